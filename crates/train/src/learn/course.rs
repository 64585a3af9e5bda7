//! The training loop of the network that judges the course of a press.
//!
//! In: presses over time, with the arm's reported motion, and presses that serve as references of
//! their sensors. Out: weights, a temperature, and the calibration of sets of levels on held-out
//! objects. Metrics and checkpoints are written on the way. An interrupted run resumes with
//! bit-identical results.

use burn::tensor::{Device, Tensor};

use self::lots::Lots;
use crate::data::courses::{self, Courses};
use crate::learn::conformal::Calibration;
use crate::learn::epochs::{self, Batch};
use crate::learn::frame::LEVEL_BALANCE;
use crate::learn::learner::Learner;
use crate::learn::temperature;
use crate::net::bins::{self, BINS};
use crate::net::course::{self, FRAMES};
use crate::net::network::{Weights, numbers};
use crate::net::standard::Standard;
use crate::run::Run;
use crate::run::checkpoint::Origin;
use crate::run::progress::ensure_finite;
use crate::settings::{ArmReports, Training};
use hardnessd_core::verdict::features::{self, FEATURES, Moment};
use hardnessd_core::verdict::{Borders, Distribution, Piece, argmax};
use hardnessd_simulator::Reference;
use hardnessd_simulator::random::Stream;

pub use self::lots::Drawn;

mod lots;
mod varied;

/// Groups of presses per pass without gradients.
const JUDGED_AT_ONCE: usize = 16;

/// A press, prepared for training.
#[derive(Debug, Clone, PartialEq)]
pub struct Press {
    /// Features, time and approach of each frame, from the one that began the press.
    pub moments: Vec<Moment>,
    /// Stiffness of the arm in N/mm; 0 if unknown.
    pub arm_n_per_mm: f32,
    /// The hardness level, 1..=L, or 0 if unlabelled.
    pub level: u8,
    /// The measured Shore OO hardness, if any.
    pub shore: Option<f32>,
    /// The number of the pressed object.
    pub object: u32,
    /// The number of the sensor.
    pub sensor: u32,
    /// The piece, if it is a rigid one.
    pub piece: Option<Piece>,
}

/// All presses of the data, each from the frame that began it.
pub fn presses(courses: &Courses) -> Vec<Press> {
    let prepare = |(number, press): (usize, &courses::Press)| {
        let rows = courses.rows(number);
        let rows = rows.filter(|&row| courses.time_s[row] >= 0.0);
        let moment = |row: usize| Moment {
            frame: features::of_frame(&courses.frame(row)),
            time_s: courses.time_s[row],
            approach_mm: (courses.known[row] == 1).then_some(courses.approach_mm[row]),
        };
        Press {
            moments: rows.take(FRAMES).map(moment).collect(),
            arm_n_per_mm: press.arm_n_per_mm,
            level: press.level,
            shore: Some(press.shore).filter(|shore| shore.is_finite()),
            object: press.object,
            sensor: press.sensor,
            piece: press.reference.map(piece),
        }
    };
    courses.presses.iter().enumerate().map(prepare).collect()
}

/// A rigid piece as references name it.
pub fn piece(reference: Reference) -> Piece {
    match reference {
        Reference::Flat { width_mm } => Piece::Flat { width_mm },
        Reference::Ball { radius_mm } => Piece::Ball { radius_mm },
    }
}

impl Drawn {
    /// The network's inputs.
    fn group(&self, standard: &Standard) -> course::Group {
        let references = self.references.iter();
        let references = references.map(|(press, piece)| (press.inputs(standard), *piece));
        course::Group {
            presses: self.presses.iter().map(|p| p.inputs(standard)).collect(),
            references: references.collect(),
        }
    }

    /// The same with the robot's errors, as training presses have them. References are whole presses.
    fn varied(self, reports: &ArmReports, stream: &mut Stream) -> Self {
        let whole = ArmReports {
            early: 0.0,
            ..*reports
        };
        let presses = self.presses.iter();
        let presses = presses.map(|press| reports.varied(press, stream)).collect();
        let references = self.references.into_iter();
        let references = references.map(|(press, piece)| (whole.varied(&press, stream), piece));
        Self {
            presses,
            references: references.collect(),
        }
    }
}

impl Press {
    /// The features of the press.
    pub fn features(&self) -> [f32; FEATURES] {
        features::of_press(&self.moments, self.arm_n_per_mm)
    }

    /// The press as a robot gives it that reports nothing of its arm.
    #[must_use]
    pub fn without_arm(mut self) -> Self {
        self.arm_n_per_mm = 0.0;
        let moments = self.moments.iter_mut();
        moments.for_each(|moment| moment.approach_mm = None);
        self
    }

    /// The network's inputs.
    fn inputs(&self, standard: &Standard) -> course::Inputs {
        let features = self.features();
        let standardised = features.iter().enumerate();
        standardised
            .map(|(column, &x)| standard.apply(column, x))
            .collect()
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
    /// The parts of the scale that the hardness levels have.
    pub borders: &'a Borders,
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
    /// Mean and deviation of the features.
    pub standard: Standard,
    /// What is added to the logits of the bins after temperature ([`bins::lifts`]).
    pub lifts: Vec<f32>,
    /// The calibration of the verdicts.
    pub calibration: Calibration,
}

impl Trained {
    /// The distribution over Shore hardness from the logits of its bins.
    pub fn distribution(&self, logits: &[f32], temperature: f32) -> Distribution {
        let lifted = logits.iter().zip(&self.lifts);
        let lifted: Vec<f32> = lifted.map(|(x, lift)| x / temperature + lift).collect();
        Distribution::of(&lifted)
    }

    /// Logits of the bins of Shore hardness, before temperature: of the presses of each group, one
    /// group after the other.
    pub fn judge(&self, groups: &[Drawn], device: &Device) -> Vec<Vec<f32>> {
        let mut judged = Vec::new();
        for part in groups.chunks(JUDGED_AT_ONCE) {
            let inputs: Vec<_> = part.iter().map(|g| g.group(&self.standard)).collect();
            let outputs = course::outputs(&self.weights, &inputs, None, device);
            judged.extend(numbers(&outputs).chunks(BINS).map(<[f32]>::to_vec));
        }
        judged
    }
}

/// Trains from random weights, or continues from the stage's last checkpoint in `run`. Without held-out
/// objects there are no sets of levels, because nothing shows whether they hold.
///
/// # Errors
///
/// Fails if the run's directory cannot be read or written, its checkpoint is of another stage than
/// this, or the loss or a weight is no longer finite.
pub fn fit(task: &Task, run: &Run) -> anyhow::Result<Trained> {
    let initial = course::initial(task.seed, task.device);
    let (weights, standard) = task.learnt(initial, task.standard(), run)?;
    task.calibrated(weights, standard, task.lifts())
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

    /// Mean and deviation of the features of the training presses.
    fn standard(&self) -> Standard {
        let presses = self.train.iter().map(|&place| &self.presses[place]);
        let rows: Vec<_> = presses.map(Press::features).collect();
        Standard::of(FEATURES, rows.iter().map(<[f32; FEATURES]>::as_slice))
    }

    /// Runs the epochs from `initial`, or from the last checkpoint.
    fn learnt(
        &self,
        initial: Weights,
        standard: Standard,
        run: &Run,
    ) -> anyhow::Result<(Weights, Standard)> {
        let lots = Lots::of(self.presses, self.train);
        // A sample of an epoch is a group of presses.
        let settings = Training {
            batch: (self.settings.batch / lots::GROUP).max(1),
            ..*self.settings
        };
        let stage = epochs::Stage {
            name: self.stage,
            origin: self.origin(&initial),
            generated: false,
            train: &lots.tickets(),
            settings: &settings,
            seed: self.seed,
        };
        let parts = bins::parts(self.borders, self.levels, self.device);
        let weights = epochs::run(&stage, initial, run, self.device, None, |learner, batch| {
            Ok(self.step(learner, &lots, (&standard, &parts), batch))
        })?;
        Ok((weights, standard))
    }

    /// What makes rare levels as likely as frequent ones.
    fn lifts(&self) -> Vec<f32> {
        let mut counts = vec![0; self.levels];
        for &place in self.train {
            counts[usize::from(self.presses[place].level) - 1] += 1;
        }
        let share = self.settings.level_balance.unwrap_or(LEVEL_BALANCE);
        bins::lifts(self.borders, &counts, share as f32)
    }

    fn origin(&self, initial: &Weights) -> String {
        let mut origin = Origin::new(self.stage, &(self.settings, self.reports), self.seed);
        for &place in self.train.iter().chain(self.held_out) {
            let press = &self.presses[place];
            let moments = press.moments.iter().flat_map(|moment| {
                let known = [moment.time_s, moment.approach_mm.unwrap_or(f32::NAN)];
                moment.frame.into_iter().chain(known)
            });
            let label = [
                f32::from(press.level),
                press.shore.unwrap_or(f32::NAN),
                press.arm_n_per_mm,
                press.sensor as f32,
            ];
            origin = origin.numbers(moments.chain(label));
        }
        origin.weights(initial).finish()
    }

    /// Takes a step on groups of presses. Returns the mean loss of their presses, and how many of the
    /// groups' presses were judged correctly before the step, in groups.
    fn step(
        &self,
        learner: &mut Learner,
        lots: &Lots,
        (standard, parts): (&Standard, &Tensor<2>),
        Batch {
            samples: tickets,
            step,
            rate,
        }: Batch,
    ) -> (f64, f64) {
        let mut stream = self.stream("variation").child(step);
        let draw = |&ticket: &usize| {
            let drawn = lots.draw(ticket, self.presses, self.borders, &mut stream);
            drawn.varied(&self.reports, &mut stream)
        };
        let drawn: Vec<Drawn> = tickets.iter().map(draw).collect();
        let groups: Vec<_> = drawn.iter().map(|drawn| drawn.group(standard)).collect();
        let presses = drawn.iter().flat_map(|drawn| &drawn.presses);
        let labels: Vec<bins::Label> = presses.map(|press| (press.level, press.shore)).collect();

        let tracked = learner.weights.tracked();
        let outputs = course::outputs(&tracked, &groups, Some(&mut stream), self.device);
        let (loss, judged) = bins::loss(outputs, &labels, parts);
        let mut gradients = loss.backward();
        learner.step(&tracked, &mut gradients, rate);
        let rows = judged.chunks(self.levels);
        let right = labels
            .iter()
            .zip(rows)
            .filter(|((level, _), row)| argmax(row).0 + 1 == usize::from(*level))
            .count();
        let share = right as f64 / labels.len() as f64;
        (f64::from(numbers(&loss)[0]), share * tickets.len() as f64)
    }

    /// Calibrates on the presses of held-out objects, varied and with references like the training
    /// presses.
    fn calibrated(
        &self,
        weights: Weights,
        standard: Standard,
        lifts: Vec<f32>,
    ) -> anyhow::Result<Trained> {
        let mut trained = Trained {
            weights,
            standard,
            lifts,
            calibration: Calibration::NONE,
        };
        // Finite weights can still give a logit that is not. One press is enough for this check.
        let first = Drawn {
            presses: vec![self.presses[self.train[0]].clone()],
            references: Vec::new(),
        };
        for logit in trained.judge(&[first], self.device).iter().flatten() {
            ensure_finite(self.stage, self.settings.epochs, "logit", (*logit).into())?;
        }
        let mut stream = self.stream("calibration");
        let lots = Lots::of(self.presses, self.held_out);
        let groups = lots
            .all(self.presses, self.borders, &mut stream)
            .into_iter();
        let groups: Vec<Drawn> = groups
            .map(|group| group.varied(&self.reports, &mut stream))
            .collect();
        let judged = trained.judge(&groups, self.device);
        let presses: Vec<&Press> = groups.iter().flat_map(|group| &group.presses).collect();
        let judged: Vec<_> = presses.into_iter().zip(judged).collect();
        trained.calibration = self.calibration(&trained, &judged, &mut stream);
        Ok(trained)
    }

    /// The temperature at which the levels of the held-out presses are most probable, and the sets of
    /// levels.
    fn calibration(
        &self,
        trained: &Trained,
        judged: &[(&Press, Vec<f32>)],
        stream: &mut Stream,
    ) -> Calibration {
        let of_truth = |(press, logits): &(&Press, Vec<f32>), temperature: f32| {
            let levels = trained
                .distribution(logits, temperature)
                .levels(self.borders);
            levels[usize::from(press.level) - 1]
        };
        // Rare levels count as much as frequent ones.
        let mut counts = vec![0.0; self.levels + 1];
        judged
            .iter()
            .for_each(|(press, _)| counts[usize::from(press.level)] += 1.0);
        let loss = |temperature: f64| {
            let loss = judged.iter().map(|judged| {
                let p = of_truth(judged, temperature as f32).max(f32::MIN_POSITIVE);
                -f64::from(p).ln() / counts[usize::from(judged.0.level)]
            });
            loss.sum::<f64>()
        };
        let temperature = match judged.is_empty() {
            true => 1.0,
            false => temperature::least(loss),
        };
        let of_truth = judged.iter().map(|judged| {
            let press = judged.0;
            let p = of_truth(judged, temperature);
            ((press.object, press.shore.is_some()), p)
        });
        Calibration::of_sets(temperature, of_truth, stream)
    }
}
