//! The sensor that a configuration of the daemon describes first, and its levels.

use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use hardnessd_core::exit::CONFIG;
use hardnessd_core::npy;
use hardnessd_core::press;
use hardnessd_core::sensor::{self, Description, Sensor};
use hardnessd_core::tare::Gains;
use hardnessd_core::verdict::{Level, LevelTable};
use hardnessd_core::wording;
use hrn_train::exit::coded;
use hrn_train::run::disk::read_text;
use serde::Deserialize;

/// The most bytes of a file of gains.
const MOST_GAINS_BYTES: u64 = 1 << 20;

/// Tables of a configuration. The daemon's `check` checks the rest.
#[derive(Deserialize)]
struct Tables {
    #[serde(default)]
    sensor: Vec<sensor::Settings>,
    #[serde(default)]
    press: press::Settings,
    #[serde(default)]
    level: Vec<LevelTable>,
}

/// The first sensor of a configuration, and the levels of its `[[level]]` tables if it has some. Without a
/// configuration, the sensor is a JX255N.
pub(super) fn described(path: Option<&Path>) -> anyhow::Result<(Sensor, Option<Vec<Level>>)> {
    let Some(path) = path else {
        return Ok((Sensor::new(Description::default())?, None));
    };
    let text = read_text(path)?;
    let tables = toml::from_str(&text).map_err(|error| wording::of_toml(&text, &error));
    let read = tables.and_then(|tables| read(tables, path));
    read.map_err(|problem| coded(CONFIG, format_args!("{}: {problem}", path.display())))
}

fn read(tables: Tables, path: &Path) -> Result<(Sensor, Option<Vec<Level>>), String> {
    let sensor = tables.sensor.into_iter().next();
    let mut sensor = sensor.ok_or("has no [[sensor]] table")?;
    if let Some(Gains::File(file)) = &sensor.calibration.gains {
        let file = path.with_file_name("").join(file);
        let opened = File::open(&file);
        let rows = opened.and_then(|file| npy::table(&mut file.take(MOST_GAINS_BYTES)));
        let rows = rows.map_err(|error| {
            let file = file.display();
            format!("sensor.calibration.gains: {file}: {error}")
        })?;
        sensor.calibration.gains = Some(Gains::Taxels(rows));
    }
    let description = Description {
        sensor,
        press: tables.press,
        ..Description::default()
    };
    let sensor = Sensor::new(description).map_err(|error| error.to_string())?;
    let levels = (!tables.level.is_empty()).then(|| LevelTable::levels(&tables.level));
    let levels = levels.transpose();
    Ok((sensor, levels.map_err(|error| format!("level: {error}"))?))
}
