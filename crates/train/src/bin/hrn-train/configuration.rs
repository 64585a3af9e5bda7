//! The sensor that a configuration of the daemon describes first, and its levels.

use std::fs;
use std::path::Path;

use hardnessd_core::exit::CONFIG;
use hardnessd_core::npy;
use hardnessd_core::press;
use hardnessd_core::sensor::{self, Description, Sensor};
use hardnessd_core::tare::Gains;
use hardnessd_core::verdict::{Borders, Level, are_levels};
use hardnessd_core::wording;
use hrn_train::data::source::MOST_LEVELS;
use hrn_train::exit::{coded, unreadable};
use serde::Deserialize;
use serde::de::DeserializeOwned;

/// Tables of a configuration. The daemon's `check` checks the rest.
fn tables<T: DeserializeOwned>(path: &Path) -> anyhow::Result<T> {
    let text = fs::read_to_string(path).map_err(|error| unreadable(path, &error))?;
    toml::from_str(&text).map_err(|error| refused(path, wording::of_toml(&text, &error)))
}

/// The error of a configuration.
fn refused(path: &Path, problem: impl std::fmt::Display) -> anyhow::Error {
    coded(CONFIG, format_args!("{}: {problem}", path.display()))
}

/// Reads the first `[[sensor]]` table and the `[press]` table.
pub(super) fn first_sensor(path: &Path) -> anyhow::Result<Sensor> {
    #[derive(Deserialize)]
    struct Tables {
        #[serde(default, rename = "sensor")]
        sensors: Vec<sensor::Settings>,
        #[serde(default)]
        press: press::Settings,
    }
    let tables: Tables = tables(path)?;
    let sensor = tables.sensors.into_iter().next();
    let mut sensor = sensor.ok_or_else(|| refused(path, "has no [[sensor]] table"))?;
    if let Some(Gains::File(file)) = &sensor.calibration.gains {
        let file = path.with_file_name("").join(file);
        let rows = fs::read(&file).and_then(|bytes| npy::table(&mut bytes.as_slice()));
        let rows = rows.map_err(|error| {
            refused(
                path,
                format_args!("sensor.calibration.gains: {}: {error}", file.display()),
            )
        })?;
        sensor.calibration.gains = Some(Gains::Taxels(rows));
    }
    let description = Description {
        sensor,
        press: tables.press,
        ..Description::default()
    };
    Sensor::new(description).map_err(|error| refused(path, error))
}

/// The levels of the `[[level]]` tables, which a data set can have. `None` without such tables.
pub(super) fn levels(path: &Path) -> anyhow::Result<Option<Vec<Level>>> {
    #[derive(Deserialize)]
    struct Named {
        label: String,
        shore: [f64; 2],
    }
    #[derive(Deserialize)]
    struct Tables {
        #[serde(default)]
        level: Vec<Named>,
    }
    let tables: Tables = tables(path)?;
    let levels = tables.level.into_iter().zip(1..).map(|(of, level)| Level {
        level,
        label: of.label,
        shore: format!("{}-{}", of.shore[0], of.shore[1]),
    });
    let levels: Vec<Level> = levels.collect();
    if levels.is_empty() {
        return Ok(None);
    }
    if !(2..=MOST_LEVELS).contains(&levels.len()) {
        let problem = format!(
            "level: found {} tables, expected 2 to {MOST_LEVELS}",
            levels.len()
        );
        return Err(refused(path, problem));
    }
    if !are_levels(&levels) {
        return Err(refused(
            path,
            "level: a label is empty, too long or not plain text",
        ));
    }
    Borders::of(&levels).map_err(|error| refused(path, format_args!("level: {error}")))?;
    Ok(Some(levels))
}
