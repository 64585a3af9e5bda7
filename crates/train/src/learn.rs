//! How networks learn: what each of them is, one loop that takes the steps of all, and the calibration of
//! what was learnt.

pub mod learner;
pub mod hrn;
pub mod gan;
pub mod regression;
pub mod course;
pub mod calibration;

use std::time::{Duration, Instant};

use anyhow::ensure;
use burn::tensor::Device;

use crate::data::presses::Presses;
use crate::data::split::Parts;
use crate::net::graph::Graph;
pub use crate::net::graph::Inputs;
use crate::net::network::Weights;
use crate::progress::{ensure_learning, progress_bar, report};
use crate::run::Run;
use crate::run::checkpoint::Checkpoint;
use crate::run::history::Metrics;
pub use crate::run::history::Taken;
use crate::settings::{Settings, Training};
use hardnessd_core::verdict::{Borders, Distribution, Knowledge, Piece, Shore, argmax};
use hardnessd_simulator::random::Stream;
use learner::Learner;

/// A checkpoint is written at the end of an epoch, if so long has passed since the last one.
const CHECKPOINT_EVERY: Duration = Duration::from_secs(10);
/// The number of epochs between two judgements of the held-out objects.
const VALIDATED_EVERY_EPOCHS: u32 = 5;

/// What a stage of a run learns from, and with what settings.
#[derive(Debug, Clone)]
pub struct Stage<'a> {
    /// The name in checkpoints and in `metrics.csv`.
    pub name: &'static str,
    /// The presses that indices refer to.
    pub presses: &'a Presses,
    /// Which presses are learnt from, and how.
    pub parts: Parts,
    /// The settings of the run.
    pub settings: Settings,
    /// Those of this stage's training.
    pub training: Training,
    /// Seed of everything random.
    pub seed: u64,
    /// The device that computes.
    pub device: Device,
}

impl Stage<'_> {
    /// The stream of random numbers of this name.
    pub fn stream(&self, name: &str) -> Stream {
        Stream::new(self.seed, &format!("{} {name}", self.name))
    }

    /// The number of hardness levels.
    pub fn levels(&self) -> usize {
        self.presses.levels().len()
    }
}

/// What learns. A GAN has two sides, everything else one.
pub trait Learning {
    /// The stage.
    fn stage(&self) -> &Stage<'_>;

    /// The sides before the first step.
    fn sides(&self) -> Vec<Learner>;

    /// What an epoch passes over, in an order that is drawn anew for each.
    fn samples(&self) -> Vec<usize> {
        self.stage().parts.train.clone()
    }

    /// Takes a step of each side on these samples, at this learning rate. `step` counts from 0.
    fn step(&self, sides: &mut [Learner], samples: &[usize], step: u64, rate: f64) -> Taken;

    /// The questions that presses of held-out objects ask where so much is known of their sensors.
    /// `None` if it never is.
    fn questions(&self, knowledge: Knowledge, _stream: &mut Stream) -> Option<Vec<Question>> {
        let held_out = &self.stage().parts.held_out;
        (knowledge == Knowledge::None).then(|| vec![Question::alone(held_out)])
    }

    /// What the network says of each press of the questions, one question after the other: logits, before
    /// temperature. With a stream, presses are varied as in training.
    fn judge(
        &self,
        weights: &[Weights],
        questions: &[Question],
        vary: Option<&mut Stream>,
    ) -> Vec<Vec<f32>>;

    /// What the logits are of.
    fn outputs(&self) -> Outputs {
        Outputs::Levels
    }

    /// The graph of the exported file, up to the logits.
    fn graph(&self, weights: &[Weights]) -> Graph;
}

/// Presses of one sensor, and presses that serve as its references, as indices.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Question {
    /// The presses to judge.
    pub presses: Vec<usize>,
    /// The references, each with what is known of its piece.
    pub references: Vec<(usize, Piece)>,
}

/// The share of rows of logits or probabilities whose greatest number is at the level, from 1.
fn share_right<'a>(
    levels: impl ExactSizeIterator<Item = u8>,
    rows: impl Iterator<Item = &'a [f32]>,
) -> f64 {
    let count = levels.len() as f64;
    let is_right = |(level, row): &(u8, &[f32])| argmax(row).0 + 1 == usize::from(*level);
    levels.zip(rows).filter(is_right).count() as f64 / count
}

impl Question {
    /// Presses without references.
    pub fn alone(presses: &[usize]) -> Self {
        Self {
            presses: presses.to_vec(),
            references: Vec::new(),
        }
    }
}

/// What logits are of.
#[derive(Debug, Clone, PartialEq)]
pub enum Outputs {
    /// The levels.
    Levels,
    /// Equal parts of the scale of Shore hardness.
    Bins {
        /// What is added to the logits after temperature.
        lifts: Vec<f32>,
        /// The levels' parts of the scale.
        borders: Borders,
    },
}

impl Outputs {
    /// The distribution over the scale of Shore hardness, where the logits are of it.
    fn distribution(&self, logits: &[f32], temperature: f32) -> Option<(Distribution, &Borders)> {
        let Self::Bins { lifts, borders } = self else {
            return None;
        };
        let lifted = logits.iter().zip(lifts);
        let lifted: Vec<f32> = lifted.map(|(x, lift)| x / temperature + lift).collect();
        Some((Distribution::of(&lifted), borders))
    }

    /// The probabilities of the levels.
    pub fn probabilities(&self, logits: &[f32], temperature: f32) -> Vec<f32> {
        if let Some((distribution, borders)) = self.distribution(logits, temperature) {
            return distribution.levels(borders);
        }
        let (_, most) = argmax(logits);
        let powers = logits.iter().map(|x| ((x - most) / temperature).exp());
        let powers: Vec<f32> = powers.collect();
        let sum: f32 = powers.iter().sum();
        powers.into_iter().map(|power| power / sum).collect()
    }

    /// The share of the distribution below a Shore hardness, where the logits are of it.
    pub fn below(&self, logits: &[f32], temperature: f32, shore: f32) -> Option<f32> {
        let (distribution, _) = self.distribution(logits, temperature)?;
        Some(distribution.below(shore))
    }

    /// The Shore hardness, where the logits are of it, with an interval that leaves out the share `tail`
    /// on each side.
    pub fn shore(&self, logits: &[f32], temperature: f32, tail: f32) -> Option<Shore> {
        let (distribution, borders) = self.distribution(logits, temperature)?;
        Some(distribution.shore(borders, tail))
    }
}

/// Trains from the beginning, or continues from the stage's last checkpoint in `run`. Returns the weights of
/// each side. An interrupted run resumes with bit-identical results. Without a run, nothing is written.
///
/// # Errors
///
/// Fails if the run's directory cannot be read or written, its checkpoint is of another run, or a loss or
/// a weight is no longer finite.
pub fn run(learning: &dyn Learning, run: Option<&Run>) -> anyhow::Result<Vec<Weights>> {
    let stage = learning.stage();
    let (name, epochs) = (stage.name, stage.training.epochs);
    let (mut sides, batch) = (learning.sides(), stage.training.batch);
    let mut done = match run {
        Some(run) => begin(name, &mut sides, run)?,
        None => Checkpoint::default(),
    };
    // A GAN names no levels.
    let is_judged = sides.len() == 1 && !stage.parts.held_out.is_empty();
    let samples = learning.samples();
    let steps = u64::from(epochs) * samples.len().div_ceil(batch) as u64;
    let open = |run: &Run| Metrics::open(&run.path("metrics.csv"), name, done.step);
    let mut metrics = run.map(open).transpose()?;
    let bar = progress_bar(name, steps, done.step);
    let (begun, seconds_before) = (Instant::now(), done.seconds);
    let mut kept = begun;
    while done.epoch < epochs {
        let mut order = samples.clone();
        { stage.stream("order").child(done.epoch.into()) }.shuffle(&mut order);
        let (mut mean, mut rate) = (Taken::default(), 0.0);
        for samples in order.chunks(batch) {
            rate = stage.training.rate_at(done.step, steps);
            let taken = learning.step(&mut sides, samples, done.step, rate);
            mean.add(&taken, samples.len() as f64 / order.len() as f64);
            done.step += 1;
            bar.inc(1);
        }
        done.epoch += 1;
        for loss in [Some(mean.loss), mean.generator_loss].into_iter().flatten() {
            ensure_learning(name, done.epoch, "loss", loss)?;
        }
        let is_last = done.epoch == epochs;
        let is_validated = is_last || done.epoch.is_multiple_of(VALIDATED_EVERY_EPOCHS);
        let validation = (is_validated && is_judged).then(|| {
            let weights: Vec<Weights> = sides.iter().map(Learner::evaluated).collect();
            validated(learning, &weights)
        });
        if let Some((loss, _)) = validation {
            ensure_learning(name, done.epoch, "validation loss", loss)?;
        }
        done.seconds = seconds_before + begun.elapsed().as_secs_f64();
        if let Some(metrics) = &mut metrics {
            metrics.add(&done, rate, &mean, validation)?;
        }
        report(&bar, name, done.epoch, epochs, message(&mean, validation));
        if is_last || kept.elapsed() > CHECKPOINT_EVERY {
            kept = Instant::now();
            done.numbers = sides.iter().flat_map(Learner::numbers).collect();
            // The loss does not show the last step yet, because a step's loss is that of the weights before it.
            for &number in &done.numbers {
                ensure_learning(name, done.epoch, "weights", number.into())?;
            }
            if let Some(run) = run {
                done.write(&run.checkpoint(name))?;
            }
        }
    }
    bar.finish_and_clear();
    Ok(sides.iter().map(Learner::evaluated).collect())
}

/// The beginning of a stage, or its last checkpoint, whose numbers the sides then have.
fn begin(name: &str, sides: &mut [Learner], run: &Run) -> anyhow::Result<Checkpoint> {
    let numbers = sides.iter().flat_map(Learner::numbers).collect();
    let first = Checkpoint::first(&run.settings()?, numbers);
    let path = run.checkpoint(name);
    let Some(kept) = Checkpoint::read(&path)? else {
        return Ok(first);
    };
    ensure!(
        kept.origin == first.origin && kept.numbers.len() == first.numbers.len(),
        "{}: the checkpoint is of another run, or of another version of the program: choose another --out",
        path.display()
    );
    let mut numbers = kept.numbers.iter().copied();
    for side in sides {
        side.resume(kept.step, &mut numbers);
    }
    Ok(kept)
}

/// Mean loss and accuracy on presses of held-out objects, as they are and without references.
fn validated(learning: &dyn Learning, weights: &[Weights]) -> (f64, f64) {
    let Stage { presses, parts, .. } = learning.stage();
    let outputs = learning.outputs();
    let (mut loss, mut right) = (0.0, 0.0);
    let rows = learning.judge(weights, &[Question::alone(&parts.held_out)], None);
    for (press, row) in presses.of(&parts.held_out).zip(rows) {
        let probabilities = outputs.probabilities(&row, 1.0);
        let level = usize::from(press.level) - 1;
        loss -= f64::from(probabilities[level].max(f32::MIN_POSITIVE)).ln();
        right += f64::from(u8::from(argmax(&probabilities).0 == level));
    }
    let count = parts.held_out.len() as f64;
    (loss / count, right / count)
}

fn message(mean: &Taken, validation: Option<(f64, f64)>) -> String {
    let mut message = format!("loss {:.4}", mean.loss);
    if let Some(share) = mean.accuracy {
        message += &format!(", accuracy {:.1} %", 100.0 * share);
    }
    if let Some((loss, share)) = validation {
        let percent = 100.0 * share;
        message += &format!("; held out: loss {loss:.4}, accuracy {percent:.1} %");
    }
    if let Some(loss) = mean.generator_loss {
        message += &format!(", generator {loss:.3}");
    }
    message
}
