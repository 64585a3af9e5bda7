//! The network that judges the course of a press.
//!
//! In: presses over time, with the arm's reported motion, and presses that serve as references of
//! their sensors. Out: weights, and logits of the bins of Shore hardness.

use burn::tensor::{Device, Tensor};

use self::lots::Lots;
use super::learner::Learner;
use super::{Inputs, Learning, Outputs, Plan, Question, Taken, share_right};
use crate::data::presses::Presses;
use crate::data::split::Parts;
use crate::net::bins::{self, BINS};
use crate::net::course;
use crate::net::graph::Graph;
use crate::net::network::{Weights, numbers};
use crate::net::standard::Standard;
use crate::run::start::Start;
use crate::settings::{ArmReports, Settings, Training};
use hardnessd_core::verdict::features::{self, FEATURES, FrameFeatures};
use hardnessd_core::verdict::{Borders, Knowledge, ModelError, Moment, TimeSeries};
use hardnessd_simulator::random::Stream;

mod lots;
mod varied;

/// Questions per pass without gradients.
const JUDGED_AT_ONCE: usize = 16;
/// The name of the stage.
const STAGE: &str = "course";

/// What a press felt like.
#[derive(Debug, Clone, PartialEq)]
pub struct Felt {
    /// Features, time and approach of each frame, from the one that began the press.
    pub moments: Vec<Moment<FrameFeatures>>,
    /// Stiffness of the arm in N/mm; 0 if unknown.
    pub arm_n_per_mm: f32,
}

impl Felt {
    fn of(course: &TimeSeries) -> Self {
        let features = |moment: &Moment| moment.map(features::of_frame);
        Self {
            moments: course.moments.iter().map(features).collect(),
            arm_n_per_mm: course.arm_n_per_mm,
        }
    }

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
}

/// The network, and what it learns from.
#[derive(Debug)]
pub struct Course<'a> {
    presses: &'a Presses,
    /// What each of them felt like.
    felt: Vec<Felt>,
    held_out: &'a [usize],
    lots: Lots<'a>,
    standard: Standard,
    /// The share of each bin that lies in each level.
    parts: Tensor<2>,
    outputs: Outputs,
    initial: Weights,
    reports: ArmReports,
    training: Training,
    seed: u64,
    device: &'a Device,
}

impl<'a> Course<'a> {
    /// A network that learns from the presses `train`. It starts from random weights, or from those of `start`.
    ///
    /// # Errors
    ///
    /// Fails if the levels are no parts of the scale of Shore hardness.
    pub fn new(
        presses: &'a Presses,
        Parts {
            train, held_out, ..
        }: &'a Parts,
        settings: &Settings,
        seed: u64,
        start: Option<&Start>,
        device: &'a Device,
    ) -> Result<Self, ModelError> {
        let stated = presses.levels();
        let (borders, levels) = (Borders::of(&stated)?, stated.len());
        let felt = (0..presses.all.len()).map(|place| Felt::of(&presses.course(place)));
        let felt: Vec<Felt> = felt.collect();
        let (initial, standard) = match start {
            Some(start) => (start.weights.clone(), start.standard.clone()),
            None => {
                let rows = train.iter().map(|&place| felt[place].features());
                let rows: Vec<[f32; FEATURES]> = rows.collect();
                let rows = rows.iter().map(<[f32; FEATURES]>::as_slice);
                (course::initial(seed, device), Standard::of(FEATURES, rows))
            }
        };
        let mut counts = vec![0; levels];
        for press in presses.of(train) {
            counts[usize::from(press.level) - 1] += 1;
        }
        Ok(Self {
            presses,
            felt,
            held_out,
            lots: Lots::of(presses, borders.clone(), train),
            standard,
            parts: bins::parts(&borders, levels, device),
            outputs: Outputs::Bins {
                lifts: bins::lifts(&borders, &counts),
                borders,
            },
            initial,
            reports: settings.reports,
            training: settings.training,
            seed,
            device,
        })
    }

    fn stream(&self, name: &str) -> Stream {
        Stream::new(self.seed, &format!("{STAGE} {name}"))
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
            let press = &self.felt[place];
            let press = match vary.as_deref_mut() {
                Some(stream) => &reports.varied(press, stream),
                None => press,
            };
            self.standard.row(&press.features())
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

    fn plan(&self) -> Plan {
        Plan {
            sides: vec![Learner::fresh(self.initial.clone(), self.training)],
            // A sample of an epoch is a group of presses.
            samples: self.lots.tickets(),
            held_out: self.presses.with_levels(self.held_out),
            batch: (self.training.batch / lots::GROUP).max(1),
            training: self.training,
            seed: self.seed,
        }
    }

    /// Takes a step on groups of presses.
    fn step(&self, sides: &mut [Learner], tickets: &[usize], step: u64, rate: f64) -> Taken {
        let learner = &mut sides[0];
        let mut stream = self.stream("variation").child(step);
        let mut labels: Vec<bins::Label> = Vec::new();
        let mut groups = Vec::with_capacity(tickets.len());
        for &ticket in tickets {
            let question = self.lots.draw(ticket, &mut stream);
            groups.push(self.group(&question, Some(&mut stream)));
            let presses = self.presses.of(&question.presses);
            labels.extend(presses.map(|press| match press.reference {
                // A rigid piece is harder than any object.
                Some(_) => (1, None),
                None => (press.level, press.shore),
            }));
        }
        let tracked = learner.weights.tracked();
        let outputs = course::outputs(&tracked, &groups, Some(&mut stream), self.device);
        let (loss, judged) = bins::loss(outputs, &labels, &self.parts);
        let mut gradients = loss.backward();
        learner.step(&tracked, &mut gradients, rate);
        let rows = judged.chunks(self.parts.dims()[1]);
        let levels = labels.iter().map(|&(level, _)| level);
        Taken {
            loss: f64::from(numbers(&loss)[0]),
            accuracy: Some(share_right(levels, rows)),
            ..Taken::default()
        }
    }

    fn questions(
        &self,
        presses: &[usize],
        knowledge: Knowledge,
        stream: &mut Stream,
    ) -> Option<Vec<Question>> {
        let lots = self.lots.with(presses);
        let is_askable = knowledge == Knowledge::None || lots.have_references();
        is_askable.then(|| lots.all(knowledge, stream))
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
        self.outputs.clone()
    }

    /// A network that met no references in training takes none.
    fn graph(&self, weights: &[Weights]) -> Graph {
        let inputs = match self.lots.have_references() {
            true => Inputs::References,
            false => Inputs::Features,
        };
        course::graph(&weights[0], &self.standard, inputs)
    }
}
