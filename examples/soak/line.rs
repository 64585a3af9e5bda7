//! The line from a simulated sensor to the daemon: a pty, or a TCP connection as of a board on
//! Wi-Fi.

use std::fs;
use std::io::{self, ErrorKind, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
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
}

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

impl Line {
    pub(crate) fn pty(port: PathBuf) -> io::Result<Self> {
        let pair = plug(&port)?;
        Ok(Self::Pty { pair, port })
    }

    pub(crate) fn tcp() -> io::Result<Self> {
        let listener = listen(SocketAddr::from(([127, 0, 0, 1], 0)))?;
        Ok(Self::Tcp {
            address: listener.local_addr()?,
            listener: Some(listener),
            stream: None,
        })
    }

    /// `port` of the configuration.
    pub(crate) fn port(&self) -> String {
        match self {
            Self::Pty { port, .. } => port.display().to_string(),
            Self::Tcp { address, .. } => format!("tcp://{address}"),
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
        }
    }

    /// Whether the daemon has read all that was written. The system delivers it to the end of a
    /// connection that is closed.
    pub(crate) fn is_read(&self) -> io::Result<bool> {
        match self {
            Self::Pty { pair, .. } => Ok(rustix::io::ioctl_fionread(&pair.device)? == 0),
            Self::Tcp { .. } => Ok(true),
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
        }
    }
}
