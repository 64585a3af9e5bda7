//! Files that are complete at all times, and directories locked for one process.

use std::fs::File;
use std::io;
use std::path::Path;

use anyhow::{Context as _, bail};
use hardnessd_core::part::Part;
use rustix::fs::FlockOperation;

/// Writes a file under another name, flushes it and renames it, so that it is complete at all times, also
/// after SIGKILL or a full disk. It may replace an earlier file. A link stays, and its target is written.
///
/// # Errors
///
/// Returns the errors of writing. A file that existed before is then unchanged.
pub fn write_whole(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let written = Part::over(path).and_then(|part| part.write(bytes));
    written.with_context(|| path.display().to_string())
}

/// Returns an error if a directory has files that a command would replace, but not the one that the
/// command always writes first: then they are somebody else's.
///
/// # Errors
///
/// Names the directory and the file.
pub fn refuse_foreign(directory: &Path, first: &str, others: &[&str]) -> anyhow::Result<()> {
    let found = others.iter().find(|name| directory.join(name).exists());
    match found {
        Some(name) if !directory.join(first).exists() => bail!(
            "{}: has {name} but no {first}, so it is of something else: choose another --out",
            directory.display()
        ),
        _ => Ok(()),
    }
}

/// Locks a directory against other processes while the file is open.
///
/// # Errors
///
/// Returns an error if another process holds the lock, or the directory cannot be opened.
pub fn lock(directory: &Path) -> anyhow::Result<File> {
    let context = || directory.display().to_string();
    let file = File::open(directory).with_context(context)?;
    match rustix::fs::flock(&file, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Ok(file),
        Err(rustix::io::Errno::WOULDBLOCK) => {
            bail!("{}: another process is at work here", context())
        }
        Err(error) => Err(io::Error::from(error)).with_context(context),
    }
}
