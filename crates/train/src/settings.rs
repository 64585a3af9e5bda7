//! All settings of a training run, as one TOML file.
//!
//! `config/hrn-train.toml` shows every key with its default and unit. A run keeps the settings that
//! it used as `settings.toml` in its directory.

use serde::{Deserialize, Serialize};

pub mod augmentation;
mod bounds;
pub mod gan;
pub mod network;
pub mod optimiser;
pub mod reports;

use hardnessd_core::wording;

pub use augmentation::AugmentationSettings;
pub use bounds::SettingsError;
pub use gan::GanSettings;
pub use network::NetworkSettings;
pub use optimiser::OptimiserSettings;
pub use reports::ArmReports;

use bounds::{MOST_SAMPLES_A_COMPONENT, check, check_loop};

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

/// The choice of the weights that a run keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Keep {
    /// The weights of the last step, as in the paper.
    Last,
    /// The weights with the least loss on the validation objects.
    Best,
}

/// The validation objects: training objects held out to choose weights and temperature.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Validation {
    /// Share of the training objects of each level, from 0 to 0.5. With 0, as in the paper, there
    /// are no validation objects.
    pub share: f64,
    /// The number of epochs between two validations.
    pub every_epochs: u32,
    /// The weights to keep: `last` or `best`.
    pub keep: Keep,
}

impl Validation {
    /// Refuses [`Keep::Best`], for a network that uses its validation objects only after training.
    ///
    /// # Errors
    ///
    /// Returns [`SettingsError::Keep`].
    pub fn check_last(&self) -> Result<(), SettingsError> {
        match self.keep {
            Keep::Last => Ok(()),
            Keep::Best => Err(SettingsError::Keep),
        }
    }
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

/// Settings for the training of a recogniser on labelled frames. The defaults are the paper's
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
    /// count the same, with 1 all levels do. `None` is the network's own: 1 for a network that
    /// judges a frame, and for one that judges a whole press. The paper's networks ignore it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub level_balance: Option<f64>,
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
            level_balance: None,
            optimiser: OptimiserSettings::default(),
            augmentation: AugmentationSettings::default(),
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
    /// The training of HRN on the labelled samples, from random weights or as the fine-tuning of
    /// other weights.
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
                picture_every_epochs: 100,
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
    /// The default settings of a profile. A method may have others:
    /// [`crate::methods::Method::settings`].
    pub fn of(profile: Profile) -> Self {
        let paper = Self::default();
        match profile {
            Profile::Paper => paper,
            // A tenth of the paper's steps in every stage. All methods take about an hour of one
            // core per seed (`results/quick`).
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

    /// Gives these settings, with the values in `text` in place of their own.
    ///
    /// # Errors
    ///
    /// Returns an error if `text` is not TOML with known keys, or a value lies outside its range.
    pub fn overridden(&self, text: &str) -> Result<Self, SettingsError> {
        // Parse the text twice: alone, so that an error can show the line, and merged over these
        // settings.
        let syntax = |error| SettingsError::Syntax(wording::of_toml(text, &error));
        let _: Self = toml::from_str(text).map_err(syntax)?;
        let own = toml::Table::try_from(self).expect("settings are plain tables of numbers");
        let given: toml::Table = toml::from_str(text).map_err(syntax)?;
        let merged: Self = merged(own, given).try_into().map_err(syntax)?;
        merged.checked()
    }

    /// Gives the same settings if every value is within its range.
    ///
    /// # Errors
    ///
    /// Returns an error if a value lies outside its range.
    pub fn checked(self) -> Result<Self, SettingsError> {
        let scale = self.full_scale_n;
        check("", "full_scale_n", scale, scale > 0.0, "above 0")?;
        self.network.check()?;
        self.ustgan.check("ustgan.")?;
        self.stgan.check("stgan.")?;
        let generated = self.generation.samples_a_component;
        let key = "samples_a_component";
        let fits = (1..=MOST_SAMPLES_A_COMPONENT).contains(&generated);
        check("generation.", key, generated, fits, "1 to 10000")?;
        self.pretraining.check("pretraining.")?;
        self.training.check("training.")?;
        self.reports.check()?;
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
        let balance = self.level_balance.unwrap_or_default();
        let fits = (0.0..=1.0).contains(&balance);
        check(table, "level_balance", balance, fits, "0 to 1")?;
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
        let text = include_str!("../../../config/hrn-train.toml");
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
            ("epoch = 3", "unknown field `epoch`"),
            ("[training]\nepochs = \"3\"", "invalid type: string \"3\""),
            (
                "[training]\nepochs = 0",
                "`training.epochs`: found 0, expected 1 or more",
            ),
            (
                "[training]\nlevel_balance = 2",
                "`training.level_balance`: found 2, expected 0 to 1",
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
                "[ustgan]\nsamples_a_component = 9223372036854775807",
                "expected 1 to 10000",
            ),
            (
                "[training]\nbatch = 4611686018427387904",
                "expected 2 to 1000000",
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
