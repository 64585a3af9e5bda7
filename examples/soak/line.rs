//! The line from a simulated sensor to the daemon: a pty, or a TCP connection or datagrams as of a
//! board on Wi-Fi.

use std::fs;
use std::io::{self, ErrorKind, Write};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use rustix::termios::OptionalActions;

use crate::pair::Pair;

pub(crate) enum Line {
    /// A pty behind a link, which is the port of the configuration.
    Pty { pair: Pair, port: PathBuf },
    /// The daemon connects to the address.
    Tcp {
        address: SocketAddr,
        listener: Option<TcpListener>,
        stream: Option<TcpStream>,
    },
    /// The daemon takes datagrams at the address.
    Udp {
        address: SocketAddr,
        socket: Option<UdpSocket>,
    },
}

/// The bytes of a datagram on Ethernet. A longer frame comes in several.
const DATAGRAM_BYTES: usize = 1472;

/// A free port of this machine.
const ANY: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

fn plug(port: &Path) -> io::Result<Pair> {
    let pair = Pair::open()?;
    let mut settings = rustix::termios::tcgetattr(&pair.device)?;
    settings.make_raw();
    rustix::termios::tcsetattr(&pair.device, OptionalActions::Now, &settings)?;
    symlink(&pair.path, port)?;
    Ok(pair)
}

fn listen(address: SocketAddr) -> io::Result<TcpListener> {
    let listener = TcpListener::bind(address)?;
    listener.set_nonblocking(true)?;
    Ok(listener)
}

/// The bytes that wait at the socket with this address, and the datagrams that it dropped.
fn waiting(address: SocketAddr) -> io::Result<(u64, u64)> {
    let sockets = fs::read_to_string("/proc/net/udp")?;
    // Each line has: number, address:port, peer, state, bytes out:bytes in, and others up to the drops.
    let end = format!(":{:04X}", address.port());
    let found = sockets.lines().skip(1).find_map(|line| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        if !fields.get(1)?.ends_with(&end) {
            return None;
        }
        let (_, bytes) = fields.get(4)?.split_once(':')?;
        let bytes = u64::from_str_radix(bytes, 16).ok()?;
        Some((bytes, fields.last()?.parse().ok()?))
    });
    found.ok_or_else(|| io::Error::other(format!("no socket at {address} in /proc/net/udp")))
}

impl Line {
    pub(crate) fn pty(port: PathBuf) -> io::Result<Self> {
        let pair = plug(&port)?;
        Ok(Self::Pty { pair, port })
    }

    pub(crate) fn tcp() -> io::Result<Self> {
        let listener = listen(ANY)?;
        Ok(Self::Tcp {
            address: listener.local_addr()?,
            listener: Some(listener),
            stream: None,
        })
    }

    pub(crate) fn udp() -> io::Result<Self> {
        // The daemon binds the port that is free now.
        let address = UdpSocket::bind(ANY)?.local_addr()?;
        Ok(Self::Udp {
            address,
            socket: Some(UdpSocket::bind(ANY)?),
        })
    }

    /// `port` of the configuration.
    pub(crate) fn port(&self) -> String {
        match self {
            Self::Pty { port, .. } => port.display().to_string(),
            Self::Tcp { address, .. } => format!("tcp://{address}"),
            Self::Udp { address, .. } => format!("udp://{address}"),
        }
    }

    /// The bytes that are lost together.
    pub(crate) fn unit(&self) -> usize {
        match self {
            Self::Pty { .. } | Self::Tcp { .. } => 1,
            Self::Udp { .. } => DATAGRAM_BYTES,
        }
    }

    /// Whether the daemon sees that the cable is pulled. Datagrams only stop.
    pub(crate) fn has_end(&self) -> bool {
        !matches!(self, Self::Udp { .. })
    }

    /// The number of datagrams that found no room at the daemon, as the system counts them.
    pub(crate) fn dropped(&self) -> io::Result<u64> {
        match self {
            Self::Pty { .. } | Self::Tcp { .. } => Ok(0),
            Self::Udp { address, .. } => Ok(waiting(*address)?.1),
        }
    }

    /// Writes bytes. Without a connection they are lost.
    pub(crate) fn write(&mut self, mut bytes: &[u8]) -> io::Result<()> {
        match self {
            Self::Pty { pair, .. } => {
                while !bytes.is_empty() {
                    // Until the other end is opened, there is room for 4 kB.
                    bytes = &bytes[rustix::io::write(&pair.master, bytes)?..];
                }
                Ok(())
            }
            Self::Tcp {
                listener, stream, ..
            } => {
                if let (None, Some(listener)) = (&stream, &listener) {
                    match listener.accept() {
                        Ok((accepted, _)) => {
                            accepted.set_nonblocking(false)?;
                            *stream = Some(accepted);
                        }
                        Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                        Err(error) => return Err(error),
                    }
                }
                stream
                    .as_mut()
                    .map_or(Ok(()), |stream| stream.write_all(bytes))
            }
            Self::Udp { address, socket } => {
                if let Some(socket) = socket {
                    for datagram in bytes.chunks(DATAGRAM_BYTES) {
                        socket.send_to(datagram, *address)?;
                    }
                }
                Ok(())
            }
        }
    }

    /// Whether the daemon has read all that was written. The system delivers it to the end of a
    /// connection that is closed.
    pub(crate) fn is_read(&self) -> io::Result<bool> {
        match self {
            Self::Pty { pair, .. } => Ok(rustix::io::ioctl_fionread(&pair.device)? == 0),
            Self::Tcp { .. } => Ok(true),
            Self::Udp { address, .. } => Ok(waiting(*address)?.0 == 0),
        }
    }

    /// Pulls the cable.
    pub(crate) fn unplug(&mut self) -> io::Result<()> {
        match self {
            Self::Pty { pair, port } => {
                fs::remove_file(&*port)?;
                // Open the new pty before the old one is closed, so that its name is a different one.
                *pair = plug(&port.with_extension("next"))?;
            }
            Self::Tcp {
                listener, stream, ..
            } => (*listener, *stream) = (None, None),
            Self::Udp { socket, .. } => *socket = None,
        }
        Ok(())
    }

    /// Plugs the cable in again.
    pub(crate) fn plug(&mut self) -> io::Result<()> {
        match self {
            Self::Pty { port, .. } => fs::rename(port.with_extension("next"), port),
            Self::Tcp {
                address, listener, ..
            } => {
                *listener = Some(listen(*address)?);
                Ok(())
            }
            // The board has another port, so for the daemon it is another sender.
            Self::Udp { socket, .. } => {
                *socket = Some(UdpSocket::bind(ANY)?);
                Ok(())
            }
        }
    }
}
