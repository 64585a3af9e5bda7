//! A robot that tells a daemon where its arm is, as the controller of a real one would.
//!
//! In: how the simulated arm moves. Out: lines on a daemon's control socket, 50 a second. The daemon
//! may come later, go, and come again; the robot waits for it and never delays the sensor.

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::UnixStream;
use tokio::sync::watch;
use tokio::time::{Instant, MissedTickBehavior};

use crate::daemon::now;
use crate::simulator::Approach;

/// Between two positions.
const STEP: Duration = Duration::from_millis(10);
/// Positions in a line.
const POINTS: usize = 2;
/// How long the robot waits before it looks for the daemon again.
const RETRY: Duration = Duration::from_millis(200);

/// How the arm moves now.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Moving {
    /// When the sensor's first frame was taken.
    pub(crate) start: Instant,
    /// Sensor seconds a second.
    pub(crate) speed: f64,
    /// Where the arm is, around this moment.
    pub(crate) approach: Approach,
}

impl Moving {
    fn mm(&self, at: Instant) -> f64 {
        self.approach
            .mm((at - self.start).as_secs_f64() * self.speed)
    }
}

/// The robot.
#[derive(Debug)]
pub(crate) struct Robot {
    /// The daemon's control socket.
    pub(crate) socket: PathBuf,
    /// The sensor on the arm; none: the daemon's first.
    pub(crate) sensor: Option<String>,
    /// How the arm moves; none before the first frame.
    pub(crate) moving: watch::Receiver<Option<Moving>>,
}

impl Robot {
    /// Tells for ever. What the daemon refuses is said on stderr, once.
    pub(crate) async fn run(self) {
        let mut complained = false;
        loop {
            if let Err(Ended::Refused(message)) = self.tell().await
                && !complained
            {
                eprintln!("warning: {}: {message}", self.socket.display());
                complained = true;
            }
            tokio::time::sleep(RETRY).await;
        }
    }

    /// Tells one daemon until it goes.
    async fn tell(&self) -> Result<(), Ended> {
        let (input, mut output) = UnixStream::connect(&self.socket).await?.into_split();
        let mut lines = BufReader::new(input).lines();
        let hello = lines.next_line().await?.ok_or(Ended::Gone)?;
        let hello: Value = serde_json::from_str(&hello).unwrap_or_default();
        let first = hello["sensors"][0]["name"].as_str().map(str::to_owned);
        let sensor = self.sensor.clone().or(first).ok_or(Ended::Gone)?;
        // Events are for others.
        output.write_all(b"{\"subscribe\":[]}\n").await?;
        let mut tick = tokio::time::interval(STEP);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut points: Vec<(u64, f64)> = Vec::with_capacity(POINTS);
        loop {
            tokio::select! {
                line = lines.next_line() => {
                    let line = line?.ok_or(Ended::Gone)?;
                    let answer: Value = serde_json::from_str(&line).unwrap_or_default();
                    if let ("error", Some(message)) =
                        (answer["type"].as_str().unwrap_or_default(), answer["message"].as_str())
                    {
                        return Err(Ended::Refused(message.to_owned()));
                    }
                }
                _ = tick.tick() => {
                    let Some(moving) = *self.moving.borrow() else {
                        continue;
                    };
                    let mono_ns = u64::try_from(now().mono.as_nanos()).unwrap_or(u64::MAX);
                    points.push((mono_ns, moving.mm(Instant::now())));
                    if points.len() == POINTS {
                        let motion = json!({"motion": {"sensor": sensor, "at": points}});
                        output.write_all(format!("{motion}\n").as_bytes()).await?;
                        points.clear();
                    }
                }
            }
        }
    }
}

/// Why a daemon is told no more.
enum Ended {
    /// It is not there, or has gone.
    Gone,
    /// It does not take what it is told.
    Refused(String),
}

impl From<io::Error> for Ended {
    fn from(_: io::Error) -> Self {
        Self::Gone
    }
}
