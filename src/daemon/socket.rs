//! The Unix socket: events out, requests in, nothing changed.
//!
//! The file appears with its mode and already answering; one left by a dead daemon is replaced,
//! one that answers is not. Each connection is a task that fetches lines from the hub and writes
//! them, and reads requests between.

use std::fs::{self, DirBuilder, File, Permissions};
use std::io::{ErrorKind, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{DirBuilderExt, FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::UnixListener as StdListener;
use std::path::{Path, PathBuf};
use std::time::Duration;

use bytes::{Buf, BytesMut};
use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType};
use tokio::io::{AsyncReadExt, AsyncWriteExt, Interest};
use tokio::net::unix::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{UnixListener, UnixStream};
use tokio::sync::oneshot;
use tokio::sync::oneshot::error::TryRecvError;
use tokio::task::JoinSet;
use tracing::{debug, warn};

use super::hub::{self, Closed, Line};
use super::request::{self, Request};
use super::sensor::Sensors;
use crate::event::{Event, Reply};

/// Longest line a subscriber may send (contract, section 5).
const LONGEST_LINE_BYTES: usize = 64 * 1024;

/// Longest path of a Unix socket: `sun_path` of unix(7), without its final NUL.
const LONGEST_PATH_BYTES: usize = 107;

/// How long a socket may take to be put in its place by another daemon.
const BIND_PATIENCE: Duration = Duration::from_secs(1);

/// How often a connection whose other end has stopped sending is looked after.
const HALF_CLOSED_CHECK: Duration = Duration::from_secs(1);

/// Pause after the system had no room for a connection.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

/// Why there is no socket.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Somebody answers there.
    #[error("{path}: found a socket in use by another process, expected a free path")]
    InUse {
        /// Of the socket.
        path: PathBuf,
    },
    /// Something else stands there.
    #[error("{path}: found a file that is no socket, expected a socket or nothing")]
    NoSocket {
        /// Of the file.
        path: PathBuf,
    },
    /// The system's limit.
    #[error("{path}: found {found} bytes, expected a socket path of at most {max}")]
    TooLong {
        /// As given.
        path: PathBuf,
        /// Its length.
        found: usize,
        /// Largest.
        max: usize,
    },
    /// The system refused.
    #[error("{path}: cannot {what}: {source}")]
    Io {
        /// Concerned.
        path: PathBuf,
        /// What was tried.
        what: &'static str,
        /// Why not.
        source: std::io::Error,
    },
}

/// A listening socket; its file goes with it.
#[derive(Debug)]
pub(crate) struct Socket {
    listener: UnixListener,
    path: PathBuf,
    /// Device and inode: a file that another put in its place is not ours to remove.
    identity: (u64, u64),
}

impl Socket {
    /// Listens at `path`, whose file has `mode` from its first moment. The directory is made if it
    /// alone is missing.
    pub(crate) fn bind(path: &Path, mode: u32) -> Result<Self, Error> {
        let failed = |what| {
            move |source| Error::Io {
                path: path.to_owned(),
                what,
                source,
            }
        };
        let found = path.as_os_str().len();
        if found > LONGEST_PATH_BYTES {
            return Err(Error::TooLong {
                path: path.to_owned(),
                found,
                max: LONGEST_PATH_BYTES,
            });
        }
        let parent = match path.parent() {
            Some(parent) if parent != Path::new("") => parent,
            _ => Path::new("."),
        };
        match DirBuilder::new().mode(0o755).create(parent) {
            Err(error) if error.kind() != ErrorKind::AlreadyExists => {
                return Err(failed("make its directory")(error));
            }
            _ => {}
        }
        // Two daemons that start at once must not both find the path free.
        let directory = File::open(parent).map_err(failed("open its directory"))?;
        lock(&directory).map_err(failed("lock its directory"))?;
        vacant(path)?;

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
            identity: (file.dev(), file.ino()),
        })
    }

    /// Accepts subscribers, at most `max_clients` at a time. Once `stop` comes there are no new
    /// ones and the file is gone; it ends when those there have their last lines.
    pub(crate) async fn serve(
        self,
        max_clients: usize,
        hub: hub::Handle,
        sensors: Sensors,
        mut stop: oneshot::Receiver<()>,
    ) {
        let mut clients = JoinSet::new();
        let mut refusing = false;
        loop {
            let accepted = tokio::select! {
                // Those that have gone make room before the next is looked at.
                biased;
                _ = &mut stop => break,
                Some(_) = clients.join_next() => continue,
                accepted = self.listener.accept() => accepted,
            };
            match accepted {
                Ok((stream, _)) if clients.len() >= max_clients => refuse(stream, max_clients),
                Ok((stream, _)) => {
                    refusing = false;
                    let (hub, sensors) = (hub.clone(), sensors.clone());
                    clients.spawn(async move {
                        if let Err(end) = Client::new(stream, hub).serve(&sensors).await {
                            debug!(%end, "subscriber gone");
                        }
                    });
                }
                // Out of descriptors or memory: later, perhaps. Said once.
                Err(error) => {
                    if !refusing {
                        warn!(%error, "subscribers cannot be accepted");
                    }
                    refusing = true;
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
        drop(self);
        while clients.join_next().await.is_some() {}
    }
}

impl Drop for Socket {
    fn drop(&mut self) {
        let ours = fs::symlink_metadata(&self.path)
            .is_ok_and(|file| (file.dev(), file.ino()) == self.identity);
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

/// Makes sure that nothing alive stands at `path`.
fn vacant(path: &Path) -> Result<(), Error> {
    let failed = |what, source| {
        Err(Error::Io {
            path: path.to_owned(),
            what,
            source,
        })
    };
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        Err(error) => return failed("look at", error),
        Ok(file) if !file.file_type().is_socket() => {
            return Err(Error::NoSocket {
                path: path.to_owned(),
            });
        }
        Ok(_) => {}
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
        Err(error @ (Errno::ACCESS | Errno::PERM)) => failed("try", error.into()),
        _ => Err(Error::InUse {
            path: path.to_owned(),
        }),
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

/// One too many: told so if there is room to tell, and closed.
fn refuse(stream: UnixStream, max_clients: usize) {
    let message = format!("found {max_clients} subscribers already, expected fewer: try later");
    let line = Reply::Error { message, id: None }.to_line();
    // Asked of the system itself: the runtime does not know yet that the stream is writable.
    let _ = stream
        .into_std()
        .and_then(|mut stream| stream.write_all(line.as_bytes()));
}

/// Why a connection ended.
#[derive(Debug, thiserror::Error)]
enum End {
    #[error(transparent)]
    Closed(#[from] Closed),
    #[error("{0}")]
    Io(#[from] std::io::Error),
    #[error("hung up")]
    HungUp,
    #[error("a line over {LONGEST_LINE_BYTES} bytes")]
    TooLong,
}

/// One connection.
struct Client {
    input: OwnedReadHalf,
    output: OwnedWriteHalf,
    /// What came after the last whole line.
    unread: BytesMut,
    /// What is being written: a batch goes out in one call.
    outgoing: Vec<u8>,
    hub: hub::Handle,
}

/// What a subscriber did.
enum Heard {
    Line(BytesMut),
    TooLong,
    /// It sends no more; it may still read.
    End,
}

impl Client {
    fn new(stream: UnixStream, hub: hub::Handle) -> Self {
        let (input, output) = stream.into_split();
        Self {
            input,
            output,
            unread: BytesMut::new(),
            outgoing: Vec::new(),
            hub,
        }
    }

    async fn serve(mut self, sensors: &Sensors) -> Result<(), End> {
        let (id, hello) = self.hub.join().await?;
        let served = self.converse(id, hello, sensors).await;
        self.hub.leave(id).await;
        served
    }

    async fn converse(&mut self, id: u64, hello: Line, sensors: &Sensors) -> Result<(), End> {
        let mut lines = vec![hello];
        lines.extend(statuses(sensors).await);
        self.send(&lines).await?;
        let mut next = self.hub.take(id).await?;
        let mut hearing = true;
        loop {
            tokio::select! {
                biased;
                lines = &mut next => {
                    // Closed: all has been sent.
                    let Ok(lines) = lines else { return Ok(()) };
                    self.send(&lines).await?;
                    next = self.hub.take(id).await?;
                }
                heard = hear(&mut self.input, &mut self.unread), if hearing => match heard? {
                    Heard::Line(line) => {
                        let answer = self.answer(id, &line, sensors).await?;
                        // What the hub gave before it answered belongs before the answer.
                        let ended = match next.try_recv() {
                            Ok(lines) => {
                                self.send(&lines).await?;
                                next = self.hub.take(id).await?;
                                false
                            }
                            Err(waiting) => waiting == TryRecvError::Closed,
                        };
                        self.send(&answer).await?;
                        if ended {
                            return Ok(());
                        }
                    }
                    Heard::TooLong => {
                        let message = format!(
                            "found a line over {LONGEST_LINE_BYTES} bytes, expected a shorter one"
                        );
                        self.send(&[error(message, None)]).await?;
                        return Err(End::TooLong);
                    }
                    Heard::End => {
                        hearing = false;
                        self.stay().await?;
                    }
                },
                () = tokio::time::sleep(HALF_CLOSED_CHECK), if !hearing => self.stay().await?,
            }
        }
    }

    /// Goes on only if the other end still reads.
    async fn stay(&self) -> Result<(), End> {
        let ready = self.output.as_ref().ready(Interest::WRITABLE).await?;
        if ready.is_write_closed() {
            Err(End::HungUp)
        } else {
            Ok(())
        }
    }

    async fn answer(&self, id: u64, line: &[u8], sensors: &Sensors) -> Result<Vec<Line>, End> {
        let line = request::parse(line);
        let mut answer = match line.request {
            Ok(Request::Subscribe(subscription)) => {
                match self.hub.subscribe(id, subscription).await? {
                    Ok(()) => Vec::new(),
                    Err(message) => return Ok(vec![error(message, line.id)]),
                }
            }
            Ok(Request::Status) => statuses(sensors).await,
            Ok(Request::Last) => self.hub.finals().await?,
            Err(message) => return Ok(vec![error(message, line.id)]),
        };
        answer.push(Reply::Ok { id: line.id, tare: None }.to_line().into());
        Ok(answer)
    }

    async fn send(&mut self, lines: &[Line]) -> Result<(), End> {
        self.outgoing.clear();
        for line in lines {
            self.outgoing.extend_from_slice(line.as_bytes());
        }
        Ok(self.output.write_all(&self.outgoing).await?)
    }
}

async fn statuses(sensors: &Sensors) -> Vec<Line> {
    let statuses = sensors.statuses().await;
    statuses
        .into_iter()
        .map(|status| Event::Status(status).to_line().into())
        .collect()
}

fn error(message: String, id: Option<serde_json::Value>) -> Line {
    Reply::Error { message, id }.to_line().into()
}

/// Waits for a whole line. Nothing is lost if the wait is given up.
async fn hear(input: &mut OwnedReadHalf, unread: &mut BytesMut) -> std::io::Result<Heard> {
    let mut searched = 0;
    loop {
        if let Some(length) = unread[searched..].iter().position(|&byte| byte == b'\n') {
            let length = searched + length;
            if length > LONGEST_LINE_BYTES {
                return Ok(Heard::TooLong);
            }
            let line = unread.split_to(length);
            unread.advance(1);
            return Ok(Heard::Line(line));
        }
        searched = unread.len();
        if searched > LONGEST_LINE_BYTES {
            return Ok(Heard::TooLong);
        }
        if input.read_buf(unread).await? == 0 {
            return Ok(Heard::End);
        }
    }
}
