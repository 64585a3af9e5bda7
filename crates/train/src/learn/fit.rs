//! The supervised training loop: Eq. (9) minimised over labelled frames.
//!
//! In: a data set, which of its samples to learn from and which to validate on, and initial
//! weights. Out: weights, the statistics of their batch normalisation, and a temperature. The run's
//! directory receives metrics and checkpoints on the way. An interrupted run resumes from its
//! checkpoint with bit-identical results. The test split never enters here.

use std::time::Instant;

use burn::tensor::{Device, Tensor};

use crate::data::augment;
use crate::data::dataset::{self, Dataset};
use crate::learn::learner::Learner;
use crate::learn::temperature::{self, LevelAndLogits};
use crate::net::hrn;
use crate::net::image::PixelScale;
use crate::net::network::{Normalisation, Statistics, Weights, numbers};
use crate::run::Run;
use crate::run::checkpoint::{Checkpoint, Origin, Progress};
use crate::run::history::Row;
use crate::run::progress::{ensure_finite, ensure_finite_weights, progress_bar, report};
use crate::settings::{Keep, Training, Validation};
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
    let Training { batch, epochs, .. } = *task.settings;
    let (validation_samples, validation_settings) = task.validation;
    let steps_an_epoch = task.train.len().div_ceil(batch) as u64;
    let steps = u64::from(epochs) * steps_an_epoch;
    let origin = task.origin(&initial);
    let fresh = State::fresh(initial, task.settings);
    let lists = fresh.learner.lists("");
    let mut state = match run.latest(task.stage, &origin, epochs, &lists, task.device)? {
        Some(checkpoint) => {
            // Generated frames have no source file, and may differ in their last bits on another
            // device or with more threads. The run then continues from its weights all the same.
            if !task.dataset.sources.is_empty() {
                run.check_origin(task.stage, &checkpoint, &origin)?;
            }
            State::resumed(&checkpoint, task.settings)?
        }
        None => fresh,
    };
    let mut metrics = run.metrics.open(task.stage, state.progress.step)?;
    let bar = progress_bar(task.stage, steps, state.progress.step);
    let begun = Instant::now();

    while state.progress.epoch < epochs {
        let (mut loss_sum, mut right, mut rate) = (0.0, 0, 0.0);
        for indices in task.epoch_order(state.progress.epoch).chunks(batch) {
            rate = task.settings.optimiser.rate_at(state.progress.step, steps);
            let learnt = state.step(task, indices, rate);
            loss_sum += learnt.0 * indices.len() as f64;
            right += learnt.1;
            bar.inc(1);
        }
        state.progress.epoch += 1;
        let Progress { epoch, step, .. } = state.progress;
        let last = epoch == epochs;
        let due = |every: u32| last || epoch.is_multiple_of(every);

        let loss = loss_sum / task.train.len() as f64;
        ensure_finite(task.stage, epoch, "loss", loss)?;
        ensure_finite_weights(task.stage, epoch, &state.learner.weights)?;
        let mut validation = None;
        if !validation_samples.is_empty() && due(validation_settings.every_epochs) {
            let judged = state.validate(task);
            ensure_finite(task.stage, epoch, "validation loss", judged.0)?;
            validation = Some(judged);
        }
        let seconds = begun.elapsed().as_secs_f64();
        metrics.add(&Row {
            step,
            epoch,
            loss,
            learning_rate: rate,
            accuracy: Some(right as f64 / task.train.len() as f64),
            validation,
            seconds,
            adversarial: None,
        })?;
        let mut message = format!("loss {loss:.4}");
        if let Some((loss, accuracy)) = validation {
            let accuracy = accuracy * 100.0;
            message += &format!(", validation loss {loss:.4}, accuracy {accuracy:.1} %");
        }
        report(&bar, task.stage, epoch, epochs, message);
        if due(task.settings.checkpoint_every_epochs) {
            run.checkpoints
                .save(task.stage, &state.checkpoint(&origin))?;
        }
    }
    bar.finish_and_clear();

    let weights = match validation_settings.keep {
        Keep::Best => state.best.unwrap_or_else(|| state.learner.evaluated()),
        Keep::Last => state.learner.evaluated(),
    };
    let mut trained = task.finished(weights, epochs)?;
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

/// Everything that changes from step to step.
#[derive(Debug)]
struct State {
    progress: Progress,
    learner: Learner,
    /// The weights of the least validation loss, if the settings keep them.
    best: Option<Weights>,
}

impl State {
    fn fresh(weights: Weights, settings: &Training) -> Self {
        Self {
            progress: Progress::default(),
            learner: Learner::fresh(weights, settings.optimiser, settings.averaging),
            best: None,
        }
    }

    fn resumed(checkpoint: &Checkpoint, settings: &Training) -> anyhow::Result<Self> {
        let Training {
            optimiser,
            averaging,
            ..
        } = *settings;
        Ok(Self {
            progress: checkpoint.progress,
            learner: Learner::resumed(
                checkpoint,
                "",
                checkpoint.progress.step,
                optimiser,
                averaging,
            )?,
            best: checkpoint.list("best").ok().cloned(),
        })
    }

    fn checkpoint(&self, origin: &str) -> Checkpoint {
        let mut lists = self.learner.lists("");
        lists.extend(
            self.best
                .iter()
                .map(|list| ("best".to_owned(), list.clone())),
        );
        Checkpoint {
            origin: origin.to_owned(),
            progress: self.progress,
            lists,
        }
    }

    /// Takes a step on the samples `indices`. Returns the batch's mean loss, and how many of the
    /// samples were judged correctly before the step.
    fn step(&mut self, task: &Task, indices: &[usize], rate: f64) -> (f64, usize) {
        let number = self.progress.step;
        let (images, targets) = (task.images(indices, number), task.targets(indices));
        let (loss, judged) = step(&mut self.learner, images, targets, rate);
        self.progress.step += 1;
        let right = indices
            .iter()
            .zip(judged.chunks(levels()))
            .filter(|(index, logits)| argmax(logits).0 == task.level(**index))
            .count();
        (loss, right)
    }

    /// Computes loss and accuracy on the validation samples, and keeps the weights if they are the
    /// best.
    fn validate(&mut self, task: &Task) -> (f64, f64) {
        let trained = task.with_statistics(self.learner.evaluated());
        let (samples, settings) = task.validation;
        let judged = task.judge(&trained, samples);
        let loss = temperature::mean_loss(&judged, 1.0);
        let right = judged
            .iter()
            .filter(|(level, logits)| argmax(logits).0 == *level)
            .count();
        let better = self.progress.best_loss.is_none_or(|best| loss < best);
        if settings.keep == Keep::Best && better {
            self.progress.best_loss = Some(loss);
            self.best = Some(trained.weights);
        }
        (loss, right as f64 / judged.len() as f64)
    }
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

    /// The training samples in the order of epoch `epoch`.
    fn epoch_order(&self, epoch: u32) -> Vec<usize> {
        let mut order = self.train.to_vec();
        self.stream("order").child(epoch.into()).shuffle(&mut order);
        order
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
