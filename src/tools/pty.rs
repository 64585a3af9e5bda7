//! A pseudo-terminal that behaves like a sensor's port: it never blocks, and unread bytes are
//! dropped.
//!
//! It keeps its own descriptor of the device side, so that the pair stays open while readers come
//! and go. Dropping the pair imitates an unplug: both sides are closed and the link is removed.

pub(crate) mod pair;

use std::fs;
use std::io::{self, ErrorKind};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::io::Errno;
use rustix::termios::{QueueSelector, Winsize};
use tokio::time::Instant;

use self::pair::Pair;
use crate::daemon::port::SIMULATED;

/// If bytes stay unread for this long, there is no reader. The bytes are dropped, and a lock that a
/// killed reader left is released: TIOCEXCL outlives the reader, because the pair stays open here.
const ABSENT: Duration = Duration::from_millis(500);

/// How long the last bytes may wait for a reader.
const LINGER: Duration = Duration::from_millis(500);

/// A pseudo-terminal, and the link to its device.
#[derive(Debug)]
pub(crate) struct Pty {
    pair: Pair,
    link: Option<PathBuf>,
    written: u64,
    /// The number of bytes that had been read when a reader last made progress, and the time of
    /// that.
    read: (u64, Instant),
}

impl Pty {
    /// Makes a pair, and `link` to its device.
    ///
    /// # Errors
    ///
    /// Fails if the system has no pair to give, or `link` is there and is not a killed simulation's.
    pub(crate) fn open(link: Option<&Path>) -> io::Result<Self> {
        let pair = Pair::raw()?;
        rustix::io::ioctl_fionbio(&pair.master, true)?;
        let (ws_xpixel, ws_ypixel) = SIMULATED;
        let mark = Winsize {
            ws_row: 0,
            ws_col: 0,
            ws_xpixel,
            ws_ypixel,
        };
        rustix::termios::tcsetwinsize(&pair.device, mark)?;
        if let Some(link) = link {
            place(&pair.path, link)?;
        }
        Ok(Self {
            pair,
            link: link.map(Path::to_owned),
            written: 0,
            read: (0, Instant::now()),
        })
    }

    /// Path of the device that a reader opens.
    pub(crate) fn path(&self) -> &Path {
        &self.pair.path
    }

    /// Writes as much as there is room for, and returns how many bytes that is. On a line without a
    /// reader the rest is lost.
    ///
    /// # Errors
    ///
    /// Fails if the system reports an error other than a full buffer.
    pub(crate) fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.forget_unread()?;
        match rustix::io::write(&self.pair.master, bytes) {
            Ok(written) => {
                self.written += written as u64;
                Ok(written)
            }
            Err(Errno::AGAIN) => Ok(0),
            Err(error) => Err(error.into()),
        }
    }

    fn forget_unread(&mut self) -> io::Result<()> {
        let unread = rustix::io::ioctl_fionread(&self.pair.device)?;
        let read = self.written.saturating_sub(unread);
        if read > self.read.0 || unread == 0 {
            self.read = (read, Instant::now());
        } else if self.read.1.elapsed() > ABSENT {
            rustix::termios::tcflush(&self.pair.device, QueueSelector::IFlush)?;
            rustix::termios::ioctl_tiocnxcl(&self.pair.device)?;
            self.read = (self.written, Instant::now());
        }
        Ok(())
    }

    /// Waits until the last bytes are read, up to a limit.
    pub(crate) async fn linger(&self) -> io::Result<()> {
        let end = Instant::now() + LINGER;
        // Written bytes reach the device a moment later, so one look at an empty device is not
        // enough.
        let mut empty = 0;
        while empty < 10 && Instant::now() < end {
            tokio::time::sleep(Duration::from_millis(5)).await;
            let is_empty = rustix::io::ioctl_fionread(&self.pair.device)? == 0;
            empty = if is_empty { empty + 1 } else { 0 };
        }
        Ok(())
    }
}

impl Drop for Pty {
    fn drop(&mut self) {
        // Another process may have put its own link there meanwhile.
        if let Some(link) = &self.link
            && fs::read_link(link).is_ok_and(|target| target == self.pair.path)
        {
            let _ = fs::remove_file(link);
        }
    }
}

/// Makes `link` point to `device`. It replaces only what a killed simulation left: a link to a
/// pseudo-terminal that is gone.
fn place(device: &Path, link: &Path) -> io::Result<()> {
    let was_pty = fs::read_link(link).is_ok_and(|target| target.starts_with("/dev/pts"));
    if was_pty && !link.exists() {
        fs::remove_file(link)?;
    }
    symlink(device, link).map_err(|error| match error.kind() {
        ErrorKind::AlreadyExists => io::Error::other(
            "a file or a link is there, perhaps that of another `hardnessd simulate`: remove it, or name \
             another path",
        ),
        _ => error,
    })
}
