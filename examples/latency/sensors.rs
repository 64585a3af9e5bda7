//! Sensors on ptys: the frames that they send, and when they sent them.

use std::fmt::Write as _;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

use hardnessd_core::frame::{Array, RawFrame};
use hardnessd_core::wire::{Layout, Settings};

use crate::pair::Pair;
use crate::{Args, Failure, Kind, What};

/// The number of frames in a cycle with one press. The press ends with the second frame without
/// load.
const CYCLE: usize = 40;
const LOADED: usize = 20;
/// The number of bytes of an NMEA cycle: about as many as of a frame.
const SENTENCES: usize = 791;

/// When each frame was sent, in ns of the clock of [`now_ns`]: a list for each sensor.
pub(crate) struct Sent(Vec<Vec<AtomicU64>>);

impl Sent {
    /// When frame `number` of `sensor` was sent. The first frame has the number 0.
    pub(crate) fn frame(&self, sensor: usize, number: usize) -> Option<u64> {
        let at = self.0.get(sensor)?.get(number)?;
        Some(at.load(Relaxed)).filter(|&at| at > 0)
    }

    /// The number of expected events of frames that were sent at `since_ns` or later.
    pub(crate) fn count(&self, what: What, since_ns: u64) -> usize {
        let of = |(sensor, frames): (usize, &Vec<AtomicU64>)| {
            let sent = frames.iter().enumerate();
            let is_meant = |number| what == What::Frame || ends(sensor, number);
            sent.filter(|(number, at)| at.load(Relaxed) >= since_ns && is_meant(*number))
                .count()
        };
        self.0.iter().enumerate().map(of).sum()
    }

    /// When the frame that ended press `number` of `sensor` was sent.
    pub(crate) fn end(&self, sensor: usize, number: usize) -> Option<u64> {
        let frame = number * CYCLE + LOADED + 1;
        self.frame(sensor, frame.checked_sub(phase(sensor))?)
    }
}

/// Whether this frame of the sensor ends a press.
fn ends(sensor: usize, frame: usize) -> bool {
    let cycle = frame + phase(sensor);
    cycle >= CYCLE && cycle % CYCLE == LOADED + 1
}

/// How far into its cycle a sensor begins. The phases differ, so that not all sensors end a press
/// at once.
fn phase(sensor: usize) -> usize {
    sensor * 7 % CYCLE
}

/// Nanoseconds since the first call.
pub(crate) fn now_ns() -> u64 {
    static START: std::sync::OnceLock<Instant> = std::sync::OnceLock::new();
    let start = START.get_or_init(Instant::now);
    start.elapsed().as_nanos() as u64 + 1
}

pub(crate) struct Sensors {
    pairs: Vec<Pair>,
    pub(crate) sent: Arc<Sent>,
    args: Args,
}

impl Sensors {
    pub(crate) fn plug(args: &Args, length: Duration) -> Result<Self, Failure> {
        let frames = (length.as_secs_f64() * args.rate) as usize + 1;
        let list = || (0..frames).map(|_| AtomicU64::new(0)).collect();
        let pairs: io::Result<Vec<Pair>> = (0..args.sensors).map(|_| Pair::raw()).collect();
        Ok(Self {
            pairs: pairs?,
            sent: Arc::new(Sent((0..args.sensors).map(|_| list()).collect())),
            args: args.clone(),
        })
    }

    pub(crate) fn devices(&self) -> Vec<PathBuf> {
        self.pairs.iter().map(|pair| pair.path.clone()).collect()
    }

    /// Sends for `length`. Returns the largest delay of a frame.
    pub(crate) fn play(self, length: Duration) -> Result<(Self, Duration), Failure> {
        let side = self.args.side;
        let layout = Layout::new(&Settings {
            rows: Some(side),
            cols: Some(side),
            ..Settings::default()
        })?;
        // All sensors send the same frames.
        let [mut rest, mut loaded] = [false, true].map(|is_loaded| {
            let mut bytes = Vec::new();
            layout.encode(&frame(side, is_loaded), &mut bytes);
            bytes
        });
        let start = Instant::now();
        let period = Duration::from_secs_f64(1.0 / self.args.rate);
        let count = self.pairs.len();
        let mut latest = Duration::ZERO;
        for number in 0.. {
            let due = start + period.mul_f64(f64::from(number));
            if due >= start + length {
                break;
            }
            if self.args.server == Kind::Gpsd {
                [rest, loaded] = [(); 2].map(|()| sentences(number).into_bytes());
            }
            for (sensor, pair) in self.pairs.iter().enumerate() {
                // The sensors of one machine do not send at the same moment, so spread them over
                // the period.
                let due = due + period.mul_f64(sensor as f64 / count as f64);
                std::thread::sleep(due.saturating_duration_since(Instant::now()));
                latest = latest.max(due.elapsed());
                let cycle = number as usize + phase(sensor);
                let is_loaded = cycle >= CYCLE && cycle % CYCLE < LOADED;
                let at = &self.sent.0[sensor][number as usize];
                // Store the time first, because a client may read the event before the write
                // returns.
                at.store(now_ns(), Relaxed);
                let mut left = if is_loaded { &loaded } else { &rest }.as_slice();
                while !left.is_empty() {
                    let written = rustix::io::write(&pair.master, left)?;
                    left = &left[written..];
                }
            }
        }
        Ok((self, latest))
    }
}

/// A frame of an array of `side` rows and columns. The load is on a seventh of the rows and of the
/// columns.
fn frame(side: usize, is_loaded: bool) -> RawFrame {
    let (rows, cols) = (side, side);
    let mut frame = RawFrame::zero(Array { rows, cols });
    let loaded = side * 3 / 7..side * 4 / 7;
    for row in loaded.clone().filter(|_| is_loaded) {
        frame.counts[row * side..][loaded.clone()].fill(60.0);
    }
    frame
}

/// One cycle of a GPS receiver, a hundredth of a second after the previous one.
fn sentences(number: i32) -> String {
    let (seconds, hundredths) = (number / 100, number % 100);
    let time = format!(
        "{:02}{:02}{:02}.{hundredths:02}",
        seconds / 3600 % 24,
        seconds / 60 % 60,
        seconds % 60
    );
    let mut cycle = String::with_capacity(SENTENCES + 80);
    let mut add = |body: &str| {
        let sum = body.bytes().fold(0, |sum, byte| sum ^ byte);
        let _ = write!(cycle, "${body}*{sum:02X}\r\n");
    };
    // These have no time of their own, so that gpsd sends one message a cycle.
    for _ in 0..16 {
        add("GPVTG,054.7,T,034.4,M,000.5,N,001.0,K,A");
    }
    add(&format!(
        "GPRMC,{time},A,4807.0380,N,01131.0000,E,000.5,054.7,010126,,,A"
    ));
    cycle
}
