//! Presses, labelled and unlabelled: what everything here learns from, judges and keeps.
//!
//! A press has one moment or many: times, frames, and the arm's approach where it is known. A frame
//! alone is a press of one moment. In: `.npz` files that numpy reads and writes, the simulator's
//! presses, recordings. Out: [`Presses`] of one or several files. `docs/formats.md` has the arrays.

pub mod file;
mod frames;

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::PathBuf;
use std::slice;

use hardnessd_core::frame::{Array, Frame, Pitch};
use hardnessd_core::verdict::{
    COLS, COURSE_FRAMES, Course, Level, ModelFrame, ROWS, Resampling, Sample, parts,
};
use hardnessd_simulator::{LabelledCourse, LabelledSample, Reference, Split};

pub use self::file::{DatasetError, Layout, meta, write};
use self::frames::Frames;
use super::source::{self, Kind, Object, PITCH_MM, Source};

/// Newtons per unit of a file's `frames_mn`, and of the simulator's presses.
const MILLINEWTON: f32 = 1e-3;

/// Labels and measurements of one press.
#[derive(Debug, Clone, PartialEq)]
pub struct Press {
    /// The hardness level, from 1, or 0 for unlabelled.
    pub level: u8,
    /// The number of the pressed object, unique in the data.
    pub object: Option<u32>,
    /// Index into the file's `meta.materials`.
    pub material: Option<u8>,
    /// The split: train or test.
    pub split: Split,
    /// Measured Shore OO hardness.
    pub shore: Option<f32>,
    /// Force of the press: the greatest applied force if simulated, the chosen frame's total force if
    /// recorded.
    pub force_n: Option<f32>,
    /// Stiffness of the arm. 0 if unknown.
    pub arm_n_per_mm: f32,
    /// The number of the sensor. 0 if the data have one sensor, or do not name them.
    pub sensor: u32,
    /// The rigid piece that was pressed to show what the sensor reads. Such a press has no level.
    pub reference: Option<Reference>,
    /// The family of the object's shape, an index into [`hardnessd_simulator::Family::NAMES`]. Only simulated presses know it.
    pub shape: Option<u8>,
    /// Whether the object is a soft layer on a stiff core. Only simulated presses know it.
    pub layered: Option<bool>,
    /// The recording and the number of the press in it, to read. Only recordings have it.
    pub name: Option<String>,
    /// The newtons of the array before the touch, without a zero taken: the sensor's own unloaded state. Only
    /// recordings have it.
    pub unloaded: Option<Vec<f32>>,
    /// Index of the press's file in [`Presses::sources`].
    pub source: usize,
    /// The frame with the largest contact area, counted from the press's first one.
    pub best: usize,
    /// The press's moments among all. [`Presses::push`] sets it.
    pub moments: Range<usize>,
}

impl Default for Press {
    fn default() -> Self {
        Self {
            level: 0,
            object: None,
            material: None,
            split: Split::Train,
            shore: None,
            force_n: None,
            arm_n_per_mm: 0.0,
            sensor: 0,
            reference: None,
            shape: None,
            layered: None,
            name: None,
            unloaded: None,
            source: 0,
            best: 0,
            moments: 0..0,
        }
    }
}

impl Press {
    /// The pressed object, if the data say which one it is.
    pub fn pressed(&self) -> Option<Object> {
        Some(Object {
            number: self.object?,
            material: self.material,
            level: self.level,
        })
    }
}

/// When the frames of a press came, and how far the arm was then.
#[derive(Debug, Clone, PartialEq)]
pub struct Timed {
    /// Seconds since the press began, and the approach where it is known.
    pub moments: Vec<(f32, Option<f32>)>,
    /// Stiffness of the arm. 0 if unknown.
    pub arm_n_per_mm: f32,
}

/// A frame of the simulated sensor, on the model's grid.
pub fn resampled(frame: &Frame) -> ModelFrame {
    Resampling::new(frame, Pitch::JX255N, PITCH_MM).apply(frame)
}

/// Presses of one or several files.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Presses {
    /// Labels and measurements of each press.
    pub all: Vec<Press>,
    /// The frames of all presses.
    frames: Frames,
    /// Seconds of each frame since the one that began its press. Negative before that frame.
    time_s: Vec<f32>,
    /// The approach of the arm since that frame, in mm, where it is known.
    approach_mm: Vec<Option<f32>>,
    /// The files.
    pub sources: Vec<Source>,
    /// The paths of the files.
    pub paths: Vec<PathBuf>,
}

impl Presses {
    /// Reads files, and joins them. Objects and sensors of different files stay apart. Prints a warning if an
    /// object of a file has presses in both splits.
    ///
    /// # Errors
    ///
    /// Returns an error if a file cannot be read, or an array is missing or has another type, shape or
    /// content than `docs/formats.md` says; if the sensors of the files have different pitches; or if the
    /// files have more objects than a u32 can number.
    pub fn read(paths: &[PathBuf]) -> Result<Self, DatasetError> {
        let mut all = Self::default();
        for path in paths {
            let part = file::read(path)?;
            part.warn_of_object_in_both_splits();
            if all.sources.is_empty() {
                all = part;
            } else {
                all.join(part)?;
            }
        }
        Ok(all)
    }

    /// The simulator's frames.
    pub fn of_samples(samples: Vec<LabelledSample>) -> Self {
        let mut all = Self::default();
        for sample in samples {
            let press = Press {
                level: sample.level,
                object: Some(sample.object),
                material: Some(sample.material),
                split: sample.split,
                shore: Some(sample.shore),
                force_n: Some(sample.force_n),
                ..Press::default()
            };
            all.push(press, [(0.0, None, resampled(&sample.frame))].into_iter());
        }
        all
    }

    /// The simulator's presses over time.
    pub fn of_courses(courses: &[LabelledCourse]) -> Self {
        let mut all = Self::default();
        for course in courses {
            let press = Press {
                level: course.level,
                object: Some(course.object),
                material: Some(course.material),
                split: course.split,
                shore: Some(course.shore).filter(|shore| shore.is_finite()),
                force_n: Some(course.force_n),
                arm_n_per_mm: course.arm_n_per_mm,
                sensor: course.sensor,
                reference: course.reference,
                shape: Some(course.family as u8),
                layered: Some(course.layered),
                best: course.best,
                ..Press::default()
            };
            let moments = course.moments.iter().map(|moment| {
                let millinewtons = moment.millinewtons.iter();
                let newtons = millinewtons.map(|&mn| f32::from(mn) * MILLINEWTON);
                (moment.time_s, Some(moment.approach_mm), newtons)
            });
            all.add(press, moments);
        }
        all
    }

    /// Adds a press. Each of `moments` is the time since the press began in s, the approach in mm where
    /// known, and the frame.
    pub fn push(
        &mut self,
        press: Press,
        moments: impl Iterator<Item = (f32, Option<f32>, ModelFrame)>,
    ) {
        let moments = moments.map(|(time_s, mm, frame)| (time_s, mm, frame.newtons.into_iter()));
        self.add(press, moments);
    }

    fn add<F: Iterator<Item = f32>>(
        &mut self,
        mut press: Press,
        moments: impl Iterator<Item = (f32, Option<f32>, F)>,
    ) {
        let first = self.frames.len();
        for (time_s, approach_mm, newtons) in moments {
            self.frames.push(newtons);
            self.time_s.push(time_s);
            self.approach_mm.push(approach_mm);
        }
        press.moments = first..self.frames.len();
        self.all.push(press);
    }

    /// Adds the presses of another file.
    fn join(&mut self, mut other: Self) -> Result<(), DatasetError> {
        let (found, expected) = (other.pitch_mm(), self.pitch_mm());
        let path = other.paths[0].clone();
        if found != expected {
            return Err(DatasetError::Pitch {
                path,
                found,
                expected,
                first: self.paths[0].clone(),
            });
        }
        let next = |presses: &[Press], of: fn(&Press) -> Option<u32>| {
            let last = presses.iter().filter_map(of).max();
            last.map_or(0, |last| u64::from(last) + 1)
        };
        let (first, more) = (
            next(&self.all, |p| p.object),
            next(&other.all, |p| p.object),
        );
        let before = match u32::try_from(first) {
            Ok(before) if first + more <= u64::from(u32::MAX) + 1 => before,
            _ => {
                return Err(DatasetError::Array {
                    path,
                    array: "object",
                    found: more.saturating_sub(1).to_string(),
                    expected: format!(
                        "no number that, after {first} of other files, is beyond {}",
                        u32::MAX
                    ),
                });
            }
        };
        // Sensors of different files are different ones.
        let sensors = next(&self.all, |press| Some(press.sensor));
        for press in &mut other.all {
            let sensor = sensors.saturating_add(press.sensor.into());
            press.sensor = u32::try_from(sensor).unwrap_or(u32::MAX);
        }
        other.sources[0].shift_objects(before);
        self.append(other, before);
        Ok(())
    }

    /// Adds the presses of another file as they are. `objects` is added to their numbers of objects.
    pub(super) fn append(&mut self, other: Self, objects: u32) {
        let (frames, sources) = (self.frames.len(), self.sources.len());
        self.frames.append(&other.frames);
        self.time_s.extend(other.time_s);
        self.approach_mm.extend(other.approach_mm);
        self.all.extend(other.all.into_iter().map(|press| Press {
            object: press.object.map(|object| object + objects),
            source: press.source + sources,
            moments: press.moments.start + frames..press.moments.end + frames,
            ..press
        }));
        self.sources.extend(other.sources);
        self.paths.extend(other.paths);
    }

    /// The path of the first file.
    pub fn path(&self) -> PathBuf {
        self.paths.first().cloned().unwrap_or_default()
    }

    /// The files, for an error.
    fn shown_paths(&self) -> String {
        let paths = self.paths.iter().map(|path| path.display().to_string());
        paths.collect::<Vec<_>>().join(", ")
    }

    /// The levels that a model of these presses states.
    pub fn levels(&self) -> Vec<Level> {
        source::levels_of(&self.sources)
    }

    /// Distance between the taxels of the sensors that were pressed, in mm.
    pub fn pitch_mm(&self) -> f64 {
        source::pitch_mm(&self.sources)
    }

    /// The least and the greatest distance between the taxels of the sensors of some presses, if these
    /// differ.
    pub fn pitches_mm(&self, presses: &[usize]) -> Option<[f64; 2]> {
        let used: BTreeSet<usize> = presses
            .iter()
            .map(|&press| self.all[press].source)
            .collect();
        let used: Vec<&Source> = used.into_iter().map(|place| &self.sources[place]).collect();
        used.iter().find(|source| source.pitches_mm.is_some())?;
        let of = |source: &Source| {
            let own = source.pitch_mm.unwrap_or(PITCH_MM);
            source.pitches_mm.unwrap_or([own; 2])
        };
        let both = |[a, b]: [f64; 2], [low, high]: [f64; 2]| [a.min(low), b.max(high)];
        used.into_iter().map(of).reduce(both)
    }

    /// Whether a press has more than one moment.
    pub fn are_over_time(&self) -> bool {
        self.frames.len() > self.all.len()
    }

    /// Indices of a split's labelled presses.
    pub fn labelled(&self, split: Split) -> impl Iterator<Item = usize> {
        let presses = self.all.iter().enumerate();
        let wanted = presses.filter(move |(_, press)| press.split == split && press.level > 0);
        wanted.map(|(place, _)| place)
    }

    /// The same, of which there must be some.
    ///
    /// # Errors
    ///
    /// Returns an error if the split has no labelled press.
    pub fn some_labelled(&self, split: Split) -> Result<Vec<usize>, DatasetError> {
        let found: Vec<usize> = self.labelled(split).collect();
        match found.is_empty() {
            false => Ok(found),
            true => Err(DatasetError::EmptySplit {
                paths: self.shown_paths(),
                split: split.name(),
            }),
        }
    }

    /// The frame of a press with the largest contact area.
    pub fn frame(&self, press: usize) -> ModelFrame {
        let Press { moments, best, .. } = &self.all[press];
        self.frames.frame(moments.start + best)
    }

    /// The course of a press as the daemon would give it to a model: from the frame that began it.
    pub fn course(&self, press: usize) -> Course {
        let moment = |row: usize| Sample {
            time_s: self.time_s[row],
            approach_mm: self.approach_mm[row],
            frame: self.frames.frame(row),
        };
        Course {
            moments: self.rows(press).map(moment).collect(),
            arm_n_per_mm: self.all[press].arm_n_per_mm,
        }
    }

    /// Place and newtons of the taxels that are not 0, of each frame of a press.
    pub(super) fn contents(&self, press: usize) -> impl Iterator<Item = Vec<(u16, f32)>> {
        let rows = self.all[press].moments.clone();
        rows.map(|row| self.frames.taxels(row).collect())
    }

    /// The array whose frames all presses have as they are.
    pub fn grid(&self) -> Option<Array> {
        let first = self.sources.first()?.grid;
        first.filter(|_| self.sources.iter().all(|source| source.grid == first))
    }

    /// The input `parts` of a model on the grid of the presses' own array.
    pub fn parts(&self, press: usize, Array { rows, cols }: Array) -> Vec<f32> {
        let (top, left) = ((ROWS - rows) / 2, (COLS - cols) / 2);
        let own = |row: usize| {
            let frame = self.frames.frame(row).newtons;
            let lines = (top..top + rows).map(move |row| row * COLS + left);
            let taxels = lines.flat_map(|first| first..first + cols);
            taxels.map(|place| frame[place]).collect::<Vec<f32>>()
        };
        let frames: Vec<(f32, Vec<f32>)> = self
            .rows(press)
            .map(|row| (self.time_s[row], own(row)))
            .collect();
        let moments = frames
            .iter()
            .map(|(time_s, newtons)| (*time_s, &newtons[..]));
        parts::parts(&moments.collect::<Vec<_>>())
    }

    /// The same without the frames.
    pub fn timed(&self, press: usize) -> Timed {
        let moment = |row: usize| (self.time_s[row], self.approach_mm[row]);
        Timed {
            moments: self.rows(press).map(moment).collect(),
            arm_n_per_mm: self.all[press].arm_n_per_mm,
        }
    }

    /// The frames of a press from the one that began it, as many as a model takes.
    fn rows(&self, press: usize) -> impl Iterator<Item = usize> {
        let rows = self.all[press].moments.clone();
        let pressed = rows.filter(|&row| self.time_s[row] >= 0.0);
        pressed.take(COURSE_FRAMES.1)
    }

    /// The number of presses whose approach is known.
    pub fn known(&self) -> usize {
        let knows = |press: &&Press| {
            let approach = &self.approach_mm[press.moments.clone()];
            approach.iter().any(Option::is_some)
        };
        self.all.iter().filter(knows).count()
    }

    /// The kinds of the labelled test presses whose objects were not learnt.
    pub fn validated(&self) -> BTreeSet<Kind> {
        let presses = self.all.iter().filter(|press| press.reference.is_none());
        source::validated(presses.map(|press| {
            let source = &self.sources[press.source];
            (source, press.pressed(), press.level, press.split)
        }))
    }

    /// The kinds of some presses.
    pub fn kinds(&self, presses: &[usize]) -> BTreeSet<Kind> {
        let presses = self.of(presses);
        presses
            .flat_map(|press| self.sources[press.source].kinds_of(press.pressed()))
            .collect()
    }

    fn warn_of_object_in_both_splits(&self) {
        let presses = self.all.iter();
        let presses = presses.filter_map(|press| Some((press.pressed()?, press.split)));
        if let Some(object) = source::object_in_both_splits(presses) {
            hardnessd_core::stderr_line!(
                "warning: {}: object {object} is in both splits: its presses are near-copies, so a test on some \
                 of them overrates a model that learnt from the others",
                self.path().display()
            );
        }
    }

    /// The presses of some indices.
    pub fn of(&self, places: &[usize]) -> impl ExactSizeIterator<Item = &Press> + Clone {
        places.iter().map(|&place| &self.all[place])
    }

    /// For each press the unit that an interval draws: the cover whose sensors read the same presses, where a
    /// file has several sensors, else the object. `None` if a press has no object.
    pub fn units(&self, presses: &[usize]) -> Option<(Unit, Vec<u32>)> {
        let objects: Option<Vec<u32>> = self.of(presses).map(|press| press.object).collect();
        let mut of_files = BTreeMap::new();
        let has_several = self.of(presses).any(|press| {
            let first = of_files.entry(press.source).or_insert(press.sensor);
            *first != press.sensor
        });
        let objects = objects?;
        Some(match has_several {
            true => (Unit::Cover, self.stations(presses)),
            false => (Unit::Object, objects),
        })
    }

    /// The least sensor that a press's object was pressed on. Sensors under one cover press the same
    /// objects, so this numbers the covers.
    pub fn stations(&self, presses: &[usize]) -> Vec<u32> {
        let mut first = BTreeMap::<Option<u32>, u32>::new();
        for press in self.of(presses) {
            let own = first.entry(press.object).or_insert(press.sensor);
            *own = press.sensor.min(*own);
        }
        self.of(presses).map(|press| first[&press.object]).collect()
    }
}

/// What is drawn as a whole for an interval.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Unit {
    /// An object with all its presses.
    Object,
    /// A cover with all its sensors and objects.
    Cover,
}

/// Reads one file.
///
/// # Errors
///
/// Returns the errors of [`Presses::read`].
pub fn read_one(path: &std::path::Path) -> Result<Presses, DatasetError> {
    Presses::read(slice::from_ref(&path.to_owned()))
}

#[cfg(test)]
mod tests;
