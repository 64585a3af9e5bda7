//! The task that owns the hub, and the handle to the task.
//!
//! In: commands through a bounded channel. Out: replies, each through its own channel. The task
//! never waits for a subscriber.

use std::collections::HashMap;

use tokio::sync::{mpsc, oneshot};

use super::{Ahead, History, Hub, Line, Survey};
use crate::daemon::now;
use crate::daemon::record::EventRecorder;
use crate::daemon::request::Subscription;
use hardnessd_core::event::{Event, Hello};

/// A command to the hub's task.
enum Command {
    Publish {
        events: Vec<Event>,
    },
    Describe {
        hello: Box<Hello>,
        recorder: Option<EventRecorder>,
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
    Survey {
        reply: oneshot::Sender<Survey>,
    },
    History {
        sensor: String,
        reply: oneshot::Sender<Option<History>>,
    },
    Leave {
        id: u64,
    },
    Close,
}

/// A handle to the hub's task.
#[derive(Debug, Clone)]
pub(crate) struct Handle {
    commands: mpsc::Sender<Command>,
}

/// The error that the hub has ended, because the daemon is stopping.
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

    /// Changes the `hello` of new subscribers. The run and the numbers stay. From now on events are
    /// passed on to `recorder`, if there is another one.
    pub(crate) async fn describe(&self, hello: Hello, recorder: Option<EventRecorder>) {
        let hello = Box::new(hello);
        let _ = self
            .commands
            .send(Command::Describe { hello, recorder })
            .await;
    }

    /// Adds a subscriber, and returns its number and its `hello`. In the end the caller must call
    /// [`Handle::leave`], so the caller must not be cancelled before: call this in a task of its
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

    /// The state of the hub.
    pub(crate) async fn survey(&self) -> Result<Survey, Closed> {
        self.ask(|reply| Command::Survey { reply }).await
    }

    /// The force and contact area of a sensor in the last two minutes. `None` if there is no such
    /// sensor. Its line is made by the caller, because the hub has no time for it.
    pub(crate) async fn history(&self, sensor: String) -> Result<Option<History>, Closed> {
        self.ask(|reply| Command::History { sensor, reply }).await
    }

    /// Removes a subscriber.
    pub(crate) async fn leave(&self, id: u64) {
        let _ = self.commands.send(Command::Leave { id }).await;
    }

    /// Closes the hub after its last event. Subscribers get the remaining lines, and then
    /// [`Handle::take`] gives no more.
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

/// The most commands that wait. The hub never waits, so the queue is short unless the machine is
/// busy.
const COMMANDS: usize = 256;

/// Starts the hub. The hub passes every event that it publishes on to `recorder`, and ends when the
/// last handle is dropped.
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
    // The subscribers that have fetched everything and wait for more.
    let mut waiting: HashMap<u64, oneshot::Sender<Vec<Line>>> = HashMap::new();
    let mut closing = false;
    while let Some(command) = inbox.recv().await {
        // If a reply cannot be sent, its subscriber has just disconnected.
        match command {
            Command::Publish { events } => {
                let mut was_offered = false;
                for event in events {
                    was_offered |= hub.publish(event, now().mono);
                }
                // Most events are frames that nobody wants, so most of the time there is nothing
                // to look for.
                if was_offered {
                    let ready = waiting.extract_if(|id, _| hub.has_lines(*id));
                    for (id, reply) in ready.collect::<Vec<_>>() {
                        let _ = reply.send(hub.take(id));
                    }
                }
            }
            Command::Describe { hello, recorder } => {
                hub.describe(*hello);
                hub.recorder = recorder.unwrap_or(hub.recorder);
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
                // End the pending `take`, because held events may be due at once. The subscriber
                // takes again after its answer.
                waiting.remove(&id);
                let _ = reply.send(hub.subscribe(id, &subscription));
            }
            Command::Survey { reply } => {
                let _ = reply.send(Survey {
                    hello: hub.hello.clone(),
                    finals: hub.finals.clone(),
                    tally: hub.tally.clone(),
                    subscribers: hub.subscribers.len(),
                });
            }
            Command::History { sensor, reply } => {
                let _ = reply.send(hub.history(&sensor));
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
