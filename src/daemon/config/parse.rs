//! Reads the file into a [`Config`], and loads the model that the file names.

use std::path::{Path, PathBuf};
use std::time::Duration;

use super::error::{MAX_BYTES, Problem, ReferencesProblem};
use super::read::{Until, read};
use super::{Config, LevelTable};
use crate::daemon::port::Port;
use hardnessd_core::npy::{self, NpyError};
use hardnessd_core::tare::Gains;
use hardnessd_core::verdict::{self, Hrn, Level};
use hardnessd_core::{references, trial, wording};

pub(super) fn load(path: &Path, until: Until) -> Result<Config, Problem> {
    let bytes = read(path, MAX_BYTES, until).map_err(Problem::Unreadable)?;
    if bytes.len() > MAX_BYTES {
        return Err(Problem::TooLong);
    }
    let text = std::str::from_utf8(&bytes).map_err(|error| Problem::Syntax(error.to_string()))?;
    let mut config: Config = toml::from_str(text).map_err(|error| syntax(text, &error))?;
    let directory = path.parent().unwrap_or(Path::new(""));
    for sensor in &mut config.sensors {
        if let Port::Device(device) = &mut sensor.port {
            if device.as_os_str().is_empty() {
                return Err(Problem::NoPort {
                    sensor: sensor.name.clone(),
                });
            }
            let key = format!("sensor.port of {:?}", sensor.name);
            resolve(device, directory, key, "the path of a device")?;
        }
        if let Some(file) = &mut sensor.references {
            let key = format!("sensor.references of {:?}", sensor.name);
            resolve(file, directory, key, "the path of an .npz file")?;
        }
        if let Some(given) = &mut sensor.calibration.gains {
            *given = gains(given, directory, &sensor.name, until)?;
        }
    }
    let unix = &mut config.publish.unix;
    let paths = [
        ("model.path", Some(&mut config.model.path)),
        ("publish.unix.path", Some(&mut unix.path)),
        ("publish.unix.control_path", Some(&mut unix.control_path)),
        (
            "record.dir",
            config.record.as_mut().map(|record| &mut record.dir),
        ),
    ];
    for (key, given) in paths {
        if let Some(Some(given)) = given {
            resolve(given, directory, key.to_owned(), "a path")?;
        }
    }
    Ok(config)
}

/// Reads the gains from the file that the configuration names.
fn gains(given: &Gains, directory: &Path, sensor: &str, until: Until) -> Result<Gains, Problem> {
    let key = format!("sensor.calibration.gains of {sensor:?}");
    let Gains::File(file) = given else {
        return Err(Problem::Value {
            key,
            found: "a list".to_owned(),
            expected: "the path of an .npy file",
        });
    };
    let mut file = file.clone();
    resolve(&mut file, directory, key, "the path of an .npy file")?;
    let refused = |source| Problem::Gains {
        sensor: sensor.to_owned(),
        file: file.clone(),
        source,
    };
    let bytes = read(&file, MAX_BYTES, until).map_err(|source| refused(NpyError::Io(source)))?;
    let rows = npy::table(&mut bytes.as_slice()).map_err(refused)?;
    Ok(Gains::Taxels(rows))
}

/// Resolves a path of the configuration against its directory. An empty path is refused, because it
/// would be the directory itself. A path with a hidden character is refused, because it would break
/// or disguise a line of the log.
fn resolve(
    given: &mut PathBuf,
    directory: &Path,
    key: String,
    expected: &'static str,
) -> Result<(), Problem> {
    let text = given.to_string_lossy();
    if text.is_empty() || !wording::is_plain(&text) {
        return Err(Problem::Value {
            key,
            found: format!("{text:?}"),
            expected,
        });
    }
    *given = directory.join(&*given);
    Ok(())
}

/// The parser's error, or the better words for a file that has `[sensor]` in place of `[[sensor]]`.
fn syntax(text: &str, error: &toml::de::Error) -> Problem {
    let table = text.parse::<toml::Table>().unwrap_or_default();
    if table.get("sensor").is_some_and(toml::Value::is_table) {
        return Problem::SingleBrackets;
    }
    Problem::Syntax(wording::of_toml(text, error))
}

/// Loads the model. If it is a file, another process tries it first. `most` is the longest time
/// that a verdict may take.
pub(super) fn model(config: &Config, most: Duration, until: Until) -> Result<Hrn, Problem> {
    let model = &config.model;
    let hrn = match &model.path {
        None => Hrn::load(model.built_in.bytes()),
        Some(file) => {
            let bytes = read(file, verdict::MAX_FILE_BYTES, until);
            let bytes = bytes.map_err(|source| Problem::ModelUnreadable {
                model: file.clone(),
                source,
            })?;
            trial::load(&bytes, Some(most))
        }
    };
    let hrn = hrn.map_err(|problem| Problem::Model {
        model: model.path.as_ref().map_or_else(
            || "the model built in".to_owned(),
            |file| file.display().to_string(),
        ),
        source: Box::new(problem),
    })?;
    if let Some(expected) = &model.sha256
        && !expected.eq_ignore_ascii_case(hrn.sha256())
    {
        return Err(Problem::ModelHash {
            found: hrn.sha256().to_owned(),
            expected: expected.clone(),
        });
    }
    if config.levels.is_empty() {
        return Ok(hrn);
    }
    let level = |(level, table): (u8, &LevelTable)| Level {
        level,
        label: table.label.clone(),
        shore: format!("{}-{}", table.shore[0], table.shore[1]),
    };
    let levels: Vec<Level> = (1..=u8::MAX).zip(&config.levels).map(level).collect();
    Ok(hrn.with_levels(levels)?)
}

/// The model with the references in `file`, which are those of `sensor`.
pub(super) fn identified(
    hrn: &Hrn,
    file: &Path,
    sensor: &str,
    until: Until,
) -> Result<Hrn, Problem> {
    let refused = |source: ReferencesProblem| Problem::References {
        sensor: sensor.to_owned(),
        file: file.to_owned(),
        source: Box::new(source),
    };
    let bytes = read(file, references::MAX_FILE_BYTES, until);
    let bytes = bytes.map_err(|source| refused(ReferencesProblem::Unreadable(source)))?;
    let presses = references::read(&bytes).map_err(|source| refused(source.into()))?;
    if hrn.most_references() == 0 {
        return Ok(hrn.clone());
    }
    if presses.len() > hrn.most_references() {
        return Err(refused(ReferencesProblem::Many {
            found: presses.len(),
            expected: hrn.most_references(),
        }));
    }
    let references = hrn
        .references(&presses)
        .map_err(|source| refused(source.into()))?;
    hrn.identified(references)
        .map_err(|source| refused(source.into()))
}
