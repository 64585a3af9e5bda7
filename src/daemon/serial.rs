//! One port, which is opened, read, and opened again when it is lost.
//!
//! In: the configured port, and what the sensor expects to be sent. Out: one [`Turn`] at a time:
//! bytes, or what happened to the port. This module tries to open the port for as long as it runs,
//! and never interprets the bytes. A read of no bytes means that the port is lost: every read of an
//! unplugged tty gives no bytes, and so does a read of a connection that the other end has closed.

mod network;
pub(crate) mod tty;

use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use rustix::io::Errno;
use serialport::TTYPort;
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio::sync::oneshot;
use tokio::time::Instant;
use tokio_serial::SerialStream;

use self::network::{Datagram, Udp};
use self::tty::{Changed, LineSettings};
use super::busy;
use super::port::Port;
use crate::apart::{self, NoThread};
use crate::maybe;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::wording;

/// The pause before the first try to reopen. It doubles with each try that fails.
const FIRST_PAUSE: Duration = Duration::from_millis(50);
/// The longest pause. A sensor that is plugged in again is read within this time.
const LONGEST_PAUSE: Duration = Duration::from_secs(2);

/// The most bytes read at once: 20 frames of the JX255N.
const BUFFER_BYTES: usize = 16 * 1024;
/// The longest datagram.
const DATAGRAM_BYTES: usize = 64 * 1024;

/// How often the settings of a serial line are compared while its sensor is stale.
const COMPARE_EVERY: Duration = Duration::from_secs(1);

/// A change of the port, or bytes from it.
#[derive(Debug)]
pub(crate) enum Turn<'a> {
    /// The port was opened, or another sender of datagrams has taken the place of the last one. The
    /// next bytes do not continue the earlier ones.
    Opened,
    /// The port cannot be opened now, for this reason.
    Unavailable(String),
    /// Bytes arrived.
    Bytes(&'a [u8]),
    /// The port was open and is lost, for this reason.
    Lost(String),
    /// Another program had changed the settings of the line. They are set again.
    Restored(Changed),
    /// Datagrams of this sender are ignored, because another one sends.
    Stranger(SocketAddr),
}

/// What a link must know of its sensor.
#[derive(Debug, Clone)]
pub(crate) struct Settings {
    /// The silence after which the sensor is stale.
    pub(crate) stale_after: Duration,
    /// Sent once after each opening.
    pub(crate) start: Vec<u8>,
    /// Sent again and again, after this time.
    pub(crate) request: Option<(Vec<u8>, Duration)>,
}

impl Settings {
    /// The settings for `sensor`.
    pub(crate) fn of(sensor: &Sensor) -> Self {
        let frame = &sensor.description().frame;
        let every = frame.request_ms.map(|ms| Duration::from_millis(ms.into()));
        let request = frame.request.as_ref();
        Self {
            stale_after: sensor.stale_after(),
            start: frame.start.clone().unwrap_or_default().0,
            request: request.map(|bytes| (bytes.0.clone(), every.unwrap_or(sensor.period()))),
        }
    }

    /// The bytes to send at the opening.
    fn opening(&self) -> Vec<u8> {
        let request = self.request.iter().flat_map(|(bytes, _)| bytes);
        self.start.iter().chain(request).copied().collect()
    }
}

/// A port and its state.
#[derive(Debug)]
pub(crate) struct Link {
    port: Port,
    baud: u32,
    settings: Settings,
    state: State,
    pause: Duration,
    buffer: Box<[u8]>,
}

#[derive(Debug)]
enum State {
    /// The port will be opened at this time.
    Waiting(Instant),
    /// A separate thread is opening the port, because a driver or a network may be slow.
    Opening(oneshot::Receiver<Result<Opened, String>>),
    Open(Open),
}

/// A port that is open, but not known to the runtime yet.
#[derive(Debug)]
enum Opened {
    Tty(TTYPort, LineSettings),
    Tcp(std::net::TcpStream),
    Udp(std::net::UdpSocket),
}

#[derive(Debug)]
struct Open {
    line: Line,
    /// When the next request is due, if the sensor wants any.
    request_at: Option<Instant>,
    /// When the settings of a serial line are compared next.
    compare_at: Option<Instant>,
    /// The number of bytes of a new sender that the next turn returns.
    held: Option<usize>,
}

#[derive(Debug)]
enum Line {
    Tty(SerialStream, LineSettings),
    Tcp(TcpStream),
    Udp(Udp),
}

/// What happened to an open port.
enum Happened {
    Read(io::Result<Datagram>),
    RequestIsDue,
    CompareIsDue,
}

impl Link {
    /// A link to `port`. The first turn opens it.
    pub(crate) fn new(port: &Port, baud: u32, settings: Settings) -> Self {
        let bytes = match port {
            Port::Device(_) | Port::Tcp(_) => BUFFER_BYTES,
            Port::Udp(_) => DATAGRAM_BYTES,
        };
        Self {
            port: port.clone(),
            baud,
            settings,
            state: State::Waiting(Instant::now()),
            pause: FIRST_PAUSE,
            buffer: vec![0; bytes].into(),
        }
    }

    /// Waits for the next turn of the port. Cancelling the wait loses nothing.
    pub(crate) async fn turn(&mut self) -> Turn<'_> {
        loop {
            match &mut self.state {
                State::Waiting(until) => {
                    tokio::time::sleep_until(*until).await;
                    let opening = start_opening(&self.port, self.baud, self.settings.opening());
                    match opening {
                        Ok(opening) => self.state = State::Opening(opening),
                        Err(NoThread(error)) => {
                            self.wait();
                            return Turn::Unavailable(format!("no thread to open it: {error}"));
                        }
                    }
                }
                State::Opening(opening) => {
                    let opened = match opening.await {
                        Ok(opened) => opened.and_then(|opened| {
                            Open::new(opened, &self.settings).map_err(|error| wording::line(&error))
                        }),
                        Err(ended) => Err(ended.to_string()),
                    };
                    match opened {
                        Ok(open) => {
                            self.state = State::Open(open);
                            return Turn::Opened;
                        }
                        Err(reason) => {
                            self.wait();
                            return Turn::Unavailable(reason);
                        }
                    }
                }
                State::Open(open) => {
                    if let Some(read) = open.held.take() {
                        return Turn::Bytes(&self.buffer[..read]);
                    }
                    // A sensor may send faster than the daemon reads.
                    busy::rest();
                    let happened = open.wait(&mut self.buffer, self.settings.stale_after).await;
                    let now = Instant::now();
                    let lost = match happened {
                        Happened::Read(Ok(Datagram::Bytes(0))) => open.line.end().to_owned(),
                        Happened::Read(Ok(Datagram::Bytes(read))) => {
                            return Turn::Bytes(&self.buffer[..read]);
                        }
                        Happened::Read(Ok(Datagram::First(read))) => {
                            open.line.send(&self.settings.opening());
                            if read == 0 {
                                continue;
                            }
                            return Turn::Bytes(&self.buffer[..read]);
                        }
                        Happened::Read(Ok(Datagram::Next(read))) => {
                            open.line.send(&self.settings.opening());
                            open.held = (read > 0).then_some(read);
                            return Turn::Opened;
                        }
                        Happened::Read(Ok(Datagram::Stranger(address))) => {
                            return Turn::Stranger(address);
                        }
                        Happened::Read(Ok(Datagram::Ignored)) => continue,
                        Happened::Read(Err(error)) => error.to_string(),
                        Happened::RequestIsDue => {
                            if let Some((request, every)) = &self.settings.request {
                                open.line.send(request);
                                let next = open.request_at.map(|at| (at + *every).max(now));
                                open.request_at = next;
                            }
                            continue;
                        }
                        Happened::CompareIsDue => {
                            open.compare_at = Some(now + COMPARE_EVERY);
                            match open.line.restore() {
                                Some(changed) => return Turn::Restored(changed),
                                None => continue,
                            }
                        }
                    };
                    self.wait();
                    return Turn::Lost(lost);
                }
            }
        }
    }

    /// Records that the port works: frames come. So it is opened again quickly after the next loss,
    /// and its settings are right. A port that fails as soon as it is opened never gets so far.
    pub(crate) fn proven(&mut self) {
        self.pause = FIRST_PAUSE;
        if let State::Open(Open {
            compare_at: Some(at),
            ..
        }) = &mut self.state
        {
            *at = Instant::now() + self.settings.stale_after;
        }
    }

    /// Takes over the changed settings of the sensor.
    pub(crate) fn reload(&mut self, settings: Settings) {
        self.settings = settings;
    }

    fn wait(&mut self) {
        self.state = State::Waiting(Instant::now() + self.pause);
        self.pause = (self.pause * 2).min(LONGEST_PAUSE);
    }
}

impl Open {
    fn new(opened: Opened, settings: &Settings) -> io::Result<Self> {
        let now = Instant::now();
        let line = match opened {
            Opened::Tty(port, settings) => Line::Tty(SerialStream::try_from(port)?, settings),
            Opened::Tcp(stream) => Line::Tcp(TcpStream::from_std(stream)?),
            Opened::Udp(socket) => Line::Udp(Udp::new(socket)?),
        };
        let is_tty = matches!(line, Line::Tty(..));
        Ok(Self {
            line,
            request_at: settings.request.as_ref().map(|(_, every)| now + *every),
            compare_at: is_tty.then_some(now + COMPARE_EVERY),
            held: None,
        })
    }

    async fn wait(&mut self, buffer: &mut [u8], stale_after: Duration) -> Happened {
        // A read that is cancelled has read nothing, because a read is one system call, made when
        // bytes are there.
        tokio::select! {
            read = self.line.read(buffer, stale_after) => Happened::Read(read),
            () = maybe::until(self.request_at) => Happened::RequestIsDue,
            () = maybe::until(self.compare_at) => Happened::CompareIsDue,
        }
    }
}

impl Line {
    async fn read(&mut self, buffer: &mut [u8], stale_after: Duration) -> io::Result<Datagram> {
        match self {
            Self::Tty(port, _) => AsyncReadExt::read(port, buffer).await.map(Datagram::Bytes),
            Self::Tcp(stream) => stream.read(buffer).await.map(Datagram::Bytes),
            Self::Udp(udp) => udp.read(buffer, stale_after).await,
        }
    }

    /// Sends bytes, if there is room for them. What is not sent is sent with the next request, and
    /// the next read finds out why.
    fn send(&self, bytes: &[u8]) {
        match self {
            Self::Tty(_, settings) => drop(settings.send(bytes)),
            Self::Tcp(stream) => drop(rustix::io::write(stream, bytes)),
            Self::Udp(udp) => udp.send(bytes),
        }
    }

    /// Sets the settings of a serial line again, if they differ.
    fn restore(&self) -> Option<Changed> {
        match self {
            // Where this fails, the next read finds out why.
            Self::Tty(_, settings) => settings.restore().ok().flatten(),
            Self::Tcp(_) | Self::Udp(_) => None,
        }
    }

    /// The reason of a loss by a read of no bytes.
    fn end(&self) -> &'static str {
        match self {
            Self::Tty(..) | Self::Udp(_) => "end of file",
            Self::Tcp(_) => "closed by the other end",
        }
    }
}

/// Opens the port in a thread of its own, and sends `first` there.
///
/// # Errors
///
/// Fails if the system has no thread to spare.
fn start_opening(
    port: &Port,
    baud: u32,
    first: Vec<u8>,
) -> Result<oneshot::Receiver<Result<Opened, String>>, NoThread> {
    let port = port.clone();
    apart::start("port", move || {
        open(&port, baud, &first).map_err(|error| reason(&port, &error))
    })
}

fn open(port: &Port, baud: u32, first: &[u8]) -> io::Result<Opened> {
    match port {
        Port::Device(path) => {
            let (port, settings) = tty::open(path, baud)?;
            if !first.is_empty() {
                settings.send(first)?;
            }
            Ok(Opened::Tty(port, settings))
        }
        Port::Tcp(address) => {
            let stream = network::connect(address)?;
            if !first.is_empty() {
                rustix::io::write(&stream, first)?;
            }
            Ok(Opened::Tcp(stream))
        }
        // The first bytes go to the first sender.
        Port::Udp(address) => {
            let socket = std::net::UdpSocket::bind(address)?;
            socket.set_nonblocking(true)?;
            Ok(Opened::Udp(socket))
        }
    }
}

/// Whether a port that is no device can be opened now.
pub(crate) fn probe(port: &Port) -> io::Result<()> {
    open(port, 0, &[]).map(drop)
}

/// Why `port` cannot be opened, in plain words.
pub(crate) fn reason(port: &Port, error: &io::Error) -> String {
    let Some(path) = port.device() else {
        return wording::line(error);
    };
    match Errno::from_io_error(error) {
        Some(Errno::BUSY | Errno::WOULDBLOCK) if tty::is_held_here(path) => {
            "this daemon reads that port already, for another sensor".to_owned()
        }
        Some(Errno::BUSY | Errno::WOULDBLOCK) => "port held by another process".to_owned(),
        Some(Errno::NOENT) => "no such device".to_owned(),
        Some(Errno::ACCESS) => "permission denied".to_owned(),
        Some(Errno::NOTTY) => "not a serial port".to_owned(),
        _ => wording::line(error),
    }
}
