//! The state of a stage in full precision, so that a killed run continues with the same bits.
//!
//! Every random choice follows from the run's seed and the step's number through counter-based
//! streams, so the number of steps done is the position of every stream. The rest of the state is
//! tensors.

use std::io::Cursor;
use std::path::Path;

use anyhow::{Context as _, ensure};
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use zip::ZipArchive;

use crate::data::presses::Presses;
use crate::net::network::{Weight, Weights, numbers};
use hardnessd_core::npy::Header;
use hardnessd_core::npz::{Element as _, Writer};

/// The state from which a stage continues, beside its settings and data.
#[derive(Debug, Clone)]
pub struct Checkpoint {
    /// The origin of the stage: see [`Origin`].
    pub origin: String,
    /// The progress of the stage.
    pub progress: Progress,
    /// The weights, and similar lists by name: Adam's moments, averaged weights.
    pub lists: Vec<(String, Weights)>,
}

/// The progress of a stage.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Epochs done.
    pub epoch: u32,
    /// Steps done.
    pub step: u64,
}

/// One hash of everything that determines a stage's result: its settings, seed, frames in their
/// order with their levels, and initial weights. If stages of two runs have the same origin, it is
/// enough to run one of them.
#[derive(Debug)]
pub struct Origin(Sha256);

impl Origin {
    /// Begins the origin of a stage with these settings and this seed.
    pub fn new(stage: &str, settings: &impl Serialize, seed: u64) -> Self {
        let settings = serde_json::to_vec(settings).expect("settings are plain numbers");
        let mut hash = Sha256::new();
        for part in [stage.as_bytes(), &seed.to_le_bytes(), &settings] {
            hash.update((part.len() as u64).to_le_bytes());
            hash.update(part);
        }
        Self(hash)
    }

    /// Adds the frames of presses with their levels.
    #[must_use]
    pub fn presses(mut self, presses: &Presses, places: &[usize]) -> Self {
        self.0.update((places.len() as u64).to_le_bytes());
        for &place in places {
            self.0.update([presses.all[place].level]);
            let newtons = presses.frame(place).newtons.into_iter();
            self.0
                .update(newtons.flat_map(f32::to_le_bytes).collect::<Vec<u8>>());
        }
        self
    }

    /// Adds numbers.
    #[must_use]
    pub fn numbers(mut self, numbers: impl Iterator<Item = f32>) -> Self {
        let bytes: Vec<u8> = numbers.flat_map(f32::to_le_bytes).collect();
        self.0.update((bytes.len() as u64).to_le_bytes());
        self.0.update(bytes);
        self
    }

    /// Adds weights.
    #[must_use]
    pub fn weights(mut self, weights: &Weights) -> Self {
        for weight in &weights.entries {
            self.0.update(&weight.name);
            let values = numbers(&weight.values);
            let bytes: Vec<u8> = values
                .iter()
                .flat_map(|value| value.to_le_bytes())
                .collect();
            self.0.update(bytes);
        }
        self
    }

    /// The hash in hexadecimal digits.
    pub fn finish(self) -> String {
        hex::encode(self.0.finalize())
    }
}

impl Checkpoint {
    /// The list called `name`.
    ///
    /// # Errors
    ///
    /// Returns an error if there is no such list.
    pub fn list(&self, name: &str) -> anyhow::Result<&Weights> {
        let found = self.lists.iter().find(|(list, _)| list == name);
        found
            .map(|(_, weights)| weights)
            .with_context(|| format!("no `{name}` in the checkpoint"))
    }

    /// The bytes of the file: an `.npz` of f32 arrays, and `progress` as JSON.
    ///
    /// # Errors
    ///
    /// Returns an error if the archive cannot be built.
    pub fn to_bytes(&self) -> anyhow::Result<Vec<u8>> {
        let mut npz = Writer::plain(Cursor::new(Vec::new()));
        npz.add_list("progress", &serde_json::to_vec(&self.progress)?)?;
        npz.add_list("origin", self.origin.as_bytes())?;
        for (list, weights) in &self.lists {
            for weight in &weights.entries {
                let name = format!("{list}/{}", weight.name);
                npz.add(&name, &weight.dims, &numbers(&weight.values))?;
            }
        }
        Ok(npz.finish()?.into_inner())
    }

    /// Reads a file that [`Checkpoint::to_bytes`] made, of a stage with the lists of `fresh`.
    ///
    /// # Errors
    ///
    /// Returns an error if the file cannot be read, is damaged, or lacks a weight of this size.
    pub fn read(path: &Path, fresh: &[(String, Weights)], device: &Device) -> anyhow::Result<Self> {
        let bytes = std::fs::read(path)?;
        let mut zip = ZipArchive::new(Cursor::new(bytes.as_slice()))?;
        let mut text = |name: &str| {
            let mut packed = zip
                .by_name(&format!("{name}.npy"))
                .context(name.to_owned())?;
            let text = Header::read(&mut packed)?.elements(&mut packed, u8::of)?;
            anyhow::Ok(String::from_utf8(text)?)
        };
        let (progress, origin) = (text("progress")?, text("origin")?);
        let mut lists = Vec::new();
        for (list, like) in fresh {
            let mut weights = Weights::default();
            for Weight { name, dims, .. } in &like.entries {
                let array = format!("{list}/{name}");
                let packed = zip.by_name(&format!("{array}.npy"));
                let mut packed = packed.with_context(|| format!("array `{array}`"))?;
                let header = Header::read(&mut packed)?;
                ensure!(
                    header.shape == *dims,
                    "array `{array}`: found shape {:?}, expected {dims:?}",
                    header.shape
                );
                let values = header.elements(&mut packed, f32::of)?;
                weights.entries.push(Weight {
                    name: name.clone(),
                    dims: dims.clone(),
                    values: flat(values, device),
                });
            }
            lists.push((list.clone(), weights));
        }
        Ok(Self {
            origin,
            progress: serde_json::from_str(&progress)?,
            lists,
        })
    }
}

fn flat(values: Vec<f32>, device: &Device) -> Tensor<1> {
    let length = values.len();
    Tensor::from_data(TensorData::new(values, [length]), device)
}
