//! All settings of a training run, as one TOML file.
//!
//! `config/hrn-train.toml` shows every key with its default and unit. A run keeps the settings that
//! it used as `settings.toml` in its directory.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::exit::coded;
use hardnessd_core::exit::CONFIG;
use hardnessd_core::range::{self, OutOfRange, Range, at_least, from_to};
use hardnessd_core::settings;
use hardnessd_core::wording;

/// Any share.
const SHARE: Range = from_to((0.0, 1.0), "");

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

/// The rule of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rule {
    /// `w -= rate g`.
    Sgd,
    /// Kingma and Ba 2015, with decoupled weight decay.
    Adam,
}

/// How the learning rate changes over the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Schedule {
    /// The learning rate stays the same.
    Constant,
    /// The learning rate falls from its full value to 0 along half a cosine.
    Cosine,
}

settings! {
    /// Settings for the training of a stage. The defaults are the paper's ("Training of HRN").
    #[derive(Copy)]
    pub struct Training {
        /// Samples per step, of a GAN the real ones. The last batch of an epoch may be smaller. Batch normalisation needs
        /// two samples.
        pub batch: usize = 100, in from_to((2.0, 1e6), "");
        /// Passes over the samples: what the paper calls iterations. If the 500 of its GANs were steps, they
        /// would be six passes over the unlabelled samples. DeLiGAN's code also calls an epoch an
        /// iteration.
        pub epochs: u32 = 200, in at_least(1.0);
        /// Decay per step of the running average of the weights, of a GAN those of the discriminator. The
        /// average is evaluated and exported. With 0, the weights themselves are.
        pub averaging: f64 = 0.0, in from_to((0.0, 0.999_999), "");
        /// The rule of a step: `sgd` or `adam`.
        pub rule: Rule = Rule::Sgd;
        /// The learning rate of the first step.
        pub learning_rate: f64 = 1e-3, in at_least(1e-9);
        /// The schedule of the learning rate: `constant` or `cosine`.
        pub schedule: Schedule = Schedule::Constant;
        /// Adam's decay of the gradient's mean.
        pub beta1: f64 = 0.9, in from_to((0.0, 0.999_999), "");
        /// The share, times the learning rate, by which each step shrinks a kernel. Biases and the
        /// mixture's mu and sigma do not decay.
        pub weight_decay: f64 = 0.0, in at_least(0.0);
    }
}

impl Training {
    /// The paper's for generator and discriminator ("Training of STGAN and USTGAN").
    pub fn of_a_gan() -> Self {
        Self {
            epochs: 500,
            rule: Rule::Adam,
            // The paper gives no betas. DeLiGAN's code has 0.5.
            beta1: 0.5,
            ..Self::default()
        }
    }

    /// The learning rate of step `step` of `steps`, both counted from 0.
    pub fn rate_at(&self, step: u64, steps: u64) -> f64 {
        match self.schedule {
            Schedule::Constant => self.learning_rate,
            Schedule::Cosine => {
                let part = step as f64 / steps.max(1) as f64;
                self.learning_rate * 0.5 * (1.0 + (std::f64::consts::PI * part).cos())
            }
        }
    }
}

settings! {
    /// The changes made to a labelled frame before each use in training.
    #[derive(Copy)]
    pub struct Augmentation {
        /// Whether frames are turned and mirrored.
        pub symmetries: bool = false;
        /// The largest shift along each axis, in taxels. The taxels that come in are background.
        pub shift_taxels: u8 = 0, in from_to((0.0, 4.0), "taxels");
    }
}

settings! {
    /// Errors in the reports about the arm, and other changes to a press, drawn anew for each press. A
    /// network that has only learnt from correct reports trusts every report.
    #[derive(Copy)]
    pub struct ArmReports {
        /// Share of the presses for which nothing is known about the arm.
        pub unknown: f64 = 0.3, in SHARE;
        /// Share of the other presses for which the stiffness is unknown.
        pub unknown_arm: f64 = 0.1, in SHARE;
        /// Share of the other presses whose reports have no error.
        pub exact: f64 = 0.5, in SHARE;
        /// The largest relative error of the positions.
        pub position: f64 = 0.1, in from_to((0.0, 0.5), "");
        /// The largest relative error of the stiffness.
        pub arm: f64 = 0.3, in from_to((0.0, 0.9), "");
        /// The largest error of the moments, in frames.
        pub clock_frames: f64 = 1.0, in from_to((0.0, 5.0), "frames");
        /// Share of the presses that are judged before their end.
        pub early: f64 = 0.25, in SHARE;
        /// Share of the presses that a slower sensor sees, with only every second to eighth frame.
        pub slower: f64 = 0.3, in SHARE;
        /// Share of the presses that take half to sixteen times as long.
        pub stretched: f64 = 0.3, in SHARE;
    }
}

settings! {
    /// Settings of a run. The defaults are the paper's. A method ignores the tables of stages that it
    /// does not have.
    #[derive(Copy)]
    pub struct Settings {
        /// The force on a taxel, in newtons, that becomes 1 in the network's image. 0 N becomes -1.
        /// 10.2 N is the full scale of 8 bits of 0.04 N.
        pub full_scale_n: f64 = 10.2, in at_least(1e-3);
        /// Above 0, the image is linear in log(1 + newtons / this value). With 0, it is linear in
        /// newtons.
        pub log_above_n: f64 = 0.0;
        /// Whether the recogniser's last layer takes each channel's mean beside its greatest value. A mean can add up
        /// an area or a force. It applies to a recogniser with a last layer of its own, so not to SGAN
        /// and IGAN, whose discriminator is the recogniser.
        pub mean_pooling: bool = false;
        /// Samples that the STGANs generate of each component of each level's mixture: 225 x 50 = 11,250 per
        /// level, which is thirty for each of the paper's 375 labelled samples. Fifty components of 10,000 samples
        /// each take 1.6 GB.
        pub generated_a_component: u32 = 225, in from_to((1.0, 1e4), "");
        /// Share of the labelled objects of each level that are held out, to fit the temperature and to follow the
        /// training, from 0 to 0.5. With 0, as in the paper, none are.
        pub held_out: f64 = 0.0, in from_to((0.0, 0.5), "");
        /// The GAN on unlabelled samples: USTGAN, or the GAN of SGAN and IGAN.
        pub ustgan: Training = Training::of_a_gan();
        /// Each STGAN.
        pub stgan: Training = Training::of_a_gan();
        /// The training of HRN on the generated samples.
        pub pretraining: Training = Training::default();
        /// The training on the labelled samples, from random weights or as the fine-tuning of other weights.
        pub training: Training = Training::default();
        /// The changes made to a frame before HRN learns from it.
        pub augmentation: Augmentation = Augmentation::default();
        /// What a robot reports of its arm, and the errors in it, for networks of whole presses.
        pub reports: ArmReports = ArmReports::default();
    }
}

impl Settings {
    /// Checks that each value is in its range.
    ///
    /// # Errors
    ///
    /// Names the first one that is not.
    pub(crate) fn check(&self) -> Result<(), OutOfRange> {
        self.check_ranges()?;
        let found = self.log_above_n;
        let fits = found == 0.0 || (1e-3..=1e3).contains(&found);
        range::check("log_above_n", found, fits, "0, or 0.001 to 1000 N")?;
        for (table, checked) in [
            ("ustgan", self.ustgan.check_ranges()),
            ("stgan", self.stgan.check_ranges()),
            ("pretraining", self.pretraining.check_ranges()),
            ("training", self.training.check_ranges()),
            ("augmentation", self.augmentation.check_ranges()),
            ("reports", self.reports.check_ranges()),
        ] {
            checked.map_err(|error| error.within(table))?;
        }
        Ok(())
    }
}

/// Settings with the values in `given` in place of their own, whatever their range.
///
/// # Errors
///
/// Returns an error if a key is unknown.
pub(crate) fn overridden<T: Serialize + DeserializeOwned>(
    settings: &T,
    given: &toml::Table,
) -> anyhow::Result<T> {
    let own = toml::Table::try_from(settings).expect("settings are plain tables");
    let merged = merged(own, given.clone()).try_into();
    merged.map_err(|error| coded(CONFIG, error.message()))
}

/// Reads a file of settings, whose values take the place of others.
///
/// # Errors
///
/// Returns an error if the text is not TOML with known keys, or a value lies outside its range.
pub fn parse(text: &str) -> anyhow::Result<toml::Table> {
    let syntax = |error| coded(CONFIG, wording::of_toml(text, &error));
    // The settings are read so that an error can show the line, and to check the given values.
    let settings: Settings = toml::from_str(text).map_err(syntax)?;
    settings.check().map_err(|error| coded(CONFIG, error))?;
    toml::from_str(text).map_err(syntax)
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
        let given = parse("[training]\nbatch = 50\nrule = \"adam\"").unwrap();
        let mut expected = Settings::default();
        expected.training.batch = 50;
        expected.training.rule = Rule::Adam;
        assert_eq!(overridden(&Settings::default(), &given).unwrap(), expected);
    }

    #[test]
    fn unusable_settings_are_refused_by_name() {
        for (text, expected) in [
            ("[training]\nepochs = \"3\"", "invalid type: string \"3\""),
            ("[stgan]\nbeta1 = 1", "stgan.beta1: found 1"),
            ("held_out = nan", "held_out: found NaN"),
            (
                "log_above_n = 1e-4",
                "log_above_n: found 0.0001, expected 0, or 0.001 to 1000",
            ),
            ("log_above_n = 1e-40", "expected 0, or 0.001 to 1000"),
            ("log_above_n = 1e4", "expected 0, or 0.001 to 1000"),
        ] {
            let error = parse(text).unwrap_err().to_string();
            assert!(error.contains(expected), "{text}: {error}");
            assert!(!error.contains('\n'), "{text}: {error}");
        }
    }
}
