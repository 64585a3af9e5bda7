//! ROS 2 over zenoh, in the form of `rmw_zenoh`: the topics that [DDS](super::config::Ros2) has, for nodes that run with
//! `RMW_IMPLEMENTATION=rmw_zenoh_cpp`.
//!
//! In: lines of the hub. Out: the messages of a recording (CDR), each with its number, time and publisher; a liveliness
//! token for the node `hardnessd` and one for each topic, by which ROS finds them. Nothing comes in. The keys, the
//! tokens and the quality of service in them are those of `rmw_zenoh_cpp`
//! (<https://github.com/ros2/rmw_zenoh>, `liveliness_utils.cpp`, `attachment_helpers.cpp`).

use std::collections::BTreeMap;
use std::time::Duration;

use jiff::Timestamp;
use sha2::{Digest, Sha256};
use tracing::{info, warn};
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};
use zenoh_ext::{
    AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig, MissDetectionConfig, ZSerializer,
};

use super::Error;
use super::config;
use super::relay::Worker;
use super::sensor::{SensorHandle, Sensors};
use super::zenoh::{check_listen, configuration as plain_configuration};
use hardnessd_core::event::{Event, Kind};
use hardnessd_core::ros::{self, Topic};

/// How often the last number of a latched topic is told, so that a reader asks for what it missed. It is that of
/// `rmw_zenoh_cpp`.
const HEARTBEAT: Duration = Duration::from_millis(500);

/// A topic, and what ROS must know of it.
struct Known {
    topic: Topic,
    /// The hash of the message's definition (REP-2016, RIHS01). It is a part of the topic's key.
    type_hash: &'static str,
    /// The quality of service as a token has it. What is not written is ROS's default: reliable, volatile.
    qos: &'static str,
}

/// Reliable, transient local, the last one: a reader that comes later gets the last message.
const LATCHED: &str = ":1:,1:,:,:,,";

const TOPICS: [Known; 5] = [
    Known {
        topic: ros::HARDNESS,
        type_hash: "RIHS01_72e975257ef6bcbfbe618446e8b9d908c23cc46db9b62e1e4dd77ae8d96d6a22",
        qos: LATCHED,
    },
    Known {
        topic: ros::STATUS,
        type_hash: "RIHS01_a5fa9b67b10c152daa6f31e32c5330631e776e0a82d00082f9b53e1aca5f807c",
        qos: LATCHED,
    },
    Known {
        topic: ros::PRESS,
        type_hash: "RIHS01_00bdf2951d5eb85caa54cd53efa0fd1088e85dc0da00ff265ebf13e99d13f7b7",
        qos: "::,16:,:,:,,",
    },
    Known {
        topic: ros::FRAME,
        type_hash: "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
        // Best effort.
        qos: "2::,5:,:,:,,",
    },
    Known {
        topic: ros::CONTACT,
        type_hash: "RIHS01_e2296428fc6fe1d9c84e8942b44d846a7e8ec3f535b65b38441b0005c93f625c",
        qos: "::,5:,:,:,,",
    },
];

/// Joins the graph as `settings` say and makes the topics of `sensors`.
///
/// # Errors
///
/// Fails if the daemon cannot listen on an address, or the library fails. A router that cannot be reached is not an
/// error, because the library tries again.
pub(super) fn open(settings: &config::RmwZenoh, sensors: &Sensors) -> Result<Worker, Error> {
    check_listen("publish.rmw_zenoh.listen", &settings.listen)?;
    let domain = config::domain_id(settings.domain_id).map_err(Error::config)?;
    let (namespace, connect) = (&settings.namespace, &settings.connect);
    info!(way = "rmw_zenoh", domain, namespace, ?connect, "publishing");
    let (settings, sensors) = (settings.clone(), sensors.clone());
    Worker::publishing(
        "rmw_zenoh",
        move || Node::open(&settings, domain, &sensors),
        |node, event, _| node.publish(event),
    )
}

/// A node and its topics.
struct Node {
    /// The publisher of each topic, by the topic's name without the namespace.
    topics: BTreeMap<String, Publisher>,
    // Dropping one of these ends it. The session must be dropped last.
    _token: LivelinessToken,
    _session: Session,
}

struct Publisher {
    publisher: AdvancedPublisher<'static>,
    /// Tells this publisher from others, for readers that ask. ROS takes another hash of the same token.
    gid: [u8; 16],
    sent: i64,
    _token: LivelinessToken,
}

impl Node {
    fn open(
        settings: &config::RmwZenoh,
        domain: u16,
        sensors: &Sensors,
    ) -> Result<Self, zenoh::Error> {
        let session = zenoh::open(configuration(settings)?).wait()?;
        let zid = session.zid();
        let namespace = settings.namespace.trim_end_matches('/');
        // A key has no empty part, so an empty name is `%` and a slash within a name too.
        let space = format!("%{}", mangled(namespace.trim_start_matches('/')));
        let names = format!("%/{space}/hardnessd");
        let declare = |token: String| session.liveliness().declare_token(token).wait();
        let token = declare(format!("@ros2_lv/{domain}/{zid}/0/0/NN/{names}"))?;
        let mut topics = BTreeMap::new();
        for SensorHandle { name: sensor, .. } in sensors.iter() {
            for known in &TOPICS {
                let type_hash = match settings.type_hashes {
                    true => known.type_hash,
                    false => "TypeHashNotSupported",
                };
                let (package, message) = known.topic.package_and_name();
                let types = format!("{package}::msg::dds_::{message}_/{type_hash}");
                let name = known.topic.of(sensor);
                let full = format!("{namespace}{name}");
                let key = format!("{domain}{full}/{types}");
                let id = topics.len() + 1;
                let token = format!(
                    "@ros2_lv/{domain}/{zid}/0/{id}/MP/{names}/{}/{types}/{}",
                    mangled(&full),
                    known.qos
                );
                let publisher = Publisher {
                    publisher: publisher(&session, key, known)?,
                    gid: gid(&token),
                    sent: 0,
                    _token: declare(token)?,
                };
                topics.insert(name, publisher);
            }
        }
        Ok(Self {
            topics,
            _token: token,
            _session: session,
        })
    }

    fn publish(&mut self, event: &Event) {
        for (topic, _, bytes) in ros::encode_all(event) {
            let name = topic.of(event.sensor());
            let Some(publisher) = self.topics.get_mut(&name) else {
                continue;
            };
            if let Err(error) = publisher.put(bytes)
                && event.kind() != Kind::Frame
            {
                warn!(name, %error, "not published on rmw_zenoh");
            }
        }
    }
}

impl Publisher {
    fn put(&mut self, message: Vec<u8>) -> Result<(), zenoh::Error> {
        self.sent += 1;
        let now = Timestamp::now().as_nanosecond() as i64;
        let mut attachment = ZSerializer::new();
        attachment.serialize(self.sent);
        attachment.serialize(now);
        attachment.serialize(self.gid);
        let put = self.publisher.put(message);
        put.attachment(attachment.finish()).wait()
    }
}

/// The publisher of a topic. A frame is soon out of date. Any other message may wait for the network a while, because
/// nothing else waits for this thread.
fn publisher(
    session: &Session,
    key: String,
    known: &Known,
) -> Result<AdvancedPublisher<'static>, zenoh::Error> {
    let is_of_frame = [ros::FRAME, ros::CONTACT].contains(&known.topic);
    let plain = session
        .declare_publisher(key)
        .congestion_control(match is_of_frame {
            true => CongestionControl::Drop,
            false => CongestionControl::Block,
        });
    let publisher = plain.advanced();
    if known.qos != LATCHED {
        return publisher.wait();
    }
    publisher
        .cache(CacheConfig::default().max_samples(1))
        .publisher_detection()
        .sample_miss_detection(MissDetectionConfig::default().sporadic_heartbeat(HEARTBEAT))
        .wait()
}

/// A name as a part of a token.
fn mangled(name: &str) -> String {
    name.replace('/', "%")
}

fn gid(token: &str) -> [u8; 16] {
    let hash: [u8; 32] = Sha256::digest(token).into();
    std::array::from_fn(|place| hash[place])
}

/// The session of a ROS node: it finds the others at the router, and then connects to them directly, because ROS's
/// router passes no message on between two nodes.
fn configuration(settings: &config::RmwZenoh) -> Result<zenoh::Config, zenoh::Error> {
    let mut config = plain_configuration(&settings.listen, &settings.connect)?;
    for (key, value) in [
        ("scouting/gossip/target", r#"{"peer": ["router"]}"#),
        (
            "scouting/gossip/autoconnect",
            r#"{"peer": ["router", "peer"]}"#,
        ),
        (
            "scouting/gossip/autoconnect_strategy",
            r#"{"peer": {"to_router": "always", "to_peer": "greater-zid"}}"#,
        ),
        // A reader orders what was kept for it by time.
        ("timestamping/enabled", "true"),
    ] {
        config.insert_json5(key, value)?;
    }
    Ok(config)
}
