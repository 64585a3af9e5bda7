//! What a GAN's training can be told.

use serde::{Deserialize, Serialize};

use super::bounds::{SettingsError, check, check_loop};
use super::optimiser::{OptimiserSettings, Rule};

/// How both sides learn; the defaults are the paper's ("Training of STGAN and USTGAN").
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GanSettings {
    /// Real samples a step. The last batch of an epoch may be smaller.
    pub batch: usize,
    /// Generated samples of each component a step.
    pub samples_a_component: usize,
    /// Passes over the real samples: what the paper calls iterations. Counted in steps, its 500
    /// would be six passes over the unlabelled samples; DeLiGAN's code calls an epoch so.
    pub epochs: u32,
    /// Lambda of Eq. (7), on a mean.
    pub sigma_penalty: f64,
    /// Decay a step of the running average of the discriminator's weights that is kept at the
    /// end; 0: the weights themselves.
    pub averaging: f64,
    /// A checkpoint is written after every so many epochs, and after the last.
    pub checkpoint_every_epochs: u32,
    /// A picture is drawn, and generated samples are measured, after every so many epochs and
    /// after the last.
    pub picture_every_epochs: u32,
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
            picture_every_epochs: 25,
            optimiser: OptimiserSettings {
                rule: Rule::Adam,
                // The paper gives no betas; DeLiGAN's code has 0.5.
                beta1: 0.5,
                ..OptimiserSettings::default()
            },
        }
    }
}

impl GanSettings {
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
        let (key, penalty) = ("sigma_penalty", self.sigma_penalty);
        check(table, key, penalty, penalty >= 0.0, "0 or more")?;
        let (key, every) = ("picture_every_epochs", self.picture_every_epochs);
        check(table, key, every, every > 0, "1 or more")?;
        self.optimiser.check(table)
    }
}
