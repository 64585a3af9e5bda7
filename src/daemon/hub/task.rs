//! The task that owns the hub, and the way to it.
//!
//! In: commands through a bounded channel. Out: replies, each through a channel of its own. The task never
//! waits for a subscriber.

use std::collections::HashMap;

use tokio::sync::{mpsc, oneshot};

use super::{Ahead, Hub, Line, Survey};
use crate::daemon::now;
use crate::daemon::record::EventRecorder;
use crate::daemon::request::Subscription;
use crate::event::{Event, Hello};

/// What the hub's task is asked to do.
enum Command {
    Publish {
        events: Vec<Event>,
    },
    Describe {
        hello: Box<Hello>,
    },
    Join {
        reply: oneshot::Sender<(u64, Line)>,
    },
    Take {
        id: u64,
        reply: oneshot::Sender<Vec<Line>>,
    },
    Subscribe {
        id: u64,
        subscription: Subscription,
        reply: oneshot::Sender<Result<(), Ahead>>,
    },
    Finals {
        reply: oneshot::Sender<Vec<Line>>,
    },
    Survey {
        reply: oneshot::Sender<Survey>,
    },
    Leave {
        id: u64,
    },
    Close,
}

/// The way to the hub.
#[derive(Debug, Clone)]
pub(crate) struct Handle {
    commands: mpsc::Sender<Command>,
}

/// The hub has ended: the daemon is stopping.
#[derive(Debug, thiserror::Error)]
#[error("the daemon is stopping")]
pub(crate) struct Closed;

impl Handle {
    /// Publishes events of one sensor.
    pub(crate) async fn publish(&self, events: Vec<Event>) {
        if !events.is_empty() {
            let _ = self.commands.send(Command::Publish { events }).await;
        }
    }

    /// Changes the `hello` of new subscribers. The run and the numbers stay.
    pub(crate) async fn describe(&self, hello: Hello) {
        let _ = self
            .commands
            .send(Command::Describe {
                hello: Box::new(hello),
            })
            .await;
    }

    /// Adds a subscriber, and gives its number and its `hello`. The caller must call
    /// [`Handle::leave`] in the end, so it must not be cancelled before: call this in a task of its
    /// own.
    pub(crate) async fn join(&self) -> Result<(u64, Line), Closed> {
        self.ask(|reply| Command::Join { reply }).await
    }

    /// The next lines of a subscriber, as soon as there are any. A subscriber may have one call
    /// under way at a time. It must send the lines that the receiver gives.
    pub(crate) async fn take(&self, id: u64) -> Result<oneshot::Receiver<Vec<Line>>, Closed> {
        let (reply, lines) = oneshot::channel();
        self.commands
            .send(Command::Take { id, reply })
            .await
            .map_err(|_| Closed)?;
        Ok(lines)
    }

    /// Changes a subscription. The inner error is for the subscriber. A call of [`Handle::take`]
    /// that is under way ends: with lines of the old subscription, or without any.
    pub(crate) async fn subscribe(
        &self,
        id: u64,
        subscription: Subscription,
    ) -> Result<Result<(), Ahead>, Closed> {
        self.ask(|reply| Command::Subscribe {
            id,
            subscription,
            reply,
        })
        .await
    }

    /// The last final verdict of each sensor, as it was sent.
    pub(crate) async fn finals(&self) -> Result<Vec<Line>, Closed> {
        self.ask(|reply| Command::Finals { reply }).await
    }

    /// The state of the hub.
    pub(crate) async fn survey(&self) -> Result<Survey, Closed> {
        self.ask(|reply| Command::Survey { reply }).await
    }

    /// Removes a subscriber.
    pub(crate) async fn leave(&self, id: u64) {
        let _ = self.commands.send(Command::Leave { id }).await;
    }

    /// Says that no more events come. Subscribers get the lines that are left, and then their end.
    pub(crate) async fn close(&self) {
        let _ = self.commands.send(Command::Close).await;
    }

    async fn ask<T>(
        &self,
        command: impl FnOnce(oneshot::Sender<T>) -> Command,
    ) -> Result<T, Closed> {
        let (reply, answer) = oneshot::channel();
        self.commands
            .send(command(reply))
            .await
            .map_err(|_| Closed)?;
        answer.await.map_err(|_| Closed)
    }
}

/// Commands that may wait. The hub never waits, so the queue is short unless the machine is busy.
const COMMANDS: usize = 256;

/// Starts the hub. It passes what it publishes on to `recorder`, and ends with the last handle.
pub(crate) fn start(hello: Hello, recorder: EventRecorder) -> Handle {
    let (commands, inbox) = mpsc::channel(COMMANDS);
    let hub = Hub {
        recorder,
        ..Hub::new(hello)
    };
    tokio::spawn(serve(hub, inbox));
    Handle { commands }
}

async fn serve(mut hub: Hub, mut inbox: mpsc::Receiver<Command>) {
    // Subscribers that have fetched everything and wait.
    let mut waiting: HashMap<u64, oneshot::Sender<Vec<Line>>> = HashMap::new();
    let mut closing = false;
    while let Some(command) = inbox.recv().await {
        // A reply that cannot be sent is for a subscriber that has just gone.
        match command {
            Command::Publish { events } => {
                for event in events {
                    hub.publish(event, now().mono);
                }
                for id in waiting.keys().copied().collect::<Vec<_>>() {
                    let lines = hub.take(id);
                    if !lines.is_empty()
                        && let Some(reply) = waiting.remove(&id)
                    {
                        let _ = reply.send(lines);
                    }
                }
            }
            Command::Describe { hello } => {
                hub.hello = Hello {
                    seq: hub.hello.seq,
                    run: hub.hello.run,
                    ..*hello
                };
            }
            Command::Join { reply } => {
                let (id, hello) = hub.join();
                if reply.send((id, hello)).is_err() {
                    hub.subscribers.remove(&id);
                }
            }
            Command::Take { id, reply } => {
                let lines = hub.take(id);
                if !lines.is_empty() {
                    let _ = reply.send(lines);
                } else if !closing {
                    waiting.insert(id, reply);
                }
            }
            Command::Subscribe {
                id,
                subscription,
                reply,
            } => {
                // Held events may be due at once: the subscriber takes again after its answer.
                waiting.remove(&id);
                let _ = reply.send(hub.subscribe(id, &subscription));
            }
            Command::Finals { reply } => {
                let _ = reply.send(hub.finals.values().cloned().collect());
            }
            Command::Survey { reply } => {
                let _ = reply.send(Survey {
                    hello: hub.hello.clone(),
                    finals: hub.finals.clone(),
                    tally: hub.tally.clone(),
                    subscribers: hub.subscribers.len(),
                });
            }
            Command::Leave { id } => {
                hub.subscribers.remove(&id);
                waiting.remove(&id);
            }
            Command::Close => {
                closing = true;
                hub.recorder = EventRecorder::default();
                waiting.clear();
            }
        }
    }
}
