//! The configuration file: its tables, and the check of every value, once, at the start.
//!
//! In: a TOML file. Out: a [`Setup`], which has the checked [`Config`], the sensors that it
//! describes, and its model. An unknown key is an error, and so is a table of a feature that this
//! program was built without. Each error names the file, the line and the key, and what was found and
//! expected. Paths in the file are relative to the file's directory. The core has the tables that
//! describe a sensor.

mod error;
mod publish;
mod check;
mod parse;
mod in_force;
mod warnings;

use std::collections::BTreeMap;
use std::env;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Context as _;
use serde_json::Value;

pub use self::error::Text;
pub(crate) use self::parse::read_at_most;
pub use self::publish::{
    Foxglove, Http, Mode, Publish, RmwZenoh, Ros2, Tcp, Unix, Zenoh, domain_id,
};
pub use super::Error;
use super::log;
use hardnessd_core::range::{OutOfRange, from_to};
use hardnessd_core::sensor::{self, Sensor};
use hardnessd_core::settings;
use hardnessd_core::verdict::{self, BuiltIn, Format, LevelTable, Model};
use hardnessd_core::{press, trial};

settings! {
    /// The whole configuration file.
    pub struct Config {
        /// The name of the robot. The default is the name of the host.
        pub robot: String = host();
        /// The sensors that the daemon serves.
        #[serde(rename = "sensor")]
        pub sensors: Vec<sensor::Settings> = Vec::new();
        /// The thresholds that begin and end a press.
        pub press: press::Settings = press::Settings::default();
        /// The model that gives verdicts.
        pub model: verdict::Settings = verdict::Settings::default();
        /// The hardness levels, in place of the model's own. Without a table, they are the model's.
        #[serde(rename = "level", skip_serializing_if = "Vec::is_empty")]
        pub levels: Vec<LevelTable> = Vec::new();
        /// All ways to publish events, except HTTP.
        pub publish: Publish = Publish::default();
        /// The live page and the other HTTP routes. Without the table, they are off.
        pub http: Option<Http>;
        /// The daemon's own recording. Without the table, it is off.
        pub record: Option<Record>;
        /// The format of the log.
        pub log: log::Settings = log::Settings::default();
    }
}

/// The largest number in `[record]`. As megabytes it is more than any disk has, and the number of
/// bytes still fits in a `u64`. As seconds it is 31 years.
const MOST: f64 = 1e9;

settings! {
    /// The `[record]` table.
    pub struct Record {
        /// The directory of the recordings. [`Record::dir`] has the default.
        dir: Option<PathBuf>;
        /// When a file has this many million bytes, the next one begins.
        pub rotate_mb: u64 = 256, in from_to((1.0, MOST), "");
        /// When a file is this many seconds old, the next one begins.
        pub rotate_s: u64 = 3600, in from_to((1.0, MOST), "");
        /// This many million bytes stay free on the disk. If fewer are free, nothing is written.
        pub keep_free_mb: u64 = 1024, in from_to((0.0, MOST), "");
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
pub(super) fn directory_of_service(variable: &str) -> Option<PathBuf> {
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
    pub fn new(sensors: Vec<sensor::Settings>) -> Self {
        Self {
            sensors,
            ..Self::default()
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

    /// Reads a file and checks every value.
    ///
    /// # Errors
    ///
    /// Returns an [`Error`] if the file cannot be read or is not TOML, if it has an unknown key, or a
    /// value that cannot be used, or if a file of gains cannot be used.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let (config, text) = parse::load(path)?;
        let checked = check::check(&config);
        checked.map(|_| config).map_err(Error::at(path, &text))
    }

    /// The first key that differs between `self` and `other` and that only a restart can change. This
    /// is any key but those of the tables that are named here, and the names of the sensors.
    pub fn fixed_difference(&self, other: &Self) -> Option<String> {
        let fixed = |config: &Self| Self {
            sensors: Vec::new(),
            press: press::Settings::default(),
            model: verdict::Settings::default(),
            levels: Vec::new(),
            log: log::Settings::default(),
            ..config.clone()
        };
        let (ours, theirs) = (fixed(self), fixed(other));
        if ours == theirs {
            let [ours, theirs] = [self, other].map(|config| config.sensors.iter());
            let is_named_alike = ours.map(|one| &one.name).eq(theirs.map(|one| &one.name));
            return (!is_named_alike).then(|| "sensor.name".to_owned());
        }
        // A path that is not UTF-8 has no JSON, so its key cannot be named.
        let [ours, theirs] =
            [ours, theirs].map(|one| serde_json::to_value(one).unwrap_or_default());
        Some(difference(&ours, &theirs).unwrap_or_else(|| "a path".to_owned()))
    }
}

/// The first key that differs, with the keys of its tables before it.
fn difference(ours: &Value, theirs: &Value) -> Option<String> {
    let (ours, theirs) = (ours.as_object()?, theirs.as_object()?);
    let mut keys = ours.keys().chain(theirs.keys());
    let key = keys.find(|key| ours.get(*key) != theirs.get(*key))?;
    let [ours, theirs] = [ours, theirs].map(|table| table.get(key).unwrap_or(&Value::Null));
    let below = difference(ours, theirs).map(|below| format!(".{below}"));
    Some(format!("{key}{}", below.unwrap_or_default()))
}

/// A configuration whose values have all been checked, with its sensors and its model.
#[derive(Debug, Clone)]
pub struct Setup {
    /// The configuration as it was read.
    pub config: Config,
    /// The sensors of the configuration, in its order.
    pub sensors: Vec<Sensor>,
    /// The model that the configuration names.
    pub hrn: Arc<Model>,
    /// The text of the configuration.
    pub text: Text,
    /// The model with the references of the sensors that have some.
    identified: BTreeMap<String, Arc<Model>>,
}

impl Setup {
    /// The sensor of this name, or the first one without a name.
    ///
    /// # Errors
    ///
    /// Fails if no sensor has the name.
    pub fn sensor_named(&self, name: Option<&str>) -> anyhow::Result<&Sensor> {
        let Some(name) = name else {
            return Ok(&self.sensors[0]);
        };
        let mut sensors = self.sensors.iter();
        let named = sensors.find(|sensor| sensor.name() == name);
        named.with_context(|| {
            let names: Vec<&str> = self.sensors.iter().map(Sensor::name).collect();
            let names = names.join(", ");
            format!("--sensor: found {name:?}, expected one of {names}")
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
            Format::Parts => "judges whole presses on the sensor's own grid, needs no arm",
            Format::Course { .. } if self.hrn.most_references() > 0 => {
                "judges whole presses, best with the arm's positions and with references of each sensor"
            }
            Format::Course { .. } => {
                "judges whole presses, needs the arm's positions or sensor.arm.speed_mm_s"
            }
        }
    }

    /// Reads a configuration and its model. `model` replaces the configuration's own.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Config::load`] and [`Self::of`].
    pub fn load(path: &Path, model: Option<&Path>) -> Result<Self, Error> {
        let (config, text) = parse::load(path)?;
        Self::of_text(config.with_model(model), path, text)?.checked(path)
    }

    /// Refuses a sensor of another array than that of a model with a grid of its own. The sensors of a
    /// recording are not those of the configuration, so [`Self::of`] does not.
    ///
    /// # Errors
    ///
    /// Returns an error that names the first such sensor.
    pub fn checked(self, path: &Path) -> Result<Self, Error> {
        for sensor in &self.sensors {
            let checked = self.hrn.card().check_array(sensor.layout().array());
            checked.map_err(|error| {
                let problem = format!("sensor {:?}: {error}", sensor.name());
                Error::at(path, &self.text)(OutOfRange::because("model.path", problem).into())
            })?;
        }
        Ok(self)
    }

    /// Checks `config` and loads its model. `path` is only for messages.
    ///
    /// # Errors
    ///
    /// Returns an [`Error`] for the first value that cannot be used, and an error if the model cannot
    /// be read or is refused.
    pub fn of(config: Config, path: &Path) -> Result<Self, Error> {
        Self::of_text(config, path, Text::default())
    }

    fn of_text(config: Config, path: &Path, text: Text) -> Result<Self, Error> {
        let sensors = check::check(&config).map_err(Error::at(path, &text))?;
        let rates = config.sensors.iter().map(|sensor| sensor.frame_rate_hz);
        let most = trial::verdict_most(rates.fold(0.0, f64::max));
        let hrn = parse::model(&config, most).map_err(Error::at(path, &text))?;
        let hrn = Arc::new(hrn);
        let mut identified = BTreeMap::new();
        for (index, sensor) in config.sensors.iter().enumerate() {
            if let Some(file) = &sensor.references {
                let own = parse::identified(&hrn, file, (index, sensor));
                let own = own.map_err(Error::at(path, &text))?;
                identified.insert(sensor.name.clone(), Arc::new(own));
            }
        }
        Ok(Self {
            config,
            sensors,
            hrn,
            text,
            identified,
        })
    }

    /// The sensors that have references, each with its model.
    pub fn identified(&self) -> impl Iterator<Item = (&str, &Arc<Model>)> {
        self.identified
            .iter()
            .map(|(name, hrn)| (name.as_str(), hrn))
    }

    /// Whether the sensor at `index` runs on with the tables of `other`: its own, those of all sensors
    /// at its port, and `[press]` are the same.
    pub(super) fn is_same(&self, other: &Self, index: usize) -> bool {
        let at_its_port = |setup: &Self| -> Vec<sensor::Settings> {
            let sensors = &setup.config.sensors;
            let at_it = sensors.iter().filter(|one| one.port == sensors[index].port);
            at_it.cloned().collect()
        };
        let is_same = self.config.sensors[index] == other.config.sensors[index];
        is_same
            && self.config.press == other.config.press
            && at_its_port(self) == at_its_port(other)
    }

    /// The model for the presses of a sensor.
    pub fn hrn_of(&self, sensor: &str) -> &Arc<Model> {
        self.identified.get(sensor).unwrap_or(&self.hrn)
    }
}

#[cfg(test)]
mod tests;
