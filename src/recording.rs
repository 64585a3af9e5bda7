//! Recordings: what sensors sent and when, as MCAP files that ROS tools open.
//!
//! In: what happens to a sensor's pipeline ([`Input`]) and the events that came of it. Out: bytes
//! of a file, and back: the inputs, which a [`Playback`] turns into the very same events. A file
//! can be played from its first [`State`] of a sensor on, and has one every few seconds, so that a
//! damaged stretch costs no more than itself. Nothing here opens a file or asks the time; MCAP is
//! named in no other module.

mod message;
mod playback;
mod reader;
mod recover;
mod ring;
mod writer;

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use self::playback::{Playback, PlaybackError};
pub use self::reader::{Found, Reader};
pub use self::recover::{RecoverError, Recovered, recover};
pub use self::ring::Ring;
pub use self::writer::{About, Writer};
use crate::event::{self, Event};
use crate::frame::Stamp;
use crate::pipeline::{self, Criteria, Pipeline};
use crate::verdict::Hrn;
use crate::{press, tare, wire};

/// One thing that happens to a pipeline. Beside these only its settings change
/// ([`Entry::Settings`]).
#[derive(Debug, Clone, PartialEq)]
pub enum Input<'a> {
    /// The port is open.
    Opened,
    /// The port could not be opened, and why.
    Unavailable(Cow<'a, str>),
    /// Bytes came.
    Bytes(Cow<'a, [u8]>),
    /// Time has passed.
    Tick,
    /// The device is gone, and why.
    Lost(Cow<'a, str>),
    /// A tare was asked for.
    Tare,
    /// What the controller says it is doing.
    Context(Option<Value>),
    /// The daemon stops.
    Shutdown,
}

impl Input<'_> {
    /// Passes it on to `pipeline`. Whether a tare could be taken only [`Pipeline::retare`] says.
    pub fn feed(self, pipeline: &mut Pipeline, at: Stamp) -> Vec<Event> {
        match self {
            Input::Opened => pipeline.opened(at),
            Input::Unavailable(reason) => pipeline.unavailable(reason.into_owned(), at),
            Input::Bytes(bytes) => pipeline.push(&bytes, at),
            Input::Tick => pipeline.tick(at),
            Input::Lost(reason) => pipeline.lost(reason.into_owned(), at),
            Input::Tare => {
                // A refusal changes nothing and publishes nothing.
                let _ = pipeline.retare();
                Vec::new()
            }
            Input::Context(context) => {
                pipeline.set_context(context);
                Vec::new()
            }
            Input::Shutdown => pipeline.shutdown(),
        }
    }

    /// The same, borrowing nothing.
    pub fn to_owned(&self) -> Input<'static> {
        let text = |text: &Cow<'_, str>| Cow::Owned(text.clone().into_owned());
        match self {
            Input::Opened => Input::Opened,
            Input::Unavailable(reason) => Input::Unavailable(text(reason)),
            Input::Bytes(bytes) => Input::Bytes(Cow::Owned(bytes.clone().into_owned())),
            Input::Tick => Input::Tick,
            Input::Lost(reason) => Input::Lost(text(reason)),
            Input::Tare => Input::Tare,
            Input::Context(context) => Input::Context(context.clone()),
            Input::Shutdown => Input::Shutdown,
        }
    }
}

/// What a recording holds of one sensor, in order.
#[derive(Debug, Clone, PartialEq)]
pub enum Entry {
    /// Something happened to it.
    Input(Input<'static>),
    /// It was judged otherwise from then on: the configuration was read again.
    Settings(Box<Sensor>),
    /// How its pipeline stood then.
    State(Box<State>),
}

impl Entry {
    /// About how much memory it takes with its moment, in bytes.
    pub(crate) fn weight(&self) -> usize {
        let beside = match self {
            Entry::Input(Input::Bytes(bytes)) => bytes.len(),
            Entry::Input(Input::Unavailable(reason) | Input::Lost(reason)) => reason.len(),
            Entry::Input(Input::Context(context)) => context.as_ref().map_or(0, heap_bytes),
            Entry::Input(_) => 0,
            Entry::Settings(sensor) => text_bytes(sensor),
            Entry::State(state) => text_bytes(state) + state.memory.context().map_or(0, heap_bytes),
        };
        size_of::<(Stamp, Self)>() + beside
    }
}

/// As JSON: of numbers in lists, which is most of a state, about what they take in memory.
fn text_bytes(value: &impl Serialize) -> usize {
    serde_json::to_vec(value).map_or(0, |text| text.len())
}

/// What a value takes beside itself: small objects take many times their text.
fn heap_bytes(value: &Value) -> usize {
    match value {
        Value::Null | Value::Bool(_) | Value::Number(_) => 0,
        Value::String(text) => text.len(),
        Value::Array(items) => {
            size_of_val(items.as_slice()) + items.iter().map(heap_bytes).sum::<usize>()
        }
        Value::Object(fields) => {
            // A B-tree's nodes have 11 places, of which 5 may be taken.
            let places = 11 * fields.len().div_ceil(5);
            let held = fields
                .iter()
                .map(|(key, value)| key.len() + heap_bytes(value));
            places * size_of::<(String, Value)>() + held.sum::<usize>()
        }
    }
}

/// A sensor, as far as a replay has to know it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sensor {
    /// Its name.
    pub name: String,
    /// Expected rate.
    pub frame_rate_hz: f64,
    /// How its frames are written.
    pub frame: wire::Settings,
    /// Counts to newtons.
    pub calibration: tare::Settings,
    /// What a press is.
    pub press: press::Settings,
    /// A verdict below this confidence is rejected.
    pub min_confidence: f32,
    /// A verdict on less force is rejected.
    pub min_force_n: f64,
    /// SHA-256 of the model that judged.
    pub model: String,
}

/// Why a sensor's description in a recording cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SensorError {
    /// Its name.
    #[error("name: found {0:?}, expected [a-z][a-z0-9_]*")]
    Name(String),
    /// Its layout.
    #[error("frame.{0}")]
    Frame(#[from] wire::LayoutError),
    /// Its calibration.
    #[error("calibration.{0}")]
    Calibration(#[from] tare::SettingsError),
    /// Its presses.
    #[error("press.{0}")]
    Press(#[from] press::SettingsError),
    /// A rate no sensor has.
    #[error("frame_rate_hz: found {0}, expected frames a second above 0")]
    FrameRate(f64),
    /// What its pipeline is said to have seen.
    #[error("memory: found what no pipeline can have come to, expected the memory of one")]
    Memory,
}

impl Sensor {
    /// The settings of its pipeline; `hrn` judges.
    ///
    /// # Errors
    ///
    /// If a value is out of its range.
    pub fn settings(&self, hrn: &Arc<Hrn>) -> Result<pipeline::Settings, SensorError> {
        if !event::is_sensor_name(&self.name) {
            return Err(SensorError::Name(self.name.clone()));
        }
        let layout = wire::Layout::new(&self.frame)?;
        self.calibration.check(layout.array())?;
        self.press.check()?;
        let hz = self.frame_rate_hz;
        // The bounds of the configuration, with room.
        if !(1e-3..=1e6).contains(&hz) {
            return Err(SensorError::FrameRate(hz));
        }
        Ok(pipeline::Settings {
            sensor: self.name.clone(),
            frame_rate_hz: hz,
            layout,
            criteria: self.criteria(hrn),
        })
    }

    /// The part of them that may change.
    pub fn criteria(&self, hrn: &Arc<Hrn>) -> Criteria {
        Criteria {
            calibration: self.calibration.clone(),
            press: self.press.clone(),
            min_confidence: self.min_confidence,
            min_force_n: self.min_force_n,
            hrn: hrn.clone(),
        }
    }

    /// Takes over what a reload has changed.
    pub fn adopt(&mut self, criteria: &Criteria) {
        self.calibration = criteria.calibration.clone();
        self.press = criteria.press.clone();
        self.min_confidence = criteria.min_confidence;
        self.min_force_n = criteria.min_force_n;
        self.model = criteria.hrn.sha256().to_owned();
    }
}

/// How a sensor's pipeline stood: enough to go on from there.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct State {
    /// The sensor.
    pub sensor: Sensor,
    /// What its pipeline had seen.
    pub memory: pipeline::Memory,
    /// The recording's labels, said again where a checksum guards them.
    pub labels: Labels,
}

/// What every recording begins with.
pub const MAGIC: &[u8] = mcap::MAGIC;

/// What was pressed and whatever else its user wrote down, by key.
pub type Labels = BTreeMap<String, String>;

/// Why a recording cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Reading or writing broke off.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// It is damaged or cut off.
    #[error("{0}: `hardnessd recover` saves what is whole")]
    Damaged(String),
    /// MCAP, but none of ours, or of a later version.
    #[error("found {found}, expected {expected}")]
    Foreign {
        /// What there is.
        found: String,
        /// What there should be.
        expected: &'static str,
    },
}

impl From<mcap::McapError> for Error {
    fn from(error: mcap::McapError) -> Self {
        match error {
            mcap::McapError::Io(error) => Error::Io(error),
            mcap::McapError::BadMagic => Error::Foreign {
                found: "no MCAP file".to_owned(),
                expected: "a recording",
            },
            other => Error::Damaged(format!("found a damaged recording ({other})")),
        }
    }
}

#[cfg(test)]
pub(crate) mod tests;
