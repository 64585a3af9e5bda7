//! A live server for Foxglove and Lichtblick: the topics of a recording, over the websocket
//! protocol `foxglove.sdk.v1`.
//!
//! In: lines of the hub. Out: the messages that a recording has of these, under the same names and with
//! the same definitions, so one layout fits both. A viewer that connects later gets the last final
//! verdict and the last status of each sensor. The server has no capability that
//! accepts data from a viewer, so a viewer cannot change anything. One thread does all this.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use foxglove::websocket::{ChannelView, Client, ServerListener};
use foxglove::{
    ChannelBuilder, Context, FoxgloveError, PartialMetadata, RawChannel, Schema, SinkId,
    WebSocketServer, WebSocketServerHandle,
};
use tokio::runtime::{Builder, Runtime};
use tokio::sync::mpsc;
use tracing::info;

use super::Error;
use super::config::{self, Config};
use super::hub::Line;
use super::relay::{Worker, each_event};
use hardnessd_core::event::Event;
use hardnessd_core::ros;

/// The most messages that wait for a viewer, about 1 MB. When there are more, the oldest are
/// dropped.
const BACKLOG: usize = 512;

/// The most new subscriptions that wait for their first message. A further subscription begins with
/// the next event.
const NEWCOMERS: usize = 64;

/// The time for the last messages to reach the viewers, because the library does not report when a
/// viewer has everything.
const LAST_MESSAGES: Duration = Duration::from_millis(50);

/// How long the server waits at its end until its viewers have closed. A viewer that does not read
/// cannot be notified, and would keep the server waiting.
const FAREWELL: Duration = Duration::from_millis(200);

/// Listens as `settings` say and announces the topics of the sensors.
///
/// # Errors
///
/// Fails if the daemon cannot listen on the address, or the library fails.
pub(super) fn open(settings: &config::Foxglove, config: &Config) -> Result<Worker, Error> {
    let (address, robot) = (settings.listen, config.robot.clone());
    let sensors = config.sensors.iter().map(|sensor| sensor.name.clone());
    let sensors: Vec<String> = sensors.collect();
    Worker::start(
        "foxglove",
        move || Foxglove::open(address, &robot, &sensors),
        Foxglove::work,
    )
}

/// A message of a topic, with its time in nanoseconds since 1970.
struct Message {
    at_ns: u64,
    bytes: Vec<u8>,
}

/// The topics and their last messages.
struct Topics {
    /// The channel of each topic, by the topic's full name.
    channels: BTreeMap<String, Arc<RawChannel>>,
    /// The last message of each topic that a late viewer gets at once.
    last: BTreeMap<String, Message>,
}

/// A listening server.
struct Foxglove {
    topics: Topics,
    newcomers: mpsc::Receiver<(String, SinkId)>,
    server: WebSocketServerHandle,
    // A channel ends with its context, and the server with its runtime.
    _context: Arc<Context>,
    runtime: Runtime,
}

impl Foxglove {
    fn open(address: SocketAddr, robot: &str, sensors: &[String]) -> Result<Self, Error> {
        let context = Context::new();
        let topics = Topics::new(&context, sensors).map_err(failed)?;
        let (queue, newcomers) = mpsc::channel(NEWCOMERS);
        let host = match address.ip() {
            IpAddr::V4(ip) => ip.to_string(),
            IpAddr::V6(ip) => format!("[{ip}]"),
        };
        let runtime = Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(failed)?;
        let server = WebSocketServer::new()
            .name(format!("hardnessd of {robot}"))
            .bind(host, address.port())
            .context(&context)
            .message_backlog_size(BACKLOG)
            .listener(Arc::new(Newcomers(queue)));
        let server = runtime
            .block_on(server.start())
            .map_err(|error| match error {
                FoxgloveError::Bind(error) => Error::Io(format!(
                    "publish.foxglove.listen: cannot listen on {address}: {error}"
                )),
                other => failed(other),
            })?;
        let address = SocketAddr::new(address.ip(), server.port());
        info!(way = "foxglove", %address, "listening");
        Ok(Self {
            topics,
            newcomers,
            server,
            _context: context,
            runtime,
        })
    }

    fn work(self, mut lines: mpsc::Receiver<Vec<Arc<Line>>>) {
        let Self {
            mut topics,
            mut newcomers,
            server,
            runtime,
            ..
        } = self;
        runtime.block_on(async {
            loop {
                tokio::select! {
                    lines = lines.recv() => match lines {
                        Some(lines) => {
                            each_event("foxglove", &lines, |event, _| topics.publish(event));
                        }
                        None => break,
                    },
                    Some((topic, viewer)) = newcomers.recv() => topics.greet(&topic, viewer),
                }
            }
            tokio::time::sleep(LAST_MESSAGES).await;
            // A timeout is not a failure: the runtime drops the remaining connections.
            let _ = tokio::time::timeout(FAREWELL, server.stop().wait()).await;
        });
    }
}

fn failed(error: impl Display) -> Error {
    Error::Io(format!("publish.foxglove: {error}"))
}

impl Topics {
    fn new(context: &Arc<Context>, sensors: &[String]) -> Result<Self, FoxgloveError> {
        let mut channels = BTreeMap::new();
        for sensor in sensors {
            for topic in [
                ros::FRAME,
                ros::CONTACT,
                ros::HARDNESS,
                ros::PRESS,
                ros::STATUS,
            ] {
                let name = topic.of(sensor);
                let schema = Schema::new(topic.schema, "ros2msg", topic.text().into_bytes());
                let channel = ChannelBuilder::new(name.clone())
                    .message_encoding("cdr")
                    .schema(schema)
                    .context(context)
                    .build_raw()?;
                channels.insert(name, channel);
            }
        }
        Ok(Self {
            channels,
            last: BTreeMap::new(),
        })
    }

    fn publish(&mut self, event: &Event) {
        for (topic, time, bytes) in ros::encode_all(event) {
            let name = topic.of(event.sensor());
            let at_ns = u64::try_from(time.as_nanosecond()).unwrap_or(0);
            let message = Message { at_ns, bytes };
            if let Some(channel) = self.channels.get(&name) {
                message.send(channel, None);
            }
            if event.lasts() {
                self.last.insert(name, message);
            }
        }
    }

    /// Sends the last message of `topic` to a viewer that has just subscribed.
    fn greet(&self, topic: &str, viewer: SinkId) {
        if let (Some(channel), Some(message)) = (self.channels.get(topic), self.last.get(topic)) {
            message.send(channel, Some(viewer));
        }
    }
}

impl Message {
    /// Queues the message for one viewer, or for all. This never waits.
    fn send(&self, channel: &RawChannel, viewer: Option<SinkId>) {
        let meta = PartialMetadata {
            log_time: Some(self.at_ns),
        };
        channel.log_with_meta_to_sink(&self.bytes, meta, viewer);
    }
}

/// The listener that passes new subscriptions of viewers on to the thread.
struct Newcomers(mpsc::Sender<(String, SinkId)>);

impl ServerListener for Newcomers {
    fn on_subscribe(&self, client: Client, channel: ChannelView<'_>) {
        if let Some(viewer) = client.sink_id() {
            // When too many wait, the viewer begins with the next event.
            let _ = self.0.try_send((channel.topic().to_owned(), viewer));
        }
    }
}
