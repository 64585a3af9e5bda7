//! Events as ROS 2 messages: their definitions, and their bytes (CDR, little-endian).
//!
//! In: events. Out: the messages that recordings hold and ROS 2 subscribers get. Every message
//! begins with a `std_msgs/Header`: the moment in UTC and the sensor's name. A ROS message has no
//! null, so a null of an event becomes 0, NaN or an empty string.

mod frame;

use byteorder::LittleEndian;
use jiff::Timestamp;
use serde::ser::SerializeTuple as _;
use serde::{Deserialize, Serialize, Serializer};
use serde_json::Value;

pub use self::frame::{CONTACT, FRAME};
use crate::event::Event;

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
pub type Blob = serde_bytes::ByteBuf;

/// The bytes of a message: [`ENCAPSULATION`], then CDR.
pub fn to_cdr(message: &impl Serialize) -> Vec<u8> {
    let mut bytes = ENCAPSULATION.to_vec();
    cdr_encoding::to_writer::<_, LittleEndian, _>(&mut bytes, message)
        .expect("a message has only what CDR knows, and memory takes it");
    bytes
}

/// A message whose fields have the names of an event's: a header, then the values of the event. A field
/// such as `shore_low` is the field `low` of the event's `shore`.
struct Named<'a> {
    topic: Topic,
    header: Header,
    event: &'a Value,
}

impl Serialize for Named<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let definition = self.topic.definition.lines();
        let fields = definition.filter(|line| !line.starts_with('#'));
        let mut message = serializer.serialize_tuple(fields.clone().count())?;
        for field in fields {
            let (kind, name) = field
                .split_once(' ')
                .expect("a field has a type and a name");
            let value = value_of(self.event, name);
            let list = || value.as_array().into_iter().flatten();
            let float = |value: &Value| value.as_f64().unwrap_or(f64::NAN);
            match kind {
                "std_msgs/Header" => message.serialize_element(&self.header)?,
                "bool" => message.serialize_element(&value.as_bool().unwrap_or(false))?,
                "uint8" => message.serialize_element(&(whole(value) as u8))?,
                "uint32" => message.serialize_element(&(whole(value) as u32))?,
                "uint64" => message.serialize_element(&whole(value))?,
                "float32" => message.serialize_element(&(float(value) as f32))?,
                "float64" => message.serialize_element(&float(value))?,
                "string" => message.serialize_element(&text(value))?,
                "string[]" => {
                    message.serialize_element(&list().map(text).collect::<Vec<_>>())?;
                }
                "uint8[]" => {
                    let bytes = list().map(|value| whole(value) as u8);
                    message.serialize_element(&bytes.collect::<Vec<_>>())?;
                }
                "float32[]" => {
                    let numbers = list().map(|value| float(value) as f32);
                    message.serialize_element(&numbers.collect::<Vec<_>>())?;
                }
                other => unreachable!("no message of an event has a field of the type {other}"),
            }
        }
        message.end()
    }
}

/// The value of a field. Of an object it is the name or the value.
fn value_of<'a>(event: &'a Value, name: &str) -> &'a Value {
    if let Some(value) = event.get(name) {
        let own = value.get("name").or_else(|| value.get("value"));
        return own.filter(|_| name != "context").unwrap_or(value);
    }
    let mut borders = name.match_indices('_');
    borders
        .find_map(|(at, _)| Some(value_of(event.get(&name[..at])?, &name[at + 1..])))
        .unwrap_or(&Value::Null)
}

fn whole(value: &Value) -> u64 {
    value.as_u64().unwrap_or(0)
}

fn text(value: &Value) -> String {
    match value {
        Value::Null => String::new(),
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}

fn named(
    topic: Topic,
    time: Timestamp,
    sensor: &str,
    event: &impl Serialize,
) -> (Topic, Timestamp, Vec<u8>) {
    let event = serde_json::to_value(event).expect("an event is JSON");
    let message = Named {
        topic,
        header: Header::new(time, sensor),
        event: &event,
    };
    (topic, time, to_cdr(&message))
}

/// Every message that a recording or a viewer such as Foxglove holds of an event, each with its channel and its
/// time. A frame has two.
pub fn encode_all(event: &Event) -> Vec<(Topic, Timestamp, Vec<u8>)> {
    match event {
        Event::Frame(frame) => vec![frame::image(frame), frame::contact(frame)],
        Event::Hardness(verdict) => vec![named(HARDNESS, verdict.time, &verdict.sensor, verdict)],
        Event::Press(press) => vec![named(PRESS, press.time, &press.sensor, press)],
        Event::Status(status) => vec![named(STATUS, status.time, &status.sensor, status)],
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn a_message_has_the_values_of_an_event_in_the_order_of_its_definition() {
        let topic = Topic {
            definition: "# Words\nstd_msgs/Header header\nuint64 seq\nstring[] notes\nuint8[] levels\n\
                         float64 shore\nfloat64 shore_low\nstring object\nfloat64 object_shore_low\n\
                         string context\nfloat32 confidence\nstring reason\n",
            ..HARDNESS
        };
        let event = json!({
            "notes": ["at_edge"],
            "levels": [2, 3],
            "shore": {"value": 61.5, "low": 55.0},
            "object": {"name": "cup", "shore": null},
            "context": {"name": "x"},
            "confidence": 0.5,
            "reason": null,
        });
        let (_, _, bytes) = named(topic, Timestamp::UNIX_EPOCH, "forearm", &event);
        type Numbers = (u64, Vec<String>, Vec<u8>, f64, f64);
        type Texts = (String, f64, String, f32, String);
        let read = cdr_encoding::from_bytes::<_, LittleEndian>(&bytes[4..]);
        let (header, numbers, texts): (Header, Numbers, Texts) = read.unwrap().0;
        assert_eq!(header.frame_id, "forearm");
        let notes = vec!["at_edge".to_owned()];
        assert_eq!(numbers, (0, notes, vec![2, 3], 61.5, 55.0));
        let (object, low, context, confidence, reason) = texts;
        assert!(low.is_nan());
        let texts = [object, context, reason];
        assert_eq!(
            (texts, confidence),
            (["cup", r#"{"name":"x"}"#, ""].map(str::to_owned), 0.5)
        );
    }
}
