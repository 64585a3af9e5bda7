//! `hrn-train fit`: recordings in, the best model for this robot out.
//!
//! In: recordings of known objects, or data sets. Out: the candidates with what each reaches on objects that it
//! has not met and on later presses, and a model or references, whichever judges these presses best. Nothing is
//! written unless it is better than guessing.

pub mod candidate;
pub mod comparison;
pub mod folds;
pub mod levels;

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context as _, ensure};
use indicatif::{ProgressBar, ProgressStyle};
use serde_json::json;

use self::candidate::Candidate;
use self::comparison::{Compared, Comparison, Outcome};
pub use self::comparison::{Division, Estimate, OfLevel, Report, Row, Wrong};
use self::folds::Fold;
use crate::data::collect::{self, LeaveOut, Settings, Unnumbered};
use crate::data::presses::{Layout, Presses};
use crate::data::source::papers_levels;
use crate::model::export::{Exported, Learnt, validation};
use hardnessd_core::references;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::{BUILT_IN_HRN, Hrn, Level};
use hardnessd_simulator::Split;
use hardnessd_simulator::random::Stream;

/// The fewest objects, and presses of each.
const LEAST: [usize; 2] = [3, 2];
/// The seed of everything random.
const SEED: u64 = 1;
/// The name of the control.
const UNLOADED: &str = "the unloaded sensor alone";

/// What to learn from.
#[derive(Debug)]
pub struct Request {
    /// Recordings, directories of recordings, and data sets.
    pub data: Vec<PathBuf>,
    /// The sensor of recordings that do not describe their own.
    pub sensor: Sensor,
    /// The levels, if they are not those of the labels.
    pub levels: Option<Vec<Level>>,
}

/// What `fit` found, and what to write.
#[derive(Debug)]
pub struct Fitted {
    /// What was compared.
    pub report: Report,
    /// What to write. `None` if nothing is better than guessing.
    pub written: Option<Written>,
}

/// A file for the daemon.
#[derive(Debug)]
pub enum Written {
    /// An ONNX model.
    Model(Vec<u8>),
    /// References for the built-in model, unless the daemon would not use them, and its levels where they
    /// are not its own.
    References(Option<Vec<u8>>, Option<Vec<Level>>),
}

/// Compares the candidates and makes the best one.
///
/// # Errors
///
/// Fails if the data cannot be used, or have too few objects, presses or levels.
pub fn fit(request: &Request) -> anyhow::Result<Fitted> {
    let presses = read(request)?;
    let places: Vec<usize> = presses.labelled(Split::Train).collect();
    check(&presses, &places)?;
    let candidates = candidate::all(&presses, &places)?;
    let control = candidate::unloaded(&presses, &places);
    let divisions = [
        folds::by_object(&presses, &places, SEED),
        folds::by_time(&presses, &places),
    ];
    let usable = candidates.iter().filter(|(_, candidate)| candidate.is_ok());
    let an_entry: usize = divisions.iter().flatten().map(Vec::len).sum();
    let work = an_entry * (usable.count() + usize::from(control.is_some()));
    let bar = ProgressBar::new(work as u64);
    let style = ProgressStyle::with_template("{msg:10} {bar:30} {pos}/{len} fits, {eta} left");
    bar.set_style(style.expect("the template is right"));
    let compare = |name, candidate: Result<&Candidate, &String>| -> anyhow::Result<Compared> {
        bar.set_message(name);
        let outcome = |folds: &Vec<Fold>| match candidate {
            Ok(candidate) => Outcome::of(candidate, &presses, folds, SEED, &bar).map(Some),
            Err(_) => Ok(None),
        };
        let [new, later] = &divisions;
        let new = new.as_ref().map(outcome).transpose()?.flatten();
        let later = later.as_ref().map(outcome).transpose()?.flatten();
        let left_out = candidate.err().cloned();
        Ok(Compared::of(name, [new, later], left_out, &presses))
    };
    let compared = candidates
        .iter()
        .map(|(name, candidate)| compare(name, candidate.as_ref()));
    let compared: Vec<Compared> = compared.collect::<anyhow::Result<_>>()?;
    let unloaded = control.ok_or_else(|| "only recordings have it".to_owned());
    let control = compare(UNLOADED, unloaded.as_ref())?;
    bar.finish_and_clear();
    let built_in = match &candidates[0].1 {
        Ok(Candidate::BuiltIn(hrn)) => Some(hrn),
        _ => None,
    };
    let references = built_in
        .map(|hrn| candidate::references(hrn, &presses, &places))
        .transpose()?;
    let is_used = match (built_in, &references) {
        (Some(hrn), Some(references)) => !hrn.identified_by(references)?.1.are_worse(),
        _ => false,
    };
    let references = references.filter(|_| is_used);
    let comparison = Comparison {
        presses: &presses,
        places: &places,
        has_references: references.is_some(),
        candidates: compared,
        control,
    };
    let choice = comparison.choice();
    let report = comparison.report(&choice);
    let chosen = choice.writes.map(|place| (place, &candidates[place]));
    let written = match chosen {
        Some((_, (_, Ok(Candidate::BuiltIn(hrn))))) => {
            let own = references.map(|own| references::write(&own)).transpose()?;
            let levels = hrn.card().levels.clone();
            let levels = Some(levels).filter(|levels| *levels != papers_levels());
            Some(Written::References(own, levels))
        }
        Some((place, (name, Ok(candidate)))) => {
            let judged = comparison.candidates[place].outcome(choice.division);
            let judged = judged.context("the best candidate was judged")?;
            let bytes = candidate.learn(&presses, &places, SEED, |learning, weights| {
                let mut stream = Stream::new(SEED, "calibration");
                let calibration = judged.calibration(&presses, &learning.outputs(), &mut stream);
                let learnt = Learnt {
                    learning,
                    weights,
                    calibration: match choice.division {
                        Division::NewObjects => calibration,
                        // Presses of known objects promise nothing of others.
                        Division::LaterPresses => calibration.without_sets(),
                    },
                    presses: &presses,
                    train: &places,
                };
                let mut exported = Exported::of(&learnt, name, &presses.sources)?;
                exported.card.validation = format!(
                    "{} of {}",
                    choice.division.words(),
                    validation(&presses.of(&places).map(|press| press.kind).collect())
                );
                exported.card.metrics["fit"] = json!(report.candidates);
                exported.bytes()
            })?;
            Some(Written::Model(bytes))
        }
        Some((_, (_, Err(_)))) | None => None,
    };
    Ok(Fitted { report, written })
}

/// Reads the labelled presses.
fn read(request: &Request) -> anyhow::Result<Presses> {
    let paths = collect::captures(&request.data)?;
    let (sets, recordings): (Vec<PathBuf>, Vec<PathBuf>) = paths
        .into_iter()
        .partition(|path| collect::is_data_set(path));
    let mut sets = Presses::read(&sets)?;
    let stated = sets.sources.iter().find_map(|source| source.levels.clone());
    let levels = match request.levels.clone().or(stated) {
        Some(levels) => levels,
        None => levels::of_labels(&collect::labels(&recordings))?,
    };
    for source in &mut sets.sources {
        source.levels = Some(levels.clone());
    }
    if recordings.is_empty() {
        return Ok(sets);
    }
    let settings = Settings {
        sensor: request.sensor.clone(),
        hrn: Arc::new(Hrn::load(BUILT_IN_HRN)?),
        levels: levels.clone(),
        level: None,
        object: None,
        unnumbered: Unnumbered::Each,
        split: Split::Train,
        layout: match sets.all.is_empty() || sets.are_over_time() {
            true => Layout::OverTime,
            false => Layout::Frames,
        },
        leave_out: LeaveOut::WithoutPress,
    };
    let collection = collect::collect(&recordings, None, &settings)?;
    collection.say_left_out();
    let mut all = collection.into_presses(&levels);
    all.join(sets)?;
    Ok(all)
}

/// Refuses data with too little to learn from.
fn check(presses: &Presses, places: &[usize]) -> anyhow::Result<()> {
    let [least_objects, least_presses] = LEAST;
    let objects = folds::objects(presses, places);
    let enough = objects
        .values()
        .filter(|own| own.len() >= least_presses)
        .count();
    ensure!(
        enough >= least_objects,
        "found {} labelled presses of {} objects, {enough} of them with {least_presses} presses or more; expected \
         {least_objects} such objects: press more of them",
        places.len(),
        objects.len()
    );
    let count = presses.levels().len();
    let beyond = presses
        .of(places)
        .map(|press| press.level)
        .find(|&level| usize::from(level) > count);
    if let Some(level) = beyond {
        anyhow::bail!("found a press of level {level}, and {count} levels: name all levels");
    }
    let found: BTreeSet<u8> = presses.of(places).map(|press| press.level).collect();
    ensure!(
        found.len() > 1,
        "all presses are of one level: press objects of another level too"
    );
    Ok(())
}
