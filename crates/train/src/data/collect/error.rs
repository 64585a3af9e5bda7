//! The reasons that files cannot be collected.

use std::path::{Path, PathBuf};

use crate::data::presses::{DatasetError, Layout};
use hardnessd_core::recording::{self, PlaybackError};

/// The reason that a file gives no samples.
#[derive(Debug, thiserror::Error)]
pub enum CollectError {
    /// A recording, or something between files.
    #[error("{}: {problem}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The reason.
        problem: Problem,
    },
    /// The file is an `.npz` file, but not the data set that is needed.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
}

/// The reason, without the file's path.
#[derive(Debug, thiserror::Error)]
pub enum Problem {
    /// The file is missing or unreadable.
    #[error("{0}")]
    Unreadable(std::io::Error),
    /// The recording is damaged, or is not one of hardnessd.
    #[error("{0}")]
    Recording(recording::Error),
    /// The recording describes an impossible sensor.
    #[error("{0}")]
    Sensor(PlaybackError),
    /// The level is neither given nor a label.
    #[error("the recording has no label `level`: give its level with --level")]
    NoLevel,
    /// A label is not a number in its range.
    #[error("label {key}: found {found}, expected {expected}{}", option(key))]
    Label {
        /// The label's key.
        key: &'static str,
        /// The value found.
        found: String,
        /// The accepted values.
        expected: &'static str,
    },
    /// The file has another taxel pitch than the others.
    #[error("taxel pitch: found {found} mm, expected {expected} mm, that of {}", first.display())]
    Pitch {
        /// The file's pitch, in mm.
        found: f64,
        /// The pitch of the others, in mm.
        expected: f64,
        /// One of the others, or the data set to which the file is added.
        first: PathBuf,
    },
    /// The sensors of one recording have different taxel pitches.
    #[error("taxel pitch: found {found} mm, expected {expected} mm, that of its first sensor")]
    Pitches {
        /// The pitch of a sensor, in mm.
        found: f64,
        /// The pitch of the first one, in mm.
        expected: f64,
    },
    /// An array has values in this file only, or everywhere but in this file. The data set would lose
    /// it, because an array has a value for every sample or is missing.
    #[error(
        "has {no}{array}, and {first} has{not}: {}make it a data set of its own (train takes several \
         --data)",
        remedy(array),
        no = if *is_there { "" } else { "no " },
        first = first.display(),
        not = if *is_there { " not" } else { "" },
    )]
    Arrays {
        /// The array's name.
        array: &'static str,
        /// Whether this file has it.
        is_there: bool,
        /// The other file.
        first: PathBuf,
    },
    /// The same object is in the training split and in the test split.
    #[error(
        "object {object} is in the {found} split here, and in the {expected} split before: give it the \
         same --split, because presses of one object are near-copies"
    )]
    Splits {
        /// The object's number.
        object: u32,
        /// The split of the object's presses in this file.
        found: &'static str,
        /// The split of the object's earlier presses.
        expected: &'static str,
    },
    /// The same recording was collected before, with the same labels.
    #[error(
        "the same recording as {0}, whose presses are in the data set already: leave it out, because \
         presses that are there twice count twice"
    )]
    Twice(String),
    /// The file names a material for which no number is left.
    #[error("material {0:?} is one too many: a data set has at most 256 materials")]
    Materials(String),
    /// No number is left for a new object.
    #[error(
        "no number is left for a new object, because object {} is in the data set: give its number with \
         --object",
        u32::MAX
    )]
    NoNumber,
    /// The sensor was not pressed, or no press was judged.
    #[error(
        "no press found: was the sensor pressed, and is this its layout? `hardnessd replay` shows what \
         is in a recording"
    )]
    NoPress,
    /// A data set has the other layout.
    #[error("{}", layout(*.0))]
    Layout(Layout),
    /// A directory has no recording in it.
    #[error("no recording is in this directory")]
    Empty,
}

impl Problem {
    /// The error of the file with this problem.
    pub(super) fn of(self, path: &Path) -> CollectError {
        CollectError::File {
            path: path.to_owned(),
            problem: self,
        }
    }
}

impl CollectError {
    /// The error without the file's path, for a list that has the path elsewhere.
    pub(super) fn reason(&self, path: &Path) -> String {
        let text = self.to_string();
        let reason = text.strip_prefix(&format!("{}: ", path.display()));
        reason.unwrap_or(&text).to_owned()
    }
}

fn layout(expected: Layout) -> &'static str {
    match expected {
        Layout::Frames => "has whole presses, not single frames: collect it with --sequences",
        Layout::OverTime => "has single frames, not whole presses: collect it without --sequences",
    }
}

fn option(key: &str) -> String {
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
