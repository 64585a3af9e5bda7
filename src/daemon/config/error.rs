//! Every way in which a configuration can fail. Each error names the file, and the line or the key.

use std::fmt;
use std::path::{Path, PathBuf};

use crate::npy::NpyError;
use crate::sensor::SensorError;
use crate::verdict::ModelError;

/// Room for a hundred sensors with every taxel dead.
pub(super) const MAX_BYTES: usize = 1 << 20;

/// Why there is no configuration. Each message names the file and the key, what was found and what
/// was expected.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file itself cannot be read.
    #[error("{path}: cannot read: {source}")]
    Unreadable {
        /// The configuration.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// It is longer than any configuration: another file, or a device without an end.
    #[error("{path}: found more than {MAX_BYTES} bytes, expected a configuration")]
    TooLong {
        /// The configuration.
        path: PathBuf,
    },
    /// No TOML, an unknown key, or a value of the wrong type.
    #[error("{path}:{place}: {problem}")]
    Syntax {
        /// The configuration.
        path: PathBuf,
        /// The line and the column.
        place: Place,
        /// What was found and what was expected.
        problem: String,
    },
    /// A value out of its range.
    #[error("{path}: {key}: found {found}, expected {expected}")]
    Value {
        /// The configuration.
        path: PathBuf,
        /// The key, as in the file.
        key: String,
        /// The value that was given.
        found: String,
        /// Which values can be used.
        expected: &'static str,
    },
    /// A value of a sensor's description.
    #[error("{path}: {}{problem}", table_of(sensor, problem))]
    Sensor {
        /// The configuration.
        path: PathBuf,
        /// Its name.
        sensor: String,
        /// The value, and what it should be.
        problem: SensorError,
    },
    /// A table of a part that this program was built without. It is never ignored.
    #[error(
        "{path}: publish.{feature}: found a table, expected none: built without the feature \
         {feature:?}"
    )]
    NotBuilt {
        /// The configuration.
        path: PathBuf,
        /// The feature of the package, which is also the table's name.
        feature: &'static str,
    },
    /// A file of gains cannot be read, or holds something else.
    #[error(
        "{path}: sensor.calibration.gains of {sensor:?}: {}",
        of_gains(file, source)
    )]
    Gains {
        /// The configuration.
        path: PathBuf,
        /// Name of the sensor.
        sensor: String,
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        source: NpyError,
    },
    /// The model file cannot be read.
    #[error("{path}: model.path: cannot read {model}: {source}")]
    ModelUnreadable {
        /// The configuration.
        path: PathBuf,
        /// The model file.
        model: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The model file has another hash.
    #[error("{path}: model.sha256: found a model of {found}, expected {expected}")]
    ModelHash {
        /// The configuration.
        path: PathBuf,
        /// The hash of the file.
        found: String,
        /// The hash that was given.
        expected: String,
    },
    /// The model is refused.
    #[error("{path}: model.path: {model}: {source}")]
    Model {
        /// The configuration.
        path: PathBuf,
        /// The model file, or "the model built in".
        model: String,
        /// The reason.
        source: Box<ModelError>,
    },
}

/// What is wrong with a file of gains.
fn of_gains(file: &Path, source: &NpyError) -> String {
    let file = file.display();
    match source {
        NpyError::Io(error) => format!("cannot read {file}: {error}"),
        found => format!("{file}: found {found}, expected f32 [rows, cols]"),
    }
}

/// The table before the key with which `problem` begins.
fn table_of(sensor: &str, problem: &SensorError) -> String {
    match problem {
        SensorError::Press(_) => String::new(),
        SensorError::MinConfidence(_)
        | SensorError::MinForce(_)
        | SensorError::EarlyConfidence(_) => "model.".to_owned(),
        // The name itself cannot be used.
        SensorError::Name(_) | SensorError::LongName { .. } => "sensor.".to_owned(),
        _ => format!("sensor[{sensor:?}]."),
    }
}

/// Line and column, from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Place {
    line: usize,
    column: usize,
}

impl fmt::Display for Place {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}:{}", self.line, self.column)
    }
}

impl Place {
    pub(super) fn of(text: &str, byte: usize) -> Self {
        let before = &text[..byte.min(text.len())];
        let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
        Self {
            line: before.matches('\n').count() + 1,
            column: before[line_start..].chars().count() + 1,
        }
    }
}
