//! A subscriber that passes lines to a thread, for publishers whose library may block.
//!
//! In: every kind of event, but only the newest frame of each sensor. Out: the same lines, in
//! order, through a short channel. While the thread is busy, nothing waits for it but the log. When
//! the log has moved on, a `gap` gives the number of lost events.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::mpsc::channel;

use tokio::sync::{mpsc, oneshot};
use tracing::warn;

use super::Error;
use super::hub::{Hub, Line};
use super::request::{Policy, Subscription};
use crate::thread::spawn_thread;
use hardnessd_core::event::{Event, Kind};

/// The most batches of lines that wait for the thread.
const BATCHES: usize = 8;

/// Passes the events of a batch to `publish`, with their lines. A gap is logged.
pub(super) fn each_event(
    way: &'static str,
    lines: &[Arc<Line>],
    mut publish: impl FnMut(&Event, &Line),
) {
    for line in lines {
        match &line.event {
            Some(event) => publish(event, line),
            None => warn!(way, gap = line.json().trim_end(), "too slow"),
        }
    }
}

/// A handle to a thread that takes lines until there are no more.
pub(super) struct Worker {
    lines: mpsc::Sender<Vec<Arc<Line>>>,
    ended: oneshot::Receiver<()>,
}

impl Worker {
    /// Starts a thread that opens a session and then publishes lines with it. Returns when the
    /// session is open. The library is never called on the daemon's own thread, because the library
    /// may have its own runtime.
    pub(super) fn start<O>(
        way: &'static str,
        open: impl FnOnce() -> Result<O, Error> + Send + 'static,
        work: impl FnOnce(O, mpsc::Receiver<Vec<Arc<Line>>>) + Send + 'static,
    ) -> Result<Self, Error> {
        let (lines, inbox) = mpsc::channel(BATCHES);
        let (opened, outcome) = channel();
        let ended = spawn_thread(way, move || match open() {
            Ok(open) => {
                let _ = opened.send(Ok(()));
                work(open, inbox);
            }
            Err(error) => {
                let _ = opened.send(Err(error));
            }
        })?;
        let outcome = outcome.recv();
        outcome.expect("a thread that panics ends the process")?;
        Ok(Self { lines, ended })
    }

    /// The same for a session that only publishes: `publish` gets each event with its line. The error of opening
    /// begins with `publish.WAY`, the table in the configuration.
    #[cfg(any(feature = "ros2", feature = "zenoh"))]
    pub(super) fn publishing<O, E: std::fmt::Display>(
        way: &'static str,
        open: impl FnOnce() -> Result<O, E> + Send + 'static,
        mut publish: impl FnMut(&mut O, &Event, &Line) + Send + 'static,
    ) -> Result<Self, Error> {
        let open = move || open().map_err(|error| Error::io(format!("publish.{way}: {error}")));
        Self::start(way, open, move |mut session, mut lines| {
            let mut each = |event: &Event, line: &Line| publish(&mut session, event, line);
            while let Some(lines) = lines.blocking_recv() {
                each_event(way, &lines, &mut each);
            }
        })
    }

    /// Passes on what the hub publishes, until the log is closed and the thread has ended.
    pub(super) async fn serve(self, hub: Hub) {
        let wanted = Subscription {
            kinds: BTreeSet::from(Kind::ALL),
            policy: Policy::LatestFrames,
            since: None,
        };
        let joined = hub.join(wanted).await;
        let (subscriber, now) = joined.expect("only a `since` can be refused");
        // The thread may have ended already.
        let _ = self.lines.send(now.statuses().collect()).await;
        subscriber.feed(self.lines);
        let _ = self.ended.await;
    }
}
