//! The cable of a sensor. The test writes every byte on it.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::PathBuf;
use std::time::{Duration, SystemTime};

use super::pair::Pair;
use super::{Bench, frame, wait_for};

/// The time between two frames.
pub const PERIOD: Duration = Duration::from_millis(10);

/// The sensor's end of a cable.
pub struct Cable {
    pair: Option<Pair>,
    pub link: PathBuf,
}

impl Cable {
    pub fn plug(link: PathBuf) -> Self {
        let mut cable = Self { pair: None, link };
        cable.replug();
        cable
    }

    /// Puts a new port behind the link. The old port, if there is one, is closed after that.
    pub fn replug(&mut self) {
        self.replug_at(Pair::raw().unwrap());
    }

    pub fn replug_at(&mut self, pair: Pair) {
        let born = self.link.with_extension("new");
        symlink(&pair.path, &born).unwrap();
        fs::rename(&born, &self.link).unwrap();
        self.pair = Some(pair);
    }

    /// Pulls the cable and returns the time.
    pub fn unplug(&mut self) -> SystemTime {
        self.drain();
        let now = SystemTime::now();
        fs::remove_file(&self.link).unwrap();
        self.pair = None;
        now
    }

    fn pair(&self) -> &Pair {
        self.pair.as_ref().unwrap()
    }

    /// Until the other end is opened, there is room for 4 kB.
    pub fn write(&self, mut bytes: &[u8]) {
        while !bytes.is_empty() {
            bytes = &bytes[rustix::io::write(&self.pair().master, bytes).unwrap()..];
        }
    }

    /// Writes frames at their pace.
    pub fn play(&self, counts: f32, frames: usize) {
        for _ in 0..frames {
            self.write(&frame(counts));
            std::thread::sleep(PERIOD);
        }
    }

    /// Waits until everything that was written is read.
    pub fn drain(&self) {
        // Written bytes reach the device a moment later.
        let mut empty = 0;
        wait_for("a reader", || {
            let is_empty = rustix::io::ioctl_fionread(&self.pair().device).unwrap() == 0;
            empty = if is_empty { empty + 1 } else { 0 };
            empty > 10
        });
    }

    /// Sends frames without load until the sensor is live: the daemon drops what came before the port was opened.
    pub fn wake(&self, bench: &Bench, sensor: &str) {
        let mut subscriber = bench.subscriber();
        wait_for("a live sensor", || {
            self.write(&frame(0.0));
            self.drain();
            subscriber.status(sensor)["state"] == "live"
        });
    }
}
