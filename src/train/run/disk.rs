//! Files that are complete at all times, and directories locked for one process.
//!
//! In: paths and bytes. A file is written under another name, flushed to the disk and renamed, so
//! that it is complete at all times, also after SIGKILL or a full disk.

use std::fs::{self, File};
use std::io::{self, Cursor, ErrorKind, Seek, Write};
use std::path::Path;

use anyhow::{Context as _, bail};
use rustix::fs::FlockOperation;

/// Writes a file under another name, flushes it and renames it. A link stays, and its target is
/// written. If the path is not a file but, for example, a pipe or a device, it is written directly.
///
/// # Errors
///
/// Returns the errors of writing. A file that existed before is then unchanged.
pub fn write_whole(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    write_streamed(path, |out| Ok(out.write_all(bytes)?))
}

/// A place that is written in any order.
pub trait Place: Write + Seek {}

impl<T: Write + Seek> Place for T {}

/// Like [`write_whole`], with the content that `write` writes, bit by bit. For a pipe or a device,
/// the content is held in memory until it is whole.
///
/// # Errors
///
/// Returns the errors of `write` and of writing.
pub fn write_streamed(
    path: &Path,
    write: impl FnOnce(&mut dyn Place) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let attempt = || -> anyhow::Result<()> {
        if let Some(directory) = path.parent()
            && !directory.as_os_str().is_empty()
            && !directory.exists()
        {
            let text = format!("the directory {} does not exist", directory.display());
            return Err(io::Error::new(ErrorKind::NotFound, text).into());
        }
        if path.is_symlink() && !path.exists() {
            // The link's target does not exist yet. Create it, so that the link can be followed.
            File::create(path)?;
        }
        match fs::metadata(path) {
            Ok(found) if found.is_file() => replace(&fs::canonicalize(path)?, write),
            Ok(_) => {
                let mut bytes = Cursor::new(Vec::new());
                write(&mut bytes)?;
                let mut file = File::options().write(true).open(path)?;
                Ok(file.write_all(bytes.get_ref())?)
            }
            Err(_) => replace(path, write),
        }
    };
    attempt().with_context(|| path.display().to_string())
}

fn replace(
    path: &Path,
    write: impl FnOnce(&mut dyn Place) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".part");
    let part = path.with_file_name(name);
    let mut file = create_anew(&part).with_context(|| part.display().to_string())?;
    let attempt = || -> anyhow::Result<()> {
        write(&mut file)?;
        file.sync_all()?;
        fs::rename(&part, path)?;
        // The rename is on the disk only after the directory is flushed.
        let directory = path
            .parent()
            .filter(|parent| !parent.as_os_str().is_empty());
        Ok(File::open(directory.unwrap_or(Path::new(".")))?.sync_all()?)
    };
    attempt().inspect_err(|_| {
        // A part left behind would fill the disk further. Its removal may fail for the same reason.
        let _ = fs::remove_file(&part);
    })
}

/// Creates a file anew. It first removes what a killed process left, which may not be writable. It
/// removes a link itself, not its target.
fn create_anew(path: &Path) -> io::Result<File> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(error),
        _ => File::create_new(path),
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_one_at_a_time_works_in_a_directory() {
        let directory = tempfile::tempdir().unwrap();
        let held = lock(directory.path()).unwrap();
        let error = lock(directory.path()).unwrap_err().to_string();
        assert!(
            error.ends_with(": another process is at work here"),
            "{error}"
        );
        drop(held);
        lock(directory.path()).unwrap();
    }

    #[test]
    fn whatever_has_the_name_of_the_part_loses_nothing_but_a_part() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        // The part is as a killed process leaves it, and here also read-only.
        fs::write(path("file.part"), "longer than what is written now").unwrap();
        let only_reading = std::os::unix::fs::PermissionsExt::from_mode(0o400);
        fs::set_permissions(path("file.part"), only_reading).unwrap();
        write_whole(&path("file"), b"whole").unwrap();
        assert_eq!(fs::read(path("file")).unwrap(), b"whole");
        assert!(!path("file.part").exists());

        fs::write(path("target"), "somebody's").unwrap();
        std::os::unix::fs::symlink("target", path("file.part")).unwrap();
        write_whole(&path("file"), b"again").unwrap();
        assert_eq!(fs::read(path("target")).unwrap(), b"somebody's");
        assert!(!path("file").is_symlink());

        let error = write_whole(&path("none/file"), b"never").unwrap_err();
        let error = format!("{error:#}");
        assert!(error.ends_with("none does not exist"), "{error}");

        fs::create_dir(path("file.part")).unwrap();
        let error = write_whole(&path("file"), b"never").unwrap_err();
        let error = format!("{error:#}");
        assert!(error.contains("file.part: Is a directory"), "{error}");
        assert_eq!(fs::read(path("file")).unwrap(), b"again");
    }

    #[test]
    fn links_stay_and_what_is_no_file_is_written_to_as_it_stands() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        fs::create_dir(path("elsewhere")).unwrap();
        fs::write(path("elsewhere/file"), "before").unwrap();
        for target in ["elsewhere/file", "elsewhere/new"] {
            let link = path("link");
            std::os::unix::fs::symlink(target, &link).unwrap();
            write_whole(&link, b"after").unwrap();
            assert!(link.is_symlink(), "{target}");
            assert_eq!(fs::read(path(target)).unwrap(), b"after");
            fs::remove_file(&link).unwrap();
        }

        let pipe = path("pipe");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status();
        assert!(made.unwrap().success());
        let reader = {
            let pipe = pipe.clone();
            std::thread::spawn(move || fs::read(pipe))
        };
        write_whole(&pipe, b"through").unwrap();
        // If the pipe had become a file, the reader would still wait.
        assert!(!pipe.is_file());
        assert_eq!(reader.join().unwrap().unwrap(), b"through");
    }
}
