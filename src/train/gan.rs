//! Generator and discriminator against each other: one loop for USTGAN, the STGANs, SGAN and
//! IGAN.
//!
//! In: real frames, the game that is played (see [`losses`]) and the weights both start from.
//! Out: both sides' weights. USTGAN and an STGAN differ in their frames and starting weights
//! alone; SGAN and IGAN also see labelled frames. Written to the run's directory on the way:
//! metrics, checkpoints and pictures of what fixed noise becomes.

use std::time::Instant;

use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};

use super::checkpoint::{Checkpoint, Origin, Progress};
use super::dataset::Dataset;
use super::fit::{progress_bar, report};
use super::generator;
use super::history::{Adversarial, Row};
use super::hrn;
use super::learner::Learner;
use super::losses::{self, Game, Judged};
use super::network::{self, Normalisation, Weights, numbers};
use super::optimiser;
use super::run::Run;
use super::settings::{SettingsError, check, check_loop};
use crate::frame::Frame;
use crate::random::Stream;

mod samples;
#[cfg(test)]
mod tests;

/// How both sides learn; the defaults are the paper's ("Training of STGAN and USTGAN").
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Real samples a step. The last batch of an epoch may be smaller.
    pub batch: usize,
    /// Generated samples of each component a step.
    pub samples_a_component: usize,
    /// Passes over the real samples: what the paper calls iterations. Counted in steps, its 500
    /// would be six passes over the unlabelled samples; DeLiGAN's code calls an epoch so.
    pub epochs: u32,
    /// Lambda of Eq. (7), on a mean.
    pub sigma_penalty: f64,
    /// Decay a step of the running average of the discriminator's weights that is kept at the
    /// end; 0: the weights themselves.
    pub averaging: f64,
    /// A checkpoint is written after every so many epochs, and after the last.
    pub checkpoint_every_epochs: u32,
    /// A picture is drawn, and generated samples are measured, after every so many epochs and
    /// after the last.
    pub picture_every_epochs: u32,
    /// Of both sides.
    pub optimiser: optimiser::Settings,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            batch: 100,
            samples_a_component: 2,
            epochs: 500,
            sigma_penalty: 0.1,
            averaging: 0.0,
            checkpoint_every_epochs: 5,
            picture_every_epochs: 25,
            optimiser: optimiser::Settings {
                rule: optimiser::Rule::Adam,
                // The paper gives no betas; DeLiGAN's code has 0.5.
                beta1: 0.5,
                ..optimiser::Settings::default()
            },
        }
    }
}

impl Settings {
    /// Refuses what lies outside its range; `table` is where these settings stand.
    pub(super) fn check(&self, table: &str) -> Result<(), SettingsError> {
        check_loop(
            table,
            self.batch,
            self.epochs,
            self.averaging,
            self.checkpoint_every_epochs,
        )?;
        let samples = self.samples_a_component;
        let key = "samples_a_component";
        check(table, key, samples as f64, samples > 0, "1 or more")?;
        let (key, penalty) = ("sigma_penalty", self.sigma_penalty);
        check(table, key, penalty, penalty >= 0.0, "0 or more")?;
        let (key, every) = ("picture_every_epochs", self.picture_every_epochs);
        check(table, key, every, every > 0, "1 or more")?;
        self.optimiser.check(table)
    }
}

/// Both sides.
#[derive(Debug, Clone)]
pub struct Gan {
    /// Of the generator and its mixture.
    pub generator: Weights,
    /// Of trunk and head.
    pub discriminator: Weights,
}

/// Both sides before training; the head is that of the game.
pub fn initial(game: Game, levels: usize, seed: u64, device: &Device) -> Gan {
    let stream = Stream::new(seed, "discriminator weights");
    let mut discriminator = Weights::default();
    network::add_trunk(&mut discriminator, &stream, device);
    network::add_head(&mut discriminator, game.outputs(levels), &stream, device);
    Gan {
        generator: generator::initial(seed, device),
        discriminator,
    }
}

/// What is to be learnt, and from what.
#[derive(Debug)]
pub struct Task<'a> {
    /// Name of the stage: of its checkpoints, pictures and rows in `metrics.csv`.
    pub stage: &'static str,
    /// What the discriminator tells apart.
    pub game: Game,
    /// Where the samples are.
    pub dataset: &'a Dataset,
    /// Samples taken as real, without their levels.
    pub real: &'a [usize],
    /// Samples whose levels the discriminator learns; empty where the game has no levels.
    pub labelled: &'a [usize],
    /// Newtons a taxel that become 1 in the image.
    pub full_scale_n: f64,
    /// How.
    pub settings: &'a Settings,
    /// Of noise and orders.
    pub seed: u64,
    /// Where.
    pub device: &'a Device,
}

/// Trains from `initial` with fresh optimisers, or from the stage's last checkpoint in `run`.
///
/// # Errors
///
/// If the run's directory cannot be read or written.
pub fn fit(task: &Task, initial: Gan, run: &Run) -> anyhow::Result<Gan> {
    let Settings { batch, epochs, .. } = *task.settings;
    let steps = u64::from(epochs) * task.real.len().div_ceil(batch) as u64;
    let origin = task.origin(&initial);
    let mut state = match run.latest(task.stage, &origin, epochs, task.device)? {
        Some(checkpoint) => State::resumed(&checkpoint, task.settings)?,
        None => State::fresh(initial, task.settings),
    };
    let mut metrics = run.metrics(task.stage, state.progress.step)?;
    let mut reference = None;
    let bar = progress_bar(task.stage, steps, state.progress.step);
    let begun = Instant::now();

    while state.progress.epoch < epochs {
        let (mut discriminator_sum, mut generator_sum, mut rate) = (0.0, 0.0, 0.0);
        let order = task.order("order", task.real, state.progress.epoch.into());
        for indices in order.chunks(batch) {
            rate = task.settings.optimiser.rate_at(state.progress.step, steps);
            let losses = state.step(task, indices, rate);
            discriminator_sum += losses.0 * indices.len() as f64;
            generator_sum += losses.1 * indices.len() as f64;
            bar.inc(1);
        }
        state.progress.epoch += 1;
        let Progress { epoch, step, .. } = state.progress;
        let due = |every: u32| epoch == epochs || epoch.is_multiple_of(every);

        let n = task.real.len() as f64;
        let (loss, generator_loss) = (discriminator_sum / n, generator_sum / n);
        let sigma = sigma_range(&state.generator.weights);
        let mut likeness = None;
        if due(task.settings.picture_every_epochs) {
            if reference.is_none() {
                reference = Some(task.reference()?);
            }
            let real = reference.as_ref().expect("set just now");
            likeness = Some(task.likeness(real, &state.generator.weights)?);
            task.picture(&state.generator.weights, epoch, run)?;
        }
        metrics.add(&Row {
            step,
            epoch,
            loss,
            learning_rate: rate,
            accuracy: None,
            validation: None,
            seconds: begun.elapsed().as_secs_f64(),
            adversarial: Some(Adversarial {
                generator_loss,
                sigma,
                likeness,
            }),
        })?;
        let mut message = format!(
            "losses {loss:.3} {generator_loss:.3}, sigma {:.3}",
            sigma[1]
        );
        if let Some(likeness) = likeness {
            let (distance, std) = (likeness.feature_distance, likeness.pixel_std);
            message += &format!(", distance {distance:.3}, pixel std {std:.3}");
        }
        report(&bar, task.stage, epoch, epochs, message);
        if due(task.settings.checkpoint_every_epochs) {
            run.save(task.stage, &state.checkpoint(&origin))?;
        }
    }
    bar.finish_and_clear();
    Ok(Gan {
        discriminator: state.discriminator.evaluated(),
        generator: state.generator.weights,
    })
}

/// All that changes from step to step.
#[derive(Debug)]
struct State {
    progress: Progress,
    generator: Learner,
    discriminator: Learner,
}

/// Prefixes of the two sides' lists in a checkpoint.
const SIDES: [&str; 2] = ["generator ", "discriminator "];

impl State {
    fn fresh(initial: Gan, settings: &Settings) -> Self {
        let Settings {
            optimiser,
            averaging,
            ..
        } = *settings;
        Self {
            progress: Progress::default(),
            generator: Learner::fresh(initial.generator, optimiser, 0.0),
            discriminator: Learner::fresh(initial.discriminator, optimiser, averaging),
        }
    }

    fn resumed(checkpoint: &Checkpoint, settings: &Settings) -> anyhow::Result<Self> {
        let resumed =
            |side, averaging| Learner::resumed(checkpoint, side, settings.optimiser, averaging);
        Ok(Self {
            progress: checkpoint.progress,
            generator: resumed(SIDES[0], 0.0)?,
            discriminator: resumed(SIDES[1], settings.averaging)?,
        })
    }

    fn checkpoint(&self, origin: &str) -> Checkpoint {
        let mut lists = self.generator.lists(SIDES[0]);
        lists.extend(self.discriminator.lists(SIDES[1]));
        Checkpoint {
            origin: origin.to_owned(),
            progress: self.progress,
            lists,
        }
    }

    /// [`step`] on the real samples `indices`; gives the losses of discriminator and generator.
    fn step(&mut self, task: &Task, indices: &[usize], rate: f64) -> (f64, f64) {
        let number = self.progress.step;
        let batch = task.batch(indices, number);
        let mut stream = task.stream("noise").child(number);
        let samples = task.settings.samples_a_component;
        let eta = generator::noise(samples, &mut stream, task.device);
        self.progress.step += 1;
        let rules = (task.game, task.settings.sigma_penalty, rate);
        step(
            &mut self.generator,
            &mut self.discriminator,
            &batch,
            eta,
            rules,
        )
    }
}

/// A step of the discriminator, then one of the generator, by the rules of a game, with a penalty
/// on sigma and a learning rate; gives the losses of both.
pub fn step(
    generator: &mut Learner,
    discriminator: &mut Learner,
    batch: &Batch,
    eta: Tensor<2>,
    (game, sigma_penalty, rate): (Game, f64, f64),
) -> (f64, f64) {
    // The generator does not change while the discriminator takes its step, so both use the
    // same images, which the first takes as constants.
    let tracked_generator = generator.weights.tracked();
    let images = generator::images(&tracked_generator, eta, &mut Normalisation::Batch);

    let tracked = discriminator.weights.tracked();
    let loss = discriminator_loss(game, &tracked, batch, images.clone().inner());
    let mut gradients = loss.backward();
    discriminator.step(&tracked, &mut gradients, rate);

    let sigma = tracked_generator.tensor::<2>("mixture.sigma");
    let judge = &discriminator.weights;
    let of_generator = generator_loss(game, judge, batch, images, sigma, sigma_penalty);
    let mut gradients = of_generator.backward();
    generator.step(&tracked_generator, &mut gradients, rate);
    let number = |loss: &Tensor<1>| f64::from(numbers(loss)[0]);
    (number(&loss), number(&of_generator))
}

/// What the discriminator is shown in a step beside generated images.
#[derive(Debug)]
pub struct Batch {
    /// `[batch, 1, 28, 28]`.
    pub real: Tensor<4>,
    /// Images and targets `[batch, L]`.
    pub labelled: Option<(Tensor<4>, Tensor<2>)>,
}

/// Every batch goes through the discriminator by itself and is normalised by its own statistics:
/// mixed, a batch of real and generated frames would tell the layers what it is made of.
fn judge(discriminator: &Weights, images: Tensor<4>) -> Judged {
    let features = network::trunk(discriminator, images, &mut Normalisation::Batch);
    Judged {
        logits: network::head(discriminator, features.clone()),
        features,
    }
}

fn discriminator_loss(
    game: Game,
    discriminator: &Weights,
    batch: &Batch,
    generated: Tensor<4>,
) -> Tensor<1> {
    let labelled = batch.labelled.as_ref().map(|(images, targets)| {
        let judged = judge(discriminator, images.clone());
        (judged.logits, targets.clone())
    });
    let real = judge(discriminator, batch.real.clone());
    let generated = judge(discriminator, generated);
    losses::discriminator(game, real, generated, labelled)
}

fn generator_loss(
    game: Game,
    discriminator: &Weights,
    batch: &Batch,
    generated: Tensor<4>,
    sigma: Tensor<2>,
    sigma_penalty: f64,
) -> Tensor<1> {
    let generated = judge(discriminator, generated);
    let real = || judge(discriminator, batch.real.clone());
    losses::generator(game, real, generated)
        .add(losses::sigma_penalty(sigma).mul_scalar(sigma_penalty))
}

/// Least, mean and greatest size of the mixture's deviations; their sign means nothing.
fn sigma_range(generator: &Weights) -> [f64; 3] {
    let sizes: Vec<f64> = generator
        .numbers("mixture.sigma")
        .iter()
        .map(|sigma| f64::from(sigma.abs()))
        .collect();
    [
        sizes.iter().copied().fold(f64::INFINITY, f64::min),
        sizes.iter().sum::<f64>() / sizes.len() as f64,
        sizes.iter().copied().fold(0.0, f64::max),
    ]
}

impl Task<'_> {
    fn origin(&self, initial: &Gan) -> String {
        let settings = (self.settings, self.full_scale_n);
        Origin::new(self.stage, &settings, self.seed)
            .samples(self.dataset, self.real)
            .samples(self.dataset, self.labelled)
            .weights(&initial.generator)
            .weights(&initial.discriminator)
            .finish()
    }

    fn stream(&self, name: &str) -> Stream {
        Stream::new(self.seed, &format!("{} {name}", self.stage))
    }

    /// `samples` in the order of pass `pass`.
    fn order(&self, name: &str, samples: &[usize], pass: u64) -> Vec<usize> {
        let mut order = samples.to_vec();
        self.stream(name).child(pass).shuffle(&mut order);
        order
    }

    fn frames(&self, indices: &[usize]) -> Vec<&Frame> {
        let frame = |&index: &usize| &self.dataset.samples[index].frame;
        indices.iter().map(frame).collect()
    }

    /// The images of step `step`. The labelled samples are fewer than the real ones and come
    /// again and again.
    fn batch(&self, real: &[usize], step: u64) -> Batch {
        let images = |indices: &[usize]| {
            hrn::images(
                self.frames(indices).into_iter(),
                self.full_scale_n,
                self.device,
            )
        };
        let batches = self.labelled.len().div_ceil(self.settings.batch) as u64;
        let labelled = (batches > 0).then(|| {
            let order = self.order("labelled order", self.labelled, step / batches);
            let mut parts = order.chunks(self.settings.batch);
            let indices = parts
                .nth((step % batches) as usize)
                .expect("so many there are");
            let levels_of = indices
                .iter()
                .map(|&index| self.dataset.samples[index].level);
            let levels = super::dataset::levels().len();
            (
                images(indices),
                hrn::targets(levels_of, levels, self.device),
            )
        });
        Batch {
            real: images(real),
            labelled,
        }
    }
}
