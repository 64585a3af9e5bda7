//! Unix sockets: their files, from the first moment to the last.
//!
//! A socket's file appears with its mode, and answers from then on. A file that a dead daemon left
//! behind is replaced; one that answers is not. A file that is deleted is made again.

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
use tokio::net::{UnixListener, UnixStream};
use tokio::time::Instant;
use tracing::warn;

use super::accept::{Listener, Stop};

/// The longest path of a Unix socket: `sun_path` of unix(7), without its final NUL.
const LONGEST_PATH_BYTES: usize = 107;

/// How long another daemon may take to put its socket in its place.
const BIND_PATIENCE: Duration = Duration::from_secs(1);

/// How often a socket looks whether its file is still there.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// The file that a daemon locks while it binds, in the socket's directory.
const LOCK_FILE: &str = ".hardnessd.lock";

/// Why there is no socket.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A process listens there.
    #[error("{key}: found {path}, in use by another process, expected a free path")]
    InUse {
        /// The key of the configuration.
        key: &'static str,
        /// The path of the socket.
        path: PathBuf,
    },
    /// Another kind of file is there.
    #[error("{key}: found {path}, which is no socket, expected a socket or nothing there")]
    NoSocket {
        /// The key of the configuration.
        key: &'static str,
        /// The path of the file.
        path: PathBuf,
    },
    /// Neither its directory nor the directory above exists.
    #[error("{key}: found {path} in no directory, expected one, or one to make it in")]
    NoDirectory {
        /// The key of the configuration.
        key: &'static str,
        /// The path of the socket.
        path: PathBuf,
    },
    /// The system's limit.
    #[error("{key}: found {path}, {found} bytes, expected a path of at most {max}")]
    TooLong {
        /// The key of the configuration.
        key: &'static str,
        /// The path as given.
        path: PathBuf,
        /// Its length.
        found: usize,
        /// Largest.
        max: usize,
    },
    /// The system refused.
    #[error("{key}: {path}: cannot {what}: {source}")]
    Io {
        /// The key of the configuration.
        key: &'static str,
        /// The path of the socket.
        path: PathBuf,
        /// What was tried.
        what: &'static str,
        /// Why not.
        source: io::Error,
    },
}

/// The file of a socket, as the configuration says.
#[derive(Debug, Clone)]
struct Place {
    /// The key of the configuration.
    key: &'static str,
    path: PathBuf,
    mode: u32,
}

/// Device and inode of a file.
type Identity = (u64, u64);

/// A listening socket. Its file is removed with it.
///
/// A file that was deleted is made again: the socket looks for it every [`LOOK_EVERY`], and when an
/// order comes.
#[derive(Debug)]
pub(crate) struct Socket {
    listener: UnixListener,
    place: Place,
    /// Of the file. A file that another process put in its place is not ours to remove. `None`:
    /// the file belongs to the service manager.
    identity: Option<Identity>,
    orders: Option<Stop>,
    next_look: Instant,
    /// Whether the file is gone or another's, and that was logged.
    missed: bool,
}

impl Socket {
    /// Listens at `path`. The file has `mode` from its first moment. `key` is the key of the path in
    /// the configuration. The directory is made if it alone is missing.
    pub(crate) fn bind(key: &'static str, path: &Path, mode: u32) -> Result<Self, Error> {
        let path = path.to_owned();
        let place = Place { key, path, mode };
        let (listener, identity) = place.listen(BIND_PATIENCE)?;
        Ok(Self::new(listener, place, Some(identity)))
    }

    /// Takes the listener at `path` out of `passed`, if it is there. Its file, and the mode of that
    /// file, belong to the service manager.
    pub(crate) fn adopt(
        key: &'static str,
        path: &Path,
        passed: &mut Vec<StdListener>,
    ) -> Option<Result<Self, Error>> {
        // The same file may have several names: /run and /var/run.
        let there = path.canonicalize().ok()?;
        let is_there = |socket: &StdListener| {
            let address = socket.local_addr().ok();
            let found = address.as_ref().and_then(|address| address.as_pathname());
            found.is_some_and(|found| found.canonicalize().is_ok_and(|found| found == there))
        };
        let index = passed.iter().position(is_there)?;
        let listener = passed.swap_remove(index);
        let adopted = listener.set_nonblocking(true);
        let adopted = adopted.and_then(|()| UnixListener::from_std(listener));
        let path = path.to_owned();
        let place = Place { key, path, mode: 0 };
        Some(match adopted {
            Ok(listener) => Ok(Self::new(listener, place, None)),
            Err(source) => Err(place.failed("listen")(source)),
        })
    }

    fn new(listener: UnixListener, place: Place, identity: Option<Identity>) -> Self {
        Self {
            listener,
            place,
            identity,
            orders: None,
            next_look: Instant::now() + LOOK_EVERY,
            missed: false,
        }
    }

    /// Makes it look for its file at every order.
    pub(crate) fn obey(mut self, orders: Stop) -> Self {
        self.orders = Some(orders);
        self
    }

    /// The path of its file.
    pub(crate) fn path(&self) -> &Path {
        &self.place.path
    }

    /// Makes the file again if it is gone. If that fails, the reason is logged once.
    fn look(&mut self) {
        self.next_look = Instant::now() + LOOK_EVERY;
        let path = self.place.path.display();
        let found = identity(&self.place.path);
        let problem = match (found, self.identity) {
            (Ok(found), Some(ours)) if found == ours => None,
            (Ok(_), None) => None,
            (Ok(_), Some(_)) => Some("another file is in its place".to_owned()),
            (Err(error), Some(_)) if error.kind() == ErrorKind::NotFound => {
                // Without patience, because the sensors wait meanwhile.
                match self.place.listen(Duration::ZERO) {
                    Ok((listener, identity)) => {
                        self.listener = listener;
                        self.identity = Some(identity);
                        warn!(%path, "the socket's file was deleted: made it again");
                        None
                    }
                    Err(error) => Some(error.to_string()),
                }
            }
            (Err(error), Some(_)) => Some(error.to_string()),
            (Err(_), None) => Some("deleted: restart the socket unit".to_owned()),
        };
        if let Some(reason) = &problem
            && !self.missed
        {
            warn!(%path, reason, "the socket's file is not there: nobody can connect");
        }
        self.missed = problem.is_some();
    }
}

impl Listener for Socket {
    type Stream = UnixStream;

    async fn accept(&mut self) -> io::Result<UnixStream> {
        loop {
            tokio::select! {
                biased;
                // Connections that wait come first: a new listener would not have them.
                accepted = self.listener.accept() => return Ok(accepted?.0),
                () = ordered(&mut self.orders) => self.look(),
                () = tokio::time::sleep_until(self.next_look) => self.look(),
            }
        }
    }
}

/// Waits for the next order to look for the file; never ready after the last one.
async fn ordered(orders: &mut Option<Stop>) {
    if let Some(receiver) = orders
        && receiver.changed().await.is_ok()
    {
        return;
    }
    std::future::pending::<()>().await;
}

impl Drop for Socket {
    fn drop(&mut self) {
        if self.identity.is_some() && identity(&self.place.path).ok() == self.identity {
            let _ = fs::remove_file(&self.place.path);
        }
    }
}

fn identity(path: &Path) -> io::Result<Identity> {
    let file = fs::symlink_metadata(path)?;
    Ok((file.dev(), file.ino()))
}

impl Place {
    /// Listens here. If another daemon binds in the same directory at the moment, this waits for it,
    /// but not longer than `patience`.
    fn listen(&self, patience: Duration) -> Result<(UnixListener, Identity), Error> {
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

    fn failed(&self, what: &'static str) -> impl FnOnce(io::Error) -> Error {
        move |source| failed(self.key, &self.path, what, source)
    }
}

/// The right to bind a socket in a directory, which one daemon has at a time. It is a lock on a file
/// that exists only meanwhile and that no other user can open. Other users may open the directory
/// itself, so a lock on the directory would let each of them keep the daemon out.
struct Lock {
    path: PathBuf,
    /// Locked for as long as it is open.
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
        // The last holder removed this file meanwhile: a lock on it would keep nobody out.
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
        // This comes before the lock is released.
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
    // A connection to a dead socket is refused. With any other result a process may listen there. The
    // socket does not block, because a full backlog would keep a blocking connect waiting.
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

    #[tokio::test(start_paused = true)]
    async fn a_file_that_was_deleted_is_made_again_at_an_order_or_within_a_second() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("events.sock");
        let (order, orders) = tokio::sync::watch::channel(());
        let mut socket = Socket::bind("key", &path, 0o620).unwrap().obey(orders);
        let serving = tokio::spawn(async move { while socket.accept().await.is_ok() {} });
        let connects = || std::os::unix::net::UnixStream::connect(&path).is_ok();
        for ordered in [true, false] {
            let deleted = Instant::now();
            assert!(connects());
            fs::remove_file(&path).unwrap();
            if ordered {
                order.send(()).unwrap();
            }
            while !connects() {
                tokio::time::sleep(LOOK_EVERY / 20).await;
            }
            let most = if ordered { LOOK_EVERY / 20 } else { LOOK_EVERY };
            assert!(deleted.elapsed() <= most, "{:?}", deleted.elapsed());
            let made = fs::metadata(&path).unwrap();
            assert_eq!(made.permissions().mode() & 0o777, 0o620);
        }
        // The file of another process stays as it is.
        fs::remove_file(&path).unwrap();
        let _other = StdListener::bind(&path).unwrap();
        let other = identity(&path).unwrap();
        tokio::time::sleep(3 * LOOK_EVERY).await;
        assert_eq!(identity(&path).unwrap(), other);
        serving.abort();
        assert!(serving.await.unwrap_err().is_cancelled());
        assert_eq!(identity(&path).unwrap(), other);
    }

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
