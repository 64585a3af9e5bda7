//! Recordings: the bytes of sensors and when they came, as MCAP files that ROS tools open.
//!
//! In: what happens to a sensor's pipeline ([`Input`]), and the events that follow. Out: the bytes
//! of a file. A [`Reader`] returns the inputs, and a [`Playback`] turns them into the same events.
//! A file can be played from the first [`State`] of a sensor on. It has one before each press, so
//! damage costs only the damaged stretch. Nothing here opens a file or asks the time. No other
//! module uses the MCAP library.

mod labels;
mod message;
mod playback;
mod reader;
mod recover;
mod ring;
mod writer;

use std::io::{self, Read};

use serde::{Deserialize, Serialize};

pub use self::labels::{Labels, check_label, misspelt, object_of};
pub use self::message::MOTION;
pub use self::playback::{Playback, PlaybackError};
pub use self::reader::{Found, Reader};
pub use self::recover::{RecoverError, Recovered, recover};
pub use self::ring::Ring;
pub use self::writer::{About, Writer};
use crate::frame::Stamp;
use crate::motion::Point;
use crate::pipeline::{AtRest, Input, Pipeline};
use crate::range::OutOfRange;
use crate::sensor::{Description, Sensor};
use crate::verdict::{Model, References};

/// An entry of a recording for one sensor. Entries are in order of time.
///
/// # Example
///
/// This counts the bytes of a sensor in a recording, and the moments at rest from which it can be played.
///
/// ```no_run
/// use hardnessd_core::pipeline::Input;
/// use hardnessd_core::recording::{Entry, Reader};
///
/// let file = std::fs::File::open("press.mcap")?;
/// let (mut bytes, mut rests) = (0, 0);
/// for found in Reader::new(file) {
///     match found?.entry {
///         Entry::Input(Input::Bytes(chunk)) => bytes += chunk.len(),
///         Entry::State(_) => rests += 1,
///         Entry::Input(_) => {}
///     }
/// }
/// println!("{bytes} bytes, {rests} rests");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub enum Entry {
    /// Something happened to the sensor.
    Input(Input),
    /// The state of the pipeline, which is at rest. Its sensor holds from then on.
    State(Box<State>),
}

/// The most memory of a state, in bytes, unless positions came in a long silence: the gains and the
/// baseline of 4,096 taxels, the references, and what came since the last frame.
const STATE_BYTES: usize = 128 << 10;
/// The most memory of a context for each byte of its text: a list of objects with one number each.
const CONTEXT_BYTES_A_BYTE: usize = 96;

impl Entry {
    /// The approximate memory of the entry in bytes, including its time.
    pub fn weight(&self) -> usize {
        let beside = match self {
            Entry::Input(Input::Bytes(bytes)) => bytes.len(),
            Entry::Input(Input::Unavailable(reason) | Input::Lost(reason)) => reason.len(),
            Entry::Input(Input::Context(context)) => {
                let text = context.as_ref().map(ToString::to_string);
                CONTEXT_BYTES_A_BYTE * text.map_or(0, |text| text.len())
            }
            Entry::Input(Input::Motion(points)) => size_of_val::<[Point]>(points),
            Entry::Input(_) => 0,
            Entry::State(_) => STATE_BYTES,
        };
        size_of::<(Stamp, Self)>() + beside
    }
}

/// The description of a sensor in a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecordedSensor {
    /// The description of the sensor.
    #[serde(flatten)]
    pub description: Description,
    /// The SHA-256 of the model.
    pub model_sha256: String,
    /// The references of the sensor, as the model takes them.
    #[serde(
        default,
        rename = "known_presses",
        skip_serializing_if = "References::is_none"
    )]
    pub references: References,
}

impl RecordedSensor {
    /// The recorded description of `sensor` with the model `hrn`.
    pub fn new(sensor: &Sensor, hrn: &Model) -> Self {
        Self {
            description: sensor.for_recording(),
            model_sha256: hrn.sha256().to_owned(),
            references: hrn.known_references().clone(),
        }
    }

    /// The sensor's name.
    pub fn name(&self) -> &str {
        &self.description.sensor.name
    }

    /// Checks the description and returns the sensor.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Sensor::new`], because a recording may hold anything.
    pub fn check(&self) -> Result<Sensor, OutOfRange> {
        Sensor::new(self.description.clone())
    }
}

/// The version of the format. It rises when an older version cannot be played any more.
pub const FORMAT: u32 = 4;

/// A sensor and the state of its pipeline at rest. Another pipeline can continue from it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct State {
    /// The version of the format.
    pub format: u32,
    /// The sensor.
    pub sensor: RecordedSensor,
    /// The state of the pipeline.
    pub at_rest: AtRest,
    /// The recording's labels. They are repeated here because a checksum covers them here.
    pub labels: Labels,
}

impl State {
    /// The current state of `pipeline`. `None` unless it is at rest.
    pub fn of(pipeline: &Pipeline, labels: &Labels) -> Option<Self> {
        Some(Self {
            format: FORMAT,
            at_rest: pipeline.at_rest()?,
            sensor: RecordedSensor::new(pipeline.sensor(), pipeline.hrn()),
            labels: labels.clone(),
        })
    }
}

/// The first bytes of every recording.
pub const MAGIC: &[u8] = mcap::MAGIC;

/// The kind of a file with a sensor's bytes. Its first bytes decide, not its name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FileKind {
    /// A recording, which is MCAP.
    Recording,
    /// The bytes of a sensor, without anything else.
    Raw,
}

impl FileKind {
    /// The kind of a file that begins with `start`. `start` has at least as many bytes as
    /// [`MAGIC`], or all of a shorter file. A file that is empty or ends within the magic is a
    /// damaged recording.
    ///
    /// # Example
    ///
    /// ```
    /// use hardnessd_core::recording::{FileKind, MAGIC};
    ///
    /// assert_eq!(FileKind::of(MAGIC), FileKind::Recording);
    /// assert_eq!(FileKind::of(&[0xBB, 0xAA, 0x10, 0x03, 0, 0, 0, 0, 0]), FileKind::Raw);
    /// assert_eq!(FileKind::of(b""), FileKind::Recording);
    /// ```
    pub fn of(start: &[u8]) -> Self {
        let start = &start[..start.len().min(MAGIC.len())];
        if MAGIC.starts_with(start) {
            FileKind::Recording
        } else {
            FileKind::Raw
        }
    }

    /// Reads the kind of `source`. The returned reader begins where `source` began, because a pipe
    /// cannot be read twice.
    ///
    /// # Errors
    ///
    /// Returns the errors of reading.
    pub fn read<R: Read>(mut source: R) -> io::Result<(Self, impl Read)> {
        let mut start = Vec::with_capacity(MAGIC.len());
        let most = MAGIC.len() as u64;
        source.by_ref().take(most).read_to_end(&mut start)?;
        Ok((Self::of(&start), io::Cursor::new(start).chain(source)))
    }
}

/// The reason why a recording cannot be written or read.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Reading or writing failed.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The content is damaged, or none of ours.
    #[error("{0}")]
    Content(String),
}

impl From<mcap::McapError> for Error {
    fn from(error: mcap::McapError) -> Self {
        match error {
            mcap::McapError::Io(error) => Error::Io(error),
            mcap::McapError::BadMagic => {
                Error::Content("found no MCAP file, expected a recording".to_owned())
            }
            mcap::McapError::ChunkTooLarge(bytes)
            | mcap::McapError::RecordTooLarge {
                opcode: mcap::records::op::CHUNK,
                len: bytes,
            } => Error::Content(format!(
                "found a chunk of {bytes} bytes, expected at most {}: `mcap recover` rewrites the recording with \
                 chunks that are read",
                reader::LONGEST_CHUNK_BYTES
            )),
            mcap::McapError::UnsupportedCompression(name) => {
                let name: String = name.chars().take(20).collect();
                Error::Content(format!(
                    "found a chunk packed with {name:?}, expected zstd, lz4 or none"
                ))
            }
            other => Error::Content(format!(
                "the recording is damaged ({other}): `hardnessd recover` saves what is whole"
            )),
        }
    }
}

#[cfg(test)]
mod tests;
