//! What a GAN's training can be told.

use serde::{Deserialize, Serialize};

use crate::train::optimiser;
use crate::train::settings::{SettingsError, check, check_loop};

/// Who takes a step when.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Turns {
    /// First the discriminator, then the generator, as the paper.
    Alternate,
    /// Whoever is behind by the generator's loss, as in DeLiGAN's code.
    Threshold,
}

/// How both sides learn; the defaults are the paper's ("Training of STGAN and USTGAN").
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Real samples a step. The last batch of an epoch may be smaller.
    pub batch: usize,
    /// Generated samples of each component a step.
    pub samples_a_component: usize,
    /// Passes over the real samples: what the paper calls iterations. Counted in steps, its 500
    /// would be six passes over the unlabelled samples; DeLiGAN's code calls an epoch so.
    pub epochs: u32,
    /// `alternate` or `threshold`.
    pub turns: Turns,
    /// Lambda of Eq. (7), on a mean.
    pub sigma_penalty: f64,
    /// Greatest size that a step leaves an entry of sigma; 0: any.
    pub sigma_cap: f64,
    /// Decay a step of the running average of the discriminator's weights that is kept at the
    /// end; 0: the weights themselves.
    pub averaging: f64,
    /// A checkpoint is written after every so many epochs, and after the last.
    pub checkpoint_every_epochs: u32,
    /// A picture is drawn, and generated samples are measured, after every so many epochs and
    /// after the last.
    pub picture_every_epochs: u32,
    /// Of both sides.
    pub optimiser: optimiser::Settings,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            batch: 100,
            samples_a_component: 2,
            epochs: 500,
            turns: Turns::Alternate,
            sigma_penalty: 0.1,
            sigma_cap: 0.0,
            averaging: 0.0,
            checkpoint_every_epochs: 5,
            picture_every_epochs: 25,
            optimiser: optimiser::Settings {
                rule: optimiser::Rule::Adam,
                // The paper gives no betas; DeLiGAN's code has 0.5.
                beta1: 0.5,
                ..optimiser::Settings::default()
            },
        }
    }
}

impl Settings {
    /// Refuses what lies outside its range; `table` is where these settings stand.
    pub(in crate::train) fn check(&self, table: &str) -> Result<(), SettingsError> {
        check_loop(
            table,
            self.batch,
            self.epochs,
            self.averaging,
            self.checkpoint_every_epochs,
        )?;
        let samples = self.samples_a_component;
        let key = "samples_a_component";
        check(table, key, samples as f64, samples > 0, "1 or more")?;
        for (key, value) in [
            ("sigma_penalty", self.sigma_penalty),
            ("sigma_cap", self.sigma_cap),
        ] {
            check(table, key, value, value >= 0.0, "0 or more")?;
        }
        let (key, every) = ("picture_every_epochs", self.picture_every_epochs);
        check(table, key, every, every > 0, "1 or more")?;
        self.optimiser.check(table)
    }
}
