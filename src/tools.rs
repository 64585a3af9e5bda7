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
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::error::ErrorKind;

use crate::apart;
use hardnessd_core::exit::{Coded, FAILED, IO, NO_INPUT};
use hardnessd_core::recording::{self, PlaybackError};
use hardnessd_core::wording;
pub use hardnessd_core::wording::{line, lines};

/// The error of a file of the command line that cannot be read.
#[derive(Debug, thiserror::Error)]
#[error("{path}: cannot read: {source}")]
pub struct CannotRead {
    path: PathBuf,
    source: io::Error,
}

impl CannotRead {
    /// Makes the error of the file at `path`.
    fn at(path: &Path) -> impl Fn(io::Error) -> Self {
        move |source| Self {
            path: path.to_owned(),
            source,
        }
    }
}

impl Coded for CannotRead {
    fn exit_code(&self) -> u8 {
        NO_INPUT
    }
}

/// A recording cannot be played to its end.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {source}")]
pub struct Unplayable {
    /// The path of the recording, or words for one that has none.
    path: PathBuf,
    source: Unreadable,
}

impl Unplayable {
    /// Makes the error of the recording at `path`.
    fn at<E: Into<Unreadable>>(path: &Path) -> impl Fn(E) -> Self {
        move |source| Self {
            path: path.to_owned(),
            source: source.into(),
        }
    }
}

impl Coded for Unplayable {
    fn exit_code(&self) -> u8 {
        match self.source {
            // The system could not read the file, whatever the file holds.
            Unreadable::Recording(recording::Error::Io(_)) => IO,
            _ => FAILED,
        }
    }
}

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

impl From<io::Error> for Unreadable {
    fn from(error: io::Error) -> Self {
        Self::Recording(error.into())
    }
}

/// Stdout cannot be written to.
#[derive(Debug, thiserror::Error)]
#[error("stdout: {0}")]
pub struct Stdout(#[source] io::Error);

impl Coded for Stdout {
    fn exit_code(&self) -> u8 {
        IO
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
            hardnessd_core::stderr_line!("hardnessd: {failure}");
            ExitCode::from(IO)
        }
    }
}

/// Opens a file to read from. Refuses a directory at once, because the system would refuse it only
/// at the first read, after the work has begun. Refuses a serial port, because reading one waits
/// for bytes and never ends.
fn open(path: &Path) -> Result<File, CannotRead> {
    let open = || -> io::Result<File> {
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
    };
    open().map_err(CannotRead::at(path))
}

/// Writes lines to stdout at once, and blocks until there is room for them. Do not call it on a
/// thread that has other work. Returns `Ok(false)` if nobody reads any more, which ends a tool
/// quietly.
///
/// # Errors
///
/// Fails if stdout cannot be written to for another reason.
pub fn print(lines: &[u8]) -> Result<bool, Stdout> {
    let mut out = io::stdout().lock();
    match out.write_all(lines).and_then(|()| out.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        written => written.map(|()| true).map_err(Stdout),
    }
}

/// Like [`print`], but on a thread of its own, because the reader of stdout may be slow.
async fn print_apart(lines: Vec<u8>) -> Result<bool, Stdout> {
    let printed = apart::start("stdout", move || print(&lines));
    let printed = printed.map_err(|error| Stdout(error.into()))?.await;
    printed.map_err(|ended| Stdout(io::Error::other(ended)))?
}

/// An absolute path, or the path as it is if the system does not know the current directory.
fn absolute(path: &Path) -> PathBuf {
    std::path::absolute(path).unwrap_or_else(|_| path.to_owned())
}

/// A path as the configuration may name it: relative, if it lies beside the configuration.
fn as_in(config: &Path, path: &Path) -> String {
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
        assert_eq!(line(&refused.source), "Is a directory");
    }
}
