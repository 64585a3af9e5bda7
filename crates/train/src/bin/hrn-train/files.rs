//! Files named on the command line.

use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use anyhow::Context as _;
use hardnessd_core::part::Part;
use hardnessd_core::trial;
use hardnessd_core::verdict::{MAX_FILE_BYTES, Model};

use hrn_train::exit::unreadable;

/// Reads a model or settings, and of a file that is too long for either only the beginning.
pub(super) fn read(path: &Path) -> anyhow::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let opened = File::open(path).map(|file| file.take(MAX_FILE_BYTES as u64 + 1));
    let read = opened.and_then(|mut file| file.read_to_end(&mut bytes));
    read.map_err(|error| unreadable(path, &error))?;
    Ok(bytes)
}

/// Refuses an output that is there already or cannot be made, before the work for it.
pub(super) fn check_new(path: &Path) -> anyhow::Result<()> {
    let begun = Part::new(path).map(drop);
    begun.with_context(|| path.display().to_string())
}

/// Writes a new file as a whole.
pub(super) fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let written = Part::new(path).and_then(|part| part.write(bytes));
    written.with_context(|| path.display().to_string())
}

/// A model and the bytes of its file, read once: the file may be a pipe.
pub(super) fn load(path: &Path) -> anyhow::Result<(Model, Vec<u8>)> {
    let bytes = read(path)?;
    let model = trial::load(&bytes, None).with_context(|| path.display().to_string())?;
    Ok((model, bytes))
}
