//! A network while it learns: weights, optimiser, running average. All of it goes into a
//! checkpoint.

use burn::tensor::{Gradients, Tensor};

use super::optimiser::Optimiser;
use crate::train::net::network::{Weight, Weights};
use crate::train::run::checkpoint::Checkpoint;
use crate::train::settings::OptimiserSettings;
use crate::train::settings::optimiser::Rule;

/// Weights and what goes with them from step to step.
#[derive(Debug)]
pub struct Learner {
    /// As of the last step.
    pub weights: Weights,
    optimiser: Optimiser,
    /// Decay a step of the average.
    averaging: f64,
    /// Sum of decayed weights, if they are averaged.
    average: Option<Weights>,
}

impl Learner {
    /// Weights before their first step. They are averaged if `averaging`, the decay a step, is
    /// above 0.
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

    /// One as [`Learner::lists`] put it under `prefix` into a checkpoint, after so many steps of its
    /// own.
    ///
    /// # Errors
    ///
    /// If a part of it is missing there.
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

    /// What a checkpoint keeps of it.
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

    /// Takes a step; `gradients` belong to `tracked`, the weights as leaves.
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

    /// The weights to judge with: averaged ones if they are averaged. The average began at 0,
    /// which is divided out.
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
