//! The file of a socket, which is made with its mode, and only where no process listens.

use std::fs::{self, DirBuilder, Permissions};
use std::io::{self, ErrorKind};
use std::os::unix::fs::{DirBuilderExt, FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::UnixListener as StdListener;
use std::path::{Path, PathBuf};

use rustix::fd::OwnedFd;
use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType};
use tokio::net::UnixListener;

use super::Error;

/// The longest path of a Unix socket: `sun_path` of unix(7), without its final NUL.
const LONGEST_PATH_BYTES: usize = 107;

/// The most connections that wait to be accepted, if the system allows as many.
const BACKLOG: i32 = 4096;

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
    /// Listens at the path. A socket at which nobody listens is replaced.
    pub(super) fn listen(&self) -> Result<(UnixListener, Identity), Error> {
        let Self { key, path, mode } = self;
        check(key, path)?;
        match DirBuilder::new().mode(0o755).create(directory(path)) {
            Err(error) if error.kind() != ErrorKind::AlreadyExists => {
                return Err(self.failed("make its directory")(error));
            }
            _ => {}
        }
        if is_there(key, path)? {
            vacant(key, path)?;
            fs::remove_file(path).map_err(self.failed("replace it"))?;
        }
        let listening = || {
            let socket = socket()?;
            rustix::net::bind(&socket, &SocketAddrUnix::new(path)?)?;
            // Until the socket listens, connections are refused. So nobody comes in before the file
            // has its mode.
            fs::set_permissions(path, Permissions::from_mode(*mode))?;
            rustix::net::listen(&socket, BACKLOG)?;
            UnixListener::from_std(StdListener::from(socket))
        };
        let listener = listening().map_err(self.failed("listen"))?;
        let identity = identity(path).map_err(self.failed("find"))?;
        Ok((listener, identity))
    }

    pub(super) fn failed(&self, what: &'static str) -> impl FnOnce(io::Error) -> Error {
        move |source| failed(self.key, &self.path, what, source)
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

fn socket() -> rustix::io::Result<OwnedFd> {
    let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
    rustix::net::socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)
}

/// Fails if a process listens at `path`.
fn vacant(key: &'static str, path: &Path) -> Result<(), Error> {
    // A connection to a dead socket is refused. With any other result a process may listen there.
    // The socket does not block, because a full backlog would keep a blocking connect waiting.
    let probe = || rustix::net::connect(&socket()?, &SocketAddrUnix::new(path)?);
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
