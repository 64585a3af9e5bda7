//! The tools around the daemon: a simulated sensor, recording and replay, views of a running
//! daemon, calibration and diagnosis.

mod answer;
pub mod args;
pub mod calibrate;
pub mod check;
pub mod configuration;
pub mod connect;
pub mod control;
pub mod demo;
pub mod doctor;
pub mod exit;
mod faults;
pub mod identify;
pub mod live;
mod played;
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
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::error::{ContextKind, ContextValue, ErrorKind};

use self::exit::{FAILED, Fail, Failure, IO, NO_INPUT};
use crate::thread;
use hardnessd_core::recording;
use hardnessd_core::wording;

/// The failure of a recording that cannot be played to its end. If the system could not read the file,
/// the exit code does not depend on what the file holds.
fn unplayable<E: Into<anyhow::Error>>(path: &Path) -> impl Fn(E) -> Failure + '_ {
    move |error| {
        let error = error.into();
        let is_io = error.is::<io::Error>()
            || matches!(error.downcast_ref(), Some(recording::Error::Io(_)));
        Failure::of(if is_io { IO } else { FAILED }, path.display(), error)
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
        let line = wording::of_usage(&error.to_string());
        let given = match (error.kind(), error.get(ContextKind::InvalidArg)) {
            (ErrorKind::UnknownArgument, Some(ContextValue::String(given))) => given,
            _ => "",
        };
        // A configuration is never named without its option.
        let is_configuration = given.ends_with(".toml") && !given.starts_with('-');
        let tip = match is_configuration {
            true => format!("; tip: --config {}", wording::escaped(given)),
            false => String::new(),
        };
        hardnessd_core::stderr_line!("hardnessd: {line}{tip}");
        return ExitCode::from(exit::USAGE);
    }
    match print(error.to_string().as_bytes()) {
        Ok(_) => ExitCode::SUCCESS,
        Err(failure) => {
            hardnessd_core::stderr_line!("hardnessd: {}", failure.line());
            ExitCode::from(failure.code)
        }
    }
}

/// Opens a file to read from. Refuses a directory at once, because the system would refuse it only
/// at the first read, after the work has begun. Refuses a serial port, because reading one waits
/// for bytes and never ends.
fn open_file(path: &Path) -> io::Result<File> {
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

/// Like [`open_file`], for a file of the command line.
fn open(path: &Path) -> Result<File, Failure> {
    open_file(path).map_err(cannot_read(path))
}

/// The failure of a file of the command line that cannot be read.
fn cannot_read(path: &Path) -> impl Fn(io::Error) -> Failure + '_ {
    move |error| Failure::of(NO_INPUT, format!("{}: cannot read", path.display()), error)
}

/// The text of a file of the command line.
///
/// # Errors
///
/// Fails if the file cannot be read, or has more than `most` bytes.
fn read_text(path: &Path, most: u64) -> Result<String, Failure> {
    let mut text = String::new();
    let read = open(path)?.take(most + 1).read_to_string(&mut text);
    match read.map_err(cannot_read(path))? as u64 > most {
        true => Err(Failure::new(
            FAILED,
            format!("{}: found more than {most} bytes", path.display()),
        )),
        false => Ok(text),
    }
}

/// Writes lines to stdout at once, and blocks until there is room for them. Do not call it on a
/// thread that has other work. Returns `Ok(false)` if nobody reads any more, which ends a tool
/// quietly.
///
/// # Errors
///
/// Fails if stdout cannot be written to for another reason.
pub fn print(lines: &[u8]) -> Result<bool, Failure> {
    let mut out = io::stdout().lock();
    match out.write_all(lines).and_then(|()| out.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        written => written.map(|()| true).of("stdout", IO),
    }
}

/// Like [`print()`], but on a thread of its own, because the reader of stdout may be slow.
///
/// # Errors
///
/// Fails as [`print()`] does, or if the system has no thread to spare.
pub async fn print_apart(text: String) -> Result<bool, Failure> {
    thread::run("stdout", move || print(text.as_bytes())).await?
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
