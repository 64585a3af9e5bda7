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

/// A topic, and its last message, if a late viewer gets it at once.
struct Topic {
    channel: Arc<RawChannel>,
    last: Option<(PartialMetadata, Vec<u8>)>,
}

/// A listening server.
struct Foxglove {
    /// By the topic's full name.
    topics: BTreeMap<String, Topic>,
    newcomers: mpsc::Receiver<(String, SinkId)>,
    server: WebSocketServerHandle,
    // A channel ends with its context, and the server with its runtime.
    _context: Arc<Context>,
    runtime: Runtime,
}

impl Foxglove {
    fn open(address: SocketAddr, robot: &str, sensors: &[String]) -> Result<Self, Error> {
        let context = Context::new();
        let topics = topics(&context, sensors).map_err(failed)?;
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
                FoxgloveError::Bind(error) => Error::io(format!(
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
        let (mut topics, mut newcomers) = (self.topics, self.newcomers);
        self.runtime.block_on(async {
            loop {
                tokio::select! {
                    lines = lines.recv() => match lines {
                        Some(lines) => {
                            each_event("foxglove", &lines, |event, _| publish(event, &mut topics));
                        }
                        None => break,
                    },
                    Some((name, viewer)) = newcomers.recv() => {
                        if let Some(Topic { channel, last: Some((meta, bytes)) }) = topics.get(&name) {
                            channel.log_with_meta_to_sink(bytes, *meta, Some(viewer));
                        }
                    }
                }
            }
            tokio::time::sleep(LAST_MESSAGES).await;
            // A timeout is not a failure: the runtime drops the remaining connections.
            let _ = tokio::time::timeout(FAREWELL, self.server.stop().wait()).await;
        });
    }
}

fn failed(error: impl Display) -> Error {
    Error::io(format!("publish.foxglove: {error}"))
}

fn topics(
    context: &Arc<Context>,
    sensors: &[String],
) -> Result<BTreeMap<String, Topic>, FoxgloveError> {
    let mut topics = BTreeMap::new();
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
            let last = None;
            topics.insert(name, Topic { channel, last });
        }
    }
    Ok(topics)
}

/// Queues the messages of an event for all viewers. This never waits.
fn publish(event: &Event, topics: &mut BTreeMap<String, Topic>) {
    for (topic, time, bytes) in ros::encode_all(event) {
        let Some(topic) = topics.get_mut(&topic.of(event.sensor())) else {
            continue;
        };
        let log_time = Some(u64::try_from(time.as_nanosecond()).unwrap_or(0));
        let meta = PartialMetadata { log_time };
        topic.channel.log_with_meta_to_sink(&bytes, meta, None);
        if event.lasts() {
            topic.last = Some((meta, bytes));
        }
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
