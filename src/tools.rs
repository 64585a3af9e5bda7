//! The tools around the daemon: a simulated sensor, recording and replay, views of a running
//! daemon, calibration and diagnosis.

mod answer;
pub mod args;
mod arm;
pub mod calibrate;
pub mod check;
pub mod configuration;
pub mod connect;
pub mod control;
pub mod demo;
pub mod doctor;
pub mod exit;
mod faults;
#[cfg(feature = "zenoh")]
pub mod fleet;
pub mod identify;
pub mod live;
mod player;
pub(crate) mod pty;
pub mod record;
pub mod recover;
pub mod replay;
mod readable;
mod robot;
pub mod simulate;
pub mod sniff;
pub mod tail;
#[cfg(feature = "watch")]
pub mod watch;

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::process::ExitCode;

use clap::error::ErrorKind;

use crate::apart;
use hardnessd_core::recording::{self, PlaybackError};
use hardnessd_core::wording;
pub use hardnessd_core::wording::{line, lines};

/// The reason why a recording cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum Unreadable {
    /// The recording is damaged, or of another program.
    #[error(transparent)]
    Recording(#[from] recording::Error),
    /// The recording describes an impossible sensor.
    #[error(transparent)]
    Playback(#[from] PlaybackError),
}

impl Unreadable {
    /// Whether the system could not read the file, whatever the file holds.
    fn is_io(&self) -> bool {
        matches!(self, Self::Recording(recording::Error::Io(_)))
    }
}

impl From<std::io::Error> for Unreadable {
    fn from(error: std::io::Error) -> Self {
        Self::Recording(error.into())
    }
}

/// Prints clap's error on one line, or the help or the version if the command line asks for it. A
/// command line without a command gets the help too.
pub fn usage(error: &clap::Error) -> ExitCode {
    if error.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand {
        // If stderr has gone, nobody reads the help.
        let _ = error.print();
        return ExitCode::from(exit::USAGE);
    }
    if error.use_stderr() {
        hardnessd_core::stderr_line!("hardnessd: {}", wording::of_usage(&error.to_string()));
        return ExitCode::from(exit::USAGE);
    }
    match print(error.to_string().as_bytes()) {
        Ok(_) => ExitCode::SUCCESS,
        Err(failure) => {
            hardnessd_core::stderr_line!("hardnessd: stdout: {failure}");
            ExitCode::from(exit::IO)
        }
    }
}

/// Opens a file to read from. Refuses a directory at once, because the system would refuse it only
/// at the first read, after the work has begun. Refuses a serial port, because reading one waits
/// for bytes and never ends.
fn open(path: &Path) -> io::Result<File> {
    let file = File::open(path)?;
    if file.metadata()?.is_dir() {
        // In the system's words, as for a configuration that is a directory.
        return Err(rustix::io::Errno::ISDIR.into());
    }
    if rustix::termios::isatty(&file) {
        return Err(io::Error::other(
            "found a serial port or a terminal, expected a file (`hardnessd sniff --port` listens to a port)",
        ));
    }
    Ok(file)
}

/// Writes lines to stdout at once, and blocks until there is room for them. Do not call it on a
/// thread that has other work. Returns `Ok(false)` if nobody reads any more, which ends a tool
/// quietly.
///
/// # Errors
///
/// Fails if stdout cannot be written to for another reason.
pub fn print(lines: &[u8]) -> io::Result<bool> {
    let mut out = io::stdout().lock();
    match out.write_all(lines).and_then(|()| out.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        written => written.map(|()| true),
    }
}

/// Like [`print`], but on a thread of its own, because the reader of stdout may be slow.
async fn print_apart(lines: Vec<u8>) -> io::Result<bool> {
    let printed = apart::start("stdout", move || print(&lines))?;
    printed.await.map_err(io::Error::other)?
}

/// A path as the configuration may name it: relative, if it lies beside the configuration.
fn as_in(config: &Path, path: &Path) -> String {
    let absolute = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let (config, path) = (absolute(config), absolute(path));
    let beside = config
        .parent()
        .and_then(|directory| path.strip_prefix(directory).ok());
    beside.unwrap_or(&path).display().to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_directory_is_refused_in_the_system_s_words() {
        let directory = tempfile::tempdir().unwrap();
        let refused = open(directory.path()).unwrap_err();
        assert_eq!(line(&refused), "Is a directory");
    }
}
