//! The errors of a configuration. Each error names the file, the line and the key.

use std::path::Path;

use toml::de::{DeTable, DeValue};

use crate::daemon::Error;
use hardnessd_core::exit::{CONFIG, NO_INPUT};
use hardnessd_core::range::OutOfRange;
use hardnessd_core::sensor;

/// The most bytes of a configuration file. They are enough for a hundred sensors with every taxel
/// dead.
pub(super) const MAX_BYTES: usize = 1 << 20;

impl Error {
    /// Makes the error of a problem in the configuration at `path`, which has this text.
    pub(super) fn at(path: &Path, text: &Text) -> impl FnOnce(Problem) -> Self {
        move |problem| {
            let mut message = format!("{}: ", path.display());
            if let Some(key) = problem.key {
                let (index, name) = problem.sensor.unwrap_or_default();
                if let Some(line) = text.line(index, &key) {
                    message += &format!("line {line}: ");
                }
                message += &key;
                // A name that cannot be one is not repeated.
                if (1..=sensor::MOST_NAME_CHARS).contains(&name.len()) {
                    message += &format!(" of {name:?}");
                }
                message += ": ";
            }
            Self {
                message: message + &problem.words,
                code: problem.code,
            }
        }
    }
}

/// The problem of a configuration, which its caller names.
pub(super) struct Problem {
    /// The key, if it is the problem of a value.
    key: Option<String>,
    /// The index and the name of the sensor, if the key is one of a `[[sensor]]`.
    sensor: Option<(usize, String)>,
    /// What was found and what was expected, or the problem and its remedy.
    words: String,
    code: u8,
}

impl From<OutOfRange> for Problem {
    fn from(value: OutOfRange) -> Self {
        Self {
            key: Some(value.key),
            ..Self::of_file(value.problem)
        }
    }
}

impl Problem {
    /// The file is not TOML, or has an unknown key or a value of the wrong type.
    pub(super) fn of_file(words: impl Into<String>) -> Self {
        Self {
            key: None,
            sensor: None,
            words: words.into(),
            code: CONFIG,
        }
    }

    /// The configuration file cannot be read.
    pub(super) fn unreadable(error: &std::io::Error) -> Self {
        Self {
            code: NO_INPUT,
            ..Self::of_file(format!("cannot read: {error}"))
        }
    }

    /// The same problem in the table of a sensor, if its key is there.
    pub(super) fn of(mut self, (index, sensor): (usize, &sensor::Settings)) -> Self {
        let mut key = self.key.iter();
        if key.any(|key| key.starts_with("sensor.")) {
            self.sensor = Some((index, sensor.name.clone()));
        }
        self
    }
}

/// The text of a configuration. It is empty for one that is no file.
#[derive(Debug, Clone, Default)]
pub struct Text(pub(super) String);

impl Text {
    /// The line of a key or of the closest table above it. `index` is that of the `[[sensor]]`.
    fn line(&self, index: usize, key: &str) -> Option<usize> {
        let (start, _) = self.place(index, key)?;
        Some(self.0[..start].matches('\n').count() + 1)
    }

    /// Whether the key is written. `index` is that of the `[[sensor]]`.
    pub fn is_written(&self, index: usize, key: &str) -> bool {
        self.place(index, key).is_some_and(|(_, is_whole)| is_whole)
    }

    /// Where the value of a key begins, or else the closest table above it, and whether it is the key.
    fn place(&self, index: usize, key: &str) -> Option<(usize, bool)> {
        let root = DeTable::parse(&self.0).ok()?.into_inner();
        let mut table = &root;
        let mut start = None;
        for part in key.split('.') {
            let Some(found) = table.get(part) else {
                return start.map(|start| (start, false));
            };
            let found = match found.get_ref() {
                DeValue::Array(list) if part == "sensor" => list.get(index)?,
                _ => found,
            };
            start = Some(found.span().start);
            match found.get_ref() {
                DeValue::Table(below) => table = below,
                _ => return start.map(|start| (start, key.ends_with(part))),
            }
        }
        start.map(|start| (start, true))
    }
}
