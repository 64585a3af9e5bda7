//! A subscriber of the hub that passes lines to a thread, for publishers whose library may block.
//!
//! In: every kind of event, frames with policy `latest`. Out: the same lines, in order, through a
//! short channel. While the thread is busy, lines wait in the hub as for any subscriber. When the
//! hub has no more room for them, there is a `gap`.

use std::thread;

use tokio::sync::{mpsc, oneshot};

use super::client;
use super::hub::{self, Line};
use super::request::{Policy, Subscription};
use super::sensor::Sensors;
use crate::event::Kind;

/// The most jobs that wait for the thread: batches of lines, and queries between them.
const JOBS: usize = 8;

/// A thread that takes jobs until there are no more.
pub(super) struct Worker<J> {
    jobs: mpsc::Sender<J>,
    ended: oneshot::Receiver<()>,
}

impl<J: From<Vec<Line>> + Send + 'static> Worker<J> {
    /// Starts a thread that opens a session and then does jobs with it, and waits until the session
    /// is open. The library is never called on the daemon's own thread, because it may have a
    /// runtime of its own.
    pub(super) fn start<O, E>(
        name: &'static str,
        open: impl FnOnce(&mpsc::Sender<J>) -> Result<O, E> + Send + 'static,
        work: impl FnOnce(O, mpsc::Receiver<J>) + Send + 'static,
    ) -> Result<Self, E>
    where
        E: From<std::io::Error> + Send + 'static,
    {
        let (jobs, inbox) = mpsc::channel(JOBS);
        let (end, ended) = oneshot::channel();
        let (opened, outcome) = std::sync::mpsc::channel();
        let sender = jobs.clone();
        thread::Builder::new()
            .name(name.to_owned())
            .spawn(move || {
                let open = open(&sender);
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
        Ok(Self { jobs, ended })
    }

    /// Passes on what the hub publishes, until the hub closes and the thread has ended.
    pub(super) async fn serve(self, hub: hub::Handle, sensors: Sensors) {
        if let Ok((id, _hello)) = hub.join().await {
            // Unlike a subscriber on a socket, it may end only with the daemon.
            let _ = relay(id, &hub, &sensors, self.jobs).await;
            hub.leave(id).await;
        }
        // Nothing is ever sent.
        let _ = self.ended.await;
    }
}

async fn relay<J: From<Vec<Line>>>(
    id: u64,
    hub: &hub::Handle,
    sensors: &Sensors,
    jobs: mpsc::Sender<J>,
) -> Result<(), hub::Closed> {
    let wanted = Subscription {
        kinds: Kind::ALL.into_iter().collect(),
        policy: Policy::LatestFrames,
        since: None,
    };
    // Only a `since` can be refused.
    let _ = hub.subscribe(id, wanted).await?;
    let mut lines = client::statuses(sensors).await;
    while jobs.send(J::from(lines)).await.is_ok() {
        let Ok(next) = hub.take(id).await?.await else {
            break;
        };
        lines = next;
    }
    Ok(())
}
