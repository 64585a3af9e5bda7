//! A pseudo-terminal as the system gives it, for the simulator's port. The tests include this file
//! for their terminals.

use std::ffi::OsStr;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStrExt;
use std::path::PathBuf;

use rustix::fs::{Mode, OFlags};
use rustix::pty::OpenptFlags;
use rustix::termios::OptionalActions;

/// Both sides of a pseudo-terminal, and the path of the device.
#[derive(Debug)]
pub(crate) struct Pair {
    pub(crate) master: OwnedFd,
    pub(crate) device: OwnedFd,
    pub(crate) path: PathBuf,
}

impl Pair {
    /// Makes a new pair with the settings of a fresh terminal. No child process inherits it.
    ///
    /// # Errors
    ///
    /// Fails if the system has no pair to give.
    pub(crate) fn open() -> io::Result<Self> {
        let flags = OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC;
        let master = rustix::pty::openpt(flags)?;
        rustix::pty::grantpt(&master)?;
        rustix::pty::unlockpt(&master)?;
        let name = rustix::pty::ptsname(&master, Vec::new())?;
        let path = PathBuf::from(OsStr::from_bytes(name.as_bytes()));
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC;
        let device = rustix::fs::open(&path, flags, Mode::empty())?;
        Ok(Self {
            master,
            device,
            path,
        })
    }

    /// The same, but the device neither echoes nor edits lines, as a sensor's port.
    ///
    /// # Errors
    ///
    /// Fails if the system has no pair to give.
    pub(crate) fn raw() -> io::Result<Self> {
        let pair = Self::open()?;
        let mut settings = rustix::termios::tcgetattr(&pair.device)?;
        settings.make_raw();
        rustix::termios::tcsetattr(&pair.device, OptionalActions::Now, &settings)?;
        Ok(pair)
    }
}
