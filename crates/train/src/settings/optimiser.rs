//! Settings of an optimiser.

use serde::{Deserialize, Serialize};

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

/// Settings of an optimiser.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OptimiserSettings {
    /// The rule of a step: `sgd` or `adam`.
    pub rule: Rule,
    /// The learning rate of the first step.
    pub learning_rate: f64,
    /// The schedule of the learning rate: `constant` or `cosine`.
    pub schedule: Schedule,
    /// Adam's decay of the gradient's mean.
    pub beta1: f64,
    /// Adam's decay of the gradient's square.
    pub beta2: f64,
    /// The share, times the learning rate, by which each step shrinks a kernel. Biases and the
    /// mixture's mu and sigma do not decay.
    pub weight_decay: f64,
}

impl Default for OptimiserSettings {
    fn default() -> Self {
        Self {
            rule: Rule::Sgd,
            learning_rate: 1e-3,
            schedule: Schedule::Constant,
            beta1: 0.9,
            beta2: 0.999,
            weight_decay: 0.0,
        }
    }
}

impl OptimiserSettings {
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
