//! A subscriber of the hub that passes lines to a thread, for publishers whose library may block.
//!
//! In: every kind of event, but only the newest frame of each sensor. Out: the same lines, in
//! order, through a short channel. While the thread is busy, lines wait in the hub as for any
//! subscriber. When the hub has no more room for them, a `gap` gives the number of lost events.
//!
//! In the other direction, a thread may pass on positions of the arm that the robot reports. They
//! take the same path as a command of the control socket. Nothing else can be passed on.

use std::collections::BTreeSet;
use std::thread;
use std::time::Duration;

use tokio::sync::{mpsc, oneshot};
use tokio::time::{Interval, MissedTickBehavior};
use tracing::warn;

use super::client;
use super::hub::{self, Line};
use super::request::motion::Positions;
use super::request::{Policy, Subscription};
use super::sensor::Sensors;
use hardnessd_core::event::{Hello, Kind, Status};

/// The most jobs that wait for the thread: batches of lines, and queries between them.
const JOBS: usize = 8;

/// The most messages with positions that wait for the sensors' tasks.
const POSITIONS: usize = 256;

/// How often a thread that wants the `hello` and the statuses gets them.
const VITALS: Duration = Duration::from_secs(1);

/// Makes a job of the `hello` and the status of every sensor.
type Vitals<J> = fn(Hello, Vec<Status>) -> J;

/// The queue for the positions of the arm that a thread receives from the robot.
#[derive(Clone)]
#[cfg_attr(
    not(any(feature = "ros2", feature = "zenoh")),
    expect(dead_code, reason = "Foxglove says nothing of an arm")
)]
pub(super) struct Door {
    way: &'static str,
    positions: mpsc::Sender<Positions>,
}

impl Door {
    /// Passes positions on, without waiting.
    #[cfg(any(feature = "ros2", feature = "zenoh"))]
    pub(super) fn put(&self, positions: Positions) {
        if self.positions.try_send(positions).is_err() {
            warn!(way = self.way, "positions come too fast and are dropped");
        }
    }
}

/// A handle to a thread that takes jobs until there are no more.
pub(super) struct Worker<J> {
    jobs: mpsc::Sender<J>,
    ended: oneshot::Receiver<()>,
    way: &'static str,
    positions: mpsc::Receiver<Positions>,
    /// Only if the thread wants them.
    vitals: Option<Vitals<J>>,
}

impl<J: From<Vec<Line>> + Send + 'static> Worker<J> {
    /// Starts a thread that opens a session and then does jobs with it. Returns when the session is
    /// open. The library is never called on the daemon's own thread, because the library may have
    /// its own runtime.
    pub(super) fn start<O, E>(
        way: &'static str,
        open: impl FnOnce(&mpsc::Sender<J>, Door) -> Result<O, E> + Send + 'static,
        work: impl FnOnce(O, mpsc::Receiver<J>) + Send + 'static,
    ) -> Result<Self, E>
    where
        E: From<std::io::Error> + Send + 'static,
    {
        let (jobs, inbox) = mpsc::channel(JOBS);
        let (end, ended) = oneshot::channel();
        let (opened, outcome) = std::sync::mpsc::channel();
        let sender = jobs.clone();
        let (door, positions) = mpsc::channel(POSITIONS);
        let door = Door {
            way,
            positions: door,
        };
        thread::Builder::new().name(way.to_owned()).spawn(move || {
            let open = open(&sender, door);
            drop(sender);
            match open {
                Ok(open) => {
                    let _ = opened.send(Ok(()));
                    work(open, inbox);
                }
                Err(error) => {
                    let _ = opened.send(Err(error));
                }
            }
            drop(end);
        })?;
        outcome
            .recv()
            .expect("a thread that panics ends the process")?;
        Ok(Self {
            jobs,
            ended,
            way,
            positions,
            vitals: None,
        })
    }

    /// Also sends the thread the `hello` and the status of every sensor, once a second, as the job
    /// that `make` returns.
    #[cfg(any(feature = "ros2", feature = "zenoh"))]
    pub(super) fn with_vitals(self, make: Vitals<J>) -> Self {
        Self {
            vitals: Some(make),
            ..self
        }
    }

    /// Passes on what the hub publishes, until the hub closes and the thread has ended.
    pub(super) async fn serve(self, hub: hub::Handle, sensors: Sensors) {
        let Self {
            jobs,
            ended,
            way,
            positions,
            vitals,
        } = self;
        let relayed = async {
            if let Ok((id, _hello)) = hub.join().await {
                // Unlike a subscriber on a socket, this subscriber ends only with the daemon.
                let _ = relay(id, &hub, &sensors, jobs, vitals).await;
                hub.leave(id).await;
            }
        };
        tokio::join!(relayed, pass_on(way, positions, &sensors));
        // The wait always ends with an error, because the thread sends nothing and only drops its
        // end.
        let _ = ended.await;
    }
}

/// Gives positions to the sensors' tasks, until the thread has ended.
async fn pass_on(way: &'static str, mut positions: mpsc::Receiver<Positions>, sensors: &Sensors) {
    while let Some(Positions { sensor, points }) = positions.recv().await {
        if let Err(refused) = client::move_arm(sensors, &sensor, &points).await {
            warn!(way, sensor, %refused, "positions refused");
        }
    }
}

async fn relay<J: From<Vec<Line>>>(
    id: u64,
    hub: &hub::Handle,
    sensors: &Sensors,
    jobs: mpsc::Sender<J>,
    vitals: Option<Vitals<J>>,
) -> Result<(), hub::Closed> {
    let wanted = Subscription {
        kinds: BTreeSet::from(Kind::ALL),
        policy: Policy::LatestFrames,
        since: None,
    };
    // Only a subscription with `since` can be refused.
    let _ = hub.subscribe(id, wanted).await?;
    let (statuses, _) = sensors.statuses().await;
    let statuses = statuses.into_iter().map(Line::from);
    let mut job = J::from(statuses.collect::<Vec<Line>>());
    let mut next = hub.take(id).await?;
    let mut tick = tokio::time::interval(VITALS);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    while jobs.send(job).await.is_ok() {
        job = tokio::select! {
            // The selection is not biased, because a stream of frames must not delay the statuses.
            lines = &mut next => match lines {
                Ok(lines) => {
                    next = hub.take(id).await?;
                    J::from(lines)
                }
                Err(_) => break,
            },
            make = each_second(&mut tick, vitals) => {
                make(hub.survey().await?.hello, sensors.statuses().await.0)
            }
        };
    }
    Ok(())
}

/// Waits for the next second, for a thread that wants statuses. For any other thread, this waits
/// forever.
async fn each_second<J>(tick: &mut Interval, vitals: Option<Vitals<J>>) -> Vitals<J> {
    let Some(make) = vitals else {
        return std::future::pending().await;
    };
    tick.tick().await;
    make
}
