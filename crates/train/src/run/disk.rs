//! Files that are complete at all times, files of the command line that are read up to a bound, and directories
//! locked for one process.

use std::fs::{self, File, TryLockError};
use std::io::{ErrorKind, Read as _};
use std::path::Path;

use anyhow::{Context as _, bail};
use hardnessd_core::exit::CONFIG;
use hardnessd_core::part::Part;
use hardnessd_core::trial;
use hardnessd_core::verdict::{MAX_FILE_BYTES, Model};

use crate::exit::{coded, unreadable};

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

/// Refuses an output that is there already or cannot be made, before the work for it.
///
/// # Errors
///
/// Names the file.
pub fn check_new(path: &Path) -> anyhow::Result<()> {
    let begun = Part::new(path).map(drop);
    begun.with_context(|| path.display().to_string())
}

/// Writes a new file as a whole.
///
/// # Errors
///
/// Returns the errors of writing, and an error if the file is there.
pub fn write_new(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let written = Part::new(path).and_then(|part| part.write(bytes));
    written.with_context(|| path.display().to_string())
}

/// The longest settings or configuration that is read, in bytes.
const MOST_TEXT_BYTES: usize = 1 << 20;

/// Reads a file of the command line, and of a longer one than `most` bytes only the beginning, with one byte more.
///
/// # Errors
///
/// Returns an error with an exit code of its own if the file cannot be read.
pub fn read(path: &Path, most: usize) -> anyhow::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let opened = File::open(path).map(|file| file.take(most as u64 + 1));
    let read = opened.and_then(|mut file| file.read_to_end(&mut bytes));
    read.map_err(|error| unreadable(path, &error))?;
    Ok(bytes)
}

/// Reads a file that may be missing.
///
/// # Errors
///
/// Returns an error if the file is there and cannot be read.
pub fn read_if_there(path: &Path) -> anyhow::Result<Option<Vec<u8>>> {
    match fs::read(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(None),
        read => read.map(Some).with_context(|| path.display().to_string()),
    }
}

/// Reads a model and the bytes of its file, once: the file may be a pipe.
///
/// # Errors
///
/// Returns an error with an exit code of its own if the file cannot be read, or is no model that the daemon takes.
pub fn load(path: &Path) -> anyhow::Result<(Model, Vec<u8>)> {
    let bytes = read(path, MAX_FILE_BYTES)?;
    let model = trial::load(&bytes, None).with_context(|| path.display().to_string())?;
    Ok((model, bytes))
}

/// Reads settings or a configuration of the command line.
///
/// # Errors
///
/// Returns an error with an exit code of its own if the file cannot be read, or is too long.
pub fn read_text(path: &Path) -> anyhow::Result<String> {
    let bytes = read(path, MOST_TEXT_BYTES)?;
    if bytes.len() > MOST_TEXT_BYTES {
        let path = path.display();
        let long = format_args!("{path}: found more than {MOST_TEXT_BYTES} bytes");
        return Err(coded(CONFIG, long));
    }
    Ok(String::from_utf8_lossy(&bytes).into_owned())
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
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => bail!("{}: another process is at work here", context()),
        Err(TryLockError::Error(error)) => Err(error).with_context(context),
    }
}
