//! Files named on the command line.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::Path;

use anyhow::Context as _;
use hardnessd_core::part::Part;
use hardnessd_core::trial;
use hardnessd_core::verdict::{Hrn, MAX_FILE_BYTES};

use super::failure::{Unreadable, WrongUsage};

/// Refuses an output that is one of the command's other files.
pub(super) fn apart<'a>(
    option: &'static str,
    out: &Path,
    others: impl IntoIterator<Item = &'a Path>,
) -> Result<(), WrongUsage> {
    let file = |path: &Path| path.canonicalize().ok().filter(|path| path.is_file());
    let found = file(out);
    let same = |other: &Path| other == out || (found.is_some() && file(other) == found);
    match others.into_iter().find(|other| same(other)) {
        Some(_) => Err(WrongUsage::Overwritten(option, out.to_owned())),
        None => Ok(()),
    }
}

/// Reads a model or settings. A file that is too long for either is refused, as the daemon refuses it.
pub(super) fn read(path: &Path) -> Result<Vec<u8>, Unreadable> {
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
    read().map_err(|source| Unreadable {
        path: path.to_owned(),
        source,
    })
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

pub(super) fn load(path: &Path) -> anyhow::Result<Hrn> {
    Ok(load_with_bytes(path)?.0)
}

/// A model and the bytes of its file, read once: the file may be a pipe.
pub(super) fn load_with_bytes(path: &Path) -> anyhow::Result<(Hrn, Vec<u8>)> {
    let bytes = read(path)?;
    let model = trial::load(&bytes, None).with_context(|| path.display().to_string())?;
    Ok((model, bytes))
}
