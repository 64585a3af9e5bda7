//! The checkpoints of a run's stages, as files.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use burn::tensor::Device;

use super::checkpoint::Checkpoint;
use super::disk::write_whole;
use crate::net::network::Weights;

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

    /// Writes a stage's checkpoint, and removes the earlier ones.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing.
    pub fn save(&self, stage: &str, checkpoint: &Checkpoint) -> anyhow::Result<()> {
        let name = format!("{stage}-{:010}.npz", checkpoint.progress.step);
        let path = self.directory.join(name);
        write_whole(&path, &checkpoint.to_bytes()?)?;
        for old in self.paths(stage)?.iter().filter(|old| **old != path) {
            fs::remove_file(old).with_context(|| old.display().to_string())?;
        }
        Ok(())
    }

    /// A stage's newest checkpoint. It must have the lists of `fresh`, the stage before its first step. `None`
    /// without any checkpoint.
    ///
    /// # Errors
    ///
    /// Returns an error if the checkpoint cannot be read.
    pub fn newest(
        &self,
        stage: &str,
        fresh: &[(String, Weights)],
        device: &Device,
    ) -> anyhow::Result<Option<Checkpoint>> {
        let path = self.paths(stage)?.pop();
        let read = path.map(|path| {
            Checkpoint::read(&path, fresh, device).with_context(|| path.display().to_string())
        });
        read.transpose()
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
