//! The training loop of the network that judges the course of a press.
//!
//! In: presses over time, with what the arm told. Out: weights, a temperature, and what makes sets of
//! levels and intervals of Shore hold what they promise on objects held out. Metrics and checkpoints
//! are written on the way; a killed run goes on bit for bit.

use std::time::Instant;

use anyhow::Context as _;
use burn::tensor::{Device, Tensor, TensorData};

use crate::frame::Frame;
use crate::random::Stream;
use crate::train::data::courses::Courses;
use crate::train::learn::fit;
use crate::train::learn::learner::Learner;
use crate::train::net::course::{
    self, Batch, COLUMNS, FEATURES, FRAMES, Features, Moment, SHORE, Standard,
};
use crate::train::net::hrn;
use crate::train::net::network::{Weights, numbers};
use crate::train::run::Run;
use crate::train::run::checkpoint::{Checkpoint, Origin, Progress};
use crate::train::run::history::Row;
use crate::train::run::progress::{ensure_finite, ensure_finite_weights, progress_bar, report};
use crate::train::settings::Training;
use crate::verdict::argmax;

mod varied;

pub use varied::Told;

/// Name of the stage.
const STAGE: &str = "course";
/// How much the intervals' loss counts beside the levels'.
const SHORE_WEIGHT: f32 = 1.5;
/// Presses a pass without gradients.
const JUDGED_AT_ONCE: usize = 250;
/// Sets of levels and intervals of Shore miss the truth in at most this share.
pub const ALPHA: f32 = 0.1;
/// Draws of a press from each object that a quantile is averaged over.
const DRAWS: usize = 50;

/// A press, ready to be learnt from.
#[derive(Debug, Clone, PartialEq)]
pub struct Press {
    /// Features of each frame, `[frames, FEATURES]`.
    pub features: Vec<f32>,
    /// Time, approach and force of each frame.
    pub moments: Vec<Moment>,
    /// Stiffness of the arm; 0: unknown.
    pub arm_n_per_mm: f32,
    /// 1..=L, or 0: unlabelled.
    pub level: u8,
    /// Shore OO, where it was measured.
    pub shore: Option<f32>,
    /// What was pressed.
    pub object: u32,
}

/// The presses of a file, from the frame that began each.
///
/// # Errors
///
/// If features cannot be computed.
pub fn presses(courses: &Courses) -> anyhow::Result<Vec<Press>> {
    let plan = Features::new()?;
    let prepare = |(number, press): (usize, &crate::train::data::courses::Press)| {
        let rows = courses
            .rows(number)
            .filter(|&row| courses.time_s[row] >= 0.0);
        let rows: Vec<usize> = rows.take(FRAMES).collect();
        let frames: Vec<Frame> = rows.iter().map(|&row| courses.frame(row)).collect();
        let features = plan.of(&frames)?;
        let moment = |(&row, of_frame): (&usize, &[f32])| Moment {
            time_s: courses.time_s[row],
            approach_mm: (courses.known[row] == 1).then_some(courses.approach_mm[row]),
            force_n: course::force_n(of_frame),
        };
        Ok(Press {
            moments: rows
                .iter()
                .zip(features.chunks(FEATURES))
                .map(moment)
                .collect(),
            features,
            arm_n_per_mm: press.arm_n_per_mm,
            level: press.level,
            shore: Some(press.shore).filter(|shore| shore.is_finite()),
            object: press.object,
        })
    };
    courses.presses.iter().enumerate().map(prepare).collect()
}

impl Press {
    /// Columns of each moment, not standardised.
    fn columns(&self) -> Vec<f32> {
        let motion = course::motion(&self.moments, self.arm_n_per_mm);
        let rows = self.features.chunks(FEATURES).zip(motion);
        rows.flat_map(|(features, motion)| features.iter().copied().chain(motion))
            .collect()
    }

    /// As the network takes it.
    fn inputs(&self, standard: &Standard) -> (Vec<f32>, Vec<f32>) {
        let columns = self.columns();
        let standardised = columns.iter().enumerate();
        let rows = standardised
            .map(|(place, &x)| standard.apply(place % COLUMNS, x))
            .collect();
        (
            rows,
            self.moments.iter().map(|moment| moment.force_n).collect(),
        )
    }
}

/// What is to be learnt, and from what.
#[derive(Debug)]
pub struct Task<'a> {
    /// All presses of the training split.
    pub presses: &'a [Press],
    /// Places of labelled presses to learn from.
    pub train: &'a [usize],
    /// Places of presses of held-out objects.
    pub held_out: &'a [usize],
    /// How many levels there are.
    pub levels: usize,
    /// What the arm may tell wrongly, or not at all.
    pub told: Told,
    /// How.
    pub settings: &'a Training,
    /// Everything random follows from it.
    pub seed: u64,
    /// Where.
    pub device: &'a Device,
}

/// A trained network.
#[derive(Debug)]
pub struct Trained {
    /// Of all layers.
    pub weights: Weights,
    /// Of the columns.
    pub standard: Standard,
    /// What the logits are divided by.
    pub temperature: f32,
    /// What is added below and above the interval of Shore, in Shore OO.
    pub widths: [f32; 2],
    /// A set of levels holds those of at least this probability.
    pub threshold: f32,
}

impl Trained {
    /// Logits and Shore OO (value, low, high) of presses, before temperature.
    pub fn judge(
        &self,
        presses: &[Press],
        levels: usize,
        device: &Device,
    ) -> Vec<(Vec<f32>, [f32; 3])> {
        let mut judged = Vec::with_capacity(presses.len());
        let [below, above] = self.widths;
        for part in presses.chunks(JUDGED_AT_ONCE) {
            let inputs: Vec<_> = part
                .iter()
                .map(|press| press.inputs(&self.standard))
                .collect();
            let outputs = course::outputs(&self.weights, &Batch::new(&inputs, device));
            for row in numbers(&outputs).chunks(levels + SHORE) {
                let of =
                    |place: usize| row[levels + place] * course::SHORE_UNIT + course::SHORE_MIDDLE;
                let shore =
                    [of(0), of(1) - below, of(2) + above].map(|shore| shore.clamp(0.0, 100.0));
                judged.push((row[..levels].to_vec(), shore));
            }
        }
        judged
    }
}

/// Trains, or goes on from the last checkpoint in `run`.
///
/// # Errors
///
/// If the run's directory cannot be read or written, its checkpoint is of another stage than this,
/// or the loss or a weight is no number any more.
pub fn fit(task: &Task, run: &Run) -> anyhow::Result<Trained> {
    let Training { batch, epochs, .. } = *task.settings;
    let rows: Vec<Vec<f32>> = task
        .train
        .iter()
        .map(|&place| task.presses[place].columns())
        .collect();
    let standard = Standard::of(rows.iter().flat_map(|rows| rows.chunks(COLUMNS)));
    drop(rows);
    let initial = course::initial(task.levels, task.seed, task.device);
    let origin = task.origin(&initial);
    let Training {
        optimiser,
        averaging,
        ..
    } = *task.settings;
    let (mut progress, mut learner) = match run.latest(STAGE, &origin, epochs, task.device)? {
        Some(checkpoint) => {
            run.check_origin(STAGE, &checkpoint, &origin)?;
            let steps = checkpoint.progress.step;
            let learner = Learner::resumed(&checkpoint, "", steps, optimiser, averaging)?;
            (checkpoint.progress, learner)
        }
        None => (
            Progress::default(),
            Learner::fresh(initial, optimiser, averaging),
        ),
    };
    let steps = u64::from(epochs) * task.train.len().div_ceil(batch) as u64;
    let mut metrics = run.metrics(STAGE, progress.step)?;
    let bar = progress_bar(STAGE, steps, progress.step);
    let begun = Instant::now();
    while progress.epoch < epochs {
        let mut order = task.train.to_vec();
        { task.stream("order").child(progress.epoch.into()) }.shuffle(&mut order);
        let (mut loss_sum, mut right, mut rate) = (0.0, 0, 0.0);
        for places in order.chunks(batch) {
            rate = optimiser.rate_at(progress.step, steps);
            let (loss, of_batch) = task.step(&mut learner, &standard, places, progress.step, rate);
            loss_sum += loss * places.len() as f64;
            right += of_batch;
            progress.step += 1;
            bar.inc(1);
        }
        progress.epoch += 1;
        let Progress { epoch, step, .. } = progress;
        let loss = loss_sum / task.train.len() as f64;
        ensure_finite(STAGE, epoch, "loss", loss)?;
        ensure_finite_weights(STAGE, epoch, &learner.weights)?;
        let accuracy = right as f64 / task.train.len() as f64;
        metrics.add(&Row {
            step,
            epoch,
            loss,
            learning_rate: rate,
            accuracy: Some(accuracy),
            seconds: begun.elapsed().as_secs_f64(),
            ..Row::default()
        })?;
        let message = format!("loss {loss:.4}, accuracy {:.1} %", 100.0 * accuracy);
        report(&bar, STAGE, epoch, epochs, message);
        if epoch == epochs || epoch.is_multiple_of(task.settings.checkpoint_every_epochs) {
            let lists = learner.lists("");
            run.save(
                STAGE,
                &Checkpoint {
                    origin: origin.clone(),
                    progress,
                    lists,
                },
            )?;
        }
    }
    bar.finish_and_clear();
    task.calibrated(learner.evaluated(), standard)
}

impl Task<'_> {
    fn stream(&self, name: &str) -> Stream {
        Stream::new(self.seed, &format!("{STAGE} {name}"))
    }

    fn origin(&self, initial: &Weights) -> String {
        let mut origin = Origin::new(STAGE, &(self.settings, self.told), self.seed);
        for &place in self.train.iter().chain(self.held_out) {
            let press = &self.presses[place];
            let known = press
                .moments
                .iter()
                .map(|moment| moment.approach_mm.unwrap_or(f32::NAN));
            let label = [
                f32::from(press.level),
                press.shore.unwrap_or(f32::NAN),
                press.arm_n_per_mm,
            ];
            origin = origin.numbers(press.features.iter().copied().chain(known).chain(label));
        }
        origin.weights(initial).finish()
    }

    /// One step on the presses `places`; gives the batch's mean loss, and how many of them were judged
    /// rightly before it.
    fn step(
        &self,
        learner: &mut Learner,
        standard: &Standard,
        places: &[usize],
        step: u64,
        rate: f64,
    ) -> (f64, usize) {
        let mut stream = self.stream("variation").child(step);
        let inputs: Vec<_> = places
            .iter()
            .map(|&place| {
                self.told
                    .varied(&self.presses[place], &mut stream)
                    .inputs(standard)
            })
            .collect();
        let batch = places.len();
        let column = |value: fn(&Press) -> f32| {
            let values: Vec<f32> = places
                .iter()
                .map(|&place| value(&self.presses[place]))
                .collect();
            Tensor::<2>::from_data(TensorData::new(values, [batch, 1]), self.device)
        };
        let on_scale = |press: &Press| {
            let shore = press.shore.unwrap_or(course::SHORE_MIDDLE);
            (shore - course::SHORE_MIDDLE) / course::SHORE_UNIT
        };
        let known = column(|press| f32::from(u8::from(press.shore.is_some())));
        let levels_of = places.iter().map(|&place| self.presses[place].level);
        let targets = hrn::targets(levels_of, self.levels, self.device);

        let tracked = learner.weights.tracked();
        let outputs = course::outputs(&tracked, &Batch::new(&inputs, self.device));
        let logits = outputs.clone().slice([0..batch, 0..self.levels]);
        let shore = outputs.slice([0..batch, self.levels..self.levels + SHORE]);
        let judged = numbers(&logits);
        let loss = hrn::cross_entropy(logits, targets)
            .add(course::interval_loss(shore, column(on_scale), known).mul_scalar(SHORE_WEIGHT));
        let mut gradients = loss.backward();
        learner.step(&tracked, &mut gradients, rate);
        let right = places
            .iter()
            .zip(judged.chunks(self.levels))
            .filter(|(place, logits)| {
                argmax(logits).0 + 1 == usize::from(self.presses[**place].level)
            })
            .count();
        (f64::from(numbers(&loss)[0]), right)
    }

    /// Temperature, widths and threshold, from the held-out objects' presses, varied as those learnt
    /// from.
    fn calibrated(&self, weights: Weights, standard: Standard) -> anyhow::Result<Trained> {
        let mut trained = Trained {
            weights,
            standard,
            temperature: 1.0,
            widths: [0.0; 2],
            threshold: 0.0,
        };
        let mut stream = self.stream("calibration");
        let presses: Vec<Press> = self
            .held_out
            .iter()
            .map(|&place| self.told.varied(&self.presses[place], &mut stream))
            .collect();
        if presses.is_empty() {
            return Ok(trained);
        }
        let judged = trained.judge(&presses, self.levels, self.device);
        let logits: Vec<(usize, Vec<f32>)> = presses
            .iter()
            .zip(&judged)
            .map(|(press, (logits, _))| (usize::from(press.level) - 1, logits.clone()))
            .collect();
        trained.temperature = fit::temperature(&logits);
        let rows: Vec<Vec<f32>> = logits.iter().map(|(_, row)| row.clone()).collect();
        let probabilities = fit::probabilities(&rows, trained.temperature, self.device);
        let wrong = probabilities
            .iter()
            .zip(&logits)
            .map(|(row, (level, _))| -row[*level]);
        let wrong = by_object(&presses, wrong);
        trained.threshold = -quantile(&wrong, &mut stream).context("no object is held out")?;
        let outside = presses
            .iter()
            .zip(&judged)
            .map(|(press, (_, [_, low, high]))| {
                let shore = press.shore.unwrap_or(f32::midpoint(*low, *high));
                (low - shore).max(shore - high)
            });
        let outside = by_object(&presses, outside);
        let width = quantile(&outside, &mut stream).context("no object is held out")?;
        trained.widths = [width; 2];
        Ok(trained)
    }
}

/// Values of presses, a list an object.
fn by_object(presses: &[Press], values: impl Iterator<Item = f32>) -> Vec<Vec<f32>> {
    let mut objects = std::collections::BTreeMap::<u32, Vec<f32>>::new();
    for (press, value) in presses.iter().zip(values) {
        objects.entry(press.object).or_default().push(value);
    }
    objects.into_values().collect()
}

/// The split-conformal quantile of 1 - [`ALPHA`] where objects are exchangeable: of a press of each
/// object, the value of rank ceil((1 - alpha)(n + 1)), averaged over draws of the presses. `None` without
/// objects.
fn quantile(objects: &[Vec<f32>], stream: &mut Stream) -> Option<f32> {
    if objects.is_empty() {
        return None;
    }
    let rank = ((1.0 - ALPHA) * (objects.len() + 1) as f32).ceil() as usize;
    let mut sum = 0.0;
    for _ in 0..DRAWS {
        let mut drawn: Vec<f32> = objects
            .iter()
            .map(|own| own[stream.below(own.len())])
            .collect();
        drawn.sort_by(f32::total_cmp);
        sum += drawn[rank.min(drawn.len()) - 1];
    }
    Some(sum / DRAWS as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_quantile_counts_objects_not_presses() {
        let mut stream = Stream::new(1, "quantile");
        // 99 objects of value 1 to 99; the last has a thousand presses.
        let mut objects: Vec<Vec<f32>> = (1..=99_u8).map(|n| vec![f32::from(n)]).collect();
        objects[98] = vec![99.0; 1000];
        assert_eq!(quantile(&objects, &mut stream), Some(90.0));
        // Too few objects for the promise: the greatest.
        assert_eq!(quantile(&objects[..3], &mut stream), Some(3.0));
        assert_eq!(quantile(&[], &mut stream), None);
    }
}
