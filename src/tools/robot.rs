//! A simulated robot that sends the positions of its arm to a daemon, as a real controller would.
//!
//! In: the motion of the simulated arm. Out: lines on a daemon's control socket, 50 a second. The
//! daemon may start later, end, and start again: the robot waits for it and never delays the
//! sensor.

use std::convert::Infallible;
use std::path::PathBuf;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::time::{Instant, MissedTickBehavior};

use super::connect;
use super::exit::Failure;
use crate::daemon::now;
use hardnessd_core::exit::FAILED;
use hardnessd_core::stderr_line;

/// The time between two positions.
const STEP: Duration = Duration::from_millis(10);
/// The number of positions in a line.
const POINTS: usize = 2;
/// How long the robot waits before it looks for the daemon again.
const RETRY: Duration = Duration::from_millis(200);

/// The robot.
pub(crate) struct Robot {
    /// The daemon's control socket.
    pub(crate) socket: PathBuf,
    /// Where the arm is at a moment, in mm. `None` while it does not move yet.
    pub(crate) position: Box<dyn Fn(Instant) -> Option<f64>>,
}

impl Robot {
    /// Sends positions for ever. Prints the first reason on stderr why a daemon does not take them.
    pub(crate) async fn run(self) {
        let mut complained = false;
        loop {
            let Err(failure) = self.send().await;
            if !complained {
                let why = failure.line();
                stderr_line!("warning: {why} (positions are sent as soon as a daemon takes them)");
                complained = true;
            }
            tokio::time::sleep(RETRY).await;
        }
    }

    /// Sends positions to one daemon until the daemon ends or refuses them.
    async fn send(&self) -> Result<Infallible, Failure> {
        let mut daemon = connect::control(Some(self.socket.clone())).await?;
        let hello = daemon.meet().await?;
        // The arm has the daemon's first sensor.
        let sensor = &hello["sensors"][0]["name"];
        // The robot needs no events.
        daemon.send("{\"subscribe\":[]}").await?;
        let mut tick = tokio::time::interval(STEP);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut points: Vec<(u64, f64)> = Vec::with_capacity(POINTS);
        loop {
            tokio::select! {
                line = daemon.next() => {
                    let answer: Value = serde_json::from_str(&line?).unwrap_or_default();
                    if answer["type"] == "error" {
                        let refusal = answer["message"].as_str().unwrap_or_default();
                        return Err(Failure::new(FAILED, refusal.to_owned()));
                    }
                }
                _ = tick.tick() => {
                    let Some(mm) = (self.position)(Instant::now()) else {
                        continue;
                    };
                    let mono_ns = u64::try_from(now().mono.as_nanos()).unwrap_or(u64::MAX);
                    points.push((mono_ns, mm));
                    if points.len() == POINTS {
                        let motion = json!({"motion": {"sensor": sensor, "at": points}});
                        daemon.send(&motion.to_string()).await?;
                        points.clear();
                    }
                }
            }
        }
    }
}
