//! The supervised training loop: Eq. (9) minimised over labelled frames.
//!
//! In: a data set, which of its samples to learn from and which to validate on, and initial
//! weights. Out: weights, the statistics of their batch normalisation, and a temperature. The test
//! split never enters here.

use burn::tensor::{Device, Tensor};

use crate::data::augment;
use crate::data::dataset::{self, Dataset};
use crate::learn::epochs::{self, Batch, Judge};
use crate::learn::learner::Learner;
use crate::learn::temperature::{self, LevelAndLogits};
use crate::net::hrn;
use crate::net::image::PixelScale;
use crate::net::network::{Normalisation, Statistics, Weights, numbers};
use crate::run::Run;
use crate::run::checkpoint::Origin;
use crate::run::progress::ensure_finite;
use crate::settings::{Training, Validation};
use hardnessd_core::verdict::{ModelFrame, argmax};
use hardnessd_simulator::random::Stream;

/// Samples per pass without gradients.
const JUDGED_AT_ONCE: usize = 250;

/// The inputs of a training.
#[derive(Debug)]
pub struct Task<'a> {
    /// The name of the stage in its checkpoints and in `metrics.csv`.
    pub stage: &'static str,
    /// The data set that the indices below refer to.
    pub dataset: &'a Dataset,
    /// Labelled samples to learn from.
    pub train: &'a [usize],
    /// Samples of held-out training objects, and how they are used; may be empty.
    pub validation: (&'a [usize], Validation),
    /// The scale from newtons to images.
    pub scale: PixelScale,
    /// Settings of the training.
    pub settings: &'a Training,
    /// Seed of the order of the samples and of their augmentation.
    pub seed: u64,
    /// The device that computes.
    pub device: &'a Device,
}

/// A trained recogniser.
#[derive(Debug)]
pub struct Trained {
    /// Weights of trunk and head.
    pub weights: Weights,
    /// Mean and variance of each normalised layer over the training samples.
    pub statistics: Statistics,
    /// The divisor of the logits. Without validation objects it is 1.
    pub temperature: f32,
}

impl Trained {
    /// Logits of `frames`, a row each, before temperature.
    pub fn logits<'a>(
        &self,
        frames: impl Iterator<Item = &'a ModelFrame>,
        scale: PixelScale,
        device: &Device,
    ) -> Vec<Vec<f32>> {
        let frames: Vec<&ModelFrame> = frames.collect();
        let mut rows = Vec::with_capacity(frames.len());
        for part in frames.chunks(JUDGED_AT_ONCE) {
            let images = scale.images(part.iter().copied(), device);
            let mut normalisation = Normalisation::Fixed(&self.statistics);
            let logits = hrn::logits(&self.weights, images, &mut normalisation);
            let levels = logits.dims()[1];
            rows.extend(numbers(&logits).chunks(levels).map(<[f32]>::to_vec));
        }
        rows
    }
}

/// Trains from `initial`, or from the stage's last checkpoint in `run`.
///
/// # Errors
///
/// Fails if the run's directory cannot be read or written, its checkpoint is of another stage than
/// this, or the loss, a weight or a logit of the trained network is no longer finite.
pub fn fit(task: &Task, initial: Weights, run: &Run) -> anyhow::Result<Trained> {
    let (held_out, validation) = task.validation;
    let stage = epochs::Stage {
        name: task.stage,
        origin: task.origin(&initial),
        // Generated frames have no source file.
        generated: task.dataset.sources.is_empty(),
        train: task.train,
        settings: task.settings,
        seed: task.seed,
    };
    let judge: Judge = &|weights| task.validated(weights);
    let validation = (!held_out.is_empty()).then_some((validation, judge));
    let learn = |learner: &mut Learner, batch: Batch| Ok(task.step(learner, batch));
    let weights = epochs::run(&stage, initial, run, task.device, validation, learn)?;
    let mut trained = task.finished(weights, task.settings.epochs)?;
    trained.temperature = task.fitted_temperature(&trained).unwrap_or(1.0);
    Ok(trained)
}

/// Takes a step of HRN on images `[batch, 1, 28, 28]` and targets `[batch, L]`. Returns the mean
/// loss and the logits before the step, row by row.
pub fn step(
    hrn: &mut Learner,
    images: Tensor<4>,
    targets: Tensor<2>,
    rate: f64,
) -> (f64, Vec<f32>) {
    let tracked = hrn.weights.tracked();
    let logits = hrn::logits(&tracked, images, &mut Normalisation::Batch);
    let judged = numbers(&logits);
    let loss = hrn::cross_entropy(logits, targets);
    let mut gradients = loss.backward();
    hrn.step(&tracked, &mut gradients, rate);
    (f64::from(numbers(&loss)[0]), judged)
}

fn levels() -> usize {
    dataset::levels().len()
}

impl Task<'_> {
    fn origin(&self, initial: &Weights) -> String {
        let settings = (self.settings, self.validation.1, self.scale);
        Origin::new(self.stage, &settings, self.seed)
            .samples(self.dataset, self.train)
            .samples(self.dataset, self.validation.0)
            .weights(initial)
            .finish()
    }

    /// Takes a step. Returns the batch's mean loss, and how many of its samples were judged
    /// correctly before the step.
    fn step(&self, learner: &mut Learner, batch: Batch) -> (f64, f64) {
        let images = self.images(batch.samples, batch.step);
        let targets = self.targets(batch.samples);
        let (loss, judged) = step(learner, images, targets, batch.rate);
        let right = batch
            .samples
            .iter()
            .zip(judged.chunks(levels()))
            .filter(|(index, logits)| argmax(logits).0 == self.level(**index))
            .count();
        (loss, right as f64)
    }

    /// Loss and accuracy of `weights` on the validation samples.
    fn validated(&self, weights: &Weights) -> (f64, f64) {
        let (samples, _) = self.validation;
        let judged = self.judge(&self.with_statistics(weights.clone()), samples);
        let right = judged
            .iter()
            .filter(|(level, logits)| argmax(logits).0 == *level)
            .count();
        let loss = temperature::mean_loss(&judged, 1.0);
        (loss, right as f64 / judged.len() as f64)
    }

    fn stream(&self, name: &str) -> Stream {
        Stream::new(self.seed, &format!("{} {name}", self.stage))
    }

    /// Images of one batch, augmented for step `step`.
    fn images(&self, indices: &[usize], step: u64) -> Tensor<4> {
        let mut stream = self.stream("augmentation").child(step);
        let frames: Vec<ModelFrame> = indices
            .iter()
            .map(|&index| {
                let frame = &self.dataset.samples[index].frame;
                augment::vary(frame, self.settings.augmentation, &mut stream)
            })
            .collect();
        self.scale.images(frames.iter(), self.device)
    }

    fn targets(&self, indices: &[usize]) -> Tensor<2> {
        let levels_of = indices
            .iter()
            .map(|&index| self.dataset.samples[index].level);
        hrn::targets(levels_of, levels(), self.device)
    }

    /// A recogniser of `weights` with statistics over the training samples and no temperature.
    fn with_statistics(&self, weights: Weights) -> Trained {
        Trained {
            statistics: self.statistics(&weights),
            weights,
            temperature: 1.0,
        }
    }

    /// The recogniser of `weights` at the end of a stage of `epochs` epochs.
    ///
    /// # Errors
    ///
    /// Fails if a logit is not finite, which finite weights can still cause.
    pub fn finished(&self, weights: Weights, epochs: u32) -> anyhow::Result<Trained> {
        let trained = self.with_statistics(weights);
        // One frame is enough for this check, and it need not be labelled.
        for logit in self.logits(&trained, &self.train[..1]).concat() {
            ensure_finite(self.stage, epochs, "logit", logit.into())?;
        }
        Ok(trained)
    }

    /// The temperature of least loss on the validation samples; `None` without any.
    fn fitted_temperature(&self, trained: &Trained) -> Option<f32> {
        let (samples, _) = self.validation;
        (!samples.is_empty()).then(|| temperature::fit(&self.judge(trained, samples)))
    }

    /// Statistics of the normalised layers over the training samples, augmented as the settings
    /// say, in batches of their size. A smaller remainder is left out.
    fn statistics(&self, weights: &Weights) -> Statistics {
        let mut statistics = Statistics::default();
        let mut order = self.train.to_vec();
        self.stream("statistics").shuffle(&mut order);
        for (indices, number) in order
            .chunks_exact(self.settings.batch.min(order.len()))
            .zip(0..)
        {
            // Training steps count from 0 and these batches from the maximum down, so none share a
            // sub-stream.
            let images = self.images(indices, u64::MAX - number);
            hrn::logits(
                weights,
                images,
                &mut Normalisation::Collect(&mut statistics),
            );
        }
        statistics
    }

    /// The level, from 0, and the logits of each of `indices`.
    fn judge(&self, trained: &Trained, indices: &[usize]) -> Vec<LevelAndLogits> {
        let levels = indices.iter().map(|&index| self.level(index));
        levels.zip(self.logits(trained, indices)).collect()
    }

    fn logits(&self, trained: &Trained, indices: &[usize]) -> Vec<Vec<f32>> {
        let frames = indices
            .iter()
            .map(|&index| &self.dataset.samples[index].frame);
        trained.logits(frames, self.scale, self.device)
    }

    /// The level of a labelled sample, from 0.
    fn level(&self, index: usize) -> usize {
        usize::from(self.dataset.samples[index].level) - 1
    }
}
