//! The arm of `hardnessd simulate --arm`, which a controller moves against a simulated object.
//!
//! In: lines of JSON on a Unix socket, of one controller at a time. Out: an answer to each line, and
//! the frames of the sensor on the arm, computed at the moments that they show. The arm stops when its
//! controller goes, and when the sensor bears [`STOP_N`].

use std::io::{self, BufRead, BufReader, Read as _, Write as _};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread;
use std::time::Duration;

use serde::Deserialize;
use serde_json::{Value, json};
use tempfile::TempPath;
use tokio::sync::mpsc;
use tokio::time::Instant;

use super::exit::{Fail as _, Failure, IO};
use super::player::Played;
use super::robot::Position;
use crate::daemon::socket;
use hardnessd_core::event::round_3;
use hardnessd_core::range::{self, OutOfRange, from_to};
use hardnessd_core::stderr_line;
use hardnessd_simulator::{Rig, SequenceSettings};

/// The time between the moment that a frame shows and its first byte: a sensor needs some to scan its
/// taxels, and here it hides the time that a step of the physics takes.
pub(crate) const SCAN: Duration = Duration::from_millis(10);
/// The pause after a controller could not connect, for example because there are too many open files.
const RETRY: Duration = Duration::from_millis(100);

/// The greatest position, in mm.
const REACH_MM: f64 = 30.0;
/// The greatest speed, and the speed until a controller names another one.
const FASTEST_MM_S: f64 = 20.0;
const SPEED_MM_S: f64 = 5.0;
/// The force at which the arm stops by itself, as robots do to protect what they touch.
const STOP_N: f64 = 50.0;
/// The longest step of the physics.
const LONGEST_STEP_S: f64 = 0.05;
/// The longest line of a controller.
const LONGEST_LINE_BYTES: u64 = 4096;

/// A simulated arm that a controller moves.
pub(crate) struct Arm {
    /// Where the arm is at a moment, for the robot that reports it.
    pub(crate) position: Position,
    /// The frames of the sensor.
    pub(crate) frames: mpsc::Receiver<Played>,
    /// The socket, which vanishes with the arm.
    pub(crate) socket: TempPath,
}

/// The arm, and the sensor on it before an object.
struct Moved {
    leg: Leg,
    rig: Rig,
}

/// A movement at a steady speed.
#[derive(Debug, Clone, Copy)]
struct Leg {
    from_mm: f64,
    start: Instant,
    to_mm: f64,
    speed_mm_s: f64,
}

impl Leg {
    fn mm(&self, at: Instant) -> f64 {
        let most_mm = self.speed_mm_s * (at - self.start).as_secs_f64();
        self.from_mm + (self.to_mm - self.from_mm).clamp(-most_mm, most_mm)
    }

    fn stop(&mut self, at: Instant) {
        self.to_mm = self.mm(at);
    }
}

/// A line of the controller. Every part may be missing.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Order {
    /// Where to go.
    to_mm: Option<f64>,
    /// How fast, from now on.
    speed_mm_s: Option<f64>,
    /// The object to put in front of the sensor.
    object: Option<u32>,
}

impl Order {
    fn check(&self) -> Result<(), OutOfRange> {
        from_to((0.0, REACH_MM), "").check("to_mm", &self.to_mm)?;
        from_to((0.1, FASTEST_MM_S), "").check("speed_mm_s", &self.speed_mm_s)?;
        range::check("object", 0, self.object != Some(0), "a number from 1")
    }
}

impl Arm {
    /// An arm at rest before its first object, whose controller connects to the new socket at `path`. Its first frame
    /// shows the moment `start`.
    ///
    /// # Errors
    ///
    /// Fails if something is at `path`, or the system has no thread.
    pub(crate) fn start(
        path: &Path,
        settings: SequenceSettings,
        start: Instant,
    ) -> Result<Self, Failure> {
        let what = format!("--arm {}", path.display());
        // Nobody else may connect, not even for a moment.
        let listener = socket::listen(path, 0o600, None);
        let listener = listener.of(format!("{what}: name a new path"), IO)?;
        listener.set_nonblocking(false).of(&what, IO)?;
        let socket = TempPath::try_from_path(path).of(&what, IO)?;
        let leg = Leg {
            from_mm: 0.0,
            start,
            to_mm: 0.0,
            speed_mm_s: SPEED_MM_S,
        };
        let frame_rate_hz = settings.frame_rate_hz;
        let rig = Rig::new(settings);
        let moved = Arc::new(Mutex::new(Moved { leg, rig }));
        let [controlled, seen] = [&moved, &moved].map(Arc::clone);
        let (frames, played) = mpsc::channel(1);
        crate::thread::start("arm", move || {
            simulate(&moved, frame_rate_hz, start, &frames);
        })?;
        crate::thread::start("controller", move || serve(&listener, &controlled))?;
        Ok(Self {
            position: Box::new(move |at| Some(Moved::of(&seen).leg.mm(at))),
            frames: played,
            socket,
        })
    }
}

/// Obeys one controller after the other, for ever.
fn serve(listener: &UnixListener, arm: &Mutex<Moved>) {
    for controller in listener.incoming() {
        match controller {
            Ok(controller) => {
                // It may leave at any moment.
                let _ = obey(&controller, arm);
                Moved::of(arm).leg.stop(Instant::now());
            }
            Err(error) => {
                stderr_line!("warning: --arm: {error}");
                thread::sleep(RETRY);
            }
        }
    }
}

fn obey(mut controller: &UnixStream, arm: &Mutex<Moved>) -> io::Result<()> {
    let mut input = BufReader::new(controller);
    loop {
        let mut line = Vec::new();
        let mut rest = (&mut input).take(LONGEST_LINE_BYTES);
        rest.read_until(b'\n', &mut line)?;
        if line.pop() != Some(b'\n') {
            return Ok(());
        }
        let order = serde_json::from_slice(&line).map_err(|error| error.to_string());
        let answer = order.and_then(|order| Moved::of(arm).take(&order));
        let answer = answer.unwrap_or_else(|error| json!({"error": error}));
        writeln!(controller, "{answer}")?;
    }
}

impl Moved {
    fn of(arm: &Mutex<Self>) -> MutexGuard<'_, Self> {
        arm.lock().expect("a panic ends the process")
    }

    /// Takes an order, and answers with the state. An order that is refused changes nothing.
    fn take(&mut self, order: &Order) -> Result<Value, String> {
        order.check().map_err(|error| error.to_string())?;
        let now = Instant::now();
        let at_mm = self.leg.mm(now);
        if let Some(object) = order.object {
            if at_mm > 0.0 {
                let found = format!("object: found the arm at {} mm", round_3(at_mm));
                return Err(format!("{found}, expected 0: withdraw it first"));
            }
            self.rig.place(object);
        }
        self.leg = Leg {
            from_mm: at_mm,
            start: now,
            to_mm: order.to_mm.unwrap_or(self.leg.to_mm),
            speed_mm_s: order.speed_mm_s.unwrap_or(self.leg.speed_mm_s),
        };
        let touched = self.rig.touched();
        Ok(json!({
            "at_mm": round_3(at_mm),
            "to_mm": round_3(self.leg.to_mm),
            "speed_mm_s": self.leg.speed_mm_s,
            "truth": {
                "object": touched.object,
                "material": touched.material.name(),
                "level": touched.material.level(),
                "shore": round_3(touched.shore),
                "force_n": round_3(touched.force_n),
                "greatest_n": round_3(touched.greatest_n),
            },
        }))
    }

    /// Steps the physics to a moment, `since_s` after the last one.
    fn step(&mut self, at: Instant, since_s: f64) {
        self.rig.move_to(self.leg.mm(at), since_s);
        if self.rig.touched().force_n > STOP_N && self.leg.to_mm > self.leg.mm(at) {
            self.leg.stop(at);
        }
    }
}

/// Steps the physics in time with the clock, until nobody takes the frames. A step that comes too late
/// is left out, with its frame, so that a frame never shows an old position.
fn simulate(arm: &Mutex<Moved>, frame_rate_hz: f64, start: Instant, frames: &mpsc::Sender<Played>) {
    let period_s = 1.0 / frame_rate_hz;
    let steps_a_frame = (period_s / LONGEST_STEP_S).ceil() as u32;
    let step = Duration::from_secs_f64(period_s / f64::from(steps_a_frame));
    let mut last = start;
    let mut number = 0;
    loop {
        let at = start + step * number;
        thread::sleep(at.saturating_duration_since(Instant::now()));
        Moved::of(arm).step(at, (at - last).as_secs_f64());
        last = at;
        if number.is_multiple_of(steps_a_frame) {
            let frame = Played {
                number: number / steps_a_frame,
                raw: Moved::of(arm).rig.read(),
                approach: None,
            };
            if frames.blocking_send(frame).is_err() {
                return;
            }
        }
        let late = Instant::now().saturating_duration_since(at);
        number += 1 + (late.as_secs_f64() / step.as_secs_f64()) as u32;
    }
}
