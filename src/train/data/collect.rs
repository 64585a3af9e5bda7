//! Recordings of known objects as samples of a data set.
//!
//! In: captures, `.mcap` or `.bin`. Out: the chosen frame of every press that was judged, or all
//! its frames with the arm's approach. The daemon's own pipeline decodes, tares and selects, so a
//! model learns from the same frames that it will judge.

mod capture;
mod selection;

use std::io::Cursor;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use serde_json::{Value, json};

pub use self::capture::Capture;
use crate::recording::{self, PlaybackError};
use crate::simulator::Split;
use crate::train::data::courses::{Courses, Press};
use crate::train::data::dataset::{self, Dataset, DatasetError, Sample};

use self::selection::Judged;

/// The generator of a data set that names none.
const UNKNOWN: &str = "unknown";

/// The labels of the samples. A field that is `None` is taken from the capture's labels.
#[derive(Debug, Clone, Copy)]
pub struct Labelling {
    /// The hardness level 1..=4, or 0 for unlabelled.
    pub level: Option<u8>,
    /// The number of the pressed object. The same number in another data set is another object. If
    /// neither this field nor a label gives a number, all captures of one call are one new object.
    pub object: Option<u32>,
    /// The split: training or test.
    pub split: Split,
}

/// The reason that a capture gives no samples.
#[derive(Debug, thiserror::Error)]
pub enum CollectError {
    /// The capture is missing or unreadable.
    #[error("{path}: {source}")]
    Unreadable {
        /// The capture.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The capture is damaged, or is not a recording of hardnessd.
    #[error("{path}: {source}")]
    Recording {
        /// The capture.
        path: PathBuf,
        /// The reader's error.
        source: recording::Error,
    },
    /// The capture describes an impossible sensor.
    #[error("{path}: {source}")]
    Sensor {
        /// The capture.
        path: PathBuf,
        /// The error of the playback.
        source: PlaybackError,
    },
    /// The level is neither given nor a label.
    #[error("{path}: the recording has no label `level`: give its level with --level")]
    NoLevel {
        /// The capture.
        path: PathBuf,
    },
    /// A label is not a number in its range.
    #[error(
        "{path}: label {key}: found {found}, expected {expected}{}",
        said_too(key)
    )]
    Label {
        /// The capture.
        path: PathBuf,
        /// The label's key.
        key: &'static str,
        /// The value found.
        found: String,
        /// The accepted values.
        expected: &'static str,
    },
    /// The capture has another taxel pitch than the others.
    #[error("{path}: taxel pitch: found {found} mm, expected {expected} mm, that of {first}")]
    Pitch {
        /// The capture.
        path: PathBuf,
        /// The capture's pitch, in mm.
        found: f64,
        /// The pitch of the others, in mm.
        expected: f64,
        /// One of the others, or the data set to which the captures are added.
        first: PathBuf,
    },
    /// An array has values for some samples only. The data set would lose it, because an array has
    /// a value for every sample or is missing.
    #[error(
        "{path}: has no {array}, and {first} has: {}make it a data set of its own (train takes \
         several --data)",
        remedy(array)
    )]
    Lost {
        /// The file without values.
        path: PathBuf,
        /// The array's name.
        array: &'static str,
        /// The file with values.
        first: PathBuf,
    },
    /// The same object is in the training split and in the test split.
    #[error(
        "{path}: object {object} is in the {found} split here, and in the {expected} split in \
         {first}: give it the same --split, because presses of one object are near-copies"
    )]
    Splits {
        /// The capture.
        path: PathBuf,
        /// The object's number.
        object: u32,
        /// The split of the object's presses in this capture.
        found: &'static str,
        /// The split of the object's earlier presses.
        expected: &'static str,
        /// The data set to which the capture is added.
        first: PathBuf,
    },
    /// The sensor was not pressed, or no press was judged.
    #[error(
        "{path}: no press found: was the sensor pressed, and is this its layout? (`hardnessd replay {path}`)"
    )]
    NoPress {
        /// The capture.
        path: PathBuf,
    },
}

fn said_too(key: &str) -> String {
    match key {
        "level" | "object" => format!(": --{key} gives another one"),
        _ => String::new(),
    }
}

fn remedy(array: &str) -> String {
    match array {
        "material" | "shore" => format!("record with --label {array}=..., or "),
        _ => String::new(),
    }
}

/// Builds the bytes of a data set of `captures`, after the samples of `before` if there are any.
/// The data set has the array `material`, and the array `shore`, if every capture has that label.
///
/// # Errors
///
/// Returns an error if:
///
/// - a level is neither given nor a label,
/// - captures and `before` have different pitches or arrays, or the same object in different
///   splits,
/// - there are more objects or materials than a u32 and a u8 can number, or
/// - the archive cannot be built.
pub fn to_bytes(
    captures: &[Capture],
    labelling: Labelling,
    before: Option<(Dataset, Value)>,
) -> anyhow::Result<Vec<u8>> {
    let before = before.map(|(dataset, meta)| Before {
        pitch_mm: dataset.pitch_mm(),
        path: dataset.path(),
        samples: dataset.samples,
        meta,
    });
    let mut collection = Collection::begun(captures.first(), before);
    for capture in captures {
        collection.add(capture, labelling)?;
    }
    collection.finish()
}

/// Like [`to_bytes`], but with all frames of each press. A press that began before its recording is
/// left out.
///
/// # Errors
///
/// Returns the errors of [`to_bytes`], except that a material or a measured hardness may be
/// missing.
pub fn courses_to_bytes(
    captures: &[Capture],
    labelling: Labelling,
    before: Option<(Courses, Value, PathBuf)>,
) -> anyhow::Result<Vec<u8>> {
    let (before, courses) = match before {
        Some((courses, meta, path)) => {
            let before = Before {
                pitch_mm: meta["pitch_mm"].as_f64().unwrap_or(dataset::PITCH_MM),
                path,
                samples: courses
                    .presses
                    .iter()
                    .map(|press| sample_of(press, &courses))
                    .collect(),
                meta,
            };
            (Some(before), courses)
        }
        None => (None, Courses::default()),
    };
    let mut collection = Collection {
        courses: Some(courses),
        ..Collection::begun(captures.first(), before)
    };
    for capture in captures {
        collection.add(capture, labelling)?;
    }
    collection.finish()
}

/// A press over time as a sample of a data set of single frames.
fn sample_of(press: &Press, courses: &Courses) -> Sample {
    Sample {
        frame: courses.frame(press.best as usize),
        level: press.level,
        object: Some(press.object),
        material: Some(press.material),
        force_n: Some(press.force_n),
        split: press.split,
        shore: None,
        source: 0,
    }
}

/// A data set to which captures are added.
struct Before {
    samples: Vec<Sample>,
    meta: Value,
    pitch_mm: f64,
    path: PathBuf,
}

/// The material of presses over time whose recording does not name one.
const NO_MATERIAL: &str = "unknown";

/// A data set under construction.
struct Collection {
    samples: Vec<Sample>,
    /// The same presses over time, if the data set is one of whole presses.
    courses: Option<Courses>,
    meta: Value,
    /// The file of the first samples.
    first: PathBuf,
    pitch_mm: f64,
    /// The number for an object that no label names. `None` if all numbers are taken.
    new_object: Option<u32>,
    materials: Vec<String>,
}

impl Collection {
    /// Begins with the samples of `before`, or without samples for the capture `first`.
    fn begun(first: Option<&Capture>, before: Option<Before>) -> Self {
        let (samples, mut meta, others, pitch_mm, first) = match before {
            Some(before) => {
                let others = before.meta["generator"].as_str().unwrap_or(UNKNOWN);
                let others = others.to_owned();
                (
                    before.samples,
                    before.meta,
                    others,
                    before.pitch_mm,
                    before.path,
                )
            }
            None => (
                Vec::new(),
                json!({"materials": [], "seed": null, "captures": []}),
                String::new(),
                first.map_or(dataset::PITCH_MM, |capture| capture.pitch_mm),
                first
                    .map(|capture| capture.path.clone())
                    .unwrap_or_default(),
            ),
        };
        let last = samples.iter().filter_map(|sample| sample.object).max();
        // Keep the names of all generators, because they tell whether a model's data is simulated,
        // recorded or both.
        let collected = format!("{} {}", dataset::COLLECTOR, env!("CARGO_PKG_VERSION"));
        let others = others
            .split(", ")
            .filter(|one| !["", &collected].contains(one));
        let generators: Vec<&str> = others.chain([&*collected]).collect();
        meta["generator"] = json!(generators.join(", "));
        meta["levels"] = json!(dataset::levels());
        meta["pitch_mm"] = json!(pitch_mm);
        Self {
            new_object: last.map_or(Some(0), |object| object.checked_add(1)),
            materials: serde_json::from_value(meta["materials"].take()).unwrap_or_default(),
            samples,
            courses: None,
            meta,
            first,
            pitch_mm,
        }
    }

    /// Adds the presses of a capture.
    fn add(&mut self, capture: &Capture, labelling: Labelling) -> anyhow::Result<()> {
        capture::check_pitch(&capture.path, capture.pitch_mm, self.pitch_mm, &self.first)?;
        let level = capture.level(labelling.level)?;
        let object = self.object(capture, labelling)?;
        let material = capture.labels.get("material").map(String::as_str);
        let none = self.courses.is_some().then_some(NO_MATERIAL);
        let material = material
            .or(none)
            .map(|name| index_of(name, &mut self.materials))
            .transpose()?;
        let shore = capture.shore()?;
        let presses: Vec<&Judged> = match self.courses {
            Some(_) => capture
                .presses
                .iter()
                .filter(|press| press.is_whole())
                .collect(),
            None => capture.presses.iter().collect(),
        };
        let own: Vec<Sample> = presses
            .iter()
            .map(|press| Sample {
                frame: press.frame,
                level,
                object: Some(object),
                material,
                force_n: Some(press.force_n),
                split: labelling.split,
                shore: shore.filter(|_| self.courses.is_none()),
                source: 0,
            })
            .collect();
        if let (Some(of_first), Some(of_this)) = (self.samples.first(), own.first()) {
            check_arrays((of_first, &self.first), (of_this, &capture.path))?;
            check_splits((&self.samples, &self.first), (of_this, &capture.path))?;
        }
        if let Some(courses) = &mut self.courses {
            for (press, sample) in presses.iter().zip(&own) {
                push_course(courses, press, sample, shore);
            }
        }
        let count = own.len();
        self.samples.extend(own);
        let said = json!({
            "name": capture.path.file_name().unwrap_or_default().to_string_lossy(),
            "sha256": capture.sha256,
            "level": level,
            "object": object,
            "presses": count,
            "split": labelling.split.name(),
            "labels": capture.labels,
        });
        match self.meta["captures"].as_array_mut() {
            Some(captures) => captures.push(said),
            None => self.meta["captures"] = json!([said]),
        }
        Ok(())
    }

    /// The object of a capture: the given number, its label's number, or a new one.
    fn object(&self, capture: &Capture, labelling: Labelling) -> anyhow::Result<u32> {
        if let Some(object) = labelling.object {
            return Ok(object);
        }
        if let Some(object) = capture.number("object", "a number")? {
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

    /// The bytes of the file.
    fn finish(mut self) -> anyhow::Result<Vec<u8>> {
        self.meta["materials"] = json!(self.materials);
        let file = Cursor::new(Vec::new());
        let written = match &self.courses {
            Some(courses) => courses.write(file, &self.meta)?,
            None => dataset::write(file, &self.samples, &self.meta)?,
        };
        Ok(written.into_inner())
    }
}

/// Adds a press over time. Level, object, material and split are those of `sample`.
fn push_course(courses: &mut Courses, judged: &Judged, sample: &Sample, shore: Option<f32>) {
    let press = Press {
        level: sample.level,
        object: sample.object.unwrap_or_default(),
        material: sample.material.unwrap_or_default(),
        split: sample.split,
        shore: shore.unwrap_or(f32::NAN),
        force_n: judged.force_n,
        arm_n_per_mm: judged.arm_n_per_mm,
        best: judged.best as u32,
    };
    let moments = judged.moments.iter();
    courses.push(
        press,
        moments.map(|moment| (moment.time_s, moment.approach_mm, &moment.frame)),
    );
}

/// Returns an error if one of two samples has a value for an array and the other has none.
fn check_arrays(
    (before, first): (&Sample, &Path),
    (added, path): (&Sample, &Path),
) -> Result<(), CollectError> {
    for (array, there, here) in [
        ("object", before.object.is_some(), added.object.is_some()),
        (
            "material",
            before.material.is_some(),
            added.material.is_some(),
        ),
        ("force", before.force_n.is_some(), added.force_n.is_some()),
        ("shore", before.shore.is_some(), added.shore.is_some()),
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

/// Returns an error if the other split has a sample of the same object.
fn check_splits(
    (before, first): (&[Sample], &Path),
    (added, path): (&Sample, &Path),
) -> Result<(), CollectError> {
    let others = |sample: &&Sample| sample.split != added.split && sample.shares_object_with(added);
    before.iter().find(others).map_or(Ok(()), |other| {
        Err(CollectError::Splits {
            path: path.to_owned(),
            object: added.object.unwrap_or_default(),
            found: added.split.name(),
            expected: other.split.name(),
            first: first.to_owned(),
        })
    })
}

/// The index of a name in `meta.materials`. A new name is added.
fn index_of(name: &str, materials: &mut Vec<String>) -> anyhow::Result<u8> {
    let known = materials.iter().position(|material| material == name);
    let index = known.unwrap_or(materials.len());
    if known.is_none() {
        materials.push(name.to_owned());
    }
    u8::try_from(index).with_context(|| {
        format!("label material: {name:?} is one too many: a data set has at most 256 materials")
    })
}

/// Like [`existing`], for presses over time.
///
/// # Errors
///
/// Returns an error if the file exists but has no presses over time.
pub fn existing_courses(path: &Path) -> Result<Option<(Courses, Value, PathBuf)>, DatasetError> {
    if !path.exists() {
        return Ok(None);
    }
    let meta = match dataset::meta(path)? {
        meta @ Value::Object(_) => meta,
        _ => json!({}),
    };
    Ok(Some((Courses::read(path)?, meta, path.to_owned())))
}

/// Reads the file to be appended to. `None` if it does not exist yet.
///
/// # Errors
///
/// Returns an error if the file exists but is not a data set.
pub fn existing(path: &Path) -> Result<Option<(Dataset, Value)>, DatasetError> {
    if !path.exists() {
        return Ok(None);
    }
    let meta = match dataset::meta(path)? {
        meta @ Value::Object(_) => meta,
        _ => json!({}),
    };
    Ok(Some((Dataset::read(path)?, meta)))
}
