//! The file of a socket, which is made with its mode, and only where no process listens.

use std::fs::{self, DirBuilder, File, OpenOptions, Permissions};
use std::io::{self, ErrorKind};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{DirBuilderExt, FileTypeExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::os::unix::net::UnixListener as StdListener;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::fs::{FlockOperation, OFlags, flock};
use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType};
use tokio::net::UnixListener;

use super::Error;

/// The longest path of a Unix socket: `sun_path` of unix(7), without its final NUL.
const LONGEST_PATH_BYTES: usize = 107;

/// The file that a daemon locks while it binds, in the socket's directory.
const LOCK_FILE: &str = ".hardnessd.lock";

/// The file of a socket, as configured.
#[derive(Debug, Clone)]
pub(super) struct Place {
    /// The key of the configuration.
    pub(super) key: &'static str,
    pub(super) path: PathBuf,
    pub(super) mode: u32,
}

/// The device and the inode of a file.
pub(super) type Identity = (u64, u64);

pub(super) fn identity(path: &Path) -> io::Result<Identity> {
    let file = fs::symlink_metadata(path)?;
    Ok((file.dev(), file.ino()))
}

impl Place {
    /// Listens at the path. If another daemon binds in the same directory at the moment, this waits
    /// for it, but not longer than `patience`.
    pub(super) fn listen(&self, patience: Duration) -> Result<(UnixListener, Identity), Error> {
        let Self { key, path, mode } = self;
        check(key, path)?;
        let parent = directory(path);
        match DirBuilder::new().mode(0o755).create(parent) {
            Err(error) if error.kind() != ErrorKind::AlreadyExists => {
                return Err(self.failed("make its directory")(error));
            }
            _ => {}
        }
        // Two daemons that start at once must not both find the path free.
        let _alone =
            Lock::take(parent, patience).map_err(self.failed("make a lock file beside"))?;
        vacant(key, path)?;

        // The socket is bound in a directory of our own, gets its mode, and is then moved into
        // place. So its file never has another mode and is never without a listener. The path
        // through the descriptor is short, however long `path` is.
        let nursery = parent.join(format!(".hardnessd-{}", std::process::id()));
        let _ = fs::remove_dir_all(&nursery);
        DirBuilder::new()
            .mode(0o700)
            .create(&nursery)
            .map_err(self.failed("make a directory beside"))?;
        let placed = place(&nursery, path, *mode);
        let _ = fs::remove_dir_all(&nursery);
        let listener = placed.map_err(self.failed("listen"))?;
        let identity = identity(path).map_err(self.failed("find"))?;
        Ok((listener, identity))
    }

    pub(super) fn failed(&self, what: &'static str) -> impl FnOnce(io::Error) -> Error {
        move |source| failed(self.key, &self.path, what, source)
    }
}

/// The right to bind a socket in a directory, which only one daemon has at a time. It is a lock on
/// a file that exists only while the lock is held and that no other user can open. Other users may
/// open the directory itself, so a lock on the directory would let each of them keep the daemon
/// out.
struct Lock {
    path: PathBuf,
    /// The file is locked for as long as it is open.
    _file: File,
}

impl Lock {
    fn take(directory: &Path, patience: Duration) -> io::Result<Self> {
        let path = directory.join(LOCK_FILE);
        let start = std::time::Instant::now();
        loop {
            match Self::try_take(&path) {
                Err(error)
                    if error.kind() == ErrorKind::WouldBlock && start.elapsed() < patience =>
                {
                    std::thread::sleep(Duration::from_millis(10));
                }
                taken => return taken,
            }
        }
    }

    fn try_take(path: &Path) -> io::Result<Self> {
        let file = OpenOptions::new()
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            // Another program may have put a link or a pipe there: do not follow it or wait for it.
            .custom_flags((OFlags::NOFOLLOW | OFlags::NONBLOCK).bits().cast_signed())
            .open(path)?;
        flock(&file, FlockOperation::NonBlockingLockExclusive)?;
        // If the last holder removed this file meanwhile, a lock on it would exclude no other
        // daemon.
        let held = file.metadata()?;
        if identity(path).ok() != Some((held.dev(), held.ino())) {
            return Err(ErrorKind::WouldBlock.into());
        }
        let path = path.to_owned();
        Ok(Self { path, _file: file })
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        // The file is removed before the lock is released.
        let _ = fs::remove_file(&self.path);
    }
}

fn failed(key: &'static str, path: &Path, what: &'static str, source: io::Error) -> Error {
    Error::Io {
        key,
        path: path.to_owned(),
        what,
        source,
    }
}

/// Checks that a socket can be made at `path`, without making it.
pub(crate) fn check(key: &'static str, path: &Path) -> Result<(), Error> {
    let found = path.as_os_str().len();
    if found > LONGEST_PATH_BYTES {
        return Err(Error::TooLong {
            key,
            path: path.to_owned(),
            found,
            max: LONGEST_PATH_BYTES,
        });
    }
    let parent = directory(path);
    let has_directory = match fs::metadata(parent) {
        Err(error) if error.kind() == ErrorKind::NotFound => directory(parent).is_dir(),
        Err(error) if error.kind() == ErrorKind::NotADirectory => false,
        Err(error) => return Err(failed(key, path, "find its directory", error)),
        Ok(parent) => parent.is_dir(),
    };
    if !has_directory {
        let path = path.to_owned();
        return Err(Error::NoDirectory { key, path });
    }
    is_there(key, path).map(drop)
}

/// The directory of a file.
fn directory(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if parent != Path::new("") => parent,
        _ => Path::new("."),
    }
}

/// Whether there is a socket at `path`, alive or dead. Any other file there is an error.
fn is_there(key: &'static str, path: &Path) -> Result<bool, Error> {
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(false),
        Err(error) => Err(failed(key, path, "look at it", error)),
        Ok(file) if file.file_type().is_socket() => Ok(true),
        Ok(_) => {
            let path = path.to_owned();
            Err(Error::NoSocket { key, path })
        }
    }
}

/// Fails if a process listens at `path`.
fn vacant(key: &'static str, path: &Path) -> Result<(), Error> {
    if !is_there(key, path)? {
        return Ok(());
    }
    // A connection to a dead socket is refused. With any other result a process may listen there.
    // The socket does not block, because a full backlog would keep a blocking connect waiting.
    let probe = || {
        let socket = rustix::net::socket_with(
            AddressFamily::UNIX,
            SocketType::STREAM,
            SocketFlags::NONBLOCK | SocketFlags::CLOEXEC,
            None,
        )?;
        rustix::net::connect(&socket, &SocketAddrUnix::new(path)?)
    };
    match probe() {
        Err(Errno::CONNREFUSED | Errno::NOENT) => Ok(()),
        Err(error @ (Errno::ACCESS | Errno::PERM)) => {
            Err(failed(key, path, "try it", error.into()))
        }
        _ => {
            let path = path.to_owned();
            Err(Error::InUse { key, path })
        }
    }
}

fn place(nursery: &Path, path: &Path, mode: u32) -> std::io::Result<UnixListener> {
    let directory = File::open(nursery)?;
    let born = PathBuf::from(format!("/proc/self/fd/{}/s", directory.as_raw_fd()));
    let listener = StdListener::bind(&born)?;
    listener.set_nonblocking(true)?;
    fs::set_permissions(&born, Permissions::from_mode(mode))?;
    fs::rename(nursery.join("s"), path)?;
    UnixListener::from_std(listener)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lock_is_held_by_one_and_leaves_no_file() {
        let directory = tempfile::tempdir().unwrap();
        let take = || Lock::take(directory.path(), Duration::ZERO);
        let held = take().unwrap();
        let mode = fs::metadata(directory.path().join(LOCK_FILE)).unwrap();
        assert_eq!(mode.permissions().mode() & 0o777, 0o600);
        let refused = take().map(drop).unwrap_err();
        assert_eq!(refused.kind(), ErrorKind::WouldBlock);
        drop(held);
        assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 0);
        drop(take().unwrap());
    }
}
