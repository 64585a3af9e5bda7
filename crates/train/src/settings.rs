//! All settings of a training run, as one TOML file.
//!
//! `config/hrn-train.toml` shows every key with its default and unit. A run keeps the settings that
//! it used as `settings.toml` in its directory.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

mod bounds;
pub mod network;
pub mod optimiser;
pub mod reports;

use crate::exit::coded;
use hardnessd_core::exit::CONFIG;
use hardnessd_core::wording;

pub use network::NetworkSettings;
pub use optimiser::OptimiserSettings;
pub use reports::ArmReports;

use optimiser::Rule;

/// How long a run may take.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, clap::ValueEnum,
)]
#[serde(rename_all = "lowercase")]
pub enum Profile {
    /// As the paper: what the committed tables are made with.
    Paper,
    /// A tenth of the paper's steps.
    Quick,
    /// Seconds: for tests.
    Smoke,
}

impl Profile {
    /// The profile's name in commands and files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::Quick => "quick",
            Self::Smoke => "smoke",
        }
    }
}

/// The objects that are held out of the labelled ones, to fit the temperature and to follow the training.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Validation {
    /// Share of the labelled objects of each level, from 0 to 0.5. With 0, as in the paper, none are
    /// held out.
    pub share: f64,
    /// The number of epochs between two judgements of the held-out objects.
    pub every_epochs: u32,
}

impl Default for Validation {
    fn default() -> Self {
        Self {
            share: 0.0,
            every_epochs: 5,
        }
    }
}

/// The changes made to a training frame before each use.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AugmentationSettings {
    /// Whether frames are turned and mirrored.
    pub symmetries: bool,
    /// The largest shift along each axis, in taxels. The taxels that come in are background.
    pub shift_taxels: u8,
}

/// Settings for the training of a recogniser on labelled presses. The defaults are the paper's
/// ("Training of HRN").
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Training {
    /// Samples per step. The last batch of an epoch may be smaller.
    pub batch: usize,
    /// Passes over the training samples: what the paper calls iterations.
    pub epochs: u32,
    /// Decay per step of the running average of the weights. The average is evaluated and exported.
    /// With 0, the weights themselves are.
    pub averaging: f64,
    /// The number of epochs between two checkpoints. The last epoch always ends with one.
    pub checkpoint_every_epochs: u32,
    /// How far the weights of levels with few samples are raised, from 0 to 1. With 0 all samples
    /// count the same, with 1 all levels do. Only the network of whole presses uses it.
    pub level_balance: f64,
    /// Settings of the optimiser.
    pub optimiser: OptimiserSettings,
    /// The changes made to a frame before each use.
    pub augmentation: AugmentationSettings,
}

impl Default for Training {
    fn default() -> Self {
        Self {
            batch: 100,
            epochs: 200,
            averaging: 0.0,
            checkpoint_every_epochs: 5,
            level_balance: 1.0,
            optimiser: OptimiserSettings::default(),
            augmentation: AugmentationSettings::default(),
        }
    }
}

/// Settings for the training of generator and discriminator. The defaults are the paper's
/// ("Training of STGAN and USTGAN").
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GanSettings {
    /// Real samples per step. The last batch of an epoch may be smaller.
    pub batch: usize,
    /// Generated samples of each component per step.
    pub samples_a_component: usize,
    /// Passes over the real samples: what the paper calls iterations. If its 500 were steps, they
    /// would be six passes over the unlabelled samples. DeLiGAN's code also calls an epoch an
    /// iteration.
    pub epochs: u32,
    /// Lambda of Eq. (7), which weighs the penalty's mean over all of sigma.
    pub sigma_penalty: f64,
    /// Decay per step of the running average of the discriminator's weights. The average is kept at
    /// the end. With 0, the weights themselves are.
    pub averaging: f64,
    /// The number of epochs between two checkpoints. The last epoch always ends with one.
    pub checkpoint_every_epochs: u32,
    /// The optimiser of generator and discriminator.
    pub optimiser: OptimiserSettings,
}

impl Default for GanSettings {
    fn default() -> Self {
        Self {
            batch: 100,
            samples_a_component: 2,
            epochs: 500,
            sigma_penalty: 0.1,
            averaging: 0.0,
            checkpoint_every_epochs: 5,
            optimiser: OptimiserSettings {
                rule: Rule::Adam,
                // The paper gives no betas. DeLiGAN's code has 0.5.
                beta1: 0.5,
                ..OptimiserSettings::default()
            },
        }
    }
}

/// Settings for the samples that the STGANs generate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Generation {
    /// Samples of each component of each level's mixture: 225 x 50 = 11,250 per level, which is
    /// thirty for each of the paper's 375 labelled samples.
    pub samples_a_component: u32,
}

impl Default for Generation {
    fn default() -> Self {
        Self {
            samples_a_component: 225,
        }
    }
}

/// Settings of a run. The defaults are the paper's. A method ignores the tables of stages that it
/// does not have.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// The force on a taxel, in newtons, that becomes 1 in the network's image. 0 N becomes -1.
    /// 10.2 N is the full scale of 8 bits of 0.04 N.
    pub full_scale_n: f64,
    /// Settings of the networks' image and pooling.
    pub network: NetworkSettings,
    /// The GAN on unlabelled samples: USTGAN, or the GAN of SGAN and IGAN.
    pub ustgan: GanSettings,
    /// Settings of each STGAN.
    pub stgan: GanSettings,
    /// Settings for the samples that the STGANs generate.
    pub generation: Generation,
    /// The training of HRN on the generated samples.
    pub pretraining: Training,
    /// The training on the labelled samples, from random weights or as the fine-tuning of other weights.
    pub training: Training,
    /// What a robot reports of its arm, and the errors in it, for networks of whole presses.
    pub reports: ArmReports,
    /// The labelled objects that are held out.
    pub validation: Validation,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            full_scale_n: 10.2,
            network: NetworkSettings::default(),
            ustgan: GanSettings::default(),
            stgan: GanSettings {
                // An epoch of an STGAN has 4 steps, and one of USTGAN has 85.
                checkpoint_every_epochs: 50,
                ..GanSettings::default()
            },
            generation: Generation::default(),
            pretraining: Training::default(),
            training: Training::default(),
            reports: ArmReports::default(),
            validation: Validation::default(),
        }
    }
}

impl Settings {
    /// Gives these settings, with the values in `given` in place of their own.
    ///
    /// # Errors
    ///
    /// Returns an error if a key is unknown, or a value lies outside its range.
    pub fn with(&self, given: toml::Table) -> anyhow::Result<Self> {
        overridden(self, given)
    }
}

/// Settings with the values in `given` in place of their own.
///
/// # Errors
///
/// Returns an error if a key is unknown, or a value lies outside its range.
pub(crate) fn overridden<T: Serialize + DeserializeOwned>(
    settings: &T,
    given: toml::Table,
) -> anyhow::Result<T> {
    let own = toml::Table::try_from(settings).expect("settings are plain tables");
    let merged = merged(own, given);
    bounds::check(&merged)?;
    merged
        .try_into()
        .map_err(|error| coded(CONFIG, error.message()))
}

/// Reads a file of settings, whose values take the place of others.
///
/// # Errors
///
/// Returns an error if the text is not TOML with known keys, or a value lies outside its range.
pub fn parse(text: &str) -> anyhow::Result<toml::Table> {
    let syntax = |error| coded(CONFIG, wording::of_toml(text, &error));
    // The settings are read only so that an error can show the line.
    let _: Settings = toml::from_str(text).map_err(syntax)?;
    let given = toml::from_str(text).map_err(syntax)?;
    bounds::check(&given)?;
    Ok(given)
}

/// The values of `under`, with those of `over` in place of its own.
fn merged(mut under: toml::Table, over: toml::Table) -> toml::Table {
    for (key, value) in over {
        let value = match (under.remove(&key), value) {
            (Some(toml::Value::Table(under)), toml::Value::Table(over)) => {
                toml::Value::Table(merged(under, over))
            }
            (_, value) => value,
        };
        under.insert(key, value);
    }
    under
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shipped_file_shows_every_key_and_equals_the_defaults() {
        let text = include_str!("../../../config/hrn-train.toml");
        let shown: toml::Table = toml::from_str(text).unwrap();
        assert_eq!(shown, toml::Table::try_from(Settings::default()).unwrap());
    }

    #[test]
    fn a_file_overrides_only_what_it_names() {
        let given = parse("[training]\nbatch = 50\noptimiser.rule = \"adam\"").unwrap();
        let mut expected = Settings::default();
        expected.training.batch = 50;
        expected.training.optimiser.rule = Rule::Adam;
        assert_eq!(Settings::default().with(given).unwrap(), expected);
    }

    #[test]
    fn unusable_settings_are_refused_by_name() {
        for (text, expected) in [
            ("epoch = 3", "unknown field `epoch`"),
            ("[training]\nepochs = \"3\"", "invalid type: string \"3\""),
            (
                "[stgan]\noptimiser.beta1 = 1",
                "`stgan.optimiser.beta1`: found 1",
            ),
            ("[validation]\nshare = nan", "`validation.share`: found NaN"),
        ] {
            let given = parse(text).and_then(|given| Settings::default().with(given));
            let error = given.unwrap_err().to_string();
            assert!(error.contains(expected), "{text}: {error}");
            assert!(!error.contains('\n'), "{text}: {error}");
        }
    }
}
