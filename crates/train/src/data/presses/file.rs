//! Presses as `.npz` files: arrays with the names, types and shapes of `docs/formats.md`.

use std::fs::File;
use std::io::{self, Read as _, Seek, Write};
use std::ops::RangeInclusive;
use std::os::unix::fs::FileTypeExt as _;
use std::path::Path;

use anyhow::{Context as _, anyhow};
use serde::Deserialize;
use serde_json::{Value, json};

use super::{MILLINEWTON, MOST_BYTES, Press, Presses};
use crate::data::source::{Grid, Kind, PITCH_MM, SIMULATOR, Source};
use crate::exit::unreadable;
use hardnessd_core::frame::{Array, MOST_SIDE};
use hardnessd_core::npy::Element;
use hardnessd_core::npz::{ANY, Reader, Unexpected, Writer, within};
use hardnessd_core::verdict::parts::PARTS;
use hardnessd_core::verdict::{
    COLS, COURSE_FRAMES, Level, MOST_LEVELS, Piece, ROWS, TAXELS, are_levels,
};
use hardnessd_simulator::{BroadSensors, Split};

/// Forces beyond any sensor's, and low enough that sums of squares stay finite.
const FORCES: RangeInclusive<f32> = -1e6..=1e6;
/// What a durometer can show.
pub(in crate::data) const SHORE: RangeInclusive<f32> = 0.0..=100.0;
/// Distances between taxels, in mm.
const PITCHES_MM: RangeInclusive<f64> = 0.01..=1000.0;

/// The array of the contact areas of presses that have parts.
const AREAS: &str = "contact_area_taxels";

/// The largest file that is read, in bytes.
const MOST_FILE_BYTES: u64 = 4 << 30;
/// All arrays of a file may be so many times as large as the file, or up to [`FREE_BYTES`], and never more than
/// [`MOST_BYTES`]. Frames of presses are packed to a tenth, and arrays of zeros to a thousandth.
const MOST_PACKED: usize = 256;
const FREE_BYTES: usize = 16 << 20;

/// How a file keeps presses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Layout {
    /// One frame of each press, in newtons.
    Frames,
    /// All moments of each press, in millinewtons.
    OverTime,
}

impl Layout {
    /// The layout of presses that are whole, or single frames.
    pub fn of(are_over_time: bool) -> Self {
        match are_over_time {
            true => Self::OverTime,
            false => Self::Frames,
        }
    }
}

/// Reads a file of either layout.
pub(super) fn read(path: &Path) -> anyhow::Result<Presses> {
    parse(&whole(path)?, path)
}

/// The description that an `.npz` file carries as `meta`. Null if it has none.
///
/// # Errors
///
/// Returns an error if the file cannot be read, or `meta` is not JSON.
pub fn meta(path: &Path) -> anyhow::Result<Value> {
    let bytes = whole(path)?;
    let found = opened(&bytes).and_then(|mut file| Ok(described(&mut file)?));
    found.with_context(|| path.display().to_string())
}

fn opened(bytes: &[u8]) -> anyhow::Result<Reader<'_>> {
    let most_bytes = bytes.len().saturating_mul(MOST_PACKED);
    let file = Reader::new(bytes, most_bytes.clamp(FREE_BYTES, MOST_BYTES));
    file.map_err(|_| anyhow!("not an .npz file, or a damaged one"))
}

/// The array `meta` as JSON. Null if it is missing.
fn described(file: &mut Reader) -> Result<Value, Unexpected> {
    let Some(text) = file.find::<u8>("meta", &[], ANY)? else {
        return Ok(Value::Null);
    };
    serde_json::from_slice(&text).map_err(|error| Unexpected::new("meta", error, "JSON in UTF-8"))
}

/// A value of each press or moment, of an array that may be missing. NaN is a value that is not known.
fn column<T: Element + PartialOrd + std::fmt::Display>(
    file: &mut Reader,
    array: &str,
    count: usize,
    range: &RangeInclusive<T>,
) -> Result<Vec<Option<T>>, Unexpected> {
    let Some(values) = file.find::<T>(array, &[], count..=count)? else {
        return Ok(vec![None; count]);
    };
    let known = |value: T| Some(value).filter(|value| value.partial_cmp(value).is_some());
    let values: Vec<Option<T>> = values.into_iter().map(known).collect();
    let given: Vec<T> = values.iter().copied().flatten().collect();
    within(array, &given, range)?;
    Ok(values)
}

/// Reads a whole file. Refuses a device, such as a serial port, because it has no end, and a file that is too large
/// for memory.
pub(in crate::data) fn whole(path: &Path) -> anyhow::Result<Vec<u8>> {
    let read = || {
        let found = std::fs::metadata(path)?;
        if found.file_type().is_char_device() {
            return Err(io::Error::other("found a device, expected a file"));
        }
        let mut bytes = Vec::new();
        if found.len() <= MOST_FILE_BYTES {
            bytes.reserve_exact(found.len() as usize);
            // A pipe has no length.
            let mut file = File::open(path)?.take(MOST_FILE_BYTES + 1);
            file.read_to_end(&mut bytes)?;
        }
        match found.len().max(bytes.len() as u64) {
            0..=MOST_FILE_BYTES => Ok(bytes),
            _ => Err(io::Error::other(format!(
                "found more than {} GB, expected less: name several smaller files",
                MOST_FILE_BYTES >> 30
            ))),
        }
    };
    read().map_err(|error| unreadable(path, &error))
}

/// Reads the presses in `bytes`, the content of the file `path`.
pub(super) fn parse(bytes: &[u8], path: &Path) -> anyhow::Result<Presses> {
    let read = opened(bytes).and_then(|mut file| Ok(presses(&mut file, bytes, path)?));
    read.with_context(|| path.display().to_string())
}

fn presses(file: &mut Reader, bytes: &[u8], path: &Path) -> Result<Presses, Unexpected> {
    let mut presses = Presses {
        sources: vec![source(file, bytes, path)?],
        ..Presses::default()
    };
    let level: Vec<u8> = file.read("level", &[], ANY)?;
    let count = level.len();
    if count == 0 {
        return Err(Unexpected::new("level", "no press", "at least one"));
    }
    within("level", &level, &(0..=presses.levels().len() as u8))?;
    let (array, of_each, newtons_each) = match file.has("frames_mn") {
        true => ("frames_mn", ANY, MILLINEWTON),
        false => ("frames", count..=count, 1.0),
    };
    let frames: Vec<f32> = file.read(array, &[ROWS, COLS], of_each)?;
    within(array, &frames, &FORCES)?;
    let taxels = frames.iter().filter(|&&newtons| newtons != 0.0);
    presses.frames.reserve(taxels.count());
    let moments = frames.len() / TAXELS;
    // A single frame is a press of one moment.
    let each: Vec<u32> = (0..moments as u32).collect();
    let press = file.find("press", &[], moments..=moments)?;
    let press = press.unwrap_or_else(|| each.clone());
    let best = file.find("best", &[], count..=count)?.unwrap_or(each);
    let time_s: Option<Vec<f32>> = file.find("time_s", &[], moments..=moments)?;
    let time_s = time_s.unwrap_or_else(|| vec![0.0; moments]);
    within("time_s", &time_s, &(-1e5..=1e5))?;
    let approach_mm = column(file, "approach_mm", moments, &FORCES)?;
    let known = column(file, "known", moments, &(0..=1_u8))?;
    let object = column(file, "object", count, &(0..=u32::MAX))?;
    let material = column(file, "material", count, &(0..=u8::MAX))?;
    let sensor = column(file, "sensor", count, &(0..=u32::MAX))?;
    let split = column(file, "split", count, &(0..=1_u8))?;
    let force_n = column(file, "force", count, &FORCES)?;
    let shore = column(file, "shore", count, &SHORE)?;
    let arm_n_per_mm = column(file, "arm_n_per_mm", count, &(0.0..=1e6))?;
    let reference = column(file, "reference", count, &(0..=2_u8))?;
    let reference_mm = column(file, "reference_mm", count, &(0.0..=1e6_f32))?;
    let kind = column(file, "kind", count, &(0..=2_u8))?;
    let (mut unloaded, mut parts) = (Vec::<f32>::new(), Vec::<f32>::new());
    let mut areas = Vec::<u32>::new();
    if let Some(grid) = presses.grid() {
        let Array { rows, cols } = grid.array;
        let of_each = file.find("unloaded", &[rows, cols], count..=count)?;
        unloaded = of_each.unwrap_or_default();
        if !grid.is_kept() {
            parts = file.read("parts", &[PARTS, rows, cols], count..=count)?;
            within("parts", &parts, &FORCES)?;
            areas = file.read(AREAS, &[], count..=count)?;
            within(AREAS, &areas, &(0..=grid.array.taxels() as u32))?;
        }
    }
    let mut unloaded = unloaded.chunks((unloaded.len() / count).max(1));
    let mut parts = parts.chunks((parts.len() / count).max(1));
    let generator = presses.sources[0].generator.as_deref().unwrap_or_default();
    let of_file = match generator.starts_with(SIMULATOR) {
        true => Kind::Simulated,
        false => Kind::Unknown,
    };
    let mut first = 0;
    for (number, of_press) in press.chunk_by(|a, b| a == b).enumerate() {
        let rows = first..first + of_press.len();
        first = rows.end;
        if of_press[0] as usize != number || number >= count {
            let expected = format!("0 to {}, one after the other", count - 1);
            return Err(Unexpected::new("press", of_press[0], expected));
        }
        let best = best[number] as usize;
        if !rows.contains(&best) {
            let found = format!("{best} of press {number}");
            let expected = format!("one of its frames, {rows:?}");
            return Err(Unexpected::new("best", found, expected));
        }
        let times = &time_s[rows.clone()];
        let used = times.iter().filter(|&&time_s| time_s >= 0.0).count();
        if !(1..=COURSE_FRAMES.1).contains(&used) || !times.is_sorted_by(|a, b| a < b) {
            let found = format!("{used} of 0 s or later in press {number}");
            let expected = format!("1 to {} of these, and all ascending", COURSE_FRAMES.1);
            return Err(Unexpected::new("time_s", found, expected));
        }
        let piece = match (reference[number].unwrap_or(0), reference_mm[number]) {
            (0, _) => None,
            (_, None) => {
                let expected = "that of each reference";
                return Err(Unexpected::new("reference_mm", "none", expected));
            }
            (1, Some(width_mm)) => Some(Piece::Flat { width_mm }),
            (_, Some(radius_mm)) => Some(Piece::Ball { radius_mm }),
        };
        if level[number] > 0 && piece.is_some() {
            let found = format!("{} of press {number}, a reference", level[number]);
            return Err(Unexpected::new("level", found, 0));
        }
        let press = Press {
            level: level[number],
            object: object[number],
            material: material[number],
            split: match split[number] {
                Some(1) => Split::Test,
                _ => Split::Train,
            },
            shore: shore[number],
            force_n: force_n[number],
            arm_n_per_mm: arm_n_per_mm[number].unwrap_or(0.0),
            sensor: sensor[number].unwrap_or(0),
            reference: piece,
            unloaded: unloaded.next().map(<[f32]>::to_vec),
            parts: parts.next().map(<[f32]>::to_vec),
            contact_area_taxels: areas.get(number).copied(),
            kind: kind[number].map_or(of_file, |kind| Kind::ALL[usize::from(kind)]),
            best: best - rows.start,
            ..Press::default()
        };
        let of_press = rows.map(|row| {
            let newtons = frames[row * TAXELS..][..TAXELS].iter();
            let newtons = newtons.map(|&value| value * newtons_each);
            let approach_mm = approach_mm[row].filter(|_| known[row] == Some(1));
            (time_s[row], approach_mm, newtons)
        });
        presses.push(press, of_press);
    }
    if presses.all.len() < count {
        let found = format!("{} presses", presses.all.len());
        return Err(Unexpected::new("press", found, count));
    }
    Ok(presses)
}

/// What a file says of its presses.
#[derive(Default, Deserialize)]
#[serde(default)]
struct Meta {
    generator: Option<String>,
    // A run keeps the seed in TOML, which has no larger numbers.
    seed: Option<i64>,
    levels: Option<Vec<Level>>,
    pitch_mm: Option<f64>,
    grid: Option<[usize; 2]>,
    grid_pitch_mm: Option<f64>,
    settings: Value,
}

/// The source of a file's presses.
fn source(file: &mut Reader, bytes: &[u8], path: &Path) -> Result<Source, Unexpected> {
    let meta: Option<Meta> = serde_json::from_value(described(file)?)
        .map_err(|error| Unexpected::new("meta", error, "the keys of docs/formats.md"))?;
    let meta = meta.unwrap_or_default();
    for (key, mm) in [
        ("pitch_mm", meta.pitch_mm),
        ("grid_pitch_mm", meta.grid_pitch_mm),
    ] {
        if let Some(mm) = mm.filter(|mm| !PITCHES_MM.contains(mm)) {
            let found = format!("{key} {mm}");
            let expected = "millimetres from 0.01 to 1000";
            return Err(Unexpected::new("meta", found, expected));
        }
    }
    let is_wrong = |of: &&Vec<Level>| !are_levels(of) || of.len() > MOST_LEVELS;
    if let Some(levels) = meta.levels.as_ref().filter(is_wrong) {
        let found = format!("levels {}", json!(levels));
        let expected = "`level`, `label` and `shore` of each of 2 to 16 levels, from 1 on";
        return Err(Unexpected::new("meta", found, expected));
    }
    // The distances between the taxels of many simulated sensors.
    let sensors = meta.settings.get("sensors").cloned().unwrap_or_default();
    let sensors: Option<BroadSensors> = serde_json::from_value(sensors).ok();
    let pitches_mm = sensors.map(|sensors| sensors.designs.pitches_mm());
    let generator = meta.generator.as_deref().unwrap_or_default();
    let array = match meta.grid {
        Some([rows, cols]) => Some(Array { rows, cols }),
        // Simulated frames are those of a whole array.
        None if generator.starts_with(SIMULATOR) && pitches_mm.is_none() => Some(Array::JX255N),
        None => None,
    };
    let pitch_mm = meta.grid_pitch_mm.or(meta.pitch_mm).unwrap_or(PITCH_MM);
    let grid = array.map(|array| Grid { array, pitch_mm });
    let is_side = |side: usize| (1..=MOST_SIDE).contains(&side);
    let fits = |of: &Grid| {
        let is_array = is_side(of.array.rows) && is_side(of.array.cols);
        is_array && (of.is_kept() || meta.grid_pitch_mm.is_some())
    };
    Ok(Source {
        seed: meta.seed.and_then(|seed| u64::try_from(seed).ok()),
        pitch_mm: meta.pitch_mm,
        grid: grid.filter(fits),
        pitches_mm,
        levels: meta.levels,
        generator: meta.generator,
        ..Source::of(path, bytes)
    })
}

/// Writes presses as an `.npz` file, compressed: most taxels of a frame are 0. An array of labels or measurements
/// is there if a press has one; a measurement that a press lacks is NaN.
///
/// # Errors
///
/// Returns the errors of writing.
pub fn write<W: Write + Seek>(
    mut npz: Writer<W>,
    presses: &Presses,
    layout: Layout,
    meta: &Value,
) -> io::Result<W> {
    let all = &presses.all;
    match layout {
        Layout::Frames => {
            let frames = (0..all.len()).flat_map(|press| presses.frame(press).newtons);
            npz.add_each("frames", &[all.len(), ROWS, COLS], frames)?;
        }
        Layout::OverTime => write_moments(&mut npz, presses)?,
    }
    let none = Some(f32::NAN);
    add(&mut npz, "level", all, None, |press| Some(press.level))?;
    add(&mut npz, "object", all, None, |press| press.object)?;
    add(&mut npz, "material", all, None, |press| press.material)?;
    add(&mut npz, "force", all, none, |press| press.force_n)?;
    let split = |press: &Press| Some(press.split as u8);
    add(&mut npz, "split", all, None, split)?;
    add(&mut npz, "shore", all, none, |press| press.shore)?;
    let kind = |press: &Press| Some(press.kind as u8).filter(|&kind| kind > 0);
    add(&mut npz, "kind", all, Some(0), kind)?;
    // The whole array of each press, where all have the same one.
    let unloaded = all.iter().map(|press| press.unloaded.as_ref());
    let unloaded: Option<Vec<&Vec<f32>>> = unloaded.collect();
    let array = presses.grid().map(|grid| grid.array);
    if let (Some(array), Some(unloaded)) = (array, unloaded)
        && layout == Layout::OverTime
        && unloaded.iter().all(|own| own.len() == array.taxels())
    {
        let unloaded = unloaded.into_iter().flatten().copied();
        npz.add_each("unloaded", &[all.len(), array.rows, array.cols], unloaded)?;
    }
    let parts = all.iter().map(|press| press.parts.as_ref());
    if let (Some(Array { rows, cols }), Some(parts)) = (array, parts.collect::<Option<Vec<_>>>())
        && layout == Layout::OverTime
    {
        let parts = parts.into_iter().flatten().copied();
        npz.add_each("parts", &[all.len(), PARTS, rows, cols], parts)?;
        let area = |press: &Press| press.contact_area_taxels;
        add(&mut npz, AREAS, all, None, area)?;
    }
    let is_known = |press: &Press| press.sensor > 0 || press.reference.is_some();
    if all.iter().any(is_known) {
        let piece = |press: &Press| match press.reference {
            None | Some(Piece::Shore { .. }) => (0, 0.0),
            Some(Piece::Flat { width_mm }) => (1, width_mm),
            Some(Piece::Ball { radius_mm }) => (2, radius_mm),
        };
        add(&mut npz, "sensor", all, None, |press| Some(press.sensor))?;
        let reference = |press: &Press| Some(piece(press).0);
        add(&mut npz, "reference", all, None, reference)?;
        let reference_mm = |press: &Press| Some(piece(press).1);
        add(&mut npz, "reference_mm", all, None, reference_mm)?;
    }
    npz.add_list("meta", meta.to_string().as_bytes())?;
    npz.finish()
}

/// Adds an array if a press has a value for it. A press without one gets `unknown`; if that is none, every press must
/// have a value.
fn add<W: Write + Seek, T: Element>(
    npz: &mut Writer<W>,
    name: &str,
    presses: &[Press],
    unknown: Option<T>,
    value: impl Fn(&Press) -> Option<T>,
) -> io::Result<()> {
    let is_there = presses.iter().any(|press| value(press).is_some());
    let values = presses.iter().map(|press| value(press).or(unknown));
    match values.collect::<Option<Vec<T>>>() {
        Some(values) if is_there => npz.add_list(name, &values),
        _ => Ok(()),
    }
}

/// Adds the arrays of whole presses.
fn write_moments<W: Write + Seek>(npz: &mut Writer<W>, presses: &Presses) -> io::Result<()> {
    let all = &presses.all;
    let rows = presses.frames.len();
    let millinewtons = || {
        let newtons = (0..rows).flat_map(|row| presses.frames.frame(row).newtons);
        newtons.map(|newtons| newtons / MILLINEWTON)
    };
    // An i16 takes half the room, and holds up to 32 N on a taxel.
    let fits = |mn: f32| mn.abs() <= f32::from(i16::MAX) && (mn - mn.round()).abs() < 0.01;
    let shape = [rows, ROWS, COLS];
    match millinewtons().all(fits) {
        true => npz.add_each(
            "frames_mn",
            &shape,
            millinewtons().map(|mn| mn.round() as i16),
        )?,
        false => npz.add_each("frames_mn", &shape, millinewtons())?,
    }
    let press = all.iter().zip(0..);
    let press = press.flat_map(|(press, number)| press.moments.clone().map(move |_| number));
    npz.add_list("press", &press.collect::<Vec<u32>>())?;
    npz.add_list("time_s", &presses.time_s)?;
    let approach = presses.approach_mm.iter();
    let approach_mm: Vec<f32> = approach.clone().map(|mm| mm.unwrap_or(0.0)).collect();
    npz.add_list("approach_mm", &approach_mm)?;
    let known: Vec<u8> = approach.map(|mm| mm.is_some().into()).collect();
    npz.add_list("known", &known)?;
    let best = |press: &Press| Some((press.moments.start + press.best) as u32);
    add(npz, "best", all, None, best)?;
    let arm_n_per_mm = |press: &Press| Some(press.arm_n_per_mm);
    add(npz, "arm_n_per_mm", all, None, arm_n_per_mm)
}
