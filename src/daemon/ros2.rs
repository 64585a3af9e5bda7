//! ROS 2 over DDS: the messages of a recording as topics, `NAMESPACE/tactile/SENSOR/KIND`.
//!
//! In: lines of the hub. Out: messages of the node `hardnessd`. ROS need not be installed. Verdicts
//! and statuses are reliable, and a subscriber that comes later gets the last of each. Frames are
//! best effort. Further topics are for the usual tools of ROS: pictures and diagnostics. If the
//! configuration names topics with positions of the arm, the node subscribes to them. The node has no
//! service and no parameter, so nothing else comes in.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use ros2_client::dds::rustdds::DomainParticipantBuilder;
use ros2_client::qos::{Durability, History, QosProfile, WhenFull};
use ros2_client::{
    Context, MessageTypeName, Name, Node, NodeName, NodeOptions, Publisher, Subscription,
    WriteResult,
};
use serde::ser::SerializeTuple;
use serde::{Serialize, Serializer};
use tokio::runtime::{Builder, Runtime};
use tokio::sync::mpsc;
use tokio::time::MissedTickBehavior;
use tracing::{info, warn};

use super::Error;
use super::config::{self, Config};
use super::hub::{Hub, Line};
use super::log;
use super::relay::{PositionQueue, Worker};
use super::request::motion::{Positions, ReportedPoint};
use hardnessd_core::event::{Event, FrameEvent, Status};
use hardnessd_core::ros::{self, Topic, tools};

/// An error of the library.
type Failure = Box<dyn std::error::Error>;

/// The number of press events that are kept for a subscriber that missed some.
const PRESSES_KEPT: usize = 16;

/// The number of pictures and arrays that are kept for a subscriber that missed some. A subscriber
/// that needs more misses them, because publishing does not wait for it.
const PICTURES_KEPT: usize = 5;

/// How often the state of the sensors is published for the usual tools.
const DIAGNOSTICS_EVERY: Duration = Duration::from_secs(1);

/// The number of positions that are kept until the thread reads them.
const POSITIONS_KEPT: usize = 256;

/// The brightest colour of a picture means at least this force on a taxel, so that noise stays
/// dark.
const LEAST_SCALE_N: f32 = 0.2;

/// Joins the domain as `settings` say and makes the topics of `sensors`.
///
/// # Errors
///
/// Fails if the domain cannot be joined, for example because no port is free.
pub(super) fn open(settings: &config::Ros2, config: &Config, hub: &Hub) -> Result<Worker, Error> {
    let domain = settings.domain_id().map_err(Error::Config)?;
    let namespace = &settings.namespace;
    info!(way = "ros2", domain, namespace, "publishing");
    let (settings, robot) = (settings.clone(), config.robot.clone());
    let sensors = config.sensors.iter().map(|sensor| sensor.name.clone());
    let sensors: Vec<String> = sensors.collect();
    let hub = hub.clone();
    Worker::start(
        "ros2",
        move |positions| {
            let opened = Ros2::open(&settings, domain, robot, &sensors, &positions);
            opened.map_err(|error| Error::Io(format!("publish.ros2: {error}")))
        },
        move |(runtime, mut ros2), lines| {
            runtime.block_on(ros2.work(lines, &hub));
            // The tasks that read positions must end before their node.
            drop(runtime);
        },
    )
}

/// A node and its topics.
struct Ros2 {
    robot: String,
    /// The publisher of each topic, by the sensor and by the topic's name.
    topics: BTreeMap<(String, &'static str), Publisher<Message>>,
    diagnostics: Publisher<Message>,
    /// The highest force on a taxel of each sensor so far, in newtons.
    highest_n: BTreeMap<String, f32>,
    // The node must be dropped last, because its topics end with it.
    _node: Node,
}

impl Ros2 {
    fn open(
        settings: &config::Ros2,
        domain: u16,
        robot: String,
        sensors: &[String],
        queue: &PositionQueue,
    ) -> Result<(Runtime, Self), Failure> {
        let mut domain = DomainParticipantBuilder::new(domain);
        if !settings.networks.is_empty() {
            domain = domain.with_only_networks(settings.networks.iter().copied());
        }
        let context = Context::from_domain_participant(domain.build()?)?;
        let name = NodeName::new(&settings.namespace, "hardnessd")?;
        let options = NodeOptions::new()
            .enable_rosout(false)
            .start_parameter_services(false);
        let mut node = context.new_node(name, options)?;
        let mut topics = BTreeMap::new();
        for sensor in sensors {
            for (topic, qos) in [
                (ros::HARDNESS, latched()),
                (ros::STATUS, latched()),
                (ros::PRESS, kept(PRESSES_KEPT)),
                (ros::FRAME, QosProfile::subscription_default()),
                (ros::CONTACT, shown()),
                (tools::IMAGE, shown()),
            ] {
                let space = format!(
                    "{}/tactile/{sensor}",
                    settings.namespace.trim_end_matches('/')
                );
                let publisher = publisher(&mut node, &space, topic, &qos)?;
                topics.insert((sensor.clone(), topic.name), publisher);
            }
        }
        // By convention, the name of this topic is the same everywhere.
        let diagnostics = publisher(&mut node, "/", tools::DIAGNOSTICS, &kept(PRESSES_KEPT))?;
        let runtime = Builder::new_current_thread().enable_time().build()?;
        for (sensor, topic) in &settings.motion {
            let positions = subscription(&mut node, topic)?;
            runtime.spawn(take_positions(sensor.clone(), positions, queue.clone()));
        }
        let ros2 = Self {
            robot,
            topics,
            diagnostics,
            highest_n: BTreeMap::new(),
            _node: node,
        };
        Ok((runtime, ros2))
    }

    /// Publishes lines, and diagnostics at intervals. Meanwhile the runtime reads positions.
    async fn work(&mut self, mut lines: mpsc::Receiver<Vec<Arc<Line>>>, hub: &Hub) {
        let mut tick = tokio::time::interval(DIAGNOSTICS_EVERY);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                lines = lines.recv() => match lines {
                    Some(lines) => lines.iter().for_each(|line| self.publish(line)),
                    None => return,
                },
                _ = tick.tick() => if let Ok(now) = hub.snapshot().await {
                    let statuses = now.sensors.into_iter().map(|one| one.state.status);
                    self.diagnose(&statuses.collect::<Vec<_>>());
                },
            }
        }
    }

    fn diagnose(&self, statuses: &[Status]) {
        let now = jiff::Timestamp::now();
        let bytes = tools::diagnostics(now, &self.robot, statuses.iter());
        if let Err(error) = self.diagnostics.publish(Message(bytes)) {
            warn!(%error, "no diagnostics published on ros2");
        }
    }

    fn publish(&mut self, line: &Line) {
        let Some(event) = &line.event else {
            warn!(gap = line.json().trim_end(), "ros2 is too slow");
            return;
        };
        let (topic, _, bytes) = ros::encode(event);
        if let Err(error) = self.send(event.sensor(), topic, bytes) {
            let (sensor, topic) = (event.sensor(), topic.name);
            warn!(sensor, topic, %error, "not published on ros2");
        }
        match &**event {
            Event::Frame(frame) => self.show(frame),
            Event::Status(status) => self.diagnose(std::slice::from_ref(status)),
            Event::Hardness(_) | Event::Press(_) => {}
        }
    }

    /// Publishes a frame in the messages that viewers know.
    fn show(&mut self, frame: &FrameEvent) {
        let highest = self.highest_n.entry(frame.sensor.clone());
        let highest = highest.or_insert(LEAST_SCALE_N);
        *highest = frame.newtons.iter().copied().fold(*highest, f32::max);
        let picture = tools::picture(frame, *highest);
        let (contact, _, numbers) = ros::contact(frame);
        for (topic, bytes) in [(contact, numbers), (tools::IMAGE, picture)] {
            // A subscriber that is too slow misses the message.
            let _ = self.send(&frame.sensor, topic, bytes);
        }
    }

    fn send(&self, sensor: &str, topic: Topic, bytes: Vec<u8>) -> WriteResult<(), Message> {
        match self.topics.get(&(sensor.to_owned(), topic.name)) {
            Some(publisher) => publisher.publish(Message(bytes)),
            None => Ok(()),
        }
    }
}

/// Reads positions of the arm of `sensor`, forever.
async fn take_positions(
    sensor: String,
    positions: Subscription<tools::PointStamped>,
    queue: PositionQueue,
) {
    loop {
        let taken = match positions.async_take().await {
            Ok((position, _)) => position.position(),
            Err(error) => {
                log::outside(
                    "ros2",
                    || warn!(sensor, %error, "found no position on ros2"),
                );
                continue;
            }
        };
        match taken.and_then(|(at, mm)| ReportedPoint::at_time(at, mm)) {
            Some(point) => queue.put(Positions {
                sensor: sensor.clone(),
                points: vec![point],
            }),
            None => log::outside("ros2", || {
                warn!(
                    sensor,
                    "found a position on ros2 that is no number or no time"
                );
            }),
        }
    }
}

fn publisher(
    node: &mut Node,
    space: &str,
    topic: Topic,
    qos: &QosProfile,
) -> Result<Publisher<Message>, Failure> {
    let (package, name) = topic.package_and_name();
    let made = node.create_topic(
        &Name::new(space, topic.name)?,
        MessageTypeName::new(package, name),
        qos,
    )?;
    Ok(node.create_publisher(&made, Some(qos.clone()))?)
}

/// Subscribes to the positions of an arm. The subscription accepts reliable and best-effort
/// publishers.
fn subscription(
    node: &mut Node,
    topic: &str,
) -> Result<Subscription<tools::PointStamped>, Failure> {
    let (space, base) = topic.rsplit_once('/').unwrap_or_default();
    let space = if space.is_empty() { "/" } else { space };
    let (package, name) = tools::POSITION.package_and_name();
    let qos = QosProfile::subscription_default().history(History::KeepLast {
        depth: POSITIONS_KEPT,
    });
    let made = node.create_topic(
        &Name::new(space, base)?,
        MessageTypeName::new(package, name),
        &qos,
    )?;
    Ok(node.create_subscription(&made, Some(qos))?)
}

/// The quality of service for viewers. RViz2 of Humble accepts only reliable images. Publishing
/// does not wait for a viewer that is too slow.
fn shown() -> QosProfile {
    QosProfile::publisher_default()
        .reliability_reliable(WhenFull::Fail)
        .history(History::KeepLast {
            depth: PICTURES_KEPT,
        })
}

/// The quality of service by which a subscriber that comes later gets the last message.
fn latched() -> QosProfile {
    kept(1).durability(Durability::TransientLocal)
}

/// The quality of service by which a subscriber gets up to `depth` missed messages again.
fn kept(depth: usize) -> QosProfile {
    QosProfile::publisher_default()
        .reliability_reliable(WhenFull::DEFAULT)
        .history(History::KeepLast { depth })
}

/// A message as [`ros::encode`] makes it. The library writes the encapsulation header; the bytes
/// after it are sent unchanged.
struct Message(Vec<u8>);

impl Serialize for Message {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        // CDR has no length before a tuple, and no padding before a byte.
        let body = &self.0[ros::ENCAPSULATION.len()..];
        let mut tuple = serializer.serialize_tuple(body.len())?;
        for byte in body {
            tuple.serialize_element(byte)?;
        }
        tuple.end()
    }
}
