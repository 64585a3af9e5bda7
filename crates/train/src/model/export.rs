//! Exports what was learnt to the file that the daemon loads, and evaluates that file.
//!
//! In: a network with its weights and its calibration, and the presses that it learnt from. Out: `hrn.onnx`,
//! which carries checks that the daemon must reproduce, and `evaluation.json`, which is measured on the
//! loaded file.

use std::collections::BTreeSet;

use anyhow::Context as _;
use serde_json::json;

use super::file;
use super::verdicts::{self, Given, rigid};
use crate::data::presses::Press;
use crate::data::source::{Kind, Source};
use crate::judge::evaluated::Evaluated;
use crate::learn::calibration::Calibration;
use crate::learn::{Inputs, Learning, Outputs, Question, Stage};
use crate::net::graph::Graph;
use crate::net::network::Weights;
use crate::run::{Description, Run};
use hardnessd_core::frame::Pitch;
use hardnessd_core::verdict::{
    Card, Check, CheckedCourse, Checks, CourseCheck, Knowledge, Model, Piece, Range,
    ReferencePress, TAIL, check_line,
};
use hardnessd_simulator::Split;

/// Checks per level (`docs/formats.md`).
const CHECKS_A_LEVEL: usize = 2;

/// What was learnt.
pub struct Learnt<'a> {
    /// The network.
    pub learning: &'a dyn Learning,
    /// The weights of its sides.
    pub weights: &'a [Weights],
    /// The calibration of its verdicts.
    pub calibration: Calibration,
}

/// Writes the model and its evaluation on the test split to the run's directory. The file is loaded once, as
/// the daemon does, which reproduces the checks.
///
/// # Errors
///
/// Fails if the daemon's loader refuses the file, or the directory cannot be written.
pub fn finish(
    learnt: &Learnt,
    run: &Run,
    description: &Description,
) -> anyhow::Result<Option<Evaluated>> {
    let mut card = learnt.card(&description.method, &description.data)?;
    let hrn = Model::load(&learnt.bytes(&card)?)?;
    let presses = learnt.learning.stage().presses;
    let test: Vec<usize> = presses.labelled(Split::Test).collect();
    let cases = verdicts::of(&hrn, presses, &test, Given::USUAL)?;
    let evaluation = (!cases.is_empty()).then(|| Evaluated::of(&cases, &card.levels));
    if let Some(evaluation) = &evaluation {
        card.metrics["test"] = json!(evaluation);
        let json = serde_json::to_vec_pretty(evaluation)?;
        run.write("evaluation.json", &json)?;
    }
    run.write("hrn.onnx", &learnt.bytes(&card)?)?;
    Ok(evaluation)
}

impl Learnt<'_> {
    /// The file with this card.
    ///
    /// # Errors
    ///
    /// Fails if the card cannot be written as JSON.
    pub fn bytes(&self, card: &Card) -> anyhow::Result<Vec<u8>> {
        let graph = self.learning.graph(self.weights);
        let outputs = self.learning.outputs();
        let checks = self.checks(&graph, &outputs);
        let temperature = self.calibration.temperature;
        file::bytes(&graph, &outputs, temperature, card, &checks)
    }

    /// What the file says of itself before it is measured. `sources` are the files of the data.
    ///
    /// # Errors
    ///
    /// Fails if the names of the files cannot be written as JSON.
    pub fn card(&self, method: &str, sources: &[Source]) -> anyhow::Result<Card> {
        let Stage { presses, parts, .. } = self.learning.stage();
        let graph = self.learning.graph(self.weights);
        let mut metrics = json!({ "temperature": self.calibration.temperature });
        let (format, conformal) = match graph.inputs {
            Inputs::Frame | Inputs::Parts(_) => ("1", None),
            Inputs::Features | Inputs::References => {
                if let Some(missing) = self.calibration.missing() {
                    metrics["not_promised"] = json!(missing);
                }
                ("3", self.calibration.conformal())
            }
        };
        let pitches = presses.pitches_mm(&parts.train);
        let grid = match graph.inputs {
            Inputs::Parts(_) => presses.grid(),
            _ => None,
        };
        let range = match grid.filter(|grid| !grid.is_kept()) {
            Some(_) => range(presses.of(&parts.train).filter_map(felt)),
            None => {
                let pitch = Pitch::square(presses.pitch_mm());
                let threshold_n = pitch.contact_threshold_n();
                range(parts.train.iter().map(|&press| {
                    let best = presses.frame(press);
                    let force_n = best.force_n() as f32;
                    ([force_n; 2], best.contact_area_taxels(threshold_n))
                }))
            }
        };
        Ok(Card {
            format: format.to_owned(),
            levels: presses.levels(),
            pitch_mm: grid.map_or(presses.pitch_mm(), |grid| grid.pitch_mm) as f32,
            method: method.to_owned(),
            data: data(sources)?,
            metrics,
            validation: validation(&presses.validated()).to_owned(),
            range: Range {
                pitch_mm: pitches.map(|pitches| pitches.map(|mm| mm as f32)),
                ..range
            },
            grid: grid.map(|grid| grid.array),
            conformal,
        })
    }

    /// Two presses of each level, and what the trainer's network says of them. Of a model that takes
    /// references, every second press has some.
    fn checks(&self, graph: &Graph, outputs: &Outputs) -> Checks {
        let presses = self.learning.stage().presses;
        let places = self.checked();
        let references = match graph.inputs {
            Inputs::References => self.check_references(),
            _ => Vec::new(),
        };
        let is_identified = |number: usize| number % 2 == 1 && !references.is_empty();
        let question = |(number, &press): (usize, &usize)| Question {
            presses: vec![press],
            references: match is_identified(number) {
                true => references.clone(),
                false => Vec::new(),
            },
        };
        let questions: Vec<Question> = places.iter().enumerate().map(question).collect();
        let rows = self.learning.judge(self.weights, &questions, None);
        let temperature = self.calibration.temperature;
        let probabilities = |row: &Vec<f32>| outputs.probabilities(row, temperature);
        if let Inputs::Frame | Inputs::Parts(_) = graph.inputs {
            let newtons = |&press: &usize| match graph.inputs {
                Inputs::Parts(array) => presses.parts(press, array),
                _ => presses.frame(press).newtons.to_vec(),
            };
            return Checks::Frames(Check {
                frames: places.iter().map(newtons).collect(),
                probabilities: rows.iter().map(probabilities).collect(),
            });
        }
        let promised = self.calibration.conformal();
        let tail = |is_identified: bool| {
            let knowledge = match is_identified {
                true => Knowledge::Rigid,
                false => Knowledge::None,
            };
            let limits = promised.as_ref().map(|promised| promised.limits(knowledge));
            limits.map_or(TAIL, |limits| limits.tail)
        };
        let checked = places.iter().zip(&rows).enumerate();
        let checked = checked.map(|(number, (&press, row))| CheckedCourse {
            course: presses.course(press),
            probabilities: probabilities(row),
            shore: outputs.shore(row, temperature, tail(is_identified(number))),
            identified: is_identified(number),
        });
        let references = references.iter();
        Checks::Courses(CourseCheck {
            presses: checked.collect(),
            references: references
                .map(|&(place, piece)| ReferencePress {
                    course: presses.course(place),
                    piece,
                })
                .collect(),
        })
    }

    /// The references of the first sensor that has some.
    fn check_references(&self) -> Vec<(usize, Piece)> {
        let Stage { presses, parts, .. } = self.learning.stage();
        let sensors = presses.of(&parts.train).map(|press| press.sensor);
        let mut seen = BTreeSet::new();
        let new = sensors.filter(|&sensor| seen.insert(sensor));
        let mut of_sensors = new.map(|sensor| rigid(presses, sensor, Given::USUAL));
        of_sensors
            .find(|references| !references.is_empty())
            .unwrap_or_default()
    }

    /// Two training presses of each level: those one third and two thirds through its presses.
    fn checked(&self) -> Vec<usize> {
        let Stage { presses, parts, .. } = self.learning.stage();
        let mut checked = Vec::new();
        for level in presses.levels() {
            let of_level = |&press: &usize| presses.all[press].level == level.level;
            let own: Vec<usize> = parts.train.iter().copied().filter(of_level).collect();
            // A level without its own is checked on those of other levels.
            let own = if own.is_empty() { &parts.train } else { &own };
            for part in 1..=CHECKS_A_LEVEL {
                checked.push(own[own.len() * part / (CHECKS_A_LEVEL + 1)]);
            }
        }
        checked
    }
}

/// The value of `hrn.data`: name, seed and hash of the file, or a list of them for several files.
fn data(sources: &[Source]) -> serde_json::Result<String> {
    let one = |source: &Source| json!({ "name": source.name, "seed": source.seed, "sha256": source.sha256 });
    match sources {
        [source] => serde_json::to_string(&one(source)),
        _ => serde_json::to_string(&sources.iter().map(one).collect::<Vec<_>>()),
    }
}

/// Checks, before anything is learnt, that a model file can name the files of the data.
///
/// # Errors
///
/// Fails if there are too many files, or one has a name that a model file may not have.
pub fn check_sources(sources: &[Source]) -> anyhow::Result<()> {
    check_line("hrn.data", &data(sources)?)
        .context("the model could not name the files of --data: use fewer, or rename them")
}

/// The value of `hrn.validation`. `kinds` are those of the labelled presses that were judged and
/// whose objects were not learnt.
pub(crate) fn validation(kinds: &BTreeSet<Kind>) -> &'static str {
    let [simulated, recorded, unknown] =
        [Kind::Simulated, Kind::Recorded, Kind::Unknown].map(|kind| kinds.contains(&kind));
    match (simulated, recorded, unknown) {
        (false, false, false) => "not validated",
        (true, false, false) => "simulated data only",
        (true, true, false) => "simulated and recorded data",
        (false, true, false) => "recorded data",
        (false, false, _) => "data of unknown origin",
        (_, _, true) => "data partly of unknown origin",
    }
}

/// Force and contact area of a press on an array that is larger than the frames here, as the daemon counts them. Its
/// force was rounded.
fn felt(press: &Press) -> Option<([f32; 2], u32)> {
    let force_n = press.force_n?;
    let force_n = [force_n.next_down(), force_n.next_up()];
    Some((force_n, press.contact_area_taxels?))
}

/// The range of total force and contact area of the training presses. Each has the least and the greatest force that
/// it may have had, and its area.
fn range(presses: impl Iterator<Item = ([f32; 2], u32)>) -> Range {
    let mut range = Range {
        force_n: [f32::INFINITY, 0.0],
        contact_area_taxels: [u32::MAX, 0],
        pitch_mm: None,
    };
    for ([low_n, high_n], area) in presses {
        range.force_n = [range.force_n[0].min(low_n), range.force_n[1].max(high_n)];
        let [least, most] = range.contact_area_taxels;
        range.contact_area_taxels = [least.min(area), most.max(area)];
    }
    range
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::presses::Presses;

    #[test]
    fn a_model_is_validated_by_what_judged_it_and_it_did_not_learn() {
        let press = |object: Option<u32>, level, kind, split| Press {
            level,
            object,
            kind,
            split,
            ..Press::default()
        };
        let [simulated, recorded, unknown] = [Kind::Simulated, Kind::Recorded, Kind::Unknown];
        let test = |object, level, kind| press(object, level, kind, Split::Test);
        let learnt = press(Some(1), 1, simulated, Split::Train);
        for (judged, expected) in [
            (vec![], "not validated"),
            (vec![test(Some(4), 0, simulated)], "not validated"),
            (vec![test(Some(1), 1, recorded)], "not validated"),
            (vec![test(Some(4), 1, simulated)], "simulated data only"),
            (vec![test(Some(2), 1, recorded)], "recorded data"),
            (
                vec![test(Some(2), 1, recorded), test(Some(4), 1, simulated)],
                "simulated and recorded data",
            ),
            (vec![test(None, 1, unknown)], "data of unknown origin"),
            (
                vec![test(Some(2), 1, recorded), test(None, 1, unknown)],
                "data partly of unknown origin",
            ),
        ] {
            let mut presses = Presses::default();
            presses.all = [vec![learnt.clone()], judged].concat();
            assert_eq!(validation(&presses.validated()), expected);
        }
    }
}
