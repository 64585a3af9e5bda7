//! The state of a network in training: weights, optimiser, running average. A checkpoint holds all
//! of it.
//!
//! The optimisers are plain SGD, as the paper trains HRN, and Adam, as it trains its GANs. They are
//! written here, on flat weights, so that a checkpoint can hold the whole state in full precision.

use burn::tensor::Gradients;

use crate::net::network::{Weight, Weights};
use crate::run::checkpoint::Checkpoint;
use crate::settings::OptimiserSettings;
use crate::settings::optimiser::Rule;

/// Adam's epsilon, as its authors recommend. burn's default of 1e-5 is not negligible beside the
/// gradients here.
const ADAM_EPSILON: f32 = 1e-8;

/// The weights, and the state that changes with them at every step.
#[derive(Debug)]
pub struct Learner {
    /// The weights after the last step.
    pub weights: Weights,
    optimiser: OptimiserSettings,
    /// The number of steps taken.
    steps: u64,
    /// Adam's running mean and mean square of each weight's gradient.
    moments: Option<[Weights; 2]>,
    /// The decay of the average per step.
    averaging: f64,
    /// The decayed sum of the weights, if they are averaged.
    average: Option<Weights>,
}

impl Learner {
    /// A learner before its first step. `averaging` is the decay of the average per step; 0 means
    /// no average.
    pub fn fresh(weights: Weights, optimiser: OptimiserSettings, averaging: f64) -> Self {
        let zeros = || {
            let zero = |weight: &Weight| Weight {
                values: weight.values.zeros_like(),
                ..weight.clone()
            };
            Weights {
                entries: weights.entries.iter().map(zero).collect(),
            }
        };
        Self {
            optimiser,
            steps: 0,
            moments: (optimiser.rule == Rule::Adam).then(|| [zeros(), zeros()]),
            averaging,
            average: (averaging > 0.0).then(zeros),
            weights,
        }
    }

    /// The learner that [`Learner::lists`] stored in a checkpoint under `prefix`, after `steps`
    /// steps.
    ///
    /// # Errors
    ///
    /// Fails if the checkpoint lacks a part of the learner.
    pub fn resumed(
        checkpoint: &Checkpoint,
        prefix: &str,
        steps: u64,
        optimiser: OptimiserSettings,
        averaging: f64,
    ) -> anyhow::Result<Self> {
        let list = |name: &str| checkpoint.list(&format!("{prefix}{name}")).cloned();
        let moments = || Ok::<_, anyhow::Error>([list("mean")?, list("square")?]);
        Ok(Self {
            weights: list("weights")?,
            optimiser,
            steps,
            moments: (optimiser.rule == Rule::Adam).then(moments).transpose()?,
            averaging,
            average: (averaging > 0.0).then(|| list("average")).transpose()?,
        })
    }

    /// The lists that a checkpoint stores, each name preceded by `prefix`.
    pub fn lists(&self, prefix: &str) -> Vec<(String, Weights)> {
        let moments = self.moments.iter();
        let moments = moments.flat_map(|[mean, square]| [("mean", mean), ("square", square)]);
        let average = self.average.iter().map(|list| ("average", list));
        let lists = [("weights", &self.weights)].into_iter().chain(moments);
        let named = |(name, list): (&str, &Weights)| (format!("{prefix}{name}"), list.clone());
        lists.chain(average).map(named).collect()
    }

    /// Takes a step at `rate`. `gradients` belong to `tracked`, which are the weights as leaves. A
    /// weight without a gradient does not change.
    pub fn step(&mut self, tracked: &Weights, gradients: &mut Gradients, rate: f64) {
        self.steps += 1;
        let OptimiserSettings {
            beta1,
            beta2,
            weight_decay,
            ..
        } = self.optimiser;
        let correction = |beta: f64| 1.0 - beta.powf(self.steps as f64);
        for (index, weight) in self.weights.entries.iter_mut().enumerate() {
            let Some(gradient) = tracked.entries[index].values.grad_remove(gradients) else {
                continue;
            };
            let step = match &mut self.moments {
                None => gradient,
                Some(moments) => {
                    let [mean, square] =
                        moments.each_mut().map(|all| &mut all.entries[index].values);
                    *mean = (mean.clone().mul_scalar(beta1))
                        .add(gradient.clone().mul_scalar(1.0 - beta1));
                    *square = (square.clone().mul_scalar(beta2))
                        .add(gradient.clone().mul(gradient).mul_scalar(1.0 - beta2));
                    let deviation = square.clone().div_scalar(correction(beta2)).sqrt();
                    (mean.clone().div_scalar(correction(beta1)))
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
        let Some(average) = &mut self.average else {
            return;
        };
        for (sum, weight) in average.entries.iter_mut().zip(&self.weights.entries) {
            let new = weight.values.clone().mul_scalar(1.0 - self.averaging);
            sum.values = sum.values.clone().mul_scalar(self.averaging).add(new);
        }
    }

    /// The weights to judge with: the averaged ones if there is an average. The average began at 0,
    /// so it is divided by the sum of its factors.
    pub fn evaluated(&self) -> Weights {
        let Some(average) = self.average.as_ref().filter(|_| self.steps > 0) else {
            return self.weights.clone();
        };
        let total = 1.0 - self.averaging.powf(self.steps as f64);
        let divided = |weight: &Weight| Weight {
            values: weight.values.clone().div_scalar(total),
            ..weight.clone()
        };
        Weights {
            entries: average.entries.iter().map(divided).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::{Device, Tensor};

    #[test]
    fn weight_decay_takes_from_kernels_alone() {
        let cases = [
            ("conv1.kernel", &[1, 1, 1, 1][..], 1.5),
            ("head.matrix", &[1, 1], 1.5),
            ("head.bias", &[1], 2.0),
            ("mixture.mu", &[1, 1], 2.0),
            ("mixture.sigma", &[1, 1], 2.0),
        ];
        let mut weights = Weights::default();
        for (name, dims, _) in cases {
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
        let mut learner = Learner::fresh(weights, settings, 0.0);
        learner.step(&tracked, &mut loss.backward(), 0.5);
        for (name, _, expected) in cases {
            assert_eq!(learner.weights.numbers(name), [expected], "{name}");
        }
    }
}
