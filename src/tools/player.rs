//! A simulated sensor on a pty: presses in real time, bytes at the speed of the line.
//!
//! Frames are computed on a thread of their own, a little ahead, so that the physics never delays a
//! byte. The player does not wait for a reader, because a sensor does not know whether anybody
//! reads.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::time::Instant;

use super::faults::{Faults, Line};
use super::pty::Pty;
use super::robot::{Moving, Robot};
use crate::daemon::baud::BITS_A_BYTE;
use hardnessd_core::wire::Layout;
use hardnessd_simulator::{Approach, Sequence, SequenceFrame, SequenceSettings};

/// The time between two writes: shorter than the time in which a UART's FIFO is emptied, yet long
/// enough to be cheap.
const SLICE: Duration = Duration::from_millis(4);

/// The number of frames that are computed ahead.
const AHEAD: usize = 32;

/// The speed of a simulated sensor and of its line.
#[derive(Debug, Clone)]
pub(crate) struct Pace {
    /// Time between frames.
    pub(crate) period: Duration,
    /// Bytes per second that the line carries.
    pub(crate) bytes_per_s: f64,
    /// Seconds of the sensor per second.
    pub(crate) speed: f64,
}

impl Pace {
    /// The pace of frames at `frame_rate_hz` over a line of `baud`, both multiplied by `speed`.
    pub(crate) fn new(frame_rate_hz: f64, baud: u32, speed: f64) -> Self {
        Self {
            period: Duration::from_secs_f64(1.0 / (frame_rate_hz * speed)),
            bytes_per_s: f64::from(baud) / BITS_A_BYTE * speed,
            speed,
        }
    }
}

/// A simulated sensor on a pty.
#[derive(Debug)]
pub(crate) struct Player {
    pty: Option<Pty>,
    link: Option<PathBuf>,
    layout: Layout,
    pace: Pace,
    faults: Faults,
    /// Sends the motion of the arm to the robot.
    moving: watch::Sender<Option<Moving>>,
}

impl Player {
    /// Makes the player and its pty.
    ///
    /// # Errors
    ///
    /// Fails as [`Pty::open`] does.
    pub(crate) fn new(
        link: Option<&Path>,
        layout: Layout,
        pace: Pace,
        faults: Faults,
    ) -> io::Result<Self> {
        let pty = Some(Pty::open(link)?);
        Ok(Self {
            pty,
            link: link.map(Path::to_owned),
            layout,
            pace,
            faults,
            moving: watch::Sender::new(None),
        })
    }

    /// Path of the device that a reader opens.
    pub(crate) fn path(&self) -> &Path {
        self.pty
            .as_ref()
            .expect("a player starts with its pty")
            .path()
    }

    /// The robot whose arm presses. It sends its motion to the daemon at `socket`.
    pub(crate) fn robot(&self, socket: PathBuf, sensor: Option<String>) -> Robot {
        Robot {
            socket,
            sensor,
            moving: self.moving.subscribe(),
        }
    }

    /// Plays to the end of the sequence. Afterwards the port is gone.
    ///
    /// # Errors
    ///
    /// Fails if the pty fails, or cannot be made again after an unplug.
    pub(crate) async fn play(mut self, settings: SequenceSettings) -> io::Result<()> {
        let mut frames = compute(settings);
        let start = Instant::now();
        let mut bytes = Vec::with_capacity(self.layout.max_frame_bytes());
        let mut index = 0_u32;
        // The time at which the line is free again. A long frame delays the next one.
        let mut free = start;
        while let Some((frame, approach)) = frames.recv().await {
            let due = start + self.pace.period * index;
            tokio::time::sleep_until(due).await;
            let speed = self.pace.speed;
            self.moving.send_replace(Some(Moving {
                start,
                speed,
                approach,
            }));
            let time_s = (self.pace.period * index).as_secs_f64() * self.pace.speed;
            let layout = &self.layout;
            let line = self.faults.encode(time_s, frame.raw, layout, &mut bytes);
            if matches!(line, Line::Up | Line::AtOnce) && self.pty.is_none() {
                self.pty = Some(Pty::open(self.link.as_deref())?);
            }
            match line {
                Line::Up => free = self.send(&bytes, due.max(free)).await?,
                Line::AtOnce => self.send_at_once(&bytes).await?,
                Line::Silent => {}
                Line::Unplugged => self.pty = None,
            }
            index += 1;
        }
        match &self.pty {
            Some(pty) => pty.linger().await,
            None => Ok(()),
        }
    }

    /// Sends `bytes` from the time `from` on. Returns the time at which the last byte has arrived.
    async fn send(&mut self, bytes: &[u8], from: Instant) -> io::Result<Instant> {
        let mut at = from;
        let Some(pty) = &mut self.pty else {
            return Ok(at);
        };
        let slice = (self.pace.bytes_per_s * SLICE.as_secs_f64())
            .ceil()
            .max(1.0);
        let mut sent = 0.0;
        for slice in bytes.chunks(slice as usize) {
            sent += slice.len() as f64;
            // A byte has arrived when its last bit has.
            at = from + Duration::from_secs_f64(sent / self.pace.bytes_per_s);
            tokio::time::sleep_until(at).await;
            pty.write(slice)?;
        }
        Ok(at)
    }

    /// Sends `bytes` without the pace of the line, as fast as the reader takes them.
    async fn send_at_once(&mut self, mut bytes: &[u8]) -> io::Result<()> {
        let Some(pty) = &mut self.pty else {
            return Ok(());
        };
        // Without a reader the pty drops what it holds after a while, so that this ends.
        loop {
            bytes = &bytes[pty.write(bytes)?..];
            if bytes.is_empty() {
                return Ok(());
            }
            tokio::time::sleep(SLICE).await;
        }
    }
}

/// The frames, each with the motion of the arm until the next frame.
fn compute(settings: SequenceSettings) -> mpsc::Receiver<(SequenceFrame, Approach)> {
    let (frames, played) = mpsc::channel(AHEAD);
    std::thread::spawn(move || {
        let mut sequence = Sequence::new(settings).peekable();
        while let Some(frame) = sequence.next() {
            let approach = sequence.peek().unwrap_or(&frame).approach;
            if frames.blocking_send((frame, approach)).is_err() {
                return;
            }
        }
    });
    played
}
