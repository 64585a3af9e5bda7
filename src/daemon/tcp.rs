//! TCP listeners and the options of their connections.

use std::io;
use std::net::{
    SocketAddr, TcpListener as StdListener, TcpStream as StdStream, ToSocketAddrs as _,
};
use std::os::fd::AsFd;
use std::time::Duration;

use rustix::net::sockopt;
use tokio::net::{TcpListener, TcpStream};

use super::Error;
use super::accept::Listener;

/// The bytes that the system may hold for a subscriber that does not read, as many as for a Unix
/// socket. The system doubles the number for its own use. The system's default would grow to
/// megabytes.
const SEND_BUFFER_BYTES: usize = 104 * 1024;

/// A connection to a client ends when its other end is gone or takes nothing for this long. Without this, such
/// clients would occupy all connections for good.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);
/// The number of probes without an answer after which the other end is gone.
const PROBES: u32 = 5;

/// A listening TCP socket.
#[derive(Debug)]
pub(crate) struct Tcp {
    listener: TcpListener,
    /// The listener's address. If the configured port was 0, it has the port that the system chose.
    pub(crate) address: SocketAddr,
}

impl Tcp {
    /// Listens on `address`. `key` is its key in the configuration.
    pub(crate) fn bind(key: &'static str, address: SocketAddr) -> Result<Self, Error> {
        let bound = || {
            // The standard library sets SO_REUSEADDR, so the connections of a daemon that has just
            // ended do not keep this one from starting.
            let listener = StdListener::bind(address)?;
            listener.set_nonblocking(true)?;
            let address = listener.local_addr()?;
            let listener = TcpListener::from_std(listener)?;
            Ok(Self { listener, address })
        };
        let failed = |error| format!("{key}: cannot listen on {address}: {error}");
        bound().map_err(|error: io::Error| Error::io(failed(error)))
    }
}

impl Listener for Tcp {
    type Stream = TcpStream;

    async fn accept(&mut self) -> io::Result<TcpStream> {
        let (stream, _) = self.listener.accept().await?;
        // If the connection has ended already, the next read returns the error.
        let _ = behave(&stream);
        Ok(stream)
    }
}

/// Connects to a host and a port, each of whose addresses may take the time `patience`. A peer that has gone without a
/// word is noticed after the time `gone`.
pub(crate) fn connect(address: &str, patience: Duration, gone: Duration) -> io::Result<StdStream> {
    let mut last = io::Error::other("the name has no address");
    for address in address.to_socket_addrs()? {
        match StdStream::connect_timeout(&address, patience) {
            Ok(stream) => return keep_alive(&stream, gone).map(|()| stream),
            Err(error) => last = error,
        }
    }
    Err(last)
}

fn behave(stream: &TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    sockopt::set_socket_send_buffer_size(stream, SEND_BUFFER_BYTES)?;
    keep_alive(stream, PATIENCE)
}

/// Has the system end a connection whose other end has gone without a word for this long, or takes nothing,
/// even if it acknowledges that it takes nothing (`TCP_USER_TIMEOUT` of tcp(7)).
pub(crate) fn keep_alive(stream: impl AsFd, patience: Duration) -> io::Result<()> {
    let silence = patience / 2;
    sockopt::set_socket_keepalive(&stream, true)?;
    sockopt::set_tcp_keepidle(&stream, silence)?;
    sockopt::set_tcp_keepintvl(&stream, silence / PROBES)?;
    sockopt::set_tcp_keepcnt(&stream, PROBES)?;
    Ok(sockopt::set_tcp_user_timeout(
        &stream,
        patience.as_millis() as u32,
    )?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_connection_ends_when_its_other_end_takes_nothing_for_long() {
        let mut listener = Tcp::bind("key", "127.0.0.1:0".parse().unwrap()).unwrap();
        let _client = std::net::TcpStream::connect(listener.address).unwrap();
        let stream = listener.accept().await.unwrap();
        assert_eq!(sockopt::tcp_user_timeout(&stream).unwrap(), 60_000);
    }
}
