//! Arrays of an `.npz` file: the writer and the reader.
//!
//! In: the name, the shape and the elements of each array, row by row. Out: a zip archive with an
//! `.npy` file for each, as numpy's `savez` and `savez_compressed` write it; and back.

use std::fmt::Display;
use std::io::{self, Cursor, Seek, Write};
use std::mem::ManuallyDrop;
use std::ops::RangeInclusive;

use zip::result::ZipResult;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use crate::npy::{Element, Header};

/// An array above this size gets 64-bit lengths in the archive. Packed bytes may be slightly more
/// than unpacked ones, so it is less than 4 GiB.
const LARGE_BYTES: usize = 0xF000_0000;
/// Bytes of an array that are packed at once, where not all are.
const CHUNK_BYTES: usize = 1 << 16;

/// An `.npz` file being written. Its arrays are compressed. It holds no date, so the same arrays give the
/// same bytes.
pub struct Writer<W: Write + Seek> {
    /// Dropped unfinished, it would write on stderr that it cannot end, after the error that is returned.
    zip: ManuallyDrop<ZipWriter<W>>,
    chunk_bytes: usize,
}

impl<W: Write + Seek> Writer<W> {
    /// Begins a file.
    pub fn new(out: W) -> Self {
        Self {
            zip: ManuallyDrop::new(ZipWriter::new(out)),
            chunk_bytes: usize::MAX,
        }
    }

    /// The same for arrays that are too large for memory. The packed bytes of a large array then differ from those of
    /// [`Self::new`], because the packer looks ahead as far as it is given bytes.
    pub fn in_chunks(out: W) -> Self {
        Self {
            chunk_bytes: CHUNK_BYTES,
            ..Self::new(out)
        }
    }

    /// Adds an array of this shape.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing.
    pub fn add<T: Element>(
        &mut self,
        name: &str,
        shape: &[usize],
        elements: &[T],
    ) -> io::Result<()> {
        self.add_each(name, shape, elements.iter().copied())
    }

    /// The same of elements that are made one by one.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing.
    ///
    /// # Panics
    ///
    /// Panics if the shape has another number of elements.
    pub fn add_each<T: Element>(
        &mut self,
        name: &str,
        shape: &[usize],
        elements: impl Iterator<Item = T>,
    ) -> io::Result<()> {
        let header = Header::of::<T>(shape);
        let mut bytes = header.to_bytes();
        let expected = header.count().unwrap_or(usize::MAX);
        let all_bytes = expected.saturating_mul(size_of::<T>());
        let options = SimpleFileOptions::default()
            .compression_method(CompressionMethod::Deflated)
            .large_file(all_bytes > LARGE_BYTES);
        self.zip.start_file(format!("{name}.npy"), options)?;
        bytes.reserve_exact(all_bytes.min(self.chunk_bytes));
        let mut found = 0;
        for element in elements {
            element.push(&mut bytes);
            found += 1;
            if bytes.len() >= self.chunk_bytes {
                self.zip.write_all(&bytes)?;
                bytes.clear();
            }
        }
        assert_eq!(found, expected, "{name}: {shape:?}");
        self.zip.write_all(&bytes)?;
        // Without this the file would be a few bytes shorter, and not the same as that of which a
        // model's card gives the SHA-256.
        self.zip.flush()
    }

    /// Adds an array with one axis.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing.
    pub fn add_list<T: Element>(&mut self, name: &str, elements: &[T]) -> io::Result<()> {
        self.add(name, &[elements.len()], elements)
    }

    /// Writes the table of contents, and gives the output back.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing.
    pub fn finish(self) -> io::Result<W> {
        let mut out = ManuallyDrop::into_inner(self.zip).finish()?;
        out.flush()?;
        Ok(out)
    }
}

/// An array that is not as it should be.
#[derive(Debug, thiserror::Error)]
#[error("array `{array}`: found {found}, expected {expected}")]
pub struct Unexpected {
    array: String,
    found: String,
    expected: String,
}

impl Unexpected {
    /// The error of an array, with what was found and what was expected.
    pub fn new(array: &str, found: impl Display, expected: impl Display) -> Self {
        Self {
            array: array.to_owned(),
            found: found.to_string(),
            expected: expected.to_string(),
        }
    }
}

/// Any number of rows.
pub const ANY: RangeInclusive<usize> = 0..=usize::MAX;

/// An `.npz` file being read.
pub struct Reader<'a> {
    zip: ZipArchive<Cursor<&'a [u8]>>,
    /// What further arrays may take.
    left_bytes: usize,
}

impl<'a> Reader<'a> {
    /// Begins to read a file, of which all arrays together may have `most_bytes`: a packed file may hold a thousand
    /// times its size.
    ///
    /// # Errors
    ///
    /// Returns an error if the bytes are no such file.
    pub fn new(bytes: &'a [u8], most_bytes: usize) -> ZipResult<Self> {
        let zip = ZipArchive::new(Cursor::new(bytes))?;
        Ok(Self {
            zip,
            left_bytes: most_bytes,
        })
    }

    /// Whether the file has this array.
    pub fn has(&self, array: &str) -> bool {
        self.zip.index_for_name(&format!("{array}.npy")).is_some()
    }

    /// The elements of an array, row by row. Each row has the shape `row`. Nothing is unpacked of an array with
    /// another number of `rows`.
    ///
    /// # Errors
    ///
    /// Returns an error if the array is missing, damaged, or of another shape or type.
    pub fn read<T: Element>(
        &mut self,
        array: &str,
        row: &[usize],
        rows: RangeInclusive<usize>,
    ) -> Result<Vec<T>, Unexpected> {
        let found = self.find(array, row, rows.clone())?;
        found.ok_or_else(|| Unexpected::new(array, "none", expected::<T>(row, &rows)))
    }

    /// The same of an array that may be missing.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Reader::read`].
    pub fn find<T: Element>(
        &mut self,
        array: &str,
        row: &[usize],
        rows: RangeInclusive<usize>,
    ) -> Result<Option<Vec<T>>, Unexpected> {
        if !self.has(array) {
            return Ok(None);
        }
        let unpacked = self.unpacked(array, row, &rows).map(Some);
        unpacked.map_err(|found| Unexpected::new(array, found, expected::<T>(row, &rows)))
    }

    fn unpacked<T: Element>(
        &mut self,
        array: &str,
        row: &[usize],
        rows: &RangeInclusive<usize>,
    ) -> io::Result<Vec<T>> {
        let mut reader = self.zip.by_name(&format!("{array}.npy"))?;
        let header = Header::read(&mut reader)?;
        let fits = matches!(header.shape.split_first(), Some((first, rest)) if rest == row && rows.contains(first));
        let count = header.count().filter(|_| fits);
        let count = count.ok_or_else(|| header.unexpected_shape())?;
        let bytes = count.saturating_mul(size_of::<T>());
        let left = self.left_bytes.checked_sub(bytes);
        self.left_bytes = left.ok_or_else(|| {
            let found = format!(
                "{bytes} bytes, where {} are left for a file of its size",
                self.left_bytes
            );
            io::Error::other(found)
        })?;
        header.elements(&mut reader)
    }
}

/// The type and the shape of an array, such as `f32 [N,28,28]`.
fn expected<T: Element>(row: &[usize], rows: &RangeInclusive<usize>) -> String {
    let lengths: String = row.iter().map(|length| format!(",{length}")).collect();
    let count = match rows {
        _ if *rows == ANY => "N".to_owned(),
        _ => in_words(rows),
    };
    format!("{} [{count}{lengths}]", T::NAME)
}

/// Refuses values of an array outside a range.
///
/// # Errors
///
/// Names the first of them.
pub fn within<T: PartialOrd + Display>(
    array: &str,
    values: &[T],
    range: &RangeInclusive<T>,
) -> Result<(), Unexpected> {
    let Some(place) = values.iter().position(|value| !range.contains(value)) else {
        return Ok(());
    };
    let found = format!("{} at {place}", values[place]);
    Err(Unexpected::new(array, found, in_words(range)))
}

fn in_words<T: Display + PartialEq>(range: &RangeInclusive<T>) -> String {
    let (least, most) = (range.start(), range.end());
    match least == most {
        true => least.to_string(),
        false => format!("{least} to {most}"),
    }
}
