//! Settings of a GAN's training.

use serde::{Deserialize, Serialize};

use super::Keep;
use super::bounds::{MOST_SAMPLES_A_COMPONENT, SettingsError, check, check_loop};
use super::optimiser::{OptimiserSettings, Rule};

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
    /// Gamma of the gradient penalty R1 on real images (Mescheder et al. 2018, Eq. (9)). With 0, as
    /// in the paper, there is none.
    pub gradient_penalty: f64,
    /// Decay per step of the running average of the discriminator's weights. The average is kept at
    /// the end. With 0, the weights themselves are.
    pub averaging: f64,
    /// The same for the generator's weights.
    pub generator_averaging: f64,
    /// The weights to keep: `last`, as in the paper, or `best`, those of the measured epoch whose
    /// generated samples lie nearest to the real ones (`feature_distance`).
    pub keep: Keep,
    /// The number of epochs between two checkpoints. The last epoch always ends with one.
    pub checkpoint_every_epochs: u32,
    /// The number of epochs between two pictures, and between two measurements of generated
    /// samples. The last epoch always ends with both.
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
            gradient_penalty: 0.0,
            averaging: 0.0,
            generator_averaging: 0.0,
            keep: Keep::Last,
            checkpoint_every_epochs: 5,
            picture_every_epochs: 25,
            optimiser: OptimiserSettings {
                rule: Rule::Adam,
                // The paper gives no betas. DeLiGAN's code has 0.5.
                beta1: 0.5,
                ..OptimiserSettings::default()
            },
        }
    }
}

impl GanSettings {
    /// Returns an error if a value lies outside its range. `table` is the prefix of the keys.
    pub(crate) fn check(&self, table: &str) -> Result<(), SettingsError> {
        check_loop(
            table,
            self.batch,
            self.epochs,
            self.averaging,
            self.checkpoint_every_epochs,
        )?;
        let samples = self.samples_a_component;
        let key = "samples_a_component";
        let fits = (1..=MOST_SAMPLES_A_COMPONENT as usize).contains(&samples);
        check(table, key, samples as f64, fits, "1 to 10000")?;
        for (key, penalty) in [
            ("sigma_penalty", self.sigma_penalty),
            ("gradient_penalty", self.gradient_penalty),
        ] {
            check(table, key, penalty, penalty >= 0.0, "0 or more")?;
        }
        let (key, decay) = ("generator_averaging", self.generator_averaging);
        check(
            table,
            key,
            decay,
            (0.0..1.0).contains(&decay),
            "0 to below 1",
        )?;
        let (key, every) = ("picture_every_epochs", self.picture_every_epochs);
        check(table, key, every, every > 0, "1 or more")?;
        self.optimiser.check(table)
    }
}
