//! Everything that a training run can be told, as one TOML file.
//!
//! `config/hrn-train.toml` shows every key with its default and unit. A run's own settings are
//! kept as `settings.toml` in its directory.

use serde::{Deserialize, Serialize};

use super::{augment, optimiser};

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

/// Settings of a supervised run; the defaults are the paper's HRN ("Training of HRN").
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Newtons a taxel that become 1 in the network's image; 0 N becomes -1. 10.2 N is what
    /// 8 bits of 0.04 N hold.
    pub full_scale_n: f64,
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
    pub optimiser: optimiser::Settings,
    /// What is done to a frame before each use.
    pub augmentation: augment::Settings,
    /// Held-out training objects.
    pub validation: Validation,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            full_scale_n: 10.2,
            batch: 100,
            epochs: 200,
            averaging: 0.0,
            checkpoint_every_epochs: 5,
            optimiser: optimiser::Settings::default(),
            augmentation: augment::Settings::default(),
            validation: Validation::default(),
        }
    }
}

/// Why settings cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SettingsError {
    /// Not TOML, an unknown key, or a value of another type.
    #[error(transparent)]
    Toml(#[from] toml::de::Error),
    /// A value outside its range.
    #[error("`{key}`: found {found}, expected {expected}")]
    Range {
        /// Path of the key.
        key: &'static str,
        /// Its value.
        found: f64,
        /// What is accepted.
        expected: &'static str,
    },
}

impl Settings {
    /// The defaults of a profile.
    pub fn of(profile: Profile) -> Self {
        let epochs = match profile {
            Profile::Paper => 200,
            Profile::Quick => 20,
            Profile::Smoke => 2,
        };
        Self {
            epochs,
            ..Self::default()
        }
    }

    /// These settings with what `text` says instead.
    ///
    /// # Errors
    ///
    /// If `text` is no TOML of our keys, or a value lies outside its range.
    pub fn overridden(&self, text: &str) -> Result<Self, SettingsError> {
        // Once as a whole, for errors that show the line; once over these settings.
        let _: Self = toml::from_str(text)?;
        let own = toml::Table::try_from(self).expect("settings are plain tables of numbers");
        let merged: Self = merged(own, toml::from_str(text)?).try_into()?;
        merged.checked()
    }

    /// The same settings, if every value is within its range.
    ///
    /// # Errors
    ///
    /// If one is not.
    pub fn checked(self) -> Result<Self, SettingsError> {
        let (optimiser, validation) = (&self.optimiser, &self.validation);
        let share = validation.share;
        let rate = optimiser.learning_rate;
        let decay = optimiser.weight_decay;
        let scale = self.full_scale_n;
        let within_0_1 = |value: f64| (0.0..1.0).contains(&value);
        let above_0 = |value: f64| value > 0.0 && value.is_finite();
        let checks = [
            ("full_scale_n", scale, above_0(scale), "above 0"),
            // Batch normalisation needs two samples.
            ("batch", self.batch as f64, self.batch > 1, "2 or more"),
            ("epochs", self.epochs.into(), self.epochs > 0, "1 or more"),
            (
                "averaging",
                self.averaging,
                within_0_1(self.averaging),
                "0 to below 1",
            ),
            (
                "checkpoint_every_epochs",
                self.checkpoint_every_epochs.into(),
                self.checkpoint_every_epochs > 0,
                "1 or more",
            ),
            ("optimiser.learning_rate", rate, above_0(rate), "above 0"),
            (
                "optimiser.beta1",
                optimiser.beta1,
                within_0_1(optimiser.beta1),
                "0 to below 1",
            ),
            (
                "optimiser.beta2",
                optimiser.beta2,
                within_0_1(optimiser.beta2),
                "0 to below 1",
            ),
            (
                "optimiser.weight_decay",
                decay,
                decay >= 0.0 && decay.is_finite(),
                "0 or more",
            ),
            (
                "augmentation.shift_taxels",
                self.augmentation.shift_taxels.into(),
                self.augmentation.shift_taxels <= 4,
                "0 to 4",
            ),
            (
                "validation.share",
                share,
                (0.0..=0.5).contains(&share),
                "0 to 0.5",
            ),
            (
                "validation.every_epochs",
                validation.every_epochs.into(),
                validation.every_epochs > 0,
                "1 or more",
            ),
            (
                "validation.share",
                share,
                validation.keep == Keep::Last || share > 0.0,
                "above 0 with `validation.keep` best",
            ),
        ];
        match checks.into_iter().find(|(_, _, fits, _)| !fits) {
            None => Ok(self),
            Some((key, found, _, expected)) => Err(SettingsError::Range {
                key,
                found,
                expected,
            }),
        }
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
    fn the_default_models_settings_are_usable() {
        let text = include_str!("../../config/default-model.toml");
        let settings = Settings::default().overridden(text).unwrap();
        assert!(
            settings.validation.share > 0.0,
            "its temperature was fitted"
        );
    }

    #[test]
    fn a_file_overrides_only_what_it_names() {
        let smoke = Settings::of(Profile::Smoke);
        let settings = smoke
            .overridden("batch = 50\n[optimiser]\nrule = \"adam\"")
            .unwrap();
        let optimiser = optimiser::Settings {
            rule: optimiser::Rule::Adam,
            ..smoke.optimiser
        };
        assert_eq!(
            settings,
            Settings {
                batch: 50,
                optimiser,
                ..smoke
            }
        );
    }

    #[test]
    fn unusable_settings_are_refused_by_name() {
        for (text, expected) in [
            ("epoch = 3", "unknown field `epoch`"),
            ("epochs = \"3\"", "expected u32"),
            ("epochs = 0", "`epochs`: found 0, expected 1 or more"),
            (
                "[validation]\nkeep = \"best\"",
                "`validation.share`: found 0",
            ),
            (
                "[augmentation]\nshift_taxels = 5",
                "`augmentation.shift_taxels`: found 5",
            ),
        ] {
            let error = Settings::default()
                .overridden(text)
                .unwrap_err()
                .to_string();
            assert!(error.contains(expected), "{text}: {error}");
        }
    }
}
