//! The reasons that captures cannot be collected.

use std::path::{Path, PathBuf};

use hardnessd_core::recording::{self, PlaybackError};

/// The reason that a capture gives no samples.
#[derive(Debug, thiserror::Error)]
pub enum CollectError {
    /// The capture is missing or unreadable.
    #[error("{path}: {source}")]
    Unreadable {
        /// The capture.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The capture is damaged, or is not a recording of hardnessd.
    #[error("{path}: {source}")]
    Recording {
        /// The capture.
        path: PathBuf,
        /// The reader's error.
        source: recording::Error,
    },
    /// The capture describes an impossible sensor.
    #[error("{path}: {source}")]
    Sensor {
        /// The capture.
        path: PathBuf,
        /// The error of the playback.
        source: PlaybackError,
    },
    /// The level is neither given nor a label.
    #[error("{path}: the recording has no label `level`: give its level with --level")]
    NoLevel {
        /// The capture.
        path: PathBuf,
    },
    /// A label is not a number in its range.
    #[error(
        "{path}: label {key}: found {found}, expected {expected}{}",
        said_too(key)
    )]
    Label {
        /// The capture.
        path: PathBuf,
        /// The label's key.
        key: &'static str,
        /// The value found.
        found: String,
        /// The accepted values.
        expected: &'static str,
    },
    /// The capture has another taxel pitch than the others.
    #[error("{path}: taxel pitch: found {found} mm, expected {expected} mm, that of {first}")]
    Pitch {
        /// The capture.
        path: PathBuf,
        /// The capture's pitch, in mm.
        found: f64,
        /// The pitch of the others, in mm.
        expected: f64,
        /// One of the others, or the data set to which the captures are added.
        first: PathBuf,
    },
    /// An array has values for some samples only. The data set would lose it, because an array has
    /// a value for every sample or is missing.
    #[error(
        "{path}: has no {array}, and {first} has: {}make it a data set of its own (train takes \
         several --data)",
        remedy(array)
    )]
    Lost {
        /// The file without values.
        path: PathBuf,
        /// The array's name.
        array: &'static str,
        /// The file with values.
        first: PathBuf,
    },
    /// The same object is in the training split and in the test split.
    #[error(
        "{path}: object {object} is in the {found} split here, and in the {expected} split in \
         {first}: give it the same --split, because presses of one object are near-copies"
    )]
    Splits {
        /// The capture.
        path: PathBuf,
        /// The object's number.
        object: u32,
        /// The split of the object's presses in this capture.
        found: &'static str,
        /// The split of the object's earlier presses.
        expected: &'static str,
        /// The data set to which the capture is added.
        first: PathBuf,
    },
    /// The same recording was collected before, with the same labels.
    #[error(
        "{path}: the same recording as {first}, whose presses are in the data set already: leave it out, because \
         presses that are there twice count twice"
    )]
    Twice {
        /// The capture.
        path: PathBuf,
        /// The name of the earlier capture.
        first: String,
    },
    /// The capture names a material for which no number is left.
    #[error(
        "{path}: label material: {name:?} is one too many: a data set has at most 256 materials"
    )]
    Materials {
        /// The capture.
        path: PathBuf,
        /// The material.
        name: String,
    },
    /// The sensor was not pressed, or no press was judged.
    #[error(
        "{path}: no press found: was the sensor pressed, and is this its layout? (`hardnessd replay {path}`)"
    )]
    NoPress {
        /// The capture.
        path: PathBuf,
    },
    /// A directory has no recording in it.
    #[error("{path}: no recording is in this directory")]
    Empty {
        /// The directory.
        path: PathBuf,
    },
}

impl CollectError {
    /// The error without the capture's path, for a list that has the path elsewhere.
    pub(super) fn reason(&self, path: &Path) -> String {
        let text = self.to_string();
        let reason = text.strip_prefix(&format!("{}: ", path.display()));
        reason.unwrap_or(&text).to_owned()
    }
}

fn said_too(key: &str) -> String {
    match key {
        "level" | "object" => format!(": --{key} gives another one"),
        _ => String::new(),
    }
}

fn remedy(array: &str) -> String {
    match array {
        "material" | "shore" => format!("record with --label {array}=..., or "),
        _ => String::new(),
    }
}
