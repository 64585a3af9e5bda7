//! Files that are complete at all times, and directories locked for one process.
//!
//! In: paths and bytes. A file is written under another name, flushed to the disk and renamed, so
//! that it is complete at all times, also after SIGKILL or a full disk.

use std::fs::{self, File};
use std::io::{self, Cursor, ErrorKind, Seek, Write};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::Path;

use anyhow::{Context as _, bail};
use rustix::fs::{FlockOperation, OFlags};

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
    let mut file = open_alone(&part).with_context(|| part.display().to_string())?;
    let attempt = || -> anyhow::Result<()> {
        if let Ok(before) = fs::metadata(path) {
            file.set_permissions(before.permissions())?;
        }
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

/// Opens an empty file for this call alone. If another call or process writes it, this waits until
/// that one has renamed or removed it. What a killed process left is removed or emptied; it may be
/// unwritable, or a link, whose target stays.
fn open_alone(path: &Path) -> io::Result<File> {
    loop {
        let mut options = File::options();
        options.write(true).create(true).truncate(false);
        let file = match options
            .custom_flags(OFlags::NOFOLLOW.bits() as i32)
            .open(path)
        {
            Ok(file) => file,
            Err(error) if path.is_symlink() || error.kind() == ErrorKind::PermissionDenied => {
                // If this removes nothing, the path cannot be written at all.
                fs::remove_file(path).map_err(|_| error)?;
                continue;
            }
            Err(error) => return Err(error),
        };
        // Some file systems have no locks. There, only one may write at a time.
        let _ = rustix::fs::flock(&file, FlockOperation::LockExclusive);
        // While this waited, the other one may have renamed or removed the file.
        let (own, at_path) = (file.metadata()?, fs::symlink_metadata(path));
        if at_path.is_ok_and(|found| (found.dev(), found.ino()) == (own.dev(), own.ino())) {
            file.set_len(0)?;
            return Ok(file);
        }
    }
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
    fn several_at_once_write_one_file_and_it_is_whole_at_all_times() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        let whole = |writer: u8| vec![writer; 100_000];
        write_whole(&path, &whole(0)).unwrap();
        std::thread::scope(|scope| {
            let writers = (1..=4).map(|writer| {
                let path = &path;
                scope.spawn(move || {
                    for _ in 0..20 {
                        write_whole(path, &whole(writer)).unwrap();
                    }
                })
            });
            let writers: Vec<_> = writers.collect();
            while writers.iter().any(|writer| !writer.is_finished()) {
                let found = fs::read(&path).unwrap();
                assert!(found == whole(found[0]), "{} bytes", found.len());
            }
        });
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_file_keeps_its_permissions() {
        use std::os::unix::fs::PermissionsExt as _;
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        write_whole(&path, b"before").unwrap();
        fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
        write_whole(&path, b"after").unwrap();
        assert_eq!(
            fs::metadata(&path).unwrap().permissions().mode() & 0o777,
            0o600
        );
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
