//! A simulated sensor on a pty: frames in real time, bytes at the speed of the line.
//!
//! The frames of a sequence are computed on a thread of their own, a little ahead, so that the physics
//! never delays a byte. The player does not wait for a reader, because a sensor does not know whether anybody
//! reads.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio::time::Instant;

use super::faults::{Faults, Line};
use super::pty::Pty;
use crate::daemon::port::BITS_A_BYTE;
use crate::thread::{NoThread, start};
use hardnessd_core::frame::RawFrame;
use hardnessd_core::wire::Layout;
use hardnessd_simulator::{Approach, Sequence, SequenceSettings};

/// The time between two writes: shorter than the time in which a UART's FIFO is emptied, yet long
/// enough to be cheap.
const SLICE: Duration = Duration::from_millis(4);

/// The number of frames that are computed ahead.
const AHEAD: usize = 32;

/// A simulated sensor on a pty.
#[derive(Debug)]
pub(crate) struct Player {
    pty: Option<Pty>,
    link: Option<PathBuf>,
    layout: Layout,
    faults: Faults,
    /// Time between frames.
    period: Duration,
    /// Bytes per second that the line carries.
    bytes_per_s: f64,
    /// Seconds of the sensor per second.
    speed: f64,
    /// The path of the arm around the present moment, for the robot.
    approach: watch::Sender<Option<Approach>>,
}

impl Player {
    /// Makes the player and its pty. Frames come at `frame_rate_hz` over a line of `baud`, both multiplied by `speed`.
    ///
    /// # Errors
    ///
    /// Fails as [`Pty::open`] does.
    pub(crate) fn new(
        link: Option<&Path>,
        layout: Layout,
        faults: Faults,
        frame_rate_hz: f64,
        baud: u32,
        speed: f64,
    ) -> io::Result<Self> {
        let pty = Some(Pty::open(link)?);
        Ok(Self {
            pty,
            link: link.map(Path::to_owned),
            layout,
            faults,
            period: Duration::from_secs_f64(1.0 / (frame_rate_hz * speed)),
            bytes_per_s: f64::from(baud) / BITS_A_BYTE * speed,
            speed,
            approach: watch::Sender::new(None),
        })
    }

    /// Path of the device that a reader opens.
    pub(crate) fn path(&self) -> &Path {
        self.pty
            .as_ref()
            .expect("a player starts with its pty")
            .path()
    }

    /// Where the arm of a sequence that begins at `start` is at a moment, for the robot that reports it. `None` before
    /// the first frame.
    pub(crate) fn position(&self, start: Instant) -> impl Fn(Instant) -> Option<f64> + use<> {
        let (approach, speed) = (self.approach.subscribe(), self.speed);
        move |at| Some((*approach.borrow())?.mm((at - start).as_secs_f64() * speed))
    }

    /// Plays the frames, the first of them at `start`. Afterwards the port is gone.
    ///
    /// # Errors
    ///
    /// Fails if the pty fails, or cannot be made again after an unplug.
    pub(crate) async fn play(
        mut self,
        mut frames: mpsc::Receiver<Played>,
        start: Instant,
    ) -> io::Result<()> {
        let mut bytes = Vec::with_capacity(self.layout.max_frame_bytes());
        // The time at which the line is free again. A long frame delays the next one.
        let mut free = start;
        while let Some(frame) = frames.recv().await {
            let since = self.period * frame.number;
            let due = start + since;
            tokio::time::sleep_until(due).await;
            self.approach.send_replace(Some(frame.approach));
            let time_s = since.as_secs_f64() * self.speed;
            let layout = &self.layout;
            let line = self.faults.encode(time_s, &frame.raw, layout, &mut bytes);
            match line {
                Line::Up => {
                    if self.pty.is_none() {
                        self.pty = Some(Pty::open(self.link.as_deref())?);
                    }
                    free = self.send(&bytes, due.max(free)).await?;
                }
                Line::Silent => {}
                Line::Unplugged => self.pty = None,
            }
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
        let slice = (self.bytes_per_s * SLICE.as_secs_f64()).ceil().max(1.0);
        let mut sent = 0.0;
        for slice in bytes.chunks(slice as usize) {
            sent += slice.len() as f64;
            // A byte has arrived when its last bit has.
            at = from + Duration::from_secs_f64(sent / self.bytes_per_s);
            tokio::time::sleep_until(at).await;
            pty.write(slice)?;
        }
        Ok(at)
    }
}

/// A frame to play.
#[derive(Debug)]
pub(crate) struct Played {
    /// Its number: frame n is taken n periods after the first one.
    pub(crate) number: u32,
    pub(crate) raw: RawFrame,
    /// The motion of the arm until the next frame.
    pub(crate) approach: Approach,
}

/// The frames of a sequence.
///
/// # Errors
///
/// Fails if the system has no thread to compute them on.
pub(crate) fn sequence(settings: SequenceSettings) -> Result<mpsc::Receiver<Played>, NoThread> {
    let (frames, played) = mpsc::channel(AHEAD);
    start("presses", move || {
        let mut sequence = (0..).zip(Sequence::new(settings)).peekable();
        while let Some((number, frame)) = sequence.next() {
            let next = sequence.peek().map(|(_, next)| next);
            let approach = next.unwrap_or(&frame).approach;
            let frame = Played {
                number,
                raw: frame.raw,
                approach,
            };
            if frames.blocking_send(frame).is_err() {
                return;
            }
        }
    })?;
    Ok(played)
}
