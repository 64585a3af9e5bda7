//! Exports a trained recogniser to the file that the daemon loads, and evaluates that file.
//!
//! In: a graph with its temperature, the data it learnt from, and a function that computes its
//! probabilities as training does. Out: `hrn.onnx`, which carries check frames that the daemon must
//! reproduce, and `evaluation.json`, which is measured on the exported file.

use std::collections::BTreeSet;

use anyhow::ensure;
use serde_json::json;

use super::evaluated::{Case, Evaluated};
use super::file;
use crate::data::dataset::{self, Dataset, Kind, Source};
use crate::net::graph::Graph;
use crate::run::{Description, Run};
use hardnessd_core::press;
use hardnessd_core::verdict::{Card, Check, Checks, Hrn, ModelFrame, Range};
use hardnessd_simulator::Split;

/// Check frames or presses per level (`docs/formats.md`).
const CHECKS_A_LEVEL: usize = 2;

/// A recogniser as a graph.
#[derive(Debug, Clone)]
pub struct Recogniser {
    /// The graph from newtons to logits.
    pub graph: Graph,
    /// Name of the logits in the graph, before temperature.
    pub raw_logits: String,
    /// Name of the Shore hardness in the graph, if it has one.
    pub shore: Option<String>,
    /// The divisor of the logits.
    pub temperature: f32,
}

/// Writes the model and its evaluation on the test split to the run's directory. `train` are the
/// training samples, and `probabilities` computes the probabilities of frames without the file.
///
/// # Errors
///
/// Fails if the daemon's loader refuses the file, or the directory cannot be written.
pub fn finish(
    run: &Run,
    description: &Description,
    dataset: &Dataset,
    train: &[usize],
    recogniser: &Recogniser,
    probabilities: impl Fn(&[&ModelFrame]) -> anyhow::Result<Vec<Vec<f32>>>,
) -> anyhow::Result<Option<Evaluated>> {
    let frames = check_frames(dataset, train);
    let checks = Checks::Frames(Check {
        probabilities: probabilities(&frames)?,
        frames: frames.iter().map(|frame| frame.newtons.to_vec()).collect(),
    });
    let mut card = Card {
        format: "1".to_owned(),
        levels: dataset::levels_of(&description.data),
        pitch_mm: dataset.pitch_mm() as f32,
        method: description.method.clone(),
        data: data(&description.data)?,
        metrics: metrics(recogniser.temperature),
        validation: validation(&dataset.validated()).to_owned(),
        range: range(train.iter().map(|&index| dataset.samples[index].frame)),
        conformal: None,
    };
    let write = |card: &Card| {
        let Recogniser {
            graph,
            raw_logits,
            shore,
            temperature,
            ..
        } = recogniser.clone();
        let outputs = file::Outputs::Levels { raw_logits, shore };
        file::write(graph, &outputs, temperature, card, &checks)
    };
    // The metrics are measured on a file without them and then added; the graph does not change.
    let hrn = Hrn::load(&write(&card)?)?;
    let evaluation = match dataset.labelled(Split::Test) {
        Ok(test) => Some(evaluate(&hrn, dataset, &test)?),
        Err(_) => None,
    };
    if let Some(evaluation) = &evaluation {
        card.metrics["test"] = json!(evaluation.levels);
        if dataset.sources.len() > 1 {
            card.metrics["test_by_source"] = evaluations_by_source(&hrn, dataset)?;
        }
        let json = serde_json::to_vec_pretty(evaluation)?;
        run.write("evaluation.json", &json)?;
    }
    run.write("hrn.onnx", &write(&card)?)?;
    Ok(evaluation)
}

/// What a file says of itself before it is measured.
pub fn metrics(temperature: f32) -> serde_json::Value {
    json!({ "temperature": temperature })
}

/// Judges samples with a model and evaluates its verdicts.
///
/// # Errors
///
/// Fails if the model has fewer levels than the data, or fails to judge a frame.
pub fn evaluate(hrn: &Hrn, dataset: &Dataset, indices: &[usize]) -> anyhow::Result<Evaluated> {
    let cases = cases(hrn, dataset, indices)?;
    Ok(Evaluated::of(&cases, hrn.card().levels.len()))
}

/// Judges labelled samples with a model.
///
/// # Errors
///
/// Fails if the model has fewer levels than the data, or fails to judge a frame.
pub fn cases(hrn: &Hrn, dataset: &Dataset, indices: &[usize]) -> anyhow::Result<Vec<Case>> {
    let levels = hrn.card().levels.len();
    let case = |&index: &usize| {
        let sample = &dataset.samples[index];
        ensure!(
            usize::from(sample.level) <= levels,
            "the model has {levels} levels, and the data has a sample of level {}",
            sample.level
        );
        Ok(Case {
            level: sample.level,
            shore: sample.shore.filter(|shore| shore.is_finite()),
            object: sample.object,
            verdict: hrn.judge(&sample.frame)?,
        })
    };
    indices.iter().map(case).collect()
}

fn evaluations_by_source(hrn: &Hrn, dataset: &Dataset) -> anyhow::Result<serde_json::Value> {
    let mut by_source = serde_json::Map::new();
    let test = dataset.labelled(Split::Test)?;
    for (number, source) in dataset.sources.iter().enumerate() {
        let of_source = |index: &usize| dataset.samples[*index].source == number;
        let indices: Vec<usize> = test.iter().copied().filter(of_source).collect();
        if !indices.is_empty() {
            let evaluation = serde_json::to_value(evaluate(hrn, dataset, &indices)?.levels)?;
            by_source.insert(source.name.clone(), evaluation);
        }
    }
    Ok(by_source.into())
}

/// The frames of the [`checked`] samples.
pub(super) fn check_frames<'a>(dataset: &'a Dataset, train: &[usize]) -> Vec<&'a ModelFrame> {
    let checked = checked(train, |index| dataset.samples[index].level);
    let frames = checked.into_iter();
    frames.map(|index| &dataset.samples[index].frame).collect()
}

/// Two indices of each level: those one third and two thirds through its samples or presses.
pub(super) fn checked(train: &[usize], level_of: impl Fn(usize) -> u8) -> Vec<usize> {
    let mut checked = Vec::new();
    for level in dataset::levels() {
        let of_level = |&index: &usize| level_of(index) == level.level;
        let own: Vec<usize> = train.iter().copied().filter(of_level).collect();
        // A level without its own is checked on those of other levels.
        let own = if own.is_empty() { train } else { &own };
        for part in 1..=CHECKS_A_LEVEL {
            checked.push(own[own.len() * part / (CHECKS_A_LEVEL + 1)]);
        }
    }
    checked
}

/// The value of `hrn.data`: name, seed and hash of the file, or a list of them for several files.
pub(super) fn data(sources: &[Source]) -> serde_json::Result<String> {
    let one = |source: &Source| json!({ "name": source.name, "seed": source.seed, "sha256": source.sha256 });
    match sources {
        [source] => serde_json::to_string(&one(source)),
        _ => serde_json::to_string(&sources.iter().map(one).collect::<Vec<_>>()),
    }
}

/// The value of `hrn.validation`. `kinds` are those of the labelled presses that were judged and
/// whose objects were not learnt.
pub(super) fn validation(kinds: &BTreeSet<Kind>) -> &'static str {
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

/// The range of total force and contact area of the training frames.
pub(super) fn range(frames: impl Iterator<Item = ModelFrame>) -> Range {
    let threshold_n = press::Thresholds::default().contact_threshold_n;
    let mut range = Range {
        force_n: [f32::INFINITY, 0.0],
        contact_area_taxels: [u32::MAX, 0],
        pitch_mm: None,
        ..Range::ANY
    };
    for frame in frames {
        let (force_n, area) = (
            frame.force_n() as f32,
            frame.contact_area_taxels(threshold_n),
        );
        range.force_n = [range.force_n[0].min(force_n), range.force_n[1].max(force_n)];
        let [least, most] = range.contact_area_taxels;
        range.contact_area_taxels = [least.min(area), most.max(area)];
    }
    range
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::data::dataset::Sample;

    #[test]
    fn a_model_is_validated_by_what_judged_it_and_it_did_not_learn() {
        let sample = |object: Option<u32>, level, split| Sample {
            frame: ModelFrame::default(),
            level,
            object,
            material: None,
            force_n: None,
            split,
            shore: None,
            source: 0,
        };
        let (train, test) = (Split::Train, Split::Test);
        let learnt = sample(Some(1), 1, train);
        let recorded = BTreeMap::from([((2, 1), Kind::Recorded), ((3, 1), Kind::Simulated)]);
        let both = Some("hardnessd simulator 0.2.0, hrn-train collect 0.2.0");
        for (generator, judged, expected) in [
            (both, vec![], "not validated"),
            (both, vec![sample(Some(4), 0, test)], "not validated"),
            (both, vec![sample(Some(1), 1, test)], "not validated"),
            (both, vec![sample(Some(4), 1, test)], "simulated data only"),
            (both, vec![sample(Some(3), 1, test)], "simulated data only"),
            (both, vec![sample(Some(2), 1, test)], "recorded data"),
            (
                both,
                vec![sample(Some(2), 1, test), sample(Some(4), 1, test)],
                "simulated and recorded data",
            ),
            (
                Some("hrn-train collect 0.2.0"),
                vec![sample(None, 1, test)],
                "recorded data",
            ),
            (None, vec![sample(None, 1, test)], "data of unknown origin"),
            (
                Some("finite elements"),
                vec![sample(None, 1, test)],
                "data of unknown origin",
            ),
            (
                None,
                vec![sample(Some(2), 1, test), sample(None, 1, test)],
                "data partly of unknown origin",
            ),
        ] {
            let dataset = Dataset {
                samples: [vec![learnt.clone()], judged].concat(),
                sources: vec![Source {
                    generator: generator.map(str::to_owned),
                    recorded: recorded.clone(),
                    ..Source::default()
                }],
                paths: Vec::new(),
            };
            assert_eq!(validation(&dataset.validated()), expected, "{generator:?}");
        }
    }
}
