//! A simulated sensor, with faults.

use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::thread::sleep;
use std::time::{Duration, Instant};

use hardnessd_core::frame::{Array, RawFrame};
use hardnessd_core::wire::{Layout, Settings};
use hardnessd_simulator::random::Stream;
use hardnessd_simulator::{Material, Sequence, SequenceSettings};

use crate::line::Line;
use crate::listener::Link;
use crate::{FRAMES_PER_S, Failure, PATIENCE, PERIOD};

/// One simulated press as frames on the wire, with the rest after it.
pub(crate) struct Press {
    frames: Vec<Vec<u8>>,
    /// The index of a frame in the middle of the contact.
    middle: usize,
}

/// What a sensor with `side` rows and columns sends.
pub(crate) struct Library {
    /// A press of each material.
    presses: Vec<Press>,
    /// A frame without load.
    rest: Vec<u8>,
}

/// The simulated frames, as an array of `side` rows and columns over the same area has them.
pub(crate) fn library(side: usize) -> Result<Library, Failure> {
    let layout = Layout::new(&Settings {
        rows: Some(side),
        cols: Some(side),
        ..Settings::default()
    })?;
    let (rows, cols) = (side, side);
    let array = Array { rows, cols };
    let materials = Material::ALL.to_vec();
    let sequence = Sequence::new(SequenceSettings {
        frame_rate_hz: FRAMES_PER_S,
        presses: u32::try_from(materials.len()).ok(),
        materials,
        ..SequenceSettings::default()
    });
    let (mut presses, mut rest): (Vec<Press>, _) = (Vec::new(), Vec::new());
    for frame in sequence {
        let counts = (0..array.taxels()).map(|place| {
            let (row, col) = array.position(place);
            let from = frame.raw.array;
            frame.raw.counts[from.place(row * from.rows / rows, col * from.cols / cols)]
        });
        let counts = counts.collect();
        let mut bytes = Vec::new();
        layout.encode(&RawFrame { array, counts }, &mut bytes);
        if frame.press == 0 {
            rest = bytes;
            continue;
        }
        if presses.len() < frame.press as usize {
            presses.push(Press {
                frames: Vec::new(),
                middle: 0,
            });
        }
        if let Some(press) = presses.last_mut() {
            press.frames.push(bytes);
            if frame.loaded {
                press.middle = press.frames.len() / 2;
            }
        }
    }
    Ok(Library { presses, rest })
}

pub(crate) const FAULTS: [&str; 7] = [
    "unplug", "silence", "stall", "flip", "drop", "noise", "double",
];

/// A sensor, its cable, and the expected end of each press sent: whether it has a verdict.
pub(crate) struct Player {
    pub(crate) name: String,
    pub(crate) line: Line,
    pub(crate) library: Arc<Library>,
    pub(crate) stream: Stream,
    pub(crate) link: Arc<Link>,
    pub(crate) sent: Vec<bool>,
    pub(crate) faults: [u64; FAULTS.len()],
    pub(crate) due: Instant,
}

impl Player {
    /// Plays until `end`, and then to the end of the press under way.
    pub(crate) fn play(mut self, end: Instant) -> Result<Self, Failure> {
        self.wake(0)?;
        while Instant::now() < end {
            let library = Arc::clone(&self.library);
            let press = &library.presses[self.stream.below(library.presses.len())];
            let fault = self.stream.below(2 * FAULTS.len());
            if fault < FAULTS.len() {
                self.faults[fault] += 1;
            }
            let name = FAULTS.get(fault).copied().unwrap_or_default();
            self.press(press, name)?;
        }
        self.drain()?;
        Ok(self)
    }

    fn press(&mut self, press: &Press, fault: &str) -> Result<(), Failure> {
        let (middle, mut held) = (press.middle, Vec::new());
        for (index, frame) in press.frames.iter().enumerate() {
            let struck = (middle..middle + 3).contains(&index);
            let mut bytes = frame.clone();
            match fault {
                "unplug" if index == middle => {
                    self.sent.push(false);
                    return self.unplug(&bytes);
                }
                "silence" if index == middle => self.due += Duration::from_millis(400),
                // Send nothing for 30 frames, then send all of them.
                "stall" if (middle..middle + 30).contains(&index) => {
                    held.append(&mut bytes);
                }
                "flip" if struck => bytes[self.stream.below(frame.len())] ^= 1,
                "drop" if struck => {
                    bytes.remove(self.stream.below(frame.len()));
                }
                "noise" if struck => {
                    let noise = (0..300).map(|_| self.stream.next_u64() as u8);
                    bytes.splice(0..0, noise.collect::<Vec<u8>>());
                }
                "double" if struck => bytes.extend_from_slice(frame),
                _ => {}
            }
            if index == middle + 30 {
                bytes.splice(0..0, std::mem::take(&mut held));
            }
            self.write(&bytes)?;
        }
        // If the press ended before the held frames were sent, send them now.
        self.write(&held)?;
        self.sent.push(true);
        Ok(())
    }

    /// Pulls the cable in the middle of a frame, and plugs it in again.
    fn unplug(&mut self, frame: &[u8]) -> Result<(), Failure> {
        let part = self.stream.below(frame.len());
        self.write(&frame[..part])?;
        self.drain()?;
        let losses = self.link.losses.load(Relaxed);
        self.line.unplug()?;
        self.wait("lost", || Ok(self.link.losses.load(Relaxed) > losses))?;
        let lives = self.link.lives.load(Relaxed);
        sleep(Duration::from_secs_f64(self.stream.range(0.0, 1.5)));
        self.line.plug()?;
        self.wake(lives)
    }

    fn wait(
        &self,
        what: &str,
        mut is_there: impl FnMut() -> Result<bool, Failure>,
    ) -> Result<(), Failure> {
        let start = Instant::now();
        while !is_there()? {
            if start.elapsed() > PATIENCE {
                return Err(format!("{}: is not {what}", self.name).into());
            }
            sleep(Duration::from_millis(2));
        }
        Ok(())
    }

    /// Sends frames without load until the sensor is live once more, and then enough frames for a
    /// tare.
    fn wake(&mut self, lives: u64) -> Result<(), Failure> {
        let (start, library) = (Instant::now(), Arc::clone(&self.library));
        self.due = start;
        while self.link.lives.load(Relaxed) == lives {
            if start.elapsed() > PATIENCE {
                return Err(format!("{}: is not live", self.name).into());
            }
            self.write(&library.rest)?;
        }
        (0..30).try_for_each(|_| self.write(&library.rest))
    }

    /// Writes when the next frame is due.
    fn write(&mut self, bytes: &[u8]) -> Result<(), Failure> {
        sleep(self.due.saturating_duration_since(Instant::now()));
        self.due += PERIOD;
        Ok(self.line.write(bytes)?)
    }

    /// Waits until everything is read.
    fn drain(&self) -> Result<(), Failure> {
        let mut empty = 0;
        self.wait("read", || {
            // Written bytes reach the device a moment later.
            empty = if self.line.is_read()? { empty + 1 } else { 0 };
            Ok(empty > 3)
        })
    }
}
