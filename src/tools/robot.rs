//! A simulated robot that sends the positions of its arm to a daemon, as a real controller would.
//!
//! In: the motion of the simulated arm. Out: lines on a daemon's control socket, 50 a second. The
//! daemon may start later, end, and start again: the robot waits for it and never delays the
//! sensor.

use std::convert::Infallible;
use std::io;
use std::path::PathBuf;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::io::AsyncWriteExt;
use tokio::net::UnixStream;
use tokio::net::unix::OwnedReadHalf;
use tokio::time::{Instant, MissedTickBehavior};

use super::connect::LONGEST_LINE_BYTES;
use crate::daemon::lines::{LineRead, Lines};
use crate::daemon::now;
use hardnessd_core::{stderr_line, wording};

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
    /// Sends positions for ever. Prints the first refusal of a daemon on stderr, and that there is no
    /// daemon yet.
    pub(crate) async fn run(self) {
        let mut complained = false;
        loop {
            let Err(complaint) = self.send().await;
            if let Some(complaint) = complaint.filter(|_| !complained) {
                stderr_line!("warning: {}: {complaint}", self.socket.display());
                complained = true;
            }
            tokio::time::sleep(RETRY).await;
        }
    }

    /// Sends positions to one daemon until the daemon ends, or there is something to complain of.
    async fn send(&self) -> Result<Infallible, Option<String>> {
        let gone = |_| None;
        let absent = |error: io::Error| {
            let yet = "no daemon takes positions there yet, and they are sent as soon as one does";
            Some(format!("{}: {yet}", wording::line(&error)))
        };
        let daemon = UnixStream::connect(&self.socket).await;
        let (input, mut output) = daemon.map_err(absent)?.into_split();
        let mut lines = Lines::new(input, LONGEST_LINE_BYTES);
        let hello = next(&mut lines).await?;
        if hello["type"] != "hello" {
            let foreign = "what answers there is no hardnessd: name the control socket of a daemon";
            return Err(Some(foreign.to_owned()));
        }
        // The arm has the daemon's first sensor.
        let sensor = &hello["sensors"][0]["name"];
        // The robot needs no events.
        let sent = output.write_all(b"{\"subscribe\":[]}\n").await;
        sent.map_err(gone)?;
        let mut tick = tokio::time::interval(STEP);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut points: Vec<(u64, f64)> = Vec::with_capacity(POINTS);
        loop {
            tokio::select! {
                line = next(&mut lines) => {
                    let answer = line?;
                    if answer["type"] == "error" {
                        return Err(answer["message"].as_str().map(str::to_owned));
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
                        output.write_all(format!("{motion}\n").as_bytes()).await.map_err(gone)?;
                        points.clear();
                    }
                }
            }
        }
    }
}

/// The next line of a daemon. Whoever sends a line without end is none.
async fn next(lines: &mut Lines<OwnedReadHalf>) -> Result<Value, Option<String>> {
    match lines.next().await {
        Ok(LineRead::Line(line)) => Ok(serde_json::from_slice(&line).unwrap_or_default()),
        Ok(LineRead::TooLong | LineRead::End) | Err(_) => Err(None),
    }
}
