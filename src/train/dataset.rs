//! Labelled and unlabelled frames, as `.npz` files that numpy reads and writes.
//!
//! In: files, or the simulator's samples. Out: a [`Dataset`], and choices of its samples that do
//! not cut objects in two: presses of one object are near-copies, so a model chosen by some of
//! an object's frames has as good as seen the others.

use std::collections::BTreeMap;
use std::io::{Cursor, Seek, Write};
use std::path::{Path, PathBuf};

use ndarray::{ArrayD, ArrayView, ArrayView1, ArrayView3, Dimension};
use ndarray_npy::{
    NpzReader, NpzWriter, ReadNpyError, ReadNpzError, ReadableElement, WritableElement,
    WriteNpzError,
};

use crate::frame::{COLS, Frame, ROWS, TAXELS};
use crate::random::Stream;
use crate::simulator::{LabelledSample, Split};
use crate::verdict::{Level, sha256_hex};

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
        let bytes = read(path)?;
        let name = path
            .file_name()
            .unwrap_or_default()
            .to_string_lossy()
            .into_owned();
        Self::parse(&bytes, path, name)
    }

    fn parse(bytes: &[u8], path: &Path, name: String) -> Result<Self, DatasetError> {
        let mut file = File::open(bytes, path)?;
        let frames: Vec<f32> = file.read("frames", &[ROWS, COLS], None)?.ok_or_else(|| {
            file.error(
                "frames",
                "none".to_owned(),
                format!("f32 [N,{ROWS},{COLS}]"),
            )
        })?;
        let n = frames.len() / TAXELS;
        if n == 0 {
            return Err(file.error("frames", "no frame".to_owned(), "at least one".to_owned()));
        }
        if let Some(place) = frames.iter().position(|n| !n.is_finite() || *n < 0.0) {
            let found = format!("{} in frame {}", frames[place], place / TAXELS);
            return Err(file.error(
                "frames",
                found,
                "newtons, finite and not below 0".to_owned(),
            ));
        }
        let level: Vec<u8> = file
            .read("level", &[], Some(n))?
            .ok_or_else(|| file.error("level", "none".to_owned(), format!("u8 [{n}]")))?;
        let object: Option<Vec<u32>> = file.read("object", &[], Some(n))?;
        let material: Option<Vec<u8>> = file.read("material", &[], Some(n))?;
        let force: Option<Vec<f32>> = file.read("force", &[], Some(n))?;
        let split: Option<Vec<u8>> = file.read("split", &[], Some(n))?;
        let shore: Option<Vec<f32>> = file.read("shore", &[], Some(n))?;
        let levels = levels().len();
        file.within("level", &level, levels as u8, "0 (unlabelled) to 4")?;
        file.within(
            "split",
            split.as_deref().unwrap_or_default(),
            1,
            "0 (train) or 1 (test)",
        )?;
        let meta = file.meta()?;
        let sample = |index: usize| {
            let mut frame = Frame::default();
            frame
                .newtons
                .copy_from_slice(&frames[index * TAXELS..][..TAXELS]);
            Sample {
                frame,
                level: level[index],
                object: object.as_ref().map(|values| values[index]),
                material: material.as_ref().map(|values| values[index]),
                force_n: force.as_ref().map(|values| values[index]),
                split: match split.as_ref().map_or(0, |values| values[index]) {
                    0 => Split::Train,
                    _ => Split::Test,
                },
                shore: shore.as_ref().map(|values| values[index]),
                source: 0,
            }
        };
        let source = Source {
            name,
            seed: meta["seed"].as_u64(),
            sha256: sha256_hex(bytes),
            generator: meta["generator"].as_str().map(str::to_owned),
        };
        Ok(Self {
            samples: (0..n).map(sample).collect(),
            sources: vec![source],
        })
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

fn read(path: &Path) -> Result<Vec<u8>, DatasetError> {
    std::fs::read(path).map_err(|source| DatasetError::Unreadable {
        path: path.to_owned(),
        source,
    })
}

/// What an `.npz` file says of itself; null if it says nothing.
///
/// # Errors
///
/// If the file cannot be read, or it is no JSON.
pub fn meta(path: &Path) -> Result<serde_json::Value, DatasetError> {
    File::open(&read(path)?, path)?.meta()
}

/// Writes samples as an `.npz` file, compressed: most taxels of a frame are 0.
///
/// # Errors
///
/// Those of writing to `out`.
pub fn write<W: Write + Seek>(
    out: W,
    samples: &[Sample],
    meta: &serde_json::Value,
) -> Result<W, WriteNpzError> {
    let mut npz = NpzWriter::new_compressed(out);
    let n = samples.len();
    let frames: Vec<f32> = samples
        .iter()
        .flat_map(|sample| sample.frame.newtons)
        .collect();
    let shape = "as many values as the shape asks for";
    let frames = ArrayView3::from_shape((n, ROWS, COLS), &frames).expect(shape);
    npz.add_array("frames", &frames)?;
    let level: Vec<u8> = samples.iter().map(|sample| sample.level).collect();
    npz.add_array("level", &ArrayView1::from(&level))?;
    add_optional(&mut npz, "object", samples, |sample| sample.object)?;
    add_optional(&mut npz, "material", samples, |sample| sample.material)?;
    add_optional(&mut npz, "force", samples, |sample| sample.force_n)?;
    let split: Vec<u8> = samples.iter().map(|sample| sample.split as u8).collect();
    npz.add_array("split", &ArrayView1::from(&split))?;
    add_optional(&mut npz, "shore", samples, |sample| sample.shore)?;
    npz.add_array("meta", &ArrayView1::from(meta.to_string().as_bytes()))?;
    npz.finish()
}

/// Adds an array if every sample has a value for it.
fn add_optional<W: Write + Seek, T: WritableElement>(
    npz: &mut NpzWriter<W>,
    name: &str,
    samples: &[Sample],
    value: impl Fn(&Sample) -> Option<T>,
) -> Result<(), WriteNpzError> {
    match samples.iter().map(value).collect::<Option<Vec<T>>>() {
        Some(values) => npz.add_array(name, &ArrayView::from(&values)),
        None => Ok(()),
    }
}

/// An element type that our files may hold.
trait Element: ReadableElement + Clone {
    const NAME: &'static str;
}
impl Element for f32 {
    const NAME: &'static str = "f32";
}
impl Element for u32 {
    const NAME: &'static str = "u32";
}
impl Element for u8 {
    const NAME: &'static str = "u8";
}

/// An `.npz` file being read.
struct File<'a> {
    npz: NpzReader<Cursor<&'a [u8]>>,
    names: Vec<String>,
    path: &'a Path,
}

impl<'a> File<'a> {
    fn open(bytes: &'a [u8], path: &'a Path) -> Result<Self, DatasetError> {
        let not_npz = |error: ReadNpzError| DatasetError::NotNpz {
            path: path.to_owned(),
            reason: error.to_string(),
        };
        let mut npz = NpzReader::new(Cursor::new(bytes)).map_err(not_npz)?;
        let names = npz.names().map_err(not_npz)?;
        Ok(Self { npz, names, path })
    }

    fn error(&self, array: &'static str, found: String, expected: String) -> DatasetError {
        DatasetError::Array {
            path: self.path.to_owned(),
            array,
            found,
            expected,
        }
    }

    /// Reads an array of `n` (or any number of) elements of shape `inner`, row-major; `None` if
    /// it is not there.
    fn read<T: Element>(
        &mut self,
        array: &'static str,
        inner: &[usize],
        n: Option<usize>,
    ) -> Result<Option<Vec<T>>, DatasetError> {
        if !self.names.iter().any(|name| name == array) {
            return Ok(None);
        }
        let lengths: String = inner.iter().map(|length| format!(",{length}")).collect();
        let count = n.map_or_else(|| "N".to_owned(), |n| n.to_string());
        let expected = format!("{} [{count}{lengths}]", T::NAME);
        let values: ArrayD<T> = self.npz.by_name(array).map_err(|error| {
            let found = match error {
                ReadNpzError::Npy(ReadNpyError::WrongDescriptor(found)) => format!("dtype {found}"),
                other => other.to_string(),
            };
            self.error(array, found, expected.clone())
        })?;
        let shape = values.raw_dim();
        let shape = shape.slice();
        let fits = shape.len() == inner.len() + 1
            && shape[1..] == *inner
            && n.is_none_or(|n| shape[0] == n);
        if !fits {
            return Err(self.error(array, format!("{} {shape:?}", T::NAME), expected));
        }
        // Row-major whatever the file's order.
        Ok(Some(values.iter().cloned().collect()))
    }

    /// The array `meta`; null if it is not there.
    fn meta(&mut self) -> Result<serde_json::Value, DatasetError> {
        let Some(text) = self.read::<u8>("meta", &[], None)? else {
            return Ok(serde_json::Value::Null);
        };
        serde_json::from_slice(&text)
            .map_err(|error| self.error("meta", error.to_string(), "JSON in UTF-8".to_owned()))
    }

    fn within(
        &self,
        array: &'static str,
        values: &[u8],
        largest: u8,
        expected: &str,
    ) -> Result<(), DatasetError> {
        match values.iter().position(|&value| value > largest) {
            None => Ok(()),
            Some(place) => {
                let found = format!("{} at {place}", values[place]);
                Err(self.error(array, found, expected.to_owned()))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array1, Array3};

    fn sample(level: u8, object: u32, split: Split) -> Sample {
        let mut frame = Frame::default();
        frame.newtons[usize::from(level)] = object as f32;
        Sample {
            frame,
            level,
            object: Some(object),
            material: Some(level),
            force_n: Some(2.5),
            split,
            shore: Some(70.0),
            source: 0,
        }
    }

    /// 4 levels x 10 objects x 5 presses.
    fn samples() -> Vec<Sample> {
        (0..200_u32)
            .map(|i| sample((i / 50) as u8 + 1, i / 5, Split::Train))
            .collect()
    }

    fn bytes_of(samples: &[Sample]) -> Vec<u8> {
        let meta = serde_json::json!({"seed": 7});
        write(Cursor::new(Vec::new()), samples, &meta)
            .unwrap()
            .into_inner()
    }

    fn parse(bytes: &[u8]) -> Result<Dataset, DatasetError> {
        Dataset::parse(bytes, Path::new("D.npz"), "D.npz".to_owned())
    }

    #[test]
    fn a_file_reads_back_what_was_written() {
        let samples = samples();
        let bytes = bytes_of(&samples);
        let read = parse(&bytes).unwrap();
        assert_eq!(read.samples, samples);
        assert_eq!(read.sources[0].seed, Some(7));
        assert_eq!(read.sources[0].sha256, sha256_hex(&bytes));
        // The file holds no date: the same samples give the same bytes.
        assert_eq!(bytes, bytes_of(&samples));
    }

    #[test]
    fn optional_arrays_may_be_missing() {
        let mut npz = NpzWriter::new(Cursor::new(Vec::new()));
        npz.add_array("frames", &Array3::<f32>::zeros((3, ROWS, COLS)))
            .unwrap();
        npz.add_array("level", &Array1::from(vec![0_u8, 1, 4]))
            .unwrap();
        let read = parse(npz.finish().unwrap().get_ref()).unwrap();
        assert!(
            read.samples
                .iter()
                .all(|s| s.split == Split::Train && s.object.is_none())
        );
        assert_eq!(read.labelled(Split::Train).unwrap(), [1, 2]);
        let error = read.labelled(Split::Test).unwrap_err().to_string();
        assert_eq!(error, "D.npz: the test split has no labelled samples");
    }

    #[test]
    fn what_is_not_as_agreed_is_named_with_what_was_found_and_expected() {
        fn check(fill: impl FnOnce(&mut NpzWriter<Cursor<Vec<u8>>>), expected: &str) {
            let mut npz = NpzWriter::new(Cursor::new(Vec::new()));
            fill(&mut npz);
            let error = parse(npz.finish().unwrap().get_ref())
                .unwrap_err()
                .to_string();
            assert!(error.starts_with("D.npz: "), "{error}");
            assert!(
                error.contains(expected),
                "{error}\nshould contain\n{expected}"
            );
        }
        let frames = |n: usize| Array3::<f32>::zeros((n, ROWS, COLS));
        check(|_| {}, "array `frames`: found none, expected f32 [N,28,28]");
        check(
            |npz| {
                npz.add_array("frames", &Array3::<f64>::zeros((2, ROWS, COLS)))
                    .unwrap();
            },
            "array `frames`: found dtype '<f8', expected f32 [N,28,28]",
        );
        check(
            |npz| {
                npz.add_array("frames", &Array3::<f32>::zeros((2, 27, COLS)))
                    .unwrap();
            },
            "array `frames`: found f32 [2, 27, 28], expected f32 [N,28,28]",
        );
        check(
            |npz| npz.add_array("frames", &frames(0)).unwrap(),
            "array `frames`: found no frame, expected at least one",
        );
        check(
            |npz| {
                npz.add_array("frames", &frames(2).mapv(|_| f32::NAN))
                    .unwrap();
            },
            "array `frames`: found NaN in frame 0, expected newtons",
        );
        check(
            |npz| npz.add_array("frames", &frames(2)).unwrap(),
            "array `level`: found none, expected u8 [2]",
        );
        check(
            |npz| {
                npz.add_array("frames", &frames(2)).unwrap();
                npz.add_array("level", &Array1::from(vec![1_i64, 2]))
                    .unwrap();
            },
            "array `level`: found dtype '<i8', expected u8 [2]",
        );
        check(
            |npz| {
                npz.add_array("frames", &frames(2)).unwrap();
                npz.add_array("level", &Array1::from(vec![1_u8, 5]))
                    .unwrap();
            },
            "array `level`: found 5 at 1, expected 0 (unlabelled) to 4",
        );
        check(
            |npz| {
                npz.add_array("frames", &frames(2)).unwrap();
                npz.add_array("level", &Array1::from(vec![1_u8, 4]))
                    .unwrap();
                npz.add_array("object", &Array1::from(vec![1_u32])).unwrap();
            },
            "array `object`: found u32 [1], expected u32 [2]",
        );
        check(
            |npz| {
                npz.add_array("frames", &frames(1)).unwrap();
                npz.add_array("level", &Array1::from(vec![1_u8])).unwrap();
                npz.add_array("meta", &Array1::from(b"{".to_vec())).unwrap();
            },
            "array `meta`: found EOF",
        );
        let error = parse(b"PK no zip").unwrap_err().to_string();
        assert!(error.starts_with("D.npz: not an .npz file"), "{error}");
    }

    fn objects_of(dataset: &Dataset, indices: &[usize]) -> Vec<u32> {
        let mut objects: Vec<u32> = indices
            .iter()
            .map(|&index| dataset.samples[index].object.unwrap())
            .collect();
        objects.dedup();
        objects
    }

    #[test]
    fn held_out_objects_are_whole_and_of_every_level() {
        let dataset = parse(&bytes_of(&samples())).unwrap();
        let indices = dataset.labelled(Split::Train).unwrap();
        let (kept, held) = dataset.hold_out(&indices, 0.2, 1);
        assert_eq!((kept.len(), held.len()), (160, 40));
        let (kept, held) = (objects_of(&dataset, &kept), objects_of(&dataset, &held));
        assert_eq!((kept.len(), held.len()), (32, 8));
        assert!(held.iter().all(|object| !kept.contains(object)));
        let first_object: Vec<usize> = (0..5).collect();
        assert_eq!(
            dataset.hold_out(&first_object, 0.5, 1),
            (first_object, vec![])
        );
        assert_ne!(
            held,
            objects_of(&dataset, &dataset.hold_out(&indices, 0.2, 2).1)
        );
    }

    #[test]
    fn labels_are_chosen_by_object_and_equally_from_each_level() {
        let dataset = parse(&bytes_of(&samples())).unwrap();
        let indices = dataset.labelled(Split::Train).unwrap();
        let chosen = dataset.choose_labelled(&indices, 48, LabelChoice::Object, 1);
        for level in 1..=4 {
            let of_level = chosen
                .iter()
                .filter(|&&i| dataset.samples[i].level == level)
                .count();
            assert_eq!(of_level, 12, "level {level}");
        }
        // Two whole objects and two presses of a third, of each level.
        assert_eq!(objects_of(&dataset, &chosen).len(), 12);
        // More labels are those and further ones: methods of one seed share what they can.
        let more = dataset.choose_labelled(&indices, 100, LabelChoice::Object, 1);
        assert!(chosen.iter().all(|index| more.contains(index)));

        let random = dataset.choose_labelled(&indices, 48, LabelChoice::Random, 1);
        assert_eq!(random.len(), 48);
        let objects = objects_of(&dataset, &random).len();
        assert!(objects > 24, "{objects} of 40 objects");
    }

    #[test]
    fn joined_files_keep_their_objects_apart() {
        let part = parse(&bytes_of(&samples())).unwrap();
        let all = Dataset::joined(vec![part.clone(), part]);
        assert_eq!(all.sources.len(), 2);
        let indices: Vec<usize> = (0..400).collect();
        assert_eq!(objects_of(&all, &indices), (0..80).collect::<Vec<u32>>());
    }
}
