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

use super::{Error, Problem};
use hardnessd_core::part::directory_of;

/// The longest path of a Unix socket: `sun_path` of unix(7), without its final NUL.
pub(super) const LONGEST_PATH_BYTES: usize = 107;

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
        self.made().map_err(Error::at(self.key, &self.path))
    }

    fn made(&self) -> Result<(UnixListener, Identity), Problem> {
        let Self { path, mode, .. } = self;
        examine(path)?;
        match DirBuilder::new().mode(0o755).create(directory_of(path)) {
            Err(error) if error.kind() != ErrorKind::AlreadyExists => {
                return Err(failed("make its directory")(error));
            }
            _ => {}
        }
        if is_there(path)? {
            vacant(path)?;
            fs::remove_file(path).map_err(failed("replace it"))?;
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
        let listener = listening().map_err(failed("listen"))?;
        let identity = identity(path).map_err(failed("find"))?;
        Ok((listener, identity))
    }
}

/// Makes the problem of a step that the system refused.
pub(super) fn failed(what: &'static str) -> impl FnOnce(io::Error) -> Problem {
    move |source| Problem::Io { what, source }
}

/// Checks that a socket can be made at `path`, without making it.
pub(crate) fn check(key: &'static str, path: &Path) -> Result<(), Error> {
    examine(path).map_err(Error::at(key, path))
}

fn examine(path: &Path) -> Result<(), Problem> {
    if path.as_os_str().len() > LONGEST_PATH_BYTES {
        return Err(Problem::TooLong);
    }
    let parent = directory_of(path);
    let has_directory = match fs::metadata(parent) {
        Err(error) if error.kind() == ErrorKind::NotFound => directory_of(parent).is_dir(),
        Err(error) if error.kind() == ErrorKind::NotADirectory => false,
        Err(error) => return Err(failed("find its directory")(error)),
        Ok(parent) => parent.is_dir(),
    };
    if !has_directory {
        return Err(Problem::NoDirectory);
    }
    is_there(path).map(drop)
}

/// Whether there is a socket at `path`, alive or dead. Any other file there is an error.
fn is_there(path: &Path) -> Result<bool, Problem> {
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(false),
        Err(error) => Err(failed("look at it")(error)),
        Ok(file) if file.file_type().is_socket() => Ok(true),
        Ok(_) => Err(Problem::NoSocket),
    }
}

fn socket() -> rustix::io::Result<OwnedFd> {
    let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
    rustix::net::socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)
}

/// Fails if a process listens at `path`.
fn vacant(path: &Path) -> Result<(), Problem> {
    // A connection to a dead socket is refused. With any other result a process may listen there.
    // The socket does not block, because a full backlog would keep a blocking connect waiting.
    let probe = || rustix::net::connect(&socket()?, &SocketAddrUnix::new(path)?);
    match probe() {
        Err(Errno::CONNREFUSED | Errno::NOENT) => Ok(()),
        Err(error @ (Errno::ACCESS | Errno::PERM)) => Err(failed("try it")(error.into())),
        _ => Err(Problem::InUse),
    }
}
