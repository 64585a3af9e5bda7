//! The sensor that a configuration of the daemon describes first, and its levels.

use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use hardnessd_core::exit::CONFIG;
use hardnessd_core::npy;
use hardnessd_core::press;
use hardnessd_core::sensor::{self, Description, Sensor};
use hardnessd_core::tare::Gains;
use hardnessd_core::verdict::{Borders, Level, LevelTable, are_levels};
use hardnessd_core::wording;
use hrn_train::data::source::MOST_LEVELS;
use hrn_train::exit::coded;
use hrn_train::run::disk::read_text;
use serde::Deserialize;
use serde::de::DeserializeOwned;

/// The most bytes of a file of gains.
const MOST_GAINS_BYTES: u64 = 1 << 20;

/// Tables of a configuration. The daemon's `check` checks the rest.
fn tables<T: DeserializeOwned>(path: &Path) -> anyhow::Result<T> {
    let text = read_text(path)?;
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
        let opened = File::open(&file);
        let rows = opened.and_then(|file| npy::table(&mut file.take(MOST_GAINS_BYTES)));
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
    struct Tables {
        #[serde(default)]
        level: Vec<LevelTable>,
    }
    let tables: Tables = tables(path)?;
    let levels = LevelTable::levels(&tables.level);
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
