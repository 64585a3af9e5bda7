//! Data sets as `.npz` files: arrays with the names, types and shapes of `docs/formats.md`.

use std::collections::BTreeMap;
use std::io::{self, Cursor, Read, Seek, Write};
use std::ops::RangeInclusive;
use std::os::unix::fs::FileTypeExt as _;
use std::path::Path;

use zip::ZipArchive;
use zip::result::ZipError;

use super::{Dataset, DatasetError, Kind, Sample, Source, levels};
use hardnessd_core::npy::{Header, NpyError};
use hardnessd_core::npz::{Element, Writer};
use hardnessd_core::verdict::{COLS, Level, ModelFrame, ROWS, TAXELS, check_levels, sha256_hex};
use hardnessd_simulator::{BroadSensors, Split};

/// A force above any sensor's, and low enough that sums of squares stay finite.
const MOST_NEWTONS: f32 = 1e6;
/// The forces of presses.
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

/// Reads the samples in `bytes`, the content of the file `path`.
pub(super) fn parse(bytes: &[u8], path: &Path) -> Result<Dataset, DatasetError> {
    let mut file = File::open(bytes, path)?;
    if file.is_of_courses() {
        return Err(DatasetError::WholePresses {
            path: path.to_owned(),
        });
    }
    let frames: Vec<f32> = file.required("frames", &[ROWS, COLS], None)?;
    let n = frames.len() / TAXELS;
    if n == 0 {
        return Err(file.error("frames", "no frame".to_owned(), "at least one".to_owned()));
    }
    if let Some(place) = frames
        .iter()
        .position(|n| !(0.0..=MOST_NEWTONS).contains(n))
    {
        let (frame, taxel) = (place / TAXELS, place % TAXELS);
        let (row, col) = (taxel / COLS, taxel % COLS);
        let found = format!("{:?} at [{frame},{row},{col}]", frames[place]);
        let expected = format!("newtons from 0 to {MOST_NEWTONS:e}");
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
        let mut frame = ModelFrame::default();
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
    let source = source(bytes, &file, &meta)?;
    Ok(Dataset {
        samples: (0..n).map(sample).collect(),
        sources: vec![source],
        paths: vec![path.to_owned()],
    })
}

/// Reads a whole file. Refuses a device, such as a serial port, because it has no end.
pub(in crate::data) fn whole(path: &Path) -> std::io::Result<Vec<u8>> {
    if std::fs::metadata(path)?.file_type().is_char_device() {
        return Err(std::io::Error::other("found a device, expected a file"));
    }
    std::fs::read(path)
}

pub(in crate::data) fn read(path: &Path) -> Result<Vec<u8>, DatasetError> {
    whole(path).map_err(|source| DatasetError::Unreadable {
        path: path.to_owned(),
        source,
    })
}

/// The source of a file's samples or presses.
pub(in crate::data) fn source(
    bytes: &[u8],
    file: &File,
    meta: &serde_json::Value,
) -> Result<Source, DatasetError> {
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
    let stated = stated.filter(|of| check_levels(of).is_ok());
    if !meta["levels"].is_null() && stated.is_none() {
        return Err(refused(
            "levels",
            "`level`, `label` and `shore` of each level, from 1 on",
        ));
    }
    let name = file.path.file_name().unwrap_or_default();
    Ok(Source {
        name: name.to_string_lossy().into_owned(),
        seed,
        sha256: sha256_hex(bytes),
        generator: meta["generator"].as_str().map(str::to_owned),
        pitch_mm,
        pitches_mm: pitches_mm(meta),
        levels: stated,
        recorded: recorded(&meta["captures"]),
    })
}

/// The distances between the taxels of many simulated sensors.
fn pitches_mm(meta: &serde_json::Value) -> Option<[f64; 2]> {
    let sensors = meta.pointer("/settings/sensors")?.clone();
    let sensors: BroadSensors = serde_json::from_value(sensors).ok()?;
    Some(sensors.designs.pitches_mm())
}

/// The objects of recordings, and whether `hardnessd simulate` played them. Raw bytes do not say it.
fn recorded(captures: &serde_json::Value) -> BTreeMap<(u32, u8), Kind> {
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
    File::open(&read(path)?, path)?.meta()
}

/// Writes samples as an `.npz` file, compressed: most taxels of a frame are 0.
///
/// # Errors
///
/// Returns the errors of writing to `out`.
pub fn write<W: Write + Seek>(
    out: W,
    samples: &[Sample],
    meta: &serde_json::Value,
) -> io::Result<W> {
    let mut npz = Writer::compressed(out);
    let newtons = samples.iter().flat_map(|sample| sample.frame.newtons);
    let frames: Vec<f32> = newtons.collect();
    npz.add("frames", &[samples.len(), ROWS, COLS], &frames)?;
    let levels: Vec<u8> = samples.iter().map(|sample| sample.level).collect();
    npz.add_list("level", &levels)?;
    add_optional(&mut npz, "object", samples, |sample| sample.object)?;
    add_optional(&mut npz, "material", samples, |sample| sample.material)?;
    add_optional(&mut npz, "force", samples, |sample| sample.force_n)?;
    let splits: Vec<u8> = samples.iter().map(|sample| sample.split as u8).collect();
    npz.add_list("split", &splits)?;
    add_optional(&mut npz, "shore", samples, |sample| sample.shore)?;
    npz.add_list("meta", meta.to_string().as_bytes())?;
    npz.finish()
}

/// Adds an array if every sample has a value for it.
fn add_optional<W: Write + Seek, T: Element>(
    npz: &mut Writer<W>,
    name: &str,
    samples: &[Sample],
    value: impl Fn(&Sample) -> Option<T>,
) -> io::Result<()> {
    match samples.iter().map(value).collect::<Option<Vec<T>>>() {
        Some(values) => npz.add_list(name, &values),
        None => Ok(()),
    }
}

/// An `.npz` file being read.
pub(in crate::data) struct File<'a> {
    zip: ZipArchive<Cursor<&'a [u8]>>,
    path: &'a Path,
    /// The size of the largest array that was read, in bytes.
    largest: u64,
}

impl<'a> File<'a> {
    pub(in crate::data) fn open(bytes: &'a [u8], path: &'a Path) -> Result<Self, DatasetError> {
        let zip = ZipArchive::new(Cursor::new(bytes)).map_err(|_| DatasetError::NotNpz {
            path: path.to_owned(),
        })?;
        Ok(Self {
            zip,
            path,
            largest: 0,
        })
    }

    pub(in crate::data) fn error(
        &self,
        array: &'static str,
        found: String,
        expected: String,
    ) -> DatasetError {
        DatasetError::Array {
            path: self.path.to_owned(),
            array,
            found,
            expected,
        }
    }

    /// Reads an array of `n` (or any number of) elements of shape `inner`, row-major. `None` if it
    /// is missing. If its header is not as expected, the rest is not unpacked.
    pub(in crate::data) fn read<T: Element>(
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

    /// Whether the file has presses over time.
    pub(in crate::data) fn is_of_courses(&self) -> bool {
        self.has("frames_mn")
    }

    /// Whether the file has single frames.
    pub(in crate::data) fn is_of_frames(&self) -> bool {
        self.has("frames") && !self.is_of_courses()
    }

    fn has(&self, array: &str) -> bool {
        let mut names = self.zip.file_names();
        names.any(|name| name.strip_suffix(".npy").unwrap_or(name) == array)
    }

    /// Like [`File::read`], for an array that must not be missing.
    pub(in crate::data) fn required<T: Element>(
        &mut self,
        array: &'static str,
        inner: &[usize],
        n: Option<usize>,
    ) -> Result<Vec<T>, DatasetError> {
        let found = self.read(array, inner, n)?;
        found.ok_or_else(|| self.error(array, "none".to_owned(), shape_of::<T>(inner, n)))
    }

    /// The array `meta` as JSON. Null if it is missing.
    pub(in crate::data) fn meta(&mut self) -> Result<serde_json::Value, DatasetError> {
        let Some(text) = self.read::<u8>("meta", &[], None)? else {
            return Ok(serde_json::Value::Null);
        };
        serde_json::from_slice(&text)
            .map_err(|error| self.error("meta", error.to_string(), "JSON in UTF-8".to_owned()))
    }

    pub(in crate::data) fn between(
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

    pub(in crate::data) fn within(
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
    Npy(#[from] NpyError),
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
