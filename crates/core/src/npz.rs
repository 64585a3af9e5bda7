//! Arrays of an `.npz` file: the types of their elements, and the writer.
//!
//! In: the name, the shape and the elements of each array, row by row. Out: a zip archive with an
//! `.npy` file for each, as numpy's `savez` and `savez_compressed` write it.

use std::io::{self, Seek, Write};

use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use crate::npy::Header;

/// An array above this size gets 64-bit lengths in the archive. Packed bytes may be slightly more
/// than unpacked ones, so it is less than 4 GiB.
const LARGE_BYTES: usize = 0xF000_0000;

/// An element type that our files may hold.
pub trait Element: Copy {
    /// The type's name in errors.
    const NAME: &'static str;
    /// The type's name in numpy's headers.
    const DESCR: &'static str;
    /// A number of any type as this one. `None` if it does not fit.
    fn of(number: f64) -> Option<Self>;
    /// Adds the element's bytes.
    fn push(self, bytes: &mut Vec<u8>);
}

macro_rules! element {
    ($type:ident, $descr:literal, $of:expr) => {
        impl Element for $type {
            const NAME: &'static str = stringify!($type);
            const DESCR: &'static str = $descr;
            fn of(number: f64) -> Option<Self> {
                $of(number as $type, number)
            }
            fn push(self, bytes: &mut Vec<u8>) {
                bytes.extend(self.to_le_bytes());
            }
        }
    };
}
element!(f32, "<f4", |rounded, _| Some(rounded));
element!(u32, "<u4", exactly);
element!(i32, "<i4", exactly);
element!(u16, "<u2", exactly);
element!(i16, "<i2", exactly);
element!(u8, "|u1", exactly);

/// A whole number, if it equals `number`.
fn exactly<T: Copy + Into<f64>>(whole: T, number: f64) -> Option<T> {
    (whole.into() == number).then_some(whole)
}

/// An `.npz` file being written. It holds no date, so the same arrays give the same bytes.
pub struct Writer<W: Write + Seek> {
    zip: ZipWriter<W>,
    method: CompressionMethod,
}

impl<W: Write + Seek> Writer<W> {
    /// Begins a file whose arrays are not compressed.
    pub fn plain(out: W) -> Self {
        Self {
            zip: ZipWriter::new(out),
            method: CompressionMethod::Stored,
        }
    }

    /// Begins a file whose arrays are compressed.
    pub fn compressed(out: W) -> Self {
        Self {
            method: CompressionMethod::Deflated,
            ..Self::plain(out)
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
        let header = Header {
            descr: T::DESCR.to_owned(),
            fortran_order: false,
            shape: shape.to_vec(),
        };
        debug_assert_eq!(header.count(), Some(elements.len()), "{name}: {shape:?}");
        let mut bytes = header.to_bytes();
        bytes.reserve_exact(size_of_val(elements));
        elements.iter().for_each(|element| element.push(&mut bytes));
        self.add_npy(name, &bytes)
    }

    /// Adds the bytes of an `.npy` file.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing.
    pub fn add_npy(&mut self, name: &str, bytes: &[u8]) -> io::Result<()> {
        let options = SimpleFileOptions::default()
            .compression_method(self.method)
            .large_file(bytes.len() > LARGE_BYTES);
        self.zip.start_file(format!("{name}.npy"), options)?;
        self.zip.write_all(bytes)?;
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
        let mut out = self.zip.finish()?;
        out.flush()?;
        Ok(out)
    }
}
