//! The sensor that a configuration of the daemon describes first.

use std::path::{Path, PathBuf};
use std::{fs, io};

use hardnessd_core::npy;
use hardnessd_core::press;
use hardnessd_core::range::OutOfRange;
use hardnessd_core::sensor::{self, Description, Sensor};
use hardnessd_core::tare::Gains;
use hardnessd_core::verdict::Level;
use hardnessd_core::wording;
use serde::Deserialize;

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
        source: io::Error,
    },
    #[error("{}: {source}", path.display())]
    Sensor { path: PathBuf, source: OutOfRange },
}

/// The tables of a configuration that describe a sensor.
#[derive(Deserialize)]
struct Tables {
    #[serde(default, rename = "sensor")]
    sensors: Vec<sensor::Settings>,
    #[serde(default)]
    press: press::Settings,
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
    let tables: Tables = toml::from_str(&text).map_err(|error| syntax(&error))?;
    let Some(mut sensor) = tables.sensors.into_iter().next() else {
        return Err(ConfigurationError::NoSensor(path.to_owned()).into());
    };
    if let Some(Gains::File(file)) = &sensor.calibration.gains {
        let file = path.with_file_name("").join(file);
        let refused = |source: io::Error| ConfigurationError::Gains {
            path: path.to_owned(),
            file: file.clone(),
            source,
        };
        let bytes = fs::read(&file).map_err(refused)?;
        let rows = npy::table(&mut bytes.as_slice()).map_err(refused)?;
        sensor.calibration.gains = Some(Gains::Taxels(rows));
    }
    let description = Description {
        sensor,
        press: tables.press,
        ..Description::default()
    };
    let sensor = Sensor::new(description).map_err(|source| ConfigurationError::Sensor {
        path: path.to_owned(),
        source,
    })?;
    Ok(sensor)
}

/// The levels of the `[[level]]` tables. `None` without such tables.
pub(super) fn levels(path: &Path) -> anyhow::Result<Option<Vec<Level>>> {
    #[derive(serde::Deserialize)]
    struct Named {
        label: String,
        shore: [f64; 2],
    }
    #[derive(serde::Deserialize)]
    struct Tables {
        #[serde(default)]
        level: Vec<Named>,
    }
    let text = fs::read_to_string(path)?;
    let tables: Tables = toml::from_str(&text).map_err(|error| ConfigurationError::Syntax {
        path: path.to_owned(),
        problem: wording::of_toml(&text, &error),
    })?;
    let level = |(
        level,
        Named {
            label,
            shore: [low, high],
        },
    )| Level {
        level,
        label,
        shore: format!("{low}-{high}"),
    };
    let levels: Vec<Level> = (1..).zip(tables.level).map(level).collect();
    Ok((!levels.is_empty()).then_some(levels))
}
