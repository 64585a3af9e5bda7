//! Data sets as `.npz` files: arrays with the names, types and shapes of `docs/formats.md`.

use std::io::{self, Cursor, Read, Seek, Write};
use std::path::Path;

use ndarray::{ArrayD, ArrayView, ArrayView1, ArrayView3, Dimension};
use ndarray_npy::{
    NpzReader, NpzWriter, ReadDataError, ReadNpyError, ReadNpzError, ReadableElement,
    WritableElement, WriteNpzError,
};
use py_literal::Value;

use super::{Dataset, DatasetError, Sample, Source, levels};
use crate::frame::{COLS, Frame, ROWS, TAXELS};
use crate::simulator::Split;
use crate::verdict::sha256_hex;

/// More on a taxel than any sensor shows, and little enough that sums of squares stay finite.
const MOST_NEWTONS: f32 = 1e6;

/// The samples in `bytes`, which are those of the file `path`.
pub(super) fn parse(bytes: &[u8], path: &Path, name: String) -> Result<Dataset, DatasetError> {
    let mut file = File::open(bytes, path)?;
    let frames: Vec<f32> = file.read("frames", &[ROWS, COLS], None)?.ok_or_else(|| {
        file.error(
            "frames",
            "none".to_owned(),
            format!("f32 [N,{ROWS},{COLS}]"),
        )
    })?;
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
    let level: Vec<u8> = file
        .read("level", &[], Some(n))?
        .ok_or_else(|| file.error("level", "none".to_owned(), format!("u8 [{n}]")))?;
    let object: Option<Vec<u32>> = file.read("object", &[], Some(n))?;
    let material: Option<Vec<u8>> = file.read("material", &[], Some(n))?;
    let force: Option<Vec<f32>> = file.read("force", &[], Some(n))?;
    let split: Option<Vec<u8>> = file.read("split", &[], Some(n))?;
    let shore: Option<Vec<f32>> = file.read("shore", &[], Some(n))?;
    for (array, values) in [("force", &force), ("shore", &shore)] {
        file.finite(array, values.as_deref().unwrap_or_default())?;
    }
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
        let mut frame = Frame::default();
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
    let pitch = &meta["pitch_mm"];
    let pitch_mm = pitch.as_f64().filter(|&mm| mm > 0.0);
    if !pitch.is_null() && pitch_mm.is_none() {
        let (found, expected) = (
            format!("pitch_mm {pitch}"),
            "millimetres above 0".to_owned(),
        );
        return Err(file.error("meta", found, expected));
    }
    let source = Source {
        name,
        seed: meta["seed"].as_u64(),
        sha256: sha256_hex(bytes),
        generator: meta["generator"].as_str().map(str::to_owned),
        pitch_mm,
    };
    Ok(Dataset {
        samples: (0..n).map(sample).collect(),
        sources: vec![source],
        paths: vec![path.to_owned()],
    })
}

pub(super) fn read(path: &Path) -> Result<Vec<u8>, DatasetError> {
    std::fs::read(path).map_err(|source| DatasetError::Unreadable {
        path: path.to_owned(),
        source,
    })
}

/// What an `.npz` file says of itself; null if it says nothing.
///
/// # Errors
///
/// If the file cannot be read, or it is no JSON.
pub fn meta(path: &Path) -> Result<serde_json::Value, DatasetError> {
    File::open(&read(path)?, path)?.meta()
}

/// Writes samples as an `.npz` file, compressed: most taxels of a frame are 0.
///
/// # Errors
///
/// Those of writing to `out`.
pub fn write<W: Write + Seek>(
    out: W,
    samples: &[Sample],
    meta: &serde_json::Value,
) -> Result<W, WriteNpzError> {
    let mut npz = NpzWriter::new_compressed(out);
    let n = samples.len();
    let frames: Vec<f32> = samples
        .iter()
        .flat_map(|sample| sample.frame.newtons)
        .collect();
    let shape = "as many values as the shape asks for";
    let frames = ArrayView3::from_shape((n, ROWS, COLS), &frames).expect(shape);
    npz.add_array("frames", &frames)?;
    let level: Vec<u8> = samples.iter().map(|sample| sample.level).collect();
    npz.add_array("level", &ArrayView1::from(&level))?;
    add_optional(&mut npz, "object", samples, |sample| sample.object)?;
    add_optional(&mut npz, "material", samples, |sample| sample.material)?;
    add_optional(&mut npz, "force", samples, |sample| sample.force_n)?;
    let split: Vec<u8> = samples.iter().map(|sample| sample.split as u8).collect();
    npz.add_array("split", &ArrayView1::from(&split))?;
    add_optional(&mut npz, "shore", samples, |sample| sample.shore)?;
    npz.add_array("meta", &ArrayView1::from(meta.to_string().as_bytes()))?;
    npz.finish()
}

/// Adds an array if every sample has a value for it.
fn add_optional<W: Write + Seek, T: WritableElement>(
    npz: &mut NpzWriter<W>,
    name: &str,
    samples: &[Sample],
    value: impl Fn(&Sample) -> Option<T>,
) -> Result<(), WriteNpzError> {
    match samples.iter().map(value).collect::<Option<Vec<T>>>() {
        Some(values) => npz.add_array(name, &ArrayView::from(&values)),
        None => Ok(()),
    }
}

/// An element type that our files may hold.
trait Element: ReadableElement + Clone {
    const NAME: &'static str;
}
impl Element for f32 {
    const NAME: &'static str = "f32";
}
impl Element for u32 {
    const NAME: &'static str = "u32";
}
impl Element for u8 {
    const NAME: &'static str = "u8";
}

/// An element that is read before room is made for it: a header may say that there are more than fit
/// in any memory.
#[derive(Clone)]
struct Met<T>(T);

impl<T: ReadableElement> ReadableElement for Met<T> {
    fn read_to_end_exact_vec<R: Read>(
        reader: R,
        type_desc: &Value,
        len: usize,
    ) -> Result<Vec<Self>, ReadDataError> {
        // A wrong type is said before a wrong length.
        T::read_to_end_exact_vec(io::empty(), type_desc, 0)?;
        let expected = len.saturating_mul(size_of::<T>());
        let mut bytes = Vec::new();
        let one_more = (expected as u64).saturating_add(1);
        reader
            .take(one_more)
            .read_to_end(&mut bytes)
            .map_err(ReadDataError::Io)?;
        if bytes.len() < expected {
            return Err(ReadDataError::MissingData);
        }
        let values = T::read_to_end_exact_vec(bytes.as_slice(), type_desc, len)?;
        Ok(values.into_iter().map(Self).collect())
    }
}

/// An `.npz` file being read.
struct File<'a> {
    npz: NpzReader<Cursor<&'a [u8]>>,
    names: Vec<String>,
    path: &'a Path,
}

impl<'a> File<'a> {
    fn open(bytes: &'a [u8], path: &'a Path) -> Result<Self, DatasetError> {
        let not_npz = |error: ReadNpzError| DatasetError::NotNpz {
            path: path.to_owned(),
            reason: error.to_string(),
        };
        let mut npz = NpzReader::new(Cursor::new(bytes)).map_err(not_npz)?;
        let names = npz.names().map_err(not_npz)?;
        Ok(Self { npz, names, path })
    }

    fn error(&self, array: &'static str, found: String, expected: String) -> DatasetError {
        DatasetError::Array {
            path: self.path.to_owned(),
            array,
            found,
            expected,
        }
    }

    /// Reads an array of `n` (or any number of) elements of shape `inner`, row-major; `None` if
    /// it is not there.
    fn read<T: Element>(
        &mut self,
        array: &'static str,
        inner: &[usize],
        n: Option<usize>,
    ) -> Result<Option<Vec<T>>, DatasetError> {
        if !self.names.iter().any(|name| name == array) {
            return Ok(None);
        }
        let lengths: String = inner.iter().map(|length| format!(",{length}")).collect();
        let count = n.map_or_else(|| "N".to_owned(), |n| n.to_string());
        let expected = format!("{} [{count}{lengths}]", T::NAME);
        let values: ArrayD<Met<T>> = self.npz.by_name(array).map_err(|error| {
            let found = match error {
                ReadNpzError::Npy(ReadNpyError::WrongDescriptor(found)) => format!("dtype {found}"),
                other => other.to_string(),
            };
            self.error(array, found, expected.clone())
        })?;
        let shape = values.raw_dim();
        let shape = shape.slice();
        let fits = shape.len() == inner.len() + 1
            && shape[1..] == *inner
            && n.is_none_or(|n| shape[0] == n);
        if !fits {
            return Err(self.error(array, format!("{} {shape:?}", T::NAME), expected));
        }
        // Row-major whatever the file's order.
        Ok(Some(
            values.iter().map(|Met(value)| value.clone()).collect(),
        ))
    }

    /// The array `meta`; null if it is not there.
    fn meta(&mut self) -> Result<serde_json::Value, DatasetError> {
        let Some(text) = self.read::<u8>("meta", &[], None)? else {
            return Ok(serde_json::Value::Null);
        };
        serde_json::from_slice(&text)
            .map_err(|error| self.error("meta", error.to_string(), "JSON in UTF-8".to_owned()))
    }

    fn finite(&self, array: &'static str, values: &[f32]) -> Result<(), DatasetError> {
        match values.iter().position(|value| !value.is_finite()) {
            None => Ok(()),
            Some(place) => {
                let found = format!("{} at {place}", values[place]);
                Err(self.error(array, found, "finite numbers".to_owned()))
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
