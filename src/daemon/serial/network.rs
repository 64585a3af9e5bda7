//! Bytes of a sensor over TCP or UDP.

use std::io;
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::time::Duration;

use tokio::net::UdpSocket;
use tokio::time::Instant;

/// How long a connection may take.
const CONNECTING: Duration = Duration::from_secs(5);

/// A peer that has gone without a word, such as a board without power, is noticed after this time. A
/// sensor that is only silent answers to the system's probes.
const GONE: Duration = Duration::from_secs(10);

/// Connects to `address`, a host and a port.
pub(super) fn connect(address: &str) -> io::Result<TcpStream> {
    let mut last = None;
    for address in address.to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, CONNECTING) {
            Ok(stream) => {
                stream.set_nodelay(true)?;
                stream.set_nonblocking(true)?;
                probe(&stream)?;
                return Ok(stream);
            }
            Err(error) => last = Some(error),
        }
    }
    Err(last.unwrap_or_else(|| io::Error::other("the name has no address")))
}

/// Has the system ask a silent peer whether it is still there.
fn probe(stream: &TcpStream) -> io::Result<()> {
    use rustix::net::sockopt;
    let every = Duration::from_secs(1);
    let first = GONE / 2;
    sockopt::set_tcp_keepidle(stream, first)?;
    sockopt::set_tcp_keepintvl(stream, every)?;
    sockopt::set_tcp_keepcnt(stream, (GONE - first).as_secs() as u32)?;
    sockopt::set_socket_keepalive(stream, true)?;
    // This covers a peer that goes while a request is under way.
    sockopt::set_tcp_user_timeout(stream, GONE.as_millis() as u32)?;
    Ok(())
}

/// A datagram, or one that is not taken.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Datagram {
    /// This many bytes came from the sender.
    Bytes(usize),
    /// The first sender has sent this many bytes.
    First(usize),
    /// Another sender has taken the place of the last one, and has sent this many bytes.
    Next(usize),
    /// Another one sends, too. It is reported once.
    Stranger(SocketAddr),
    /// It says nothing.
    Ignored,
}

/// A socket that takes datagrams from one sender at a time.
#[derive(Debug)]
pub(super) struct Udp {
    socket: UdpSocket,
    sender: Option<Sender>,
}

#[derive(Debug)]
struct Sender {
    address: SocketAddr,
    last: Instant,
    /// Whether another one was reported.
    reported: bool,
}

impl Udp {
    pub(super) fn new(socket: std::net::UdpSocket) -> io::Result<Self> {
        Ok(Self {
            socket: UdpSocket::from_std(socket)?,
            sender: None,
        })
    }

    /// Waits for the next datagram. Another sender is taken when the first has been silent for
    /// `stale_after`.
    pub(super) async fn read(
        &mut self,
        buffer: &mut [u8],
        stale_after: Duration,
    ) -> io::Result<Datagram> {
        let (bytes, address) = self.socket.recv_from(buffer).await?;
        let now = Instant::now();
        Ok(match &mut self.sender {
            Some(sender) if sender.address == address => {
                sender.last = now;
                // An empty datagram is no end.
                match bytes {
                    0 => Datagram::Ignored,
                    bytes => Datagram::Bytes(bytes),
                }
            }
            Some(sender) if now.duration_since(sender.last) < stale_after => {
                match std::mem::replace(&mut sender.reported, true) {
                    true => Datagram::Ignored,
                    false => Datagram::Stranger(address),
                }
            }
            sender => {
                let last = sender.replace(Sender {
                    address,
                    last: now,
                    reported: false,
                });
                match last {
                    None => Datagram::First(bytes),
                    Some(_) => Datagram::Next(bytes),
                }
            }
        })
    }

    /// Sends bytes to the sender, if there is one and there is room.
    pub(super) fn send(&self, bytes: &[u8]) {
        if let Some(sender) = &self.sender {
            let _ = self.socket.try_send_to(bytes, sender.address);
        }
    }
}
