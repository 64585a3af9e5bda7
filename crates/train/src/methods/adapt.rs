//! `adapt` on presses of one frame each: continues to train the network of a model file.

use burn::tensor::Device;

use super::frame;
use crate::data::dataset::{self, Dataset};
use crate::learn::force;
use crate::model::evaluated::Evaluated;
use crate::model::file;
use crate::net::frame as network;
use crate::net::{start, unfolded};
use crate::run::{Description, Run};
use crate::settings::{NetworkSettings, Settings, SettingsError};
use crate::stages::Stages;
use hardnessd_core::verdict::Hrn;
use hardnessd_simulator::Split;

/// The name of the only stage.
const STAGE: &str = "adapt";

/// A model file that `adapt` cannot start from.
#[derive(Debug, thiserror::Error)]
pub enum NoStart {
    /// The file holds another network.
    #[error(
        "with such data adapt starts from models of {from} with {expected} levels: this one is of {method}, \
         with {levels} levels"
    )]
    Network {
        /// The networks that would be a start.
        from: &'static str,
        /// The file's method.
        method: String,
        /// The file's number of levels.
        levels: usize,
        /// The number of levels of the data.
        expected: usize,
    },
    /// The file's graph is the paper's network, and what folding loses is missing, or is not this
    /// network's.
    #[error(
        "adapt needs the `hrn.unfolded` of this file, which is missing or wrong: train its model again with this \
         version"
    )]
    Folded,
}

impl NoStart {
    /// The error for a file whose network is not one of `from`.
    pub(super) fn of(hrn: &Hrn, from: &'static str) -> Self {
        Self::Network {
            from,
            method: hrn.card().method.clone(),
            levels: hrn.card().levels.len(),
            expected: dataset::levels().len(),
        }
    }
}

/// The network of a model file.
#[derive(Debug)]
pub enum Start {
    /// The network of `frame`.
    Frame(start::Start),
    /// The paper's network.
    Hrn(unfolded::Start),
}

impl Start {
    /// Reads the network of a file that the daemon's loader has accepted.
    ///
    /// # Errors
    ///
    /// Returns [`NoStart`] if it is another network than those above, or the file does not have what
    /// further training needs.
    pub fn read(hrn: &Hrn, bytes: &[u8], device: &Device) -> anyhow::Result<Self> {
        let levels = dataset::levels().len();
        let constants = file::constants(bytes)?;
        let constant = |name: &str| constants.get(name);
        let start = match file::unfolded(bytes)? {
            None => network::start(constant, levels, device).map(Self::Frame),
            Some(unfolded) => unfolded.start(levels, constant, device).map(Self::Hrn),
        };
        // The other networks also have the means of their features.
        let is_folded = hrn.card().levels.len() == levels
            && constants.contains_key("head.matrix")
            && !constants.contains_key("column means");
        Ok(start.ok_or_else(|| match is_folded {
            true => NoStart::Folded,
            false => NoStart::of(hrn, "single frames (any method but features)"),
        })?)
    }

    /// The settings of the run: the start's network and image instead of the given ones.
    ///
    /// # Errors
    ///
    /// Fails if the start is of [`Start::Frame`] and `validation.keep` is not `last`.
    pub fn settings(&self, settings: Settings) -> Result<Settings, SettingsError> {
        Ok(match self {
            Self::Frame(_) => {
                settings.validation.check_last()?;
                settings
            }
            Self::Hrn(start) => Settings {
                full_scale_n: start.scale.full_scale_n,
                network: NetworkSettings {
                    pooling: start.pooling,
                    log_above_n: start.scale.log_above_n,
                },
                ..settings
            },
        })
    }
}

/// Trains from `start` on all labelled training samples and, by consistency, on the unlabelled
/// ones. A resumed run continues from the files there.
///
/// # Errors
///
/// Fails if the data has no labelled training samples, the training diverges, or the directory
/// cannot be read or written.
pub fn train(
    dataset: &Dataset,
    start: Start,
    description: &Description,
    run: &Run,
    device: &Device,
) -> anyhow::Result<Option<Evaluated>> {
    let labelled = dataset.labelled(Split::Train)?;
    let share = description.settings.validation.share;
    let (kept, held_out) = dataset.hold_out(&labelled, share, description.seed);
    let unlabelled = super::unlabelled(dataset, &labelled, &held_out);
    let start = match start {
        Start::Frame(start) => {
            let samples = frame::Samples {
                dataset,
                train: &kept,
                held_out: &held_out,
                unlabelled: &unlabelled,
            };
            return frame::train(STAGE, &samples, Some(start), description, run, device);
        }
        Start::Hrn(start) => start,
    };
    let stages = |description| Stages {
        dataset,
        train: &kept,
        validation: &held_out,
        unlabelled: &unlabelled,
        description,
        run,
        device,
    };
    let start = stages(description).with_force_factor(start)?;
    if let Some(account) = force::account(start.force_factor) {
        hardnessd_core::say!("{account}");
    }
    // The corrected scale of the image.
    let mut corrected = description.clone();
    corrected.settings.full_scale_n = start.scale.full_scale_n;
    corrected.settings.network.log_above_n = start.scale.log_above_n;
    let stages = stages(&corrected);
    let trained = stages.adapted(STAGE, &start)?;
    stages.finish(&trained, start.force_factor)
}
