//! Labelled and unlabelled frames, as `.npz` files that numpy reads and writes.
//!
//! In: files, or the simulator's samples. Out: a [`Dataset`], and choices of its samples that keep
//! objects whole. Presses of one object are near-copies, so a model that was chosen by some of an
//! object's frames has practically seen the others.

pub(super) mod file;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::slice;

pub use self::file::{meta, write};
use hardnessd_core::frame::{Frame, Pitch};
use hardnessd_core::verdict::{Laying, Level, ModelFrame};
use hardnessd_simulator::random::Stream;
use hardnessd_simulator::{LEVELS, LabelledSample, LevelRange, Split};

/// The distance between taxels, unless a file names another one.
pub const PITCH_MM: f64 = Pitch::JX255N.rows_mm;

/// The four hardness levels of the paper's Table 1.
pub fn levels() -> Vec<Level> {
    LEVELS
        .iter()
        .map(|range| level(range, range.table))
        .collect()
}

/// A level with its interval of Shore, as it is written in files.
pub(super) fn level(range: &LevelRange, shore: &str) -> Level {
    Level {
        level: range.level,
        label: range.label.to_owned(),
        shore: shore.to_owned(),
    }
}

/// The levels that a model of these files states: those of the first file that states some, otherwise
/// those of [`levels`].
pub fn levels_of(sources: &[Source]) -> Vec<Level> {
    let mut stated = sources.iter().filter_map(Source::our_levels);
    stated.next().map_or_else(levels, <[Level]>::to_vec)
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
        if let Some(others) = source.our_levels().filter(|others| *others != ours) {
            hardnessd_core::stderr_line!(
                "warning: {}: levels: found {}, expected {}, which the model will state",
                source.name,
                shown(others),
                shown(&ours)
            );
        }
    }
}

/// How the samples are chosen whose labels may be used.
#[derive(
    Debug,
    Clone,
    Copy,
    Default,
    PartialEq,
    Eq,
    clap::ValueEnum,
    serde::Serialize,
    serde::Deserialize,
)]
#[serde(rename_all = "lowercase")]
pub enum LabelChoice {
    /// By whole objects: what labelling some objects gives.
    #[default]
    Object,
    /// Each by itself, so that near-copies of most unlabelled ones are labelled: probably the
    /// paper's way.
    Random,
}

/// The chosen frame of one press, with its labels and measurements.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// The frame in newtons, after tare.
    pub frame: ModelFrame,
    /// The hardness level 1..=4, or 0 for unlabelled.
    pub level: u8,
    /// The number of the pressed object, unique in the data set.
    pub object: Option<u32>,
    /// Index into the file's `meta.materials`.
    pub material: Option<u8>,
    /// Force of the press: the applied force if simulated, the chosen frame's total force if
    /// recorded.
    pub force_n: Option<f32>,
    /// The split: train or test.
    pub split: Split,
    /// Measured Shore hardness.
    pub shore: Option<f32>,
    /// Index of the sample's file in [`Dataset::sources`].
    pub source: usize,
}

/// A frame of the simulated sensor, on the model's grid.
pub fn laid(frame: &Frame) -> ModelFrame {
    Laying::new(frame, Pitch::JX255N, PITCH_MM).lay(frame)
}

impl From<LabelledSample> for Sample {
    fn from(sample: LabelledSample) -> Self {
        Self {
            frame: laid(&sample.frame),
            level: sample.level,
            object: Some(sample.object),
            material: Some(sample.material),
            force_n: Some(sample.force_n),
            split: sample.split,
            shore: Some(sample.shore),
            source: 0,
        }
    }
}

impl Sample {
    /// The pressed object, if the data set says which one it is.
    pub(super) fn pressed(&self) -> Option<Object> {
        Some(Object {
            number: self.object?,
            material: self.material,
            level: self.level,
        })
    }

    /// Whether both samples are of one object.
    pub fn shares_object_with(&self, other: &Self) -> bool {
        let both = self.pressed().zip(other.pressed());
        both.is_some_and(|(one, other)| one.is_same_as(&other))
    }
}

/// A pressed object. Numbers of objects may begin anew for each level, or for each material.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Object {
    pub(super) number: u32,
    pub(super) material: Option<u8>,
    pub(super) level: u8,
}

impl Object {
    /// Whether both are one object: they have the same number and material, and not two different
    /// levels. An unlabelled one agrees with every level.
    pub(super) fn is_same_as(&self, other: &Self) -> bool {
        let same_level = self.level == other.level || self.level == 0 || other.level == 0;
        self.number == other.number && self.material == other.material && same_level
    }
}

/// The number of an object that has presses in both splits, if there is one.
fn object_in_both_splits(presses: impl Iterator<Item = (Object, Split)>) -> Option<u32> {
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

/// Prints a warning if an object of a file has presses in both splits.
pub(super) fn warn_of_object_in_both_splits(
    path: &Path,
    presses: impl Iterator<Item = (Object, Split)>,
) {
    if let Some(object) = object_in_both_splits(presses) {
        hardnessd_core::stderr_line!(
            "warning: {}: object {object} is in both splits: its presses are near-copies, so a test on some \
             of them overrates a model that learnt from the others",
            path.display()
        );
    }
}

/// Objects by source and level. Each object is a list of samples.
type Groups = BTreeMap<(usize, u8), Vec<Vec<usize>>>;

/// A file that samples came from.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize, serde::Deserialize)]
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
    /// The levels that the file states.
    #[serde(skip)]
    pub levels: Option<Vec<Level>>,
    /// The kind of the presses of recorded objects, by number and level.
    #[serde(skip)]
    pub recorded: BTreeMap<(u32, u8), Kind>,
}

/// The name of our simulator in `meta.generator`.
pub const SIMULATOR: &str = "hardnessd simulator";
/// The name of `hrn-train collect` in `meta.generator`.
pub const COLLECTOR: &str = "hrn-train collect";

/// The kind of samples in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// Samples of our simulator.
    Simulated,
    /// Samples of `hrn-train collect`.
    Recorded,
    /// Samples of another program, or of one that the file does not name.
    Unknown,
}

impl Source {
    /// The levels that the file states, if they are as many as those of a model that is trained here.
    fn our_levels(&self) -> Option<&[Level]> {
        let stated = self.levels.as_deref();
        stated.filter(|stated| stated.len() == LEVELS.len())
    }

    /// The kinds of the samples, in the order of the programs that made them.
    pub fn kinds(&self) -> Vec<Kind> {
        let kind = |generator: &str| match generator {
            _ if generator.starts_with(SIMULATOR) => Kind::Simulated,
            _ if generator.starts_with(COLLECTOR) => Kind::Recorded,
            _ => Kind::Unknown,
        };
        let generators = self.generator.as_deref().unwrap_or_default().split(", ");
        generators.map(kind).collect()
    }

    /// Adds `before` to the numbers of recorded objects, as to those of the file's presses.
    fn shift_objects(&mut self, before: u32) {
        let recorded = std::mem::take(&mut self.recorded).into_iter();
        self.recorded = recorded
            .map(|((object, level), kind)| ((object + before, level), kind))
            .collect();
    }
}

/// The possible kinds of a press of an object in one of the files.
fn kinds_of(sources: &[Source], object: Option<Object>) -> Vec<Kind> {
    let known = object.and_then(|of| {
        let mut recorded = sources.iter().map(|source| &source.recorded);
        recorded.find_map(|recorded| recorded.get(&(of.number, of.level)))
    });
    if let Some(kind) = known {
        return vec![*kind];
    }
    let mut kinds: Vec<Kind> = sources.iter().flat_map(Source::kinds).collect();
    if kinds.iter().any(|&kind| kind != Kind::Recorded) {
        kinds.retain(|&kind| kind != Kind::Recorded);
    }
    kinds
}

/// A press as far as its validation is concerned: the files that it may be from, its object if that
/// is known, its level and its split.
pub(super) type Judged<'a> = (&'a [Source], Option<Object>, u8, Split);

/// The kinds of the labelled test presses whose objects were not learnt.
pub(super) fn validated<'a>(presses: impl Iterator<Item = Judged<'a>> + Clone) -> BTreeSet<Kind> {
    let learnt = presses.clone().filter(|press| press.3 == Split::Train);
    let learnt: BTreeSet<Object> = learnt.filter_map(|press| press.1).collect();
    let is_learnt = |object: &Object| learnt.iter().any(|other| other.is_same_as(object));
    // An object has many presses.
    let mut seen = BTreeSet::new();
    let mut kinds = BTreeSet::new();
    for (sources, object, level, split) in presses {
        if split == Split::Train || level == 0 {
            continue;
        }
        let is_new = object.is_none_or(|object| seen.insert(object));
        if is_new && !object.as_ref().is_some_and(is_learnt) {
            kinds.extend(kinds_of(sources, object));
        }
    }
    kinds
}

/// Samples of one or several files.
#[derive(Debug, Clone, PartialEq)]
pub struct Dataset {
    /// The samples, in the order of the files.
    pub samples: Vec<Sample>,
    /// The files.
    pub sources: Vec<Source>,
    /// The paths of the files.
    pub paths: Vec<PathBuf>,
}

/// The reason that a file is not a data set.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The file is missing or unreadable.
    #[error("{}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The file is not a zip archive of arrays.
    #[error("{}: not an .npz file, or a damaged one", path.display())]
    NotNpz {
        /// The file.
        path: PathBuf,
    },
    /// The file has presses over time where single frames are needed.
    #[error(
        "{}: has whole presses, not single frames: make it without --sequences (`train --method \
         course` takes whole presses)",
        path.display()
    )]
    WholePresses {
        /// The file.
        path: PathBuf,
    },
    /// The file has single frames where presses over time are needed.
    #[error(
        "{}: has single frames, not whole presses: make it with `simulate --sequences` or \
         `collect --sequences`",
        path.display()
    )]
    SingleFrames {
        /// The file.
        path: PathBuf,
    },
    /// An array is missing, or has another type, shape or content than expected.
    #[error("{}: array `{array}`: found {found}, expected {expected}", path.display())]
    Array {
        /// The file.
        path: PathBuf,
        /// The array's name.
        array: &'static str,
        /// The type, shape or content found.
        found: String,
        /// The type, shape or content expected.
        expected: String,
    },
    /// The split has no labelled sample.
    #[error(
        "{paths}: no sample of the {split} split has a level: add some with `collect --append \
         --split {split} --level L`"
    )]
    EmptySplit {
        /// The file, or files.
        paths: String,
        /// `train` or `test`.
        split: &'static str,
    },
    /// The file has another taxel pitch than the files before it.
    #[error("{}: taxel pitch: found {found} mm, expected {expected} mm, that of {}", path.display(), first.display())]
    Pitch {
        /// The file.
        path: PathBuf,
        /// The file's pitch, in mm.
        found: f64,
        /// The pitch of the files before it, in mm.
        expected: f64,
        /// One of the files before it.
        first: PathBuf,
    },
}

/// Distance between the taxels of the sensor that was pressed, in mm. All sources have the same one.
pub fn pitch_mm(sources: &[Source]) -> f64 {
    let stated = sources.first().and_then(|source| source.pitch_mm);
    stated.unwrap_or(PITCH_MM)
}

/// Files that are joined: their pitch is the same, and their objects stay apart.
#[derive(Debug, Default)]
pub(super) struct Joining {
    /// The files so far.
    pub(super) sources: Vec<Source>,
    paths: Vec<PathBuf>,
    /// The first number after those of their objects.
    next_object: u64,
}

impl Joining {
    /// Adds a file. `last` is the greatest number of its objects. Gives what to add to their numbers.
    pub(super) fn add(
        &mut self,
        mut source: Source,
        path: PathBuf,
        last: Option<u32>,
    ) -> Result<u32, DatasetError> {
        let (found, expected) = (pitch_mm(slice::from_ref(&source)), pitch_mm(&self.sources));
        if let Some(first) = self.paths.first()
            && found != expected
        {
            let first = first.clone();
            return Err(DatasetError::Pitch {
                path,
                found,
                expected,
                first,
            });
        }
        let first = self.next_object;
        self.next_object = last.map_or(first, |last| first + u64::from(last) + 1);
        let before = match u32::try_from(first) {
            Ok(before) if self.next_object <= u64::from(u32::MAX) + 1 => before,
            _ => {
                return Err(DatasetError::Array {
                    path,
                    array: "object",
                    found: last.unwrap_or_default().to_string(),
                    expected: format!(
                        "no number that, after {first} of other files, is beyond {}",
                        u32::MAX
                    ),
                });
            }
        };
        source.shift_objects(before);
        self.sources.push(source);
        self.paths.push(path);
        Ok(before)
    }
}

impl Dataset {
    /// Reads an `.npz` file.
    ///
    /// # Errors
    ///
    /// Returns an error if the file cannot be read, or an array is missing or has another type,
    /// shape or content than `docs/formats.md` says. `object`, `material`, `force`, `shore`,
    /// `split` (then all 0) and `meta` may be missing.
    pub fn read(path: &Path) -> Result<Self, DatasetError> {
        file::parse(&file::read(path)?, path)
    }

    /// Joins several files into one data set. Objects of different files stay apart.
    ///
    /// # Errors
    ///
    /// Returns an error if the sensors of the files have different pitches, or the files have more
    /// objects than a u32 can number.
    pub fn joined(parts: Vec<Self>) -> Result<Self, DatasetError> {
        let (mut samples, mut joining) = (Vec::new(), Joining::default());
        for part in parts {
            let last = part.samples.iter().filter_map(|sample| sample.object).max();
            let source = joining.sources.len();
            let before = joining.add(part.sources[0].clone(), part.path(), last)?;
            samples.extend(part.samples.into_iter().map(|sample| Sample {
                object: sample.object.map(|object| object + before),
                source,
                ..sample
            }));
        }
        Ok(Self {
            samples,
            sources: joining.sources,
            paths: joining.paths,
        })
    }

    /// The kinds of the labelled test samples whose objects were not learnt.
    pub fn validated(&self) -> BTreeSet<Kind> {
        let judged = |sample: &Sample| {
            let source = slice::from_ref(&self.sources[sample.source]);
            (source, sample.pressed(), sample.level, sample.split)
        };
        validated(self.samples.iter().map(judged))
    }

    /// Distance between the taxels of the sensor that was pressed, in mm.
    pub fn pitch_mm(&self) -> f64 {
        pitch_mm(&self.sources)
    }

    /// Prints a warning if an object has samples in both splits.
    pub fn warn_of_object_in_both_splits(&self) {
        let samples = self.samples.iter();
        let presses = samples.filter_map(|sample| Some((sample.pressed()?, sample.split)));
        warn_of_object_in_both_splits(&self.path(), presses);
    }

    /// The path of the first file.
    pub fn path(&self) -> PathBuf {
        self.paths.first().cloned().unwrap_or_default()
    }

    /// Indices of a split's labelled samples.
    ///
    /// # Errors
    ///
    /// Returns an error if the split has no labelled sample.
    pub fn labelled(&self, split: Split) -> Result<Vec<usize>, DatasetError> {
        let wanted = |sample: &Sample| sample.split == split && sample.level > 0;
        let indices: Vec<usize> = (0..self.samples.len())
            .filter(|&index| wanted(&self.samples[index]))
            .collect();
        if indices.is_empty() {
            let paths = self.paths.iter().map(|path| path.display().to_string());
            return Err(DatasetError::EmptySplit {
                paths: paths.collect::<Vec<_>>().join(", "),
                split: split.name(),
            });
        }
        Ok(indices)
    }

    /// The objects of `indices` by source and level, in a random order drawn from `stream`. A
    /// sample without a known object counts as an object of its own.
    fn objects(&self, indices: &[usize], stream: &Stream) -> Groups {
        self.groups(indices, stream, |sample| sample.object)
    }

    fn groups(
        &self,
        indices: &[usize],
        stream: &Stream,
        object_of: impl Fn(&Sample) -> Option<u32>,
    ) -> Groups {
        let mut groups: BTreeMap<(usize, u8), BTreeMap<u64, Vec<usize>>> = BTreeMap::new();
        for &index in indices {
            let sample = &self.samples[index];
            let object = object_of(sample).map_or(u64::MAX - index as u64, u64::from);
            let group = groups.entry((sample.source, sample.level)).or_default();
            group.entry(object).or_default().push(index);
        }
        let shuffled = |(number, (key, objects)): (usize, ((usize, u8), BTreeMap<_, Vec<_>>))| {
            let mut objects: Vec<Vec<usize>> = objects.into_values().collect();
            stream.child(number as u64).shuffle(&mut objects);
            (key, objects)
        };
        groups.into_iter().enumerate().map(shuffled).collect()
    }

    /// The number of the object of each of `indices`, from 0 in the order of their appearance. A
    /// sample without a known object has an object of its own.
    pub fn object_numbers(&self, indices: &[usize]) -> Vec<u32> {
        let mut numbers = BTreeMap::new();
        let number = |&index: &usize| {
            let sample = &self.samples[index];
            let object = sample.object.map_or(u64::MAX - index as u64, u64::from);
            let next = numbers.len() as u32;
            let key = (sample.source, sample.level, sample.material, object);
            *numbers.entry(key).or_insert(next)
        };
        indices.iter().map(number).collect()
    }

    /// Takes `share` of the objects of every source and level out of `indices`. Gives the kept and
    /// the held-out indices, each in the data set's order.
    pub fn hold_out(&self, indices: &[usize], share: f64, seed: u64) -> (Vec<usize>, Vec<usize>) {
        let (mut kept, mut held) = (Vec::new(), Vec::new());
        for objects in self
            .objects(indices, &Stream::new(seed, "held out objects"))
            .values()
        {
            // At least one object stays to learn from.
            let count = (objects.len() as f64 * share).round() as usize;
            let count = count.min(objects.len() - 1);
            held.extend(objects[..count].iter().flatten());
            kept.extend(objects[count..].iter().flatten());
        }
        kept.sort_unstable();
        held.sort_unstable();
        (kept, held)
    }

    /// Chooses `labels` of `indices`, with equal numbers for each level and source. A group with
    /// too few samples gives all of them, and the other groups give more. By object, whole objects
    /// are chosen, except that the last object of each group gives only as many presses as are
    /// still wanted.
    pub fn choose_labelled(
        &self,
        indices: &[usize],
        labels: usize,
        choice: LabelChoice,
        seed: u64,
    ) -> Vec<usize> {
        let stream = Stream::new(seed, "labelled objects");
        let groups = match choice {
            LabelChoice::Object => self.objects(indices, &stream),
            LabelChoice::Random => self.groups(indices, &stream, |_| None),
        };
        let size_of = |objects: &Vec<Vec<usize>>| objects.iter().map(Vec::len).sum();
        let sizes: Vec<usize> = groups.values().map(size_of).collect();
        let mut chosen = Vec::with_capacity(labels);
        for (objects, wanted) in groups.into_values().zip(shares(&sizes, labels)) {
            chosen.extend(objects.into_iter().flatten().take(wanted));
        }
        chosen.sort_unstable();
        chosen
    }
}

/// How many of `labels` each group gives. All groups give the same number, but none more than its
/// size. If `labels` does not divide equally, the first groups that have more give one more.
fn shares(sizes: &[usize], labels: usize) -> Vec<usize> {
    let given = |each: usize| -> usize { sizes.iter().map(|size| each.min(*size)).sum() };
    let each = (0..=labels).take_while(|&each| given(each) <= labels);
    let each = each.last().unwrap_or_default();
    let mut left = labels - given(each);
    let share = |&size: &usize| {
        let one_more = size > each && left > 0;
        left -= usize::from(one_more);
        each.min(size) + usize::from(one_more)
    };
    sizes.iter().map(share).collect()
}

#[cfg(test)]
mod tests;
