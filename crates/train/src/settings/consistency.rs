//! Settings for learning from unlabelled samples by consistency.

use serde::{Deserialize, Serialize};

use super::bounds::{SettingsError, check};

/// Settings for learning from unlabelled samples without a GAN (FixMatch, Sohn et al. 2020, with
/// the averaged weights as the teacher).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ConsistencySettings {
    /// Unlabelled samples per labelled sample in each step.
    pub ratio: usize,
    /// The least confidence of the teacher at which its verdict on an unlabelled sample is learnt.
    pub confidence: f64,
    /// Weight of the unlabelled samples' loss relative to the labelled samples' loss.
    pub weight: f64,
}

impl Default for ConsistencySettings {
    fn default() -> Self {
        Self {
            ratio: 3,
            confidence: 0.95,
            weight: 1.0,
        }
    }
}

impl ConsistencySettings {
    /// Returns an error if a value lies outside its range.
    pub(super) fn check(&self) -> Result<(), SettingsError> {
        let check =
            |key, found: f64, fits, expected| check("consistency.", key, found, fits, expected);
        let fits = (1..=1000).contains(&self.ratio);
        check("ratio", self.ratio as f64, fits, "1 to 1000")?;
        let fits = (0.0..=1.0).contains(&self.confidence);
        check("confidence", self.confidence, fits, "0 to 1")?;
        check("weight", self.weight, self.weight >= 0.0, "0 or more")
    }
}
