//! What subscribers read beside events: who is speaking, answers to commands, and what they miss.

use serde::Serialize;

use super::line;
use crate::tare::Offsets;

/// What is not an event of a sensor: `hello`, `gap`, `error` and `ok`.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "type", rename_all = "lowercase")]
pub enum Reply {
    /// First line of every connection.
    Hello(Hello),
    /// Events this subscriber will not get.
    Gap {
        /// How many of its subscribed kinds; null: unknown.
        lost: Option<u64>,
    },
    /// A line could not be used, or there is no room.
    Error {
        /// What was found and what was expected.
        message: String,
        /// The `id` of the line, echoed.
        #[serde(skip_serializing_if = "Option::is_none")]
        id: Option<serde_json::Value>,
    },
    /// A command was carried out.
    Ok {
        /// The `id` of the line, echoed.
        #[serde(skip_serializing_if = "Option::is_none")]
        id: Option<serde_json::Value>,
        /// What a `tare` did.
        #[serde(skip_serializing_if = "Option::is_none")]
        tare: Option<Tared>,
        /// Where a `blackbox` was written.
        #[serde(skip_serializing_if = "Option::is_none")]
        blackbox: Option<String>,
    },
}

/// A tare taken on request.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Tared {
    /// Sensor's name.
    pub sensor: String,
    /// The offsets before.
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

/// Who is speaking, and of what.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Hello {
    /// [`PROTOCOL`](super::PROTOCOL).
    pub protocol: u32,
    /// `hardnessd`.
    pub server: &'static str,
    /// Version of the daemon.
    pub version: &'static str,
    /// Name of the robot.
    pub robot: String,
    /// Random, of this start of the daemon.
    pub run: String,
    /// The kernel's boot id.
    pub boot_id: String,
    /// Latest number given.
    pub seq: u64,
    /// The sensors served.
    pub sensors: Vec<SensorCard>,
    /// The model in use.
    pub model: ModelCard,
}

/// A sensor as announced in `hello`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SensorCard {
    /// Its name.
    pub name: String,
    /// Rows of the array itself.
    pub rows: usize,
    /// Columns of the array itself.
    pub cols: usize,
    /// Distance of taxel centres.
    pub pitch_mm: f64,
}

/// The model as announced in `hello`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ModelCard {
    /// SHA-256 of the model's file.
    pub sha256: String,
    /// What it was validated on, such as "simulated data only".
    pub validation: String,
    /// Its levels.
    pub levels: Vec<crate::verdict::Level>,
}
