//! The supervised training loop: Eq. (9) minimised over labelled frames.
//!
//! In: a data set, which of its samples to learn from and which to validate on, and initial
//! weights. Out: weights, the statistics of their batch normalisation, and a temperature. Written
//! to the run's directory on the way: metrics and checkpoints, from which a killed run goes on bit
//! for bit. The test split never enters here.

use std::time::Instant;

use burn::tensor::{Device, Tensor, activation};
use indicatif::{ProgressBar, ProgressStyle};

use super::augment;
use super::checkpoint::{Checkpoint, Progress};
use super::dataset::Dataset;
use super::hrn;
use super::network::{Normalisation, Statistics, Weight, Weights, numbers};
use super::optimiser::{Optimiser, Rule};
use super::run::{Row, Run};
use super::settings::{Keep, Settings};
use crate::frame::Frame;
use crate::random::Stream;

/// Samples a pass without gradients.
const JUDGED_AT_ONCE: usize = 250;

/// What is to be learnt, and from what.
#[derive(Debug)]
pub struct Task<'a> {
    /// Name of the stage: of its checkpoints and of its rows in `metrics.csv`.
    pub stage: &'static str,
    /// Where the samples are.
    pub dataset: &'a Dataset,
    /// Labelled samples to learn from.
    pub train: &'a [usize],
    /// Samples of held-out training objects; may be empty.
    pub validation: &'a [usize],
    /// Levels there are.
    pub levels: usize,
    /// How.
    pub settings: &'a Settings,
    /// Of the order of the samples and their augmentation.
    pub seed: u64,
    /// Where.
    pub device: &'a Device,
}

/// A trained recogniser.
#[derive(Debug)]
pub struct Trained {
    /// Of trunk and head.
    pub weights: Weights,
    /// Mean and variance of each normalised layer over the training samples.
    pub statistics: Statistics,
    /// What the logits are divided by; 1 without validation objects.
    pub temperature: f32,
}

impl Trained {
    /// Logits of `frames`, a row each, before temperature.
    pub fn logits<'a>(
        &self,
        frames: impl Iterator<Item = &'a Frame>,
        full_scale_n: f64,
        device: &Device,
    ) -> Vec<Vec<f32>> {
        let frames: Vec<&Frame> = frames.collect();
        let mut rows = Vec::with_capacity(frames.len());
        for part in frames.chunks(JUDGED_AT_ONCE) {
            let images = hrn::images(part.iter().copied(), full_scale_n, device);
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
/// If the run's directory cannot be read or written.
pub fn fit(task: &Task, initial: Weights, run: &Run) -> anyhow::Result<Trained> {
    let Settings { batch, epochs, .. } = *task.settings;
    let steps_an_epoch = task.train.len().div_ceil(batch) as u64;
    let steps = u64::from(epochs) * steps_an_epoch;
    let mut state = match run.latest(task.stage, task.device)? {
        Some(checkpoint) => State::resumed(&checkpoint, task.settings)?,
        None => State::fresh(initial, task.settings),
    };
    let mut metrics = run.metrics(task.stage, state.progress.step)?;
    let bar = progress_bar(task.stage, steps, state.progress.step);
    let begun = Instant::now();

    while state.progress.epoch < epochs {
        let (mut loss_sum, mut rate) = (0.0, 0.0);
        for indices in task.epoch_order(state.progress.epoch).chunks(batch) {
            rate = task.settings.optimiser.rate_at(state.progress.step, steps);
            loss_sum += state.step(task, indices, rate) * indices.len() as f64;
            bar.inc(1);
        }
        state.progress.epoch += 1;
        let Progress { epoch, step, .. } = state.progress;
        let last = epoch == epochs;
        let due = |every: u32| last || epoch.is_multiple_of(every);

        let loss = loss_sum / task.train.len() as f64;
        let mut validation = None;
        if !task.validation.is_empty() && due(task.settings.validation.every_epochs) {
            validation = Some(state.validate(task));
        }
        let seconds = begun.elapsed().as_secs_f64();
        metrics.add(&Row {
            step,
            epoch,
            loss,
            learning_rate: rate,
            validation,
            seconds,
        })?;
        report(&bar, task.stage, epoch, epochs, loss, validation);
        if due(task.settings.checkpoint_every_epochs) {
            run.save(task.stage, &state.checkpoint())?;
        }
    }
    bar.finish_and_clear();

    let weights = match task.settings.validation.keep {
        Keep::Best => state.best.unwrap_or(state.weights),
        Keep::Last => state.evaluated(task.settings),
    };
    let mut trained = Trained {
        statistics: task.statistics(&weights),
        weights,
        temperature: 1.0,
    };
    if !task.validation.is_empty() {
        trained.temperature = temperature(&task.judge(&trained, task.validation));
    }
    Ok(trained)
}

/// All that changes from step to step.
#[derive(Debug)]
struct State {
    progress: Progress,
    weights: Weights,
    optimiser: Optimiser,
    /// Sum of decayed weights, if they are averaged.
    average: Option<Weights>,
    /// Of the least validation loss, if those are kept.
    best: Option<Weights>,
}

impl State {
    fn fresh(weights: Weights, settings: &Settings) -> Self {
        let zeros = |weight: &Weight| Weight {
            values: weight.values.zeros_like(),
            ..weight.clone()
        };
        let average = Weights {
            entries: weights.entries.iter().map(zeros).collect(),
        };
        Self {
            progress: Progress {
                epoch: 0,
                step: 0,
                best_loss: None,
            },
            optimiser: Optimiser::new(settings.optimiser, &weights),
            average: (settings.averaging > 0.0).then_some(average),
            best: None,
            weights,
        }
    }

    fn resumed(checkpoint: &Checkpoint, settings: &Settings) -> anyhow::Result<Self> {
        let moments = match settings.optimiser.rule {
            Rule::Sgd => Vec::new(),
            Rule::Adam => {
                let (means, squares) = (checkpoint.list("mean")?, checkpoint.list("square")?);
                let pair = |(mean, square): (&Weight, &Weight)| {
                    (mean.values.clone(), square.values.clone())
                };
                means
                    .entries
                    .iter()
                    .zip(&squares.entries)
                    .map(pair)
                    .collect()
            }
        };
        let step = checkpoint.progress.step;
        Ok(Self {
            progress: checkpoint.progress,
            weights: checkpoint.list("weights")?.clone(),
            optimiser: Optimiser::resumed(settings.optimiser, step, moments),
            average: checkpoint.list("average").ok().cloned(),
            best: checkpoint.list("best").ok().cloned(),
        })
    }

    fn checkpoint(&self) -> Checkpoint {
        let mut lists = vec![("weights".to_owned(), self.weights.clone())];
        let moments = self.optimiser.moments();
        let like_weights = |values: Vec<Tensor<1>>| {
            let with = |(weight, values): (&Weight, Tensor<1>)| Weight {
                values,
                ..weight.clone()
            };
            Weights {
                entries: self.weights.entries.iter().zip(values).map(with).collect(),
            }
        };
        if !moments.is_empty() {
            let means = moments.iter().map(|(mean, _)| mean.clone()).collect();
            let squares = moments.iter().map(|(_, square)| square.clone()).collect();
            lists.push(("mean".to_owned(), like_weights(means)));
            lists.push(("square".to_owned(), like_weights(squares)));
        }
        lists.extend(
            self.average
                .iter()
                .map(|list| ("average".to_owned(), list.clone())),
        );
        lists.extend(
            self.best
                .iter()
                .map(|list| ("best".to_owned(), list.clone())),
        );
        Checkpoint {
            progress: self.progress,
            lists,
        }
    }

    /// One step on the samples `indices`; gives the batch's mean loss.
    fn step(&mut self, task: &Task, indices: &[usize], rate: f64) -> f64 {
        let (images, targets) = task.batch(indices, self.progress.step);
        let tracked = self.weights.tracked();
        let logits = hrn::logits(&tracked, images, &mut Normalisation::Batch);
        let loss = hrn::cross_entropy(logits, targets);
        let mut gradients = loss.backward();
        self.optimiser
            .step(&mut self.weights, &tracked, &mut gradients, rate);
        if let Some(average) = &mut self.average {
            let decay = task.settings.averaging;
            for (sum, weight) in average.entries.iter_mut().zip(&self.weights.entries) {
                let new = weight.values.clone().mul_scalar(1.0 - decay);
                sum.values = sum.values.clone().mul_scalar(decay).add(new);
            }
        }
        self.progress.step += 1;
        f64::from(numbers(&loss)[0])
    }

    /// The weights to judge with: averaged ones if they are averaged. The average began at 0,
    /// which is divided out.
    fn evaluated(&self, settings: &Settings) -> Weights {
        let Some(average) = &self.average else {
            return self.weights.clone();
        };
        let total = 1.0 - settings.averaging.powf(self.progress.step as f64);
        let divided = |weight: &Weight| Weight {
            values: weight.values.clone().div_scalar(total),
            ..weight.clone()
        };
        Weights {
            entries: average.entries.iter().map(divided).collect(),
        }
    }

    /// Loss and accuracy on the validation samples; keeps the weights if they are the best.
    fn validate(&mut self, task: &Task) -> (f64, f64) {
        let weights = self.evaluated(task.settings);
        let trained = Trained {
            statistics: task.statistics(&weights),
            weights,
            temperature: 1.0,
        };
        let judged = task.judge(&trained, task.validation);
        let loss = mean_loss(&judged, 1.0);
        let right = judged
            .iter()
            .filter(|(level, logits)| largest(logits) == *level)
            .count();
        let better = self.progress.best_loss.is_none_or(|best| loss < best);
        if task.settings.validation.keep == Keep::Best && better {
            self.progress.best_loss = Some(loss);
            self.best = Some(trained.weights);
        }
        (loss, right as f64 / judged.len() as f64)
    }
}

impl Task<'_> {
    /// The training samples in the order of epoch `epoch`.
    fn epoch_order(&self, epoch: u32) -> Vec<usize> {
        let mut order = self.train.to_vec();
        self.stream("order").child(epoch.into()).shuffle(&mut order);
        order
    }

    fn stream(&self, name: &str) -> Stream {
        Stream::new(self.seed, &format!("{} {name}", self.stage))
    }

    /// Images and targets of one batch, augmented for step `step`.
    fn batch(&self, indices: &[usize], step: u64) -> (Tensor<4>, Tensor<2>) {
        let mut stream = self.stream("augmentation").child(step);
        let frames: Vec<Frame> = indices
            .iter()
            .map(|&index| {
                let frame = &self.dataset.samples[index].frame;
                augment::vary(frame, self.settings.augmentation, &mut stream)
            })
            .collect();
        let levels_of = indices
            .iter()
            .map(|&index| self.dataset.samples[index].level);
        let images = hrn::images(frames.iter(), self.settings.full_scale_n, self.device);
        (images, hrn::targets(levels_of, self.levels, self.device))
    }

    /// Statistics of the normalised layers over all training samples, augmented as in training,
    /// in batches of the same size.
    fn statistics(&self, weights: &Weights) -> Statistics {
        let mut statistics = Statistics::default();
        let mut order = self.train.to_vec();
        self.stream("statistics").shuffle(&mut order);
        for (indices, number) in order
            .chunks_exact(self.settings.batch.min(order.len()))
            .zip(0..)
        {
            // Steps count from 0, so no step shares a batch's sub-stream counted from the end.
            let (images, _) = self.batch(indices, u64::MAX - number);
            hrn::logits(
                weights,
                images,
                &mut Normalisation::Collect(&mut statistics),
            );
        }
        statistics
    }

    /// Level, from 0, and logits of each of `indices`.
    fn judge(&self, trained: &Trained, indices: &[usize]) -> Vec<(usize, Vec<f32>)> {
        let frames = indices
            .iter()
            .map(|&index| &self.dataset.samples[index].frame);
        let rows = trained.logits(frames, self.settings.full_scale_n, self.device);
        let level = |&index: &usize| usize::from(self.dataset.samples[index].level) - 1;
        indices.iter().map(level).zip(rows).collect()
    }
}

fn largest(logits: &[f32]) -> usize {
    (1..logits.len()).fold(0, |best, index| {
        if logits[index] > logits[best] {
            index
        } else {
            best
        }
    })
}

/// Mean cross-entropy of logits over `temperature`.
fn mean_loss(judged: &[(usize, Vec<f32>)], temperature: f64) -> f64 {
    let loss = |(level, logits): &(usize, Vec<f32>)| {
        let scaled: Vec<f64> = logits.iter().map(|&l| f64::from(l) / temperature).collect();
        let top = scaled.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        top + scaled.iter().map(|l| (l - top).exp()).sum::<f64>().ln() - scaled[*level]
    };
    judged.iter().map(loss).sum::<f64>() / judged.len() as f64
}

/// The temperature of least loss, between 1/8 and 8: the loss is convex in 1/T, so shrinking a
/// bracket around the least finds it.
fn temperature(judged: &[(usize, Vec<f32>)]) -> f32 {
    let (mut low, mut high) = (0.125_f64, 8.0_f64);
    for _ in 0..60 {
        let (left, right) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
        if mean_loss(judged, 1.0 / left) < mean_loss(judged, 1.0 / right) {
            high = right;
        } else {
            low = left;
        }
    }
    (2.0 / (low + high)) as f32
}

/// Probabilities, a row each, of logits over `temperature`.
pub fn probabilities(logits: &[Vec<f32>], temperature: f32, device: &Device) -> Vec<Vec<f32>> {
    let one = |row: &Vec<f32>| {
        let scaled = Tensor::<1>::from_floats(row.as_slice(), device).div_scalar(temperature);
        numbers(&activation::softmax(scaled, 0))
    };
    logits.iter().map(one).collect()
}

fn progress_bar(stage: &str, steps: u64, done: u64) -> ProgressBar {
    let template = "{prefix} {bar:30} {pos}/{len} steps, {per_sec}, {eta} left {msg}";
    let style = ProgressStyle::with_template(template).expect("the template is right");
    // indicatif draws on a terminal only; elsewhere `report` prints lines.
    let bar = ProgressBar::new(steps)
        .with_style(style)
        .with_prefix(stage.to_owned());
    bar.set_position(done);
    bar.reset_eta();
    bar
}

/// The state of a stage after an epoch: beside the bar on a terminal, a line elsewhere.
fn report(
    bar: &ProgressBar,
    stage: &str,
    epoch: u32,
    epochs: u32,
    loss: f64,
    validation: Option<(f64, f64)>,
) {
    let validation = validation.map_or_else(String::new, |(loss, accuracy)| {
        format!(
            ", validation loss {loss:.4}, accuracy {:.1} %",
            accuracy * 100.0
        )
    });
    let message = format!("loss {loss:.4}{validation}");
    if bar.is_hidden() {
        eprintln!("{stage}: epoch {epoch} of {epochs}: {message}");
    } else {
        bar.set_message(message);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_temperature_undoes_overconfidence() {
        // Logits of two levels that are right in 3 of 4 cases, stated four times too surely.
        let honest = 3.0_f64.ln();
        let judged: Vec<(usize, Vec<f32>)> = (0..8)
            .map(|n| (usize::from(n % 4 == 0), vec![(4.0 * honest) as f32, 0.0]))
            .collect();
        assert!(
            (temperature(&judged) - 4.0).abs() < 1e-3,
            "{}",
            temperature(&judged)
        );
        assert!(mean_loss(&judged, 4.0) < mean_loss(&judged, 1.0));
    }
}
