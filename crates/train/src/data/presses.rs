//! Presses, labelled and unlabelled: what everything here learns from, judges and keeps.
//!
//! A press has one moment or many: times, frames, and the arm's approach where it is known. A frame
//! alone is a press of one moment. In: `.npz` files that numpy reads and writes, the simulator's
//! presses, recordings. Out: [`Presses`] of one or several files. `docs/formats.md` has the arrays.

pub mod file;
mod frames;

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::Path;

use anyhow::ensure;
use hardnessd_core::frame::{Array, Frame, Pitch};
use hardnessd_core::verdict::{
    COLS, COURSE_FRAMES, Card, Level, ModelFrame, Moment, Piece, ROWS, Resampling, TAXELS,
    TimeSeries, parts,
};
use hardnessd_core::wording;
use hardnessd_simulator::{LabelledCourse, LabelledSample, Labels, Split};

pub use self::file::{Layout, meta, write};
use self::frames::Frames;
use super::source::{Grid, Kind, Object, PITCH_MM, Source, papers_levels};

/// Newtons per unit of a file's `frames_mn`, and of the simulator's presses.
const MILLINEWTON: f32 = 1e-3;
/// What all presses of a call may take in memory, in bytes, and all arrays of a file.
const MOST_BYTES: usize = 8 << 30;

/// Labels and measurements of one press.
#[derive(Debug, Clone, Default, PartialEq)]
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
    pub reference: Option<Piece>,
    /// The recording and the number of the press in it, to read. Only recordings have it.
    pub name: Option<String>,
    /// The newtons of the array before the touch, without a zero taken: the sensor's own unloaded state. Only
    /// recordings have it.
    pub unloaded: Option<Vec<f32>>,
    /// The input `parts` of a model on the array's own grid, where the array is larger than the frames here. Only
    /// recordings have it.
    pub parts: Option<Vec<f32>>,
    /// The contact area of the best frame in the array's own taxels. A press with parts has it.
    pub contact_area_taxels: Option<u32>,
    /// What felt the press.
    pub kind: Kind,
    /// Index of the press's file in [`Presses::sources`].
    pub source: usize,
    /// The frame with the largest contact area, counted from the press's first one.
    pub best: usize,
    /// The press's moments among all. [`Presses::push`] sets it.
    pub moments: Range<usize>,
}

impl Press {
    fn labelled(labels: Labels, force_n: f32) -> Self {
        Self {
            level: labels.level,
            object: Some(labels.object),
            material: Some(labels.material),
            split: labels.split,
            shore: Some(labels.shore).filter(|shore| shore.is_finite()),
            force_n: Some(force_n),
            ..Self::default()
        }
    }

    /// The pressed object, if the data say which one it is.
    pub fn pressed(&self) -> Option<Object> {
        Some(Object {
            number: self.object?,
            material: self.material,
            level: self.level,
        })
    }
}

/// A frame of the simulated sensor, on the model's grid.
pub fn resampled(frame: &Frame) -> ModelFrame {
    Resampling::new(frame, Pitch::JX255N, PITCH_MM).apply(frame)
}

/// The taxels of an array in the middle of a frame.
fn in_the_middle(frame: &[f32; TAXELS], Array { rows, cols }: Array) -> Vec<f32> {
    let (top, left) = ((ROWS - rows) / 2, (COLS - cols) / 2);
    let lines = (top..top + rows).map(|row| &frame[row * COLS + left..][..cols]);
    lines.flatten().copied().collect()
}

/// File, level, number and material of an object.
pub type OfObject = (usize, u8, u64, Option<u8>);

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
    /// What they take in memory.
    bytes: usize,
    /// The files.
    pub sources: Vec<Source>,
}

impl Presses {
    /// Reads files, and joins them. Objects and sensors of different files stay apart.
    ///
    /// # Errors
    ///
    /// Returns an error if a file cannot be read, or an array is missing or has another type, shape or
    /// content than `docs/formats.md` says; or if the sensors of the files have different pitches.
    pub fn read(paths: &[impl AsRef<Path>]) -> anyhow::Result<Self> {
        let mut all = Self::default();
        for path in paths {
            all.join(file::read(path.as_ref())?)?;
        }
        Ok(all)
    }

    /// The simulator's frames.
    pub fn of_samples(samples: impl IntoIterator<Item = LabelledSample>) -> Self {
        let mut all = Self::default();
        for sample in samples {
            let press = Press::labelled(sample.labels, sample.force_n);
            all.push(press, [(0.0, None, resampled(&sample.frame).newtons)]);
        }
        all
    }

    /// The simulator's presses over time.
    pub fn of_courses(courses: impl IntoIterator<Item = LabelledCourse>) -> Self {
        let mut all = Self::default();
        for course in courses {
            let press = Press {
                arm_n_per_mm: course.arm_n_per_mm,
                sensor: course.sensor,
                reference: course.reference,
                best: course.best,
                ..Press::labelled(course.labels, course.force_n)
            };
            let moments = course.moments.iter().map(|moment| {
                let millinewtons = moment.millinewtons.iter();
                let newtons = millinewtons.map(|&mn| f32::from(mn) * MILLINEWTON);
                (moment.time_s, Some(moment.approach_mm), newtons)
            });
            all.push(press, moments);
        }
        all
    }

    /// Adds a press. Each of `moments` is the time since the press began in s, the approach in mm where
    /// known, and the newtons of the frame.
    pub fn push<F: IntoIterator<Item = f32>>(
        &mut self,
        mut press: Press,
        moments: impl IntoIterator<Item = (f32, Option<f32>, F)>,
    ) {
        let (first, before) = (self.frames.len(), self.frames.bytes());
        for (time_s, approach_mm, newtons) in moments {
            self.frames.push(newtons.into_iter());
            self.time_s.push(time_s);
            self.approach_mm.push(approach_mm);
        }
        press.moments = first..self.frames.len();
        self.bytes += size_of::<Press>() + self.frames.bytes() - before;
        for array in [&press.unloaded, &press.parts].into_iter().flatten() {
            self.bytes += size_of_val(&array[..]);
        }
        self.all.push(press);
    }

    /// Refuses presses that fill the memory.
    ///
    /// # Errors
    ///
    /// Returns an error if there are too many.
    pub(super) fn check_size(&self) -> anyhow::Result<()> {
        ensure!(
            self.bytes <= MOST_BYTES,
            "the presses take more than {} GB of memory: use fewer at a time",
            MOST_BYTES >> 30
        );
        Ok(())
    }

    /// Adds the presses of other files. Their objects and sensors are others than those that are there.
    ///
    /// # Errors
    ///
    /// Returns an error if the sensors of the files have different pitches, or all presses are too many.
    pub fn join(&mut self, mut other: Self) -> anyhow::Result<()> {
        if self.all.is_empty() {
            *self = other;
            return Ok(());
        }
        let next = |of: fn(&Press) -> Option<u32>| {
            let last = self.all.iter().filter_map(of).max();
            last.map_or(0, |last| last.saturating_add(1))
        };
        let (object, sensor) = (next(|press| press.object), next(|press| Some(press.sensor)));
        let objects: BTreeSet<u32> = other.all.iter().filter_map(|press| press.object).collect();
        ensure!(
            objects.len() <= (u32::MAX - object) as usize,
            "{}: no numbers are left for its objects beyond {object}",
            other.shown_paths()
        );
        let objects: BTreeMap<u32, u32> = objects.into_iter().zip(object..).collect();
        for press in &mut other.all {
            press.object = press.object.map(|own| objects[&own]);
            press.sensor = press.sensor.saturating_add(sensor);
        }
        self.append(other)
    }

    /// Adds the presses of other files, whose objects and sensors have the same numbers as those that are there.
    ///
    /// # Errors
    ///
    /// Returns an error if the sensors of the files have different pitches, or all presses are too many.
    pub(super) fn append(&mut self, other: Self) -> anyhow::Result<()> {
        let (found, expected) = (other.pitch_mm(), self.pitch_mm());
        ensure!(
            found == expected || self.sources.is_empty(),
            "{}: taxel pitch: found {found} mm, expected {expected} mm, that of {}",
            other.shown_paths(),
            self.shown_paths()
        );
        let (frames, sources) = (self.frames.len(), self.sources.len());
        self.frames.append(&other.frames);
        self.time_s.extend(other.time_s);
        self.approach_mm.extend(other.approach_mm);
        self.bytes += other.bytes;
        self.all.extend(other.all.into_iter().map(|press| Press {
            source: press.source + sources,
            moments: press.moments.start + frames..press.moments.end + frames,
            ..press
        }));
        self.sources.extend(other.sources);
        self.check_size()
    }

    /// The files, for an error.
    pub fn shown_paths(&self) -> String {
        let paths = self.sources.iter().map(|one| one.path.display());
        let paths: Vec<String> = paths.map(|path| path.to_string()).collect();
        paths.join(", ")
    }

    /// The levels that a model of these presses states: those of the first file that states some, otherwise
    /// the paper's.
    pub fn levels(&self) -> Vec<Level> {
        let mut sources = self.sources.iter();
        let stated = sources.find_map(|source| source.levels.clone());
        stated.unwrap_or_else(papers_levels)
    }

    /// Distance between the taxels of the sensors that were pressed, in mm.
    pub fn pitch_mm(&self) -> f64 {
        self.sources.first().map_or(PITCH_MM, Source::pitch)
    }

    /// The least and the greatest distance between the taxels of the sensors of some presses, if these
    /// differ.
    pub fn pitches_mm(&self, presses: &[usize]) -> Option<[f64; 2]> {
        let used: BTreeSet<usize> = self.of(presses).map(|press| press.source).collect();
        let used: Vec<&Source> = used.into_iter().map(|place| &self.sources[place]).collect();
        used.iter().find(|source| source.pitches_mm.is_some())?;
        let of = |source: &Source| source.pitches_mm.unwrap_or([source.pitch(); 2]);
        let both = |[a, b]: [f64; 2], [low, high]: [f64; 2]| [a.min(low), b.max(high)];
        used.into_iter().map(of).reduce(both)
    }

    /// How a file keeps them.
    pub fn layout(&self) -> Layout {
        Layout::of(self.are_over_time())
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
    pub fn some_labelled(&self, split: Split) -> anyhow::Result<Vec<usize>> {
        let found: Vec<usize> = self.labelled(split).collect();
        let name = wording::name(&split);
        ensure!(
            !found.is_empty(),
            "{}: no press of the {name} split has a level: add some with `collect --append --split {name} --level L`",
            self.shown_paths()
        );
        Ok(found)
    }

    /// The frame of a press with the largest contact area.
    pub fn frame(&self, press: usize) -> ModelFrame {
        self.frames.frame(self.best_row(press))
    }

    /// The force of that frame. Of an array that is larger than the frames here, a frame may lack a part of the contact.
    pub fn force_n(&self, press: usize) -> f32 {
        let Press { parts, force_n, .. } = &self.all[press];
        let whole = parts.as_ref().and(*force_n);
        whole.unwrap_or_else(|| self.frame(press).newtons.iter().sum())
    }

    fn best_row(&self, press: usize) -> usize {
        let Press { moments, best, .. } = &self.all[press];
        moments.start + best
    }

    /// The course of a press as the daemon would give it to a model of the same pitch: from the frame that began it.
    pub fn course(&self, press: usize) -> TimeSeries {
        let moment = |row: usize| Moment {
            time_s: self.time_s[row],
            approach_mm: self.approach_mm[row],
            frame: self.frames.frame(row),
        };
        TimeSeries {
            moments: self.rows(press).map(moment).collect(),
            arm_n_per_mm: self.all[press].arm_n_per_mm,
        }
    }

    /// The course of a press as the daemon would give it to this model.
    pub fn course_for(&self, press: usize, model: &Card) -> TimeSeries {
        let resampled = self.resampler(press, model);
        let mut course = self.course(press);
        for (moment, row) in course.moments.iter_mut().zip(self.rows(press)) {
            moment.frame = resampled(row);
        }
        course
    }

    /// The frame with the largest contact area as the daemon would give it to this model. A model with a grid of its
    /// own takes it as it is.
    pub fn frame_for(&self, press: usize, model: &Card) -> ModelFrame {
        match model.grid {
            Some(_) => self.frame(press),
            None => self.resampler(press, model)(self.best_row(press)),
        }
    }

    /// What resamples the frames of a press. The array that sent them lies in their middle. If it is not known, or
    /// larger than they are, they are as large as they look.
    fn resampler(&self, press: usize, model: &Card) -> impl Fn(usize) -> ModelFrame {
        let source = self.sources.get(self.all[press].source);
        let kept = source.and_then(|source| source.grid).filter(Grid::is_kept);
        let array = kept.map_or(Array::JX255N, |grid| grid.array);
        let own = move |row: usize| Frame {
            array,
            newtons: in_the_middle(&self.frames.frame(row).newtons, array).into(),
        };
        let pitch = Pitch::square(source.map_or(PITCH_MM, Source::pitch));
        let resampling = Resampling::new(&own(self.best_row(press)), pitch, model.pitch_mm.into());
        move |row| resampling.apply(&own(row))
    }

    /// Place and bits of the newtons of the taxels that are not 0, of each frame of a press.
    pub(super) fn contents(&self, press: usize) -> impl Iterator<Item = Vec<(u16, u32)>> {
        let rows = self.all[press].moments.clone();
        rows.map(|row| {
            let taxels = self.frames.taxels(row);
            taxels
                .map(|(place, newtons)| (place, newtons.to_bits()))
                .collect()
        })
    }

    /// The array that all presses are of, if it is one with square taxels, and each press has the parts that such an
    /// array needs.
    pub fn grid(&self) -> Option<Grid> {
        let grid = self.sources.first()?.grid?;
        let length = (!grid.is_kept()).then(|| parts::PARTS * grid.array.taxels());
        let fits = |press: &Press| press.parts.as_ref().map(Vec::len) == length;
        let is_one = self.sources.iter().all(|source| source.grid == Some(grid));
        (is_one && self.all.iter().all(fits)).then_some(grid)
    }

    /// The input `parts` of a model on the grid of the presses' own array.
    pub fn parts(&self, press: usize, array: Array) -> Vec<f32> {
        if let Some(parts) = &self.all[press].parts {
            return parts.clone();
        }
        let own = |row: usize| -> (f32, Vec<f32>) {
            let frame = self.frames.frame(row).newtons;
            (self.time_s[row], in_the_middle(&frame, array))
        };
        let frames: Vec<(f32, Vec<f32>)> = self.rows(press).map(own).collect();
        let moments = frames.iter().map(|(time_s, frame)| (*time_s, &frame[..]));
        parts::parts(&moments.collect::<Vec<_>>())
    }

    /// The frames of a press from the one that began it, as many as a model takes.
    fn rows(&self, press: usize) -> impl Iterator<Item = usize> {
        let rows = self.all[press].moments.clone();
        let pressed = rows.filter(|&row| self.time_s[row] >= 0.0);
        pressed.take(COURSE_FRAMES.1)
    }

    /// Whether the approach of a press is known.
    pub fn is_known(&self, press: usize) -> bool {
        let moments = self.all[press].moments.clone();
        self.approach_mm[moments].iter().any(Option::is_some)
    }

    /// The kinds of the labelled test presses whose objects were not learnt.
    pub fn validated(&self) -> BTreeSet<Kind> {
        let learnt = self.objects(Split::Train);
        let tested = self.labelled(Split::Test);
        let tested: BTreeSet<(Option<Object>, Kind)> = tested
            .map(|place| (self.all[place].pressed(), self.all[place].kind))
            .collect();
        let is_learnt = |object: &Object| learnt.iter().any(|other| other.is_same_as(object));
        let new = tested.into_iter();
        let new = new.filter(|(object, _)| !object.as_ref().is_some_and(is_learnt));
        new.map(|(_, kind)| kind).collect()
    }

    /// The objects of a split that are known and are no rigid pieces.
    fn objects(&self, split: Split) -> BTreeSet<Object> {
        let presses = self.all.iter();
        let presses = presses.filter(|press| press.split == split && press.reference.is_none());
        presses.filter_map(Press::pressed).collect()
    }

    /// The number of an object that has presses in both splits, if there is one.
    pub(super) fn object_in_both_splits(&self) -> Option<u32> {
        let (trained, tested) = (self.objects(Split::Train), self.objects(Split::Test));
        let is_tested = |object: &&Object| tested.iter().any(|other| other.is_same_as(object));
        trained.iter().find(is_tested).map(|object| object.number)
    }

    /// The presses of each object by its file, level, number and material, because numbers may begin anew for each
    /// material. A press whose object is not known is of one of its own.
    pub fn by_object(&self, places: &[usize]) -> BTreeMap<OfObject, Vec<usize>> {
        let mut objects = BTreeMap::<_, Vec<usize>>::new();
        for &place in places {
            let press = &self.all[place];
            let object = press.object.map_or(u64::MAX - place as u64, u64::from);
            let key = (press.source, press.level, object, press.material);
            objects.entry(key).or_default().push(place);
        }
        objects
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
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
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
pub fn read_one(path: &Path) -> anyhow::Result<Presses> {
    Presses::read(&[path])
}

#[cfg(test)]
mod tests;
