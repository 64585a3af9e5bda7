//! The line from a simulated sensor to the daemon: a pty behind a link, which is the port of the
//! configuration.

use std::fs;
use std::io;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

use crate::pair::Pair;

pub(crate) struct Line {
    pair: Pair,
    pub(crate) port: PathBuf,
}

fn open(port: &Path) -> io::Result<Pair> {
    let pair = Pair::raw()?;
    symlink(&pair.path, port)?;
    Ok(pair)
}

impl Line {
    pub(crate) fn new(port: PathBuf) -> io::Result<Self> {
        let pair = open(&port)?;
        Ok(Self { pair, port })
    }

    pub(crate) fn write(&mut self, mut bytes: &[u8]) -> io::Result<()> {
        while !bytes.is_empty() {
            // Until the other end is opened, there is room for 4 kB.
            bytes = &bytes[rustix::io::write(&self.pair.master, bytes)?..];
        }
        Ok(())
    }

    /// Whether the daemon has read all that was written.
    pub(crate) fn is_read(&self) -> io::Result<bool> {
        Ok(rustix::io::ioctl_fionread(&self.pair.device)? == 0)
    }

    /// Pulls the cable.
    pub(crate) fn unplug(&mut self) -> io::Result<()> {
        fs::remove_file(&self.port)?;
        // Open the new pty before the old one is closed, so that its name is a different one.
        self.pair = open(&self.port.with_extension("next"))?;
        Ok(())
    }

    /// Plugs the cable in again.
    pub(crate) fn plug(&mut self) -> io::Result<()> {
        fs::rename(self.port.with_extension("next"), &self.port)
    }
}
