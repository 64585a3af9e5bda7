//! The hub: a log of events that subscribers read, each from its own place on.
//!
//! In: events of the sensors, in the order in which they happen, and the current state of each
//! sensor. Out: lines, each formatted once and shared by all who read it. Nothing is queued for
//! anyone. A subscriber is a [`Cursor`] in the log: a slow one finds that the log has moved on, and
//! a `gap` says by how many events.
//!
//! The log belongs to the sensors' thread. Other threads have their questions answered there, so that
//! no thread with ordinary scheduling holds the log while a sensor needs it.

mod cursor;
mod log;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
#[cfg(feature = "zenoh")]
use std::{sync::mpsc::channel, time::Duration};

use tokio::runtime::Handle;
use tokio::sync::{Notify, mpsc};

use self::log::Log;
pub(crate) use self::log::{Line, SensorSnapshot, Series, Snapshot};
use super::now;
use super::request::Subscription;
use hardnessd_core::event::{Event, Hello};

/// How long a thread without a runtime waits for an answer.
#[cfg(feature = "zenoh")]
const PATIENCE: Duration = Duration::from_secs(1);

/// A handle to the log.
#[derive(Debug, Clone)]
pub(crate) struct Hub {
    log: Arc<Mutex<Log>>,
    /// The runtime of the sensors' thread.
    pub(super) thread: Handle,
}

impl Hub {
    /// An empty log that describes the daemon with `hello`. Call it on the sensors' thread, inside
    /// its runtime.
    pub(crate) fn new(hello: Hello) -> Self {
        Self {
            log: Arc::new(Mutex::new(Log::new(hello))),
            thread: Handle::current(),
        }
    }

    /// The log. Call this on the sensors' thread alone.
    pub(crate) fn log(&self) -> MutexGuard<'_, Log> {
        // A panic ends the process. In a test, it ends the test.
        self.log.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Publishes events of one sensor. Call this on the sensors' thread alone.
    pub(crate) fn publish(&self, events: Vec<Event>) {
        let mut log = self.log();
        for event in events {
            log.publish(event, now().mono);
        }
    }

    /// Adds a subscriber, and returns what is true where its lines begin. The error is for the subscriber.
    pub(crate) async fn join(
        &self,
        wanted: Subscription,
    ) -> Result<(Subscriber, Snapshot), String> {
        let hub = self.clone();
        self.ask(move |log| {
            let now = log.snapshot();
            let id = log.join(&wanted)?;
            let changed = log.subscribers[&id].changed.clone();
            Ok((Subscriber { hub, id, changed }, now))
        })
        .await
    }

    /// The current state of the log and of all sensors.
    pub(crate) async fn snapshot(&self) -> Snapshot {
        self.ask(|log| log.snapshot()).await
    }

    /// Like [`Hub::snapshot`], for a thread without a runtime. `None` if the daemon is stopping.
    #[cfg(feature = "zenoh")]
    pub(crate) fn snapshot_blocking(&self) -> Option<Snapshot> {
        let (answer, answered) = channel();
        let hub = self.clone();
        self.thread
            .spawn(async move { answer.send(hub.log().snapshot()) });
        answered.recv_timeout(PATIENCE).ok()
    }

    /// Has a question answered on the sensors' thread. That thread outlives those who ask. Without it, this
    /// never completes.
    async fn ask<T: Send + 'static>(
        &self,
        question: impl FnOnce(&mut Log) -> T + Send + 'static,
    ) -> T {
        let hub = self.clone();
        let answered = self.thread.spawn(async move { question(&mut hub.log()) });
        match answered.await {
            Ok(answer) => answer,
            Err(_) => std::future::pending().await,
        }
    }
}

/// A subscriber. Its cursor ends when this is dropped. It belongs to the sensors' thread.
#[derive(Debug)]
pub(crate) struct Subscriber {
    hub: Hub,
    id: u64,
    changed: Arc<Notify>,
}

impl Subscriber {
    /// The next lines, as soon as there are any. `None` if the log is closed and there are no more.
    /// Cancelling the wait loses nothing.
    pub(crate) async fn next(&mut self) -> Option<Vec<Arc<Line>>> {
        loop {
            {
                // One lock, so that no line comes between the two questions.
                let mut log = self.hub.log();
                let lines = log.read(self.id);
                if !lines.is_empty() {
                    return Some(lines);
                }
                if log.is_closed {
                    return None;
                }
            }
            self.changed.notified().await;
        }
    }

    /// Changes the subscription from now on.
    pub(crate) fn subscribe(&mut self, wanted: &Subscription) -> Result<(), String> {
        self.hub.log().subscribe(self.id, wanted)
    }

    /// Sends the lines into a channel, from the sensors' thread, until the log is closed or nobody
    /// receives.
    pub(crate) fn feed(mut self, lines: mpsc::Sender<Vec<Arc<Line>>>) {
        let thread = self.hub.thread.clone();
        thread.spawn(async move {
            // The room comes first. So a slow receiver gets the frames that are the newest then.
            while let Ok(room) = lines.reserve().await {
                let next = tokio::select! {
                    next = self.next() => next,
                    () = lines.closed() => None,
                };
                match next {
                    Some(next) => room.send(next),
                    None => return,
                }
            }
        });
    }
}

impl Drop for Subscriber {
    fn drop(&mut self) {
        self.hub.log().leave(self.id);
    }
}

#[cfg(test)]
pub(super) mod tests;
