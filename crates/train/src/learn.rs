//! How networks learn: what each of them is, one loop that takes the steps of all, and the calibration of
//! what was learnt.

pub mod learner;
pub mod hrn;
pub mod gan;
pub mod regression;
pub mod course;
pub mod calibration;

use std::time::Instant;

use burn::tensor::Device;

use crate::data::presses::Timed;
use crate::net::graph::Graph;
pub use crate::net::graph::Inputs;
use crate::net::network::Weights;
use crate::run::Run;
use crate::run::checkpoint::{Checkpoint, Progress};
use crate::run::history::Row;
use crate::run::progress::{ensure_finite, ensure_finite_weights, progress_bar, report};
use crate::settings::OptimiserSettings;
use hardnessd_core::verdict::{Borders, Distribution, Extents, Knowledge, Piece, Shore, argmax};
use hardnessd_simulator::random::Stream;
use learner::Learner;

/// What learns. A GAN has two sides, everything else one.
pub trait Learning {
    /// The name of the stage in its checkpoints and in `metrics.csv`.
    fn stage(&self) -> &'static str;

    /// Where the stage begins, and everything that determines where it ends.
    fn origin(&self) -> Origin<'_>;

    /// Takes a step of each side.
    ///
    /// # Errors
    ///
    /// Fails if the step cannot be computed.
    fn step(&self, sides: &mut [Learner], batch: Batch) -> anyhow::Result<Taken>;

    /// The questions that presses of held-out objects ask where so much is known of their sensors.
    /// `None` if it never is.
    fn questions(
        &self,
        presses: &[usize],
        knowledge: Knowledge,
        _stream: &mut Stream,
    ) -> Option<Vec<Question>> {
        (knowledge == Knowledge::None).then(|| {
            vec![Question {
                presses: presses.to_vec(),
                references: Vec::new(),
            }]
        })
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
    fn outputs(&self) -> Outputs;

    /// The ranges of presses that the network has met, if it judges presses over time.
    fn ranges(&self, _learnt: &[Timed]) -> Extents {
        [None; 5]
    }

    /// The graph of the exported file, up to the logits.
    fn graph(&self, weights: &[Weights]) -> Recogniser;
}

/// Where a stage begins.
#[derive(Debug)]
pub struct Origin<'a> {
    /// A hash of everything that determines the weights. A checkpoint of another origin is refused,
    /// except where the samples are generated.
    pub hash: String,
    /// Whether a GAN generated the samples. They may then differ in their last bits on another
    /// device or with more threads, and the run continues from its weights all the same.
    pub is_generated: bool,
    /// The sides, before their first step.
    pub sides: Vec<Side>,
    /// What an epoch passes over, in an order that is drawn anew for each.
    pub samples: Vec<usize>,
    /// Labelled presses of held-out objects; may be empty.
    pub held_out: &'a [usize],
    /// Samples of a step.
    pub batch: usize,
    /// Passes over the samples.
    pub epochs: u32,
    /// The rule of a step, for all sides.
    pub optimiser: OptimiserSettings,
    /// The number of epochs between two checkpoints.
    pub checkpoint_every_epochs: u32,
    /// The number of epochs between two judgements of the held-out objects.
    pub validated_every_epochs: u32,
    /// Seed of everything random.
    pub seed: u64,
}

/// A network of a stage before its first step.
#[derive(Debug)]
pub struct Side {
    /// The prefix of its lists in a checkpoint.
    pub prefix: &'static str,
    /// Its first weights.
    pub weights: Weights,
    /// The decay of the running average of its weights.
    pub averaging: f64,
}

/// One step's batch.
#[derive(Debug, Clone, Copy)]
pub struct Batch<'a> {
    /// The samples of the batch.
    pub samples: &'a [usize],
    /// The number of the step, from 0.
    pub step: u64,
    /// Learning rate.
    pub rate: f64,
}

/// What a step says of itself.
#[derive(Debug, Clone, Copy, Default)]
pub struct Taken {
    /// The mean loss of the batch.
    pub loss: f64,
    /// The loss of a GAN's generator.
    pub generator_loss: Option<f64>,
    /// How many of the batch's samples were judged rightly before the step.
    pub right: Option<f64>,
}

/// Presses of one sensor, and presses that serve as its references, as indices.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Question {
    /// The presses to judge.
    pub presses: Vec<usize>,
    /// The references, each with what is known of its piece.
    pub references: Vec<(usize, Piece)>,
}

/// A graph from a model's inputs to logits.
#[derive(Debug, Clone)]
pub struct Recogniser {
    /// The nodes.
    pub graph: Graph,
    /// What the graph takes.
    pub inputs: Inputs,
    /// Name of the logits in the graph.
    pub raw: String,
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
    fn distribution(lifts: &[f32], logits: &[f32], temperature: f32) -> Distribution {
        let lifted = logits.iter().zip(lifts);
        let lifted: Vec<f32> = lifted.map(|(x, lift)| x / temperature + lift).collect();
        Distribution::of(&lifted)
    }

    /// The probabilities of the levels.
    pub fn probabilities(&self, logits: &[f32], temperature: f32) -> Vec<f32> {
        match self {
            Self::Levels => {
                let (_, most) = argmax(logits);
                let powers = logits.iter().map(|x| ((x - most) / temperature).exp());
                let powers: Vec<f32> = powers.collect();
                let sum: f32 = powers.iter().sum();
                powers.into_iter().map(|power| power / sum).collect()
            }
            Self::Bins { lifts, borders } => {
                Self::distribution(lifts, logits, temperature).levels(borders)
            }
        }
    }

    /// The share of the distribution below a Shore hardness, where the logits are of it.
    pub fn below(&self, logits: &[f32], temperature: f32, shore: f32) -> Option<f32> {
        match self {
            Self::Levels => None,
            Self::Bins { lifts, .. } => {
                Some(Self::distribution(lifts, logits, temperature).below(shore))
            }
        }
    }

    /// The Shore hardness, where the logits are of it, with an interval that leaves out the share `tail`
    /// on each side.
    pub fn shore(&self, logits: &[f32], temperature: f32, tail: f32) -> Option<Shore> {
        match self {
            Self::Levels => None,
            Self::Bins { lifts, borders } => {
                Some(Self::distribution(lifts, logits, temperature).shore(borders, tail))
            }
        }
    }
}

/// Least, mean and greatest absolute value of the deviations of a generator's mixture, whose sign has
/// no effect.
fn sigma(sides: &[Learner]) -> Option<[f64; 3]> {
    let sigma = sides
        .iter()
        .find_map(|side| side.weights.find("mixture.sigma"))?;
    let sizes: Vec<f64> = sigma.iter().map(|sigma| f64::from(sigma.abs())).collect();
    Some([
        sizes.iter().copied().fold(f64::INFINITY, f64::min),
        sizes.iter().sum::<f64>() / sizes.len() as f64,
        sizes.iter().copied().fold(0.0, f64::max),
    ])
}

/// Trains from the origin, or continues from the stage's last checkpoint in `run`. Returns the weights of
/// each side. An interrupted run resumes with bit-identical results. `level_of` gives the level of a
/// held-out press.
///
/// # Errors
///
/// Fails if the run's directory cannot be read or written, its checkpoint is of another origin, a loss or a
/// weight is no longer finite, or a step fails.
pub fn run(
    learning: &dyn Learning,
    level_of: impl Fn(usize) -> u8,
    run: &Run,
    device: &Device,
) -> anyhow::Result<Vec<Weights>> {
    let (stage, origin) = (learning.stage(), learning.origin());
    let epochs = origin.epochs;
    let (mut progress, mut sides) = begin(stage, &origin, run, device)?;
    let count = origin.samples.len();
    let steps = u64::from(epochs) * count.div_ceil(origin.batch) as u64;
    let mut metrics = run.metrics.open(stage, progress.step)?;
    let bar = progress_bar(stage, steps, progress.step);
    let begun = Instant::now();
    while progress.epoch < epochs {
        let mut order = origin.samples.clone();
        let stream = Stream::new(origin.seed, &format!("{stage} order"));
        { stream.child(progress.epoch.into()) }.shuffle(&mut order);
        let (mut sum, mut rate) = (Taken::default(), 0.0);
        for samples in order.chunks(origin.batch) {
            rate = origin.optimiser.rate_at(progress.step, steps);
            let batch = Batch {
                samples,
                step: progress.step,
                rate,
            };
            let taken = learning.step(&mut sides, batch)?;
            sum.add(&taken, samples.len());
            progress.step += 1;
            bar.inc(1);
        }
        progress.epoch += 1;
        let Progress { epoch, step } = progress;
        let due = |every: u32| epoch == epochs || epoch.is_multiple_of(every);
        let mut row = Row {
            step,
            epoch,
            loss: sum.loss / count as f64,
            learning_rate: rate,
            accuracy: sum.right.map(|right| right / count as f64),
            generator_loss: sum.generator_loss.map(|loss| loss / count as f64),
            sigma: sigma(&sides),
            ..Row::default()
        };
        for loss in [Some(row.loss), row.generator_loss].into_iter().flatten() {
            ensure_finite(stage, epoch, "loss", loss)?;
        }
        for side in &sides {
            ensure_finite_weights(stage, epoch, &side.weights)?;
        }
        if !origin.held_out.is_empty() && due(origin.validated_every_epochs) {
            let weights: Vec<Weights> = sides.iter().map(Learner::evaluated).collect();
            let validation = validated(learning, &weights, origin.held_out, &level_of);
            ensure_finite(stage, epoch, "validation loss", validation.0)?;
            row.validation = Some(validation);
        }
        row.seconds = begun.elapsed().as_secs_f64();
        metrics.add(&row)?;
        report(&bar, stage, epoch, epochs, message(&row));
        if due(origin.checkpoint_every_epochs) {
            let of_side = |(side, learner): (&Side, &Learner)| learner.lists(side.prefix);
            let checkpoint = Checkpoint {
                origin: origin.hash.clone(),
                progress,
                lists: origin.sides.iter().zip(&sides).flat_map(of_side).collect(),
            };
            run.checkpoints.save(stage, &checkpoint)?;
        }
    }
    bar.finish_and_clear();
    Ok(sides.iter().map(Learner::evaluated).collect())
}

impl Taken {
    /// Adds the figures of a batch of `samples`.
    fn add(&mut self, taken: &Self, samples: usize) {
        let samples = samples as f64;
        self.loss += taken.loss * samples;
        if let Some(loss) = taken.generator_loss {
            *self.generator_loss.get_or_insert(0.0) += loss * samples;
        }
        if let Some(right) = taken.right {
            *self.right.get_or_insert(0.0) += right;
        }
    }
}

/// The sides at the origin, or as the stage's last checkpoint has them.
fn begin(
    stage: &str,
    origin: &Origin,
    run: &Run,
    device: &Device,
) -> anyhow::Result<(Progress, Vec<Learner>)> {
    let optimiser = origin.optimiser;
    let fresh = |side: &Side| Learner::fresh(side.weights.clone(), optimiser, side.averaging);
    let fresh: Vec<Learner> = origin.sides.iter().map(fresh).collect();
    let pairs = || origin.sides.iter().zip(&fresh);
    let lists: Vec<_> = pairs()
        .flat_map(|(side, fresh)| fresh.lists(side.prefix))
        .collect();
    let Some(kept) = run.checkpoints.newest(stage, &lists, device)? else {
        return Ok((Progress::default(), fresh));
    };
    if !origin.is_generated {
        run.check_origin(stage, &kept, &origin.hash)?;
    }
    let steps = kept.progress.step;
    let resumed =
        |side: &Side| Learner::resumed(&kept, side.prefix, steps, optimiser, side.averaging);
    let sides: anyhow::Result<_> = origin.sides.iter().map(resumed).collect();
    Ok((kept.progress, sides?))
}

/// Mean loss and accuracy on presses of held-out objects, as they are and without references.
fn validated(
    learning: &dyn Learning,
    weights: &[Weights],
    held_out: &[usize],
    level_of: impl Fn(usize) -> u8,
) -> (f64, f64) {
    let question = Question {
        presses: held_out.to_vec(),
        references: Vec::new(),
    };
    let outputs = learning.outputs();
    let (mut loss, mut right) = (0.0, 0.0);
    let rows = learning.judge(weights, &[question], None);
    for (&press, row) in held_out.iter().zip(rows) {
        let probabilities = outputs.probabilities(&row, 1.0);
        let level = usize::from(level_of(press)) - 1;
        loss -= f64::from(probabilities[level].max(f32::MIN_POSITIVE)).ln();
        right += f64::from(u8::from(argmax(&probabilities).0 == level));
    }
    let count = held_out.len() as f64;
    (loss / count, right / count)
}

fn message(row: &Row) -> String {
    let mut message = format!("loss {:.4}", row.loss);
    if let Some(share) = row.accuracy {
        message += &format!(", accuracy {:.1} %", 100.0 * share);
    }
    if let Some((loss, share)) = row.validation {
        let percent = 100.0 * share;
        message += &format!("; held out: loss {loss:.4}, accuracy {percent:.1} %");
    }
    if let Some(loss) = row.generator_loss {
        message += &format!(", generator {loss:.3}");
    }
    if let Some([_, sigma, _]) = row.sigma {
        message += &format!(", sigma {sigma:.3}");
    }
    message
}
