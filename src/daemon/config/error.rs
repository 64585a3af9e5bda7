//! The errors of a configuration. Each error names the file, and the line or the key.

use std::path::{Path, PathBuf};

use hardnessd_core::exit::{CONFIG, Coded, NO_INPUT};
use hardnessd_core::sensor::SensorError;
use hardnessd_core::verdict::LevelsError;

/// The most bytes of a configuration file. They are enough for a hundred sensors with every taxel
/// dead.
pub(super) const MAX_BYTES: usize = 1 << 20;

/// The reason a configuration cannot be used. Each message names the file and the key, what was
/// found and what was expected.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {problem}")]
pub struct Error {
    /// The path of the configuration.
    path: PathBuf,
    #[source]
    problem: Problem,
}

impl Error {
    /// Makes the error of a problem in the configuration at `path`.
    pub(super) fn at(path: &Path) -> impl FnOnce(Problem) -> Self {
        move |problem| Self {
            path: path.to_owned(),
            problem,
        }
    }
}

/// The problem of a configuration, which its caller names.
#[derive(Debug, thiserror::Error)]
pub(super) enum Problem {
    /// The configuration file cannot be read.
    #[error("cannot read: {0}")]
    Unreadable(#[source] std::io::Error),
    /// The file is longer than any configuration. It may be another file, or an endless device.
    #[error("more than {MAX_BYTES} bytes: no configuration is so long: name another file")]
    TooLong,
    /// The file is not TOML, or has an unknown key or a value of the wrong type. The text is the
    /// place in the file, and the parser's message.
    #[error("{0}")]
    Syntax(String),
    /// The file has `[sensor]` in place of `[[sensor]]`.
    #[error("write [[sensor]], not [sensor]: there may be several")]
    SingleBrackets,
    /// A `[[sensor]]` has no port.
    #[error("sensor.port of {sensor:?} is missing: set it to a path under /dev/serial/by-id/")]
    NoPort {
        /// The sensor's name.
        sensor: String,
    },
    /// A value cannot be used.
    #[error("{key}: found {found}, expected {expected}")]
    Value {
        /// The key, as it is written in the file.
        key: String,
        /// The value found.
        found: String,
        /// The values that can be used.
        expected: &'static str,
    },
    /// Two values cannot be used together.
    #[error("{key}: {problem}")]
    Clash {
        /// The key to change, as it is written in the file.
        key: String,
        /// The problem, and the remedy.
        problem: String,
    },
    /// The configuration has no sensor.
    #[error("no sensor: add a [[sensor]] with a port")]
    NoSensor,
    /// A value of a sensor's description cannot be used.
    #[error("{}{problem}", table_of(sensor, problem))]
    Sensor {
        /// The sensor's name.
        sensor: String,
        /// The value found, and the values that can be used.
        problem: SensorError,
    },
    /// A table belongs to a feature that this program was built without. Such a table is never
    /// ignored.
    #[error(
        "publish.{feature}: this hardnessd was built without {feature}: build it with \
         --features {feature}, or remove the table"
    )]
    NotBuilt {
        /// The feature of the package, which is also the table's name.
        feature: &'static str,
    },
    /// A file that the configuration names cannot be used.
    #[error("{key}: {file}: {source}")]
    File {
        /// The key, as it is written in the file.
        key: String,
        /// The path of the file, or "the model built in".
        file: PathBuf,
        /// The reason the file cannot be used.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The model cannot have the levels of the configuration.
    #[error("level: {0}")]
    Levels(#[from] LevelsError),
    /// The model has another hash than `model.sha256`.
    #[error("model.sha256: found a model of {found}, expected {expected}")]
    ModelHash {
        /// The hash of the model.
        found: String,
        /// The hash in `model.sha256`.
        expected: String,
    },
}

impl Coded for Error {
    fn exit_code(&self) -> u8 {
        match self.problem {
            Problem::Unreadable(_) => NO_INPUT,
            _ => CONFIG,
        }
    }
}

/// The table to name before the key with which `problem` begins.
fn table_of(sensor: &str, problem: &SensorError) -> String {
    match problem {
        SensorError::Press(_) => String::new(),
        // The name cannot be used, so it cannot identify the table.
        SensorError::Name(_) => "sensor.".to_owned(),
        SensorError::Range(found) => match found.key {
            "name" => "sensor.".to_owned(),
            "min_confidence" | "min_force_n" | "early_confidence" => "model.".to_owned(),
            _ => format!("sensor[{sensor:?}]."),
        },
        _ => format!("sensor[{sensor:?}]."),
    }
}
