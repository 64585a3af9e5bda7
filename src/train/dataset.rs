//! Labelled and unlabelled frames, as `.npz` files that numpy reads and writes.
//!
//! In: files, or the simulator's samples. Out: a [`Dataset`], and choices of its samples that do
//! not cut objects in two: presses of one object are near-copies, so a model chosen by some of
//! an object's frames has as good as seen the others.

mod file;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

pub use self::file::{meta, write};
use crate::frame::Frame;
use crate::random::Stream;
use crate::simulator::{LabelledSample, Split};
use crate::verdict::Level;

/// Distance between the sensor's taxels (paper, "Tactile sensor").
pub const PITCH_MM: f32 = 3.5;

/// The four hardness levels of the paper's Table 1.
pub fn levels() -> Vec<Level> {
    let level = |(index, (label, shore)): (usize, (&str, &str))| Level {
        level: index as u8 + 1,
        label: label.to_owned(),
        shore: shore.to_owned(),
    };
    [
        ("hard", ">70"),
        ("firm", "61-70"),
        ("soft", "51-60"),
        ("very-soft", "<=50"),
    ]
    .into_iter()
    .enumerate()
    .map(level)
    .collect()
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

/// One press's chosen frame and what is known of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// Newtons, after tare.
    pub frame: Frame,
    /// 1..=4, or 0: unlabelled.
    pub level: u8,
    /// What was pressed; unique in the data set.
    pub object: Option<u32>,
    /// Index into the file's `meta.materials`.
    pub material: Option<u8>,
    /// Force of the press.
    pub force_n: Option<f32>,
    /// Train or test.
    pub split: Split,
    /// Measured Shore hardness.
    pub shore: Option<f32>,
    /// Which of [`Dataset::sources`] it came from.
    pub source: usize,
}

impl From<LabelledSample> for Sample {
    fn from(sample: LabelledSample) -> Self {
        Self {
            frame: sample.frame,
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

/// By source and level: a list of objects, each a list of samples.
type Groups = BTreeMap<(usize, u8), Vec<Vec<usize>>>;

/// A file that samples came from.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Source {
    /// The file's name without its directory.
    pub name: String,
    /// The simulator's seed, where the file tells one.
    pub seed: Option<u64>,
    /// SHA-256 of the file.
    pub sha256: String,
    /// What made it, where the file tells.
    pub generator: Option<String>,
}

/// What our simulator calls itself in `meta.generator`.
pub const SIMULATOR: &str = "hardnessd simulator";

impl Source {
    /// Whether our simulator made it.
    pub fn is_simulated(&self) -> bool {
        self.generator
            .as_deref()
            .is_some_and(|generator| generator.starts_with(SIMULATOR))
    }
}

/// Samples of one or several files.
#[derive(Debug, Clone, PartialEq)]
pub struct Dataset {
    /// In the files' order.
    pub samples: Vec<Sample>,
    /// The files.
    pub sources: Vec<Source>,
}

/// Why a file is no data set.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// Missing or unreadable.
    #[error("{}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// Not a zip archive of arrays.
    #[error("{}: not an .npz file: {reason}", path.display())]
    NotNpz {
        /// The file.
        path: PathBuf,
        /// What the reader said.
        reason: String,
    },
    /// An array is missing or not as agreed.
    #[error("{}: array `{array}`: found {found}, expected {expected}", path.display())]
    Array {
        /// The file.
        path: PathBuf,
        /// Its name.
        array: &'static str,
        /// As it is.
        found: String,
        /// As it should be.
        expected: String,
    },
    /// Nothing to work on.
    #[error("{}: the {split} split has no {kind} samples", path.display())]
    EmptySplit {
        /// The file, or files.
        path: PathBuf,
        /// `train` or `test`.
        split: &'static str,
        /// `labelled`, or empty for any.
        kind: &'static str,
    },
}

impl Dataset {
    /// Reads an `.npz` file.
    ///
    /// # Errors
    ///
    /// If the file cannot be read, or an array is missing or of another type, shape or content
    /// than agreed. `object`, `material`, `force`, `shore`, `split` (then all 0) and `meta` may
    /// be missing.
    pub fn read(path: &Path) -> Result<Self, DatasetError> {
        let bytes = file::read(path)?;
        let name = path
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        file::parse(&bytes, path, name)
    }

    /// Several files as one data set; their objects stay apart.
    #[must_use]
    pub fn joined(parts: Vec<Self>) -> Self {
        let mut all = Self {
            samples: Vec::new(),
            sources: Vec::new(),
        };
        let mut first_object = 0;
        for part in parts {
            let source = all.sources.len();
            let last = part.samples.iter().filter_map(|sample| sample.object).max();
            all.samples
                .extend(part.samples.into_iter().map(|sample| Sample {
                    object: sample.object.map(|object| object + first_object),
                    source,
                    ..sample
                }));
            all.sources.extend(part.sources);
            first_object += last.map_or(0, |object| object + 1);
        }
        all
    }

    /// Indices of a split's labelled samples.
    ///
    /// # Errors
    ///
    /// If there is none.
    pub fn labelled(&self, split: Split) -> Result<Vec<usize>, DatasetError> {
        let wanted = |sample: &Sample| sample.split == split && sample.level > 0;
        let indices: Vec<usize> = (0..self.samples.len())
            .filter(|&index| wanted(&self.samples[index]))
            .collect();
        if indices.is_empty() {
            let names: Vec<&str> = self
                .sources
                .iter()
                .map(|source| source.name.as_str())
                .collect();
            return Err(DatasetError::EmptySplit {
                path: names.join(", ").into(),
                split: if split == Split::Train {
                    "train"
                } else {
                    "test"
                },
                kind: "labelled",
            });
        }
        Ok(indices)
    }

    /// The objects of `indices` by source and level, in a random order of `stream`'s. A sample of
    /// no known object stands for itself.
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

    /// Takes `share` of the objects of every source and level out of `indices`: what is kept,
    /// and what is held out, each in the data set's order.
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

    /// Chooses `labels` of `indices`, equally many a level (and source). By object, whole ones
    /// are taken, and of the last of each level only as many presses as are still wanted.
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
        let group_count = groups.len();
        let mut chosen = Vec::with_capacity(labels);
        for (number, objects) in groups.into_values().enumerate() {
            // The first groups take one more where the number does not divide.
            let wanted = labels / group_count + usize::from(number < labels % group_count);
            chosen.extend(objects.into_iter().flatten().take(wanted));
        }
        chosen.sort_unstable();
        chosen
    }
}

#[cfg(test)]
mod tests;
