//! Files that are whole or not there.
//!
//! In: a path, and bytes. The bytes go into a file without a name in the same directory, which gets its name once
//! it is whole and on the disk. If the process is killed before, nothing is left. Nothing is removed but what this
//! process has made: what else is in the directory, whatever its name, stays as it is.

use std::ffi::{OsStr, OsString};
use std::fs::{self, File, Permissions};
use std::io::{self, ErrorKind, Write as _};
use std::os::fd::AsRawFd as _;
use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _, fchown};
use std::path::{Path, PathBuf};

use rustix::fs::{AtFlags, CWD, Mode, OFlags, linkat};
use tempfile::{Builder, TempPath};

/// A file that is being written. It is gone if it is dropped before [`Part::finish`].
#[derive(Debug)]
pub struct Part {
    file: File,
    /// The name of the file until it is whole, on a file system where it needs one.
    named: Option<TempPath>,
    path: PathBuf,
    /// Whether an earlier file at the path is replaced.
    replaces: bool,
}

impl Part {
    /// Begins a new file.
    ///
    /// # Errors
    ///
    /// Fails if anything is at `path`, even a link to a file that does not exist, or if no file can be made
    /// there.
    pub fn new(path: &Path) -> io::Result<Self> {
        if path.symlink_metadata().is_ok() {
            return Err(taken());
        }
        let (file, named) = beside(path)?;
        Ok(Self {
            file,
            named,
            path: path.to_owned(),
            replaces: false,
        })
    }

    /// Begins a file that may replace an earlier one, whose mode it takes. A link stays, and its target is
    /// written.
    ///
    /// # Errors
    ///
    /// Fails if something other than a file is at `path`, or if no file can be made there.
    pub fn over(path: &Path) -> io::Result<Self> {
        let before = match fs::metadata(path) {
            Ok(found) if !found.is_file() => {
                let found = "found no file, but perhaps a pipe or a device: name a file";
                return Err(io::Error::other(found));
            }
            Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
            found => found.ok(),
        };
        // The links end somewhere, because the system has just followed them.
        let mut target = path.to_owned();
        while let Ok(next) = fs::read_link(&target) {
            target = directory_of(&target).join(next);
        }
        let (file, named) = beside(&target)?;
        if let Some(before) = before {
            // Only root may give a file away.
            let _ = fchown(&file, Some(before.uid()), Some(before.gid()));
            file.set_permissions(before.permissions())?;
        }
        Ok(Self {
            file,
            named,
            path: target,
            replaces: true,
        })
    }

    /// The file to write to.
    pub fn as_file(&self) -> &File {
        &self.file
    }

    /// Writes the bytes of the whole file, and gives it its name.
    ///
    /// # Errors
    ///
    /// Those of [`Part::finish`].
    pub fn write(self, bytes: &[u8]) -> io::Result<()> {
        self.as_file().write_all(bytes)?;
        self.finish()
    }

    /// Gives the file its name.
    ///
    /// # Errors
    ///
    /// Fails if a new file's path has been taken meanwhile, or if the file cannot be written to the disk or
    /// renamed.
    pub fn finish(self) -> io::Result<()> {
        self.file.sync_all()?;
        let directory = directory_of(&self.path);
        // A link replaces nothing, but a renamed one does.
        let part = match self.named {
            Some(part) => part,
            None => name(&prefix(&self.path))
                .make_in(directory, |part| link(&self.file, part))?
                .into_temp_path(),
        };
        let named = match self.replaces {
            true => part.persist(&self.path),
            false => part.persist_noclobber(&self.path),
        };
        named.map_err(|failed| match failed.error.kind() {
            ErrorKind::AlreadyExists => taken(),
            _ => failed.error,
        })?;
        // The name is on the disk only after the directory is flushed.
        File::open(directory)?.sync_all()
    }
}

/// Whether `file` is still at `path`.
///
/// # Errors
///
/// Fails if the system does not say so.
pub fn is_at(path: &Path, file: &File) -> io::Result<bool> {
    let identity = |found: fs::Metadata| (found.dev(), found.ino());
    match fs::symlink_metadata(path) {
        Ok(there) => Ok(identity(there) == identity(file.metadata()?)),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// Removes `file`, which this process has made at `path`. A file that took its place stays.
pub fn remove(path: &Path, file: &File) {
    if is_at(path, file).unwrap_or_default() {
        // The caller reports a first error, which says more than a second one.
        let _ = fs::remove_file(path);
    }
}

/// The directory of a file.
pub fn directory_of(file: &Path) -> &Path {
    let directory = file.parent().filter(|path| !path.as_os_str().is_empty());
    directory.unwrap_or(Path::new("."))
}

/// The descriptors of this process, by which a file without a name gets one.
const DESCRIPTORS: &str = "/proc/self/fd";

/// The directory of a file that is to be made.
///
/// # Errors
///
/// Fails, and names the directory, if it does not exist.
pub fn directory_for(file: &Path) -> io::Result<&Path> {
    let directory = directory_of(file);
    if directory.exists() {
        return Ok(directory);
    }
    let text = format!("the directory {} does not exist", directory.display());
    Err(io::Error::new(ErrorKind::NotFound, text))
}

/// A file in the directory of `path`, without a name where the file system can do that.
fn beside(path: &Path) -> io::Result<(File, Option<TempPath>)> {
    let directory = directory_for(path)?;
    let flags = OFlags::TMPFILE | OFlags::RDWR | OFlags::CLOEXEC;
    if Path::new(DESCRIPTORS).exists()
        && let Ok(file) = rustix::fs::open(directory, flags, Mode::from_raw_mode(0o666))
    {
        return Ok((file.into(), None));
    }
    let file = name(&prefix(path))
        .permissions(Permissions::from_mode(0o666))
        .tempfile_in(directory)?;
    let (file, part) = file.into_parts();
    Ok((file, Some(part)))
}

/// The begin of the name of a file until it is whole. What a killed process leaves shows what it was
/// going to be.
fn prefix(path: &Path) -> OsString {
    let mut prefix = path.file_name().unwrap_or_default().to_owned();
    prefix.push(".");
    prefix
}

fn name(prefix: &OsStr) -> Builder<'_, 'static> {
    let mut name = Builder::new();
    name.prefix(prefix).suffix(".part");
    name
}

/// Gives a name to a file without one.
fn link(file: &File, path: &Path) -> io::Result<()> {
    let file = format!("{DESCRIPTORS}/{}", file.as_raw_fd());
    Ok(linkat(CWD, file, CWD, path, AtFlags::SYMLINK_FOLLOW)?)
}

fn taken() -> io::Error {
    let found = "a file or link is there already: name another one, or remove it";
    io::Error::new(ErrorKind::AlreadyExists, found)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    fn write(part: io::Result<Part>, bytes: &[u8]) -> io::Result<()> {
        part?.write(bytes)
    }

    fn names(directory: &Path) -> Vec<String> {
        let names = fs::read_dir(directory).unwrap();
        let names = names.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<_> = names.collect();
        names.sort();
        names
    }

    #[test]
    fn a_new_file_replaces_nothing_not_even_what_came_meanwhile() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        write(Part::new(&path("new")), b"ours").unwrap();
        assert_eq!(fs::read(path("new")).unwrap(), b"ours");
        let is_taken = |result: io::Result<()>| {
            assert_eq!(result.unwrap_err().kind(), ErrorKind::AlreadyExists);
        };
        is_taken(write(Part::new(&path("new")), b"again"));
        symlink(path("nowhere"), path("link")).unwrap();
        is_taken(write(Part::new(&path("link")), b"through"));
        let part = Part::new(&path("late"));
        fs::write(path("late"), "theirs").unwrap();
        is_taken(write(part, b"ours"));
        assert_eq!(fs::read(path("late")).unwrap(), b"theirs");
        // Whoever is killed leaves nothing, where a file needs no name until it is whole.
        let part = Part::new(&path("given up")).unwrap();
        let beside = usize::from(part.named.is_some());
        assert_eq!(names(directory.path()).len(), 3 + beside);
        drop(part);
        assert_eq!(names(directory.path()), ["late", "link", "new"]);
    }

    #[test]
    fn a_file_that_is_replaced_keeps_its_mode_and_its_links() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        fs::create_dir(path("elsewhere")).unwrap();
        fs::write(path("elsewhere/file"), "before").unwrap();
        let only_own = Permissions::from_mode(0o600);
        fs::set_permissions(path("elsewhere/file"), only_own).unwrap();
        symlink("elsewhere/file", path("link")).unwrap();
        symlink("link", path("link of a link")).unwrap();
        symlink("elsewhere/new", path("link to none")).unwrap();
        for (link, target) in [
            ("link", "elsewhere/file"),
            ("link of a link", "elsewhere/file"),
            ("link to none", "elsewhere/new"),
        ] {
            write(Part::over(&path(link)), link.as_bytes()).unwrap();
            assert!(path(link).is_symlink(), "{link}");
            assert_eq!(fs::read(path(target)).unwrap(), link.as_bytes());
        }
        let mode = fs::metadata(path("elsewhere/file")).unwrap().mode();
        assert_eq!(mode & 0o777, 0o600);
        assert_eq!(names(&path("elsewhere")), ["file", "new"]);
    }

    #[test]
    fn what_is_no_file_is_not_replaced() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        symlink("loop", path("loop")).unwrap();
        symlink("/dev/null", path("device")).unwrap();
        for (name, part) in [
            ("", "found no file"),
            ("device", "found no file"),
            ("loop", "symbolic links"),
            ("none/file", "none does not exist"),
        ] {
            let error = write(Part::over(&path(name)), b"never").unwrap_err();
            assert!(error.to_string().contains(part), "{name}: {error}");
        }
        assert_eq!(names(directory.path()), ["device", "loop"]);
    }
}
