//! The checkpoints of a run's stages, as files.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use burn::tensor::Device;

use super::checkpoint::Checkpoint;
use super::disk::write_whole;
use crate::net::network::Weights;

/// The number of checkpoints kept for a stage: the newest, and one before it.
const KEPT: usize = 2;

/// The directory of a run's checkpoints.
#[derive(Debug)]
pub struct Checkpoints {
    directory: PathBuf,
}

impl Checkpoints {
    /// The checkpoints of the run in a directory.
    pub(super) fn of(run: &Path) -> Self {
        Self {
            directory: run.join("checkpoints"),
        }
    }

    /// Writes a stage's checkpoint and removes all but the last two.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing.
    pub fn save(&self, stage: &str, checkpoint: &Checkpoint) -> anyhow::Result<()> {
        let name = format!("{stage}-{:010}.npz", checkpoint.progress.step);
        write_whole(&self.directory.join(name), &checkpoint.to_bytes()?)?;
        let all = self.paths(stage)?;
        for old in &all[..all.len().saturating_sub(KEPT)] {
            fs::remove_file(old).with_context(|| old.display().to_string())?;
        }
        Ok(())
    }

    /// A stage's newest checkpoint that can be read. It must have the lists of `fresh`, the stage
    /// before its first step. `None` without any checkpoint.
    ///
    /// # Errors
    ///
    /// Returns an error if there are checkpoints but none can be read.
    pub fn newest(
        &self,
        stage: &str,
        fresh: &[(String, Weights)],
        device: &Device,
    ) -> anyhow::Result<Option<Checkpoint>> {
        let mut failure = None;
        for path in self.paths(stage)?.iter().rev() {
            match Checkpoint::read(path, fresh, device) {
                Ok(checkpoint) => return Ok(Some(checkpoint)),
                Err(error) => failure = Some(error.context(path.display().to_string())),
            }
        }
        failure.map_or(Ok(None), Err)
    }

    /// Paths of a stage's checkpoints, oldest first.
    fn paths(&self, stage: &str) -> anyhow::Result<Vec<PathBuf>> {
        let directory = &self.directory;
        let prefix = format!("{stage}-");
        let mut paths = Vec::new();
        for entry in fs::read_dir(directory).with_context(|| directory.display().to_string())? {
            let path = entry?.path();
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if name.starts_with(&prefix) && name.ends_with(".npz") {
                paths.push(path);
            }
        }
        paths.sort();
        Ok(paths)
    }
}
