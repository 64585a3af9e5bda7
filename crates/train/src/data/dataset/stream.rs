//! Writer of an `.npz` file whose arrays come in blocks, so that no array has to fit into memory.
//!
//! In: the shape of each array, then its values. Out: the file that `ndarray-npy` writes of whole
//! arrays, except that a large array may be packed a few bytes tighter or looser.

use std::io::{BufWriter, Seek, Write};

use anyhow::bail;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use super::file::Element;
use hardnessd_core::npy;

/// The number of bytes that are compressed at once.
const BLOCK_BYTES: usize = 1 << 16;
/// An array above this size gets 64-bit lengths in the archive. Packed bytes may be slightly more
/// than unpacked ones, so it is less than 4 GiB.
const LARGE_BYTES: u64 = 0xF000_0000;

/// An `.npz` file being written.
pub(in crate::data) struct Stream<W: Write + Seek> {
    zip: ZipWriter<W>,
}

impl<W: Write + Seek> Stream<W> {
    pub(in crate::data) fn new(out: W) -> Self {
        Self {
            zip: ZipWriter::new(out),
        }
    }

    /// Adds an array, compressed. Its values are those of `blocks`, row by row.
    ///
    /// # Errors
    ///
    /// Returns an error if a block is one, there are more or fewer values than `shape` says, or
    /// writing fails.
    pub(in crate::data) fn add<T: Element>(
        &mut self,
        name: &str,
        shape: &[usize],
        blocks: impl IntoIterator<Item = anyhow::Result<Vec<T>>>,
    ) -> anyhow::Result<()> {
        let expected: usize = shape.iter().product();
        let bytes = expected as u64 * size_of::<T>() as u64;
        let options = SimpleFileOptions::default()
            .compression_method(CompressionMethod::Deflated)
            .large_file(bytes > LARGE_BYTES);
        self.zip.start_file(format!("{name}.npy"), options)?;
        let mut out = BufWriter::with_capacity(BLOCK_BYTES, &mut self.zip);
        out.write_all(&npy::header_bytes(T::DESCRIPTIONS[0], shape))?;
        let mut found = 0;
        for block in blocks {
            let block = block?;
            found += block.len();
            out.write_all(&T::bytes(&block))?;
        }
        if found != expected {
            bail!("array `{name}`: found {found} values, expected {expected}");
        }
        Ok(out.flush()?)
    }

    pub(in crate::data) fn finish(self) -> anyhow::Result<W> {
        let mut out = self.zip.finish()?;
        out.flush()?;
        Ok(out)
    }
}
