//! Bytes of a sensor over TCP or UDP.

use std::io::{self, Read};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use rustix::io::Errno;
use tokio::net::UdpSocket;
use tokio::time::Instant;
use tracing::warn;

use crate::daemon::{log, tcp};
use hardnessd_core::wire;

/// How long a connection may take.
const CONNECTING: Duration = Duration::from_secs(5);

/// A telnet server sends its options within this time.
const GREETING: Duration = Duration::from_millis(500);

/// A peer that has gone without a word, such as a board without power, is noticed after this time. A
/// sensor that is only silent answers to the system's probes.
const GONE: Duration = Duration::from_secs(10);

/// The most requests to a sender of datagrams that has sent no frame. A stranger gets no more, and of the modules of a
/// board some may be silent.
const UNPROVEN_REQUESTS: u32 = 32;

/// Connects to `address`, a host and a port.
pub(super) fn connect(address: &str) -> io::Result<TcpStream> {
    let stream = tcp::connect(address, CONNECTING, GONE)?;
    refuse_self(&stream)?;
    stream.set_nodelay(true)?;
    stream.set_nonblocking(true)?;
    Ok(stream)
}

/// Fails for a connection to itself. The system makes one where nothing listens and it happens to choose
/// the wanted port as its own. Such a connection would keep the port from the server.
fn refuse_self(stream: &TcpStream) -> io::Result<()> {
    if stream.local_addr()? != stream.peer_addr()? {
        return Ok(());
    }
    // Without a wait for late packets, the port is free at once.
    rustix::net::sockopt::set_socket_linger(stream, Some(Duration::ZERO))?;
    Err(Errno::CONNREFUSED.into())
}

/// Whether the other end says within a moment that it is a telnet server.
pub(super) fn is_telnet(mut stream: &TcpStream) -> bool {
    let mut bytes = [0; 3];
    let is_set =
        stream.set_nonblocking(false).is_ok() && stream.set_read_timeout(Some(GREETING)).is_ok();
    is_set && stream.read_exact(&mut bytes).is_ok() && wire::is_telnet(&bytes)
}

/// What came from a line.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Received {
    /// This many bytes.
    Bytes(usize),
    /// This many bytes of the first sender, or of another one that has taken its place.
    OfAnother(usize),
    /// A datagram that is not taken.
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
    /// When its last frame came, or its first bytes.
    last: Instant,
    sends_frames: bool,
    /// The number of requests to it, less that of its datagrams while it has sent no frame.
    requests: u32,
    /// Whether another one was reported.
    reported: bool,
}

impl Sender {
    /// Whether its last frame, or its first bytes, came less than `stale_after` ago.
    fn is_new(&self, stale_after: Duration) -> bool {
        self.last.elapsed() < stale_after
    }
}

impl Udp {
    pub(super) fn bind(address: &SocketAddr) -> io::Result<Self> {
        let socket = std::net::UdpSocket::bind(address)?;
        socket.set_nonblocking(true)?;
        Ok(Self {
            socket: UdpSocket::from_std(socket)?,
            sender: None,
        })
    }

    /// Waits for the next datagram. Another sender is taken when the first has sent no frame for
    /// `stale_after`. Bytes without frames keep no place.
    pub(super) async fn read(
        &mut self,
        buffer: &mut [u8],
        stale_after: Duration,
    ) -> io::Result<Received> {
        let (bytes, address) = self.socket.recv_from(buffer).await?;
        Ok(match &mut self.sender {
            Some(sender) if sender.address == address => {
                // It may be ready for requests only now. But no stranger may have more sent than it sends.
                if !sender.sends_frames {
                    sender.requests = sender.requests.saturating_sub(1);
                }
                // An empty datagram is no end.
                match bytes {
                    0 => Received::Ignored,
                    bytes => Received::Bytes(bytes),
                }
            }
            Some(sender) if sender.is_new(stale_after) => {
                if !std::mem::replace(&mut sender.reported, true) {
                    let sender = sender.address;
                    log::limited("UDP senders", || {
                        warn!(%sender, other = %address, "ignored: another sender sends for this sensor, and one at a time may");
                    });
                }
                Received::Ignored
            }
            sender => {
                *sender = Some(Sender {
                    address,
                    last: Instant::now(),
                    sends_frames: false,
                    requests: 0,
                    reported: false,
                });
                Received::OfAnother(bytes)
            }
        })
    }

    /// Records that the sender has sent a frame.
    pub(super) fn proven(&mut self) {
        if let Some(sender) = &mut self.sender {
            sender.last = Instant::now();
            sender.sends_frames = true;
        }
    }

    /// Sends bytes to the sender, if there is one and there is room.
    pub(super) fn send(&self, bytes: &[u8]) {
        if let Some(sender) = &self.sender {
            let _ = self.socket.try_send_to(bytes, sender.address);
        }
    }

    /// Sends a request to the sender, unless it has had some and sends no frames.
    pub(super) fn request(&mut self, bytes: &[u8]) {
        if let Some(sender) = &mut self.sender
            && (sender.sends_frames || sender.requests < UNPROVEN_REQUESTS)
        {
            sender.requests = sender.requests.saturating_add(1);
            self.send(bytes);
        }
    }
}

#[cfg(test)]
mod tests {
    use rustix::net::{
        AddressFamily, SocketAddrV4, SocketType, bind, connect, getsockname, socket,
    };

    use super::*;

    #[test]
    fn a_connection_to_itself_is_refused_and_leaves_the_port_to_the_server() {
        let itself = socket(AddressFamily::INET, SocketType::STREAM, None).unwrap();
        let any = SocketAddrV4::new(std::net::Ipv4Addr::LOCALHOST, 0);
        bind(&itself, &any).unwrap();
        let address: SocketAddr = getsockname(&itself).unwrap().try_into().unwrap();
        connect(&itself, &address).unwrap();
        let stream = TcpStream::from(itself);
        assert_eq!(stream.local_addr().unwrap(), stream.peer_addr().unwrap());
        let refused = refuse_self(&stream).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::ConnectionRefused);
        drop(stream);
        std::net::TcpListener::bind(address).unwrap();
    }
}
