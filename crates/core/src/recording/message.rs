//! The messages of a recording that hold a sensor's entries. Its events are ROS 2 messages.

use byteorder::LittleEndian;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Entry, Error, FORMAT, Found, State};
use crate::event;
use crate::frame::Stamp;
use crate::motion::Point;
use crate::pipeline::Input;
use crate::ros::{self, Blob, Header, Topic};

/// The channels of a sensor, in the order of their numbers. `recover` numbers the channels of a
/// damaged file by this order.
pub(super) const TOPICS: [Topic; 7] = [
    INPUT,
    MOTION,
    ros::FRAME,
    ros::CONTACT,
    ros::PRESS,
    ros::HARDNESS,
    ros::STATUS,
];

pub(super) const INPUT: Topic = Topic {
    name: "input",
    schema: "tactile_interfaces/msg/Input",
    definition: include_str!("../../../../clients/ros2/tactile_interfaces/msg/Input.msg"),
};

/// The positions of the arm, from the robot.
pub const MOTION: Topic = Topic {
    name: "motion",
    schema: "tactile_interfaces/msg/Motion",
    definition: include_str!("../../../../clients/ros2/tactile_interfaces/msg/Motion.msg"),
};

/// The topic for an entry.
pub(super) fn topic_of(entry: &Entry) -> Topic {
    match entry {
        Entry::Input(Input::Motion(_)) => MOTION,
        _ => INPUT,
    }
}

#[derive(Debug, Serialize, Deserialize)]
struct MotionMessage {
    header: Header,
    mono_ns: u64,
    at_ns: Vec<i64>,
    approach_mm: Vec<f64>,
}

#[derive(Debug, Serialize, Deserialize)]
struct InputMessage {
    header: Header,
    mono_ns: u64,
    kind: u8,
    data: Blob,
}

/// The part of a state that says whether the rest can be read.
#[derive(Deserialize)]
struct Version {
    #[serde(default)]
    format: u32,
}

fn from_cdr<M: DeserializeOwned>(bytes: &[u8]) -> Result<M, Error> {
    let foreign =
        |found: &str| Error::Content(format!("found {found}, expected a message of ours"));
    let body = bytes
        .strip_prefix(&ros::ENCAPSULATION)
        .ok_or_else(|| foreign("bytes that are no little-endian CDR"))?;
    cdr_encoding::from_bytes::<M, LittleEndian>(body)
        .map(|(message, _)| message)
        .map_err(|error| foreign(&format!("another message ({error})")))
}

fn json(value: &impl Serialize) -> Vec<u8> {
    serde_json::to_vec(value).expect("plain structs of numbers and strings always serialise")
}

fn mono_ns(at: Stamp) -> u64 {
    u64::try_from(at.mono.as_nanos()).unwrap_or(u64::MAX)
}

/// The message of an entry of `sensor` at `at`.
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
        Entry::Input(Input::Motion(points)) => {
            return ros::to_cdr(&MotionMessage {
                header: Header::new(at.wall, sensor),
                mono_ns: mono_ns(at),
                at_ns: points.iter().map(|point| point.at_ns).collect(),
                approach_mm: points.iter().map(|point| point.mm).collect(),
            });
        }
        Entry::State(state) => (STATE, json(state)),
        Entry::Input(Input::Skipped(bytes)) => (11, json(bytes)),
    };
    encode(sensor, at, kind, data)
}

/// The kind of a state.
pub(super) const STATE: u8 = 9;

/// A message on [`INPUT`].
pub(super) fn encode(sensor: &str, at: Stamp, kind: u8, data: Vec<u8>) -> Vec<u8> {
    ros::to_cdr(&InputMessage {
        header: Header::new(at.wall, sensor),
        mono_ns: mono_ns(at),
        kind,
        data: Blob::from(data),
    })
}

fn foreign(found: &str) -> Error {
    Error::Content(format!("found {found}, expected an input of this version"))
}

fn check_context(context: Option<&Value>) -> Result<(), Error> {
    let checked = context.map_or(Ok(()), event::check_context);
    checked.map_err(|problem| Error::Content(format!("context: {problem}")))
}

/// The moment of a message. MCAP's own time reaches further than that of a ROS header, but does not
/// know the time before 1970.
fn stamp(header: &Header, mono_ns: u64, log_time_ns: u64) -> Result<Stamp, Error> {
    let wall = match log_time_ns {
        0 => header.time(),
        ns => jiff::Timestamp::from_nanosecond(ns.into()).ok(),
    };
    Ok(Stamp {
        mono: std::time::Duration::from_nanos(mono_ns),
        wall: wall.ok_or_else(|| foreign("an invalid time"))?,
    })
}

/// Reads the sensor, the moment and the positions of the arm from a message on [`MOTION`].
pub(super) fn decode_motion(bytes: &[u8], log_time_ns: u64) -> Result<Found, Error> {
    let message: MotionMessage = from_cdr(bytes)?;
    let at = stamp(&message.header, message.mono_ns, log_time_ns)?;
    let (moments, positions) = (message.at_ns, message.approach_mm);
    let same = moments.len() == positions.len();
    let points = moments.into_iter().zip(positions);
    let points: Vec<Point> = points.map(Point::from).collect();
    if !same || !points.iter().all(Point::is_usable) {
        return Err(foreign("invalid positions"));
    }
    Ok(Found {
        sensor: message.header.frame_id,
        at,
        entry: Entry::Input(Input::Motion(points)),
    })
}

/// Reads the sensor, the moment and the entry from a message on [`INPUT`].
pub(super) fn decode_entry(bytes: &[u8], log_time_ns: u64) -> Result<Found, Error> {
    let message: InputMessage = from_cdr(bytes)?;
    let at = stamp(&message.header, message.mono_ns, log_time_ns)?;
    let data = message.data.into_vec();
    let text = |data: Vec<u8>| String::from_utf8_lossy(&data).into_owned();
    let unreadable = |error: serde_json::Error| foreign(&format!("other JSON ({error})"));
    let entry = match message.kind {
        0 => Entry::Input(Input::Bytes(data)),
        1 => Entry::Input(Input::Opened),
        2 => Entry::Input(Input::Unavailable(text(data))),
        3 => Entry::Input(Input::Lost(text(data))),
        4 => Entry::Input(Input::Tick),
        5 => Entry::Input(Input::Tare),
        6 => {
            let context: Option<Value> = serde_json::from_slice(&data).map_err(unreadable)?;
            check_context(context.as_ref())?;
            Entry::Input(Input::Context(context))
        }
        7 => Entry::Input(Input::Shutdown),
        STATE => {
            let Version { format } = serde_json::from_slice(&data).map_err(unreadable)?;
            if format != FORMAT {
                return Err(Error::Content(format!(
                    "found a recording of format {format}, expected format {FORMAT}: play it with the version \
                     that wrote it"
                )));
            }
            // Not by way of a `Value`, which would turn a number out of range into infinity.
            let state: State = serde_json::from_slice(&data).map_err(unreadable)?;
            check_context(state.at_rest.context())?;
            Entry::State(Box::new(state))
        }
        11 => {
            let bytes: u64 = serde_json::from_slice(&data).map_err(unreadable)?;
            // No line ever delivers so many.
            if bytes > u64::from(u32::MAX) {
                return Err(foreign(&format!("{bytes} bytes at once")));
            }
            Entry::Input(Input::Skipped(bytes))
        }
        other => return Err(foreign(&format!("an input of kind {other}"))),
    };
    let sensor = message.header.frame_id;
    Ok(Found { sensor, at, entry })
}

/// The sensor's name in any message that this program writes.
pub(super) fn sensor_of(bytes: &[u8]) -> Option<String> {
    from_cdr::<Header>(bytes).ok().map(|header| header.frame_id)
}
