//! One port, which is opened, read, and opened again when it is lost.
//!
//! In: the configured port, and what the sensor expects to be sent. Out: one input of a pipeline at a
//! time: bytes, or what happened to the port. This module tries to open the port for as long as it runs,
//! and never interprets the bytes. A read of no bytes means that the port is lost: every read of an
//! unplugged tty gives no bytes, and so does a read of a connection that the other end has closed.

mod network;
mod shared;
pub(crate) mod tty;

use std::collections::BTreeMap;
use std::io;
use std::ops::Range;
use std::time::Duration;

use rustix::io::Errno;
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio::runtime::Handle;
use tokio::sync::oneshot;
use tokio::time::Instant;
use tokio_serial::SerialStream;

use self::network::{Datagram, Udp};
use self::shared::Share;
use self::tty::LineSettings;
use super::baud::BITS_A_BYTE;
use super::{log, realtime};
use crate::maybe;
use crate::thread::{NoThread, spawn_thread};
use hardnessd_core::allowance::Allowance;
use hardnessd_core::pipeline::Input;
use hardnessd_core::port::Port;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::wire::is_telnet;
use hardnessd_core::wording;

/// The pause before the first try to reopen. It doubles with each try that fails.
const FIRST_PAUSE: Duration = Duration::from_millis(50);
/// The longest pause. A sensor that is plugged in again is read within this time.
const LONGEST_PAUSE: Duration = Duration::from_secs(2);

/// The most bytes read at once: 20 frames of the JX255N.
const BUFFER_BYTES: usize = 16 * 1024;
/// The longest datagram.
const DATAGRAM_BYTES: usize = 64 * 1024;

/// A link has held if frames come for this long. Only then is the port opened again at once after a loss.
const HELD: Duration = LONGEST_PAUSE;

/// The number of frames whose bytes are passed on at once. What they cost is then bounded, however small
/// they are.
const FRAMES_AT_ONCE: usize = 16;
/// Bytes are passed on up to this many times the rate of a sensor's frames. Frames beyond twice their rate
/// are dropped by the pipeline.
const MOST_BYTES: f64 = 4.0;
/// As many bytes may come at once as the highest rate has in this time.
const BYTES_AT_ONCE: Duration = Duration::from_secs(5);
/// The pause after each read of bytes that are not passed on.
const OVERFLOW_PAUSE: Duration = Duration::from_millis(1);
/// How often bytes that are not passed on are reported, so that a sensor that floods is not stale. This is
/// also at most a third of the stale time.
const REPORT_EVERY: Duration = Duration::from_millis(25);

/// How often the settings of a serial line are compared while its sensor is stale.
const COMPARE_EVERY: Duration = Duration::from_secs(1);

/// What a link must know of its sensor.
#[derive(Debug, Clone)]
pub(crate) struct Settings {
    /// The silence after which the sensor is stale.
    pub(crate) stale_after: Duration,
    /// Sent once after each opening.
    pub(crate) start: Vec<u8>,
    /// Sent again and again, after this time.
    pub(crate) request: Option<(Vec<u8>, Duration)>,
    /// How long a request and a frame take on the line.
    pub(crate) on_the_line: Duration,
    /// The most bytes that are passed on at once.
    pub(crate) bytes_at_once: usize,
    /// The bytes of the sensor's frames in a second, if all are as long as the longest.
    pub(crate) bytes_per_s: f64,
}

impl Settings {
    /// The settings for `sensor`.
    pub(crate) fn of(sensor: &Sensor) -> Self {
        let frame = &sensor.description().sensor.frame;
        let every = frame.request_ms.map(|ms| Duration::from_millis(ms.into()));
        let request = frame.request.as_ref();
        let asked = request.map_or(0, |bytes| bytes.0.len());
        let frame_bytes = sensor.layout().max_frame_bytes();
        let bytes = (asked + frame_bytes) as f64;
        let baud = f64::from(sensor.description().sensor.baud);
        let on_the_line = match sensor.description().sensor.port {
            Port::Device(_) => Duration::from_secs_f64(bytes * BITS_A_BYTE / baud),
            Port::Tcp(_) | Port::Udp(_) => Duration::ZERO,
        };
        Self {
            on_the_line,
            stale_after: sensor.stale_after(),
            start: frame.start.clone().unwrap_or_default().0,
            request: request.map(|bytes| (bytes.0.clone(), every.unwrap_or(sensor.period()))),
            bytes_at_once: FRAMES_AT_ONCE * frame_bytes,
            bytes_per_s: frame_bytes as f64 * sensor.frame_rate_hz(),
        }
    }

    /// The bytes to send at the opening.
    fn opening(&self) -> Vec<u8> {
        let request = self.request.iter().flat_map(|(bytes, _)| bytes);
        self.start.iter().chain(request).copied().collect()
    }

    /// The time that `bytes` take on the line at the highest rate. A line of `baud` carries that many bits
    /// in any case.
    fn time_of(&self, bytes: usize, baud: u32) -> Duration {
        let most = MOST_BYTES * self.bytes_per_s;
        let seconds = bytes as f64 / most.max(f64::from(baud) / 10.0);
        Duration::try_from_secs_f64(seconds).unwrap_or(Duration::ZERO)
    }
}

/// The port of a sensor: one of its own, or its share of one.
#[derive(Debug)]
pub(crate) enum Source {
    Own(Box<Link>),
    Shared(Share),
}

impl Source {
    /// Waits for the next input. Cancelling the wait loses nothing.
    pub(crate) async fn next(&mut self) -> Input {
        match self {
            Self::Own(link) => link.next().await,
            Self::Shared(share) => share.next().await,
        }
    }

    /// Records that the port works: frames come.
    pub(crate) fn proven(&mut self) {
        match self {
            Self::Own(link) => link.proven(),
            Self::Shared(share) => share.proven(),
        }
    }

    /// Closes the port. One that is shared is closed when all its sensors have closed it.
    pub(crate) async fn close(self) {
        if let Self::Shared(share) = self {
            share.close().await;
        }
    }
}

/// The ports of sensors that start together. Sensors with the same port share it.
#[derive(Debug, Default)]
pub(crate) struct Sources(BTreeMap<usize, Source>);

impl Sources {
    /// The port of the sensor at `index` of `sensors`.
    pub(crate) fn take(&mut self, sensors: &[Sensor], index: usize) -> Source {
        if let Some(source) = self.0.remove(&index) {
            return source;
        }
        let table = |index: usize| &sensors[index].description().sensor;
        let (port, baud) = (&table(index).port, table(index).baud);
        let same = |&other: &usize| table(other).port == *port;
        let sharing: Vec<usize> = (0..sensors.len()).filter(same).collect();
        let settings = sharing.iter().map(|&one| Settings::of(&sensors[one]));
        let settings: Vec<Settings> = settings.collect();
        if let [settings] = &settings[..] {
            return Source::Own(Box::new(Link::new(port, baud, settings.clone())));
        }
        let mut starts: Vec<&[u8]> = settings.iter().map(|one| one.start.as_slice()).collect();
        starts.dedup();
        let of_link = Settings {
            stale_after: settings
                .iter()
                .map(|one| one.stale_after)
                .max()
                .unwrap_or_default(),
            start: starts.concat(),
            request: None,
            on_the_line: Duration::ZERO,
            bytes_at_once: settings
                .iter()
                .map(|one| one.bytes_at_once)
                .min()
                .unwrap_or_default(),
            bytes_per_s: settings.iter().map(|one| one.bytes_per_s).sum(),
        };
        let shares = shared::share(Link::new(port, baud, of_link), &settings);
        let shares = shares.into_iter().map(Source::Shared);
        self.0.extend(sharing.into_iter().zip(shares));
        self.0.remove(&index).expect("the sensor has its own port")
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
    allowance: Allowance,
    /// The number of bytes that were not passed on and not reported yet.
    skipped: u64,
    /// From then on, they are reported.
    report_at: Instant,
}

#[derive(Debug)]
enum State {
    /// The port will be opened at this time.
    Waiting(Instant),
    /// A separate thread is opening the port, because a driver or a network may be slow.
    Opening(oneshot::Receiver<io::Result<Line>>),
    Open(Open),
}

#[derive(Debug)]
struct Open {
    line: Line,
    /// When the next request is due, if the sensor wants any.
    request_at: Option<Instant>,
    /// When the settings of a serial line are compared next.
    compare_at: Option<Instant>,
    /// The bytes in the buffer that come next.
    held: Range<usize>,
    /// Whether a telnet server at the other end would begin with its options now.
    is_new: bool,
    /// When the next bytes are read, if the sensor sends too many.
    read_at: Option<Instant>,
    since: Instant,
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
    /// A link to `port`. The first wait opens it.
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
            allowance: Allowance::default(),
            skipped: 0,
            report_at: Instant::now(),
        }
    }

    /// Waits for the next input: the port was opened, could not be opened or is lost, or bytes came. Another
    /// sender of datagrams counts as another opening. Cancelling the wait loses nothing.
    pub(crate) async fn next(&mut self) -> Input {
        loop {
            match &mut self.state {
                State::Waiting(until) => {
                    tokio::time::sleep_until(*until).await;
                    let opening = start_opening(&self.port, self.baud, self.settings.opening());
                    match opening {
                        Ok(opening) => self.state = State::Opening(opening),
                        Err(NoThread(error)) => {
                            self.wait();
                            let reason = format!("no thread to open it: {error}");
                            return Input::Unavailable(reason);
                        }
                    }
                }
                State::Opening(opening) => {
                    let opened = match opening.await {
                        Ok(opened) => opened.map_err(|error| reason(&self.port, &error)),
                        Err(ended) => Err(ended.to_string()),
                    };
                    match opened {
                        Ok(line) => {
                            self.state = State::Open(Open::new(line, &self.settings));
                            return Input::Opened;
                        }
                        Err(reason) => {
                            self.wait();
                            return Input::Unavailable(reason);
                        }
                    }
                }
                State::Open(open) => {
                    if !open.held.is_empty() {
                        // Others get their turn between two pieces.
                        let begin = open.held.start;
                        let bytes = open.held.len().min(self.settings.bytes_at_once);
                        open.held.start += bytes;
                        let bytes = &self.buffer[begin..][..bytes];
                        if std::mem::take(&mut open.is_new) && is_telnet(bytes) {
                            log::telnet(&self.port);
                        }
                        return Input::Bytes(bytes.to_vec());
                    }
                    // A sensor may send faster than the daemon reads.
                    realtime::rest();
                    let happened = open.wait(&mut self.buffer, self.settings.stale_after).await;
                    let now = Instant::now();
                    let lost = match happened {
                        Happened::Read(Ok(Datagram::Bytes(0))) => open.line.end().to_owned(),
                        Happened::Read(Ok(Datagram::Bytes(read))) => {
                            let time = self.settings.time_of(read, self.baud);
                            let at = super::now().mono;
                            if !self.allowance.allows(at, time, BYTES_AT_ONCE) {
                                self.skipped = (self.skipped + read as u64).min(u32::MAX.into());
                                open.read_at = Some(now + OVERFLOW_PAUSE);
                                if now < self.report_at {
                                    continue;
                                }
                                let every = REPORT_EVERY.min(self.settings.stale_after / 3);
                                self.report_at = now + every;
                                return Input::Skipped(std::mem::take(&mut self.skipped));
                            }
                            open.held = 0..read;
                            match std::mem::take(&mut self.skipped) {
                                0 => continue,
                                skipped => return Input::Skipped(skipped),
                            }
                        }
                        Happened::Read(Ok(Datagram::OfAnother(read))) => {
                            open.line.send(&self.settings.opening());
                            open.held = 0..read;
                            return Input::Opened;
                        }
                        Happened::Read(Ok(Datagram::Ignored)) => continue,
                        Happened::Read(Err(error)) => error.to_string(),
                        Happened::RequestIsDue => {
                            if let Some((request, every)) = &self.settings.request {
                                open.line.request(request, self.settings.stale_after);
                                let next = open.request_at.map(|at| (at + *every).max(now));
                                open.request_at = next;
                            }
                            continue;
                        }
                        Happened::CompareIsDue => {
                            open.compare_at = Some(now + COMPARE_EVERY);
                            open.line.restore();
                            continue;
                        }
                    };
                    self.wait();
                    return Input::Lost(lost);
                }
            }
        }
    }

    /// Sends a request, if the port is open and there is room for it.
    fn request(&self, request: &[u8]) {
        if let State::Open(open) = &self.state {
            open.line.request(request, self.settings.stale_after);
        }
    }

    /// Records that the port works: frames come. So its settings are right, and a sender of datagrams keeps
    /// its place. A port that goes on so for a while is opened again quickly after the next loss. A port
    /// that fails as soon as it is opened, or after a frame, never gets so far.
    pub(crate) fn proven(&mut self) {
        let State::Open(open) = &mut self.state else {
            return;
        };
        let now = Instant::now();
        if now.duration_since(open.since) >= HELD {
            self.pause = FIRST_PAUSE;
        }
        if let Some(at) = &mut open.compare_at {
            *at = now + self.settings.stale_after;
        }
        if let Line::Udp(udp) = &mut open.line {
            udp.proven();
        }
    }

    fn wait(&mut self) {
        self.state = State::Waiting(Instant::now() + self.pause);
        self.pause = (self.pause * 2).min(LONGEST_PAUSE);
    }
}

impl Open {
    fn new(line: Line, settings: &Settings) -> Self {
        let now = Instant::now();
        let is_tty = matches!(line, Line::Tty(..));
        Self {
            line,
            request_at: settings.request.as_ref().map(|(_, every)| now + *every),
            compare_at: is_tty.then_some(now + COMPARE_EVERY),
            held: 0..0,
            is_new: !is_tty,
            read_at: None,
            since: now,
        }
    }

    async fn wait(&mut self, buffer: &mut [u8], stale_after: Duration) -> Happened {
        // A read that is cancelled has read nothing, because a read is one system call, made when
        // bytes are there.
        let read = async {
            if let Some(at) = self.read_at {
                tokio::time::sleep_until(at).await;
            }
            self.line.read(buffer, stale_after).await
        };
        let happened = tokio::select! {
            read = read => Happened::Read(read),
            () = maybe::until(self.request_at) => Happened::RequestIsDue,
            () = maybe::until(self.compare_at) => Happened::CompareIsDue,
        };
        if matches!(happened, Happened::Read(_)) {
            self.read_at = None;
        }
        happened
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

    /// Sends a request, but to no sender of datagrams that sends no frames.
    fn request(&self, request: &[u8], stale_after: Duration) {
        match self {
            Self::Udp(udp) if !udp.may_be_a_sensor(stale_after) => {}
            _ => self.send(request),
        }
    }

    /// Sets the settings of a serial line again, if another program has changed them.
    fn restore(&self) {
        if let Self::Tty(_, settings) = self {
            // Where this fails, the next read finds out why.
            let _ = settings.restore();
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
) -> Result<oneshot::Receiver<io::Result<Line>>, NoThread> {
    let (port, runtime) = (port.clone(), Handle::current());
    spawn_thread("port", move || {
        let _in_runtime = runtime.enter();
        let line = open(&port, baud)?;
        // The first bytes to a sender of datagrams are sent when it is known.
        line.send(&first);
        Ok(line)
    })
}

fn open(port: &Port, baud: u32) -> io::Result<Line> {
    Ok(match port {
        Port::Device(path) => {
            let (port, settings) = tty::open(path, baud)?;
            Line::Tty(SerialStream::try_from(port)?, settings)
        }
        Port::Tcp(address) => Line::Tcp(TcpStream::from_std(network::connect(address)?)?),
        Port::Udp(address) => Line::Udp(Udp::bind(address)?),
    })
}

/// Opens a port that is no device for a moment. Returns whether a telnet server is at its other end.
pub(crate) fn probe(port: &Port) -> io::Result<bool> {
    match port {
        Port::Device(_) => Ok(false),
        Port::Tcp(address) => Ok(network::is_telnet(&network::connect(address)?)),
        Port::Udp(address) => std::net::UdpSocket::bind(address).map(|_| false),
    }
}

/// Why `port` cannot be opened, in plain words.
pub(crate) fn reason(port: &Port, error: &io::Error) -> String {
    match Errno::from_io_error(error).filter(|_| port.device().is_some()) {
        Some(Errno::BUSY | Errno::WOULDBLOCK) => "port held by another process".to_owned(),
        Some(Errno::NOENT) => "no such device".to_owned(),
        Some(Errno::ACCESS) => "permission denied".to_owned(),
        Some(Errno::NOTTY) => "not a serial port".to_owned(),
        _ => wording::line(error),
    }
}
