//! Files named on the command line.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::Path;

use anyhow::Context as _;
use hardnessd_core::part::Part;
use hardnessd_core::trial;
use hardnessd_core::verdict::{Hrn, MAX_FILE_BYTES};

use hrn_train::exit::unreadable;

/// Reads a model or settings. A file that is too long for either is refused, as the daemon refuses it.
pub(super) fn read(path: &Path) -> anyhow::Result<Vec<u8>> {
    let read = || {
        let mut bytes = Vec::new();
        let file = File::open(path)?;
        file.take(MAX_FILE_BYTES as u64 + 1)
            .read_to_end(&mut bytes)?;
        if bytes.len() > MAX_FILE_BYTES {
            return Err(io::Error::other(format!(
                "found more than {MAX_FILE_BYTES} bytes, expected at most so many"
            )));
        }
        Ok(bytes)
    };
    read().map_err(|error| unreadable(path, &error))
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
pub(super) fn load(path: &Path) -> anyhow::Result<(Hrn, Vec<u8>)> {
    let bytes = read(path)?;
    let model = trial::load(&bytes, None).with_context(|| path.display().to_string())?;
    Ok((model, bytes))
}
