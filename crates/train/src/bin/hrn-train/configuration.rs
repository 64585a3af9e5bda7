//! The sensor that a configuration of the daemon describes first.

use std::fs;
use std::path::{Path, PathBuf};

use hardnessd_core::npy::{self, NpyError};
use hardnessd_core::sensor::{Description, Sensor, SensorError};
use hardnessd_core::tare::Gains;
use hardnessd_core::wording;
use toml::{Table, Value};

use super::failure::Unreadable;

/// The error of a configuration that describes no sensor.
#[derive(Debug, thiserror::Error)]
pub(super) enum ConfigurationError {
    #[error("{}: {problem}", path.display())]
    Syntax { path: PathBuf, problem: String },
    #[error("{}: has no [[sensor]] table", .0.display())]
    NoSensor(PathBuf),
    #[error("{}: sensor.calibration.gains: {}: {source}", path.display(), file.display())]
    Gains {
        path: PathBuf,
        file: PathBuf,
        source: NpyError,
    },
    #[error("{}: sensor.{source}", path.display())]
    Sensor { path: PathBuf, source: SensorError },
}

/// Reads the first `[[sensor]]` table and the `[press]` table. The daemon's `check` checks the rest.
pub(super) fn first_sensor(path: &Path) -> anyhow::Result<Sensor> {
    let text = fs::read_to_string(path).map_err(|source| Unreadable {
        path: path.to_owned(),
        source,
    })?;
    let syntax = |error: &toml::de::Error| ConfigurationError::Syntax {
        path: path.to_owned(),
        problem: wording::of_toml(&text, error),
    };
    let mut file: Table = text.parse().map_err(|error| syntax(&error))?;
    let sensors = file.remove("sensor");
    let sensors = sensors.and_then(|sensors| sensors.try_into::<Vec<Table>>().ok());
    let first = sensors.and_then(|sensors| sensors.into_iter().next());
    let Some(mut table) = first else {
        return Err(ConfigurationError::NoSensor(path.to_owned()).into());
    };
    table.retain(|key, _| key != "port" && key != "baud");
    table.extend(
        file.remove("press")
            .map(|press| ("press".to_owned(), press)),
    );
    let description: Result<Description, _> = Value::Table(table).try_into();
    let mut description = description.map_err(|error| syntax(&error))?;
    if let Some(Gains::File(file)) = &description.calibration.gains {
        let file = path.with_file_name("").join(file);
        let refused = |source| ConfigurationError::Gains {
            path: path.to_owned(),
            file: file.clone(),
            source,
        };
        let bytes = fs::read(&file).map_err(|source| refused(NpyError::Io(source)))?;
        let rows = npy::table(&mut bytes.as_slice()).map_err(refused)?;
        description.calibration.gains = Some(Gains::Taxels(rows));
    }
    let sensor = Sensor::new(description).map_err(|source| ConfigurationError::Sensor {
        path: path.to_owned(),
        source,
    })?;
    Ok(sensor)
}
