//! One sensor: its port at one end, the hub at the other, its pipeline between.
//!
//! The task waits for the port, the pipeline's deadline or a command, makes one call into the
//! pipeline and sends what came of it. It shares nothing, so a sensor that is lost disturbs no
//! other.

use std::time::Duration;

use tokio::sync::{mpsc, oneshot};
use tokio::time::Instant;

use super::hub;
use super::serial::{Link, Turn};
use crate::event::{Event, Kind, Status};
use crate::pipeline::{Judgement, Pipeline};

/// What a sensor can be asked.
#[derive(Debug)]
pub(crate) enum Command {
    /// How it is now.
    Status(oneshot::Sender<Status>),
    /// To judge otherwise from now on.
    Reload(Box<Judgement>),
    /// To end: a press is aborted, then nothing comes any more.
    Finish,
}

/// Ways to all sensors, in the order of the configuration.
#[derive(Debug, Clone)]
pub(crate) struct Sensors(pub(crate) Vec<mpsc::Sender<Command>>);

impl Sensors {
    /// Every sensor's status now; those that have ended are left out.
    pub(crate) async fn statuses(&self) -> Vec<Status> {
        let mut statuses = Vec::with_capacity(self.0.len());
        for sensor in &self.0 {
            let (reply, status) = oneshot::channel();
            if sensor.send(Command::Status(reply)).await.is_ok()
                && let Ok(status) = status.await
            {
                statuses.push(status);
            }
        }
        statuses
    }
}

/// Serves one sensor until [`Command::Finish`].
pub(crate) async fn serve(
    mut pipeline: Pipeline,
    mut link: Link,
    hub: hub::Handle,
    mut commands: mpsc::Receiver<Command>,
) {
    loop {
        let deadline = pipeline.deadline();
        let (events, at) = tokio::select! {
            // Commands first: a sensor that never pauses must still stop when told.
            biased;
            command = commands.recv() => match command {
                Some(Command::Status(reply)) => {
                    // The asker may have gone.
                    let _ = reply.send(pipeline.status(super::now()));
                    continue;
                }
                Some(Command::Reload(judgement)) => {
                    pipeline.reload(*judgement);
                    continue;
                }
                Some(Command::Finish) | None => {
                    return hub.publish(pipeline.shutdown(), super::now().mono).await;
                }
            },
            turn = link.turn() => {
                let at = super::now();
                let events = match turn {
                    Turn::Bytes(bytes) => pipeline.push(bytes, at),
                    Turn::Opened => pipeline.opened(at),
                    Turn::Unavailable(reason) => pipeline.unavailable(reason, at),
                    Turn::Lost(reason) => pipeline.lost(reason, at),
                };
                (events, at)
            }
            () = until(deadline) => {
                let at = super::now();
                (pipeline.tick(at), at)
            }
        };
        if events
            .iter()
            .map(Event::kind)
            .any(|kind| kind == Kind::Frame)
        {
            link.proven();
        }
        hub.publish(events, at.mono).await;
    }
}

/// Waits for a moment of CLOCK_MONOTONIC, which is the runtime's clock too; for ever if there is
/// none.
async fn until(deadline: Option<Duration>) {
    match deadline {
        Some(deadline) => {
            let left = deadline.saturating_sub(super::now().mono);
            tokio::time::sleep_until(Instant::now() + left).await;
        }
        None => std::future::pending().await,
    }
}
