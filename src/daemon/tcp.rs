//! TCP listeners: where they stand, and how their connections behave.

use std::io;
use std::net::{SocketAddr, TcpListener as StdListener};
use std::time::Duration;

use rustix::net::sockopt;
use tokio::net::{TcpListener, TcpStream};

use super::accept::Listener;

/// Bytes the system may hold for a subscriber that does not read, doubled by it for its own use;
/// by default it would let them grow to megabytes. As for a Unix socket.
const SEND_BUFFER_BYTES: usize = 104 * 1024;

/// A connection without traffic is looked after once it has been so for this long.
const KEEPALIVE: Duration = Duration::from_secs(30);
/// Then so often,
const KEEPALIVE_PAUSE: Duration = Duration::from_secs(10);
/// and given up after so many looks without an answer.
const KEEPALIVE_TRIES: u32 = 3;

/// Why there is no listener.
#[derive(Debug, thiserror::Error)]
#[error("{key}: cannot listen on {address}: {source}")]
pub struct Error {
    key: &'static str,
    address: SocketAddr,
    source: io::Error,
}

/// A listening TCP socket.
#[derive(Debug)]
pub(crate) struct Tcp {
    listener: TcpListener,
    address: SocketAddr,
}

impl Tcp {
    /// Listens on `address`; `key` is the one that names it in the configuration.
    pub(crate) fn bind(key: &'static str, address: SocketAddr) -> Result<Self, Error> {
        let bound = || {
            // SO_REUSEADDR is the standard library's default: connections of a daemon that has
            // just ended are no reason not to start.
            let listener = StdListener::bind(address)?;
            listener.set_nonblocking(true)?;
            let address = listener.local_addr()?;
            let listener = TcpListener::from_std(listener)?;
            Ok(Self { listener, address })
        };
        bound().map_err(|source| Error {
            key,
            address,
            source,
        })
    }

    /// Where it listens: with the port the system chose, if it was to choose.
    pub(crate) fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Listener for Tcp {
    type Stream = TcpStream;

    async fn accept(&mut self) -> io::Result<TcpStream> {
        let (stream, _) = self.listener.accept().await?;
        // A connection that is gone already is found out when it is read.
        let _ = behave(&stream);
        Ok(stream)
    }
}

fn behave(stream: &TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    sockopt::set_socket_send_buffer_size(stream, SEND_BUFFER_BYTES)?;
    sockopt::set_socket_keepalive(stream, true)?;
    sockopt::set_tcp_keepidle(stream, KEEPALIVE)?;
    sockopt::set_tcp_keepintvl(stream, KEEPALIVE_PAUSE)?;
    Ok(sockopt::set_tcp_keepcnt(stream, KEEPALIVE_TRIES)?)
}
