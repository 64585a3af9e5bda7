//! Everything that a training run can be told, as one TOML file.
//!
//! `config/hrn-train.toml` shows every key with its default and unit. A run's own settings are
//! kept as `settings.toml` in its directory.

use serde::{Deserialize, Serialize};

pub mod augmentation;
mod bounds;
pub mod consistency;
pub mod gan;
pub mod network;
pub mod optimiser;
pub(in crate::train) mod retired;
pub mod told;

use crate::wording;

pub use augmentation::AugmentationSettings;
pub use bounds::SettingsError;
pub use consistency::ConsistencySettings;
pub use gan::GanSettings;
pub use network::NetworkSettings;
pub use optimiser::OptimiserSettings;
pub use told::Told;

use bounds::{check, check_loop};

/// How long a run may take.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Profile {
    /// As the paper: what the committed tables are made with.
    Paper,
    /// A tenth of the paper's steps.
    Quick,
    /// Seconds: for tests.
    Smoke,
}

/// Which weights a run keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Keep {
    /// Those of the last step, as the paper.
    Last,
    /// Those of the least loss on the validation objects.
    Best,
}

/// Objects taken out of the training objects, to choose weights and temperature by.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Validation {
    /// Share of the training objects of each level, 0 to 0.5; 0: none, as the paper.
    pub share: f64,
    /// Judged after every so many epochs.
    pub every_epochs: u32,
    /// `last` or `best`.
    pub keep: Keep,
}

impl Default for Validation {
    fn default() -> Self {
        Self {
            share: 0.0,
            every_epochs: 5,
            keep: Keep::Last,
        }
    }
}

/// How a recogniser learns from labelled frames; the defaults are the paper's ("Training of HRN").
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Training {
    /// Samples a step. The last batch of an epoch may be smaller.
    pub batch: usize,
    /// Passes over the training samples: what the paper calls iterations.
    pub epochs: u32,
    /// Decay a step of the running average of the weights that is evaluated and exported;
    /// 0: the weights themselves.
    pub averaging: f64,
    /// A checkpoint is written after every so many epochs, and after the last.
    pub checkpoint_every_epochs: u32,
    /// The rule of the steps.
    pub optimiser: OptimiserSettings,
    /// What is done to a frame before each use.
    pub augmentation: AugmentationSettings,
}

impl Default for Training {
    fn default() -> Self {
        Self {
            batch: 100,
            epochs: 200,
            averaging: 0.0,
            checkpoint_every_epochs: 5,
            optimiser: OptimiserSettings::default(),
            augmentation: AugmentationSettings::default(),
        }
    }
}

/// What the STGANs' generators are asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Generation {
    /// Samples of each component of each level's mixture: 225 x 50 = 11,250 a level, thirty for
    /// each of the paper's 375 labelled ones.
    pub samples_a_component: u32,
}

impl Default for Generation {
    fn default() -> Self {
        Self {
            samples_a_component: 225,
        }
    }
}

/// Settings of a run; the defaults are the paper's. A stage that a method does not have leaves
/// its table unused.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Newtons a taxel that become 1 in the network's image; 0 N becomes -1. 10.2 N is what
    /// 8 bits of 0.04 N hold.
    pub full_scale_n: f64,
    /// How the networks see a frame.
    pub network: NetworkSettings,
    /// The GAN over unlabelled samples: USTGAN, or that of SGAN and IGAN.
    pub ustgan: GanSettings,
    /// Each of the STGANs.
    pub stgan: GanSettings,
    /// What the STGANs' generators are asked for.
    pub generation: Generation,
    /// HRN on the generated samples.
    pub pretraining: Training,
    /// HRN on the labelled samples: from random weights, or the fine-tuning of others.
    pub training: Training,
    /// Unlabelled samples beside the labelled ones, without a GAN.
    pub consistency: ConsistencySettings,
    /// What a robot may tell of its arm, for networks of whole presses.
    pub told: Told,
    /// Held-out objects of the labelled ones.
    pub validation: Validation,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            full_scale_n: 10.2,
            network: NetworkSettings::default(),
            ustgan: GanSettings::default(),
            stgan: GanSettings {
                // An epoch has 4 steps there and 85 here.
                checkpoint_every_epochs: 50,
                picture_every_epochs: 100,
                ..GanSettings::default()
            },
            generation: Generation::default(),
            pretraining: Training::default(),
            training: Training::default(),
            consistency: ConsistencySettings::default(),
            told: Told::default(),
            validation: Validation::default(),
        }
    }
}

impl Settings {
    /// The defaults of a profile. A method may have others: [`crate::train::methods::Method::settings`].
    pub fn of(profile: Profile) -> Self {
        let paper = Self::default();
        match profile {
            Profile::Paper => paper,
            // A tenth of the paper's steps everywhere: all methods take 34 minutes of one core a
            // seed (`results/quick`).
            Profile::Quick => paper.with_epochs(50, 20),
            Profile::Smoke => Self {
                generation: Generation {
                    samples_a_component: 2,
                },
                ..paper.with_epochs(2, 2)
            },
        }
    }

    fn with_epochs(self, gan_epochs: u32, training_epochs: u32) -> Self {
        let gan = |settings: GanSettings| GanSettings {
            epochs: gan_epochs,
            checkpoint_every_epochs: settings.checkpoint_every_epochs.min(gan_epochs / 2),
            picture_every_epochs: settings.picture_every_epochs.min(gan_epochs / 2),
            ..settings
        };
        let training = |settings: Training| Training {
            epochs: training_epochs,
            ..settings
        };
        Self {
            ustgan: gan(self.ustgan),
            stgan: gan(self.stgan),
            pretraining: training(self.pretraining),
            training: training(self.training),
            ..self
        }
    }

    /// These settings with what `text` says instead.
    ///
    /// # Errors
    ///
    /// If `text` is no TOML of our keys, or a value lies outside its range.
    pub fn overridden(&self, text: &str) -> Result<Self, SettingsError> {
        // Once as a whole, for errors that show the line; once over these settings.
        let syntax = |error| SettingsError::Syntax(wording::of_toml(text, &error));
        let _: Self = toml::from_str(text).map_err(syntax)?;
        let own = toml::Table::try_from(self).expect("settings are plain tables of numbers");
        let given = toml::from_str(text).map_err(syntax)?;
        let merged: Self = merged(own, given).try_into().map_err(syntax)?;
        merged.checked()
    }

    /// The same settings, if every value is within its range.
    ///
    /// # Errors
    ///
    /// If one is not.
    pub fn checked(self) -> Result<Self, SettingsError> {
        let scale = self.full_scale_n;
        check("", "full_scale_n", scale, scale > 0.0, "above 0")?;
        self.network.check()?;
        self.ustgan.check("ustgan.")?;
        self.stgan.check("stgan.")?;
        let generated = self.generation.samples_a_component;
        let key = "samples_a_component";
        check("generation.", key, generated, generated > 0, "1 or more")?;
        self.pretraining.check("pretraining.")?;
        self.training.check("training.")?;
        self.consistency.check()?;
        self.told.check()?;
        let Validation {
            share,
            every_epochs,
            keep,
        } = self.validation;
        let check = |key, found, fits, expected| check("validation.", key, found, fits, expected);
        check("share", share, (0.0..=0.5).contains(&share), "0 to 0.5")?;
        let expected = "above 0 with `validation.keep` best";
        check("share", share, keep == Keep::Last || share > 0.0, expected)?;
        check(
            "every_epochs",
            every_epochs.into(),
            every_epochs > 0,
            "1 or more",
        )?;
        Ok(self)
    }
}

impl Training {
    fn check(&self, table: &str) -> Result<(), SettingsError> {
        check_loop(
            table,
            self.batch,
            self.epochs,
            self.averaging,
            self.checkpoint_every_epochs,
        )?;
        self.optimiser.check(table)?;
        let shift = self.augmentation.shift_taxels;
        let key = "augmentation.shift_taxels";
        check(table, key, shift, shift <= 4, "0 to 4")
    }
}

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
        let text = include_str!("../../config/hrn-train.toml");
        let shown: toml::Table = toml::from_str(text).unwrap();
        assert_eq!(shown, toml::Table::try_from(Settings::default()).unwrap());
        assert_eq!(
            toml::from_str::<Settings>(text).unwrap(),
            Settings::default()
        );
    }

    #[test]
    fn a_file_overrides_only_what_it_names() {
        let smoke = Settings::of(Profile::Smoke);
        let settings = smoke
            .overridden("[training]\nbatch = 50\noptimiser.rule = \"adam\"")
            .unwrap();
        let mut expected = smoke;
        expected.training.batch = 50;
        expected.training.optimiser.rule = optimiser::Rule::Adam;
        assert_eq!(settings, expected);
    }

    #[test]
    fn unusable_settings_are_refused_by_name() {
        for (text, expected) in [
            ("epoch = 3", "unknown key `epoch`"),
            (
                "[training]\nepochs = \"3\"",
                "line 2: found string \"3\", expected a whole number from 0 to 4294967295",
            ),
            (
                "[training]\nepochs = 0",
                "`training.epochs`: found 0, expected 1 or more",
            ),
            (
                "[stgan]\noptimiser.beta1 = 1",
                "`stgan.optimiser.beta1`: found 1",
            ),
            (
                "[generation]\nsamples_a_component = 0",
                "`generation.samples_a_component`: found 0",
            ),
            (
                "[validation]\nkeep = \"best\"",
                "`validation.share`: found 0",
            ),
            (
                "[pretraining]\naugmentation.shift_taxels = 5",
                "`pretraining.augmentation.shift_taxels`: found 5",
            ),
        ] {
            let error = Settings::default()
                .overridden(text)
                .unwrap_err()
                .to_string();
            assert!(error.contains(expected), "{text}: {error}");
            assert!(!error.contains('\n'), "{text}: {error}");
        }
    }
}
