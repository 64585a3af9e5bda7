//! A simulated robot that sends the positions of its arm to a daemon, as a real controller would.
//!
//! In: the motion of the simulated arm. Out: lines on a daemon's control socket, 50 a second. The
//! daemon may start later, end, and start again: the robot waits for it and never delays the
//! sensor.

use std::convert::Infallible;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::time::Instant;

use super::connect;
use super::exit::{FAILED, Failure};
use crate::daemon::now;
use crate::thread::NoThread;
use hardnessd_core::stderr_line;

/// The time between two positions.
const STEP: Duration = Duration::from_millis(10);
/// The number of positions in a line.
const POINTS: usize = 2;
/// How long the robot waits before it looks for the daemon again.
const RETRY: Duration = Duration::from_millis(200);

/// Sends positions to the daemon at a control socket, for ever, on a thread of its own. `position` is where the
/// arm is at a moment, in mm, and `None` while it does not move yet. If a daemon does not take them, the first
/// reason is printed on stderr.
///
/// # Errors
///
/// Fails if the system has no thread to spare.
pub(crate) fn start(
    socket: PathBuf,
    position: impl Fn(Instant) -> Option<f64> + Send + 'static,
) -> Result<(), NoThread> {
    crate::thread::start("robot", move || {
        let mut complained = false;
        loop {
            let Err(failure) = send(&socket, &position);
            // A demo that ends has closed its daemon, and needs no words about that.
            thread::sleep(RETRY);
            if !complained {
                let why = failure.line();
                stderr_line!("warning: {why} (positions are sent as soon as a daemon takes them)");
                complained = true;
            }
        }
    })
}

/// Sends positions to one daemon until the daemon ends or refuses them.
fn send(socket: &Path, position: &impl Fn(Instant) -> Option<f64>) -> Result<Infallible, Failure> {
    let mut daemon = connect::control(Some(socket.to_owned()))?;
    let hello = daemon.meet()?;
    // The arm has the daemon's first sensor. It needs no events.
    let sensor = &hello["sensors"][0]["name"];
    daemon.send("{\"subscribe\":[]}")?;
    let mut points: Vec<(u64, f64)> = Vec::with_capacity(POINTS);
    loop {
        // Meanwhile answers come. A position is due whether or not the last ones were taken.
        let due = Instant::now() + STEP;
        while let Some(line) = daemon.next_within(due.saturating_duration_since(Instant::now()))? {
            let answer: Value = serde_json::from_str(&line).unwrap_or_default();
            if answer["type"] == "error" {
                let refusal = answer["message"].as_str().unwrap_or_default();
                return Err(Failure::new(FAILED, refusal.to_owned()));
            }
        }
        // The position may have to wait for the simulation, and is that of this moment.
        let (at, mono) = (Instant::now(), now().mono);
        let Some(mm) = position(at) else {
            continue;
        };
        let mono_ns = u64::try_from(mono.as_nanos()).unwrap_or(u64::MAX);
        points.push((mono_ns, mm));
        if points.len() == POINTS {
            let motion = json!({"motion": {"sensor": sensor, "at": points}});
            daemon.send(&motion.to_string())?;
            points.clear();
        }
    }
}
