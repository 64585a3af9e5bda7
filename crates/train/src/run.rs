//! A run's directory: settings, revision, metrics, checkpoints, the model and its evaluation.
//!
//! Every file is complete at all times ([`disk`]), also after SIGKILL or a full disk. Only the last
//! row of `metrics.csv` may be broken; a resumed run drops it.

pub mod checkpoint;
pub mod disk;
pub mod history;
pub mod progress;

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail, ensure};
use burn::tensor::Device;
use serde::{Deserialize, Serialize};

use crate::data::dataset::{LabelChoice, Source};
use crate::net::network::Weights;
use crate::settings::{Profile, Settings, SettingsError};
use checkpoint::Checkpoint;
use disk::{lock, refuse_foreign, write_whole};
use hardnessd_core::wording;
use history::Metrics;

/// The number of checkpoints kept for a stage: the newest, and one before it.
const CHECKPOINTS_KEPT: usize = 2;

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
    /// How the labelled samples are chosen.
    pub label_choice: LabelChoice,
    /// SHA-256 of the model file that the run started from, if it was one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<String>,
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

    /// Writes a stage's checkpoint and removes all but the last two.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing.
    pub fn save(&self, stage: &str, checkpoint: &Checkpoint) -> anyhow::Result<()> {
        let name = format!("checkpoints/{stage}-{:010}.npz", checkpoint.progress.step);
        self.write(&name, &checkpoint.to_bytes()?)?;
        let all = checkpoints(&self.directory, stage)?;
        for old in &all[..all.len().saturating_sub(CHECKPOINTS_KEPT)] {
            fs::remove_file(old).with_context(|| old.display().to_string())?;
        }
        Ok(())
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
        let read = |path: &Path| {
            let checkpoint = Checkpoint::read(path, device)?;
            checkpoint.check_like(fresh)?;
            Ok::<_, anyhow::Error>(checkpoint)
        };
        let mut failure = None;
        for path in checkpoints(&self.directory, stage)?.iter().rev() {
            match read(path) {
                Ok(checkpoint) => return Ok(Some(checkpoint)),
                Err(error) => failure = Some(error.context(path.display().to_string())),
            }
        }
        if let Some(failure) = failure {
            return Err(failure);
        }
        for other in &self.others {
            // A file of another run that cannot be read is no error, because this run can do the
            // stage itself.
            let Some(path) = checkpoints(other, stage).unwrap_or_default().pop() else {
                continue;
            };
            let Ok(checkpoint) = read(&path) else {
                continue;
            };
            let Ok(metrics) = metrics_of(other) else {
                continue;
            };
            let Ok(revisions) = fs::read_to_string(other.join("revision")) else {
                continue;
            };
            if checkpoint.origin == origin && checkpoint.progress.epoch == epochs {
                self.add_revisions(&revisions)?;
                self.take_metrics(stage, &metrics)?;
                self.save(stage, &checkpoint)?;
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

    /// Adds the rows of `stage` of another run's metrics to `metrics.csv`, because they are part of
    /// the cost of this run's model.
    fn take_metrics(&self, stage: &str, text: &str) -> anyhow::Result<()> {
        let mut own = self.metrics_before()?;
        if own.is_empty() {
            own = history::columns() + "\n";
        }
        let of_stage = |row: &&str| row.split(',').next() == Some(stage);
        own = own
            .lines()
            .filter(|row| !of_stage(row))
            .fold(String::new(), |rows, row| rows + row + "\n");
        for row in text.lines().filter(of_stage) {
            own += row;
            own.push('\n');
        }
        self.write("metrics.csv", own.as_bytes())
    }

    /// Opens `metrics.csv` and cuts off the rows of `stage` after `step`, because a resumed run
    /// writes them again.
    ///
    /// # Errors
    ///
    /// Returns the errors of reading and writing, and an error if another version began the file
    /// with other columns.
    pub fn metrics(&self, stage: &'static str, step: u64) -> anyhow::Result<Metrics> {
        let before = self.metrics_before()?;
        let columns = history::columns();
        let mut seconds_before = 0.0;
        let mut text = columns.clone() + "\n";
        for row in before.lines().skip(1) {
            let cells: Vec<&str> = row.split(',').collect();
            let row_step = cells.get(1).and_then(|cell| cell.parse::<u64>().ok());
            let is_done = cells[0] != stage || row_step.is_some_and(|row_step| row_step <= step);
            // A full disk may have broken a row off.
            if !is_done || cells.len() != columns.split(',').count() {
                continue;
            }
            text.push_str(row);
            text.push('\n');
            let seconds = cells.last().and_then(|cell| cell.parse().ok());
            if let (true, Some(seconds)) = (cells[0] == stage, seconds) {
                seconds_before = seconds;
            }
        }
        self.write("metrics.csv", text.as_bytes())?;
        let path = self.path("metrics.csv");
        let file = File::options().append(true).open(&path);
        let file = file.with_context(|| path.display().to_string())?;
        Ok(Metrics::new(file, stage, seconds_before))
    }

    /// The text of `metrics.csv` so far. Empty if the file does not exist yet.
    fn metrics_before(&self) -> anyhow::Result<String> {
        let path = self.path("metrics.csv");
        match fs::read_to_string(&path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(String::new()),
            Err(error) => Err(error).with_context(|| path.display().to_string()),
            Ok(text) if text.is_empty() => Ok(text),
            Ok(text) => history::check_columns(&text, &path).map(|()| text),
        }
    }
}

/// The text of a run's `metrics.csv`, if its columns are those of this version.
fn metrics_of(run: &Path) -> anyhow::Result<String> {
    let path = run.join("metrics.csv");
    let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    history::check_columns(&text, &path)?;
    Ok(text)
}

/// Paths of a stage's checkpoints in a run's directory, oldest first.
fn checkpoints(run: &Path, stage: &str) -> anyhow::Result<Vec<PathBuf>> {
    let directory = run.join("checkpoints");
    let prefix = format!("{stage}-");
    let mut paths = Vec::new();
    for entry in fs::read_dir(&directory).with_context(|| directory.display().to_string())? {
        let path = entry?.path();
        let name = path
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        if name.starts_with(&prefix) && name.ends_with(".npz") {
            paths.push(path);
        }
    }
    paths.sort();
    Ok(paths)
}

/// This package's version, and the commit it was built from.
fn revision() -> String {
    let commit = env!("HARDNESSD_REVISION");
    format!("hardnessd {} ({commit})", env!("CARGO_PKG_VERSION"))
}

#[cfg(test)]
mod tests;
