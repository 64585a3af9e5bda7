//! Presses as `.npz` files: arrays with the names, types and shapes of `docs/formats.md`.

use std::collections::BTreeMap;
use std::io::{self, Cursor, Read, Seek, Write};
use std::ops::RangeInclusive;
use std::os::unix::fs::FileTypeExt as _;
use std::path::{Path, PathBuf};

use zip::ZipArchive;
use zip::result::ZipError;

use super::{MILLINEWTON, Press, Presses};
use crate::data::source::{Kind, MOST_LEVELS, SIMULATOR, Source, papers_levels};
use hardnessd_core::frame::Array;
use hardnessd_core::npy::Header;
use hardnessd_core::npz::{Element, Writer};
use hardnessd_core::verdict::{COLS, COURSE_FRAMES, Level, ROWS, TAXELS, check_levels, sha256_hex};
use hardnessd_simulator::{BroadSensors, Family, Reference, Split};

/// A force beyond any sensor's, and low enough that sums of squares stay finite.
const MOST_NEWTONS: f32 = 1e6;
/// The forces of taxels and presses.
pub(in crate::data) const FORCES_N: RangeInclusive<f32> = -MOST_NEWTONS..=MOST_NEWTONS;
/// What a durometer can show.
pub(in crate::data) const SHORE: RangeInclusive<f32> = 0.0..=100.0;
/// Distances between taxels, in mm.
const PITCHES_MM: RangeInclusive<f64> = 0.01..=1000.0;

/// The largest ratio of an array's size to its packed size. Frames of presses are packed to a
/// tenth, and arrays of zeros to a thousandth.
const MOST_PACKED: u64 = 256;
/// An array up to this size, or up to that of a larger array of the same file, may have any ratio.
/// An approach that is never known is all zeros, however many frames there are.
const FREE_BYTES: u64 = 16 << 20;

/// The reason that a file is not a data set, or that files do not go together.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The file is missing or unreadable.
    #[error("{}: {source}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The file is not a zip archive of arrays.
    #[error("{}: not an .npz file, or a damaged one", path.display())]
    NotNpz {
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
    /// The split has no labelled press.
    #[error(
        "{paths}: no press of the {split} split has a level: add some with `collect --append \
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

/// How a file keeps presses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layout {
    /// One frame of each press, in newtons.
    Frames,
    /// All moments of each press, in millinewtons.
    OverTime,
}

/// Reads a file of either layout.
pub(super) fn read(path: &Path) -> Result<Presses, DatasetError> {
    parse(&whole_of(path)?, path)
}

/// The layout of a file.
///
/// # Errors
///
/// Returns an error if the file cannot be read, or is no archive of arrays.
pub(crate) fn layout_of(path: &Path) -> Result<Layout, DatasetError> {
    Ok(File::open(&whole_of(path)?, path)?.layout())
}

/// Reads the presses in `bytes`, the content of the file `path`.
pub(super) fn parse(bytes: &[u8], path: &Path) -> Result<Presses, DatasetError> {
    let mut file = File::open(bytes, path)?;
    let meta = file.meta()?;
    let source = source(bytes, &file, &meta)?;
    let levels = source
        .levels
        .as_ref()
        .map_or(papers_levels().len(), Vec::len);
    let mut presses = match file.layout() {
        Layout::Frames => frames(&mut file)?,
        Layout::OverTime => over_time(&mut file)?,
    };
    let level: Vec<u8> = presses.all.iter().map(|press| press.level).collect();
    let expected = format!("0 (unlabelled) to {levels}");
    file.within("level", &level, levels as u8, &expected)?;
    presses.sources = vec![source];
    presses.paths = vec![path.to_owned()];
    Ok(presses)
}

/// Reads single frames.
fn frames(file: &mut File) -> Result<Presses, DatasetError> {
    let frames: Vec<f32> = file.required("frames", &[ROWS, COLS], None)?;
    let n = frames.len() / TAXELS;
    if n == 0 {
        return Err(file.error("frames", "no frame".to_owned(), "at least one".to_owned()));
    }
    if let Some(place) = frames.iter().position(|n| !FORCES_N.contains(n)) {
        let (frame, taxel) = (place / TAXELS, place % TAXELS);
        let (row, col) = (taxel / COLS, taxel % COLS);
        let found = format!("{:?} at [{frame},{row},{col}]", frames[place]);
        let expected = format!(
            "newtons from {:e} to {:e}",
            FORCES_N.start(),
            FORCES_N.end()
        );
        return Err(file.error("frames", found, expected));
    }
    let level: Vec<u8> = file.required("level", &[], Some(n))?;
    let object: Option<Vec<u32>> = file.read("object", &[], Some(n))?;
    let material: Option<Vec<u8>> = file.read("material", &[], Some(n))?;
    let force: Option<Vec<f32>> = file.read("force", &[], Some(n))?;
    let split: Option<Vec<u8>> = file.read("split", &[], Some(n))?;
    let shore: Option<Vec<f32>> = file.read("shore", &[], Some(n))?;
    file.between("force", force.as_deref().unwrap_or_default(), FORCES_N)?;
    file.between("shore", shore.as_deref().unwrap_or_default(), SHORE)?;
    let splits = split.unwrap_or_else(|| vec![0; n]);
    file.within("split", &splits, 1, "0 (train) or 1 (test)")?;
    let mut presses = Presses::default();
    for (index, newtons) in frames.chunks(TAXELS).enumerate() {
        let press = Press {
            level: level[index],
            object: object.as_ref().map(|values| values[index]),
            material: material.as_ref().map(|values| values[index]),
            force_n: force.as_ref().map(|values| values[index]),
            split: split_of(splits[index]),
            shore: shore.as_ref().map(|values| values[index]),
            ..Press::default()
        };
        presses.add(press, [(0.0, None, newtons.iter().copied())].into_iter());
    }
    Ok(presses)
}

fn split_of(number: u8) -> Split {
    match number {
        0 => Split::Train,
        _ => Split::Test,
    }
}

/// The arrays of presses over time that have a value for each press.
struct Columns {
    level: Vec<u8>,
    object: Vec<u32>,
    material: Vec<u8>,
    split: Vec<u8>,
    shore: Vec<f32>,
    force_n: Vec<f32>,
    arm_n_per_mm: Vec<f32>,
    best: Vec<u32>,
    sensor: Option<Vec<u32>>,
    shape: Option<Vec<u8>>,
    layered: Option<Vec<u8>>,
    reference: Vec<Option<Reference>>,
}

impl Columns {
    fn read(file: &mut File) -> Result<Self, DatasetError> {
        let level: Vec<u8> = file.required("level", &[], None)?;
        let count = Some(level.len());
        if level.is_empty() {
            let (found, expected) = ("no press".to_owned(), "at least one".to_owned());
            return Err(file.error("level", found, expected));
        }
        let columns = Self {
            object: file.required("object", &[], count)?,
            material: file.required("material", &[], count)?,
            split: file.required("split", &[], count)?,
            shore: file.required("shore", &[], count)?,
            force_n: file.required("force", &[], count)?,
            arm_n_per_mm: file.required("arm_n_per_mm", &[], count)?,
            best: file.required("best", &[], count)?,
            sensor: file.read("sensor", &[], count)?,
            shape: file.read("shape", &[], count)?,
            layered: file.read("layered", &[], count)?,
            reference: references(file, &level)?,
            level,
        };
        let shore = columns.shore.iter().copied();
        let known: Vec<f32> = shore.filter(|shore| !shore.is_nan()).collect();
        file.between("shore", &known, SHORE)?;
        file.between("force", &columns.force_n, FORCES_N)?;
        file.between("arm_n_per_mm", &columns.arm_n_per_mm, 0.0..=1e6)?;
        file.within("split", &columns.split, 1, "0 (train) or 1 (test)")?;
        for (array, values, most) in [
            ("shape", &columns.shape, Family::NAMES.len() as u8 - 1),
            ("layered", &columns.layered, 1),
        ] {
            let values = values.as_deref().unwrap_or_default();
            file.within(array, values, most, &format!("0 to {most}"))?;
        }
        Ok(columns)
    }

    fn press(&self, k: usize) -> Press {
        Press {
            level: self.level[k],
            object: Some(self.object[k]),
            material: Some(self.material[k]),
            split: split_of(self.split[k]),
            shore: Some(self.shore[k]).filter(|shore| shore.is_finite()),
            force_n: Some(self.force_n[k]),
            arm_n_per_mm: self.arm_n_per_mm[k],
            sensor: self.sensor.as_ref().map_or(0, |sensor| sensor[k]),
            reference: self.reference[k],
            shape: self.shape.as_ref().map(|shape| shape[k]),
            layered: self.layered.as_ref().map(|layered| layered[k] == 1),
            ..Press::default()
        }
    }
}

/// The rigid piece of each press. Such a press has no level.
fn references(file: &mut File, level: &[u8]) -> Result<Vec<Option<Reference>>, DatasetError> {
    let count = level.len();
    let Some(kinds) = file.read::<u8>("reference", &[], Some(count))? else {
        return Ok(vec![None; count]);
    };
    let mm: Vec<f32> = file.required("reference_mm", &[], Some(count))?;
    let expected = "0 (no reference), 1 (flat) or 2 (ball)";
    file.within("reference", &kinds, 2, expected)?;
    file.between("reference_mm", &mm, 0.0..=1e6)?;
    if let Some(k) = (0..count).find(|&k| kinds[k] > 0 && level[k] > 0) {
        let found = format!("{} of press {k}, a reference", level[k]);
        return Err(file.error("level", found, "0".to_owned()));
    }
    let of = |(&kind, &mm): (&u8, &f32)| match kind {
        1 => Some(Reference::Flat { width_mm: mm }),
        2 => Some(Reference::Ball { radius_mm: mm }),
        _ => None,
    };
    Ok(kinds.iter().zip(&mm).map(of).collect())
}

/// Reads presses over time.
fn over_time(file: &mut File) -> Result<Presses, DatasetError> {
    let frames_mn: Vec<i32> = file.required("frames_mn", &[ROWS, COLS], None)?;
    let rows = Some(frames_mn.len() / TAXELS);
    let press: Vec<u32> = file.required("press", &[], rows)?;
    let time_s: Vec<f32> = file.required("time_s", &[], rows)?;
    let approach_mm: Vec<f32> = file.required("approach_mm", &[], rows)?;
    let known: Vec<u8> = file.required("known", &[], rows)?;
    file.between("time_s", &time_s, -1e5..=1e5)?;
    file.between("approach_mm", &approach_mm, -1e6..=1e6)?;
    file.within("known", &known, 1, "0 or 1")?;
    let columns = Columns::read(file)?;
    let count = columns.level.len();
    let ascends = press.first() == Some(&0)
        && press
            .windows(2)
            .all(|pair| pair[1] == pair[0] || pair[1] == pair[0] + 1);
    let last = press.last().map_or(0, |&last| last as usize + 1);
    if !ascends || last != count {
        let found = format!("{last} presses, or a step that is not 0 or 1");
        let expected = format!("0 to {}, each at least once", count - 1);
        return Err(file.error("press", found, expected));
    }
    let mut presses = Presses::default();
    let mut first = 0;
    for (number, of_press) in press.chunk_by(|a, b| a == b).enumerate() {
        let rows = first..first + of_press.len();
        first = rows.end;
        let best = columns.best[number] as usize;
        if !rows.contains(&best) {
            let found = format!("{best} of press {number}");
            let expected = format!("one of its frames, {rows:?}");
            return Err(file.error("best", found, expected));
        }
        let times = &time_s[rows.clone()];
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
        let press = Press {
            best: best - rows.start,
            ..columns.press(number)
        };
        let moments = rows.map(|row| {
            let millinewtons = frames_mn[row * TAXELS..][..TAXELS].iter();
            let newtons = millinewtons.map(|&mn| mn as f32 * MILLINEWTON);
            let approach = (known[row] == 1).then_some(approach_mm[row]);
            (time_s[row], approach, newtons)
        });
        presses.add(press, moments);
    }
    if let Some(Array { rows, cols }) = grid(&file.meta()?) {
        let unloaded = file.read::<f32>("unloaded", &[rows, cols], Some(count))?;
        let each = unloaded
            .iter()
            .flat_map(|all| all.chunks_exact(rows * cols));
        for (press, newtons) in presses.all.iter_mut().zip(each) {
            press.unloaded = Some(newtons.to_vec());
        }
    }
    Ok(presses)
}

/// Reads a whole file. Refuses a device, such as a serial port, because it has no end.
pub(in crate::data) fn whole(path: &Path) -> std::io::Result<Vec<u8>> {
    if std::fs::metadata(path)?.file_type().is_char_device() {
        return Err(std::io::Error::other("found a device, expected a file"));
    }
    std::fs::read(path)
}

fn whole_of(path: &Path) -> Result<Vec<u8>, DatasetError> {
    whole(path).map_err(|source| DatasetError::Unreadable {
        path: path.to_owned(),
        source,
    })
}

/// The source of a file's presses.
fn source(bytes: &[u8], file: &File, meta: &serde_json::Value) -> Result<Source, DatasetError> {
    let refused = |key: &str, expected: &str| {
        let found = format!("{key} {}", meta[key]);
        file.error("meta", found, expected.to_owned())
    };
    let pitch_mm = meta["pitch_mm"]
        .as_f64()
        .filter(|mm| PITCHES_MM.contains(mm));
    if !meta["pitch_mm"].is_null() && pitch_mm.is_none() {
        return Err(refused("pitch_mm", "millimetres from 0.01 to 1000"));
    }
    let seed = meta["seed"].as_u64();
    // A run keeps the seed in TOML, which has no larger numbers.
    if seed.is_some_and(|seed| i64::try_from(seed).is_err()) {
        return Err(refused("seed", "a number up to 9223372036854775807"));
    }
    let stated: Option<Vec<Level>> = serde_json::from_value(meta["levels"].clone()).ok();
    let stated = stated.filter(|of| check_levels(of).is_ok() && of.len() <= MOST_LEVELS);
    if !meta["levels"].is_null() && stated.is_none() {
        return Err(refused(
            "levels",
            "`level`, `label` and `shore` of each of 2 to 16 levels, from 1 on",
        ));
    }
    let name = file.path.file_name().unwrap_or_default();
    Ok(Source {
        name: name.to_string_lossy().into_owned(),
        seed,
        sha256: sha256_hex(bytes),
        generator: meta["generator"].as_str().map(str::to_owned),
        pitch_mm,
        grid: grid(meta),
        pitches_mm: pitches_mm(meta),
        levels: stated,
        recorded: recorded(&meta["captures"]),
    })
}

/// The array of `meta.grid`, `[rows, cols]`. Simulated frames are those of a whole array.
fn grid(meta: &serde_json::Value) -> Option<Array> {
    if let Ok([rows, cols]) = serde_json::from_value::<[usize; 2]>(meta["grid"].clone()) {
        let fits = (1..=ROWS).contains(&rows) && (1..=COLS).contains(&cols);
        return fits.then_some(Array { rows, cols });
    }
    let generator = meta["generator"].as_str().unwrap_or_default();
    (generator.starts_with(SIMULATOR) && pitches_mm(meta).is_none()).then_some(Array::JX255N)
}

/// The distances between the taxels of many simulated sensors.
fn pitches_mm(meta: &serde_json::Value) -> Option<[f64; 2]> {
    let sensors = meta.pointer("/settings/sensors")?.clone();
    let sensors: BroadSensors = serde_json::from_value(sensors).ok()?;
    Some(sensors.designs.pitches_mm())
}

/// The objects of recordings, and whether `hardnessd simulate` played them. Raw bytes do not say it.
pub(crate) fn recorded(captures: &serde_json::Value) -> BTreeMap<(u32, u8), Kind> {
    let captures = captures.as_array().into_iter().flatten();
    let object = |capture: &serde_json::Value| {
        let number = u32::try_from(capture["object"].as_u64()?).ok()?;
        let level = u8::try_from(capture["level"].as_u64()?).ok()?;
        let kind = match capture["labels"]["simulated"].as_str() {
            Some("true") => Kind::Simulated,
            _ if capture["raw"] == true => Kind::Unknown,
            _ => Kind::Recorded,
        };
        Some(((number, level), kind))
    };
    captures.filter_map(object).collect()
}

/// The description that an `.npz` file carries as `meta`. Null if it has none.
///
/// # Errors
///
/// Returns an error if the file cannot be read, or `meta` is not JSON.
pub fn meta(path: &Path) -> Result<serde_json::Value, DatasetError> {
    File::open(&whole_of(path)?, path)?.meta()
}

/// Writes presses as an `.npz` file, compressed: most taxels of a frame are 0.
///
/// # Errors
///
/// Returns the errors of writing to `out`.
pub fn write<W: Write + Seek>(
    out: W,
    presses: &Presses,
    layout: Layout,
    meta: &serde_json::Value,
) -> io::Result<W> {
    let mut npz = Writer::compressed(out);
    let all = &presses.all;
    match layout {
        Layout::Frames => {
            let frames: Vec<f32> = (0..all.len())
                .flat_map(|press| presses.frame(press).newtons)
                .collect();
            npz.add("frames", &[all.len(), ROWS, COLS], &frames)?;
            npz.add_list("level", &of_each(all, |press| press.level))?;
            add_optional(&mut npz, "object", all, |press| press.object)?;
            add_optional(&mut npz, "material", all, |press| press.material)?;
            add_optional(&mut npz, "force", all, |press| press.force_n)?;
            npz.add_list("split", &of_each(all, |press| press.split as u8))?;
            add_optional(&mut npz, "shore", all, |press| press.shore)?;
        }
        Layout::OverTime => write_over_time(&mut npz, presses, meta)?,
    }
    npz.add_list("meta", meta.to_string().as_bytes())?;
    npz.finish()
}

fn of_each<T>(presses: &[Press], value: impl Fn(&Press) -> T) -> Vec<T> {
    presses.iter().map(value).collect()
}

/// Adds an array if every press has a value for it.
fn add_optional<W: Write + Seek, T: Element>(
    npz: &mut Writer<W>,
    name: &str,
    presses: &[Press],
    value: impl Fn(&Press) -> Option<T>,
) -> io::Result<()> {
    match presses.iter().map(value).collect::<Option<Vec<T>>>() {
        Some(values) => npz.add_list(name, &values),
        None => Ok(()),
    }
}

/// Adds the arrays of presses over time. Those of sensors are there if the presses have several sensors, or
/// references.
fn write_over_time<W: Write + Seek>(
    npz: &mut Writer<W>,
    presses: &Presses,
    meta: &serde_json::Value,
) -> io::Result<()> {
    let all = &presses.all;
    let rows = presses.frames.len();
    // An i16 holds up to 32 N on a taxel, which is beyond the range of most films.
    let millinewtons = |newtons: f32| (newtons / MILLINEWTON).round() as i16;
    let frames: Vec<i16> = (0..rows)
        .flat_map(|row| presses.frames.frame(row).newtons.map(millinewtons))
        .collect();
    npz.add("frames_mn", &[rows, ROWS, COLS], &frames)?;
    let press = all.iter().zip(0..);
    let press = press.flat_map(|(press, number)| press.moments.clone().map(move |_| number));
    npz.add_list("press", &press.collect::<Vec<u32>>())?;
    npz.add_list("time_s", &presses.time_s)?;
    let approach = presses.approach_mm.iter();
    let approach_mm: Vec<f32> = approach.clone().map(|mm| mm.unwrap_or(0.0)).collect();
    npz.add_list("approach_mm", &approach_mm)?;
    let known: Vec<u8> = approach.map(|mm| mm.is_some().into()).collect();
    npz.add_list("known", &known)?;
    npz.add_list("level", &of_each(all, |press| press.level))?;
    npz.add_list(
        "material",
        &of_each(all, |press| press.material.unwrap_or(0)),
    )?;
    npz.add_list("split", &of_each(all, |press| press.split as u8))?;
    npz.add_list("object", &of_each(all, |press| press.object.unwrap_or(0)))?;
    let best = |press: &Press| (press.moments.start + press.best) as u32;
    npz.add_list("best", &of_each(all, best))?;
    npz.add_list(
        "shore",
        &of_each(all, |press| press.shore.unwrap_or(f32::NAN)),
    )?;
    npz.add_list("force", &of_each(all, |press| press.force_n.unwrap_or(0.0)))?;
    npz.add_list("arm_n_per_mm", &of_each(all, |press| press.arm_n_per_mm))?;
    add_optional(npz, "shape", all, |press| press.shape)?;
    add_optional(npz, "layered", all, |press| press.layered.map(u8::from))?;
    // The whole array of each press, where all have the same one.
    let grid = grid(meta).filter(|array| {
        let is_whole = |newtons: &Vec<f32>| newtons.len() == array.taxels();
        all.iter()
            .all(|press| press.unloaded.as_ref().is_some_and(is_whole))
    });
    if let Some(Array { rows, cols }) = grid {
        let unloaded = all.iter().flat_map(|press| press.unloaded.iter().flatten());
        let unloaded: Vec<f32> = unloaded.copied().collect();
        npz.add("unloaded", &[all.len(), rows, cols], &unloaded)?;
    }
    let names_sensors = |press: &Press| press.sensor > 0 || press.reference.is_some();
    if !all.iter().any(names_sensors) {
        return Ok(());
    }
    let (reference, reference_mm): (Vec<u8>, Vec<f32>) = all
        .iter()
        .map(|press| match press.reference {
            None => (0, 0.0),
            Some(Reference::Flat { width_mm }) => (1, width_mm),
            Some(Reference::Ball { radius_mm }) => (2, radius_mm),
        })
        .unzip();
    npz.add_list("sensor", &of_each(all, |press| press.sensor))?;
    npz.add_list("reference", &reference)?;
    npz.add_list("reference_mm", &reference_mm)
}

/// An `.npz` file being read.
pub(super) struct File<'a> {
    zip: ZipArchive<Cursor<&'a [u8]>>,
    path: &'a Path,
    /// The size of the largest array that was read, in bytes.
    largest: u64,
}

impl<'a> File<'a> {
    fn open(bytes: &'a [u8], path: &'a Path) -> Result<Self, DatasetError> {
        let zip = ZipArchive::new(Cursor::new(bytes)).map_err(|_| DatasetError::NotNpz {
            path: path.to_owned(),
        })?;
        Ok(Self {
            zip,
            path,
            largest: 0,
        })
    }

    fn error(&self, array: &'static str, found: String, expected: String) -> DatasetError {
        DatasetError::Array {
            path: self.path.to_owned(),
            array,
            found,
            expected,
        }
    }

    /// Reads an array of `n` (or any number of) elements of shape `inner`, row-major. `None` if it
    /// is missing. If its header is not as expected, the rest is not unpacked.
    fn read<T: Element>(
        &mut self,
        array: &'static str,
        inner: &[usize],
        n: Option<usize>,
    ) -> Result<Option<Vec<T>>, DatasetError> {
        let file_name = format!("{array}.npy");
        let mut names = self.zip.file_names();
        let name = names.find(|name| *name == file_name || *name == array);
        let Some(name) = name.map(str::to_owned) else {
            return Ok(None);
        };
        drop(names);
        let free = FREE_BYTES.max(self.largest);
        let read = self
            .zip
            .by_name(&name)
            .map_err(ArrayError::from)
            .and_then(|mut reader| {
                let packed = reader.compressed_size();
                array_of::<T>(&mut reader, packed, inner, n, free)
            });
        match read {
            Ok(values) => {
                self.largest = self.largest.max(size_of_val(&*values) as u64);
                Ok(Some(values))
            }
            Err(found) => Err(self.error(array, found.to_string(), shape_of::<T>(inner, n))),
        }
    }

    fn layout(&self) -> Layout {
        let mut names = self.zip.file_names();
        let is_over_time = names.any(|name| name.trim_end_matches(".npy") == "frames_mn");
        match is_over_time {
            true => Layout::OverTime,
            false => Layout::Frames,
        }
    }

    /// Like [`File::read`], for an array that must not be missing.
    fn required<T: Element>(
        &mut self,
        array: &'static str,
        inner: &[usize],
        n: Option<usize>,
    ) -> Result<Vec<T>, DatasetError> {
        let found = self.read(array, inner, n)?;
        found.ok_or_else(|| self.error(array, "none".to_owned(), shape_of::<T>(inner, n)))
    }

    /// The array `meta` as JSON. Null if it is missing.
    fn meta(&mut self) -> Result<serde_json::Value, DatasetError> {
        let Some(text) = self.read::<u8>("meta", &[], None)? else {
            return Ok(serde_json::Value::Null);
        };
        serde_json::from_slice(&text)
            .map_err(|error| self.error("meta", error.to_string(), "JSON in UTF-8".to_owned()))
    }

    fn between(
        &self,
        array: &'static str,
        values: &[f32],
        range: RangeInclusive<f32>,
    ) -> Result<(), DatasetError> {
        match values.iter().position(|value| !range.contains(value)) {
            None => Ok(()),
            Some(place) => {
                let found = format!("{} at {place}", values[place]);
                let expected = format!("{} to {}", range.start(), range.end());
                Err(self.error(array, found, expected))
            }
        }
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

/// The type and the shape of an array, such as `f32 [N,28,28]`.
fn shape_of<T: Element>(inner: &[usize], n: Option<usize>) -> String {
    let lengths: String = inner.iter().map(|length| format!(",{length}")).collect();
    let count = n.map_or_else(|| "N".to_owned(), |n| n.to_string());
    format!("{} [{count}{lengths}]", T::NAME)
}

/// The content found in place of an array. Each message continues the word "found".
#[derive(Debug, thiserror::Error)]
enum ArrayError {
    #[error(transparent)]
    Zip(#[from] ZipError),
    #[error(transparent)]
    Npy(#[from] io::Error),
    /// The array has the right type and another shape.
    #[error("{name} {shape:?}")]
    Shape {
        name: &'static str,
        shape: Vec<usize>,
    },
    /// A few packed bytes would unpack to very many.
    #[error("{bytes} bytes packed into {packed}")]
    Packed { bytes: u64, packed: u64 },
}

/// Reads an array of `n` (or any number of) elements of shape `inner`, row-major, from `packed`
/// bytes. Up to `free` bytes may have been packed in any ratio.
fn array_of<T: Element>(
    reader: &mut impl Read,
    packed: u64,
    inner: &[usize],
    n: Option<usize>,
    free: u64,
) -> Result<Vec<T>, ArrayError> {
    let header = Header::read(reader)?;
    let fits = match header.shape.split_first() {
        Some((first, rest)) => rest == inner && n.is_none_or(|n| *first == n),
        None => false,
    };
    let Some(count) = header.count().filter(|_| fits) else {
        let (name, shape) = (T::NAME, header.shape);
        return Err(ArrayError::Shape { name, shape });
    };
    let bytes = count.saturating_mul(size_of::<T>()) as u64;
    if bytes > free.max(packed.saturating_mul(MOST_PACKED)) {
        return Err(ArrayError::Packed { bytes, packed });
    }
    let values = header.elements(reader, T::of)?;
    if !header.fortran_order {
        return Ok(values);
    }
    // In Fortran order the first axis changes fastest; in our order the last one does.
    let place = |mut index: usize| {
        let mut steps = count;
        let (mut place, mut stride) = (0, 1);
        for &length in &header.shape {
            steps /= length;
            place += index / steps * stride;
            index %= steps;
            stride *= length;
        }
        place
    };
    Ok((0..count).map(|index| values[place(index)]).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recording_says_whether_it_was_simulated_and_raw_bytes_do_not() {
        let captures = serde_json::json!([
            {"object": 1, "level": 4, "labels": {"simulated": "true"}},
            {"object": 2, "level": 4, "labels": {}},
            {"object": 3, "level": 4, "labels": {}, "raw": true},
        ]);
        let kinds = [Kind::Simulated, Kind::Recorded, Kind::Unknown];
        assert!(recorded(&captures).into_values().eq(kinds));
    }

    #[test]
    fn an_array_as_large_as_another_may_be_all_zeros() {
        let header = Header {
            descr: "|u1".to_owned(),
            fortran_order: false,
            shape: vec![20 << 20],
        };
        let bytes = [header.to_bytes(), vec![0; 20 << 20]].concat();
        let read = |free| array_of::<u8>(&mut &*bytes, 100, &[], Some(20 << 20), free);
        assert!(matches!(read(FREE_BYTES), Err(ArrayError::Packed { .. })));
        assert!(read(20 << 20).is_ok_and(|values| values.len() == 20 << 20));
    }
}
