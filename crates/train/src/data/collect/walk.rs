//! Directories of recordings.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use super::{CollectError, Problem};
use hardnessd_core::recording::MAGIC;

/// The files that `paths` name. In place of a directory come all recordings below it, sorted by
/// their paths. A recording is known by its first bytes. Links to directories are not followed.
///
/// # Errors
///
/// Returns an error if a directory cannot be read, or has no recording.
pub fn captures(paths: &[PathBuf]) -> Result<Vec<PathBuf>, CollectError> {
    let mut all = Vec::new();
    for path in paths {
        if !path.is_dir() {
            all.push(path.clone());
            continue;
        }
        let mut found = below(path)?;
        if found.is_empty() {
            return Err(Problem::Empty.of(path));
        }
        found.sort();
        all.append(&mut found);
    }
    Ok(all)
}

fn below(directory: &Path) -> Result<Vec<PathBuf>, CollectError> {
    let (mut found, mut directories) = (Vec::new(), vec![directory.to_owned()]);
    while let Some(directory) = directories.pop() {
        let unreadable = |error| Problem::Unreadable(error).of(&directory);
        for entry in fs::read_dir(&directory).map_err(unreadable)? {
            let entry = entry.map_err(unreadable)?;
            let path = entry.path();
            if entry.file_type().map_err(unreadable)?.is_dir() {
                directories.push(path);
            } else if path.is_file() && is_recording(&path) {
                found.push(path);
            }
        }
    }
    Ok(found)
}

/// Whether a file begins as a recording. An unreadable file counts as one, so that it is named
/// later.
fn is_recording(path: &Path) -> bool {
    let mut start = [0; MAGIC.len()];
    let read = File::open(path).and_then(|mut file| file.read_exact(&mut start));
    match read {
        Ok(()) => start == *MAGIC,
        Err(error) => error.kind() != io::ErrorKind::UnexpectedEof,
    }
}
