//! The connection to a running daemon, for `tail`, `watch` and the commands of its control socket.
//!
//! In: the socket or address from the command line. Without one, the default paths of a daemon's
//! socket are tried, then the sockets of running demonstrations. Out: a connection whose lines have
//! a limited length.

use std::fmt;
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, ErrorKind, Write as _};
use std::os::fd::OwnedFd;
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::Args as ClapArgs;
use rustix::net::sockopt::{Timeout, set_socket_timeout};
use serde_json::Value;

use super::exit::{Failure, UNAVAILABLE};
use super::{demo, doctor};
use crate::daemon::config::Unix;
use crate::daemon::tcp;
use hardnessd_core::event::PROTOCOL;

/// How long a daemon may take to send `hello`: a hundred times the 50 ms that a running one takes
/// at most, because a service manager may have to start it first.
const HELLO: Duration = Duration::from_secs(5);

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
    let is_one = |(host, port): (&str, &str)| !host.is_empty() && port.parse::<u16>().is_ok();
    match text.rsplit_once(':').is_some_and(is_one) {
        true => Ok(text.to_owned()),
        false => Err("expected HOST:PORT, such as 192.168.7.2:8255"),
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

/// The longest line that a daemon may send: a `hello` that describes thousands of sensors. A frame
/// takes about 6 kB.
const LONGEST_LINE_BYTES: usize = 1 << 20;

/// A connection to a daemon. Its calls block, so it has a thread of its own.
pub(super) struct Connection {
    /// The daemon's address.
    pub(super) address: Address,
    input: BufReader<File>,
    /// What has come of the next line.
    begun: Vec<u8>,
}

impl Source {
    /// Connects to the daemon that the command line names, or else to the first daemon found.
    /// [`Connection`] has its address.
    ///
    /// # Errors
    ///
    /// Fails if no daemon answers.
    pub(super) fn connect(&self) -> Result<Connection, Failure> {
        match self.given() {
            Some(address) => Connection::open(&address),
            None => find("events.sock"),
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
/// Fails if no daemon answers.
pub(super) fn control(path: Option<PathBuf>) -> Result<Connection, Failure> {
    match path {
        Some(path) => Connection::open(&Address::Unix(path)),
        None => find("control.sock"),
    }
}

/// The first daemon that answers at one of the usual places, at its socket of this name.
fn find(name: &str) -> Result<Connection, Failure> {
    let place = |path: PathBuf| path.with_file_name(name);
    let places: Vec<PathBuf> = Unix::places().into_iter().map(place).collect();
    let demos = demo::sockets().into_iter().map(place);
    let mut denied = None;
    for path in places.iter().cloned().chain(demos) {
        let address = Address::Unix(path);
        match Connection::try_open(&address) {
            Ok(connection) => return Ok(connection),
            Err(error) if error.kind() == ErrorKind::PermissionDenied => {
                denied = denied.or(Some(refusal(&address, error)));
            }
            Err(_) => {}
        }
    }
    if let Some(denied) = denied {
        return Err(denied);
    }
    let places = places.iter().map(|path| path.display().to_string());
    let problem = format!(
        "no daemon answers at {}, and no demo runs: start one with `hardnessd run` or `hardnessd demo`, or name its \
         socket with --socket",
        places.collect::<Vec<_>>().join(" or ")
    );
    Err(Failure::new(UNAVAILABLE, problem))
}

impl Connection {
    pub(super) fn open(address: &Address) -> Result<Self, Failure> {
        Self::try_open(address).map_err(|error| refusal(address, error))
    }

    fn try_open(address: &Address) -> io::Result<Self> {
        let stream: OwnedFd = match address {
            Address::Unix(path) => UnixStream::connect(path)?.into(),
            Address::Tcp(name) => tcp::connect(name, HELLO, tcp::PATIENCE)?.into(),
        };
        Ok(Self {
            address: address.clone(),
            input: BufReader::new(stream.into()),
            begun: Vec::new(),
        })
    }

    /// The first line of a daemon, its `hello`. A web server answers only if something was sent before.
    ///
    /// # Errors
    ///
    /// Fails if what answers is no daemon of this protocol, or has too many subscribers.
    pub(super) fn meet(&mut self) -> Result<Value, Failure> {
        let Some(first) = self.next_within(HELLO)? else {
            return Err(self.failed(format_args!(
                "no answer for {} s: what listens there is no hardnessd, or it hangs",
                HELLO.as_secs()
            )));
        };
        let hello: Value = serde_json::from_str(&first).unwrap_or_default();
        let found = match (hello["type"].as_str(), &hello["protocol"]) {
            (Some("hello"), protocol) if *protocol == PROTOCOL => return Ok(hello),
            (Some("hello"), protocol) => format!("protocol {protocol}"),
            (Some("error"), _) => {
                let message = hello["message"].as_str().unwrap_or_default();
                return Err(self.failed(format_args!("the daemon says: {message}")));
            }
            (Some(kind), _) => format!("{kind:?}"),
            (None, _) if first.starts_with("HTTP/") => {
                let server = "a web server answers there, such as the live page's: name the address of [publish.tcp]";
                return Err(self.failed(server));
            }
            (None, _) => "a line that is no JSON".to_owned(),
        };
        Err(self.failed(format_args!(
            "found {found}, expected the hello of a daemon of protocol {PROTOCOL}"
        )))
    }

    /// The next line, without its newline.
    ///
    /// # Errors
    ///
    /// Those of [`Self::next_within`].
    pub(super) fn next(&mut self) -> Result<String, Failure> {
        loop {
            if let Some(line) = self.next_within(tcp::PATIENCE)? {
                return Ok(line);
            }
        }
    }

    /// The next line, without its newline. `None` if nothing comes for `patience`.
    ///
    /// # Errors
    ///
    /// Fails if the connection has ended, or the line is longer than a daemon may send.
    pub(super) fn next_within(&mut self, patience: Duration) -> Result<Option<String>, Failure> {
        let end = Instant::now() + patience;
        loop {
            let left = end.saturating_duration_since(Instant::now());
            let left = left.max(Duration::from_millis(1));
            let set = set_socket_timeout(self.input.get_ref(), Timeout::Recv, Some(left));
            set.map_err(|error| self.broke(error.into()))?;
            let come = match self.input.fill_buf() {
                Ok(come) => come,
                Err(error) if error.kind() == ErrorKind::WouldBlock => return Ok(None),
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(error) => return Err(self.broke(error)),
            };
            if come.is_empty() {
                return Err(self.failed("the daemon closed the connection"));
            }
            let newline = come.iter().position(|&byte| byte == b'\n');
            let of_line = &come[..newline.unwrap_or(come.len())];
            if self.begun.len() + of_line.len() > LONGEST_LINE_BYTES {
                return Err(self.failed(format_args!(
                    "closed the connection: a line is longer than {LONGEST_LINE_BYTES} bytes, which no \
                     daemon sends"
                )));
            }
            self.begun.extend_from_slice(of_line);
            let taken = of_line.len() + usize::from(newline.is_some());
            self.input.consume(taken);
            if newline.is_some() {
                let line = String::from_utf8_lossy(&self.begun).into_owned();
                self.begun.clear();
                return Ok(Some(line));
            }
            // A peer that sends a byte now and then has no more time than a silent one.
            if Instant::now() >= end {
                return Ok(None);
            }
        }
    }

    /// The failure of this connection.
    fn failed(&self, why: impl fmt::Display) -> Failure {
        Failure::new(UNAVAILABLE, format!("{}: {why}", self.address))
    }

    fn broke(&self, error: io::Error) -> Failure {
        let what = format!("{}: the connection broke", self.address);
        Failure::of(UNAVAILABLE, what, error)
    }

    /// Sends a request.
    ///
    /// # Errors
    ///
    /// Fails if the request cannot be sent.
    pub(super) fn send(&mut self, request: &str) -> Result<(), Failure> {
        let line = format!("{request}\n");
        let sent = self.input.get_mut().write_all(line.as_bytes());
        sent.map_err(|error| self.broke(error))
    }
}

/// The failure of a connection that was not accepted.
fn refusal(address: &Address, error: io::Error) -> Failure {
    match address {
        Address::Unix(path) if error.kind() == ErrorKind::PermissionDenied => {
            let problem = format!("{address}: permission denied: {}", remedy(path));
            Failure::new(UNAVAILABLE, problem)
        }
        _ => Failure::of(UNAVAILABLE, format!("{address}: no daemon answers"), error),
    }
}

/// What gives a user access to a socket: its group, if that may connect. If the group is unknown, it is that
/// of the packaged daemon.
fn remedy(path: &Path) -> String {
    let file = fs::metadata(path).ok();
    if file.as_ref().is_some_and(|file| file.mode() & 0o020 == 0) {
        return "only the daemon's user may connect: use sudo, or set control_mode and control_group \
                in [publish.unix]"
            .to_owned();
    }
    let gid = file.map_or(0, |file| file.gid());
    let group = doctor::group(gid).filter(|_| gid != 0);
    let group = group.unwrap_or_else(|| "hardnessd".to_owned());
    format!("join the group {group} (`sudo usermod -aG {group} $USER`) and log in again")
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

    #[test]
    fn what_is_no_daemon_is_left_and_named() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("other.sock");
        let listener = std::os::unix::net::UnixListener::bind(&path).unwrap();
        // The first line, and the bytes that follow again and again.
        for (first, more, expected) in [
            // A byte now and then is no hello.
            ("", 1, "no answer for 5 s"),
            ("", 1 << 16, "which no daemon sends"),
            (
                "{\"type\":\"hello\",\"protocol\":2}\n",
                1,
                "found protocol 2, expected the hello of a daemon of protocol 1",
            ),
            ("{\"type\":\"ok\"}\n", 1, "found \"ok\", expected the hello"),
            ("SSH-2.0\n", 1, "found a line that is no JSON"),
            ("HTTP/1.1 400 Bad\r\n", 1, "of [publish.tcp]"),
        ] {
            let mut connection = control(Some(path.clone())).unwrap();
            let (mut stream, _) = listener.accept().unwrap();
            let sender = std::thread::spawn(move || {
                stream.write_all(first.as_bytes()).unwrap();
                let mut sent = 0;
                while stream.write_all(&vec![b'x'; more]).is_ok() {
                    sent += more;
                    std::thread::sleep(Duration::from_millis(10));
                }
                sent
            });
            let error = connection.meet().unwrap_err();
            let line = error.line();
            assert!(line.starts_with(&path.display().to_string()), "{line}");
            assert!(line.contains(expected) && !line.contains('\n'), "{line}");
            assert_eq!(error.code, UNAVAILABLE, "{line}");
            drop(connection);
            // The sender wrote more than the reader took, because the system's buffers hold the rest.
            assert!(sender.join().unwrap() < 4 * LONGEST_LINE_BYTES);
        }
    }
}
