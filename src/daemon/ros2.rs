//! ROS 2 over DDS: the messages of a recording as topics, `NAMESPACE/tactile/SENSOR/KIND`.
//!
//! In: lines of the hub. Out: samples of the node `hardnessd`. ROS need not be installed. Verdicts and
//! statuses are reliable, and a subscriber that comes later gets the last of each. Frames are best
//! effort. The node has no service and no parameter, so nothing comes in.

use std::collections::BTreeMap;
use std::io;

use ros2_client::dds::rustdds::DomainParticipantBuilder;
use ros2_client::qos::{Durability, History, QosProfile, WhenFull};
use ros2_client::{
    Context, CreateError, MessageTypeName, Name, Node, NodeName, NodeOptions, Publisher,
};
use serde::ser::SerializeTuple;
use serde::{Serialize, Serializer};
use tokio::sync::mpsc;
use tracing::{info, warn};

use super::config;
use super::hub::Line;
use super::relay::Worker;
use crate::ros;

/// Why there is no node.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The domain or a topic could not be made.
    #[error("publish.ros2: {0}")]
    Create(#[from] CreateError),
    /// The node could not be made.
    #[error("publish.ros2: {0}")]
    Node(#[from] ros2_client::NodeCreateError),
    /// ROS does not allow this name.
    #[error("publish.ros2.namespace: {0}")]
    Name(#[from] ros2_client::names::NameError),
    /// The system gave no thread.
    #[error("no thread for publish.ros2: {0}")]
    Thread(#[from] io::Error),
}

/// Press events that are kept for a subscriber that missed some.
const PRESSES_KEPT: usize = 16;

/// Joins the domain as `settings` say and makes the topics of `sensors`.
///
/// # Errors
///
/// If the domain cannot be joined, for example because no port is free.
pub(super) fn open(
    settings: &config::Ros2,
    sensors: Vec<String>,
) -> Result<Worker<Vec<Line>>, Error> {
    let (domain, namespace) = (settings.domain_id(), &settings.namespace);
    info!(way = "ros2", domain, namespace, "publishing");
    let settings = settings.clone();
    Worker::start("ros2", move |_| Ros2::open(&settings, &sensors), Ros2::work)
}

/// A node and its topics.
struct Ros2 {
    /// By sensor and name.
    topics: BTreeMap<(String, &'static str), Publisher<Message>>,
    // Must be dropped last: its topics end with it.
    _node: Node,
}

impl Ros2 {
    fn open(settings: &config::Ros2, sensors: &[String]) -> Result<Self, Error> {
        let mut domain = DomainParticipantBuilder::new(settings.domain_id());
        if !settings.networks.is_empty() {
            domain = domain.with_only_networks(settings.networks.iter().copied());
        }
        let context = Context::from_domain_participant(domain.build().map_err(CreateError::from)?)?;
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
            ] {
                let publisher = publisher(&mut node, settings, sensor, topic, &qos)?;
                topics.insert((sensor.clone(), topic.name), publisher);
            }
        }
        Ok(Self {
            topics,
            _node: node,
        })
    }

    fn work(self, mut lines: mpsc::Receiver<Vec<Line>>) {
        while let Some(lines) = lines.blocking_recv() {
            for line in lines {
                self.publish(&line);
            }
        }
    }

    fn publish(&self, line: &Line) {
        let Some(event) = &line.event else {
            warn!(gap = line.json.trim_end(), "ros2 is too slow");
            return;
        };
        let (topic, _, bytes) = ros::encode(event);
        let key = (event.sensor().to_owned(), topic.name);
        if let Some(publisher) = self.topics.get(&key)
            && let Err(error) = publisher.publish(Message(bytes))
        {
            warn!(sensor = key.0, topic = key.1, %error, "not published on ros2");
        }
    }
}

fn publisher(
    node: &mut Node,
    settings: &config::Ros2,
    sensor: &str,
    topic: ros::Topic,
    qos: &QosProfile,
) -> Result<Publisher<Message>, Error> {
    let space = format!(
        "{}/tactile/{sensor}",
        settings.namespace.trim_end_matches('/')
    );
    let (package, name) = topic.package_and_name();
    let made = node.create_topic(
        &Name::new(&space, topic.name)?,
        MessageTypeName::new(package, name),
        qos,
    )?;
    Ok(node.create_publisher(&made, Some(qos.clone()))?)
}

/// A subscriber that comes later gets the last sample.
fn latched() -> QosProfile {
    kept(1).durability(Durability::TransientLocal)
}

/// A subscriber that missed samples gets them again.
fn kept(depth: usize) -> QosProfile {
    QosProfile::publisher_default()
        .reliability_reliable(WhenFull::DEFAULT)
        .history(History::KeepLast { depth })
}

/// A message as [`ros::encode`] makes it. The library writes the encapsulation header; the bytes after it
/// are sent unchanged.
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
