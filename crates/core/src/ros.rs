//! Events as ROS 2 messages: their definitions, and their bytes (CDR, little-endian).
//!
//! In: events. Out: the messages that recordings hold and ROS 2 subscribers get. Every message
//! begins with a `std_msgs/Header`: the moment in UTC and the sensor's name. A ROS message has no
//! null, so a null of an event becomes 0, NaN or an empty string.

mod frame;
pub mod tools;

use byteorder::LittleEndian;
use jiff::Timestamp;
use serde::de::Visitor;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;

pub use self::frame::contact;
pub use self::frame::{CONTACT, FRAME, GRID};
use crate::event::{self, Event, name};
use crate::frame::Pitch;

/// The bytes before every message: CDR, little-endian, no options (DDS-XTYPES 1.3, 7.6.3.1.2).
pub const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// A channel of a sensor: `/tactile/SENSOR/NAME`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Topic {
    /// The last part of the topic.
    pub name: &'static str,
    /// The type of its messages: PACKAGE/msg/NAME.
    pub schema: &'static str,
    /// The text of that type.
    pub definition: &'static str,
}

/// Verdicts.
pub const HARDNESS: Topic = Topic {
    name: "hardness",
    schema: "tactile_interfaces/msg/Hardness",
    definition: include_str!("../../../clients/ros2/tactile_interfaces/msg/Hardness.msg"),
};

/// Begins and ends of presses.
pub const PRESS: Topic = Topic {
    name: "press",
    schema: "tactile_interfaces/msg/Press",
    definition: include_str!("../../../clients/ros2/tactile_interfaces/msg/Press.msg"),
};

/// States of the link.
pub const STATUS: Topic = Topic {
    name: "status",
    schema: "tactile_interfaces/msg/Status",
    definition: include_str!("../../../clients/ros2/tactile_interfaces/msg/Status.msg"),
};

impl Topic {
    /// The full name of a sensor's topic.
    pub fn of(&self, sensor: &str) -> String {
        format!("/tactile/{sensor}/{}", self.name)
    }

    /// The package and the name of the topic's schema, as a middleware names them.
    pub fn package_and_name(&self) -> (&'static str, &'static str) {
        let named = self.schema.split_once("/msg/");
        named.expect("a schema is PACKAGE/msg/NAME")
    }

    /// The definition and all definitions that it refers to, in the form of `ros2msg`.
    pub fn text(&self) -> String {
        let rule = "=".repeat(80);
        format!(
            "{}{rule}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n\
             {rule}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
            self.definition
        )
    }
}

/// A `std_msgs/Header`: the time and the name of the sensor.
#[derive(Debug, Serialize, Deserialize)]
pub struct Header {
    stamp: Time,
    /// The name of the sensor.
    pub frame_id: String,
}

#[derive(Debug, Serialize, Deserialize)]
struct Time {
    sec: i32,
    nanosec: u32,
}

impl Time {
    fn new(time: Timestamp) -> Self {
        // In ROS, nanoseconds always count up from the second. Before 1970, jiff's nanoseconds do
        // not.
        let ns = time.as_nanosecond();
        let seconds = ns.div_euclid(1_000_000_000);
        Self {
            // A ROS header ends on 19 January 2038. A later time is that moment.
            sec: seconds.clamp(i32::MIN.into(), i32::MAX.into()) as i32,
            nanosec: ns.rem_euclid(1_000_000_000) as u32,
        }
    }
}

impl Header {
    /// The header of a message of `sensor`.
    pub fn new(time: Timestamp, sensor: &str) -> Self {
        Self {
            stamp: Time::new(time),
            frame_id: sensor.to_owned(),
        }
    }

    /// The time, unless its nanoseconds are no part of a second.
    pub fn time(&self) -> Option<Timestamp> {
        let nanosec = i32::try_from(self.stamp.nanosec).ok()?;
        Timestamp::new(i64::from(self.stamp.sec), nanosec).ok()
    }
}

/// Bytes that are written in one piece, because writing one element at a time is slow.
#[derive(Debug)]
pub struct Blob(pub Vec<u8>);

impl Serialize for Blob {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_bytes(&self.0)
    }
}

impl<'de> Deserialize<'de> for Blob {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Bytes;
        impl Visitor<'_> for Bytes {
            type Value = Blob;

            fn expecting(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                out.write_str("bytes")
            }

            fn visit_byte_buf<E>(self, bytes: Vec<u8>) -> Result<Blob, E> {
                Ok(Blob(bytes))
            }
        }
        deserializer.deserialize_byte_buf(Bytes)
    }
}

#[derive(Debug, Serialize)]
struct HardnessMessage<'a> {
    header: Header,
    seq: u64,
    sensor: &'a str,
    time: String,
    press: u64,
    phase: String,
    level: u8,
    label: &'a str,
    rejected: String,
    notes: Vec<String>,
    probabilities: &'a [f32],
    confidence: f32,
    frame: u64,
    contact_area_taxels: u32,
    contact_area_mm2: f64,
    force_n: f64,
    model: &'a str,
    state: String,
    context: String,
    mono_ns: u64,
    age_at_publish_ms: f64,
    latency_us: u64,
    shore: f64,
    shore_low: f64,
    shore_high: f64,
    levels: Blob,
    course: String,
    stiffness_n_per_mm: f64,
    references: String,
    object: &'a str,
    object_presses: u64,
    object_level: u8,
    object_probabilities: &'a [f32],
    object_shore: f64,
    object_shore_low: f64,
    object_shore_high: f64,
}

#[derive(Debug, Serialize)]
struct PressMessage<'a> {
    header: Header,
    seq: u64,
    sensor: &'a str,
    time: String,
    press: u64,
    state: String,
    frame: u64,
    reason: &'a str,
    frames: u64,
    context: String,
}

#[derive(Debug, Serialize)]
struct StatusMessage<'a> {
    header: Header,
    seq: u64,
    sensor: &'a str,
    time: String,
    state: String,
    reason: &'a str,
    frames: u64,
    frames_damaged: u64,
    bytes_skipped: u64,
    frame_rate_hz: f64,
}

/// The bytes of a message: [`ENCAPSULATION`], then CDR.
pub fn to_cdr(message: &impl Serialize) -> Vec<u8> {
    let mut bytes = ENCAPSULATION.to_vec();
    cdr_encoding::to_writer::<_, LittleEndian, _>(&mut bytes, message)
        .expect("a message has only what CDR knows, and memory takes it");
    bytes
}

fn context(context: Option<&Value>) -> String {
    context.map_or_else(String::new, Value::to_string)
}

/// Every message that a recording or a viewer such as Foxglove holds of an event. A frame has three
/// messages. `pitch` is that of the sensor's taxels.
pub fn encode_all(event: &Event, pitch: Pitch) -> Vec<(Topic, Timestamp, Vec<u8>)> {
    let mut messages = vec![encode(event)];
    if let Event::Frame(frame) = event {
        messages.extend([frame::contact(frame), frame::grid(frame, pitch)]);
    }
    messages
}

/// The main message of an event, with its channel and its time.
pub fn encode(event: &Event) -> (Topic, Timestamp, Vec<u8>) {
    match event {
        Event::Frame(frame) => frame::image(frame),
        Event::Hardness(verdict) => {
            let shore = verdict.shore;
            let object = verdict.object.as_ref();
            let of_object = object.and_then(|object| object.shore);
            let message = HardnessMessage {
                header: Header::new(verdict.time, &verdict.sensor),
                seq: verdict.seq.unwrap_or(0),
                sensor: &verdict.sensor,
                time: event::time_text(verdict.time),
                press: verdict.press,
                phase: name(&verdict.phase),
                level: verdict.level.unwrap_or(0),
                label: verdict.label.as_deref().unwrap_or_default(),
                rejected: verdict.rejected.as_ref().map_or_else(String::new, name),
                notes: verdict.notes.iter().map(name).collect(),
                probabilities: &verdict.probabilities,
                confidence: verdict.confidence,
                frame: verdict.frame,
                contact_area_taxels: verdict.contact_area_taxels,
                contact_area_mm2: verdict.contact_area_mm2,
                force_n: verdict.force_n,
                model: &verdict.model,
                state: name(&verdict.state),
                context: context(verdict.context.as_ref()),
                mono_ns: verdict.mono_ns.unwrap_or(0),
                age_at_publish_ms: verdict.age_at_publish_ms.unwrap_or(f64::NAN),
                latency_us: verdict.latency_us.unwrap_or(0),
                shore: shore.map_or(f64::NAN, |shore| shore.value.into()),
                shore_low: shore.map_or(f64::NAN, |shore| shore.low.into()),
                shore_high: shore.map_or(f64::NAN, |shore| shore.high.into()),
                levels: Blob(verdict.levels.clone().unwrap_or_default()),
                course: verdict.course.as_ref().map_or_else(String::new, name),
                stiffness_n_per_mm: verdict.stiffness_n_per_mm.unwrap_or(f64::NAN),
                references: name(&verdict.references),
                object: object.map_or("", |object| &object.name),
                object_presses: object.map_or(0, |object| object.presses),
                object_level: object.map_or(0, |object| object.level),
                object_probabilities: object.map_or(&[], |object| &object.probabilities),
                object_shore: of_object.map_or(f64::NAN, |shore| shore.value.into()),
                object_shore_low: of_object.map_or(f64::NAN, |shore| shore.low.into()),
                object_shore_high: of_object.map_or(f64::NAN, |shore| shore.high.into()),
            };
            (HARDNESS, verdict.time, to_cdr(&message))
        }
        Event::Press(press) => {
            let message = PressMessage {
                header: Header::new(press.time, &press.sensor),
                seq: press.seq.unwrap_or(0),
                sensor: &press.sensor,
                time: event::time_text(press.time),
                press: press.press,
                state: name(&press.state),
                frame: press.frame,
                reason: press.reason.unwrap_or_default(),
                frames: press.frames,
                context: context(press.context.as_ref()),
            };
            (PRESS, press.time, to_cdr(&message))
        }
        Event::Status(status) => {
            let message = StatusMessage {
                header: Header::new(status.time, &status.sensor),
                seq: status.seq.unwrap_or(0),
                sensor: &status.sensor,
                time: event::time_text(status.time),
                state: name(&status.state),
                reason: status.reason.as_deref().unwrap_or_default(),
                frames: status.frames,
                frames_damaged: status.frames_damaged,
                bytes_skipped: status.bytes_skipped,
                frame_rate_hz: status.frame_rate_hz.unwrap_or(f64::NAN),
            };
            (STATUS, status.time, to_cdr(&message))
        }
    }
}
