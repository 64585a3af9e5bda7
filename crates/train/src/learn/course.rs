//! The training loop of the network that judges the course of a press.
//!
//! In: presses over time, with the arm's reported motion. Out: weights, a temperature, and the
//! calibration of sets of levels and intervals of Shore hardness on held-out objects. Metrics and
//! checkpoints are written on the way. An interrupted run resumes with bit-identical results.

use burn::tensor::{Device, Tensor};

use crate::data::courses::Courses;
use crate::data::dataset;
use crate::learn::conformal::{Calibration, Judged};
use crate::learn::epochs::{self, Batch};
use crate::learn::force::{self, Label};
use crate::learn::learner::Learner;
use crate::net::course::{self, COLUMNS, FRAMES, PressMoment};
use crate::net::frames::{self, FEATURES, Features};
use crate::net::hrn;
use crate::net::network::{Weights, numbers};
use crate::net::shore;
use crate::net::standard::Standard;
use crate::net::start::ExportedNetwork;
use crate::run::Run;
use crate::run::checkpoint::Origin;
use crate::run::progress::ensure_finite_logits;
use crate::settings::{ArmReports, Training};
use hardnessd_core::verdict::{ModelFrame, argmax};
use hardnessd_simulator::random::Stream;

mod varied;

/// How far the weights of levels with few samples are raised towards equal levels, unless the
/// settings say otherwise: halfway. Evenly spread Shore hardness gives few samples of the narrow
/// levels. The course of a press separates these levels well enough that halfway costs no accuracy
/// over samples, and gains most of what equal weights would gain over levels (`models/course.md`).
pub const LEVEL_BALANCE: f64 = 0.5;
/// Training that starts from a model's weights ends at this share of the way from them to the
/// weights it learnt: less of it than for models of one frame ([`epochs::LEARNT_SHARE`]). On four
/// draws of other sensors and materials, an eighth of the way was better than half by 2 points,
/// with correct newtons and with wrong ones (`docs/results.md`).
const LEARNT_SHARE: f32 = 0.125;
/// Presses per pass without gradients.
const JUDGED_AT_ONCE: usize = 250;

/// A press, prepared for training.
#[derive(Debug, Clone, PartialEq)]
pub struct Press {
    /// Features of each frame, `[frames, FEATURES]`.
    pub features: Vec<f32>,
    /// Time, approach and force of each frame.
    pub moments: Vec<PressMoment>,
    /// Stiffness of the arm in N/mm; 0 if unknown.
    pub arm_n_per_mm: f32,
    /// The hardness level, 1..=L, or 0 if unlabelled.
    pub level: u8,
    /// The measured Shore OO hardness, if any.
    pub shore: Option<f32>,
    /// The number of the pressed object.
    pub object: u32,
}

/// All presses of the data, each from the frame that began it, with all forces times
/// `force_factor`.
///
/// # Errors
///
/// Fails if features cannot be computed.
pub fn presses(courses: &Courses, force_factor: f32) -> anyhow::Result<Vec<Press>> {
    let all: Vec<usize> = (0..courses.presses.len()).collect();
    prepared(courses, &all, force_factor)
}

/// The presses of these numbers.
fn prepared(courses: &Courses, numbers: &[usize], force_factor: f32) -> anyhow::Result<Vec<Press>> {
    let plan = Features::new()?;
    let prepare = |&number: &usize| {
        let press = &courses.presses[number];
        let rows = courses
            .rows(number)
            .filter(|&row| courses.time_s[row] >= 0.0);
        let rows: Vec<usize> = rows.take(FRAMES).collect();
        let frame = |&row: &usize| courses.frame(row).times(force_factor);
        let frames: Vec<ModelFrame> = rows.iter().map(frame).collect();
        let features = plan.of(&frames)?;
        let moment = |(&row, of_frame): (&usize, &[f32])| PressMoment {
            time_s: courses.time_s[row],
            approach_mm: (courses.known[row] == 1).then_some(courses.approach_mm[row]),
            force_n: frames::force_n(of_frame),
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
    numbers.iter().map(prepare).collect()
}

impl Press {
    /// The columns of each moment, before standardisation.
    fn columns(&self) -> Vec<f32> {
        let motion = course::motion(&self.moments, self.arm_n_per_mm);
        let rows = self.features.chunks(FEATURES).zip(motion);
        rows.flat_map(|(features, motion)| features.iter().copied().chain(motion))
            .collect()
    }

    /// The network's inputs.
    fn inputs(&self, standard: &Standard) -> course::Inputs {
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

/// The inputs of a training.
#[derive(Debug)]
pub struct Task<'a> {
    /// Name of the stage.
    pub stage: &'static str,
    /// All presses of the data.
    pub presses: &'a [Press],
    /// Indices of labelled presses to learn from.
    pub train: &'a [usize],
    /// Indices of labelled presses of held-out objects; may be empty.
    pub held_out: &'a [usize],
    /// The number of hardness levels.
    pub levels: usize,
    /// The errors and gaps in the arm's reports that training presses are given.
    pub reports: ArmReports,
    /// Settings of the training.
    pub settings: &'a Training,
    /// The seed of everything random.
    pub seed: u64,
    /// The device that computes.
    pub device: &'a Device,
}

/// A trained network.
#[derive(Debug)]
pub struct Trained {
    /// Weights of all layers.
    pub weights: Weights,
    /// The factor of the forces, which presses are prepared with, and mean and deviation of the columns.
    pub standard: Standard,
    /// The calibration of the verdicts.
    pub calibration: Calibration,
}

impl Trained {
    /// Logits, before temperature, and Shore OO (value, low, high) of presses.
    pub fn judge(
        &self,
        presses: &[Press],
        levels: usize,
        device: &Device,
    ) -> Vec<(Vec<f32>, [f32; 3])> {
        let mut judged = Vec::with_capacity(presses.len());
        for part in presses.chunks(JUDGED_AT_ONCE) {
            let inputs: Vec<_> = part
                .iter()
                .map(|press| press.inputs(&self.standard))
                .collect();
            let outputs = course::outputs(&self.weights, &inputs, device);
            judged.extend(shore::of_outputs(&outputs, levels, self.calibration.widths));
        }
        judged
    }
}

/// The start with its factor of the forces corrected by the labels of the presses `train`.
///
/// # Errors
///
/// Fails if features cannot be computed.
pub fn with_force_factor(
    mut start: ExportedNetwork,
    courses: &Courses,
    train: &[usize],
    device: &Device,
) -> anyhow::Result<ExportedNetwork> {
    let presses = train.iter().map(|&place| &courses.presses[place]);
    let labels: Vec<Label> = presses.map(|press| (press.level, press.object)).collect();
    let trained = Trained {
        weights: start.weights.clone(),
        standard: start.standard.clone(),
        calibration: Calibration::NONE,
    };
    let factor = force::factor(&labels, start.temperature, device, |factor| {
        let presses = prepared(courses, train, start.standard.force_factor * factor)?;
        let judged = trained.judge(&presses, dataset::levels().len(), device);
        Ok(judged.into_iter().map(|(logits, _)| logits).collect())
    })?;
    start.standard.force_factor *= factor;
    Ok(start)
}

/// Trains from random weights or from `start` with its calibration, or continues from the stage's
/// last checkpoint in `run`. Without held-out objects, the temperature and the interval's widths
/// stay those of `start`, and there are no sets of levels, because nothing shows whether they hold.
///
/// # Errors
///
/// Fails if the run's directory cannot be read or written, its checkpoint is of another stage than
/// this, or the loss or a weight is no longer finite.
pub fn fit(
    task: &Task,
    start: Option<(ExportedNetwork, Calibration)>,
    run: &Run,
) -> anyhow::Result<Trained> {
    let Some((start, calibration)) = start else {
        let initial = course::initial(task.levels, task.seed, task.device);
        let (weights, standard) = task.learnt(initial, task.standard(), run)?;
        let calibration = match task.has_shore() {
            true => Calibration::NONE,
            false => Calibration::WITHOUT_SHORE,
        };
        return task.calibrated(weights, standard, &calibration);
    };
    let (weights, standard) = task.learnt(start.weights.clone(), start.standard, run)?;
    let weights = weights.between(&start.weights, LEARNT_SHARE);
    task.calibrated(weights, standard, &calibration)
}

impl Task<'_> {
    /// Whether a press to learn from has a measured Shore hardness.
    pub fn has_shore(&self) -> bool {
        let mut train = self.train.iter();
        train.any(|&place| self.presses[place].shore.is_some())
    }

    fn stream(&self, name: &str) -> Stream {
        Stream::new(self.seed, &format!("{} {name}", self.stage))
    }

    /// Mean and deviation of the columns of the training presses.
    fn standard(&self) -> Standard {
        let presses = self.train.iter().map(|&place| &self.presses[place]);
        let rows: Vec<Vec<f32>> = presses.map(Press::columns).collect();
        Standard::of(COLUMNS, rows.iter().flat_map(|rows| rows.chunks(COLUMNS)))
    }

    /// Runs the epochs from `initial`, or from the last checkpoint.
    fn learnt(
        &self,
        initial: Weights,
        standard: Standard,
        run: &Run,
    ) -> anyhow::Result<(Weights, Standard)> {
        let stage = epochs::Stage {
            name: self.stage,
            origin: self.origin(&initial),
            train: self.train,
            settings: self.settings,
            seed: self.seed,
        };
        let level_of = |&place: &usize| self.presses[place].level;
        let level_weights = hrn::level_weights(
            self.train.iter().map(level_of),
            self.levels,
            self.settings.level_balance.unwrap_or(LEVEL_BALANCE) as f32,
            self.device,
        );
        let weights = epochs::run(&stage, initial, run, self.device, |learner, batch| {
            Ok(self.step(learner, (&standard, &level_weights), batch))
        })?;
        Ok((weights, standard))
    }

    fn origin(&self, initial: &Weights) -> String {
        let mut origin = Origin::new(self.stage, &(self.settings, self.reports), self.seed);
        for &place in self.train.iter().chain(self.held_out) {
            let press = &self.presses[place];
            let known = press
                .moments
                .iter()
                .flat_map(|moment| [moment.time_s, moment.approach_mm.unwrap_or(f32::NAN)]);
            let label = [
                f32::from(press.level),
                press.shore.unwrap_or(f32::NAN),
                press.arm_n_per_mm,
            ];
            origin = origin.numbers(press.features.iter().copied().chain(known).chain(label));
        }
        origin.weights(initial).finish()
    }

    /// Takes a step on a batch of presses. Returns the batch's mean loss, and how many of the
    /// presses were judged correctly before the step.
    fn step(
        &self,
        learner: &mut Learner,
        (standard, weights): (&Standard, &Tensor<2>),
        Batch {
            samples: places,
            step,
            rate,
        }: Batch,
    ) -> (f64, usize) {
        let mut stream = self.stream("variation").child(step);
        let vary = |&place: &usize| self.reports.varied(&self.presses[place], &mut stream);
        let mut presses: Vec<Press> = places.iter().map(vary).collect();
        presses.sort_by_key(|press| press.moments.len());
        let inputs: Vec<_> = presses.iter().map(|press| press.inputs(standard)).collect();
        let levels_of = presses.iter().map(|press| press.level);
        let targets = hrn::targets(levels_of, self.levels, self.device).mul(weights.clone());
        let measured: Vec<Option<f32>> = presses.iter().map(|press| press.shore).collect();

        let tracked = learner.weights.tracked();
        let outputs = course::outputs(&tracked, &inputs, self.device);
        let (loss, judged) = shore::loss(outputs, targets, &measured);
        let mut gradients = loss.backward();
        learner.step(&tracked, &mut gradients, rate);
        let right = presses
            .iter()
            .zip(judged.chunks(self.levels))
            .filter(|(press, logits)| argmax(logits).0 + 1 == usize::from(press.level))
            .count();
        (f64::from(numbers(&loss)[0]), right)
    }

    /// Calibrates on the presses of held-out objects, varied like the training presses.
    fn calibrated(
        &self,
        weights: Weights,
        standard: Standard,
        start: &Calibration,
    ) -> anyhow::Result<Trained> {
        let mut trained = Trained {
            weights,
            standard,
            calibration: Calibration::NONE,
        };
        // Finite weights can still give a logit that is not. One press is enough for this check.
        let first = self.presses[self.train[0]].clone();
        let first = trained.judge(&[first], self.levels, self.device);
        ensure_finite_logits(self.stage, self.settings.epochs, &first)?;
        let mut stream = self.stream("calibration");
        let presses: Vec<Press> = self
            .held_out
            .iter()
            .map(|&place| self.reports.varied(&self.presses[place], &mut stream))
            .collect();
        let judged = trained.judge(&presses, self.levels, self.device);
        let judged: Vec<Judged> = presses
            .iter()
            .zip(judged)
            .map(|(press, (logits, said))| Judged {
                object: press.object,
                level: usize::from(press.level) - 1,
                shore: press.shore,
                logits,
                said,
            })
            .collect();
        trained.calibration = Calibration::of(&judged, start, &mut stream, self.device);
        Ok(trained)
    }
}
