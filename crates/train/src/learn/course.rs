//! The network that judges the course of a press.
//!
//! In: presses over time, with the arm's reported motion, and presses that serve as references of
//! their sensors. Out: weights, and logits of the bins of Shore hardness.

use burn::tensor::Tensor;

use self::lots::Lots;
use super::learner::Learner;
use super::{Inputs, Learning, Outputs, Question, Stage, Taken, share_right};
use crate::net::bins::{self, BINS};
use crate::net::course;
use crate::net::graph::Graph;
use crate::net::network::{Weights, numbers};
use crate::net::standard::Standard;
use crate::run::start::Start;
use crate::settings::ArmReports;
use hardnessd_core::verdict::features::{self, FEATURES, FrameFeatures};
use hardnessd_core::verdict::{Borders, Knowledge, ModelError, Moment, TimeSeries};
use hardnessd_simulator::random::Stream;

mod lots;
mod varied;

/// Questions per pass without gradients.
const JUDGED_AT_ONCE: usize = 16;

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
}

/// The network, and what it learns from.
#[derive(Debug)]
pub struct Course<'a> {
    stage: Stage<'a>,
    /// What each press felt like.
    felt: Vec<Felt>,
    lots: Lots<'a>,
    standard: Standard,
    /// The share of each bin that lies in each level.
    parts: Tensor<2>,
    outputs: Outputs,
    initial: Weights,
}

impl<'a> Course<'a> {
    /// A network that starts from random weights, or from those of `start`.
    ///
    /// # Errors
    ///
    /// Fails if the levels are no parts of the scale of Shore hardness.
    pub fn new(mut stage: Stage<'a>, start: Option<&Start>) -> Result<Self, ModelError> {
        // A sample of an epoch is a group of presses.
        stage.training.batch = (stage.training.batch / lots::GROUP).max(1);
        let (presses, train) = (stage.presses, &stage.parts.train);
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
                let standard = Standard::of(FEATURES, rows);
                (course::initial(stage.seed, &stage.device), standard)
            }
        };
        let mut counts = vec![0; levels];
        for press in presses.of(train) {
            counts[usize::from(press.level) - 1] += 1;
        }
        Ok(Self {
            felt,
            lots: Lots::of(presses, borders.clone(), train),
            standard,
            parts: bins::parts(&borders, levels, &stage.device),
            outputs: Outputs::Bins {
                lifts: bins::lifts(&borders, &counts),
                borders,
            },
            initial,
            stage,
        })
    }

    /// The network's inputs for a question.
    fn group(&self, question: &Question, mut vary: Option<&mut Stream>) -> course::Group {
        let reports = self.stage.settings.reports;
        let whole = ArmReports {
            early: 0.0,
            ..reports
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
            presses: presses.map(|&place| inputs(place, &reports)).collect(),
            references: references
                .map(|&(place, piece)| (inputs(place, &whole), piece))
                .collect(),
        }
    }
}

impl Learning for Course<'_> {
    fn stage(&self) -> &Stage<'_> {
        &self.stage
    }

    fn sides(&self) -> Vec<Learner> {
        vec![Learner::fresh(self.initial.clone(), self.stage.training)]
    }

    fn samples(&self) -> Vec<usize> {
        self.lots.tickets()
    }

    /// Takes a step on groups of presses.
    fn step(&self, sides: &mut [Learner], tickets: &[usize], step: u64, rate: f64) -> Taken {
        let learner = &mut sides[0];
        let mut stream = self.stage.stream("variation").child(step);
        let mut labels: Vec<bins::Label> = Vec::new();
        let mut groups = Vec::with_capacity(tickets.len());
        for &ticket in tickets {
            let question = self.lots.draw(ticket, &mut stream);
            groups.push(self.group(&question, Some(&mut stream)));
            let presses = self.stage.presses.of(&question.presses);
            labels.extend(presses.map(|press| match press.reference {
                // A rigid piece is harder than any object.
                Some(_) => (1, None),
                None => (press.level, press.shore),
            }));
        }
        let tracked = learner.weights.tracked();
        let outputs = course::outputs(&tracked, &groups, Some(&mut stream));
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

    fn questions(&self, knowledge: Knowledge, stream: &mut Stream) -> Option<Vec<Question>> {
        let lots = self.lots.with(&self.stage.parts.held_out);
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
            let outputs = course::outputs(&weights[0], part, None);
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
