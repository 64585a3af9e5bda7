//! Gradient steps: plain SGD, as the paper trains HRN, and Adam, as it trains its GANs.
//!
//! Written out on flat weights so that a checkpoint can hold the whole state in full precision.

use burn::tensor::{Gradients, Tensor};
use serde::{Deserialize, Serialize};

use super::network::Weights;
use super::settings::{SettingsError, check};

/// Adam's epsilon, of its authors. burn's default of 1e-5 is not negligible beside the gradients
/// here.
const ADAM_EPSILON: f32 = 1e-8;

/// Which rule.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rule {
    /// `w -= rate g`.
    Sgd,
    /// Kingma and Ba 2015, with decoupled weight decay.
    Adam,
}

/// How the learning rate goes over the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Schedule {
    /// The same throughout.
    Constant,
    /// From the full rate to 0 along half a cosine.
    Cosine,
}

/// Settings of an optimiser.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// `sgd` or `adam`.
    pub rule: Rule,
    /// At the first step.
    pub learning_rate: f64,
    /// `constant` or `cosine`.
    pub schedule: Schedule,
    /// Adam's decay of the gradient's mean.
    pub beta1: f64,
    /// Adam's decay of the gradient's square.
    pub beta2: f64,
    /// Share of a kernel taken away a step, times the learning rate; not of biases, nor
    /// of the mixture's mu and sigma.
    pub weight_decay: f64,
}

impl Default for Settings {
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

impl Settings {
    /// Refuses what lies outside its range; `table` is where these settings stand.
    pub(super) fn check(&self, table: &str) -> Result<(), SettingsError> {
        let table = format!("{table}optimiser.");
        let check = |key, found, fits, expected| check(&table, key, found, fits, expected);
        let within_0_1 = |value: f64| (0.0..1.0).contains(&value);
        let rate = self.learning_rate;
        check("learning_rate", rate, rate > 0.0, "above 0")?;
        for (key, beta) in [("beta1", self.beta1), ("beta2", self.beta2)] {
            check(key, beta, within_0_1(beta), "0 to below 1")?;
        }
        let decay = self.weight_decay;
        check("weight_decay", decay, decay >= 0.0, "0 or more")
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

/// An optimiser with its state.
#[derive(Debug)]
pub struct Optimiser {
    settings: Settings,
    /// Steps taken.
    step: u64,
    /// Running mean and mean square of each weight's gradient; empty for SGD.
    moments: Vec<(Tensor<1>, Tensor<1>)>,
}

impl Optimiser {
    /// A fresh optimiser for `weights`.
    pub fn new(settings: Settings, weights: &Weights) -> Self {
        let zeros = |values: &Tensor<1>| values.zeros_like();
        let moments = match settings.rule {
            Rule::Sgd => Vec::new(),
            Rule::Adam => weights
                .entries
                .iter()
                .map(|weight| (zeros(&weight.values), zeros(&weight.values)))
                .collect(),
        };
        Self {
            settings,
            step: 0,
            moments,
        }
    }

    /// Takes one step at `rate`. `tracked` are the leaves that `gradients` belong to, in the
    /// order of `weights`; a weight without a gradient stays.
    pub fn step(
        &mut self,
        weights: &mut Weights,
        tracked: &Weights,
        gradients: &mut Gradients,
        rate: f64,
    ) {
        self.step += 1;
        let Settings {
            rule,
            beta1,
            beta2,
            weight_decay,
            ..
        } = self.settings;
        let correction = |beta: f64| 1.0 - beta.powf(self.step as f64);
        for (index, weight) in weights.entries.iter_mut().enumerate() {
            let Some(gradient) = tracked.entries[index].values.grad_remove(gradients) else {
                continue;
            };
            let step = match rule {
                Rule::Sgd => gradient,
                Rule::Adam => {
                    let (mean, square) = self.moments[index].clone();
                    let mean = mean
                        .mul_scalar(beta1)
                        .add(gradient.clone().mul_scalar(1.0 - beta1));
                    let square = square
                        .mul_scalar(beta2)
                        .add(gradient.clone().mul(gradient).mul_scalar(1.0 - beta2));
                    self.moments[index] = (mean.clone(), square.clone());
                    let deviation = square.div_scalar(correction(beta2)).sqrt();
                    mean.div_scalar(correction(beta1))
                        .div(deviation.add_scalar(ADAM_EPSILON))
                }
            };
            let mut values = weight.values.clone();
            let is_kernel = weight.dims.len() > 1 && !weight.name.starts_with("mixture.");
            if weight_decay > 0.0 && is_kernel {
                values = values.mul_scalar(1.0 - rate * weight_decay);
            }
            weight.values = values.sub(step.mul_scalar(rate));
        }
    }

    /// Steps taken so far.
    pub fn steps(&self) -> u64 {
        self.step
    }

    /// Each weight's moments, for a checkpoint; empty for SGD.
    pub fn moments(&self) -> &[(Tensor<1>, Tensor<1>)] {
        &self.moments
    }

    /// The optimiser as it was after `step` steps with these moments.
    #[must_use]
    pub fn resumed(settings: Settings, step: u64, moments: Vec<(Tensor<1>, Tensor<1>)>) -> Self {
        Self {
            settings,
            step,
            moments,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[test]
    fn weight_decay_takes_from_kernels_alone() {
        let mut weights = Weights::default();
        for (name, dims) in [
            ("conv1.kernel", &[1, 1, 1, 1][..]),
            ("head.matrix", &[1, 1]),
            ("head.bias", &[1]),
            ("mixture.mu", &[1, 1]),
            ("mixture.sigma", &[1, 1]),
        ] {
            weights.add(name, dims, vec![2.0], &Device::flex());
        }
        let tracked = weights.tracked();
        // Every weight has a gradient, of 0.
        let values = tracked.entries.iter().map(|weight| weight.values.clone());
        let loss = Tensor::cat(values.collect(), 0).mul_scalar(0.0).sum();
        let settings = Settings {
            weight_decay: 0.5,
            ..Settings::default()
        };
        let mut gradients = loss.backward();
        Optimiser::new(settings, &weights).step(&mut weights, &tracked, &mut gradients, 0.5);
        for (name, expected) in [
            ("conv1.kernel", 1.5),
            ("head.matrix", 1.5),
            ("head.bias", 2.0),
            ("mixture.mu", 2.0),
            ("mixture.sigma", 2.0),
        ] {
            assert_eq!(weights.numbers(name), [expected], "{name}");
        }
    }
}
