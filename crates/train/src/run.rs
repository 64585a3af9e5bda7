//! A run's directory: settings, revision, metrics, checkpoints, the model and its evaluation.
//!
//! Every file is complete at all times ([`disk`]), also after SIGKILL or a full disk. Only the last
//! row of `metrics.csv` may be broken; a resumed run drops it.

pub mod checkpoint;
pub mod checkpoints;
pub mod disk;
pub mod history;
pub mod progress;

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail, ensure};
use burn::tensor::Device;
use serde::{Deserialize, Serialize};

use crate::data::source::Source;
use crate::net::network::Weights;
use crate::settings::{Profile, Settings, SettingsError};
use checkpoint::Checkpoint;
use checkpoints::Checkpoints;
use disk::{lock, refuse_foreign, write_whole};
use hardnessd_core::wording;
use history::MetricsFile;

/// The description of a run, in `settings.toml`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Description {
    /// The name of the method, such as `hrn100`.
    pub method: String,
    /// The profile, which says how long the run may take.
    pub profile: Profile,
    /// The seed of everything random.
    pub seed: u64,
    /// The number of labelled samples that the run may use.
    pub labels: usize,
    /// Settings of the method.
    pub settings: Settings,
    /// The files from which the run learns.
    pub data: Vec<Source>,
}

impl Description {
    /// Reads `settings.toml`.
    fn read(text: &str) -> Result<Self, SettingsError> {
        toml::from_str(text).map_err(|error| SettingsError::Syntax(wording::of_toml(text, &error)))
    }

    /// The first key whose value differs from `expected`, with both values. `None` if there is
    /// none. Data are the same if their bytes are, because a file may have been renamed.
    pub fn difference(&self, expected: &Self) -> Option<String> {
        let hashes = |sources: &[Source]| -> Vec<String> {
            sources.iter().map(|source| source.sha256.clone()).collect()
        };
        let (found, wanted) = (hashes(&self.data), hashes(&expected.data));
        if found != wanted {
            let (found, wanted) = (found.join(", "), wanted.join(", "));
            return Some(format!(
                "sha256 of the data: found {found}, expected {wanted}"
            ));
        }
        let data = self.data.clone();
        let expected = &Self {
            data,
            ..expected.clone()
        };
        if self == expected {
            return None;
        }
        // A `toml::Table` cannot hold a seed above i64::MAX, although a file can.
        let tables = (toml::Table::try_from(self), toml::Table::try_from(expected));
        let named = match tables {
            (Ok(found), Ok(expected)) => difference("", &found, &expected),
            _ => None,
        };
        named.or_else(|| Some("a setting differs".to_owned()))
    }
}

fn difference(table: &str, found: &toml::Table, expected: &toml::Table) -> Option<String> {
    let shown = |value: Option<&toml::Value>| value.map_or("none".to_owned(), ToString::to_string);
    let keys: BTreeSet<&String> = found.keys().chain(expected.keys()).collect();
    keys.into_iter()
        .find_map(|key| match (found.get(key), expected.get(key)) {
            (Some(toml::Value::Table(found)), Some(toml::Value::Table(expected))) => {
                difference(&format!("{table}{key}."), found, expected)
            }
            (found, expected) => (found != expected).then(|| {
                let (found, expected) = (shown(found), shown(expected));
                format!("`{table}{key}`: found {found}, expected {expected}")
            }),
        })
}

/// Files that a run writes after its `settings.toml`.
const OF_A_RUN: [&str; 4] = [
    "hrn.onnx",
    "metrics.csv",
    "evaluation.json",
    "compared.json",
];

/// A run's directory, locked against other processes while it is open.
#[derive(Debug)]
pub struct Run {
    directory: PathBuf,
    _lock: File,
    /// The checkpoints of its stages.
    pub checkpoints: Checkpoints,
    /// Its `metrics.csv`.
    pub metrics: MetricsFile,
    /// Directories of other runs, from which finished stages may be taken.
    others: Vec<PathBuf>,
}

impl Run {
    /// The description of the run in a directory. `None` if there is no run.
    ///
    /// # Errors
    ///
    /// Returns an error if `settings.toml` exists but cannot be read.
    pub fn description_at(directory: &Path) -> anyhow::Result<Option<Description>> {
        let path = directory.join("settings.toml");
        match fs::read(&path) {
            Ok(bytes) => {
                let description = Description::read(&String::from_utf8_lossy(&bytes));
                Ok(Some(
                    description.with_context(|| path.display().to_string())?,
                ))
            }
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(error).with_context(|| path.display().to_string()),
        }
    }

    /// Starts a run in the directory. With `resume`, continues the run that the directory has, if
    /// its description is the same.
    ///
    /// # Errors
    ///
    /// Returns an error if there is a run and `resume` is not set, if that run has another
    /// description, if another process works in the directory, or if the directory cannot be
    /// written.
    pub fn open(directory: &Path, description: &Description, resume: bool) -> anyhow::Result<Self> {
        fs::create_dir_all(directory).with_context(|| directory.display().to_string())?;
        let run = Self {
            directory: directory.to_owned(),
            _lock: lock(directory)?,
            checkpoints: Checkpoints::of(directory),
            metrics: MetricsFile::of(directory),
            others: Vec::new(),
        };
        let before = Self::description_at(directory)?;
        refuse_foreign(directory, "settings.toml", &OF_A_RUN)?;
        if before.is_none() || resume {
            for part in ["checkpoints", "samples"] {
                let part = run.path(part);
                fs::create_dir_all(&part).with_context(|| part.display().to_string())?;
            }
        }
        match before {
            Some(before) if resume => {
                if let Some(difference) = description.difference(&before) {
                    bail!(
                        "{}: this run was started with other settings or data; {difference}; give \
                         --resume the same ones, or choose another --out",
                        run.path("settings.toml").display()
                    );
                }
                run.add_revisions(&revision())?;
                return Ok(run);
            }
            Some(_) => bail!(
                "{}: has a run already: continue it with --resume, or choose another --out",
                directory.display()
            ),
            None => {}
        }
        run.write("revision", format!("{}\n", revision()).as_bytes())?;
        run.write("settings.toml", toml::to_string(description)?.as_bytes())?;
        Ok(run)
    }

    /// The same run, which takes a stage that it has not begun from one of `others`, if that run
    /// has finished a stage of the same origin.
    #[must_use]
    pub fn taking_from(self, others: Vec<PathBuf>) -> Self {
        Self { others, ..self }
    }

    /// The path of a file in the directory.
    pub fn path(&self, name: &str) -> PathBuf {
        self.directory.join(name)
    }

    /// Writes a file, whole or not at all.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing. A file that existed before is then unchanged.
    pub fn write(&self, name: &str, bytes: &[u8]) -> anyhow::Result<()> {
        write_whole(&self.path(name), bytes)
    }

    /// A stage's newest checkpoint that can be read. Without any checkpoint, that of another run
    /// which did all `epochs` of a stage of the same `origin`; it then becomes this run's too. A
    /// checkpoint must have the lists of `fresh`, the stage before its first step.
    ///
    /// # Errors
    ///
    /// Returns an error if there are checkpoints but none can be read, or if a stage that was taken
    /// from another run cannot be written.
    pub fn latest(
        &self,
        stage: &str,
        origin: &str,
        epochs: u32,
        fresh: &[(String, Weights)],
        device: &Device,
    ) -> anyhow::Result<Option<Checkpoint>> {
        if let Some(own) = self.checkpoints.newest(stage, fresh, device)? {
            return Ok(Some(own));
        }
        for other in &self.others {
            // A file of another run that cannot be read is no error, because this run can do the
            // stage itself.
            let Ok(Some(checkpoint)) = Checkpoints::of(other).newest(stage, fresh, device) else {
                continue;
            };
            let Ok(metrics) = MetricsFile::of(other).read() else {
                continue;
            };
            let Ok(revisions) = fs::read_to_string(other.join("revision")) else {
                continue;
            };
            if checkpoint.origin == origin && checkpoint.progress.epoch == epochs {
                self.add_revisions(&revisions)?;
                self.metrics.take(stage, &metrics)?;
                self.checkpoints.save(stage, &checkpoint)?;
                return Ok(Some(checkpoint));
            }
        }
        Ok(None)
    }

    /// Checks that a stage's checkpoint was made from the stage's present settings and inputs.
    ///
    /// # Errors
    ///
    /// Returns an error if the checkpoint's origin is not `origin`.
    pub fn check_origin(
        &self,
        stage: &str,
        checkpoint: &Checkpoint,
        origin: &str,
    ) -> anyhow::Result<()> {
        ensure!(
            checkpoint.origin == origin,
            "{}: {stage}: the checkpoint is of other frames, settings or starting weights, or of \
             another version of the program; found origin {:.12}, expected {origin:.12}; choose \
             another --out",
            self.path("checkpoints").display(),
            checkpoint.origin
        );
        Ok(())
    }

    /// Adds the lines of `revisions` that the run's file lacks, because other programs had a part
    /// in the run.
    fn add_revisions(&self, revisions: &str) -> anyhow::Result<()> {
        let path = self.path("revision");
        let before = match fs::read_to_string(&path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => String::new(),
            read => read.with_context(|| path.display().to_string())?,
        };
        let mut all = before.clone();
        for revision in revisions.lines() {
            if !all.lines().any(|known| known == revision) {
                all += &format!("{revision}\n");
            }
        }
        if all == before {
            return Ok(());
        }
        self.write("revision", all.as_bytes())
    }
}

/// This package's version, and the commit it was built from.
fn revision() -> String {
    let commit = env!("HARDNESSD_REVISION");
    format!("hardnessd {} ({commit})", env!("CARGO_PKG_VERSION"))
}

#[cfg(test)]
mod tests;
