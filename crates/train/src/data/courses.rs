//! Presses over time as `.npz` files that numpy reads and writes.
//!
//! In: files, or the simulator's courses. Out: [`Courses`], with a row per kept frame and a row per
//! press. `docs/formats.md` has the arrays.

use std::collections::BTreeSet;
mod frames;

use std::io::{self, Seek, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

pub use self::frames::Frames;
use self::frames::NEWTONS;
use super::dataset::file::{self, FORCES_N, File, SHORE};
use super::dataset::{
    self, Dataset, DatasetError, Joining, Kind, Object, Sample, Source, levels,
    warn_of_object_in_both_splits,
};
use hardnessd_core::npz::Writer;
use hardnessd_core::verdict::{COLS, COURSE_FRAMES, ModelFrame, ROWS, TAXELS};
use hardnessd_simulator::{LabelledCourse, Reference, Split};

/// Presses over time. Each column is an array of the file.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Courses {
    /// The kept frames.
    pub frames: Frames,
    /// The number of each frame's press, ascending.
    pub press: Vec<u32>,
    /// Seconds since the frame that began the press. Negative before that frame.
    pub time_s: Vec<f32>,
    /// The approach of the arm since that frame, in mm. 0 where it is unknown.
    pub approach_mm: Vec<f32>,
    /// 1 where the approach is known.
    pub known: Vec<u8>,
    /// Labels and measurements of each press.
    pub presses: Vec<Press>,
}

/// Labels and measurements of one press.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Press {
    /// The hardness level 1..=4, or 0 for unlabelled.
    pub level: u8,
    /// The number of the pressed object, unique in the file.
    pub object: u32,
    /// Index into `meta.materials`.
    pub material: u8,
    /// The split: train or test.
    pub split: Split,
    /// Shore hardness; NaN where it was not measured.
    pub shore: f32,
    /// Force of the press: the greatest applied force if simulated, the chosen frame's total force
    /// if recorded.
    pub force_n: f32,
    /// Stiffness of the arm. 0 if unknown.
    pub arm_n_per_mm: f32,
    /// The number of the sensor. 0 if the file has one sensor, or does not name them.
    pub sensor: u32,
    /// The rigid piece that was pressed to show what the sensor reads. Such a press has no level.
    pub reference: Option<Reference>,
    /// The row of the frame that a model of single frames judges.
    pub best: u32,
}

impl Press {
    /// The pressed object.
    pub(super) fn pressed(&self) -> Object {
        Object {
            number: self.object,
            material: Some(self.material),
            level: self.level,
        }
    }
}

/// Reads a file of single frames, or of whole presses. A press gives the frame with its largest contact
/// area.
///
/// # Errors
///
/// Returns the errors of [`Dataset::read`] and [`Courses::read`].
pub fn single_frames(path: &Path) -> Result<Dataset, DatasetError> {
    if !Courses::is_at(path)? {
        return Dataset::read(path);
    }
    let (courses, source) = Courses::read_with_source(path)?;
    Ok(courses.best_frames(path, source))
}

/// An array with a value for each press: its name, and the value.
type Column<T> = (&'static str, fn(&Press) -> T);

impl Courses {
    /// The columns of simulated presses.
    pub fn of(courses: &[LabelledCourse]) -> Self {
        let mut all = Self::default();
        for course in courses {
            let press = Press {
                level: course.level,
                object: course.object,
                material: course.material,
                split: course.split,
                shore: course.shore,
                force_n: course.force_n,
                arm_n_per_mm: course.arm_n_per_mm,
                sensor: course.sensor,
                reference: course.reference,
                best: course.best as u32,
            };
            let moments = course.moments.iter().map(|moment| {
                let approach_mm = moment.known.then_some(moment.approach_mm);
                (
                    moment.time_s,
                    approach_mm,
                    moment.millinewtons.iter().copied(),
                )
            });
            all.add(press, moments);
        }
        all
    }

    /// Adds a press. Each of `moments` is the time since the press began in s, the approach in mm
    /// where known, and the frame. `press.best` counts from the first moment.
    pub fn push<'a>(
        &mut self,
        press: Press,
        moments: impl Iterator<Item = (f32, Option<f32>, &'a ModelFrame)>,
    ) {
        // A u16 holds up to 65 N on a taxel, which is beyond the range of any film.
        let millinewtons = |newtons: &f32| (newtons / NEWTONS).round() as u16;
        let moments = moments.map(|(time_s, approach_mm, frame)| {
            (time_s, approach_mm, frame.newtons.iter().map(millinewtons))
        });
        self.add(press, moments);
    }

    fn add<F: Iterator<Item = u16>>(
        &mut self,
        press: Press,
        moments: impl Iterator<Item = (f32, Option<f32>, F)>,
    ) {
        let (first, number) = (self.press.len() as u32, self.presses.len() as u32);
        for (time_s, approach_mm, millinewtons) in moments {
            self.frames.push(millinewtons);
            self.press.push(number);
            self.time_s.push(time_s);
            self.approach_mm.push(approach_mm.unwrap_or(0.0));
            self.known.push(approach_mm.is_some().into());
        }
        self.presses.push(Press {
            best: first + press.best,
            ..press
        });
    }

    /// The frame of each press with the largest contact area, as a data set of single frames. Presses
    /// of rigid pieces are left out.
    fn best_frames(&self, path: &Path, source: Source) -> Dataset {
        let sample = |press: &Press| Sample {
            frame: self.frame(press.best as usize),
            level: press.level,
            object: Some(press.object),
            material: Some(press.material),
            force_n: Some(press.force_n),
            split: press.split,
            shore: Some(press.shore).filter(|shore| shore.is_finite()),
            source: 0,
        };
        Dataset {
            samples: self
                .presses
                .iter()
                .filter(|press| press.reference.is_none())
                .map(sample)
                .collect(),
            sources: vec![source],
            paths: vec![path.to_owned()],
        }
    }

    /// The kinds of the labelled test presses, of files from `sources`, whose objects were not learnt.
    pub fn validated(&self, sources: &[Source]) -> BTreeSet<Kind> {
        let presses = self.presses.iter();
        let presses = presses.filter(|press| press.reference.is_none());
        let judged = |press: &Press| (sources, Some(press.pressed()), press.level, press.split);
        dataset::validated(presses.map(judged))
    }

    /// Indices of a split's presses whose level is known.
    pub fn labelled(&self, split: Split) -> impl Iterator<Item = usize> {
        let presses = self.presses.iter().enumerate();
        let wanted = presses.filter(move |(_, press)| press.split == split && press.level > 0);
        wanted.map(|(place, _)| place)
    }

    /// The rows of press number `press`.
    pub fn rows(&self, press: usize) -> Range<usize> {
        let first = |press: usize| self.press.partition_point(|&of| (of as usize) < press);
        first(press)..first(press + 1)
    }

    /// A kept frame in newtons.
    pub fn frame(&self, row: usize) -> ModelFrame {
        self.frames.newtons(row)
    }

    /// Whether the file has presses over time, and not single frames.
    ///
    /// # Errors
    ///
    /// Returns an error if the file cannot be read.
    pub fn is_at(path: &Path) -> Result<bool, DatasetError> {
        let bytes = file::read(path)?;
        Ok(File::open(&bytes, path)?.is_of_courses())
    }

    /// Reads several files as one, and gives the source of each. Objects of different files stay
    /// apart. Prints a warning if an object of a file has presses in both splits.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Courses::read`]. Also returns an error if the sensors of the files
    /// have different pitches, or the files have more objects than a u32 can number.
    pub fn read_all(paths: &[PathBuf]) -> Result<(Self, Vec<Source>), DatasetError> {
        let (mut all, mut joining) = (Self::default(), Joining::default());
        let mut first_sensor = 0;
        for path in paths {
            let (mut part, source) = Self::read_with_source(path)?;
            let presses = part.presses.iter();
            let presses = presses.map(|press| (press.pressed(), press.split));
            warn_of_object_in_both_splits(path, presses);
            let last = part.presses.iter().map(|press| press.object).max();
            let before = joining.add(source, path.clone(), last)?;
            // Sensors of different files are different ones.
            let sensors = part.presses.iter().map(|press| press.sensor).max();
            for press in &mut part.presses {
                press.sensor = press.sensor.saturating_add(first_sensor);
            }
            first_sensor = sensors.map_or(0, |last| last.saturating_add(first_sensor + 1));
            all.append(part, before);
        }
        Ok((all, joining.sources))
    }

    fn read_with_source(path: &Path) -> Result<(Self, Source), DatasetError> {
        let bytes = file::read(path)?;
        let mut file = File::open(&bytes, path)?;
        let meta = file.meta()?;
        let source = file::source(&bytes, &file, &meta)?;
        Ok((Self::parse(&bytes, path)?, source))
    }

    /// Adds the presses of another file. `objects` is added to their numbers of objects.
    pub(super) fn append(&mut self, other: Self, objects: u32) {
        let (rows, presses) = (self.press.len() as u32, self.presses.len() as u32);
        self.frames.append(&other.frames);
        self.press
            .extend(other.press.iter().map(|press| press + presses));
        self.time_s.extend(other.time_s);
        self.approach_mm.extend(other.approach_mm);
        self.known.extend(other.known);
        self.presses
            .extend(other.presses.into_iter().map(|press| Press {
                object: press.object + objects,
                best: press.best + rows,
                ..press
            }));
    }

    /// Reads a file.
    ///
    /// # Errors
    ///
    /// Returns an error if the file cannot be read, or an array is missing or has another type,
    /// shape or content than `docs/formats.md` says.
    pub fn read(path: &Path) -> Result<Self, DatasetError> {
        Self::parse(&file::read(path)?, path)
    }

    fn parse(bytes: &[u8], path: &Path) -> Result<Self, DatasetError> {
        let mut file = File::open(bytes, path)?;
        if file.is_of_frames() {
            return Err(DatasetError::SingleFrames {
                path: path.to_owned(),
            });
        }
        let frames_mn: Vec<u16> = file.required("frames_mn", &[ROWS, COLS], None)?;
        let rows = Some(frames_mn.len() / TAXELS);
        let press: Vec<u32> = file.required("press", &[], rows)?;
        let time_s: Vec<f32> = file.required("time_s", &[], rows)?;
        let approach_mm: Vec<f32> = file.required("approach_mm", &[], rows)?;
        let known: Vec<u8> = file.required("known", &[], rows)?;
        let level: Vec<u8> = file.required("level", &[], None)?;
        let count = Some(level.len());
        let object: Vec<u32> = file.required("object", &[], count)?;
        let material: Vec<u8> = file.required("material", &[], count)?;
        let split: Vec<u8> = file.required("split", &[], count)?;
        let shore: Vec<f32> = file.required("shore", &[], count)?;
        let force_n: Vec<f32> = file.required("force", &[], count)?;
        let arm_n_per_mm: Vec<f32> = file.required("arm_n_per_mm", &[], count)?;
        let best: Vec<u32> = file.required("best", &[], count)?;
        let sensor: Option<Vec<u32>> = file.read("sensor", &[], count)?;
        let reference: Option<Vec<u8>> = file.read("reference", &[], count)?;
        let reference_mm: Vec<f32> = match reference {
            Some(_) => file.required("reference_mm", &[], count)?,
            None => Vec::new(),
        };
        let reference = reference.unwrap_or_default();
        let kinds = "0 (no reference), 1 (flat) or 2 (ball)";
        file.within("reference", &reference, 2, kinds)?;
        for (array, values, range) in [
            ("reference_mm", &reference_mm, 0.0..=1e6),
            ("time_s", &time_s, -1e5..=1e5),
            ("approach_mm", &approach_mm, -1e6..=1e6),
            ("force", &force_n, FORCES_N),
            ("arm_n_per_mm", &arm_n_per_mm, 0.0..=1e6),
        ] {
            file.between(array, values, range)?;
        }
        let known_shore: Vec<f32> = shore
            .iter()
            .copied()
            .filter(|shore| !shore.is_nan())
            .collect();
        file.between("shore", &known_shore, SHORE)?;
        file.within("level", &level, levels().len() as u8, "0 (unlabelled) to 4")?;
        file.within("split", &split, 1, "0 (train) or 1 (test)")?;
        file.within("known", &known, 1, "0 or 1")?;
        if level.is_empty() {
            let (found, expected) = ("no press".to_owned(), "at least one".to_owned());
            return Err(file.error("level", found, expected));
        }
        let ascends = press.first() == Some(&0)
            && press
                .windows(2)
                .all(|pair| pair[1] == pair[0] || pair[1] == pair[0] + 1);
        let last = press.last().map_or(0, |&last| last as usize + 1);
        if !ascends || last != level.len() {
            let found = format!("{last} presses, or a step that is not 0 or 1");
            let expected = format!("0 to {}, each at least once", level.len() - 1);
            return Err(file.error("press", found, expected));
        }
        let labelled = |k: &usize| reference[*k] > 0 && level[*k] > 0;
        if let Some(k) = (0..reference.len()).find(labelled) {
            let found = format!("{} of press {k}, a reference", level[k]);
            return Err(file.error("level", found, "0".to_owned()));
        }
        let reference = |k: usize| match reference.get(k) {
            Some(1) => Some(Reference::Flat {
                width_mm: reference_mm[k],
            }),
            Some(2) => Some(Reference::Ball {
                radius_mm: reference_mm[k],
            }),
            _ => None,
        };
        let presses = (0..level.len()).map(|k| Press {
            level: level[k],
            object: object[k],
            material: material[k],
            split: if split[k] == 0 {
                Split::Train
            } else {
                Split::Test
            },
            shore: shore[k],
            force_n: force_n[k],
            arm_n_per_mm: arm_n_per_mm[k],
            sensor: sensor.as_ref().map_or(0, |sensor| sensor[k]),
            reference: reference(k),
            best: best[k],
        });
        let courses = Self {
            presses: presses.collect(),
            frames: Frames::of(&frames_mn),
            press,
            time_s,
            approach_mm,
            known,
        };
        for (number, press) in courses.presses.iter().enumerate() {
            let rows = courses.rows(number);
            if !rows.contains(&(press.best as usize)) {
                let found = format!("{} of press {number}", press.best);
                let expected = format!("one of its frames, {rows:?}");
                return Err(file.error("best", found, expected));
            }
            let times = &courses.time_s[rows];
            let used = times.iter().filter(|&&time_s| time_s >= 0.0).count();
            if !(1..=COURSE_FRAMES.1).contains(&used) {
                let found = format!("{used} frames at 0 s or later in press {number}");
                let expected = format!("1 to {}", COURSE_FRAMES.1);
                return Err(file.error("time_s", found, expected));
            }
            if !times.is_sorted_by(|a, b| a < b) {
                let found = format!("times that stand still or go back in press {number}");
                return Err(file.error("time_s", found, "ascending ones".to_owned()));
            }
        }
        Ok(courses)
    }

    /// Writes the file, compressed: most taxels of a frame are 0.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing to `out`.
    pub fn write<W: Write + Seek>(&self, out: W, meta: &serde_json::Value) -> io::Result<W> {
        let mut npz = Writer::compressed(out);
        let shape = [self.press.len(), ROWS, COLS];
        npz.add("frames_mn", &shape, &self.frames.dense())?;
        npz.add_list("press", &self.press)?;
        npz.add_list("time_s", &self.time_s)?;
        npz.add_list("approach_mm", &self.approach_mm)?;
        npz.add_list("known", &self.known)?;
        let bytes: [Column<u8>; 3] = [
            ("level", |press| press.level),
            ("material", |press| press.material),
            ("split", |press| press.split as u8),
        ];
        for (name, of) in bytes {
            let values: Vec<u8> = self.presses.iter().map(of).collect();
            npz.add_list(name, &values)?;
        }
        let numbers: [Column<u32>; 2] = [
            ("object", |press| press.object),
            ("best", |press| press.best),
        ];
        for (name, of) in numbers {
            let values: Vec<u32> = self.presses.iter().map(of).collect();
            npz.add_list(name, &values)?;
        }
        let reals: [Column<f32>; 3] = [
            ("shore", |press| press.shore),
            ("force", |press| press.force_n),
            ("arm_n_per_mm", |press| press.arm_n_per_mm),
        ];
        for (name, of) in reals {
            let values: Vec<f32> = self.presses.iter().map(of).collect();
            npz.add_list(name, &values)?;
        }
        let names_sensors = |press: &Press| press.sensor > 0 || press.reference.is_some();
        if self.presses.iter().any(names_sensors) {
            self.write_sensors(&mut npz)?;
        }
        npz.add_list("meta", meta.to_string().as_bytes())?;
        npz.finish()
    }
}

impl Courses {
    /// The arrays of a file that has several sensors, or references.
    fn write_sensors<W: Write + Seek>(&self, npz: &mut Writer<W>) -> io::Result<()> {
        let sensor: Vec<u32> = self.presses.iter().map(|press| press.sensor).collect();
        let references = self.presses.iter().map(|press| match press.reference {
            None => (0, 0.0),
            Some(Reference::Flat { width_mm }) => (1, width_mm),
            Some(Reference::Ball { radius_mm }) => (2, radius_mm),
        });
        let (reference, reference_mm): (Vec<u8>, Vec<f32>) = references.unzip();
        npz.add_list("sensor", &sensor)?;
        npz.add_list("reference", &reference)?;
        npz.add_list("reference_mm", &reference_mm)
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use serde_json::json;

    use super::*;
    use hardnessd_simulator::{self, CourseSettings, DatasetSettings, Materials};

    fn simulated() -> Courses {
        let settings = CourseSettings {
            objects: DatasetSettings {
                seed: 2,
                materials: Materials::Broad,
                objects: 1,
                test_objects: 0,
                presses: 2,
                ..DatasetSettings::default()
            },
            unknown_share: 0.5,
            ..CourseSettings::default()
        };
        Courses::of(&hardnessd_simulator::courses(&settings, 2, |_| ()))
    }

    fn round_trip(courses: &Courses) -> Result<Courses, DatasetError> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("courses.npz");
        let bytes = courses.write(Cursor::new(Vec::new()), &json!({"seed": 2}));
        std::fs::write(&path, bytes.unwrap().into_inner()).unwrap();
        assert_eq!(super::super::dataset::meta(&path).unwrap()["seed"], 2);
        Courses::read(&path)
    }

    #[test]
    fn a_file_gives_back_what_was_written() {
        let courses = simulated();
        assert!(courses.presses.len() >= 6);
        assert!(round_trip(&courses).unwrap() == courses);
        for (number, press) in courses.presses.iter().enumerate() {
            let area = |row: usize| courses.frame(row).contact_area_taxels(0.07);
            let most = courses.rows(number).map(area).max();
            assert_eq!(most, Some(area(press.best as usize)), "press {number}");
        }
    }

    #[test]
    fn sensors_and_references_are_kept_and_checked() {
        let mut courses = simulated();
        let [flat, ball] = [
            Reference::Flat { width_mm: 20.0 },
            Reference::Ball { radius_mm: 7.5 },
        ];
        for (place, reference) in [(1, flat), (3, ball)] {
            let press = &mut courses.presses[place];
            (press.level, press.reference) = (0, Some(reference));
            (press.shore, press.sensor) = (50.0, place as u32);
        }
        assert!(round_trip(&courses).unwrap() == courses);
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("courses.npz");
        let bytes = courses.write(Cursor::new(Vec::new()), &json!({}));
        std::fs::write(&path, bytes.unwrap().into_inner()).unwrap();
        let frames = single_frames(&path).unwrap();
        assert_eq!(frames.samples.len(), courses.presses.len() - 2);
        courses.presses[3].level = 2;
        let error = round_trip(&courses).unwrap_err().to_string();
        assert!(
            error.contains("`level`: found 2 of press 3, a reference, expected 0"),
            "{error}"
        );
    }

    #[test]
    fn objects_and_sensors_of_different_files_stay_apart() {
        let mut courses = Courses::default();
        for object in [0, 4] {
            let press = Press {
                level: 1,
                object,
                material: 0,
                split: Split::Train,
                shore: 80.0,
                force_n: 1.0,
                arm_n_per_mm: 0.0,
                sensor: 0,
                reference: None,
                best: 0,
            };
            courses.push(press, [(0.0, None, &ModelFrame::default())].into_iter());
        }
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("one");
        let bytes = courses.write(Cursor::new(Vec::new()), &json!({}));
        std::fs::write(&path, bytes.unwrap().into_inner()).unwrap();
        let (all, _) = Courses::read_all(&[path.clone(), path]).unwrap();
        let presses = all.presses.iter();
        let found: Vec<_> = presses.map(|press| (press.object, press.sensor)).collect();
        assert_eq!(found, [(0, 0), (4, 0), (5, 1), (9, 1)]);
    }

    #[test]
    fn what_contradicts_itself_is_refused() {
        let good = simulated();
        let check = |change: fn(&mut Courses), part: &str| {
            let mut bad = good.clone();
            change(&mut bad);
            let error = round_trip(&bad).unwrap_err().to_string();
            assert!(error.contains(part), "{error}");
        };
        check(|bad| bad.press[0] = 1, "array `press`");
        check(|bad| bad.time_s[1] = -9.0, "array `time_s`: found times");
        check(|bad| bad.time_s[1] = f32::NAN, "array `time_s`: found NaN");
        check(
            |bad| {
                let rows = bad.rows(0);
                let count = rows.len() as f32;
                rows.for_each(|row| bad.time_s[row] = row as f32 - count);
            },
            "array `time_s`: found 0 frames at 0 s or later in press 0, expected 1 to 48",
        );
        check(
            |bad| {
                // The first two presses become one that is too long.
                let second = bad.rows(1);
                let added = 60 - bad.rows(0).len().min(59);
                assert!(second.start > bad.rows(0).start);
                let first = &bad.frames.dense()[..TAXELS];
                let mut longer = Frames::of(&first.repeat(added));
                longer.append(&bad.frames);
                bad.frames = longer;
                for _ in 0..added {
                    bad.press.insert(0, 0);
                    bad.approach_mm.insert(0, 0.0);
                    bad.known.insert(0, 1);
                    bad.time_s.insert(0, 0.0);
                }
                bad.presses
                    .iter_mut()
                    .for_each(|press| press.best += added as u32);
                let rows = bad.rows(0);
                rows.for_each(|row| bad.time_s[row] = row as f32);
            },
            "frames at 0 s or later in press 0, expected 1 to 48",
        );
        check(
            |bad| bad.presses[0].best = 99_999,
            "array `best`: found 99999 of press 0",
        );
        check(|bad| bad.known[0] = 2, "array `known`: found 2");
        check(|bad| bad.presses[0].level = 5, "array `level`: found 5");
        check(|bad| bad.presses.truncate(1), "array `press`");
    }
}
