//! The state of a network in training: weights, optimiser, running average. A checkpoint holds all
//! of it.

use burn::tensor::{Gradients, Tensor};

use super::optimiser::Optimiser;
use crate::net::network::{Weight, Weights};
use crate::run::checkpoint::Checkpoint;
use crate::settings::OptimiserSettings;
use crate::settings::optimiser::Rule;

/// The weights, and the state that changes with them at every step.
#[derive(Debug)]
pub struct Learner {
    /// The weights after the last step.
    pub weights: Weights,
    optimiser: Optimiser,
    /// The decay of the average per step.
    averaging: f64,
    /// The decayed sum of the weights, if they are averaged.
    average: Option<Weights>,
}

impl Learner {
    /// A learner before its first step. `averaging` is the decay of the average per step; 0 means
    /// no average.
    pub fn fresh(weights: Weights, settings: OptimiserSettings, averaging: f64) -> Self {
        let zeros = |weight: &Weight| Weight {
            values: weight.values.zeros_like(),
            ..weight.clone()
        };
        let average = Weights {
            entries: weights.entries.iter().map(zeros).collect(),
        };
        Self {
            optimiser: Optimiser::new(settings, &weights),
            averaging,
            average: (averaging > 0.0).then_some(average),
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
        settings: OptimiserSettings,
        averaging: f64,
    ) -> anyhow::Result<Self> {
        let list = |name: &str| checkpoint.list(&format!("{prefix}{name}"));
        let moments = match settings.rule {
            Rule::Sgd => Vec::new(),
            Rule::Adam => {
                let pair = |(mean, square): (&Weight, &Weight)| {
                    (mean.values.clone(), square.values.clone())
                };
                let (means, squares) = (list("mean")?, list("square")?);
                means
                    .entries
                    .iter()
                    .zip(&squares.entries)
                    .map(pair)
                    .collect()
            }
        };
        let average = if averaging > 0.0 {
            Some(list("average")?.clone())
        } else {
            None
        };
        Ok(Self {
            weights: list("weights")?.clone(),
            optimiser: Optimiser::resumed(settings, steps, moments),
            averaging,
            average,
        })
    }

    /// The lists that a checkpoint stores, each name preceded by `prefix`.
    pub fn lists(&self, prefix: &str) -> Vec<(String, Weights)> {
        let like_weights = |values: Vec<Tensor<1>>| {
            let with = |(weight, values): (&Weight, Tensor<1>)| Weight {
                values,
                ..weight.clone()
            };
            Weights {
                entries: self.weights.entries.iter().zip(values).map(with).collect(),
            }
        };
        let mut lists = vec![("weights", self.weights.clone())];
        let moments = self.optimiser.moments();
        if !moments.is_empty() {
            let means = moments.iter().map(|(mean, _)| mean.clone()).collect();
            let squares = moments.iter().map(|(_, square)| square.clone()).collect();
            lists.push(("mean", like_weights(means)));
            lists.push(("square", like_weights(squares)));
        }
        lists.extend(self.average.iter().map(|list| ("average", list.clone())));
        let named = |(name, list)| (format!("{prefix}{name}"), list);
        lists.into_iter().map(named).collect()
    }

    /// Takes a step. `gradients` belong to `tracked`, which are the weights as leaves.
    pub fn step(&mut self, tracked: &Weights, gradients: &mut Gradients, rate: f64) {
        self.optimiser
            .step(&mut self.weights, tracked, gradients, rate);
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
        let Some(average) = self.average.as_ref().filter(|_| self.optimiser.steps() > 0) else {
            return self.weights.clone();
        };
        let total = 1.0 - self.averaging.powf(self.optimiser.steps() as f64);
        let divided = |weight: &Weight| Weight {
            values: weight.values.clone().div_scalar(total),
            ..weight.clone()
        };
        Weights {
            entries: average.entries.iter().map(divided).collect(),
        }
    }
}
