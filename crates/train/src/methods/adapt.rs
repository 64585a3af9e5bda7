//! `adapt` on presses of one frame each: continues to train the network of a model file.

use burn::tensor::Device;

use super::frame;
use crate::data::dataset::{self, Dataset};
use crate::learn::force;
use crate::model::evaluated::Evaluated;
use crate::model::file;
use crate::net::frame as network;
use crate::net::{hrn, start};
use crate::run::{Description, Run};
use crate::settings::{NetworkSettings, Settings, SettingsError};
use crate::stages::Stages;
use hardnessd_core::verdict::Hrn;
use hardnessd_simulator::Split;

pub use super::settings::adapt as settings;

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
#[derive(Debug, Clone)]
pub enum AdaptBase {
    /// The network of `frame`.
    Frame(start::ExportedNetwork),
    /// The paper's network, and the factor of the forces that its scale includes.
    Hrn(hrn::ExportedHrn, f32),
}

impl AdaptBase {
    /// Reads the network of a file that the daemon's loader has accepted.
    ///
    /// # Errors
    ///
    /// Returns [`NoStart`] if it is another network than those above.
    pub fn read(model: &Hrn, bytes: &[u8], device: &Device) -> anyhow::Result<Self> {
        let levels = dataset::levels().len();
        let constants = file::constants(bytes)?;
        let constant = |name: &str| constants.get(name);
        let frame = network::start(constant, levels, device).map(Self::Frame);
        let paper = || {
            let factor = model.card().metrics["force_factor"].as_f64();
            let start = hrn::start(constant, levels, device)?;
            Some(Self::Hrn(start, factor.map_or(1.0, |factor| factor as f32)))
        };
        let start = frame.or_else(paper);
        Ok(start.ok_or_else(|| NoStart::of(model, "single frames (any method but features)"))?)
    }

    /// The settings of the run: the start's network and image instead of the given ones.
    ///
    /// # Errors
    ///
    /// Fails if the start is of [`AdaptBase::Frame`] and `validation.keep` is not `last`.
    pub fn settings(&self, settings: Settings) -> Result<Settings, SettingsError> {
        Ok(match self {
            Self::Frame(_) => {
                settings.validation.check_last()?;
                settings
            }
            Self::Hrn(start, _) => Settings {
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
    start: AdaptBase,
    description: &Description,
    run: &Run,
    device: &Device,
) -> anyhow::Result<Option<Evaluated>> {
    let labelled = dataset.labelled(Split::Train)?;
    let share = description.settings.validation.share;
    let (kept, held_out) = dataset.hold_out(&labelled, share, description.seed);
    let unlabelled = super::unlabelled(dataset, &labelled, &held_out);
    let (start, known_factor) = match start {
        AdaptBase::Frame(start) => {
            let samples = frame::Samples {
                dataset,
                train: &kept,
                held_out: &held_out,
                unlabelled: &unlabelled,
            };
            return frame::train(STAGE, &samples, Some(start), description, run, device);
        }
        AdaptBase::Hrn(start, factor) => (start, factor),
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
    let correction = stages(description).force_factor(&start)?;
    let force_factor = known_factor * correction;
    if let Some(account) = force::account(force_factor) {
        hardnessd_core::say!("{account}");
    }
    let corrected_scale = start.scale.of_newtons_times(correction);
    let mut corrected = description.clone();
    corrected.settings.full_scale_n = corrected_scale.full_scale_n;
    corrected.settings.network.log_above_n = corrected_scale.log_above_n;
    let stages = stages(&corrected);
    let trained = stages.adapted(STAGE, &start)?;
    stages.finish(&trained, force_factor)
}
