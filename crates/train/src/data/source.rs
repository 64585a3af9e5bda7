//! The files that presses are from: what they say of themselves, and whose levels a model states.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use hardnessd_core::frame::{Array, Pitch};
use hardnessd_core::verdict::Level;
use hardnessd_simulator::{LEVELS, LevelRange, Split};

/// The distance between taxels, unless a file names another one.
pub const PITCH_MM: f64 = Pitch::JX255N.rows_mm;
/// The most hardness levels.
pub const MOST_LEVELS: usize = 16;
/// The name of our simulator in `meta.generator`.
pub const SIMULATOR: &str = "hardnessd simulator";
/// The name of `hrn-train collect` in `meta.generator`.
pub const COLLECTOR: &str = "hrn-train collect";

/// The four hardness levels of the paper's Table 1.
pub fn papers_levels() -> Vec<Level> {
    let level = |range: &LevelRange| level(range, range.table);
    LEVELS.iter().map(level).collect()
}

/// A level with its interval of Shore, as it is written in files.
pub(super) fn level(range: &LevelRange, shore: &str) -> Level {
    Level {
        level: range.level,
        label: range.label.to_owned(),
        shore: shore.to_owned(),
    }
}

/// The kind of the presses in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Presses of our simulator.
    Simulated,
    /// Presses of `hrn-train collect`.
    Recorded,
    /// Presses of another program, or of one that the file does not name.
    Unknown,
}

/// A file that presses came from.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Source {
    /// The file's name without its directory.
    pub name: String,
    /// The simulator's seed, if the file names one.
    pub seed: Option<u64>,
    /// SHA-256 of the file.
    pub sha256: String,
    /// The programs that made the file, separated by commas, if it names any.
    pub generator: Option<String>,
    /// Distance between the sensor's taxels, if the file names one.
    pub pitch_mm: Option<f64>,
    /// The least and the greatest distance between the taxels of the file's sensors, if they differ.
    #[serde(skip)]
    pub pitches_mm: Option<[f64; 2]>,
    /// The array whose frames the file has as they are, in the middle of its own.
    #[serde(skip)]
    pub grid: Option<Array>,
    /// The levels that the file states.
    #[serde(skip)]
    pub levels: Option<Vec<Level>>,
    /// The kind of the presses of recorded objects, by number and level.
    #[serde(skip)]
    pub recorded: BTreeMap<(u32, u8), Kind>,
}

impl Source {
    /// The kinds of the presses, in the order of the programs that made them.
    pub fn kinds(&self) -> Vec<Kind> {
        let kind = |generator: &str| match generator {
            _ if generator.starts_with(SIMULATOR) => Kind::Simulated,
            _ if generator.starts_with(COLLECTOR) => Kind::Recorded,
            _ => Kind::Unknown,
        };
        let generators = self.generator.as_deref().unwrap_or_default().split(", ");
        generators.map(kind).collect()
    }

    /// The possible kinds of a press of an object in the file.
    pub(super) fn kinds_of(&self, object: Option<Object>) -> Vec<Kind> {
        let known = object.and_then(|of| self.recorded.get(&(of.number, of.level)));
        if let Some(kind) = known {
            return vec![*kind];
        }
        let mut kinds = self.kinds();
        if kinds.iter().any(|&kind| kind != Kind::Recorded) {
            kinds.retain(|&kind| kind != Kind::Recorded);
        }
        kinds
    }

    /// Adds `before` to the numbers of recorded objects, as to those of the file's presses.
    pub(super) fn shift_objects(&mut self, before: u32) {
        let recorded = std::mem::take(&mut self.recorded).into_iter();
        self.recorded = recorded
            .map(|((object, level), kind)| ((object + before, level), kind))
            .collect();
    }
}

/// A pressed object. Numbers of objects may begin anew for each level, or for each material.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Object {
    /// The object's number.
    pub number: u32,
    /// Index of its material, if the file has materials.
    pub material: Option<u8>,
    /// Its level; 0 if it is not known.
    pub level: u8,
}

impl Object {
    /// Whether both are one object: they have the same number and material, and not two different
    /// levels. An unlabelled one agrees with every level.
    pub fn is_same_as(&self, other: &Self) -> bool {
        let same_level = self.level == other.level || self.level == 0 || other.level == 0;
        self.number == other.number && self.material == other.material && same_level
    }
}

/// The number of an object that has presses in both splits, if there is one.
pub(super) fn object_in_both_splits(presses: impl Iterator<Item = (Object, Split)>) -> Option<u32> {
    let (mut trained, mut tested) = (BTreeSet::new(), BTreeSet::new());
    for (object, split) in presses {
        match split {
            Split::Train => trained.insert(object),
            Split::Test => tested.insert(object),
        };
    }
    let is_tested = |object: &&Object| tested.iter().any(|other| other.is_same_as(object));
    trained.iter().find(is_tested).map(|object| object.number)
}

/// A press as far as its validation is concerned: its file, its object if that is known, its level and its
/// split.
pub(super) type Judged<'a> = (&'a Source, Option<Object>, u8, Split);

/// The kinds of the labelled test presses whose objects were not learnt.
pub(super) fn validated<'a>(presses: impl Iterator<Item = Judged<'a>> + Clone) -> BTreeSet<Kind> {
    let learnt = presses.clone().filter(|press| press.3 == Split::Train);
    let learnt: BTreeSet<Object> = learnt.filter_map(|press| press.1).collect();
    let is_learnt = |object: &Object| learnt.iter().any(|other| other.is_same_as(object));
    // An object has many presses.
    let mut seen = BTreeSet::new();
    let mut kinds = BTreeSet::new();
    for (source, object, level, split) in presses {
        if split == Split::Train || level == 0 {
            continue;
        }
        let is_new = object.is_none_or(|object| seen.insert(object));
        if is_new && !object.as_ref().is_some_and(is_learnt) {
            kinds.extend(source.kinds_of(object));
        }
    }
    kinds
}

/// The levels that a model of these files states: those of the first file that states some, otherwise
/// the paper's.
pub fn levels_of(sources: &[Source]) -> Vec<Level> {
    let mut stated = sources.iter().filter_map(|source| source.levels.clone());
    stated.next().unwrap_or_else(papers_levels)
}

/// Prints a warning for each file that states other levels than the model will.
pub fn warn_of_other_levels(sources: &[Source]) {
    let shown = |levels: &[Level]| {
        let each = levels
            .iter()
            .map(|level| format!("{} {}", level.label, level.shore));
        each.collect::<Vec<_>>().join(", ")
    };
    let ours = levels_of(sources);
    for source in sources {
        if let Some(others) = source.levels.as_ref().filter(|others| **others != ours) {
            hardnessd_core::stderr_line!(
                "warning: {}: levels: found {}, expected {}, which the model will state",
                source.name,
                shown(others),
                shown(&ours)
            );
        }
    }
}

/// Distance between the taxels of the sensor that was pressed, in mm. All sources have the same one.
pub fn pitch_mm(sources: &[Source]) -> f64 {
    let stated = sources.first().and_then(|source| source.pitch_mm);
    stated.unwrap_or(PITCH_MM)
}
