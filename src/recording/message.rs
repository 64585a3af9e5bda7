//! The messages of a recording: ROS 2 definitions, and bytes by them (CDR, little-endian).
//!
//! Every message begins with a `std_msgs/Header`: the moment in UTC and the sensor's name. What is
//! null in an event is 0, NaN or an empty string here, for a ROS message knows no null.

use byteorder::LittleEndian;
use jiff::Timestamp;
use serde::de::{DeserializeOwned, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::Value;

use super::{Entry, Error, Input, Sensor, State};
use crate::event;
use crate::frame::{COLS, ROWS, Stamp};

/// What every message stands after: CDR, little-endian, no options (DDS-XTYPES 1.3, 7.6.3.1.2).
const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// A channel of a sensor: `/tactile/SENSOR/NAME`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Topic {
    pub(super) name: &'static str,
    pub(super) schema: &'static str,
    definition: &'static str,
}

/// The channels of a sensor, in the order of their numbers. It only grows: `recover` tells the
/// channels of a damaged file by it.
pub(super) const TOPICS: [Topic; 5] = [INPUT, FRAME, HARDNESS, PRESS, STATUS];

pub(super) const INPUT: Topic = Topic {
    name: "input",
    schema: "tactile_interfaces/msg/Input",
    definition: "\
uint8 BYTES=0
uint8 OPENED=1
uint8 UNAVAILABLE=2
uint8 LOST=3
uint8 TICK=4
uint8 TARE=5
uint8 CONTEXT=6
uint8 SHUTDOWN=7
uint8 SETTINGS=8
uint8 STATE=9
std_msgs/Header header
uint64 mono_ns
uint8 kind
uint8[] data
",
};

pub(super) const FRAME: Topic = Topic {
    name: "frame",
    schema: "sensor_msgs/msg/Image",
    definition: "\
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
",
};

pub(super) const HARDNESS: Topic = Topic {
    name: "hardness",
    schema: "tactile_interfaces/msg/Hardness",
    definition: "\
std_msgs/Header header
uint64 seq
string sensor
string time
uint64 press
string phase
uint8 level
string label
string rejected
string[] notes
float32[] probabilities
float32 confidence
uint64 frame
uint32 contact_area_taxels
float64 contact_area_mm2
float64 force_n
string model
string state
string context
uint64 mono_ns
float64 age_at_publish_ms
uint64 latency_us
",
};

pub(super) const PRESS: Topic = Topic {
    name: "press",
    schema: "tactile_interfaces/msg/Press",
    definition: "\
std_msgs/Header header
uint64 seq
string sensor
string time
uint64 press
string state
uint64 frame
string reason
uint64 frames
string context
",
};

pub(super) const STATUS: Topic = Topic {
    name: "status",
    schema: "tactile_interfaces/msg/Status",
    definition: "\
std_msgs/Header header
uint64 seq
string sensor
string time
string state
string reason
uint64 frames
uint64 frames_damaged
uint64 bytes_skipped
float64 frame_rate_hz
",
};

impl Topic {
    /// The definition with those it refers to, as `ros2msg` has it.
    pub(super) fn text(&self) -> String {
        let rule = "=".repeat(80);
        format!(
            "{}{rule}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n\
             {rule}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
            self.definition
        )
    }
}

#[derive(Debug, Serialize, Deserialize)]
struct Header {
    stamp: Time,
    frame_id: String,
}

#[derive(Debug, Serialize, Deserialize)]
struct Time {
    sec: i32,
    nanosec: u32,
}

impl Header {
    fn new(time: Timestamp, sensor: &str) -> Self {
        // Seconds and nanoseconds of ROS count from the same second on; before 1970 ours do not.
        let ns = time.as_nanosecond();
        Self {
            stamp: Time {
                sec: ns.div_euclid(1_000_000_000) as i32,
                nanosec: ns.rem_euclid(1_000_000_000) as u32,
            },
            frame_id: sensor.to_owned(),
        }
    }

    fn time(&self) -> Option<Timestamp> {
        let nanosec = i32::try_from(self.stamp.nanosec).ok()?;
        Timestamp::new(i64::from(self.stamp.sec), nanosec).ok()
    }
}

/// Bytes as one run: an element at a time is slow.
#[derive(Debug)]
struct Blob(Vec<u8>);

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

#[derive(Debug, Serialize, Deserialize)]
struct InputMessage {
    header: Header,
    mono_ns: u64,
    kind: u8,
    data: Blob,
}

#[derive(Debug, Serialize)]
struct ImageMessage {
    header: Header,
    height: u32,
    width: u32,
    encoding: &'static str,
    is_bigendian: u8,
    step: u32,
    data: Blob,
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

fn to_cdr(message: &impl Serialize) -> Vec<u8> {
    let mut bytes = ENCAPSULATION.to_vec();
    cdr_encoding::to_writer::<_, LittleEndian, _>(&mut bytes, message)
        .expect("a message has only what CDR knows, and memory takes it");
    bytes
}

fn from_cdr<M: DeserializeOwned>(bytes: &[u8]) -> Result<M, Error> {
    let foreign = |found: String| Error::Foreign {
        found,
        expected: "a message of ours",
    };
    let body = bytes
        .strip_prefix(&ENCAPSULATION)
        .ok_or_else(|| foreign("bytes that are no little-endian CDR".to_owned()))?;
    cdr_encoding::from_bytes::<M, LittleEndian>(body)
        .map(|(message, _)| message)
        .map_err(|error| foreign(format!("another message ({error})")))
}

fn json(value: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec(value).expect("plain structs of numbers and strings always serialise")
}

/// A state without data, by the name it is published under.
fn name(state: &impl Serialize) -> String {
    match serde_json::to_value(state) {
        Ok(Value::String(name)) => name,
        other => unreachable!("a state without data is published as its name, not {other:?}"),
    }
}

fn context(context: Option<&Value>) -> String {
    context.map_or_else(String::new, Value::to_string)
}

/// What happened to `sensor` at `at`.
pub(super) fn encode_entry(sensor: &str, at: Stamp, entry: &Entry) -> Vec<u8> {
    let text = |text: &str| text.as_bytes().to_vec();
    let (kind, data) = match entry {
        Entry::Input(Input::Bytes(bytes)) => (0, bytes.to_vec()),
        Entry::Input(Input::Opened) => (1, Vec::new()),
        Entry::Input(Input::Unavailable(reason)) => (2, text(reason)),
        Entry::Input(Input::Lost(reason)) => (3, text(reason)),
        Entry::Input(Input::Tick) => (4, Vec::new()),
        Entry::Input(Input::Tare) => (5, Vec::new()),
        Entry::Input(Input::Context(context)) => (6, json(context)),
        Entry::Input(Input::Shutdown) => (7, Vec::new()),
        Entry::Settings(sensor) => (8, json(sensor)),
        Entry::State(state) => (9, json(state)),
    };
    to_cdr(&InputMessage {
        header: Header::new(at.wall, sensor),
        mono_ns: u64::try_from(at.mono.as_nanos()).unwrap_or(u64::MAX),
        kind,
        data: Blob(data),
    })
}

/// Back again: the sensor, the moment, and what happened.
pub(super) fn decode_entry(bytes: &[u8]) -> Result<(String, Stamp, Entry), Error> {
    let message: InputMessage = from_cdr(bytes)?;
    let foreign = |found: String| Error::Foreign {
        found,
        expected: "an input of this version",
    };
    let wall = message
        .header
        .time()
        .ok_or_else(|| foreign("a time that is none".to_owned()))?;
    let at = Stamp {
        mono: std::time::Duration::from_nanos(message.mono_ns),
        wall,
    };
    let data = message.data.0;
    let text = |data: Vec<u8>| String::from_utf8_lossy(&data).into_owned().into();
    let unreadable = |error: serde_json::Error| foreign(format!("other JSON ({error})"));
    let entry = match message.kind {
        0 => Entry::Input(Input::Bytes(data.into())),
        1 => Entry::Input(Input::Opened),
        2 => Entry::Input(Input::Unavailable(text(data))),
        3 => Entry::Input(Input::Lost(text(data))),
        4 => Entry::Input(Input::Tick),
        5 => Entry::Input(Input::Tare),
        6 => {
            let context: Option<Value> = serde_json::from_slice(&data).map_err(unreadable)?;
            Entry::Input(Input::Context(context))
        }
        7 => Entry::Input(Input::Shutdown),
        8 => {
            let sensor: Sensor = serde_json::from_slice(&data).map_err(unreadable)?;
            Entry::Settings(Box::new(sensor))
        }
        9 => {
            let state: State = serde_json::from_slice(&data).map_err(unreadable)?;
            Entry::State(Box::new(state))
        }
        other => return Err(foreign(format!("an input of kind {other}"))),
    };
    Ok((message.header.frame_id, at, entry))
}

/// The sensor that any message of ours speaks of.
pub(super) fn sensor_of(bytes: &[u8]) -> Option<String> {
    from_cdr::<Header>(bytes).ok().map(|header| header.frame_id)
}

/// An event, with its channel and its time.
pub(super) fn encode_event(event: &event::Event) -> (Topic, Timestamp, Vec<u8>) {
    match event {
        event::Event::Frame(frame) => {
            let bytes = frame.newtons.iter().flat_map(|n| n.to_le_bytes()).collect();
            let message = ImageMessage {
                header: Header::new(frame.time, &frame.sensor),
                height: ROWS as u32,
                width: COLS as u32,
                encoding: "32FC1",
                is_bigendian: 0,
                step: (COLS * size_of::<f32>()) as u32,
                data: Blob(bytes),
            };
            (FRAME, frame.time, to_cdr(&message))
        }
        event::Event::Hardness(verdict) => {
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
            };
            (HARDNESS, verdict.time, to_cdr(&message))
        }
        event::Event::Press(press) => {
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
        event::Event::Status(status) => {
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
