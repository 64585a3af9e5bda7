//! Files named on the command line.

use std::path::Path;

use anyhow::Context as _;
use hardnessd::train::run::disk::write_whole;
use hardnessd::trial;
use hardnessd::verdict::Hrn;

use super::failure::Unreadable;

pub(super) fn read(path: &Path) -> Result<Vec<u8>, Unreadable> {
    std::fs::read(path).map_err(|source| Unreadable {
        path: path.to_owned(),
        source,
    })
}

/// Writes a file at once and as a whole. If it replaces a file, stderr says so.
pub(super) fn write(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let is_replaced = path.is_file();
    write_whole(path, bytes)?;
    if is_replaced {
        eprintln!("{}: replaced the earlier file", path.display());
    }
    Ok(())
}

pub(super) fn load(path: &Path) -> anyhow::Result<Hrn> {
    trial::load(&read(path)?, None).with_context(|| path.display().to_string())
}
