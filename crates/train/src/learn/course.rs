//! The network that judges the course of a press.
//!
//! In: presses over time, with the arm's reported motion, and presses that serve as references of
//! their sensors. Out: weights, and logits of the bins of Shore hardness.

use burn::tensor::{Device, Tensor};

use self::lots::Lots;
use super::learner::Learner;
use super::{Batch, Inputs, Learning, Origin, Outputs, Question, Recogniser, Side, Taken};
use crate::data::presses::{Presses, Timed};
use crate::net::bins::{self, BINS};
use crate::net::course;
use crate::net::network::{Weights, numbers};
use crate::net::standard::Standard;
use crate::run::checkpoint;
use crate::settings::{ArmReports, Settings, Training};
use hardnessd_core::verdict::features::{self, FEATURES, Moment};
use hardnessd_core::verdict::{Borders, Extents, Knowledge, ModelError, Piece, argmax};
use hardnessd_simulator::Reference;
use hardnessd_simulator::random::Stream;

mod lots;
mod varied;

/// Questions per pass without gradients.
const JUDGED_AT_ONCE: usize = 16;
/// The name of the stage.
const STAGE: &str = "course";

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
    /// The number of the object, if it is known.
    pub object: Option<u32>,
    /// The number of the sensor.
    pub sensor: u32,
    /// The piece, if it is a rigid one.
    pub piece: Option<Piece>,
}

/// All presses of the data, each from the frame that began it.
pub fn prepared(presses: &Presses) -> Vec<Press> {
    let prepare = |place: usize| {
        let (course, press) = (presses.course(place), &presses.all[place]);
        Press {
            moments: course.moments.iter().map(Moment::from).collect(),
            arm_n_per_mm: course.arm_n_per_mm,
            level: press.level,
            shore: press.shore,
            object: press.object,
            sensor: press.sensor,
            piece: press.reference.map(piece),
        }
    };
    (0..presses.all.len()).map(prepare).collect()
}

/// A rigid piece as references name it.
pub fn piece(reference: Reference) -> Piece {
    match reference {
        Reference::Flat { width_mm } => Piece::Flat { width_mm },
        Reference::Ball { radius_mm } => Piece::Ball { radius_mm },
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
    fn inputs(&self, standard: &Standard) -> Vec<f32> {
        let features = self.features();
        let standardised = features.iter().enumerate();
        standardised
            .map(|(column, &x)| standard.apply(column, x))
            .collect()
    }
}

/// The network, and what it learns from.
#[derive(Debug)]
pub struct Course<'a> {
    prepared: Vec<Press>,
    train: &'a [usize],
    held_out: &'a [usize],
    lots: Lots,
    standard: Standard,
    borders: Borders,
    /// The number of hardness levels.
    levels: usize,
    /// The share of each bin that lies in each level.
    parts: Tensor<2>,
    /// What is added to the logits of the bins after temperature ([`bins::lifts`]).
    lifts: Vec<f32>,
    initial: Weights,
    reports: ArmReports,
    settings: Training,
    validated_every_epochs: u32,
    seed: u64,
    device: &'a Device,
}

impl<'a> Course<'a> {
    /// A network that learns from the presses `train`.
    ///
    /// # Errors
    ///
    /// Fails if the levels are no parts of the scale of Shore hardness.
    pub fn new(
        presses: &Presses,
        (train, held_out): (&'a [usize], &'a [usize]),
        settings: &Settings,
        seed: u64,
        device: &'a Device,
    ) -> Result<Self, ModelError> {
        let stated = presses.levels();
        let (borders, levels) = (Borders::of(&stated)?, stated.len());
        let prepared = prepared(presses);
        let rows: Vec<_> = train
            .iter()
            .map(|&place| prepared[place].features())
            .collect();
        let mut counts = vec![0; levels];
        for &place in train {
            counts[usize::from(prepared[place].level) - 1] += 1;
        }
        let balance = settings.training.level_balance as f32;
        Ok(Self {
            train,
            held_out,
            lots: Lots::of(&prepared, train),
            standard: Standard::of(FEATURES, rows.iter().map(<[f32; FEATURES]>::as_slice)),
            parts: bins::parts(&borders, levels, device),
            lifts: bins::lifts(&borders, &counts, balance),
            initial: course::initial(seed, device),
            borders,
            levels,
            prepared,
            reports: settings.reports,
            settings: settings.training,
            validated_every_epochs: settings.validation.every_epochs,
            seed,
            device,
        })
    }

    fn stream(&self, name: &str) -> Stream {
        Stream::new(self.seed, &format!("{STAGE} {name}"))
    }

    fn hash(&self) -> String {
        let settings = (&self.settings, self.reports);
        let mut origin = checkpoint::Origin::new(STAGE, &settings, self.seed);
        for &place in self.train.iter().chain(self.held_out) {
            let press = &self.prepared[place];
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
        origin.weights(&self.initial).finish()
    }

    /// The network's inputs for a question.
    fn group(&self, question: &Question, mut vary: Option<&mut Stream>) -> course::Group {
        let whole = ArmReports {
            early: 0.0,
            ..self.reports
        };
        // With a stream, presses have the robot's errors, as training presses have them. References are
        // whole presses.
        let mut inputs = |place: usize, reports: &ArmReports| {
            let press = &self.prepared[place];
            let press = match vary.as_deref_mut() {
                Some(stream) => &reports.varied(press, stream),
                None => press,
            };
            press.inputs(&self.standard)
        };
        let presses = question.presses.iter();
        let references = question.references.iter();
        course::Group {
            presses: presses.map(|&place| inputs(place, &self.reports)).collect(),
            references: references
                .map(|&(place, piece)| (inputs(place, &whole), piece))
                .collect(),
        }
    }
}

impl Learning for Course<'_> {
    fn stage(&self) -> &'static str {
        STAGE
    }

    fn origin(&self) -> Origin<'_> {
        Origin {
            hash: self.hash(),
            is_generated: false,
            sides: vec![Side {
                prefix: "",
                weights: self.initial.clone(),
                averaging: self.settings.averaging,
            }],
            // A sample of an epoch is a group of presses.
            samples: self.lots.tickets(),
            held_out: self.held_out,
            batch: (self.settings.batch / lots::GROUP).max(1),
            epochs: self.settings.epochs,
            optimiser: self.settings.optimiser,
            checkpoint_every_epochs: self.settings.checkpoint_every_epochs,
            validated_every_epochs: self.validated_every_epochs,
            seed: self.seed,
        }
    }

    /// Takes a step on groups of presses. The presses that were judged rightly are counted in groups.
    fn step(&self, sides: &mut [Learner], batch: Batch) -> anyhow::Result<Taken> {
        let learner = &mut sides[0];
        let mut stream = self.stream("variation").child(batch.step);
        let mut labels: Vec<bins::Label> = Vec::new();
        let mut groups = Vec::with_capacity(batch.samples.len());
        for &ticket in batch.samples {
            let question = self
                .lots
                .draw(ticket, &self.prepared, &self.borders, &mut stream);
            groups.push(self.group(&question, Some(&mut stream)));
            let presses = question.presses.iter().map(|&place| &self.prepared[place]);
            labels.extend(presses.map(|press| match press.piece {
                // A rigid piece is harder than any object.
                Some(_) => (1, None),
                None => (press.level, press.shore),
            }));
        }
        let tracked = learner.weights.tracked();
        let outputs = course::outputs(&tracked, &groups, Some(&mut stream), self.device);
        let (loss, judged) = bins::loss(outputs, &labels, &self.parts);
        let mut gradients = loss.backward();
        learner.step(&tracked, &mut gradients, batch.rate);
        let rows = judged.chunks(self.levels);
        let right = labels
            .iter()
            .zip(rows)
            .filter(|((level, _), row)| argmax(row).0 + 1 == usize::from(*level))
            .count();
        let share = right as f64 / labels.len() as f64;
        Ok(Taken {
            loss: f64::from(numbers(&loss)[0]),
            right: Some(share * batch.samples.len() as f64),
            ..Taken::default()
        })
    }

    fn questions(
        &self,
        presses: &[usize],
        knowledge: Knowledge,
        stream: &mut Stream,
    ) -> Option<Vec<Question>> {
        let lots = Lots::of(&self.prepared, presses);
        let is_askable = knowledge == Knowledge::None || lots.have_references();
        is_askable.then(|| lots.all(knowledge, &self.prepared, &self.borders, stream))
    }

    fn judge(
        &self,
        weights: &[Weights],
        questions: &[Question],
        mut vary: Option<&mut Stream>,
    ) -> Vec<Vec<f32>> {
        let group = |question: &Question| self.group(question, vary.as_deref_mut());
        let groups: Vec<course::Group> = questions.iter().map(group).collect();
        let mut rows = Vec::new();
        for part in groups.chunks(JUDGED_AT_ONCE) {
            let outputs = course::outputs(&weights[0], part, None, self.device);
            rows.extend(numbers(&outputs).chunks(BINS).map(<[f32]>::to_vec));
        }
        rows
    }

    fn outputs(&self) -> Outputs {
        Outputs::Bins {
            lifts: self.lifts.clone(),
            borders: self.borders.clone(),
        }
    }

    fn ranges(&self, learnt: &[Timed]) -> Extents {
        self.reports.ranges(learnt)
    }

    /// A network that met no references in training takes none.
    fn graph(&self, weights: &[Weights]) -> Recogniser {
        let inputs = match self.lots.have_references() {
            true => Inputs::References,
            false => Inputs::Features,
        };
        let (graph, raw) = course::graph(&weights[0], &self.standard, inputs);
        Recogniser { graph, inputs, raw }
    }
}
