//! A subscriber that passes lines to a thread, for publishers whose library may block.
//!
//! In: every kind of event, but only the newest frame of each sensor. Out: the same lines, in
//! order, through a short channel. While the thread is busy, nothing waits for it but the log. When
//! the log has moved on, a `gap` gives the number of lost events.
//!
//! In the other direction, a thread may pass on positions of the arm that the robot reports. They
//! take the same path as a command of the control socket. Nothing else can be passed on.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::thread;

use tokio::sync::{mpsc, oneshot};
use tracing::warn;

use super::Error;
use super::client;
use super::hub::{Hub, Line};
use super::log;
use super::request::motion::Positions;
use super::request::{Policy, Subscription};
use super::sensor::Sensors;
use hardnessd_core::event::Kind;

/// The most batches of lines that wait for the thread.
const BATCHES: usize = 8;

/// The most messages with positions that wait for the sensors' tasks.
const POSITIONS: usize = 256;

/// The queue for the positions of the arm that a thread receives from the robot.
#[derive(Clone)]
#[allow(dead_code, reason = "Foxglove says nothing of an arm")]
pub(super) struct PositionQueue {
    way: &'static str,
    positions: mpsc::Sender<Positions>,
}

impl PositionQueue {
    /// Passes positions on, without waiting.
    #[allow(dead_code, reason = "Foxglove says nothing of an arm")]
    pub(super) fn put(&self, positions: Positions) {
        if self.positions.try_send(positions).is_err() {
            let way = self.way;
            log::outside(way, || {
                warn!(way, "positions come too fast and are dropped");
            });
        }
    }
}

/// A handle to a thread that takes lines until there are no more.
pub(super) struct Worker {
    lines: mpsc::Sender<Vec<Arc<Line>>>,
    ended: oneshot::Receiver<()>,
    way: &'static str,
    positions: mpsc::Receiver<Positions>,
}

impl Worker {
    /// Starts a thread that opens a session and then publishes lines with it. Returns when the
    /// session is open. The library is never called on the daemon's own thread, because the library
    /// may have its own runtime.
    pub(super) fn start<O>(
        way: &'static str,
        open: impl FnOnce(PositionQueue) -> Result<O, Error> + Send + 'static,
        work: impl FnOnce(O, mpsc::Receiver<Vec<Arc<Line>>>) + Send + 'static,
    ) -> Result<Self, Error> {
        let (lines, inbox) = mpsc::channel(BATCHES);
        let (end, ended) = oneshot::channel();
        let (opened, outcome) = std::sync::mpsc::channel();
        let (sender, positions) = mpsc::channel(POSITIONS);
        let queue = PositionQueue {
            way,
            positions: sender,
        };
        let thread = thread::Builder::new().name(way.to_owned());
        let started = thread.spawn(move || {
            match open(queue) {
                Ok(open) => {
                    let _ = opened.send(Ok(()));
                    work(open, inbox);
                }
                Err(error) => {
                    let _ = opened.send(Err(error));
                }
            }
            drop(end);
        });
        started.map_err(|error| Error::Io(format!("no thread for publish.{way}: {error}")))?;
        outcome
            .recv()
            .expect("a thread that panics ends the process")?;
        Ok(Self {
            lines,
            ended,
            way,
            positions,
        })
    }

    /// Passes on what the hub publishes, until the log is closed and the thread has ended.
    pub(super) async fn serve(self, hub: Hub, sensors: Sensors) {
        let Self {
            lines,
            ended,
            way,
            positions,
        } = self;
        let wanted = Subscription {
            kinds: BTreeSet::from(Kind::ALL),
            policy: Policy::LatestFrames,
            since: None,
        };
        if let Ok(joined) = hub.join(wanted).await {
            let (subscriber, now) = joined.expect("only a `since` can be refused");
            // The thread may have ended already.
            let _ = lines.send(now.statuses().collect()).await;
            subscriber.feed(lines);
        }
        pass_on(way, positions, &sensors).await;
        // The wait always ends with an error, because the thread sends nothing and only drops its
        // end.
        let _ = ended.await;
    }
}

/// Gives positions to the sensors' tasks, until the thread has ended.
async fn pass_on(way: &'static str, mut positions: mpsc::Receiver<Positions>, sensors: &Sensors) {
    while let Some(Positions { sensor, points }) = positions.recv().await {
        if let Err(refused) = client::move_arm(sensors, &sensor, &points).await {
            log::outside(way, || warn!(way, sensor, %refused, "positions refused"));
        }
    }
}
