//! A subscriber's handle to its cursor in the log.

use std::sync::Arc;

use tokio::sync::{Notify, mpsc};

use super::{Hub, Line};
use crate::daemon::request::Subscription;

/// A subscriber. Its cursor ends when this is dropped. It belongs to the sensors' thread.
#[derive(Debug)]
pub(crate) struct Subscriber {
    hub: Hub,
    id: u64,
    changed: Arc<Notify>,
}

impl Subscriber {
    pub(super) fn new(hub: Hub, id: u64, changed: Arc<Notify>) -> Self {
        Self { hub, id, changed }
    }

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
                if log.is_closed() {
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
