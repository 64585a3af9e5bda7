//! The configuration file: every table composed, every value checked once, at the door.
//!
//! In: a TOML file. Out: a [`Setup`]: the [`Config`], the sensors it describes and its model, all
//! checked. A key that is unknown, or of a part that this version does not have, is an error that
//! names the file and the key, what was found and what was expected. Paths in the file are
//! relative to its directory.

mod error;
mod publish;
mod check;
mod parse;

use std::env;
use std::net::SocketAddr;
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Deserializer, Serialize};

pub use self::error::Error;
pub use self::publish::{
    Endpoint, EndpointError, Foxglove, Mode, ModeError, Publish, Ros2, Tcp, Unix, Zenoh,
};
use super::log;
use crate::sensor::{Description, Sensor};
use crate::verdict::Hrn;
use crate::{motion, press, tare, trial, wire};

/// The whole file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of the robot; by default the host's.
    #[serde(default = "host")]
    pub robot: String,
    /// The sensors served.
    #[serde(default, rename = "sensor")]
    pub sensors: Vec<SensorTable>,
    /// What a press is.
    #[serde(default)]
    pub press: press::Settings,
    /// The model that judges.
    #[serde(default)]
    pub model: Model,
    /// Where events go.
    #[serde(default)]
    pub publish: Publish,
    /// The live page and the other HTTP routes; off unless the table is there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub http: Option<Http>,
    /// The daemon's own recording; off unless the table is there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub record: Option<Record>,
    /// How the log is written.
    #[serde(default)]
    pub log: log::Settings,
}

/// A `[[sensor]]` table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorTable {
    /// Its name, unique, `[a-z][a-z0-9_]*`.
    #[serde(default = "default_name")]
    pub name: String,
    /// Its device file.
    pub port: PathBuf,
    /// Bits a second on the line; a pty and USB CDC ignore it.
    #[serde(default = "default_baud", deserialize_with = "above_zero")]
    pub baud: u32,
    /// Expected rate.
    #[serde(default = "default_frame_rate_hz")]
    pub frame_rate_hz: f64,
    /// A live sensor is stale after a silence of this length; by default the larger of 2.5 periods
    /// and 50 ms.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stale_after_ms: Option<f64>,
    /// How a frame is written.
    #[serde(default)]
    pub frame: wire::Settings,
    /// Counts to newtons.
    #[serde(default)]
    pub calibration: tare::Settings,
    /// The arm that presses with it.
    #[serde(default)]
    pub arm: motion::Settings,
}

fn default_name() -> String {
    Description::default().name
}

fn default_baud() -> u32 {
    115_200
}

fn above_zero<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u32, D::Error> {
    NonZeroU32::deserialize(deserializer).map(NonZeroU32::get)
}

fn default_frame_rate_hz() -> f64 {
    Description::default().frame_rate_hz
}

impl SensorTable {
    /// A sensor at `port`, all else by default.
    pub fn new(port: PathBuf) -> Self {
        Self {
            name: default_name(),
            port,
            baud: default_baud(),
            frame_rate_hz: default_frame_rate_hz(),
            stale_after_ms: None,
            frame: wire::Settings::default(),
            calibration: tare::Settings::default(),
            arm: motion::Settings::default(),
        }
    }
}

/// The `[model]` table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Model {
    /// ONNX file; by default the one built in.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub path: Option<PathBuf>,
    /// Hash that the file must have.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sha256: Option<String>,
    /// A verdict below this confidence is rejected.
    pub min_confidence: f32,
    /// A verdict on less force is rejected.
    pub min_force_n: f64,
    /// A model of the course gives an early verdict with this confidence.
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
            path: None,
            sha256: None,
            min_confidence,
            min_force_n,
            early_confidence,
        }
    }
}

/// The `[http]` table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Http {
    /// Address and port.
    pub listen: SocketAddr,
}

impl Default for Http {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 8256)),
        }
    }
}

/// The `[record]` table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Record {
    /// The directory; [`Record::dir`] has the default.
    #[serde(skip_serializing_if = "Option::is_none")]
    dir: Option<PathBuf>,
    /// True: everything is recorded. False: only the last minute before a fault.
    pub continuous: bool,
    /// A file of this many million bytes is ended, and the next one begins.
    pub rotate_mb: u64,
    /// A file that is this old is ended, and the next one begins.
    pub rotate_s: u64,
    /// This many million bytes stay free on the disk. With less, nothing is written.
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
    /// The directory: the configured one, else the service's state directory, else
    /// `/var/lib/hardnessd`.
    pub fn dir(&self) -> PathBuf {
        if let Some(dir) = &self.dir {
            return dir.clone();
        }
        let directories = env::var("STATE_DIRECTORY").unwrap_or_default();
        // systemd separates several by colons.
        match directories.split(':').next() {
            Some(first) if !first.is_empty() => PathBuf::from(first),
            _ => PathBuf::from("/var/lib/hardnessd"),
        }
    }
}

fn host() -> String {
    rustix::system::uname()
        .nodename()
        .to_string_lossy()
        .into_owned()
}

impl Config {
    /// The defaults, for these sensors.
    pub fn new(sensors: Vec<SensorTable>) -> Self {
        Self {
            robot: host(),
            sensors,
            press: press::Settings::default(),
            model: Model::default(),
            publish: Publish::default(),
            http: None,
            record: None,
            log: log::Settings::default(),
        }
    }

    /// Reads a file. Whether its values can be used, [`Self::check`] says.
    ///
    /// # Errors
    ///
    /// [`Error`], if the file cannot be read, is no TOML, or has an unknown key, a value of another
    /// type or a path that none can be.
    pub fn load(path: &Path) -> Result<Self, Error> {
        parse::load(path)
    }

    /// Checks every value, and all of them together. Gives the sensors, in their order; `path` is
    /// for messages.
    ///
    /// # Errors
    ///
    /// [`Error`], for the first value that cannot be used.
    pub fn check(&self, path: &Path) -> Result<Vec<Sensor>, Error> {
        check::check(self, path)
    }

    /// What the file says of one of its sensors, in all its tables.
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

    /// The first key by which `self` and `other` differ that only a restart can change.
    pub fn fixed_difference(&self, other: &Self) -> Option<String> {
        if self.robot != other.robot {
            return Some("robot".to_owned());
        }
        if self.sensors.len() != other.sensors.len() {
            return Some("sensor".to_owned());
        }
        for (ours, theirs) in self.sensors.iter().zip(&other.sensors) {
            let key = if ours.port != theirs.port {
                Some("port")
            } else if ours.baud != theirs.baud {
                Some("baud")
            } else {
                let described = self.describe(ours);
                described.fixed_difference(&other.describe(theirs))
            };
            if let Some(key) = key {
                return Some(format!("sensor.{key} of \"{}\"", ours.name));
            }
        }
        let (ours, theirs) = (&self.publish, &other.publish);
        let (unix, their_unix) = (&ours.unix, &theirs.unix);
        let control_differs = unix.control_path() != their_unix.control_path();
        let differs = [
            ("publish.unix.enabled", unix.enabled != their_unix.enabled),
            ("publish.unix.path", unix.path() != their_unix.path()),
            ("publish.unix.mode", unix.mode != their_unix.mode),
            ("publish.unix.control_path", control_differs),
            (
                "publish.unix.max_clients",
                unix.max_clients != their_unix.max_clients,
            ),
            ("publish.tcp.listen", ours.tcp != theirs.tcp),
            ("publish.foxglove.listen", ours.foxglove != theirs.foxglove),
            ("publish.zenoh", ours.zenoh != theirs.zenoh),
            ("publish.ros2", ours.ros2 != theirs.ros2),
            ("http.listen", self.http != other.http),
            ("record", self.record != other.record),
        ];
        differs
            .iter()
            .find(|(_, differs)| *differs)
            .map(|(key, _)| (*key).to_owned())
    }
}

/// A configuration whose values have all been checked, and its model: ready to run.
#[derive(Debug, Clone)]
pub struct Setup {
    /// As read.
    pub config: Config,
    /// The sensors of the configuration, in its order.
    pub sensors: Vec<Sensor>,
    /// The model that it names.
    pub hrn: Arc<Hrn>,
}

impl Setup {
    /// Reads a configuration and its model.
    ///
    /// # Errors
    ///
    /// As [`Config::load`] and [`Self::of`].
    pub fn load(path: &Path) -> Result<Self, Error> {
        let config = Config::load(path)?;
        Self::of(config, path)
    }

    /// Checks `config` and loads its model; `path` is for messages.
    ///
    /// # Errors
    ///
    /// As [`Config::check`], and if the model cannot be read or is refused.
    pub fn of(config: Config, path: &Path) -> Result<Self, Error> {
        let sensors = config.check(path)?;
        let rates = config.sensors.iter().map(|sensor| sensor.frame_rate_hz);
        let most = trial::verdict_most(rates.fold(0.0, f64::max));
        let hrn = Arc::new(parse::model(&config.model, most, path)?);
        Ok(Self {
            config,
            sensors,
            hrn,
        })
    }
}

#[cfg(test)]
mod tests;
