//! The published lines beside events: the greeting, answers to commands, and gaps.

use serde::Serialize;

use super::line;
use crate::frame::Pitch;
use crate::tare::Offsets;

/// A line that is not an event of a sensor: `hello`, `gap`, `error` or `ok`.
///
/// # Example
///
/// ```
/// use hardnessd_core::event::Reply;
///
/// let gap = Reply::Gap { lost: Some(3) };
/// assert_eq!(gap.to_line(), "{\"type\":\"gap\",\"lost\":3}\n");
/// ```
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "type", rename_all = "lowercase")]
pub enum Reply {
    /// The first line of every connection.
    Hello(Hello),
    /// Events that this subscriber will not get.
    Gap {
        /// The number of lost events of the subscribed kinds. Null if it is unknown.
        lost: Option<u64>,
    },
    /// A line could not be used, or the server has no room.
    Error {
        /// What was found and what was expected.
        message: String,
        /// The `id` of the line.
        #[serde(skip_serializing_if = "Option::is_none")]
        id: Option<serde_json::Value>,
    },
    /// A command was carried out.
    Ok {
        /// The `id` of the line.
        #[serde(skip_serializing_if = "Option::is_none")]
        id: Option<serde_json::Value>,
        /// The result of a `tare`.
        #[serde(skip_serializing_if = "Option::is_none")]
        tare: Option<Tared>,
        /// The path where a `blackbox` was written.
        #[serde(skip_serializing_if = "Option::is_none")]
        blackbox: Option<String>,
    },
}

/// A tare taken on request.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Tared {
    /// The sensor's name.
    pub sensor: String,
    /// The offsets before the tare.
    pub old: Offsets,
    /// The offsets from the next frame on.
    pub new: Offsets,
}

impl Reply {
    /// The reply as one line, newline included.
    pub fn to_line(&self) -> String {
        line(self)
    }
}

/// The greeting: the server, its sensors and its model.
///
/// # Example
///
/// ```
/// use hardnessd_core::event::{Hello, ModelCard, PROTOCOL, Reply};
///
/// let hello = Hello {
///     protocol: PROTOCOL,
///     server: "hardnessd",
///     version: "0.2.0",
///     robot: "arm-7".to_owned(),
///     run: "5f0c".to_owned(),
///     boot_id: String::new(),
///     seq: 41,
///     sensors: Vec::new(),
///     model: ModelCard {
///         sha256: "0123456789ab".to_owned(),
///         validation: "simulated data only".to_owned(),
///         levels: Vec::new(),
///         name: "built in".to_owned(),
///         needs: "judges single frames, needs no arm".to_owned(),
///         without_effect: Vec::new(),
///     },
/// };
/// let line = Reply::Hello(hello).to_line();
/// assert!(line.starts_with(r#"{"type":"hello","protocol":1,"server":"hardnessd","#));
/// ```
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Hello {
    /// [`PROTOCOL`](super::PROTOCOL).
    pub protocol: u32,
    /// The name of the server: `hardnessd`.
    pub server: &'static str,
    /// The version of the daemon.
    pub version: &'static str,
    /// The name of the robot.
    pub robot: String,
    /// A random token of this start of the daemon.
    pub run: String,
    /// The kernel's boot id.
    pub boot_id: String,
    /// The number of the latest event.
    pub seq: u64,
    /// The sensors of the daemon.
    pub sensors: Vec<SensorCard>,
    /// The model in use.
    pub model: ModelCard,
}

/// A sensor, as announced in `hello`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SensorCard {
    /// The sensor's name.
    pub name: String,
    /// The number of rows of the sensor's own array.
    pub rows: usize,
    /// The number of columns of the sensor's own array.
    pub cols: usize,
    /// The distance between taxel centres.
    pub pitch_mm: Pitch,
}

/// The model, as announced in `hello`.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct ModelCard {
    /// The SHA-256 of the model's file.
    pub sha256: String,
    /// The data of the model's validation, such as "simulated data only".
    pub validation: String,
    /// The model's levels.
    pub levels: Vec<crate::verdict::Level>,
    /// The name of the model's file, or `built in`.
    pub name: String,
    /// What the model judges, and what it needs beside the sensor.
    pub needs: String,
    /// The keys of the configuration that are set and change no verdict of this model.
    pub without_effect: Vec<String>,
}
