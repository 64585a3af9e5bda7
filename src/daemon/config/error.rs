//! Every way in which a configuration can fail. Each error names the file, and the line or the key.

use std::fmt;
use std::path::PathBuf;

use crate::sensor::SensorError;
use crate::verdict::ModelError;

/// Room for a hundred sensors with every taxel dead.
pub(super) const MAX_BYTES: usize = 1 << 20;

/// Why there is no configuration. Each says file, key, what was found and what was expected.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file itself cannot be read.
    #[error("{path}: cannot read: {source}")]
    Unreadable {
        /// Of the configuration.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// More than any configuration has: another file, or a device without an end.
    #[error("{path}: found more than {MAX_BYTES} bytes, expected a configuration")]
    TooLong {
        /// Of the configuration.
        path: PathBuf,
    },
    /// No TOML, an unknown key, or a value of the wrong type.
    #[error("{path}:{place}: {problem}")]
    Syntax {
        /// Of the configuration.
        path: PathBuf,
        /// Where in it.
        place: Place,
        /// What was found and what was expected.
        problem: String,
    },
    /// A value out of its range.
    #[error("{path}: {key}: found {found}, expected {expected}")]
    Value {
        /// Of the configuration.
        path: PathBuf,
        /// As in the file.
        key: String,
        /// As given.
        found: String,
        /// What could be used.
        expected: &'static str,
    },
    /// A value of a sensor's description.
    #[error("{path}: {}{problem}", table_of(sensor, problem))]
    Sensor {
        /// Of the configuration.
        path: PathBuf,
        /// Its name.
        sensor: String,
        /// Which, and what it should be.
        problem: SensorError,
    },
    /// A table of a part that this program was built without: never ignored in silence.
    #[error(
        "{path}: publish.{feature}: found a table, expected none: built without the feature \
         {feature:?}"
    )]
    NotBuilt {
        /// Of the configuration.
        path: PathBuf,
        /// Of the package, and the table's name.
        feature: &'static str,
    },
    /// The model file cannot be read.
    #[error("{path}: model.path: cannot read {model}: {source}")]
    ModelUnreadable {
        /// Of the configuration.
        path: PathBuf,
        /// Of the model.
        model: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// Another file than the one meant.
    #[error("{path}: model.sha256: found a model of {found}, expected {expected}")]
    ModelHash {
        /// Of the configuration.
        path: PathBuf,
        /// Of the file there is.
        found: String,
        /// As given.
        expected: String,
    },
    /// The model is refused.
    #[error("{path}: model.path: {model}: {source}")]
    Model {
        /// Of the configuration.
        path: PathBuf,
        /// Of the model, or that it is the one built in.
        model: String,
        /// Why.
        source: Box<ModelError>,
    },
}

/// What stands before the key that `problem` begins with.
fn table_of(sensor: &str, problem: &SensorError) -> String {
    match problem {
        SensorError::Press(_) => String::new(),
        SensorError::MinConfidence(_) | SensorError::MinForce(_) => "model.".to_owned(),
        // The name itself is what cannot be used.
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
