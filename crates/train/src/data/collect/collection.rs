//! A data set under construction: what it says of each capture, without the frames.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use super::capture::{self, Head};
use super::{CollectError, Labelling};
use crate::data::courses::{Courses, Press};
use crate::data::dataset::{self, Dataset, DatasetError, Sample};
use hardnessd_simulator::Split;

/// The generator of a data set that names none.
const UNKNOWN: &str = "unknown";

/// The material of presses over time whose recording does not name one.
const NO_MATERIAL: &str = "unknown";

/// The samples of a data set to which captures are added.
#[derive(Debug)]
pub(super) enum Samples {
    Frames(Vec<Sample>),
    Courses(Courses),
}

/// A data set to which captures are added.
#[derive(Debug)]
pub struct Earlier {
    samples: Samples,
    meta: Value,
    pitch_mm: f64,
    path: PathBuf,
}

impl Earlier {
    /// Reads the file to be appended to: presses over time if `sequences`, else single frames.
    /// `None` if it does not exist yet.
    ///
    /// # Errors
    ///
    /// Returns an error if the file exists but is not such a data set.
    pub fn read(path: &Path, sequences: bool) -> Result<Option<Self>, DatasetError> {
        if !path.exists() {
            return Ok(None);
        }
        let meta = match dataset::meta(path)? {
            meta @ Value::Object(_) => meta,
            _ => json!({}),
        };
        let (samples, pitch_mm) = if sequences {
            let pitch_mm = meta["pitch_mm"].as_f64().unwrap_or(dataset::PITCH_MM);
            (Samples::Courses(Courses::read(path)?), pitch_mm)
        } else {
            let dataset = Dataset::read(path)?;
            let pitch_mm = dataset.pitch_mm();
            (Samples::Frames(dataset.samples), pitch_mm)
        };
        Ok(Some(Self {
            samples,
            meta,
            pitch_mm,
            path: path.to_owned(),
        }))
    }

    /// The number of presses.
    pub fn presses(&self) -> usize {
        match &self.samples {
            Samples::Frames(samples) => samples.len(),
            Samples::Courses(courses) => courses.presses.len(),
        }
    }

    /// The objects, with what tells two of the same number apart.
    fn objects(&self) -> BTreeSet<Object> {
        match &self.samples {
            Samples::Frames(samples) => samples.iter().filter_map(Object::of_sample).collect(),
            Samples::Courses(courses) => courses.presses.iter().map(Object::of_press).collect(),
        }
    }

    fn shape(&self) -> Shape {
        let first = match &self.samples {
            Samples::Frames(samples) => samples.first(),
            Samples::Courses(_) => None,
        };
        let has = |test: fn(&Sample) -> bool, otherwise| first.map_or(otherwise, test);
        Shape {
            pitch_mm: self.pitch_mm,
            object: has(|sample| sample.object.is_some(), true),
            material: has(|sample| sample.material.is_some(), true),
            force: has(|sample| sample.force_n.is_some(), true),
            shore: has(|sample| sample.shore.is_some(), false),
        }
    }
}

/// An object in a data set. The order begins with its number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Object {
    number: u32,
    material: Option<u8>,
    level: u8,
    is_test: bool,
}

impl Object {
    fn of_sample(sample: &Sample) -> Option<Self> {
        sample.object.map(|number| Self {
            number,
            material: sample.material,
            level: sample.level,
            is_test: sample.split == Split::Test,
        })
    }

    fn of_press(press: &Press) -> Self {
        Self {
            number: press.object,
            material: Some(press.material),
            level: press.level,
            is_test: press.split == Split::Test,
        }
    }

    /// Whether both are one object, by the rule of [`Sample::shares_object_with`].
    fn is_same_as(&self, other: &Self) -> bool {
        let same_level = self.level == other.level || self.level == 0 || other.level == 0;
        self.number == other.number && self.material == other.material && same_level
    }
}

/// What all samples of a data set have in common: the pitch, and the arrays that they have.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Shape {
    pitch_mm: f64,
    object: bool,
    pub(super) material: bool,
    force: bool,
    pub(super) shore: bool,
}

impl Shape {
    pub(super) fn of(head: &Head, sequences: bool) -> Self {
        Self {
            pitch_mm: head.pitch_mm,
            object: true,
            // A press over time has a material and a hardness also where the recording has none.
            material: sequences || head.labels.contains_key("material"),
            force: true,
            shore: !sequences && head.labels.contains_key("shore"),
        }
    }

    /// Returns an error if the samples in `path` are of another shape than those in `first`.
    fn check(&self, path: &Path, expected: &Self, first: &Path) -> Result<(), CollectError> {
        for (array, there, here) in [
            ("object", expected.object, self.object),
            ("material", expected.material, self.material),
            ("force", expected.force, self.force),
            ("shore", expected.shore, self.shore),
        ] {
            let (path, first) = match (there, here) {
                (true, false) => (path, first),
                (false, true) => (first, path),
                _ => continue,
            };
            return Err(CollectError::Lost {
                path: path.to_owned(),
                array,
                first: first.to_owned(),
            });
        }
        Ok(())
    }
}

/// A capture in the data set.
#[derive(Debug)]
pub(super) struct Used {
    pub(super) part: PathBuf,
    pub(super) level: u8,
    pub(super) object: u32,
    pub(super) material: Option<u8>,
    pub(super) shore: Option<f32>,
    pub(super) presses: usize,
    pub(super) frames: usize,
    /// The numbers of presses and frames before this capture.
    pub(super) before: (usize, usize),
}

/// What makes two captures the same presses of the same object.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Identity {
    sha256: String,
    level: u8,
    object: u32,
    is_test: bool,
}

impl Identity {
    /// The identity of an element of `meta.captures`. `None` if another program wrote it differently.
    fn of(capture: &Value) -> Option<Self> {
        Some(Self {
            sha256: capture["sha256"].as_str()?.to_owned(),
            level: capture["level"].as_u64()?.try_into().ok()?,
            object: capture["object"].as_u64()?.try_into().ok()?,
            is_test: capture["split"].as_str()? == Split::Test.name(),
        })
    }
}

/// A data set under construction. It holds a few hundred bytes of each capture; the frames stay in
/// the parts.
#[derive(Debug)]
pub struct Collection {
    pub(super) earlier: Option<Samples>,
    pub(super) used: Vec<Used>,
    pub(super) shape: Shape,
    pub(super) split: Split,
    pub(super) is_of_courses: bool,
    /// The JSON of each key of `meta`.
    meta: BTreeMap<String, String>,
    /// The JSON of the elements of `meta.captures`.
    captures: String,
    /// The captures that gave samples, and their names.
    known_captures: BTreeMap<Identity, String>,
    /// The file of the first samples.
    first: PathBuf,
    objects: BTreeSet<Object>,
    /// The number for an object that no label names. `None` if all numbers are taken.
    new_object: Option<u32>,
    materials: Vec<String>,
    /// The number of presses, and of frames, with those of the earlier data set.
    pub(super) all: (usize, usize),
    /// The captures that give no samples, with the reason.
    pub left_out: Vec<(PathBuf, String)>,
    /// The number of presses that were added.
    pub presses: usize,
    /// The number of these whose approach is known.
    pub known: usize,
    /// The number of presses that were left out because their begin is not in the recording.
    pub partial: usize,
}

impl Collection {
    /// Begins with the samples of `earlier`, or without samples for captures as the one in `first`,
    /// which is of shape `shape`.
    pub(super) fn begun(
        earlier: Option<Earlier>,
        (first, shape): (&Path, Shape),
        split: Split,
        is_of_courses: bool,
    ) -> Self {
        let objects = earlier
            .as_ref()
            .map_or_else(BTreeSet::new, Earlier::objects);
        let all = match earlier.as_ref().map(|earlier| &earlier.samples) {
            Some(Samples::Frames(samples)) => (samples.len(), samples.len()),
            Some(Samples::Courses(courses)) => (courses.presses.len(), courses.press.len()),
            None => (0, 0),
        };
        let (samples, meta, shape, first) = match earlier {
            Some(earlier) => {
                let shape = earlier.shape();
                (Some(earlier.samples), earlier.meta, shape, earlier.path)
            }
            None => {
                let meta = json!({"materials": [], "seed": null, "captures": []});
                (None, meta, shape, first.to_owned())
            }
        };
        // Keep the names of all generators, because they tell whether a model's data is simulated,
        // recorded or both.
        let others = match &samples {
            Some(_) => meta["generator"].as_str().unwrap_or(UNKNOWN),
            None => "",
        };
        let collected = format!("{} {}", dataset::COLLECTOR, env!("CARGO_PKG_VERSION"));
        let others = others
            .split(", ")
            .filter(|one| !["", &collected].contains(one));
        let generators: Vec<&str> = others.chain([&*collected]).collect();
        let captures = meta["captures"].as_array().map_or(&[][..], Vec::as_slice);
        let name = |capture: &Value| capture["name"].as_str().unwrap_or_default().to_owned();
        let known_captures = captures
            .iter()
            .filter_map(|capture| Some((Identity::of(capture)?, name(capture))))
            .collect();
        let captures: Vec<String> = captures.iter().map(Value::to_string).collect();
        let mut texts: BTreeMap<String, String> = meta
            .as_object()
            .into_iter()
            .flatten()
            .map(|(key, value)| (key.clone(), value.to_string()))
            .collect();
        for (key, value) in [
            ("generator", json!(generators.join(", "))),
            ("levels", json!(dataset::levels())),
            ("pitch_mm", json!(shape.pitch_mm)),
        ] {
            texts.insert(key.to_owned(), value.to_string());
        }
        let last = objects.last().map(|object| object.number);
        Self {
            new_object: last.map_or(Some(0), |object| object.checked_add(1)),
            materials: serde_json::from_value(meta["materials"].clone()).unwrap_or_default(),
            meta: texts,
            captures: captures.join(","),
            known_captures,
            earlier: samples,
            used: Vec::new(),
            shape,
            split,
            is_of_courses,
            first,
            objects,
            all,
            left_out: Vec::new(),
            presses: 0,
            known: 0,
            partial: 0,
        }
    }

    /// Adds a capture, whose presses are in `part`.
    ///
    /// # Errors
    ///
    /// Returns a [`CollectError`] if the capture does not fit the others, and another error if no
    /// number is left for an object.
    pub(super) fn add(
        &mut self,
        head: &Head,
        part: PathBuf,
        labelling: Labelling,
    ) -> anyhow::Result<()> {
        let (path, expected) = (&head.path, self.shape.pitch_mm);
        capture::check_pitch(path, head.pitch_mm, expected, &self.first)?;
        let level = head.level(labelling.level)?;
        let object = self.object(head, labelling)?;
        let shore = head.shore()?;
        let identity = Identity {
            sha256: head.sha256.clone(),
            level,
            object,
            is_test: self.split == Split::Test,
        };
        if let Some(first) = self.known_captures.get(&identity) {
            return Err(CollectError::Twice {
                path: path.clone(),
                first: first.clone(),
            }
            .into());
        }
        let shape = Shape::of(head, self.is_of_courses);
        if head.presses > 0 {
            shape.check(path, &self.shape, &self.first)?;
        }
        let none = self.is_of_courses.then_some(NO_MATERIAL);
        let material = head.labels.get("material").map(String::as_str).or(none);
        let material = material.map(|name| self.material(name, path)).transpose()?;
        if head.presses > 0 {
            self.check_split(path, object, material, level)?;
        }
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let said = json!({
            "name": name,
            "sha256": head.sha256,
            "level": level,
            "object": object,
            "presses": head.presses,
            "split": labelling.split.name(),
            "labels": head.labels,
        });
        if !self.captures.is_empty() {
            self.captures.push(',');
        }
        self.captures.push_str(&said.to_string());
        self.known_captures.insert(identity, name.into_owned());
        self.used.push(Used {
            part,
            level,
            object,
            material,
            shore,
            presses: head.presses,
            frames: head.frames,
            before: self.all,
        });
        self.all = (self.all.0 + head.presses, self.all.1 + head.frames);
        self.presses += head.presses;
        self.known += head.known;
        self.partial += head.judged - head.presses;
        Ok(())
    }

    /// Makes the number of a new object greater than `labelled`, the greatest number in a label. So a
    /// capture without a label never shares the number of one with a label.
    pub(super) fn keep_free(&mut self, labelled: Option<u32>) {
        if let Some(labelled) = labelled {
            let next = labelled.checked_add(1);
            self.new_object = self.new_object.and_then(|new| Some(new.max(next?)));
        }
    }

    /// The object of a capture: the given number, its label's number, or a new one.
    fn object(&self, head: &Head, labelling: Labelling) -> anyhow::Result<u32> {
        if let Some(object) = labelling.object {
            return Ok(object);
        }
        if let Some(object) = head.number("object", "a number")? {
            return Ok(object);
        }
        let new_object = self.new_object.ok_or_else(|| DatasetError::Array {
            path: self.first.clone(),
            array: "object",
            found: u32::MAX.to_string(),
            expected: "a lower number, for the next to be a new object's: --object says one"
                .to_owned(),
        })?;
        Ok(new_object)
    }

    /// The index of a name in `meta.materials`. A new name is added.
    fn material(&mut self, name: &str, path: &Path) -> Result<u8, CollectError> {
        let known = self.materials.iter().position(|material| material == name);
        let index = known.unwrap_or(self.materials.len());
        let index = u8::try_from(index).map_err(|_| CollectError::Materials {
            path: path.to_owned(),
            name: name.to_owned(),
        })?;
        if known.is_none() {
            self.materials.push(name.to_owned());
        }
        Ok(index)
    }

    /// Returns an error if the earlier data set has the object in the other split. The captures of
    /// one call are all in one split.
    fn check_split(
        &self,
        path: &Path,
        number: u32,
        material: Option<u8>,
        level: u8,
    ) -> Result<(), CollectError> {
        let added = Object {
            number,
            material,
            level,
            is_test: self.split == Split::Test,
        };
        let least = Object {
            material: None,
            level: 0,
            is_test: false,
            ..added
        };
        let of_number = self.objects.range(least..);
        let mut of_number = of_number.take_while(|object| object.number == number);
        let other = |object: &Object| object.is_test != added.is_test && object.is_same_as(&added);
        if !of_number.any(other) {
            return Ok(());
        }
        let expected = match self.split {
            Split::Train => Split::Test,
            Split::Test => Split::Train,
        };
        Err(CollectError::Splits {
            path: path.to_owned(),
            object: number,
            found: self.split.name(),
            expected: expected.name(),
            first: self.first.clone(),
        })
    }

    /// The JSON of `meta`.
    pub(super) fn meta(&self) -> String {
        let mut texts = self.meta.clone();
        texts.insert("captures".to_owned(), format!("[{}]", self.captures));
        texts.insert("materials".to_owned(), json!(self.materials).to_string());
        let one = |(key, text): (&String, &String)| format!("{}:{text}", json!(key));
        let all: Vec<String> = texts.iter().map(one).collect();
        format!("{{{}}}", all.join(","))
    }
}
