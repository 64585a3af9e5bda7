//! Files named on the command line.

use std::path::Path;

use anyhow::Context as _;
use hardnessd_core::part::Part;

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
