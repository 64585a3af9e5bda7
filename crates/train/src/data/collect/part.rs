//! The presses of one file, which is a recording or a data set.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use super::{CollectError, Problem, Settings, capture};
use crate::data::courses::Courses;
use crate::data::dataset::{self, Dataset, Object, Sample, file};
use hardnessd_simulator::Split;

/// The generator of a data set that names none.
const UNKNOWN: &str = "unknown";

/// How an `.npz` file begins: it is a zip archive.
const ARCHIVE: &[u8] = b"PK\x03\x04";

/// The presses of one file, and what is known about them.
#[derive(Debug)]
pub struct Part {
    pub(super) path: PathBuf,
    pub(super) is_recording: bool,
    pub(super) presses: Presses,
    pub(super) pitch_mm: f64,
    /// The name of each material that a press has.
    pub(super) materials: Vec<String>,
    /// The elements of `meta.captures`.
    pub(super) captures: Vec<Value>,
    /// The numbers of objects that neither a label nor an option gave.
    pub(super) new_objects: BTreeSet<u32>,
    /// The programs that made the presses.
    pub(super) generators: Vec<String>,
    /// The number of presses that were left out because their begin is not in the recording.
    pub(super) partial: usize,
    /// What a data set says of itself.
    pub(super) meta: Map<String, Value>,
}

impl Part {
    pub(super) fn read(path: &Path, settings: &Settings) -> Result<Self, CollectError> {
        let bytes = file::whole(path);
        let bytes = bytes.map_err(|error| Problem::Unreadable(error).of(path))?;
        if bytes.starts_with(ARCHIVE) {
            return Self::of_data_set(path, settings.sequences);
        }
        capture::part(path, &bytes, settings).map_err(|problem| problem.of(path))
    }

    /// Reads a data set: presses over time if `sequences`, else single frames.
    ///
    /// # Errors
    ///
    /// Returns an error if the file is not such a data set.
    pub fn of_data_set(path: &Path, sequences: bool) -> Result<Self, CollectError> {
        let meta = match dataset::meta(path)? {
            Value::Object(meta) => meta,
            _ => Map::new(),
        };
        let list = |key: &str| {
            let list = meta.get(key).and_then(Value::as_array);
            list.cloned().unwrap_or_default()
        };
        let (presses, pitch_mm) = if sequences {
            let pitch_mm = meta.get("pitch_mm").and_then(Value::as_f64);
            (
                Presses::Courses(Courses::read(path)?),
                pitch_mm.unwrap_or(dataset::PITCH_MM),
            )
        } else {
            let dataset = Dataset::read(path)?;
            let pitch_mm = dataset.pitch_mm();
            (Presses::Frames(dataset.samples), pitch_mm)
        };
        let materials = list("materials").into_iter().enumerate();
        let mut materials: Vec<String> = materials
            .map(|(number, name)| {
                name.as_str()
                    .map_or_else(|| nameless(number), str::to_owned)
            })
            .collect();
        let materials_used = presses.objects().into_iter();
        let last = materials_used.filter_map(|(object, _)| object.material);
        let all = last.max().map_or(0, |last| usize::from(last) + 1);
        materials.extend((materials.len()..all).map(nameless));
        let generators = meta.get("generator").and_then(Value::as_str);
        let generators = generators.unwrap_or(UNKNOWN).split(", ");
        let captures = list("captures");
        let new_objects = captures.iter().filter(|of| of["new_object"] == true);
        let new_objects = new_objects.filter_map(|capture| capture["object"].as_u64());
        Ok(Self {
            path: path.to_owned(),
            is_recording: false,
            pitch_mm,
            materials,
            new_objects: new_objects
                .filter_map(|number| number.try_into().ok())
                .collect(),
            captures,
            generators: generators.map(str::to_owned).collect(),
            partial: 0,
            presses,
            meta,
        })
    }

    /// The numbers of objects that a label or an option gave.
    pub(super) fn numbered_objects(&self) -> impl Iterator<Item = u32> {
        let objects = self.presses.objects().into_iter();
        let numbers = objects.map(|(object, _)| object.number);
        numbers.filter(|number| !self.new_objects.contains(number))
    }

    pub(super) fn shape(&self) -> Shape {
        let first = match &self.presses {
            Presses::Frames(samples) => samples.first(),
            Presses::Courses(_) => None,
        };
        // Presses over time have a value for each.
        let has = |test: fn(&Sample) -> bool| first.is_none_or(test);
        Shape {
            pitch_mm: self.pitch_mm,
            object: has(|sample| sample.object.is_some()),
            material: has(|sample| sample.material.is_some()),
            force: has(|sample| sample.force_n.is_some()),
            shore: has(|sample| sample.shore.is_some()),
        }
    }
}

/// The name of a material to which a data set gives none.
fn nameless(number: usize) -> String {
    format!("material {number}")
}

/// Single frames, or presses over time.
#[derive(Debug)]
pub(super) enum Presses {
    Frames(Vec<Sample>),
    Courses(Courses),
}

impl Presses {
    pub(super) fn len(&self) -> usize {
        match self {
            Self::Frames(samples) => samples.len(),
            Self::Courses(courses) => courses.presses.len(),
        }
    }

    /// The number of presses whose approach is known.
    pub(super) fn known(&self) -> usize {
        let Self::Courses(courses) = self else {
            return 0;
        };
        let presses = 0..courses.presses.len();
        presses
            .filter(|&press| courses.known[courses.rows(press)].contains(&1))
            .count()
    }

    /// The objects, each with its split.
    pub(super) fn objects(&self) -> BTreeSet<(Object, Split)> {
        match self {
            Self::Frames(samples) => samples
                .iter()
                .filter_map(|sample| Some((sample.pressed()?, sample.split)))
                .collect(),
            Self::Courses(courses) => courses
                .presses
                .iter()
                .map(|press| (press.pressed(), press.split))
                .collect(),
        }
    }

    /// Changes the numbers of objects, and those of materials to the ones in `materials`.
    pub(super) fn renumber(&mut self, object: impl Fn(u32) -> u32, materials: &[u8]) {
        let material = |number: u8| materials[usize::from(number)];
        match self {
            Self::Frames(samples) => {
                for sample in samples {
                    sample.object = sample.object.map(&object);
                    sample.material = sample.material.map(material);
                }
            }
            Self::Courses(courses) => {
                for press in &mut courses.presses {
                    press.object = object(press.object);
                    press.material = material(press.material);
                }
            }
        }
    }

    /// Adds other presses of the same kind.
    pub(super) fn append(&mut self, other: Self) {
        match (self, other) {
            (Self::Frames(all), Self::Frames(samples)) => all.extend(samples),
            (Self::Courses(all), Self::Courses(courses)) => all.append(courses, 0),
            _ => unreachable!("all files of a call are read as one kind"),
        }
    }
}

/// What all samples of a data set have in common: the pitch, and the arrays that they have.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Shape {
    pub(super) pitch_mm: f64,
    object: bool,
    material: bool,
    force: bool,
    shore: bool,
}

impl Shape {
    /// Returns an error if this is another shape than that of the samples in `first`.
    pub(super) fn check(&self, expected: &Self, first: &Path) -> Result<(), Problem> {
        if self.pitch_mm != expected.pitch_mm {
            return Err(Problem::Pitch {
                found: self.pitch_mm,
                expected: expected.pitch_mm,
                first: first.to_owned(),
            });
        }
        for (array, there, here) in [
            ("object", expected.object, self.object),
            ("material", expected.material, self.material),
            ("force", expected.force, self.force),
            ("shore", expected.shore, self.shore),
        ] {
            if there != here {
                return Err(Problem::Arrays {
                    array,
                    is_there: here,
                    first: first.to_owned(),
                });
            }
        }
        Ok(())
    }
}
