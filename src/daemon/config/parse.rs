//! Reads the file into a [`Config`], and loads the model that the file names.

use std::fmt::Display;
use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::error::{MAX_BYTES, Problem, Text};
use super::{Config, Error};
use hardnessd_core::port::Port;
use hardnessd_core::range::OutOfRange;
use hardnessd_core::tare::Gains;
use hardnessd_core::verdict::{self, LevelTable, Model};
use hardnessd_core::{npy, range, references, sensor, trial, wording};

/// The configuration at `path` with its paths resolved and its gains read, and its text.
pub(super) fn load(path: &Path) -> Result<(Config, Text), Error> {
    let text = text(path).map_err(Error::at(path, &Text::default()))?;
    let config = config(&text, path);
    let config = config.map_err(Error::at(path, &text))?;
    Ok((config, text))
}

fn text(path: &Path) -> Result<Text, Problem> {
    let bytes = read_at_most(path, MAX_BYTES).map_err(|error| Problem::unreadable(&error))?;
    if bytes.len() > MAX_BYTES {
        let problem = "no configuration is so long: name another file";
        return Err(Problem::of_file(format!(
            "more than {MAX_BYTES} bytes: {problem}"
        )));
    }
    let text = String::from_utf8(bytes);
    text.map(Text)
        .map_err(|error| Problem::of_file(format!("not a text file, such as TOML: {error}")))
}

fn config(Text(text): &Text, path: &Path) -> Result<Config, Problem> {
    let mut config: Config = toml::from_str(text).map_err(|error| syntax(text, &error))?;
    let directory = path.parent().unwrap_or(Path::new(""));
    for (index, sensor) in config.sensors.iter_mut().enumerate() {
        let resolved = resolve_of(sensor, directory);
        resolved.map_err(|problem| problem.of((index, sensor)))?;
    }
    let unix = &mut config.publish.unix;
    let record = config.record.as_mut();
    let paths = [
        ("model.path", config.model.path.as_mut()),
        ("publish.unix.path", unix.path.as_mut()),
        ("publish.unix.control_path", unix.control_path.as_mut()),
        ("record.dir", record.and_then(|record| record.dir.as_mut())),
    ];
    for (key, given) in paths {
        resolve(given, directory, key)?;
    }
    Ok(config)
}

/// Resolves the paths of a sensor, and reads its gains.
fn resolve_of(sensor: &mut sensor::Settings, directory: &Path) -> Result<(), Problem> {
    if let Port::Device(device) = &mut sensor.port {
        if device.as_os_str().is_empty() {
            let expected = "a path under /dev/serial/by-id/";
            return Err(OutOfRange::new("sensor.port", format_args!("none"), expected).into());
        }
        resolve(Some(device), directory, "sensor.port")?;
    }
    resolve(sensor.references.as_mut(), directory, "sensor.references")?;
    if let Some(given) = &mut sensor.calibration.gains {
        *given = gains(given, directory)?;
    }
    Ok(())
}

/// Reads the gains from the file that the configuration names.
fn gains(given: &Gains, directory: &Path) -> Result<Gains, Problem> {
    let key = "sensor.calibration.gains";
    let Gains::File(file) = given else {
        let found = format_args!("a list");
        return Err(OutOfRange::new(key, found, "the path of an .npy file").into());
    };
    let mut file = file.clone();
    resolve(Some(&mut file), directory, key)?;
    let bytes = read_named(key, &file, MAX_BYTES)?;
    let rows = npy::table(&mut bytes.as_slice()).map_err(|found| {
        let problem = format!("found {found}, expected f32 [rows, cols]");
        unusable(key, &file, problem)
    })?;
    Ok(Gains::Taxels(rows))
}

/// Reads at most one byte more than `most` from a file. That byte shows that the file is too long.
pub(crate) fn read_at_most(path: &Path, most: usize) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let file = File::open(path)?;
    file.take(most as u64 + 1).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Reads the file that the configuration names at `key`.
fn read_named(key: &str, file: &Path, most: usize) -> Result<Vec<u8>, Problem> {
    let bytes = read_at_most(file, most);
    bytes.map_err(|error| unusable(key, file, format!("cannot read: {error}")))
}

/// The problem of the file that the configuration names at `key`.
fn unusable(key: &str, file: &Path, problem: impl Display) -> Problem {
    OutOfRange::because(key, format_args!("{}: {problem}", file.display())).into()
}

/// Resolves a path of the configuration, if it is given, against its directory. An empty path is refused,
/// because it would be the directory itself. A path with a hidden character is refused, because it would break
/// or disguise a line of the log.
fn resolve(given: Option<&mut PathBuf>, directory: &Path, key: &str) -> Result<(), Problem> {
    let Some(given) = given else {
        return Ok(());
    };
    let text = given.to_string_lossy();
    let expected = "a path without control or bidirectional characters";
    range::check(
        key,
        &text,
        !text.is_empty() && wording::is_plain(&text),
        expected,
    )?;
    *given = directory.join(&*given);
    Ok(())
}

/// The parser's error, or the better words for a file that has `[sensor]` in place of `[[sensor]]`.
fn syntax(text: &str, error: &toml::de::Error) -> Problem {
    let table = text.parse::<toml::Table>().unwrap_or_default();
    if table.get("sensor").is_some_and(toml::Value::is_table) {
        let line = text.lines().position(|line| line.trim() == "[sensor]");
        let line = line.map_or_else(String::new, |line| format!("line {}: ", line + 1));
        return Problem::of_file(format!(
            "{line}write [[sensor]], not [sensor]: there may be several"
        ));
    }
    Problem::of_file(wording::of_toml(text, error))
}

/// Loads the model. If it is a file, another process tries it first. `most` is the longest time
/// that a verdict may take.
pub(super) fn model(config: &Config, most: Duration) -> Result<Model, Problem> {
    let (key, model) = ("model.path", &config.model);
    let (file, hrn) = match &model.path {
        None => (
            Path::new("the model built in"),
            Model::load(model.built_in.bytes()),
        ),
        Some(file) => {
            let bytes = read_named(key, file, verdict::MAX_FILE_BYTES)?;
            (file.as_path(), trial::load(&bytes, Some(most)))
        }
    };
    let hrn = hrn.map_err(|error| unusable(key, file, wording::line(&error)))?;
    if let Some(expected) = &model.sha256
        && !expected.eq_ignore_ascii_case(hrn.sha256())
    {
        let found = format_args!("a model of {}", hrn.sha256());
        let expected = expected.as_str();
        return Err(OutOfRange::new("model.sha256", found, expected).into());
    }
    if config.levels.is_empty() {
        return Ok(hrn);
    }
    let levels = LevelTable::levels(&config.levels);
    let levelled = levels.and_then(|levels| hrn.with_levels(levels));
    levelled.map_err(|error| OutOfRange::because("level", error).into())
}

/// The model with the references in `file`, which are those of `sensor`.
pub(super) fn identified(
    hrn: &Model,
    file: &Path,
    sensor: (usize, &sensor::Settings),
) -> Result<Model, Problem> {
    let key = "sensor.references";
    let own = || {
        let bytes = read_named(key, file, references::MAX_FILE_BYTES)?;
        let presses = references::read(&bytes).map_err(|error| unusable(key, file, error))?;
        let (found, most) = (presses.len(), hrn.most_references());
        if most == 0 {
            return Ok(hrn.clone());
        }
        if found > most {
            let problem = format!(
                "found {found} presses, expected at most {most}, as many as the model takes"
            );
            return Err(unusable(key, file, problem));
        }
        let identified = hrn.identified_by(&presses);
        let (identified, _) = identified.map_err(|error| unusable(key, file, error))?;
        Ok(identified)
    };
    own().map_err(|problem: Problem| problem.of(sensor))
}
