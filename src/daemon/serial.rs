//! The ports of the sensors. A task of its own opens each port, reads it, and opens it again when it is lost.
//!
//! In: the configured port, and what its sensors expect to be sent. Out: inputs of pipelines, to each sensor
//! that they concern: bytes, or what happened to the port. The task tries to open the port for as long as a
//! sensor wants it, and never interprets the bytes. A read of no bytes means that the port is lost: every read
//! of an unplugged tty gives no bytes, and so does a read of a connection that the other end has closed.

mod network;
pub(crate) mod tty;
mod turns;

use std::collections::{BTreeMap, HashMap};
use std::io;
use std::time::Duration;

use rustix::io::Errno;
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio::runtime::Handle;
use tokio::sync::mpsc;
use tokio::time::Instant;
use tokio_serial::SerialStream;
use tracing::warn;

use self::network::{Received, Udp};
use self::tty::LineSettings;
use self::turns::Turns;
use super::port::BITS_A_BYTE;
use super::{log, realtime};
use crate::maybe;
use crate::thread::{NoThread, spawn_thread};
use hardnessd_core::allowance::Allowance;
use hardnessd_core::pipeline::Input;
use hardnessd_core::port::Port;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::wire::{TELNET, is_telnet};
use hardnessd_core::wording;

/// The pause before the first try to reopen. It doubles with each try that fails.
const FIRST_PAUSE: Duration = Duration::from_millis(50);
/// The longest pause. A sensor that is plugged in again is read within this time.
const LONGEST_PAUSE: Duration = Duration::from_secs(2);
/// A port has held if frames come for this long. Only then is it opened again at once after a loss. A port
/// that fails as soon as it is opened, or after a frame, never gets so far.
const HELD: Duration = LONGEST_PAUSE;

/// The most bytes read at once from a line: more wait in the system.
const BUFFER_BYTES: usize = 8 * 1024;
/// The most bytes of a datagram. What is not read of it is lost.
const DATAGRAM_BYTES: usize = 64 * 1024;
/// The most inputs that wait for a sensor. When the queue is full, the port is not read.
const INPUTS: usize = 16;

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

/// How often the settings of a serial line are set again, if they are other ones.
const RESTORE_EVERY: Duration = Duration::from_secs(1);

/// What a port must know of a sensor.
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
    fn of(sensor: &Sensor) -> Self {
        let described = &sensor.description().sensor;
        let frame = &described.frame;
        let every = frame.request_ms.map(|ms| Duration::from_millis(ms.into()));
        let request = frame.request.as_ref();
        let asked = request.map_or(0, |bytes| bytes.0.len());
        let frame_bytes = sensor.layout().max_frame_bytes();
        let bits = (asked + frame_bytes) as f64 * BITS_A_BYTE;
        let on_the_line = match described.port {
            Port::Device(_) => Duration::from_secs_f64(bits / f64::from(described.baud)),
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
}

/// A sensor's end of its port, which others may share.
#[derive(Debug)]
pub(crate) struct Source {
    index: usize,
    inputs: mpsc::Receiver<Input>,
    /// Tells the port that a frame of this sensor came.
    frames: mpsc::Sender<usize>,
}

impl Source {
    /// Waits for the next input. Cancelling the wait loses nothing.
    pub(crate) async fn next(&mut self) -> Input {
        match self.inputs.recv().await {
            Some(input) => input,
            // The task of the port ends after its sensors.
            None => std::future::pending().await,
        }
    }

    /// Records that the port works: frames come. So its settings are right, and a sender of datagrams keeps
    /// its place.
    pub(crate) fn proven(&self) {
        // When the queue is full, the port notices the next frame.
        let _ = self.frames.try_send(self.index);
    }

    /// Gives the port up. It is closed when all its sensors have done so, and then this returns.
    pub(crate) async fn close(self) {
        drop(self.inputs);
        self.frames.closed().await;
    }
}

/// Starts a task for each port of these sensors. Returns the source of each sensor, in the same order.
pub(crate) fn start(sensors: &[&Sensor]) -> Vec<Source> {
    let mut ports: HashMap<&Port, Vec<usize>> = HashMap::new();
    for (index, sensor) in sensors.iter().enumerate() {
        let port = &sensor.description().sensor.port;
        ports.entry(port).or_default().push(index);
    }
    let mut sources = BTreeMap::new();
    for (port, members) in ports {
        let baud = sensors[members[0]].description().sensor.baud;
        let settings = members.iter().map(|&index| Settings::of(sensors[index]));
        let started = open(port, baud, &settings.collect::<Vec<_>>());
        sources.extend(members.into_iter().zip(started));
    }
    sources.into_values().collect()
}

/// Starts the task of a port of sensors with these settings. Returns the source of each.
pub(crate) fn open(port: &Port, baud: u32, sensors: &[Settings]) -> Vec<Source> {
    let (frames, frames_in) = mpsc::channel(INPUTS);
    let (members, inputs): (Vec<_>, Vec<_>) = sensors.iter().map(|_| mpsc::channel(INPUTS)).unzip();
    let mut starts: Vec<&[u8]> = sensors.iter().map(|one| one.start.as_slice()).collect();
    starts.dedup();
    let stale_after = sensors.iter().map(|one| one.stale_after).max();
    let bytes_at_once = sensors.iter().map(|one| one.bytes_at_once).min();
    let bytes_per_s: f64 = sensors.iter().map(|one| one.bytes_per_s).sum();
    let buffer_bytes = match port {
        Port::Device(_) | Port::Tcp(_) => BUFFER_BYTES,
        Port::Udp(_) => DATAGRAM_BYTES,
    };
    let task = Task {
        port: port.clone(),
        baud,
        start: starts.concat(),
        stale_after: stale_after.unwrap_or_default(),
        bytes_at_once: bytes_at_once.unwrap_or(usize::MAX),
        // A line carries what its baud rate allows in any case.
        most_bytes_per_s: (MOST_BYTES * bytes_per_s).max(f64::from(baud) / BITS_A_BYTE),
        members: members.clone(),
        frames: frames_in,
        turns: Turns::new(sensors, Instant::now()),
        pause: FIRST_PAUSE,
        buffer: vec![0; buffer_bytes].into(),
        allowance: Allowance::default(),
        skipped: 0,
        report_at: Instant::now(),
    };
    tokio::spawn(async move {
        let given_up = async {
            for member in &members {
                member.closed().await;
            }
        };
        tokio::select! {
            () = task.serve() => {}
            () = given_up => {}
        }
    });
    let sources = inputs
        .into_iter()
        .enumerate()
        .map(|(index, inputs)| Source {
            index,
            inputs,
            frames: frames.clone(),
        });
    sources.collect()
}

/// A port and its state.
struct Task {
    port: Port,
    baud: u32,
    /// Sent once after each opening.
    start: Vec<u8>,
    /// The silence after which no sensor of the port is live.
    stale_after: Duration,
    bytes_at_once: usize,
    most_bytes_per_s: f64,
    members: Vec<mpsc::Sender<Input>>,
    /// The sensors of which a frame came.
    frames: mpsc::Receiver<usize>,
    turns: Turns,
    pause: Duration,
    buffer: Box<[u8]>,
    allowance: Allowance,
    /// The number of bytes that were not passed on and not reported yet.
    skipped: u64,
    /// From then on, they are reported.
    report_at: Instant,
}

#[derive(Debug)]
enum Line {
    Tty(SerialStream, LineSettings),
    Tcp(TcpStream),
    Udp(Udp),
}

impl Task {
    /// Opens and reads the port, again and again.
    async fn serve(mut self) {
        loop {
            let ended = match open_line(&self.port, self.baud).await {
                Ok(line) => Input::Lost(self.read(line).await),
                Err(reason) => Input::Unavailable(reason),
            };
            self.report_skipped().await;
            self.tell_all(ended).await;
            tokio::time::sleep(self.pause).await;
            self.pause = (self.pause * 2).min(LONGEST_PAUSE);
        }
    }

    /// Reads the open port until it is lost. Returns the reason.
    async fn read(&mut self, mut line: Line) -> String {
        let since = Instant::now();
        let is_tty = matches!(line, Line::Tty(..));
        // A telnet server at the other end would begin with its options.
        let mut is_new = !is_tty;
        let mut restore = tokio::time::interval(RESTORE_EVERY);
        // Frames of an earlier opening prove nothing.
        while self.frames.try_recv().is_ok() {}
        self.begin(&line).await;
        loop {
            // A sensor may send faster than the daemon reads.
            realtime::rest();
            let read = tokio::select! {
                read = line.read(&mut self.buffer, self.stale_after) => read,
                Some(member) = self.frames.recv() => {
                    let now = Instant::now();
                    if now.duration_since(since) >= HELD {
                        self.pause = FIRST_PAUSE;
                    }
                    if let Line::Udp(udp) = &mut line {
                        udp.proven();
                    }
                    self.turns.answered(member, now);
                    continue;
                }
                () = maybe::until(self.turns.due()) => {
                    if let Some(request) = self.turns.ask(Instant::now()) {
                        line.request(request);
                    }
                    continue;
                }
                () = maybe::until((self.skipped > 0).then_some(self.report_at)) => {
                    self.report_skipped().await;
                    continue;
                }
                _ = restore.tick(), if is_tty => {
                    line.restore();
                    continue;
                }
            };
            let bytes = match read {
                Ok(Received::Bytes(0)) => return line.end().to_owned(),
                Ok(Received::Bytes(bytes)) => bytes,
                Ok(Received::OfAnother(bytes)) => {
                    self.begin(&line).await;
                    bytes
                }
                Ok(Received::Ignored) => continue,
                Err(error) => return error.to_string(),
            };
            if std::mem::take(&mut is_new) && is_telnet(&self.buffer[..bytes]) {
                log::limited("TCP peers", || warn!(port = %self.port, "{TELNET}"));
            }
            self.pass_on(bytes).await;
        }
    }

    /// The port was opened, or another sender of datagrams has taken its place.
    async fn begin(&mut self, line: &Line) {
        line.send(&self.start);
        self.turns.begin(Instant::now());
        self.tell_all(Input::Opened).await;
    }

    /// Passes on the first `bytes` of the buffer, unless too many come.
    async fn pass_on(&mut self, bytes: usize) {
        let time = Duration::try_from_secs_f64(bytes as f64 / self.most_bytes_per_s);
        let (now, time) = (Instant::now(), time.unwrap_or_default());
        if !self
            .allowance
            .allows(super::now().mono, time, BYTES_AT_ONCE)
        {
            self.skipped += bytes as u64;
            if now >= self.report_at {
                self.report_at = now + REPORT_EVERY.min(self.stale_after / 3);
                self.report_skipped().await;
            }
            tokio::time::sleep(OVERFLOW_PAUSE).await;
            return;
        }
        self.report_skipped().await;
        for piece in self.buffer[..bytes].chunks(self.bytes_at_once) {
            for (index, member) in self.members.iter().enumerate() {
                if self.turns.hears(index) {
                    // A sensor that has ended takes nothing.
                    let _ = member.send(Input::Bytes(piece.to_vec())).await;
                }
            }
        }
    }

    async fn report_skipped(&mut self) {
        match std::mem::take(&mut self.skipped) {
            0 => {}
            skipped => self.tell_all(Input::Skipped(skipped)).await,
        }
    }

    async fn tell_all(&self, input: Input) {
        for member in &self.members {
            // A sensor that has ended takes nothing.
            let _ = member.send(input.clone()).await;
        }
    }
}

impl Line {
    fn open(port: &Port, baud: u32) -> io::Result<Self> {
        Ok(match port {
            Port::Device(path) => {
                let (port, settings) = tty::open(path, baud)?;
                Self::Tty(SerialStream::try_from(port)?, settings)
            }
            Port::Tcp(address) => Self::Tcp(TcpStream::from_std(network::connect(address)?)?),
            Port::Udp(address) => Self::Udp(Udp::bind(address)?),
        })
    }

    async fn read(&mut self, buffer: &mut [u8], stale_after: Duration) -> io::Result<Received> {
        match self {
            Self::Tty(port, _) => AsyncReadExt::read(port, buffer).await.map(Received::Bytes),
            Self::Tcp(stream) => stream.read(buffer).await.map(Received::Bytes),
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

    /// Sends a request, but few to a sender of datagrams that sends no frames.
    fn request(&mut self, request: &[u8]) {
        match self {
            Self::Udp(udp) => udp.request(request),
            _ => self.send(request),
        }
    }

    /// Sets the settings of a serial line again: another program may have changed them.
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

/// Opens a port in a thread of its own, because a driver or a network may be slow. The error says why
/// it cannot be opened.
async fn open_line(port: &Port, baud: u32) -> Result<Line, String> {
    let (opened, runtime) = (port.clone(), Handle::current());
    let opening = spawn_thread("port", move || {
        let _in_runtime = runtime.enter();
        Line::open(&opened, baud)
    });
    let opening = opening.map_err(|NoThread(error)| format!("no thread to open it: {error}"))?;
    let opened = opening.await.map_err(|ended| ended.to_string())?;
    opened.map_err(|error| reason(port, &error))
}

/// Opens a port for a moment. The error says why it cannot be opened.
pub(crate) async fn try_port(port: &Port, baud: u32) -> Result<(), String> {
    open_line(port, baud).await.map(drop)
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

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;

    use super::*;
    use hardnessd_core::tests::support::sensor_of;

    #[tokio::test]
    async fn datagrams_of_many_frames_are_passed_on_in_pieces_or_skipped() {
        static DATAGRAM: [u8; 60_000] = [1; 60_000];
        let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
        for (bytes_per_s, expected) in [(10_000.0, [180_000, 0]), (100.0, [60_000, 120_000])] {
            let free = UdpSocket::bind("127.0.0.1:0").unwrap();
            let address = free.local_addr().unwrap();
            drop(free);
            let sensor = sensor_of(|described| {
                described.sensor.port = format!("udp://{address}").parse().unwrap();
            });
            let settings = Settings {
                bytes_at_once: 160,
                bytes_per_s,
                ..Settings::of(&sensor)
            };
            let mut sources = open(&Port::Udp(address), 9600, &[settings]);
            assert_eq!(sources[0].next().await, Input::Opened);
            for _ in 0..3 {
                sender.send_to(&DATAGRAM, address).unwrap();
            }
            let [mut passed_on, mut skipped] = [0, 0];
            while passed_on + skipped < 3 * DATAGRAM.len() {
                let input = tokio::time::timeout(HELD, sources[0].next()).await;
                match input.expect("no byte is left out") {
                    Input::Bytes(bytes) => {
                        assert!(bytes.len() <= 160, "{}", bytes.len());
                        passed_on += bytes.len();
                    }
                    Input::Skipped(bytes) => skipped += bytes as usize,
                    input => assert_eq!(input, Input::Opened),
                }
            }
            assert_eq!([passed_on, skipped], expected);
        }
    }
}
