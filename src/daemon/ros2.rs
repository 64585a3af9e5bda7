//! ROS 2 over DDS: the messages of a recording as topics, `NAMESPACE/tactile/SENSOR/KIND`.
//!
//! In: lines of the hub. Out: messages of the node `hardnessd`. ROS need not be installed. Verdicts
//! and statuses are reliable, and a subscriber that comes later gets the last of each. Frames are
//! best effort. The node has no subscription, no service and no parameter, so nothing comes in.

use std::collections::BTreeMap;

use ros2_client::dds::rustdds::DomainParticipantBuilder;
use ros2_client::qos::{Durability, History, QosProfile, WhenFull};
use ros2_client::{Context, MessageTypeName, Name, Node, NodeName, NodeOptions, Publisher};
use serde::ser::SerializeTuple;
use serde::{Serialize, Serializer};
use tracing::{info, warn};

use super::Error;
use super::config;
use super::relay::Worker;
use super::sensor::{SensorHandle, Sensors};
use hardnessd_core::event::{Event, Kind};
use hardnessd_core::ros::{self, Topic};

/// An error of the library.
type Failure = Box<dyn std::error::Error>;

/// The number of press events that are kept for a subscriber that missed some.
const PRESSES_KEPT: usize = 16;

/// The number of contacts that are kept for a subscriber that missed some. A subscriber that needs more misses
/// them, because publishing does not wait for it.
const CONTACTS_KEPT: usize = 5;

/// Joins the domain as `settings` say and makes the topics of `sensors`.
///
/// # Errors
///
/// Fails if the domain cannot be joined, for example because no port is free.
pub(super) fn open(settings: &config::Ros2, sensors: &Sensors) -> Result<Worker, Error> {
    let domain = config::domain_id(settings.domain_id).map_err(Error::config)?;
    let namespace = &settings.namespace;
    info!(way = "ros2", domain, namespace, "publishing");
    let (settings, sensors) = (settings.clone(), sensors.clone());
    Worker::publishing(
        "ros2",
        move || Ros2::open(&settings, domain, &sensors),
        |node, event, _| node.publish(event),
    )
}

/// A node and its topics.
struct Ros2 {
    /// The publisher of each topic, by the topic's full name.
    topics: BTreeMap<String, Publisher<Message>>,
    // The node must be dropped last, because its topics end with it.
    _node: Node,
}

impl Ros2 {
    fn open(settings: &config::Ros2, domain: u16, sensors: &Sensors) -> Result<Self, Failure> {
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
        for SensorHandle { name: sensor, .. } in sensors.iter() {
            for (topic, qos) in [
                (ros::HARDNESS, latched()),
                (ros::STATUS, latched()),
                (ros::PRESS, kept(PRESSES_KEPT)),
                (ros::FRAME, QosProfile::subscription_default()),
                (ros::CONTACT, shown()),
            ] {
                let space = format!(
                    "{}/tactile/{sensor}",
                    settings.namespace.trim_end_matches('/')
                );
                let publisher = publisher(&mut node, &space, topic, &qos)?;
                topics.insert(topic.of(sensor), publisher);
            }
        }
        Ok(Self {
            topics,
            _node: node,
        })
    }

    fn publish(&self, event: &Event) {
        for (topic, _, bytes) in ros::encode_all(event) {
            let name = topic.of(event.sensor());
            let Some(publisher) = self.topics.get(&name) else {
                continue;
            };
            // A viewer that is too slow misses frames.
            if let Err(error) = publisher.publish(Message(bytes))
                && event.kind() != Kind::Frame
            {
                warn!(name, %error, "not published on ros2");
            }
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

/// The quality of service for viewers. Publishing does not wait for a viewer that is too slow.
fn shown() -> QosProfile {
    QosProfile::publisher_default()
        .reliability_reliable(WhenFull::Fail)
        .history(History::KeepLast {
            depth: CONTACTS_KEPT,
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

/// A message as [`ros::encode_all`] makes it. The library writes the encapsulation header; the bytes
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
