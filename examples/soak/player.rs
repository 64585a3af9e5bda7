//! A simulated sensor on a pty, with faults.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::thread::sleep;
use std::time::{Duration, Instant};

use hardnessd_core::wire::{Layout, Settings};
use hardnessd_simulator::random::Stream;
use hardnessd_simulator::{Material, Sequence, SequenceSettings};
use rustix::termios::OptionalActions;

use crate::listener::Link;
use crate::pair::Pair;
use crate::{FRAMES_PER_S, Failure, PATIENCE, PERIOD};

/// One simulated press as frames on the wire, with the rest after it.
pub(crate) struct Press {
    frames: Vec<Vec<u8>>,
    /// The index of a frame in the middle of the contact.
    middle: usize,
}

/// A press of each material, and a frame without load.
pub(crate) fn library() -> Result<(Vec<Press>, Vec<u8>), Failure> {
    let layout = Layout::new(&Settings::default())?;
    let materials = Material::ALL.to_vec();
    let sequence = Sequence::new(SequenceSettings {
        frame_rate_hz: FRAMES_PER_S,
        presses: u32::try_from(materials.len()).ok(),
        materials,
        ..SequenceSettings::default()
    });
    let (mut presses, mut rest): (Vec<Press>, _) = (Vec::new(), Vec::new());
    for frame in sequence {
        let mut bytes = Vec::new();
        layout.encode(&frame.raw, &mut bytes);
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
    Ok((presses, rest))
}

pub(crate) const FAULTS: [&str; 7] = [
    "unplug", "silence", "stall", "flip", "drop", "noise", "double",
];

/// A sensor, its cable, and the expected end of each press sent: whether it has a verdict.
pub(crate) struct Player {
    pub(crate) port: PathBuf,
    pub(crate) pair: Pair,
    pub(crate) presses: Arc<Vec<Press>>,
    pub(crate) rest: Arc<Vec<u8>>,
    pub(crate) stream: Stream,
    pub(crate) link: Arc<Link>,
    pub(crate) sent: Vec<bool>,
    pub(crate) faults: [u64; FAULTS.len()],
    pub(crate) due: Instant,
}

pub(crate) fn plug(port: &Path) -> io::Result<Pair> {
    let pair = Pair::open()?;
    let mut settings = rustix::termios::tcgetattr(&pair.device)?;
    settings.make_raw();
    rustix::termios::tcsetattr(&pair.device, OptionalActions::Now, &settings)?;
    std::os::unix::fs::symlink(&pair.path, port)?;
    Ok(pair)
}

impl Player {
    /// Plays until `end`, and then to the end of the press under way.
    pub(crate) fn play(mut self, end: Instant) -> Result<Self, Failure> {
        self.wake(0)?;
        while Instant::now() < end {
            let presses = Arc::clone(&self.presses);
            let press = &presses[self.stream.below(presses.len())];
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
                "drop" if struck => drop(bytes.remove(self.stream.below(frame.len()))),
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
        fs::remove_file(&self.port)?;
        // Open the new pty before the old one is closed, so that its name is a different one.
        let next = self.port.with_extension("next");
        self.pair = plug(&next)?;
        self.wait("lost", || Ok(self.link.losses.load(Relaxed) > losses))?;
        let lives = self.link.lives.load(Relaxed);
        sleep(Duration::from_secs_f64(self.stream.range(0.0, 1.5)));
        fs::rename(next, &self.port)?;
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
                return Err(format!("{}: is not {what}", self.port.display()).into());
            }
            sleep(Duration::from_millis(2));
        }
        Ok(())
    }

    /// Sends frames without load until the sensor is live once more, and then enough frames for a
    /// tare.
    fn wake(&mut self, lives: u64) -> Result<(), Failure> {
        let (start, rest) = (Instant::now(), Arc::clone(&self.rest));
        self.due = start;
        while self.link.lives.load(Relaxed) == lives {
            if start.elapsed() > PATIENCE {
                return Err(format!("{}: is not live", self.port.display()).into());
            }
            self.write(&rest)?;
        }
        (0..30).try_for_each(|_| self.write(&rest))
    }

    /// Writes when the next frame is due.
    fn write(&mut self, mut bytes: &[u8]) -> Result<(), Failure> {
        sleep(self.due.saturating_duration_since(Instant::now()));
        self.due += PERIOD;
        while !bytes.is_empty() {
            // Until the other end is opened, there is room for 4 kB.
            bytes = &bytes[rustix::io::write(&self.pair.master, bytes)?..];
        }
        Ok(())
    }

    /// Waits until everything is read.
    fn drain(&self) -> Result<(), Failure> {
        let mut empty = 0;
        self.wait("read", || {
            // Written bytes reach the device a moment later.
            let is_empty = rustix::io::ioctl_fionread(&self.pair.device)? == 0;
            empty = if is_empty { empty + 1 } else { 0 };
            Ok(empty > 3)
        })
    }
}
