//! `hrn-train fit`: recordings in, the best model for this robot out.
//!
//! In: recordings of known objects, or data sets. Out: the candidates with what each reaches on objects that it
//! has not met and on later presses, and a model or references, whichever judges these presses best. Nothing is
//! written if no candidate is better than guessing and the daemon would not use the references.

pub mod candidate;
pub mod comparison;
pub mod folds;
pub mod levels;

use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::{Context as _, bail, ensure};
use serde_json::json;

use self::candidate::{Candidate, Entry};
use self::comparison::Comparison;
pub use self::comparison::{Division, Estimate, OfLevel, Report, Row, Wrong};
use self::folds::Fold;
use crate::data::collect::{self, Collection, Settings};
use crate::data::findings;
use crate::data::presses::{Layout, Presses, read_one};
use crate::data::source::{Source, papers_levels};
use crate::exit::unreadable;
use crate::model::export::{Learnt, validation};
use crate::progress;
use hardnessd_core::references;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::Level;
use hardnessd_simulator::Split;
use hardnessd_simulator::random::Stream;

/// The fewest objects, and presses of each.
const LEAST: [usize; 2] = [3, 2];
/// A press that took less than this share of the median time of its object's presses is a piece of one.
const LEAST_SHARE: f32 = 1.0 / 3.0;
/// The seed of everything random.
const SEED: u64 = 1;
/// The name of the control.
const UNLOADED: &str = "the unloaded sensor alone";

/// A file for the daemon.
#[derive(Debug)]
pub enum Written {
    /// An ONNX model.
    Model(Vec<u8>),
    /// References for the built-in model, unless the daemon would not use them, and its levels where they
    /// are not its own.
    References(Option<Vec<u8>>, Option<Vec<Level>>),
}

/// Compares the candidates and makes the best one of the recordings, directories of recordings, and data sets that
/// `data` names. `sensor` is that of recordings that do not describe their own. `levels` are those of the labels
/// unless they are given. Nothing is to be written if nothing is better than guessing.
///
/// # Errors
///
/// Fails if the data cannot be used, or have too few objects, presses or levels.
pub fn fit(
    data: &[PathBuf],
    sensor: &Sensor,
    levels: Option<Vec<Level>>,
) -> anyhow::Result<(Report, Option<Written>)> {
    let (presses, mut doubtful) = read(data, sensor, levels)?;
    doubtful.extend(findings::doubtful(&presses)?);
    let tested = presses.labelled(Split::Test).count();
    if tested > 0 {
        doubtful.push(format!("{tested} presses of the split test are not used"));
    }
    let all: Vec<usize> = presses.labelled(Split::Train).collect();
    let once = findings::without_copies(&presses, &all);
    if once.len() < all.len() {
        let copies = all.len() - once.len();
        doubtful.push(format!(
            "{copies} presses are copies of others, and are not used"
        ));
    }
    let places = whole(&presses, &once);
    check(&presses, &places)?;
    let candidates = candidate::all(&presses, &places)?;
    let control = candidate::unloaded(&presses, &places);
    let divisions = [
        folds::by_object(&presses, &places),
        folds::by_time(&presses, &places),
    ];
    let usable = candidates.iter().filter(|(_, candidate)| candidate.is_ok());
    let an_entry: usize = divisions.iter().flatten().map(Vec::len).sum();
    let work = an_entry * (usable.count() + usize::from(control.is_some()));
    let bar = progress::bar("{msg:10} {bar:30} {pos}/{len} fits, {eta} left", work);
    let compare = |name, candidate: Result<&Candidate, &String>| -> anyhow::Result<Row> {
        bar.set_message(name);
        let judge = |folds: &Option<Vec<Fold>>| {
            let (Ok(candidate), Some(folds)) = (candidate, folds) else {
                return Ok(None);
            };
            comparison::judge(candidate, &presses, folds, &bar).map(Some)
        };
        let [new, later] = &divisions;
        let judged = [judge(new)?, judge(later)?];
        Ok(Row::of(name, judged, candidate.err().cloned(), &presses))
    };
    let each = |(name, candidate): &Entry| compare(name, candidate.as_ref());
    let compared: Vec<Row> = candidates.iter().map(each).collect::<anyhow::Result<_>>()?;
    let unloaded = control.ok_or_else(|| "only recordings have it".to_owned());
    let control = compare(UNLOADED, unloaded.as_ref())?;
    bar.finish_and_clear();
    let mut references = None;
    if let Ok(Candidate::BuiltIn(hrn)) = &candidates[0].1 {
        let own = candidate::references(hrn, &presses, &places)?;
        let is_used = !hrn.identified_by(&own)?.1.are_worse();
        references = Some(own).filter(|_| is_used);
    }
    let comparison = Comparison {
        presses: &presses,
        places: &places,
        has_references: references.is_some(),
        candidates: compared,
        control,
    };
    let (mut report, chosen) = comparison.report();
    report.remarks.splice(0..0, doubtful);
    let pieces = once.len() - places.len();
    if pieces > 0 {
        let remark = format!(
            "{pieces} of {} presses are left out, because each took less than a third of the median time of its object's: a \
             light contact that is lost for a moment makes several presses of one",
            once.len()
        );
        report.remarks.insert(0, remark);
    }
    let Some(place) = chosen else {
        return Ok((report, None));
    };
    let (name, Ok(candidate)) = &candidates[place] else {
        return Ok((report, None));
    };
    if let Candidate::BuiltIn(hrn) = candidate {
        let own = references.map(|own| references::write(&own)).transpose()?;
        let levels = hrn.card().levels.clone();
        let levels = Some(levels).filter(|levels| *levels != papers_levels());
        return Ok((report, Some(Written::References(own, levels))));
    }
    let division = report.chosen_by.unwrap_or(Division::NewObjects);
    let judged = report.candidates[place].judged(division);
    let judged = judged.context("the best candidate was judged")?;
    let (learning, weights) = candidate.learnt(&presses, &places)?;
    let mut stream = Stream::new(SEED, "calibration");
    let outputs = learning.outputs();
    let calibration = comparison::calibration(judged, &presses, &outputs, &mut stream);
    let (calibration, by) = match division {
        Division::NewObjects => (calibration, "new objects"),
        // Presses of known objects promise nothing of others.
        Division::LaterPresses => (calibration.without_sets(), "later presses"),
    };
    let learnt = Learnt {
        learning: &*learning,
        weights: &weights,
        calibration,
    };
    let mut card = learnt.card(name, &presses.sources)?;
    let kinds = presses.of(&places).map(|press| press.kind).collect();
    card.validation = format!("{by} of {}", validation(&kinds));
    card.metrics["fit"] = json!(report.candidates);
    let bytes = learnt.bytes(&card)?;
    Ok((report, Some(Written::Model(bytes))))
}

/// Reads the labelled presses, in the order in which they were made, and says what is doubtful about their objects. An
/// object of recordings and of data sets that were collected is the same where its number and level are.
fn read(
    data: &[PathBuf],
    sensor: &Sensor,
    levels: Option<Vec<Level>>,
) -> anyhow::Result<(Presses, Vec<String>)> {
    // What cannot be used is left out, but not a name that is misspelt.
    for path in data {
        std::fs::metadata(path).map_err(|error| unreadable(path, &error))?;
    }
    let paths = collect::captures(data)?;
    let is_set = |path: &PathBuf| collect::is_data_set(path);
    let (sets, recordings): (Vec<PathBuf>, Vec<PathBuf>) = paths.into_iter().partition(is_set);
    let sets = sets.iter().map(|path| read_one(path));
    let sets: Vec<Presses> = sets.collect::<anyhow::Result<_>>()?;
    let layout = Layout::of(sets.is_empty() || sets.iter().any(Presses::are_over_time));
    let mut doubtful = Vec::new();
    if !sets.iter().all(Presses::are_over_time) {
        let text = "some presses are single frames, and the daemon judges whole presses: a model of `features` is then \
                    right less often than the figures say";
        doubtful.push(text.to_owned());
    }
    let mut played = Vec::new();
    collect::recordings(&recordings, sensor, layout, true, |recording| {
        played.push(recording);
        Ok(())
    })?;
    played.sort_by_key(|recording| recording.began);
    let found = played.len();
    played.retain(|recording| !recording.is_unlabelled());
    let unlabelled = found - played.len();
    if unlabelled > 0 {
        doubtful.push(format!(
            "{unlabelled} recordings are left out, because nothing says what was pressed: give them a label `level`"
        ));
    }
    let unnumbered = played.iter().filter(|of| of.is_unnumbered()).count();
    if unnumbered > 0 {
        doubtful.push(format!(
            "{unnumbered} recordings have no label `object`, and each counts as an object of its own: if two are of one \
             object, the figures on new objects are too good"
        ));
    }
    let mut sources = sets.iter().flat_map(|set| &set.sources);
    let stated = sources.find_map(|source| source.levels.clone());
    let levels = match levels.or(stated) {
        Some(levels) => levels,
        None => levels::of_labels(played.iter().map(|recording| &recording.labels))?,
    };
    let mut sources = sets.iter().flat_map(|set| &set.sources);
    let differs = |source: &&Source| {
        let stated = source.levels.as_ref();
        stated.is_some_and(|stated| *stated != levels)
    };
    if let Some(source) = sources.find(differs) {
        bail!(
            "{}: its levels are others than those of the other data or of the configuration",
            source.path.display()
        );
    }
    let settings = Settings {
        levels,
        level: None,
        object: None,
        is_one_object: false,
        split: Split::Train,
    };
    let mut collection = Collection::default();
    for recording in played {
        collection.add(recording, &settings)?;
    }
    let is_collected = |set: &Presses| set.sources.iter().all(Source::is_collected);
    let (collected, others): (Vec<Presses>, Vec<Presses>) =
        sets.into_iter().partition(is_collected);
    for set in collected {
        collection.add_set(set)?;
    }
    let mut all = collection.into_presses(&settings.levels);
    // One object may be of two materials where one recording does not name its own.
    all.all.iter_mut().for_each(|press| press.material = None);
    if others.len() > 1 {
        let text = "objects of different data sets count as different ones: if they are not, the figures on new objects \
                    are too good";
        doubtful.push(text.to_owned());
    }
    for set in others {
        all.join(set)?;
    }
    for source in &mut all.sources {
        source.levels = Some(settings.levels.clone());
    }
    Ok((all, doubtful))
}

/// The presses that are no pieces of one. Where the contact is light, it is lost and felt again.
fn whole(presses: &Presses, places: &[usize]) -> Vec<usize> {
    let seconds = |place: &usize| {
        let moments = presses.course(*place).moments;
        moments.last().map_or(0.0, |moment| moment.time_s)
    };
    let objects = presses.by_object(places).into_values();
    let whole = objects.flat_map(|mut own| {
        let mut times: Vec<f32> = own.iter().map(seconds).collect();
        times.sort_by(f32::total_cmp);
        let least = LEAST_SHARE * times[times.len() / 2];
        own.retain(|place| seconds(place) >= least);
        own
    });
    let mut whole: Vec<usize> = whole.collect();
    whole.sort_unstable();
    whole
}

/// Refuses data with too little to learn from.
fn check(presses: &Presses, places: &[usize]) -> anyhow::Result<()> {
    let [least_objects, least_presses] = LEAST;
    let objects = presses.by_object(places);
    let enough = objects.values().filter(|own| own.len() >= least_presses);
    let enough = enough.count();
    ensure!(
        enough >= least_objects,
        "found {} labelled presses of {} objects, {enough} of them with {least_presses} presses or more; expected \
         {least_objects} such objects: press more of them",
        places.len(),
        objects.len()
    );
    let count = presses.levels().len();
    let found: BTreeSet<u8> = presses.of(places).map(|press| press.level).collect();
    if let Some(level) = found.iter().find(|&&level| usize::from(level) > count) {
        anyhow::bail!(
            "found a press of level {level}, and {count} levels: name all of them in [[level]] tables of --config"
        );
    }
    ensure!(
        found.len() > 1,
        "all presses are of one level: press objects of another level too"
    );
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::presses::Press;

    #[test]
    fn a_press_much_shorter_than_its_objects_others_is_left_out() {
        let mut presses = Presses::default();
        // The objects are pressed in turn.
        for lengths in [[20, 8, 1], [21, 8, 1], [6, 8, 1], [40, 3, 1]] {
            for (object, length) in (0..).zip(lengths) {
                let press = Press {
                    level: 1,
                    object: Some(object),
                    ..Press::default()
                };
                let moments = (0..length).map(|moment| (0.2 * moment as f32, None, [0.0; 784]));
                presses.push(press, moments);
            }
        }
        let all: Vec<usize> = (0..presses.all.len()).collect();
        let expected: Vec<usize> = all
            .iter()
            .copied()
            .filter(|place| ![6, 10].contains(place))
            .collect();
        assert_eq!(whole(&presses, &all), expected);
    }
}
