//! Unix sockets and their files.
//!
//! A socket accepts connections only once its file has its mode. A file that a dead daemon left
//! behind is replaced. A file whose socket answers is not. A file that is deleted is made again.

mod place;

use std::fs;
use std::io::{self, ErrorKind};
use std::os::unix::net::UnixListener as StdListener;
use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::net::{UnixListener, UnixStream};
use tokio::time::Instant;
use tracing::warn;

pub(crate) use self::place::check;
use self::place::{Identity, LONGEST_PATH_BYTES, Place, identity};
use super::accept::{Listener, Stop};

/// How often a socket checks that its file is still there.
const LOOK_EVERY: Duration = Duration::from_secs(1);

/// The reason a socket could not be opened.
#[derive(Debug, thiserror::Error)]
#[error("{key}: {}", problem.at(path))]
pub struct Error {
    /// The key of the configuration.
    key: &'static str,
    /// The path of the socket, as configured.
    path: PathBuf,
    pub(super) problem: Problem,
}

impl Error {
    /// Makes the error of a problem with the socket at `path`. `key` is the key of the path.
    fn at(key: &'static str, path: &Path) -> impl FnOnce(Problem) -> Self {
        move |problem| Self {
            key,
            path: path.to_owned(),
            problem,
        }
    }
}

/// A problem with the path of a socket.
#[derive(Debug)]
pub(super) enum Problem {
    /// A process already listens at the path.
    InUse,
    /// The path has another kind of file.
    NoSocket,
    /// Neither the directory of the socket nor the directory above it exists.
    NoDirectory,
    /// The path is longer than the system allows.
    TooLong,
    /// The system refused a step.
    Io {
        what: &'static str,
        source: io::Error,
    },
}

impl Problem {
    /// The problem in words, with the path.
    fn at(&self, path: &Path) -> String {
        let (bytes, path) = (path.as_os_str().len(), path.display());
        match self {
            Self::InUse => format!(
                "{path} is in use by another process: end that process, or set another path"
            ),
            Self::NoSocket => format!("{path} is no socket: remove it, or set another path"),
            Self::NoDirectory => {
                format!("{path} is in no directory: make the directory, or set another path")
            }
            Self::TooLong => {
                format!(
                    "found {path}, {bytes} bytes, expected a path of at most {LONGEST_PATH_BYTES}"
                )
            }
            Self::Io { what, source } => {
                format!("{path}: cannot {what}: {source}{}", remedy(source))
            }
        }
    }
}

/// What to do about an error of the system.
fn remedy(source: &io::Error) -> &'static str {
    match source.kind() {
        io::ErrorKind::PermissionDenied => {
            ": set another path there, or XDG_RUNTIME_DIR to a directory of yours"
        }
        _ => "",
    }
}

/// A listening socket. When it is dropped, its file is removed.
///
/// A file that was deleted is made again: the socket looks for it every [`LOOK_EVERY`], and when an
/// order comes.
#[derive(Debug)]
pub(crate) struct Socket {
    listener: UnixListener,
    place: Place,
    /// The identity of the file. A file that another process put in its place is not ours to
    /// remove. `None`: the file belongs to the service manager.
    identity: Option<Identity>,
    orders: Option<Stop>,
    next_look: Instant,
    /// Whether the file is missing or belongs to another process, and this was logged.
    missed: bool,
}

impl Socket {
    /// Listens at `path`. The file has `mode` before anybody can connect. `key` is the key of the path
    /// in the configuration. If the directory is missing, it is made, but no directory above it.
    pub(crate) fn bind(key: &'static str, path: &Path, mode: u32) -> Result<Self, Error> {
        let path = path.to_owned();
        let place = Place { key, path, mode };
        let (listener, identity) = place.listen()?;
        Ok(Self::new(listener, place, Some(identity)))
    }

    /// Takes the listener at `path` out of `passed`, if it is there. The listener's file, and the
    /// mode of that file, belong to the service manager.
    pub(crate) fn adopt(
        key: &'static str,
        path: &Path,
        passed: &mut Vec<StdListener>,
    ) -> Option<Result<Self, Error>> {
        // The same file may have several names, as in /run and /var/run.
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
            Err(error) => Err(Error::at(key, &place.path)(place::failed("listen")(error))),
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

    /// Makes the socket check its file at every order.
    pub(crate) fn obey(mut self, orders: Stop) -> Self {
        self.orders = Some(orders);
        self
    }

    /// The path of the socket's file.
    pub(crate) fn path(&self) -> &Path {
        &self.place.path
    }

    /// Makes the file again if it is missing. If that fails, the reason is logged once.
    fn look(&mut self) {
        self.next_look = Instant::now() + LOOK_EVERY;
        let path = self.place.path.display();
        let found = identity(&self.place.path);
        let problem = match (found, self.identity) {
            (Ok(found), Some(ours)) if found == ours => None,
            (Ok(_), None) => None,
            (Ok(_), Some(_)) => Some("another file is in its place".to_owned()),
            (Err(error), Some(_)) if error.kind() == ErrorKind::NotFound => {
                match self.place.listen() {
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
                // Connections that wait come first, because a new listener would not have them.
                accepted = self.listener.accept() => return Ok(accepted?.0),
                () = ordered(&mut self.orders) => self.look(),
                () = tokio::time::sleep_until(self.next_look) => self.look(),
            }
        }
    }
}

/// Waits for the next order to check the file. After the last order, this waits forever.
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

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

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
}
