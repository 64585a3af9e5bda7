//! The state of a network in training: weights, optimiser, running average. A checkpoint holds all
//! of it.
//!
//! The optimisers are plain SGD, as the paper trains HRN, and Adam, as it trains its GANs. They are
//! written here, on flat weights, so that a checkpoint can hold the whole state in full precision.

use burn::tensor::{Gradients, Tensor};

use crate::net::network::{Weights, numbers};
use crate::settings::{Rule, Training};

/// Adam's epsilon, as its authors recommend. burn's default of 1e-5 is not negligible beside the
/// gradients here.
const ADAM_EPSILON: f32 = 1e-8;
/// Adam's decay of the gradient's square, as its authors recommend.
const BETA2: f64 = 0.999;

/// The weights, and the state that changes with them at every step.
#[derive(Debug)]
pub struct Learner {
    /// The weights after the last step.
    pub weights: Weights,
    training: Training,
    /// The number of steps taken.
    steps: u64,
    /// Adam's running mean and mean square of each weight's gradient.
    moments: Option<[Weights; 2]>,
    /// The decayed sum of the weights, if they are averaged.
    average: Option<Weights>,
}

impl Learner {
    /// A learner before its first step.
    pub fn fresh(weights: Weights, training: Training) -> Self {
        let zeros = || weights.each(|values| values.zeros_like());
        Self {
            steps: 0,
            moments: (training.rule == Rule::Adam).then(|| [zeros(), zeros()]),
            average: (training.averaging > 0.0).then(zeros),
            training,
            weights,
        }
    }

    /// All numbers that a step changes, in a fixed order.
    pub fn numbers(&self) -> Vec<f32> {
        let lists = [&self.weights]
            .into_iter()
            .chain(self.moments.iter().flatten());
        let entries = lists.chain(&self.average).flat_map(|list| &list.entries);
        entries.flat_map(|weight| numbers(&weight.values)).collect()
    }

    /// Continues after `steps` steps, with numbers in the order of [`Learner::numbers`].
    pub fn resume(&mut self, steps: u64, saved: &mut impl Iterator<Item = f32>) {
        self.steps = steps;
        let lists = [&mut self.weights]
            .into_iter()
            .chain(self.moments.iter_mut().flatten());
        for weight in lists
            .chain(&mut self.average)
            .flat_map(|list| &mut list.entries)
        {
            let own: Vec<f32> = saved.take(weight.values.dims()[0]).collect();
            weight.values = Tensor::from_floats(own.as_slice(), &weight.values.device());
        }
    }

    /// Takes a step at `rate`. `gradients` belong to `tracked`, which are the weights as leaves. A
    /// weight without a gradient does not change.
    pub fn step(&mut self, tracked: &Weights, gradients: &mut Gradients, rate: f64) {
        self.steps += 1;
        let training = self.training;
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
                    *mean = (mean.clone().mul_scalar(training.beta1))
                        .add(gradient.clone().mul_scalar(1.0 - training.beta1));
                    *square = (square.clone().mul_scalar(BETA2))
                        .add(gradient.clone().mul(gradient).mul_scalar(1.0 - BETA2));
                    let deviation = square.clone().div_scalar(correction(BETA2)).sqrt();
                    (mean.clone().div_scalar(correction(training.beta1)))
                        .div(deviation.add_scalar(ADAM_EPSILON))
                }
            };
            let mut values = weight.values.clone();
            let is_kernel = weight.dims.len() > 1 && !weight.name.starts_with("mixture.");
            if training.weight_decay > 0.0 && is_kernel {
                values = values.mul_scalar(1.0 - rate * training.weight_decay);
            }
            weight.values = values.sub(step.mul_scalar(rate));
        }
        let Some(average) = &mut self.average else {
            return;
        };
        for (sum, weight) in average.entries.iter_mut().zip(&self.weights.entries) {
            let new = weight.values.clone().mul_scalar(1.0 - training.averaging);
            sum.values = sum.values.clone().mul_scalar(training.averaging).add(new);
        }
    }

    /// The weights to judge with: the averaged ones if there is an average. The average began at 0,
    /// so it is divided by the sum of its factors.
    pub fn evaluated(&self) -> Weights {
        let Some(average) = self.average.as_ref().filter(|_| self.steps > 0) else {
            return self.weights.clone();
        };
        let total = 1.0 - self.training.averaging.powf(self.steps as f64);
        average.each(|values| values.div_scalar(total))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[test]
    fn weight_decay_takes_from_kernels_alone() {
        let cases = [
            ("conv1.kernel", &[1, 1, 1, 1][..], 1.5),
            ("head.matrix", &[1, 1], 1.5),
            ("head.bias", &[1], 2.0),
            ("mixture.mu", &[1, 1], 2.0),
        ];
        let mut weights = Weights::new(&Device::flex());
        for (name, dims, _) in cases {
            weights.add(name, dims, vec![2.0]);
        }
        let tracked = weights.tracked();
        // Every weight has a gradient of 0, so only weight decay changes it.
        let values = tracked.entries.iter().map(|weight| weight.values.clone());
        let loss = Tensor::cat(values.collect(), 0).mul_scalar(0.0).sum();
        let settings = Training {
            weight_decay: 0.5,
            ..Training::default()
        };
        let mut learner = Learner::fresh(weights, settings);
        learner.step(&tracked, &mut loss.backward(), 0.5);
        for (name, _, expected) in cases {
            assert_eq!(learner.weights.numbers(name), [expected], "{name}");
        }
    }

    #[test]
    fn a_resumed_learner_goes_on_with_the_same_bits() {
        let settings = Training {
            rule: Rule::Adam,
            averaging: 0.9,
            weight_decay: 0.01,
            ..Training::default()
        };
        let fresh = || {
            let mut weights = Weights::new(&Device::flex());
            weights.add("head.matrix", &[2, 2], vec![0.3, -0.2, 0.7, 0.1]);
            weights.add("head.bias", &[2], vec![0.5, -0.4]);
            Learner::fresh(weights, settings)
        };
        let take_three = |learner: &mut Learner| {
            for _ in 0..3 {
                let tracked = learner.weights.tracked();
                let values = tracked.entries.iter().map(|weight| weight.values.clone());
                let values = Tensor::cat(values.collect(), 0);
                let loss = values.clone().mul(values.clone()).mul(values).sum();
                learner.step(&tracked, &mut loss.backward(), 0.01);
            }
        };
        let bits = |numbers: &[f32]| numbers.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        let mut whole = fresh();
        take_three(&mut whole);
        let kept = whole.numbers();
        // Weights, two moments and the average, of six numbers each.
        assert_eq!(kept.len(), 4 * 6);
        let mut resumed = fresh();
        let mut saved = kept.iter().copied();
        resumed.resume(3, &mut saved);
        assert_eq!(saved.next(), None);
        assert_eq!(bits(&resumed.numbers()), bits(&kept));
        for learner in [&mut whole, &mut resumed] {
            take_three(learner);
        }
        assert_eq!(bits(&resumed.numbers()), bits(&whole.numbers()));
        assert_ne!(bits(&whole.numbers()), bits(&kept));
        let judged = [&whole, &resumed].map(|of| bits(&of.evaluated().numbers("head.matrix")));
        assert_eq!(judged[0], judged[1]);
    }
}
