//! The connection to a running daemon, for `tail`, `watch` and the commands of its control socket.
//!
//! In: the socket or address from the command line. Without one, the default paths of a daemon's
//! socket are tried, then the sockets of running demonstrations. Out: a connection whose lines have
//! a limited length.

use std::fmt;
use std::fs;
use std::io::{self, ErrorKind};
use std::net::{SocketAddr, ToSocketAddrs};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;
use tokio::io::{AsyncRead, AsyncWriteExt};
use tokio::net::{TcpStream, UnixStream, tcp, unix};

use super::demo;
use crate::apart;
use crate::daemon::config::Unix;
use crate::daemon::lines::{LineRead, Lines};
use hardnessd_core::exit::{Coded, UNAVAILABLE};

/// The reason why there is no daemon where a line begins with `HTTP/`.
pub(super) const WEB_SERVER: &str = "a web server answers there, such as the live page's: name the address \
                                     of [publish.tcp]";

/// Options that name a daemon.
#[derive(Debug, Clone, Default, ClapArgs)]
pub struct Source {
    /// Socket of the daemon [default: of the first daemon that answers]
    ///
    /// Tried in this order: the user's own daemon, the system's, running demos.
    #[arg(long, value_name = "P", conflicts_with = "connect")]
    socket: Option<PathBuf>,
    /// Connect over TCP instead, to the address under [publish.tcp]
    #[arg(long, value_name = "HOST:PORT", value_parser = host_port)]
    connect: Option<String>,
}

fn host_port(text: &str) -> Result<String, &'static str> {
    let port = text
        .rsplit_once(':')
        .map(|(host, port)| (host, port.parse::<u16>()));
    match port {
        Some((host, Ok(_))) if !host.is_empty() => Ok(text.to_owned()),
        _ => Err("expected HOST:PORT, such as 192.168.7.2:8255"),
    }
}

/// The address of a daemon.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Address {
    /// A socket on this machine.
    Unix(PathBuf),
    /// A host and port, over TCP.
    Tcp(String),
}

impl fmt::Display for Address {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unix(path) => path.display().fmt(out),
            Self::Tcp(address) => address.fmt(out),
        }
    }
}

/// An error of a connection to a daemon.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No daemon listens at the address.
    #[error("{address}: no daemon answers: {source}")]
    NoAnswer {
        /// The address.
        address: Address,
        /// The system's error.
        source: io::Error,
    },
    /// No daemon listens at any of the usual places.
    #[error(
        "no daemon answers at {places}, and no demo runs: start one with `hardnessd run` or \
         `hardnessd demo`, or name its socket with --socket"
    )]
    Nowhere {
        /// The paths that were tried.
        places: String,
    },
    /// This user may not connect to the socket.
    #[error(
        "{path}: permission denied: join the group {group} (`sudo usermod -aG {group} $USER`) and \
         log in again"
    )]
    Denied {
        /// Path of the socket.
        path: PathBuf,
        /// The group whose members may connect.
        group: String,
    },
    /// The connection broke.
    #[error("{address}: the connection broke: {source}")]
    Broken {
        /// The address.
        address: Address,
        /// The system's error.
        source: io::Error,
    },
    /// The daemon has ended.
    #[error("{address}: the daemon closed the connection")]
    Closed {
        /// The address.
        address: Address,
    },
    /// The other end sent a line that is too long for a daemon.
    #[error(
        "{address}: closed the connection: a line is longer than {LONGEST_LINE_BYTES} bytes, which no \
         daemon sends"
    )]
    TooLong {
        /// The address.
        address: Address,
    },
}

impl Coded for Error {
    fn exit_code(&self) -> u8 {
        UNAVAILABLE
    }
}

/// The longest line that a daemon may send: a `hello` that describes thousands of sensors. A frame
/// takes about 6 kB.
const LONGEST_LINE_BYTES: usize = 1 << 20;

/// A connection to a daemon.
pub(super) struct Connection {
    address: Address,
    lines: Lines<Box<dyn AsyncRead + Send + Unpin>>,
    output: Output,
}

enum Output {
    Unix(unix::OwnedWriteHalf),
    Tcp(tcp::OwnedWriteHalf),
}

impl Source {
    /// Connects to the daemon that the command line names, or else to the first daemon found.
    /// [`Connection::address`] gives its address.
    ///
    /// # Errors
    ///
    /// Returns [`Error`] if no daemon answers.
    pub(super) async fn connect(&self) -> Result<Connection, Error> {
        match self.given() {
            Some(address) => Connection::open(address).await,
            None => find("events.sock").await,
        }
    }

    /// The address that the command line names.
    pub(super) fn given(&self) -> Option<Address> {
        let tcp = self.connect.clone().map(Address::Tcp);
        tcp.or_else(|| self.socket.clone().map(Address::Unix))
    }
}

/// Connects to the control socket at `path`, or else to that of the first daemon found, which is
/// beside its other one.
///
/// # Errors
///
/// Returns [`Error`] if no daemon answers.
pub(super) async fn control(path: Option<PathBuf>) -> Result<Connection, Error> {
    match path {
        Some(path) => Connection::open(Address::Unix(path)).await,
        None => find("control.sock").await,
    }
}

/// The first daemon that answers at one of the usual places, at its socket of this name.
async fn find(name: &str) -> Result<Connection, Error> {
    let place = |path: PathBuf| path.with_file_name(name);
    let places: Vec<PathBuf> = Unix::places().into_iter().map(place).collect();
    let demos = demo::sockets().into_iter().map(place);
    let mut denied = None;
    for path in places.iter().cloned().chain(demos) {
        match Connection::open(Address::Unix(path)).await {
            Ok(connection) => return Ok(connection),
            Err(error @ Error::Denied { .. }) => denied = denied.or(Some(error)),
            Err(_) => {}
        }
    }
    let tried = || {
        let places: Vec<String> = places
            .iter()
            .map(|path| path.display().to_string())
            .collect();
        places.join(" or ")
    };
    Err(denied.unwrap_or_else(|| Error::Nowhere { places: tried() }))
}

/// Connects to one of the addresses of a name. A lookup may take long.
async fn connect(name: String) -> io::Result<TcpStream> {
    let found = apart::start("lookup", move || name.to_socket_addrs())?;
    let addresses: Vec<SocketAddr> = found.await.map_err(io::Error::other)??.collect();
    TcpStream::connect(&addresses[..]).await
}

impl Connection {
    async fn open(address: Address) -> Result<Self, Error> {
        let opened: io::Result<(Box<dyn AsyncRead + Send + Unpin>, Output)> = match &address {
            Address::Unix(path) => UnixStream::connect(path).await.map(|stream| {
                let (input, output) = stream.into_split();
                (Box::new(input) as Box<_>, Output::Unix(output))
            }),
            Address::Tcp(address) => connect(address.clone()).await.and_then(|stream| {
                crate::daemon::tcp::keep_alive(&stream)?;
                let (input, output) = stream.into_split();
                Ok((Box::new(input) as Box<_>, Output::Tcp(output)))
            }),
        };
        match opened {
            Ok((input, output)) => Ok(Self {
                address,
                lines: Lines::new(input, LONGEST_LINE_BYTES),
                output,
            }),
            Err(source) => Err(refusal(address, source)),
        }
    }

    /// The daemon's address.
    pub(super) fn address(&self) -> &Address {
        &self.address
    }

    /// The next line, without its newline. Cancelling the call loses nothing.
    ///
    /// # Errors
    ///
    /// Returns [`Error`] if the connection has ended, or the line is longer than a daemon may send.
    pub(super) async fn next(&mut self) -> Result<String, Error> {
        let address = || self.address.clone();
        match self.lines.next().await {
            Ok(LineRead::Line(line)) => Ok(String::from_utf8_lossy(&line).into_owned()),
            Ok(LineRead::End) => Err(Error::Closed { address: address() }),
            Ok(LineRead::TooLong) => Err(Error::TooLong { address: address() }),
            Err(source) => Err(Error::Broken {
                address: address(),
                source,
            }),
        }
    }

    /// Sends a request.
    ///
    /// # Errors
    ///
    /// Returns [`Error::Broken`] if the request cannot be sent.
    pub(super) async fn send(&mut self, request: &str) -> Result<(), Error> {
        let line = format!("{request}\n");
        let sent = match &mut self.output {
            Output::Unix(output) => output.write_all(line.as_bytes()).await,
            Output::Tcp(output) => output.write_all(line.as_bytes()).await,
        };
        sent.map_err(|source| Error::Broken {
            address: self.address.clone(),
            source,
        })
    }

    /// Sends a request if there is room for it now.
    #[cfg(feature = "watch")]
    pub(super) fn try_send(&self, request: &str) {
        let line = format!("{request}\n");
        // If the daemon does not receive the request, its missing answer shows that later.
        let _ = match &self.output {
            Output::Unix(output) => output.try_write(line.as_bytes()),
            Output::Tcp(output) => output.try_write(line.as_bytes()),
        };
    }
}

/// The error for a connection that was not accepted.
fn refusal(address: Address, source: io::Error) -> Error {
    match address {
        Address::Unix(path) if source.kind() == ErrorKind::PermissionDenied => Error::Denied {
            group: group(&path),
            path,
        },
        address => Error::NoAnswer { address, source },
    }
}

/// The group of a socket. If it is unknown, the group of the packaged daemon.
fn group(path: &Path) -> String {
    let name = || {
        let gid = fs::metadata(path).ok()?.gid().to_string();
        let groups = fs::read_to_string("/etc/group").ok()?;
        let mut lines = groups.lines().map(|line| line.split(':'));
        lines.find_map(|mut fields| {
            let name = fields.next()?;
            (gid != "0" && fields.nth(1)? == gid).then(|| name.to_owned())
        })
    };
    name().unwrap_or_else(|| "hardnessd".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_has_a_host_and_a_port() {
        for good in ["localhost:8255", "192.168.7.2:1", "[::1]:65535"] {
            assert_eq!(host_port(good).as_deref(), Ok(good));
        }
        for bad in ["localhost", ":8255", "host:", "host:99999", ""] {
            assert!(host_port(bad).is_err(), "{bad:?}");
        }
    }

    #[tokio::test]
    async fn a_server_without_newlines_is_left() {
        use tokio::io::AsyncWriteExt;

        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("hostile.sock");
        let listener = tokio::net::UnixListener::bind(&path).unwrap();
        let sender = tokio::spawn(async move {
            let (mut stream, _) = listener.accept().await.unwrap();
            let mut sent = 0;
            while stream.write_all(&[b'x'; 65536]).await.is_ok() {
                sent += 65536;
            }
            sent
        });
        let source = Source {
            socket: Some(path),
            connect: None,
        };
        let mut connection = source.connect().await.unwrap();
        let error = connection.next().await.unwrap_err();
        assert!(matches!(error, Error::TooLong { .. }), "{error}");
        drop(connection);
        // The sender wrote more than the reader took, because the system's buffers hold the rest.
        assert!(sender.await.unwrap() < 4 * LONGEST_LINE_BYTES);
    }
}
