//! The state of a stage in full precision, so that a killed run continues with the same bits.
//!
//! Every random choice follows from the run's seed and the step's number through counter-based
//! streams, so the number of steps done is the position of every stream. The rest of the state is
//! numbers. The file is a line of JSON with how many they are, and the numbers after it.

use std::path::Path;

use anyhow::{Context as _, ensure};
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};

use super::disk::{read_if_there, write_whole};
use hardnessd_core::verdict::sha256_hex;

/// How far a stage is. The default is its beginning.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Checkpoint {
    /// A hash of what determines the stage: the run's `settings.toml`, which has the settings, the seed and the
    /// hashes of the data, and the stage's numbers before its first step.
    pub origin: String,
    /// Epochs done.
    pub epoch: u32,
    /// Steps done.
    pub step: u64,
    /// The seconds that they took, in all processes.
    pub seconds: f64,
    /// The numbers of the stage.
    #[serde(skip)]
    pub numbers: Vec<f32>,
}

impl Checkpoint {
    /// The beginning of a stage with these numbers, in a run with this `settings.toml`.
    pub fn first(settings: &[u8], numbers: Vec<f32>) -> Self {
        let origin = [&Sha256::digest(settings)[..], &bytes(&numbers)].concat();
        Self {
            origin: sha256_hex(&origin),
            numbers,
            ..Self::default()
        }
    }

    /// Writes the file, whole or not at all.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing.
    pub fn write(&self, path: &Path) -> anyhow::Result<()> {
        let mut file = serde_json::to_vec(&(self, self.numbers.len()))?;
        file.push(b'\n');
        file.extend(bytes(&self.numbers));
        write_whole(path, &file)
    }

    /// Reads a file that [`Checkpoint::write`] made. `None` if there is none.
    ///
    /// # Errors
    ///
    /// Returns an error if the file cannot be read, or is none of a checkpoint.
    pub fn read(path: &Path) -> anyhow::Result<Option<Self>> {
        let Some(file) = read_if_there(path)? else {
            return Ok(None);
        };
        let head = file.split(|&byte| byte == b'\n').next().unwrap_or_default();
        let (checkpoint, expected): (Self, usize) =
            serde_json::from_slice(head).with_context(|| path.display().to_string())?;
        let (numbers, rest) = file[(head.len() + 1).min(file.len())..].as_chunks();
        ensure!(
            numbers.len() == expected && rest.is_empty(),
            "{}: found {} numbers, expected {expected}: the checkpoint is damaged",
            path.display(),
            numbers.len()
        );
        Ok(Some(Self {
            numbers: numbers.iter().copied().map(f32::from_le_bytes).collect(),
            ..checkpoint
        }))
    }
}

fn bytes(numbers: &[f32]) -> Vec<u8> {
    numbers.iter().flat_map(|x| x.to_le_bytes()).collect()
}
