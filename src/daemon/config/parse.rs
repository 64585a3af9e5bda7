//! Reading the file: text to [`Config`], and every way in which that can fail.

use std::fmt;
use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};

use super::{Config, Model, Sensor};
use crate::verdict::{self, Hrn, ModelError};
use crate::{press, tare, wire};

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
    /// A value that the part concerned cannot use; its message begins with the key.
    #[error("{path}: {table}.{problem}")]
    Table {
        /// Of the configuration.
        path: PathBuf,
        /// The table, and whose.
        table: String,
        /// What the part says.
        problem: Unusable,
    },
    /// A key of a part that is not built yet: never ignored in silence.
    #[error("{path}: {key}: found a value, expected none: not in this version")]
    NotInThisVersion {
        /// Of the configuration.
        path: PathBuf,
        /// As in the file.
        key: &'static str,
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

/// What a part of the core says of its table.
#[derive(Debug, thiserror::Error)]
pub enum Unusable {
    /// `[sensor.frame]`
    #[error(transparent)]
    Frame(wire::LayoutError),
    /// `[sensor.calibration]`
    #[error(transparent)]
    Calibration(tare::SettingsError),
    /// `[press]`
    #[error(transparent)]
    Press(press::SettingsError),
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
    fn of(text: &str, byte: usize) -> Self {
        let before = &text[..byte.min(text.len())];
        let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
        Self {
            line: before.matches('\n').count() + 1,
            column: before[line_start..].chars().count() + 1,
        }
    }
}

pub(super) fn load(path: &Path) -> Result<Config, Error> {
    let text = fs::read_to_string(path).map_err(|source| Error::Unreadable {
        path: path.to_owned(),
        source,
    })?;
    let mut config: Config = toml::from_str(&text).map_err(|error| syntax(path, &text, &error))?;
    check(&config, path)?;
    let directory = path.parent().unwrap_or(Path::new(""));
    for sensor in &mut config.sensors {
        sensor.port = directory.join(&sensor.port);
    }
    let unix = &mut config.publish.unix;
    let paths = [
        &mut config.model.path,
        &mut unix.path,
        &mut unix.control_path,
    ];
    let record = config.record.as_mut().map(|record| &mut record.dir);
    for path in paths.into_iter().chain(record).flatten() {
        *path = directory.join(&*path);
    }
    Ok(config)
}

fn syntax(path: &Path, text: &str, error: &toml::de::Error) -> Error {
    let start = error.span().map_or(0, |span| span.start);
    // The parser says what was found and expected; the key stands before it on its line.
    let line_start = text[..start].rfind('\n').map_or(0, |newline| newline + 1);
    let line = text[line_start..].lines().next().unwrap_or_default();
    let key = line
        .split_once('=')
        .map(|(key, _)| key.trim())
        .filter(|key| !key.is_empty());
    let message = error.message().replace('\n', ": ");
    Error::Syntax {
        path: path.to_owned(),
        place: Place::of(text, start),
        problem: match key {
            Some(key) if !message.contains(&format!("`{key}`")) => format!("{key}: {message}"),
            _ => message,
        },
    }
}

fn check(config: &Config, path: &Path) -> Result<(), Error> {
    let value = |key: String, found: String, expected| Error::Value {
        path: path.to_owned(),
        key,
        found,
        expected,
    };
    let absent = [
        ("publish.zenoh", config.publish.zenoh.is_some()),
        ("publish.ros2", config.publish.ros2.is_some()),
    ];
    if let Some((key, _)) = absent.iter().find(|(_, given)| *given) {
        return Err(Error::NotInThisVersion {
            path: path.to_owned(),
            key,
        });
    }
    if config.robot.is_empty() || config.robot.chars().any(char::is_control) {
        let found = format!("{:?}", config.robot);
        return Err(value("robot".to_owned(), found, "a name"));
    }
    if config.sensors.is_empty() {
        let expected = "at least one [[sensor]] with a port";
        return Err(value("sensor".to_owned(), "none".to_owned(), expected));
    }
    for (index, sensor) in config.sensors.iter().enumerate() {
        let twin = config.sensors[..index]
            .iter()
            .any(|earlier| earlier.name == sensor.name);
        check_sensor(sensor, twin, path)?;
    }
    config.press.check().map_err(|problem| Error::Table {
        path: path.to_owned(),
        table: "press".to_owned(),
        problem: Unusable::Press(problem),
    })?;
    check_model(&config.model, &value)?;
    if config.publish.unix.max_clients == 0 {
        let key = "publish.unix.max_clients".to_owned();
        return Err(value(key, "0".to_owned(), "1 or more"));
    }
    if let Some(record) = &config.record {
        for (key, found, least) in [
            ("record.rotate_mb", record.rotate_mb, 1),
            ("record.rotate_s", record.rotate_s, 1),
            ("record.keep_free_mb", record.keep_free_mb, 0),
        ] {
            if !(least..=MOST).contains(&found) {
                let expected = "1 to 1000000000 (keep_free_mb also 0)";
                return Err(value(key.to_owned(), found.to_string(), expected));
            }
        }
    }
    let unix = &config.publish.unix;
    if unix.enabled && unix.control_path() == unix.path() {
        let key = "publish.unix.control_path".to_owned();
        let found = unix.control_path().display().to_string();
        return Err(value(key, found, "another path than that of events"));
    }
    Ok(())
}

/// More megabytes than any disk has, few enough to be counted in bytes; 31 years.
const MOST: u64 = 1_000_000_000;

fn check_sensor(sensor: &Sensor, twin: bool, path: &Path) -> Result<(), Error> {
    let name = &sensor.name;
    let value = |key: &str, found: String, expected| {
        let key = format!("sensor.{key} of {name:?}");
        Err(Error::Value {
            path: path.to_owned(),
            key,
            found,
            expected,
        })
    };
    let table = |table: &str, problem| Error::Table {
        path: path.to_owned(),
        table: format!("sensor[{name:?}].{table}"),
        problem,
    };
    let named = name.starts_with(|first: char| first.is_ascii_lowercase())
        && name
            .chars()
            .all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
    if !named {
        return value("name", format!("{name:?}"), "[a-z][a-z0-9_]*");
    }
    if twin {
        return value(
            "name",
            format!("{name:?} twice"),
            "a name of its own for each sensor",
        );
    }
    if sensor.port.as_os_str().is_empty() {
        return value("port", "an empty path".to_owned(), "the path of a device");
    }
    if sensor.baud == 0 {
        return value("baud", "0".to_owned(), "bits a second, 1 or more");
    }
    let hz = sensor.frame_rate_hz;
    if !(FRAME_RATES_HZ.0..=FRAME_RATES_HZ.1).contains(&hz) {
        return value(
            "frame_rate_hz",
            hz.to_string(),
            "frames a second, 0.01 to 10000",
        );
    }
    let layout = wire::Layout::new(&sensor.frame)
        .map_err(|problem| table("frame", Unusable::Frame(problem)))?;
    sensor
        .calibration
        .check(layout.array())
        .map_err(|problem| table("calibration", Unusable::Calibration(problem)))
}

/// Wider than any sensor, narrow enough that a period is a sane time to wait.
const FRAME_RATES_HZ: (f64, f64) = (0.01, 10_000.0);

fn check_model(
    model: &Model,
    value: &impl Fn(String, String, &'static str) -> Error,
) -> Result<(), Error> {
    if !(0.0..=1.0).contains(&model.min_confidence) {
        let found = model.min_confidence.to_string();
        return Err(value("model.min_confidence".to_owned(), found, "0 to 1"));
    }
    if !(model.min_force_n.is_finite() && model.min_force_n >= 0.0) {
        let found = model.min_force_n.to_string();
        return Err(value(
            "model.min_force_n".to_owned(),
            found,
            "newtons, 0 or more",
        ));
    }
    match &model.sha256 {
        Some(hash) if hash.len() != 64 || !hash.chars().all(|c| c.is_ascii_hexdigit()) => {
            Err(value(
                "model.sha256".to_owned(),
                format!("{hash:?}"),
                "64 hex digits",
            ))
        }
        _ => Ok(()),
    }
}

pub(super) fn model(model: &Model, path: &Path) -> Result<Hrn, Error> {
    let hrn = match &model.path {
        None => Hrn::load(verdict::BUILT_IN),
        Some(file) => {
            // A byte more than is accepted is enough to be refused.
            let mut bytes = Vec::new();
            fs::File::open(file)
                .and_then(|open| {
                    open.take(verdict::MAX_FILE_BYTES as u64 + 1)
                        .read_to_end(&mut bytes)
                })
                .map_err(|source| Error::ModelUnreadable {
                    path: path.to_owned(),
                    model: file.clone(),
                    source,
                })?;
            Hrn::load(&bytes)
        }
    };
    let hrn = hrn.map_err(|problem| Error::Model {
        path: path.to_owned(),
        model: model.path.as_ref().map_or_else(
            || "the model built in".to_owned(),
            |file| file.display().to_string(),
        ),
        source: Box::new(problem),
    })?;
    match &model.sha256 {
        Some(expected) if !expected.eq_ignore_ascii_case(hrn.sha256()) => Err(Error::ModelHash {
            path: path.to_owned(),
            found: hrn.sha256().to_owned(),
            expected: expected.clone(),
        }),
        _ => Ok(hrn),
    }
}
