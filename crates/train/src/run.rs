//! A run's directory: settings, revision, metrics, checkpoints, the model and its evaluation.
//!
//! Every file is complete at all times ([`disk`]), also after SIGKILL or a full disk. Only the last
//! row of `metrics.csv` may be broken; a resumed run drops it. A run may [`start`] from a model.

pub mod checkpoint;
pub mod disk;
pub mod history;
pub mod start;

use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail, ensure};
use serde::{Deserialize, Serialize};

use crate::data::source::Source;
use crate::exit::coded;
use crate::settings::{Profile, Settings};
use checkpoint::Checkpoint;
use disk::{lock, read_if_there, refuse_foreign, write_whole};
use hardnessd_core::exit::CONFIG;
use hardnessd_core::wording;

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
    /// The first line of `settings.toml` that differs from that of `expected`, with both. Data are the same if
    /// their bytes are, because a file may have been renamed.
    fn difference(&self, expected: &Self) -> anyhow::Result<Option<String>> {
        let mut found = self.clone();
        for (own, other) in found.data.iter_mut().zip(&expected.data) {
            own.name.clone_from(&other.name);
        }
        let (found, expected) = (toml::to_string(&found)?, toml::to_string(expected)?);
        let mut pairs = found.lines().zip(expected.lines());
        let differing = pairs.find(|(found, expected)| found != expected);
        Ok(match differing {
            Some((found, expected)) => Some(format!("found `{found}`, expected `{expected}`")),
            None if found != expected => Some("the one has more files than the other".to_owned()),
            None => None,
        })
    }
}

/// Files that a run writes after its `settings.toml`.
const OF_A_RUN: [&str; 4] = ["hrn.onnx", "metrics.csv", "evaluation.json", "checkpoints"];

/// A run's directory, locked against other processes while it is open.
#[derive(Debug)]
pub struct Run {
    directory: PathBuf,
    _lock: File,
}

/// Returns an error if a directory without a run has files. A run that was killed before it had its settings leaves
/// only a part of a file.
fn refuse_to_continue(directory: &Path) -> anyhow::Result<()> {
    for entry in fs::read_dir(directory)? {
        let name = entry?.file_name();
        let name = name.to_string_lossy();
        ensure!(
            name.ends_with(".part"),
            "{}: has {name} but no settings.toml, so there is no run to continue: leave out --resume, or choose \
             another --out",
            directory.display()
        );
    }
    Ok(())
}

impl Run {
    /// The description of the run in a directory. `None` if there is no run.
    ///
    /// # Errors
    ///
    /// Returns an error if `settings.toml` exists but cannot be read.
    pub fn description_at(directory: &Path) -> anyhow::Result<Option<Description>> {
        let path = directory.join("settings.toml");
        let Some(bytes) = read_if_there(&path)? else {
            return Ok(None);
        };
        let text = String::from_utf8_lossy(&bytes);
        let description = toml::from_str(&text).map_err(|error| {
            let problem = wording::of_toml(&text, &error);
            coded(CONFIG, format_args!("{}: {problem}", path.display()))
        });
        description.map(Some)
    }

    /// Starts a run in the directory. With `resume`, continues the run that the directory has, if
    /// its description is the same.
    ///
    /// # Errors
    ///
    /// Returns an error if there is a run and `resume` is not set, if that run has another
    /// description, if `resume` is set and the directory has files but no run, if another process works
    /// in the directory, or if the directory cannot be written.
    pub fn open(directory: &Path, description: &Description, resume: bool) -> anyhow::Result<Self> {
        fs::create_dir_all(directory).with_context(|| directory.display().to_string())?;
        let run = Self {
            directory: directory.to_owned(),
            _lock: lock(directory)?,
        };
        let before = Self::description_at(directory)?;
        refuse_foreign(directory, "settings.toml", &OF_A_RUN)?;
        if resume && before.is_none() {
            refuse_to_continue(directory)?;
        }
        ensure!(
            before.is_none() || resume,
            "{}: has a run already: continue it with --resume, or choose another --out",
            directory.display()
        );
        // First, because a directory with checkpoints and no settings is refused.
        match before {
            None => run.write("settings.toml", toml::to_string(description)?.as_bytes())?,
            Some(before) => {
                if let Some(difference) = description.difference(&before)? {
                    bail!(
                        "{}: this run was started with other settings or data; {difference}; give \
                         --resume the same ones, or choose another --out",
                        run.path("settings.toml").display()
                    );
                }
            }
        }
        for part in ["checkpoints", "samples"] {
            let part = run.path(part);
            fs::create_dir_all(&part).with_context(|| part.display().to_string())?;
        }
        run.add_revision()?;
        Ok(run)
    }

    /// The bytes of `settings.toml`, as the run was started.
    ///
    /// # Errors
    ///
    /// Returns the error of reading the file.
    pub fn settings(&self) -> anyhow::Result<Vec<u8>> {
        let path = self.path("settings.toml");
        fs::read(&path).with_context(|| path.display().to_string())
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

    /// The path of a stage's checkpoint.
    pub fn checkpoint(&self, stage: &str) -> PathBuf {
        self.path("checkpoints").join(stage)
    }

    /// The steps and the seconds of all stages of the run in a directory, over all restarts. They are 0 without
    /// checkpoints, which somebody may have removed to save space.
    ///
    /// # Errors
    ///
    /// Returns an error if the checkpoints are there and cannot be read.
    pub fn cost(directory: &Path) -> anyhow::Result<(u64, f64)> {
        let (mut steps, mut seconds) = (0, 0.0);
        let directory = directory.join("checkpoints");
        let files = match fs::read_dir(&directory) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok((steps, seconds)),
            files => files.with_context(|| directory.display().to_string())?,
        };
        for file in files {
            if let Some(stage) = Checkpoint::read(&file?.path())? {
                steps += stage.step;
                seconds += stage.seconds;
            }
        }
        Ok((steps, seconds))
    }

    /// Adds this package's version and the commit it was built from, if they are not the last ones.
    fn add_revision(&self) -> anyhow::Result<()> {
        let commit = env!("HARDNESSD_REVISION");
        let own = format!("hardnessd {} ({commit})\n", env!("CARGO_PKG_VERSION"));
        let before = fs::read_to_string(self.path("revision")).unwrap_or_default();
        match before.ends_with(&own) {
            true => Ok(()),
            false => self.write("revision", (before + &own).as_bytes()),
        }
    }
}

#[cfg(test)]
mod tests;
