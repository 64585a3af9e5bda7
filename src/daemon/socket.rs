//! Unix sockets: where they stand, and that nobody else's is taken.
//!
//! The file appears with its mode and already answering; one left by a dead daemon is replaced,
//! one that answers is not.

use std::fs::{self, DirBuilder, File, Permissions};
use std::io::{self, ErrorKind};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{DirBuilderExt, FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::UnixListener as StdListener;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType};
use tokio::net::{UnixListener, UnixStream};

use super::accept::Listener;

/// Longest path of a Unix socket: `sun_path` of unix(7), without its final NUL.
const LONGEST_PATH_BYTES: usize = 107;

/// How long a socket may take to be put in its place by another daemon.
const BIND_PATIENCE: Duration = Duration::from_secs(1);

/// Why there is no socket.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Somebody answers there.
    #[error("{key}: found {path}, in use by another process, expected a free path")]
    InUse {
        /// In the configuration.
        key: &'static str,
        /// Of the socket.
        path: PathBuf,
    },
    /// Something else stands there.
    #[error("{key}: found {path}, which is no socket, expected a socket or nothing there")]
    NoSocket {
        /// In the configuration.
        key: &'static str,
        /// Of the file.
        path: PathBuf,
    },
    /// No directory to put it in, and none to make that in.
    #[error("{key}: found {path} in no directory, expected one, or one to make it in")]
    NoDirectory {
        /// In the configuration.
        key: &'static str,
        /// Of the socket.
        path: PathBuf,
    },
    /// The system's limit.
    #[error("{key}: found {path}, {found} bytes, expected a path of at most {max}")]
    TooLong {
        /// In the configuration.
        key: &'static str,
        /// As given.
        path: PathBuf,
        /// Its length.
        found: usize,
        /// Largest.
        max: usize,
    },
    /// The system refused.
    #[error("{key}: {path}: cannot {what}: {source}")]
    Io {
        /// In the configuration.
        key: &'static str,
        /// Concerned.
        path: PathBuf,
        /// What was tried.
        what: &'static str,
        /// Why not.
        source: io::Error,
    },
}

/// A listening socket; its file goes with it.
#[derive(Debug)]
pub(crate) struct Socket {
    listener: UnixListener,
    path: PathBuf,
    /// Device and inode: a file that another put in its place is not ours to remove. `None`: it
    /// belongs to the service manager.
    identity: Option<(u64, u64)>,
}

impl Socket {
    /// Listens at `path`, whose file has `mode` from its first moment; `key` is the one that names it
    /// in the configuration. The directory is made if it alone is missing.
    pub(crate) fn bind(key: &'static str, path: &Path, mode: u32) -> Result<Self, Error> {
        check(key, path)?;
        let failed = |what| move |source| failed(key, path, what, source);
        let parent = directory(path);
        match DirBuilder::new().mode(0o755).create(parent) {
            Err(error) if error.kind() != ErrorKind::AlreadyExists => {
                return Err(failed("make its directory")(error));
            }
            _ => {}
        }
        // Two daemons that start at once must not both find the path free.
        let held = File::open(parent).map_err(failed("open its directory"))?;
        lock(&held).map_err(failed("lock its directory"))?;
        vacant(key, path)?;

        // Bound in a directory of our own, given its mode, then moved into place: there is no
        // moment with another mode, nor one without a listener. The way through the descriptor
        // keeps the name short, whatever the length of `path`.
        let nursery = parent.join(format!(".hardnessd-{}", std::process::id()));
        let _ = fs::remove_dir_all(&nursery);
        DirBuilder::new()
            .mode(0o700)
            .create(&nursery)
            .map_err(failed("make a directory beside"))?;
        let placed = place(&nursery, path, mode);
        let _ = fs::remove_dir_all(&nursery);
        let listener = placed.map_err(failed("listen"))?;
        let file = fs::symlink_metadata(path).map_err(failed("find"))?;
        Ok(Self {
            listener,
            path: path.to_owned(),
            identity: Some((file.dev(), file.ino())),
        })
    }

    /// That of `passed` which listens at `path`, if one does. Its file, and
    /// the mode of that, stay the service manager's.
    pub(crate) fn adopt(
        key: &'static str,
        path: &Path,
        passed: &mut Vec<StdListener>,
    ) -> Option<Result<Self, Error>> {
        // The same file may have several names: /run and /var/run.
        let place = path.canonicalize().ok()?;
        let is_there = |socket: &StdListener| {
            let address = socket.local_addr().ok();
            let found = address.as_ref().and_then(|address| address.as_pathname());
            found.is_some_and(|found| found.canonicalize().is_ok_and(|found| found == place))
        };
        let index = passed.iter().position(is_there)?;
        let listener = passed.swap_remove(index);
        let adopted = listener.set_nonblocking(true);
        let adopted = adopted.and_then(|()| UnixListener::from_std(listener));
        Some(match adopted {
            Ok(listener) => Ok(Self {
                listener,
                path: path.to_owned(),
                identity: None,
            }),
            Err(source) => Err(failed(key, path, "listen", source)),
        })
    }
}

impl Socket {
    /// Of its file.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }
}

impl Listener for Socket {
    type Stream = UnixStream;

    async fn accept(&self) -> std::io::Result<UnixStream> {
        Ok(self.listener.accept().await?.0)
    }
}

impl Drop for Socket {
    fn drop(&mut self) {
        let ours = fs::symlink_metadata(&self.path)
            .is_ok_and(|file| Some((file.dev(), file.ino())) == self.identity);
        if ours {
            let _ = fs::remove_file(&self.path);
        }
    }
}

fn lock(directory: &File) -> std::io::Result<()> {
    let start = std::time::Instant::now();
    loop {
        match flock(directory, FlockOperation::NonBlockingLockExclusive) {
            Err(Errno::WOULDBLOCK) if start.elapsed() < BIND_PATIENCE => {
                std::thread::sleep(Duration::from_millis(10));
            }
            locked => return locked.map_err(Into::into),
        }
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

/// Whether a socket can stand at `path`, as far as looking tells.
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

/// Whether a socket stands at `path`, be it dead; anything else there is an error.
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

/// Makes sure that nothing alive stands at `path`.
fn vacant(key: &'static str, path: &Path) -> Result<(), Error> {
    if !is_there(key, path)? {
        return Ok(());
    }
    // On a socket that nobody listens to, connect is refused; on any other outcome somebody may
    // (a full backlog, for one, would keep a blocking connect waiting).
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
