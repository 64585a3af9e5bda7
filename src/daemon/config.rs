//! The configuration file: its tables, and the check of every value, once, at the start.
//!
//! In: a TOML file. Out: a [`Setup`], which has the checked [`Config`], the sensors that it
//! describes, and its model. An unknown key is an error, and so is a table of a feature that this
//! program was built without. Each error names the file and the key, and what was found and
//! expected. Paths in the file are relative to the file's directory.

mod error;
mod publish;
mod check;
mod parse;
mod read;

use std::collections::{BTreeMap, BTreeSet};
use std::env;
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use self::error::Error;
pub use self::publish::{
    Endpoint, EndpointError, Foxglove, Http, Listen, Mode, ModeError, Publish, Ros2, Tcp, Unix,
    Zenoh,
};
use self::read::Until;
use super::log;
use super::port::Port;
use hardnessd_core::exit::{Coded, USAGE};
use hardnessd_core::sensor::{Description, Sensor};
use hardnessd_core::verdict::{self, Format, Hrn};
use hardnessd_core::{motion, press, tare, trial, wire};

/// The whole configuration file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The name of the robot. The default is the name of the host.
    #[serde(default = "host")]
    pub robot: String,
    /// The sensors that the daemon serves.
    #[serde(default, rename = "sensor")]
    pub sensors: Vec<SensorTable>,
    /// The thresholds that begin and end a press.
    #[serde(default)]
    pub press: press::Settings,
    /// The model that gives verdicts.
    #[serde(default)]
    pub model: Model,
    /// The hardness levels, in place of the model's own. Without a table, they are the model's.
    #[serde(default, rename = "level", skip_serializing_if = "Vec::is_empty")]
    pub levels: Vec<LevelTable>,
    /// All ways to publish events, except HTTP.
    #[serde(default)]
    pub publish: Publish,
    /// The live page and the other HTTP routes. Without the table, they are off.
    #[serde(default)]
    pub http: Option<Http>,
    /// The daemon's own recording. Without the table, it is off.
    #[serde(default)]
    pub record: Option<Record>,
    /// The format of the log.
    #[serde(default)]
    pub log: log::Settings,
}

/// A `[[sensor]]` table. [`Description`] has the defaults of the keys that both have.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SensorTable {
    /// The sensor's name: unique, and `[a-z][a-z0-9_]*`.
    pub name: String,
    /// The sensor's port. It has no default: [`Config::load`] refuses an empty path.
    pub port: Port,
    /// The baud rate of the serial line, in bits per second. A pty and USB CDC ignore it.
    pub baud: NonZeroU32,
    /// The number of frames that the sensor is expected to send in a second.
    pub frame_rate_hz: f64,
    /// The silence after which a live sensor is stale, in milliseconds. The default is the larger
    /// of 2.5 periods and 50 ms.
    pub stale_after_ms: Option<f64>,
    /// The layout of a frame in bytes.
    pub frame: wire::Settings,
    /// The calibration, which converts counts to newtons.
    pub calibration: tare::Settings,
    /// The arm that presses with the sensor.
    pub arm: motion::Settings,
    /// The file with presses of known pieces on this sensor, as `identify` makes it.
    pub references: Option<PathBuf>,
}

impl Default for SensorTable {
    fn default() -> Self {
        let Description {
            name,
            frame_rate_hz,
            stale_after_ms,
            frame,
            calibration,
            arm,
            ..
        } = Description::default();
        Self {
            name,
            port: PathBuf::new().into(),
            baud: const { NonZeroU32::new(115_200).unwrap() },
            frame_rate_hz,
            stale_after_ms,
            frame,
            calibration,
            arm,
            references: None,
        }
    }
}

impl SensorTable {
    /// A sensor at `port`, with the defaults of all other keys.
    pub fn new(port: impl Into<Port>) -> Self {
        Self {
            port: port.into(),
            ..Self::default()
        }
    }
}

/// A `[[level]]` table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LevelTable {
    /// The name of the level, such as `firm`.
    pub label: String,
    /// The least and the greatest Shore OO of the level.
    pub shore: [f32; 2],
}

/// The models in the binary.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum BuiltIn {
    /// The model of courses and references.
    #[default]
    Course,
    /// The model that judges one frame, that of the largest contact area, as the paper does.
    Hrn,
}

impl BuiltIn {
    /// The bytes of the model.
    pub fn bytes(self) -> &'static [u8] {
        match self {
            Self::Course => verdict::BUILT_IN,
            Self::Hrn => verdict::BUILT_IN_HRN,
        }
    }
}

/// The `[model]` table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Model {
    /// The model in the binary that judges, unless a path names another.
    pub built_in: BuiltIn,
    /// The path of the ONNX file. The default is the built-in model.
    pub path: Option<PathBuf>,
    /// The SHA-256 hash that the model must have, in hex.
    pub sha256: Option<String>,
    /// A verdict below this confidence is rejected.
    pub min_confidence: f32,
    /// A verdict on a frame with less total force, in newtons, is rejected.
    pub min_force_n: f64,
    /// A model of the course gives an early verdict when its confidence reaches this value.
    pub early_confidence: f32,
}

impl Default for Model {
    fn default() -> Self {
        let Description {
            min_confidence,
            min_force_n,
            early_confidence,
            ..
        } = Description::default();
        Self {
            built_in: BuiltIn::default(),
            path: None,
            sha256: None,
            min_confidence,
            min_force_n,
            early_confidence,
        }
    }
}

/// The `[record]` table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Record {
    /// The directory of the recordings. [`Record::dir`] has the default.
    dir: Option<PathBuf>,
    /// Whether everything is recorded. If `false`, only the last minute before a fault is recorded.
    pub continuous: bool,
    /// When a file has this many million bytes, the next one begins.
    pub rotate_mb: u64,
    /// When a file is this many seconds old, the next one begins.
    pub rotate_s: u64,
    /// This many million bytes stay free on the disk. If fewer are free, nothing is written.
    pub keep_free_mb: u64,
}

impl Default for Record {
    fn default() -> Self {
        Self {
            dir: None,
            continuous: true,
            rotate_mb: 256,
            rotate_s: 3600,
            keep_free_mb: 1024,
        }
    }
}

impl Record {
    /// The directory of the recordings: the configured one, else the service's state directory,
    /// else `/var/lib/hardnessd`.
    pub fn dir(&self) -> PathBuf {
        let configured = self.dir.clone();
        let dir = configured.or_else(|| directory_of_service("STATE_DIRECTORY"));
        dir.unwrap_or_else(|| PathBuf::from("/var/lib/hardnessd"))
    }
}

/// The directory that systemd names in this variable: the first of several, between which it writes
/// colons.
fn directory_of_service(variable: &str) -> Option<PathBuf> {
    let directories = env::var(variable).ok()?;
    let first = directories.split(':').next()?;
    (!first.is_empty()).then(|| PathBuf::from(first))
}

fn host() -> String {
    rustix::system::uname()
        .nodename()
        .to_string_lossy()
        .into_owned()
}

impl Config {
    /// The default configuration with `sensors`.
    pub fn new(sensors: Vec<SensorTable>) -> Self {
        Self {
            robot: host(),
            sensors,
            press: press::Settings::default(),
            model: Model::default(),
            levels: Vec::new(),
            publish: Publish::default(),
            http: None,
            record: None,
            log: log::Settings::default(),
        }
    }

    /// The same configuration with the model at `path`, if there is one.
    #[must_use]
    pub fn with_model(mut self, path: Option<&Path>) -> Self {
        if let Some(path) = path {
            self.model.path = Some(path.to_owned());
            self.model.sha256 = None;
        }
        self
    }

    /// Reads a file, but does not check its values. [`Self::check`] does.
    ///
    /// # Errors
    ///
    /// Returns an [`Error`] if the file cannot be read or is not TOML, if it has an unknown key, a
    /// value of another type or a path that cannot be used, or if a file of gains cannot be used.
    pub fn load(path: &Path) -> Result<Self, Error> {
        parse::load(path, None).map_err(Error::at(path))
    }

    /// Checks every value, and whether the values fit together. Returns the sensors in their order.
    /// `path` is only for messages.
    ///
    /// # Errors
    ///
    /// Returns an [`Error`] for the first value that cannot be used.
    pub fn check(&self, path: &Path) -> Result<Vec<Sensor>, Error> {
        check::check(self).map_err(Error::at(path))
    }

    /// The description of `sensor`, composed from all tables of the file.
    pub(crate) fn describe(&self, sensor: &SensorTable) -> Description {
        Description {
            name: sensor.name.clone(),
            frame_rate_hz: sensor.frame_rate_hz,
            stale_after_ms: sensor.stale_after_ms,
            frame: sensor.frame.clone(),
            calibration: sensor.calibration.clone(),
            press: self.press.clone(),
            arm: sensor.arm.clone(),
            min_confidence: self.model.min_confidence,
            min_force_n: self.model.min_force_n,
            early_confidence: self.model.early_confidence,
        }
    }

    /// The first key that differs between `self` and `other` and that only a restart can change. This
    /// is any key but those that are named here as taken over by a running daemon.
    pub fn fixed_difference(&self, other: &Self) -> Option<String> {
        let fixed = |config: &Self, others: &Self| Self {
            press: others.press.clone(),
            model: others.model.clone(),
            levels: others.levels.clone(),
            log: others.log,
            sensors: Vec::new(),
            ..config.clone()
        };
        let fixed_of_sensor = |sensor: &SensorTable, others: &SensorTable| SensorTable {
            stale_after_ms: others.stale_after_ms,
            calibration: others.calibration.clone(),
            arm: others.arm.clone(),
            references: others.references.clone(),
            ..sensor.clone()
        };
        let mut of_sensors = self.sensors.iter().filter_map(|ours| {
            let theirs = other
                .sensors
                .iter()
                .find(|theirs| theirs.name == ours.name)?;
            let key = difference(ours, &fixed_of_sensor(theirs, ours))?;
            Some(format!("sensor.{key} of {:?}", ours.name))
        });
        let of_tables = difference(&fixed(self, self), &fixed(other, self));
        of_sensors
            .next()
            .or(of_tables)
            .or_else(|| self.fixed_names(other))
    }

    /// The key of a publisher that announces the names of the sensors once, if they differ.
    fn fixed_names(&self, other: &Self) -> Option<String> {
        let names = |config: &Self| -> BTreeSet<String> {
            config
                .sensors
                .iter()
                .map(|sensor| sensor.name.clone())
                .collect()
        };
        let publish = &self.publish;
        let announcing = [
            ("publish.zenoh", publish.zenoh.is_some()),
            ("publish.ros2", publish.ros2.is_some()),
            ("publish.foxglove", publish.foxglove.is_some()),
        ];
        let (key, _) = announcing.into_iter().find(|(_, is_on)| *is_on)?;
        (names(self) != names(other)).then(|| format!("sensor.name (beside {key})"))
    }
}

/// The first key that differs, with the keys of its tables before it.
fn difference<T: PartialEq + Serialize>(ours: &T, theirs: &T) -> Option<String> {
    fn first(ours: &Value, theirs: &Value) -> Option<String> {
        let (Value::Object(ours), Value::Object(theirs)) = (ours, theirs) else {
            return None;
        };
        let mut keys = ours.keys().chain(theirs.keys());
        let key = keys.find(|key| ours.get(*key) != theirs.get(*key))?;
        let [ours, theirs] = [ours, theirs].map(|table| table.get(key).unwrap_or(&Value::Null));
        let below = first(ours, theirs).map(|below| format!(".{below}"));
        Some(format!("{key}{}", below.unwrap_or_default()))
    }
    // A path that is not UTF-8 has no JSON, so its key cannot be named.
    let json = |table: &T| serde_json::to_value(table).unwrap_or_default();
    let named = || first(&json(ours), &json(theirs)).unwrap_or_else(|| "a path".to_owned());
    (ours != theirs).then(named)
}

/// A configuration whose values have all been checked, with its sensors and its model.
#[derive(Debug, Clone)]
pub struct Setup {
    /// The configuration as it was read.
    pub config: Config,
    /// The sensors of the configuration, in its order.
    pub sensors: Vec<Sensor>,
    /// The model that the configuration names.
    pub hrn: Arc<Hrn>,
    /// The model with the references of the sensors that have some.
    identified: BTreeMap<String, Arc<Hrn>>,
}

/// A name on the command line is that of no configured sensor.
#[derive(Debug, thiserror::Error)]
#[error("--sensor: found {found:?}, expected one of {}", names.join(", "))]
pub struct UnknownSensor {
    found: String,
    names: Vec<String>,
}

impl Coded for UnknownSensor {
    fn exit_code(&self) -> u8 {
        USAGE
    }
}

impl Setup {
    /// The sensor of this name, or the first one without a name.
    ///
    /// # Errors
    ///
    /// Fails if no sensor has the name.
    pub fn sensor_named(&self, name: Option<&str>) -> Result<&Sensor, UnknownSensor> {
        let Some(name) = name else {
            return Ok(&self.sensors[0]);
        };
        let mut sensors = self.sensors.iter();
        let named = sensors.find(|sensor| sensor.name() == name);
        named.ok_or_else(|| UnknownSensor {
            found: name.to_owned(),
            names: self.sensors.iter().map(|s| s.name().to_owned()).collect(),
        })
    }

    /// The name of the model's file, or `built in`.
    pub fn model_name(&self) -> String {
        let path = self.config.model.path.as_ref();
        let name = path.map(|path| path.file_name().unwrap_or(path.as_os_str()));
        match (name, self.config.model.built_in) {
            (Some(name), _) => name.to_string_lossy().into_owned(),
            (None, BuiltIn::Course) => "built in".to_owned(),
            (None, BuiltIn::Hrn) => "built in, hrn".to_owned(),
        }
    }

    /// What the model judges, and what it needs beside the sensor.
    pub fn model_needs(&self) -> &'static str {
        match self.hrn.format() {
            Format::Frame => "judges single frames, needs no arm",
            Format::Course { .. } if self.hrn.most_references() > 0 => {
                "judges whole presses, best with the arm's positions and with references of each sensor"
            }
            Format::Course { .. } => {
                "judges whole presses, needs the arm's positions or sensor.arm.speed_mm_s"
            }
        }
    }

    /// The keys of the configuration that are set and change no verdict of this model.
    pub fn without_effect(&self) -> Vec<String> {
        let Config { press, model, .. } = &self.config;
        let (press_default, model_default) = (press::Settings::default(), Model::default());
        let takes_none = self.hrn.most_references() == 0;
        let sensors = self.config.sensors.iter();
        let given = sensors.filter(|sensor| takes_none && sensor.references.is_some());
        let references = given.map(|sensor| format!("sensor.references of {:?}", sensor.name));
        match self.hrn.format() {
            Format::Frame => {
                let described = |sensor: &&SensorTable| sensor.arm != motion::Settings::default();
                let arms = self.config.sensors.iter().filter(described);
                let arms = arms.map(|sensor| format!("sensor.arm of {:?}", sensor.name));
                let early = model.early_confidence != model_default.early_confidence;
                let early = early.then(|| "model.early_confidence".to_owned());
                arms.chain(early).chain(references).collect()
            }
            Format::Course { .. } => {
                let settle = press.early_settle_s != press_default.early_settle_s;
                let settle = settle.then(|| "press.early_settle_s".to_owned());
                settle.into_iter().chain(references).collect()
            }
        }
    }

    /// Reads a configuration and its model. `model` replaces the configuration's own.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Config::load`] and [`Self::of`].
    pub fn load(path: &Path, model: Option<&Path>) -> Result<Self, Error> {
        let config = Config::load(path)?;
        Self::of(config.with_model(model), path)
    }

    /// Reads a configuration and its model, but does not wait longer than `until` for a program that
    /// writes a file of them.
    pub(super) fn load_until(
        path: &Path,
        model: Option<&Path>,
        until: Instant,
    ) -> Result<Self, Error> {
        let config = parse::load(path, Some(until)).map_err(Error::at(path))?;
        Self::of_until(config.with_model(model), path, Some(until))
    }

    /// Checks `config` and loads its model. `path` is only for messages.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Config::check`], and an error if the model cannot be read or is
    /// refused.
    pub fn of(config: Config, path: &Path) -> Result<Self, Error> {
        Self::of_until(config, path, None)
    }

    fn of_until(config: Config, path: &Path, until: Until) -> Result<Self, Error> {
        let sensors = config.check(path)?;
        let rates = config.sensors.iter().map(|sensor| sensor.frame_rate_hz);
        let most = trial::verdict_most(rates.fold(0.0, f64::max));
        let hrn = parse::model(&config, most, until).map_err(Error::at(path))?;
        let hrn = Arc::new(hrn);
        let mut identified = BTreeMap::new();
        for sensor in &config.sensors {
            if let Some(file) = &sensor.references {
                let own = parse::identified(&hrn, file, &sensor.name, until);
                let own = own.map_err(Error::at(path))?;
                identified.insert(sensor.name.clone(), Arc::new(own));
            }
        }
        Ok(Self {
            config,
            sensors,
            hrn,
            identified,
        })
    }

    /// The sensors that have references, each with its model.
    pub fn identified(&self) -> impl Iterator<Item = (&str, &Arc<Hrn>)> {
        self.identified
            .iter()
            .map(|(name, hrn)| (name.as_str(), hrn))
    }

    /// The model for the presses of a sensor.
    pub fn hrn_of(&self, sensor: &str) -> &Arc<Hrn> {
        self.identified.get(sensor).unwrap_or(&self.hrn)
    }
}

#[cfg(test)]
mod tests;
