//! The published format, protocol 1: one JSON object a line.
//!
//! The format is defined here alone. Within a protocol version, fields may be added, but no field
//! ever changes its meaning. The order of fields is part of the golden bytes. Nothing here decides
//! anything: the pipeline fills events in, and the hub numbers and publishes them.

mod reply;

use std::time::Duration;

use jiff::Timestamp;
use serde::{Serialize, Serializer};
use serde_json::Value;

pub use self::reply::{Hello, ModelCard, Reply, SensorCard, Tared};
use crate::verdict::Shore;
pub use crate::wording::name;

/// The version of the format, as announced in `hello`.
pub const PROTOCOL: u32 = 1;

/// A context, written as JSON without spaces, is shorter than this.
pub const CONTEXT_BYTES: usize = 1024;

/// The most levels of objects and lists in a context. A recording holds a context within a state,
/// and JSON is read only up to 128 levels.
pub const CONTEXT_LEVELS: usize = 16;

/// Checks that a value can be a controller's context.
///
/// # Errors
///
/// Returns the problem, in words, if the value is no object, has [`CONTEXT_BYTES`] or more, or has more
/// than [`CONTEXT_LEVELS`].
pub fn check_context(context: &Value) -> Result<(), String> {
    let (bytes, levels) = (context.to_string().len(), levels(context));
    if !context.is_object() {
        Err("found no object, expected one".to_owned())
    } else if bytes >= CONTEXT_BYTES {
        Err(format!(
            "found {bytes} bytes, expected fewer than {CONTEXT_BYTES}"
        ))
    } else if levels > CONTEXT_LEVELS {
        Err(format!(
            "found {levels} levels, expected at most {CONTEXT_LEVELS}"
        ))
    } else {
        Ok(())
    }
}

/// The levels of objects and lists in a value. A number or a text has none.
fn levels(value: &Value) -> usize {
    match value {
        Value::Array(items) => 1 + items.iter().map(levels).max().unwrap_or(0),
        Value::Object(fields) => 1 + fields.values().map(levels).max().unwrap_or(0),
        _ => 0,
    }
}

/// A numbered or live event of one sensor.
///
/// # Example
///
/// The hub gives a status its number and publishes it as a line.
///
/// ```
/// use hardnessd_core::event::{Event, Kind, LinkState, Status};
///
/// let mut event = Event::Status(Status {
///     seq: None,
///     sensor: "forearm".to_owned(),
///     time: jiff::Timestamp::UNIX_EPOCH,
///     state: LinkState::Live,
///     reason: None,
///     detail: None,
///     frames: 41,
///     frames_damaged: 0,
///     frames_dropped: 0,
///     bytes_skipped: 0,
///     frame_rate_hz: Some(5.0),
/// });
/// event.number(9);
/// assert_eq!((event.kind(), event.seq()), (Kind::Status, Some(9)));
/// assert!(event.to_line().starts_with(r#"{"type":"status","seq":9,"sensor":"forearm","#));
/// ```
#[expect(
    clippy::large_enum_variant,
    reason = "a few hundred bytes, beside a frame's three thousand on the heap"
)]
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "type", rename_all = "lowercase")]
pub enum Event {
    /// The link changed, or a client asked for its status.
    Status(Status),
    /// A press began, ended or was aborted.
    Press(Press),
    /// A press was judged.
    Hardness(Hardness),
    /// One frame. Frames are never numbered.
    Frame(FrameEvent),
}

/// The kinds of [`Event`] that a subscriber may ask for.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, serde::Deserialize, Serialize,
)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// [`Event::Status`]
    Status,
    /// [`Event::Press`]
    Press,
    /// [`Event::Hardness`]
    Hardness,
    /// [`Event::Frame`]
    Frame,
}

impl Kind {
    /// Every kind.
    pub const ALL: [Kind; 4] = [Kind::Status, Kind::Press, Kind::Hardness, Kind::Frame];

    /// The kinds whose events carry a `seq`.
    pub const NUMBERED: [Kind; 3] = [Kind::Status, Kind::Press, Kind::Hardness];
}

impl Event {
    /// The kind of this event.
    pub fn kind(&self) -> Kind {
        match self {
            Event::Status(_) => Kind::Status,
            Event::Press(_) => Kind::Press,
            Event::Hardness(_) => Kind::Hardness,
            Event::Frame(_) => Kind::Frame,
        }
    }

    /// The name of the event's sensor.
    pub fn sensor(&self) -> &str {
        match self {
            Event::Status(event) => &event.sensor,
            Event::Press(event) => &event.sensor,
            Event::Hardness(event) => &event.sensor,
            Event::Frame(event) => &event.sensor,
        }
    }

    /// Gives the event its number in the run. A `frame` has no number and stays unchanged.
    pub fn number(&mut self, seq: u64) {
        match self {
            Event::Status(event) => event.seq = Some(seq),
            Event::Press(event) => event.seq = Some(seq),
            Event::Hardness(event) => event.seq = Some(seq),
            Event::Frame(_) => {}
        }
    }

    /// The event's number in the run, once it has one.
    pub fn seq(&self) -> Option<u64> {
        match self {
            Event::Status(event) => event.seq,
            Event::Press(event) => event.seq,
            Event::Hardness(event) => event.seq,
            Event::Frame(_) => None,
        }
    }

    /// Whether this event holds until the next one of its kind, so that a late viewer gets it. A status
    /// does, and a final verdict.
    pub fn lasts(&self) -> bool {
        match self {
            Event::Hardness(verdict) => verdict.phase == Phase::Final,
            Event::Status(_) => true,
            Event::Press(_) | Event::Frame(_) => false,
        }
    }

    /// The event as one line, newline included.
    pub fn to_line(&self) -> String {
        line(self)
    }
}

/// The state of a sensor's link.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LinkState {
    /// The port was never opened, or has been open without a frame for less than 2.5 periods.
    Connecting,
    /// Frames arrive.
    Live,
    /// The port is open, and the sensor has been silent for too long.
    Stale,
    /// The port was open and is gone.
    Lost,
}

impl LinkState {
    /// Every state.
    pub const ALL: [Self; 4] = [Self::Connecting, Self::Live, Self::Stale, Self::Lost];
}

/// A sensor's link and its counters.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Status {
    /// The event's number in the run. Absent in a status sent on request or after `hello`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seq: Option<u64>,
    /// The sensor's name.
    pub sensor: String,
    /// The time of the frame that caused the status, or else the current time.
    #[serde(serialize_with = "rfc3339")]
    pub time: Timestamp,
    /// The state of the link.
    pub state: LinkState,
    /// The reason for the state, if there is one.
    pub reason: Option<String>,
    /// The number of whole frames since the start.
    pub frames: u64,
    /// The number of damaged frames since the start.
    pub frames_damaged: u64,
    /// The number of whole frames since the start that were dropped because the sensor sent more than
    /// twice its rate. `frames` leaves them out.
    pub frames_dropped: u64,
    /// The number of bytes since the start that belonged to no whole frame.
    pub bytes_skipped: u64,
    /// The frame rate over the last frames. Null before there are two.
    #[serde(serialize_with = "rounded_or_null")]
    pub frame_rate_hz: Option<f64>,
    /// What was found and what to do, where the daemon knows more than the reason says.
    pub detail: Option<String>,
}

/// The state of a press.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum PressState {
    /// The first frame at or above the begin area came.
    Begin,
    /// The press was released, or timed out.
    End,
    /// The press ended without a verdict.
    Aborted,
}

/// A change of a press.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Press {
    /// The event's number in the run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seq: Option<u64>,
    /// The sensor's name.
    pub sensor: String,
    /// The time of `frame`.
    #[serde(serialize_with = "rfc3339")]
    pub time: Timestamp,
    /// The number of the press, from 1, per sensor.
    pub press: u64,
    /// The state of the press.
    pub state: PressState,
    /// The number of the frame that began the press, or of its last frame in contact.
    pub frame: u64,
    /// `timeout`, `short`, `lost`, `shutdown`, `end of recording`, or null.
    pub reason: Option<&'static str>,
    /// The number of frames in contact so far.
    pub frames: u64,
    /// The controller's last context.
    pub context: Option<serde_json::Value>,
}

/// The phase of the press at a verdict.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Phase {
    /// The contact has settled, and the press continues.
    Early,
    /// The press has ended.
    Final,
}

/// The reason why a verdict has no level.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Rejection {
    /// The confidence is below `model.min_confidence`.
    LowConfidence,
    /// The force is below `model.min_force_n`.
    LowForce,
    /// The conformal set holds more than one level.
    Ambiguous,
}

/// What the robot may do to know more of an object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Advice {
    /// Nothing is known of the sensor, and the force was too small for a verdict. No level is named.
    PressHarder,
    /// The verdict is not sure, and another press of the object makes it surer.
    PressAgain,
}

/// The source of the arm's approach.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ApproachSource {
    /// The robot sent positions.
    Positions,
    /// A constant speed was assumed while the contact was loaded.
    Speed,
    /// The approach is unknown.
    None,
}

/// A note on the chosen frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Note {
    /// The contact touches the border of the array.
    AtEdge,
    /// A taxel reads full scale.
    Saturated,
    /// The force, the area or the pitch is outside the range of the model's training.
    OutsideTraining,
    /// The sensor's taxels have another pitch than the model's, so their forces were shared out
    /// over the model's.
    Resampled,
    /// The model takes references, and the sensor has none: what the sensor reads of a known piece is
    /// unknown.
    NotIdentified,
    /// The sensor has references, and they are not used: they make verdicts on themselves worse.
    ReferencesIgnored,
}

/// A verdict.
///
/// # Example
///
/// A recording of two presses on foam has two final verdicts.
///
/// ```
/// use std::sync::Arc;
/// use std::time::Duration;
///
/// use hardnessd_core::event::{Event, Phase};
/// use hardnessd_core::frame::Stamp;
/// use hardnessd_core::pipeline::{Clock, Input, Pipeline};
/// use hardnessd_core::sensor::{Description, Sensor};
/// use hardnessd_core::verdict::{BUILT_IN_HRN, Model};
///
/// let hrn = Arc::new(Model::load(BUILT_IN_HRN)?);
/// let mut pipeline = Pipeline::new(Sensor::new(Description::default())?, hrn, Clock::FrameRate);
/// let at = Stamp {
///     mono: Duration::ZERO,
///     wall: jiff::Timestamp::UNIX_EPOCH,
/// };
/// let bytes = std::fs::read("../../fixtures/foam.5hz.bin")?;
/// let events = pipeline.take(Input::Bytes(bytes), at)?;
/// let labels = events.iter().filter_map(|event| match event {
///     Event::Hardness(verdict) if verdict.phase == Phase::Final => verdict.label.as_deref(),
///     _ => None,
/// });
/// assert_eq!(labels.collect::<Vec<_>>(), ["firm", "firm"]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Hardness {
    /// The event's number in the run.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seq: Option<u64>,
    /// The sensor's name.
    pub sensor: String,
    /// The time of the chosen frame.
    #[serde(serialize_with = "rfc3339")]
    pub time: Timestamp,
    /// The number of the press.
    pub press: u64,
    /// Whether the verdict is early or final.
    pub phase: Phase,
    /// The level, 1..L, or null when rejected.
    pub level: Option<u8>,
    /// The model's label of the level, or null when rejected.
    pub label: Option<String>,
    /// The reason why there is no level.
    pub rejected: Option<Rejection>,
    /// The notes on the chosen frame.
    pub notes: Vec<Note>,
    /// One probability for each level; their sum is 1. Published with six digits after the point.
    #[serde(serialize_with = "millionths")]
    pub probabilities: Vec<f32>,
    /// The largest probability. Published with six digits after the point.
    #[serde(serialize_with = "rounded_6")]
    pub confidence: f32,
    /// The number of the chosen frame, which has the maximal contact area.
    pub frame: u64,
    /// The contact area of the chosen frame in taxels.
    pub contact_area_taxels: u32,
    /// The contact area of the chosen frame in mm2.
    #[serde(serialize_with = "rounded_3")]
    pub contact_area_mm2: f64,
    /// The force of the contact in the chosen frame, in newtons.
    #[serde(serialize_with = "rounded_3")]
    pub force_n: f64,
    /// The first 12 hex digits of the model file's SHA-256.
    pub model: String,
    /// The state of the link.
    pub state: LinkState,
    /// The controller's last context.
    pub context: Option<serde_json::Value>,
    /// CLOCK_MONOTONIC at the arrival of the chosen frame's last byte; null in a replay.
    pub mono_ns: Option<u64>,
    /// The age of the chosen frame at publication; null in a replay.
    pub age_at_publish_ms: Option<f64>,
    /// The time since the arrival of the byte that made the verdict possible; null in a replay.
    pub latency_us: Option<u64>,
    /// The Shore hardness with its 90 % interval; null if the model has no such output.
    #[serde(serialize_with = "shore")]
    pub shore: Option<Shore>,
    /// The levels that the model cannot tell apart; null without a conformal threshold.
    pub levels: Option<Vec<u8>>,
    /// The source of the approach; null unless the model judges courses.
    pub course: Option<ApproachSource>,
    /// The slope of force against indentation at the end of loading; null if unknown.
    #[serde(serialize_with = "rounded_or_null")]
    pub stiffness_n_per_mm: Option<f64>,
    /// The kinds of the references that the model was given: `none`, or some of `own`, `rigid` and `labelled`,
    /// joined by `+`.
    pub references: String,
    /// What the robot may do to know more; null if nothing.
    pub advice: Option<Advice>,
    /// The verdict on the object that the context names, over all its presses so far; null if it
    /// names none.
    pub object: Option<ObjectVerdict>,
    /// The arrival of the byte that made the verdict possible, on CLOCK_MONOTONIC. Not published.
    #[serde(skip)]
    pub arrival: Duration,
}

/// The verdict over all presses of an object so far.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ObjectVerdict {
    /// The name in the context.
    pub name: String,
    /// The number of presses, with this one.
    pub presses: u64,
    /// The most probable level.
    pub level: u8,
    /// One probability for each level. Published with six digits after the point.
    #[serde(serialize_with = "millionths")]
    pub probabilities: Vec<f32>,
    /// The Shore hardness with its 90 % interval; null if the model has no such output.
    #[serde(serialize_with = "shore")]
    pub shore: Option<Shore>,
}

/// One frame in newtons, tared if the first tare has been taken.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameEvent {
    /// The sensor's name.
    pub sensor: String,
    /// The arrival of the frame's last byte.
    #[serde(serialize_with = "rfc3339")]
    pub time: Timestamp,
    /// The number of the frame, from 0, per sensor.
    pub frame: u64,
    /// The rows of the sensor's array.
    pub rows: usize,
    /// The columns of the sensor's array.
    pub cols: usize,
    /// `[rows, cols]` flattened, row-major, rounded to 0.001 N. Noise makes some of them negative.
    #[serde(serialize_with = "millinewtons")]
    pub newtons: Vec<f32>,
    /// The number of taxels at or above the contact threshold.
    pub contact_area_taxels: u32,
    /// The force of the contact in newtons; null until the first tare is taken.
    #[serde(serialize_with = "rounded_or_null")]
    pub force_n: Option<f64>,
    /// False until the first tare is taken: until then, `newtons` contain those of the unloaded
    /// sensor.
    pub tared: bool,
    /// During a press: how far the arm went since the press began, by the positions up to now. This
    /// is for views; the verdict has a more exact value.
    #[serde(serialize_with = "rounded_or_null")]
    pub approach_mm: Option<f64>,
}

fn line<T: Serialize>(value: &T) -> String {
    let text = serde_json::to_string(value);
    text.expect("plain structs of numbers and strings always serialise") + "\n"
}

/// RFC 3339 in UTC with microseconds, so that every time has the same width.
fn rfc3339<S: Serializer>(time: &Timestamp, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_str(&format_args!("{time:.6}"))
}

fn rounded_3<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64(round_3(*value))
}

fn rounded_or_null<S: Serializer>(value: &Option<f64>, serializer: S) -> Result<S::Ok, S::Error> {
    value.map(round_3).serialize(serializer)
}

fn shore<S: Serializer>(shore: &Option<Shore>, serializer: S) -> Result<S::Ok, S::Error> {
    #[derive(Serialize)]
    struct Rounded {
        value: f64,
        low: f64,
        high: f64,
    }
    let rounded = |Shore { value, low, high }: Shore| {
        let [value, low, high] = [value, low, high].map(|n| round_3(f64::from(n)));
        Rounded { value, low, high }
    };
    shore.map(rounded).serialize(serializer)
}

fn millinewtons<S: Serializer>(newtons: &[f32], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(newtons.iter().map(|&n| round_3(f64::from(n))))
}

fn rounded_6<S: Serializer>(value: &f32, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64(round_6(*value))
}

fn millionths<S: Serializer>(values: &[f32], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(values.iter().map(|&value| round_6(value)))
}

/// Rounds to three digits. There is no negative zero.
pub fn round_3(value: f64) -> f64 {
    (value * 1e3).round() / 1e3 + 0.0
}

/// Rounds to six digits. More would mean nothing: an f32 has seven, and a calibrated probability is
/// good for two or three.
fn round_6(value: f32) -> f64 {
    (f64::from(value) * 1e6).round() / 1e6
}
