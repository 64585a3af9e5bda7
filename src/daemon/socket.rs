//! Unix sockets and their files.
//!
//! A socket accepts connections only once its file has its mode. A file that a dead daemon left
//! behind is replaced. A file whose socket answers is not.

use std::fs::{self, DirBuilder, Permissions};
use std::io::{self, ErrorKind};
use std::os::unix::fs::{DirBuilderExt, FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::UnixListener as StdListener;
use std::path::{Path, PathBuf};

use rustix::fd::OwnedFd;
use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType};
use rustix::process::Gid;
use tokio::net::{UnixListener, UnixStream};

use super::Error;
use super::accept::Listener;
use hardnessd_core::part::directory_of;

/// The longest path of a Unix socket: `sun_path` of unix(7), without its final NUL.
const LONGEST_PATH_BYTES: usize = 107;

/// The most connections that wait to be accepted, if the system allows as many.
const BACKLOG: i32 = 4096;

/// A listening socket. When it is dropped, its file is removed.
#[derive(Debug)]
pub(crate) struct Socket {
    listener: UnixListener,
    path: PathBuf,
    /// A file that another process put in the place of ours is not ours to remove.
    identity: Identity,
}

/// The device and the inode of a file.
type Identity = (u64, u64);

impl Socket {
    /// Listens at `path`. A socket at which nobody listens is replaced. The file has `mode` and `group`
    /// before anybody can connect. `key` is the key of the path in the configuration. If the directory is
    /// missing, it is made, but no directory above it.
    pub(crate) fn bind(
        key: &str,
        path: &Path,
        mode: u32,
        group: Option<Gid>,
    ) -> Result<Self, Error> {
        let failed = |what| move |error| failed(key, path, what, &error);
        if check(key, path)? {
            refuse_living(key, path)?;
            fs::remove_file(path).map_err(failed("replace it"))?;
        }
        let directory = directory_of(path);
        if !directory.is_dir() {
            match DirBuilder::new().mode(0o755).create(directory) {
                // Another process of this user began at the same moment.
                Err(error) if error.kind() == ErrorKind::AlreadyExists => {}
                made => made.map_err(failed("make its directory"))?,
            }
        }
        Ok(Self {
            listener: listen(path, mode, group)
                .and_then(UnixListener::from_std)
                .map_err(failed("listen"))?,
            path: path.to_owned(),
            identity: identity(path).map_err(failed("find"))?,
        })
    }
}

impl Listener for Socket {
    type Stream = UnixStream;

    async fn accept(&mut self) -> io::Result<UnixStream> {
        Ok(self.listener.accept().await?.0)
    }
}

impl Drop for Socket {
    fn drop(&mut self) {
        if identity(&self.path).ok() == Some(self.identity) {
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// Checks that a socket can be made at `path`, without making it. Returns whether there is one, alive or dead.
pub(crate) fn check(key: &str, path: &Path) -> Result<bool, Error> {
    let (bytes, shown) = (path.as_os_str().len(), path.display());
    if bytes > LONGEST_PATH_BYTES {
        return Err(Error::config(format!(
            "{key}: found {shown}, {bytes} bytes, expected a path of at most {LONGEST_PATH_BYTES}"
        )));
    }
    let directory = directory_of(path);
    if let Err(error) = fs::metadata(directory)
        && error.kind() == ErrorKind::PermissionDenied
    {
        return Err(failed(key, path, "find its directory", &error));
    }
    if !directory.is_dir() && (directory.exists() || !directory_of(directory).is_dir()) {
        return Err(Error::config(format!(
            "{key}: {shown} is in no directory: make the directory, or set another path"
        )));
    }
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(false),
        Err(error) => Err(failed(key, path, "look at it", &error)),
        Ok(file) if file.file_type().is_socket() => Ok(true),
        Ok(_) => Err(Error::config(format!(
            "{key}: {shown} is no socket: remove it, or set another path"
        ))),
    }
}

/// Fails if a process listens at `path`.
fn refuse_living(key: &str, path: &Path) -> Result<(), Error> {
    // A connection to a dead socket is refused. With any other result a process may listen there. The
    // socket does not block, because a full backlog would keep a blocking connect waiting.
    let probe = || rustix::net::connect(&socket()?, &SocketAddrUnix::new(path)?);
    match probe() {
        Err(Errno::CONNREFUSED | Errno::NOENT) => Ok(()),
        Err(error @ (Errno::ACCESS | Errno::PERM)) => {
            Err(failed(key, path, "try it", &error.into()))
        }
        _ => Err(Error::io(format!(
            "the daemon runs and serves {}: stop it (the package's with `sudo systemctl stop hardnessd`), or \
             give a second one another {key} or another XDG_RUNTIME_DIR",
            path.display()
        ))),
    }
}

/// The error of a step that the system refused.
fn failed(key: &str, path: &Path, what: &str, error: &io::Error) -> Error {
    let remedy = match error.kind() {
        ErrorKind::PermissionDenied => {
            ": set another path there, or XDG_RUNTIME_DIR to a directory of yours"
        }
        _ => "",
    };
    let path = path.display();
    Error::io(format!("{key}: {path}: cannot {what}: {error}{remedy}"))
}

/// Listens at a new socket of this mode and group. Its calls do not block.
fn listen(path: &Path, mode: u32, group: Option<Gid>) -> io::Result<StdListener> {
    let socket = socket()?;
    rustix::net::bind(&socket, &SocketAddrUnix::new(path)?)?;
    // Until the socket listens, connections are refused. So nobody comes in before the file has its
    // group and its mode.
    if group.is_some() {
        rustix::fs::chown(path, None, group)?;
    }
    fs::set_permissions(path, Permissions::from_mode(mode))?;
    rustix::net::listen(&socket, BACKLOG)?;
    Ok(StdListener::from(socket))
}

/// The group of this name or number. The system's other lists of groups, such as LDAP, are not read.
pub(crate) fn group(name: &str) -> Option<Gid> {
    let by_name = || {
        let groups = fs::read_to_string("/etc/group").ok()?;
        let fields = groups
            .lines()
            .map(|line| line.split(':').collect::<Vec<_>>());
        let named = fields.into_iter().find(|fields| fields[0] == name)?;
        named.get(2)?.parse().ok()
    };
    name.parse().ok().or_else(by_name).map(Gid::from_raw)
}

fn socket() -> rustix::io::Result<OwnedFd> {
    let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
    rustix::net::socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)
}

fn identity(path: &Path) -> io::Result<Identity> {
    let file = fs::symlink_metadata(path)?;
    Ok((file.dev(), file.ino()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_file_that_another_process_put_in_its_place_stays() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("events.sock");
        drop(Socket::bind("key", &path, 0o600, None).unwrap());
        assert!(!path.exists());
        let ours = Socket::bind("key", &path, 0o600, None).unwrap();
        fs::rename(&path, directory.path().join("moved")).unwrap();
        let _theirs = StdListener::bind(&path).unwrap();
        drop(ours);
        assert!(path.exists());
    }
}
