//! The presses of one file, which is a recording or a data set.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use super::{CollectError, Problem, Settings, capture};
use crate::data::presses::{self, Layout, Press, Presses, file};
use crate::data::source::Object;
use hardnessd_core::frame::Array;
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
    /// The array whose frames the presses have as they are.
    pub(super) grid: Option<Array>,
    /// The name of each material that a press has.
    pub(super) materials: Vec<String>,
    /// The name of each sensor that a press has. A data set may not say it.
    pub(super) sensors: Vec<Option<String>>,
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
            return Self::of_data_set(path, settings.layout);
        }
        capture::part(path, &bytes, settings).map_err(|problem| problem.of(path))
    }

    /// Reads a data set of this layout.
    ///
    /// # Errors
    ///
    /// Returns an error if the file is not such a data set.
    pub fn of_data_set(path: &Path, layout: Layout) -> Result<Self, CollectError> {
        if file::layout_of(path)? != layout {
            return Err(Problem::Layout(layout).of(path));
        }
        let meta = match presses::meta(path)? {
            Value::Object(meta) => meta,
            _ => Map::new(),
        };
        let list = |key: &str| {
            let list = meta.get(key).and_then(Value::as_array);
            list.cloned().unwrap_or_default()
        };
        let presses = presses::read_one(path)?;
        let materials = list("materials").into_iter().enumerate();
        let mut materials: Vec<String> = materials
            .map(|(number, name)| {
                name.as_str()
                    .map_or_else(|| nameless(number), str::to_owned)
            })
            .collect();
        let last = presses.all.iter().filter_map(|press| press.material).max();
        let all = last.map_or(0, |last| usize::from(last) + 1);
        materials.extend((materials.len()..all).map(nameless));
        let sensors = list("sensors").into_iter();
        let mut sensors: Vec<Option<String>> = sensors
            .map(|name| name.as_str().map(str::to_owned))
            .collect();
        let last = presses.all.iter().map(|press| press.sensor).max();
        sensors.resize(last.map_or(0, |last| last as usize + 1), None);
        let generators = meta.get("generator").and_then(Value::as_str);
        let generators = generators.unwrap_or(UNKNOWN).split(", ");
        let captures = list("captures");
        let new_objects = captures.iter().filter(|of| of["new_object"] == true);
        let new_objects = new_objects.filter_map(|capture| capture["object"].as_u64());
        Ok(Self {
            path: path.to_owned(),
            is_recording: false,
            pitch_mm: presses.pitch_mm(),
            grid: presses.grid(),
            materials,
            sensors,
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

    /// The objects, each with its split.
    pub(super) fn objects(&self) -> BTreeSet<(Object, Split)> {
        let presses = self.presses.all.iter();
        presses
            .filter_map(|press| Some((press.pressed()?, press.split)))
            .collect()
    }

    /// The numbers of objects that a label or an option gave.
    pub(super) fn numbered_objects(&self) -> impl Iterator<Item = u32> {
        let objects = self.objects().into_iter();
        let numbers = objects.map(|(object, _)| object.number);
        numbers.filter(|number| !self.new_objects.contains(number))
    }

    pub(super) fn shape(&self, layout: Layout) -> Shape {
        let first = self.presses.all.first();
        // Presses over time have a value for each.
        let first = first.filter(|_| layout == Layout::Frames);
        let has = |test: fn(&Press) -> bool| first.is_none_or(test);
        Shape {
            pitch_mm: self.pitch_mm,
            object: has(|press| press.object.is_some()),
            material: has(|press| press.material.is_some()),
            force: has(|press| press.force_n.is_some()),
            shore: has(|press| press.shore.is_some()),
        }
    }
}

/// The name of a material to which a data set gives none.
fn nameless(number: usize) -> String {
    format!("material {number}")
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
