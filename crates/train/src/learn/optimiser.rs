//! Gradient steps: plain SGD, as the paper trains HRN, and Adam, as it trains its GANs.
//!
//! The optimisers are written here, on flat weights, so that a checkpoint can hold the whole state
//! in full precision.

use burn::tensor::{Gradients, Tensor};

use crate::net::network::Weights;
use crate::settings::OptimiserSettings;
use crate::settings::optimiser::Rule;

/// Adam's epsilon, as its authors recommend. burn's default of 1e-5 is not negligible beside the
/// gradients here.
const ADAM_EPSILON: f32 = 1e-8;

/// An optimiser with its state.
#[derive(Debug)]
pub struct Optimiser {
    settings: OptimiserSettings,
    /// The number of steps taken.
    step: u64,
    /// Running mean and mean square of each weight's gradient; empty for SGD.
    moments: Vec<(Tensor<1>, Tensor<1>)>,
}

impl Optimiser {
    /// A fresh optimiser for `weights`.
    pub fn new(settings: OptimiserSettings, weights: &Weights) -> Self {
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

    /// Takes one step at `rate`. `tracked` are the leaves that `gradients` belong to, in the order
    /// of `weights`. A weight without a gradient does not change.
    pub fn step(
        &mut self,
        weights: &mut Weights,
        tracked: &Weights,
        gradients: &mut Gradients,
        rate: f64,
    ) {
        self.step += 1;
        let OptimiserSettings {
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

    /// The number of steps taken so far.
    pub fn steps(&self) -> u64 {
        self.step
    }

    /// Each weight's moments, for a checkpoint; empty for SGD.
    pub fn moments(&self) -> &[(Tensor<1>, Tensor<1>)] {
        &self.moments
    }

    /// The optimiser as it was after `step` steps with these moments.
    #[must_use]
    pub fn resumed(
        settings: OptimiserSettings,
        step: u64,
        moments: Vec<(Tensor<1>, Tensor<1>)>,
    ) -> Self {
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
        // Every weight has a gradient of 0, so only weight decay changes it.
        let values = tracked.entries.iter().map(|weight| weight.values.clone());
        let loss = Tensor::cat(values.collect(), 0).mul_scalar(0.0).sum();
        let settings = OptimiserSettings {
            weight_decay: 0.5,
            ..OptimiserSettings::default()
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
