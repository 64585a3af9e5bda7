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
mod subscriber;
mod tally;

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
#[cfg(feature = "zenoh")]
use std::{sync::mpsc, time::Duration};

use tokio::runtime::Handle;

use self::log::Log;
pub(crate) use self::log::{Line, SensorSnapshot, Snapshot};
pub(crate) use self::subscriber::Subscriber;
pub(crate) use self::tally::Series;
use super::now;
use super::request::Subscription;
use hardnessd_core::event::{Event, Hello};

/// How long a thread without a runtime waits for an answer.
#[cfg(feature = "zenoh")]
const PATIENCE: Duration = Duration::from_secs(1);

/// The error that the daemon is stopping, and its sensors' thread answers no more.
#[derive(Debug, thiserror::Error)]
#[error("the daemon is stopping")]
pub(crate) struct Closed;

/// A handle to the log.
#[derive(Debug, Clone)]
pub(crate) struct Hub {
    log: Arc<Mutex<Log>>,
    thread: Handle,
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

    /// Adds a subscriber, and returns what is true where its lines begin. The inner error is for the
    /// subscriber.
    pub(crate) async fn join(
        &self,
        wanted: Subscription,
    ) -> Result<Result<(Subscriber, Snapshot), String>, Closed> {
        let hub = self.clone();
        self.ask(move |log| {
            let now = log.snapshot();
            let id = log.join(&wanted)?;
            let changed = log.subscribers[&id].changed.clone();
            Ok((Subscriber::new(hub, id, changed), now))
        })
        .await
    }

    /// The current state of the log and of all sensors.
    pub(crate) async fn snapshot(&self) -> Result<Snapshot, Closed> {
        self.ask(|log| log.snapshot()).await
    }

    /// Like [`Hub::snapshot`], for a thread without a runtime.
    #[cfg(feature = "zenoh")]
    pub(crate) fn snapshot_blocking(&self) -> Result<Snapshot, Closed> {
        let (answer, answered) = mpsc::channel();
        let hub = self.clone();
        self.thread
            .spawn(async move { answer.send(hub.log().snapshot()) });
        answered.recv_timeout(PATIENCE).map_err(|_| Closed)
    }

    /// Has a question answered on the sensors' thread.
    async fn ask<T: Send + 'static>(
        &self,
        question: impl FnOnce(&mut Log) -> T + Send + 'static,
    ) -> Result<T, Closed> {
        let hub = self.clone();
        let answered = self.thread.spawn(async move { question(&mut hub.log()) });
        answered.await.map_err(|_| Closed)
    }
}

#[cfg(test)]
pub(super) mod tests;
