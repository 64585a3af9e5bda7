//! Reads the file into a [`Config`], and loads the model that the file names.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::error::{MAX_BYTES, Problem};
use super::read::{Until, read};
use super::{Config, LevelTable};
use crate::daemon::port::Port;
use hardnessd_core::tare::Gains;
use hardnessd_core::verdict::{self, Hrn, Level};
use hardnessd_core::{npy, references, trial, wording};

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
            resolve(device, directory, &key, "the path of a device")?;
        }
        if let Some(file) = &mut sensor.references {
            let key = format!("sensor.references of {:?}", sensor.name);
            resolve(file, directory, &key, "the path of an .npz file")?;
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
            resolve(given, directory, key, "a path")?;
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
    resolve(&mut file, directory, &key, "the path of an .npy file")?;
    let bytes = read_named(&key, &file, MAX_BYTES, until)?;
    let rows = npy::table(&mut bytes.as_slice()).map_err(|found| {
        let problem = format!("found {found}, expected f32 [rows, cols]");
        unusable(&key, &file, problem)
    })?;
    Ok(Gains::Taxels(rows))
}

/// Reads the file that the configuration names at `key`.
fn read_named(key: &str, file: &Path, most: usize, until: Until) -> Result<Vec<u8>, Problem> {
    let bytes = read(file, most, until);
    bytes.map_err(|error| unusable(key, file, format!("cannot read: {error}")))
}

/// The problem of the file that the configuration names at `key`.
fn unusable(key: &str, file: &Path, source: impl Into<Box<dyn Error + Send + Sync>>) -> Problem {
    Problem::File {
        key: key.to_owned(),
        file: file.to_owned(),
        source: source.into(),
    }
}

/// Resolves a path of the configuration against its directory. An empty path is refused, because it
/// would be the directory itself. A path with a hidden character is refused, because it would break
/// or disguise a line of the log.
fn resolve(
    given: &mut PathBuf,
    directory: &Path,
    key: &str,
    expected: &'static str,
) -> Result<(), Problem> {
    let text = given.to_string_lossy();
    if text.is_empty() || !wording::is_plain(&text) {
        return Err(Problem::Value {
            key: key.to_owned(),
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
    let (key, model) = ("model.path", &config.model);
    let (file, hrn) = match &model.path {
        None => (
            Path::new("the model built in"),
            Hrn::load(model.built_in.bytes()),
        ),
        Some(file) => {
            let bytes = read_named(key, file, verdict::MAX_FILE_BYTES, until)?;
            (file.as_path(), trial::load(&bytes, Some(most)))
        }
    };
    let hrn = hrn.map_err(|error| unusable(key, file, error))?;
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
    let key = format!("sensor.references of {sensor:?}");
    let bytes = read_named(&key, file, references::MAX_FILE_BYTES, until)?;
    let presses = references::read(&bytes).map_err(|error| unusable(&key, file, error))?;
    let (found, most) = (presses.len(), hrn.most_references());
    if most == 0 {
        return Ok(hrn.clone());
    }
    if found > most {
        let problem =
            format!("found {found} presses, expected at most {most}, as many as the model takes");
        return Err(unusable(&key, file, problem));
    }
    let references = hrn.references(&presses);
    let references = references.map_err(|error| unusable(&key, file, error))?;
    let identified = hrn.identified(references);
    identified.map_err(|error| unusable(&key, file, error))
}
