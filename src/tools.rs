//! The tools around the daemon: a simulated sensor, recording and replay, views of a running
//! daemon, calibration and diagnosis.

pub mod args;
pub mod calibrate;
pub mod check;
pub mod configuration;
pub mod connect;
pub mod demo;
pub mod doctor;
pub mod exit;
mod faults;
#[cfg(feature = "zenoh")]
pub mod fleet;
mod player;
mod pty;
pub mod record;
pub mod recover;
pub mod replay;
mod robot;
pub mod simulate;
pub mod sniff;
pub mod tail;
#[cfg(feature = "watch")]
pub mod watch;

use std::error::Error;
use std::fs::File;
use std::io::{self, Write};
use std::path::Path;
use std::process::ExitCode;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use tokio::time::Instant;

use crate::wording;

/// The text of an error on one line, with every cause that the text does not contain already.
pub fn line(error: &(dyn Error + 'static)) -> String {
    let mut line = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let text = error.to_string();
        if !line.contains(&text) {
            line = format!("{line}: {text}");
        }
        cause = error.source();
    }
    wording::escaped(&without_numbers(&line))
}

/// Removes the numbers of the system's errors, such as ` (os error 2)`: the system's words are
/// there already.
fn without_numbers(text: &str) -> String {
    let mut parts = text.split(" (os error ");
    let mut told = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        match part.split_once(')') {
            Some((number, rest)) if number.bytes().all(|digit| digit.is_ascii_digit()) => {
                told += rest;
            }
            _ => told = told + " (os error " + part,
        }
    }
    told
}

/// Escapes the hidden characters of each line. Without this, the name of a file could control the
/// terminal.
pub fn lines(text: &str) -> String {
    let lines: Vec<String> = text.split('\n').map(wording::escaped).collect();
    lines.join("\n")
}

/// Prints clap's error on one line, and returns exit code 2. Prints the help or the version instead
/// if the command line asks for it.
pub fn usage(program: &str, error: &clap::Error) -> ExitCode {
    if matches!(
        error.kind(),
        ErrorKind::DisplayHelp
            | ErrorKind::DisplayVersion
            | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand
    ) {
        return match error.print() {
            Err(failure) if !error.use_stderr() && failure.kind() != io::ErrorKind::BrokenPipe => {
                crate::say!("{program}: stdout: {failure}");
                ExitCode::from(exit::IO)
            }
            _ => ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(exit::USAGE)),
        };
    }
    let text = error.to_string();
    let told = text.split("\n\nUsage:").next().unwrap_or_default();
    let told = told.split("\n\nFor more").next().unwrap_or_default();
    // clap also proposes names that have little in common with the name given, such as `calibrate`
    // for `frobnicate`. The help has them all.
    let told = match error.kind() {
        ErrorKind::InvalidSubcommand => told.split("\n\n").next().unwrap_or_default(),
        _ => told,
    };
    let told: Vec<&str> = told.split_whitespace().collect();
    let mut told = told
        .join(" ")
        .trim_start_matches("error: ")
        .replace(" tip: ", ": ");
    if error.kind() == ErrorKind::ValueValidation
        && let Some((value, reason)) = told.split_once("': ")
    {
        told = format!("{value}': {}", wording::of_argument(reason));
    }
    if let Some(file) = configuration_in_place_of_an_option(error) {
        told += &format!(": write --config {file}");
    } else if is_fleet_without_zenoh(error) {
        told = "fleet: this build has no zenoh: build it with --features zenoh".to_owned();
    } else if let Some(command) = where_to_look(error, &text) {
        told += &format!(": see `{command} --help`");
    }
    crate::say!("{program}: {}", wording::escaped(&told));
    ExitCode::from(exit::USAGE)
}

/// Whether the command line has `fleet`, which only a build with zenoh has.
fn is_fleet_without_zenoh(error: &clap::Error) -> bool {
    let unknown = error.get(ContextKind::InvalidSubcommand);
    !cfg!(feature = "zenoh")
        && matches!(unknown, Some(ContextValue::String(command)) if command == "fleet")
}

/// The command whose help lists what is missing or unknown.
fn where_to_look(error: &clap::Error, text: &str) -> Option<String> {
    let is_of_help = matches!(
        error.kind(),
        ErrorKind::MissingRequiredArgument
            | ErrorKind::InvalidSubcommand
            | ErrorKind::UnknownArgument
    );
    let (_, usage) = text.split_once("\n\nUsage: ").filter(|_| is_of_help)?;
    let words = usage.split_whitespace();
    let command: Vec<&str> = words
        .take_while(|word| word.starts_with(|c: char| c.is_ascii_lowercase()))
        .collect();
    Some(command.join(" "))
}

/// The configuration in a command line such as `hardnessd run hardnessd.toml`, which lacks the
/// option `--config`.
fn configuration_in_place_of_an_option(error: &clap::Error) -> Option<&str> {
    match (error.kind(), error.get(ContextKind::InvalidArg)) {
        (ErrorKind::UnknownArgument, Some(ContextValue::String(argument))) => {
            argument.ends_with(".toml").then_some(argument.as_str())
        }
        _ => None,
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

/// The output of the future. Without a future, this never completes.
async fn wait<T: Future>(one: Option<T>) -> T::Output {
    match one {
        Some(one) => one.await,
        None => std::future::pending().await,
    }
}

/// Waits until the moment. Without a moment, this never completes.
async fn until(moment: Option<Instant>) {
    wait(moment.map(tokio::time::sleep_until)).await;
}

/// Like [`print`], but on a thread of its own, because the reader of stdout may be slow.
async fn print_apart(lines: Vec<u8>) -> io::Result<bool> {
    tokio::task::spawn_blocking(move || print(&lines)).await?
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    enum Told {
        #[error("x: cannot read: {0}")]
        Whole(#[source] io::Error),
        #[error("x: cannot read")]
        Bare(#[source] io::Error),
        #[error("x: {0}, expected a new file")]
        Within(#[source] io::Error),
    }

    #[test]
    fn a_cause_is_told_once() {
        let cause = || io::Error::other("no such file");
        for told in [Told::Whole(cause()), Told::Bare(cause())] {
            assert_eq!(line(&told), "x: cannot read: no such file");
        }
        let told = Told::Within(cause());
        assert_eq!(line(&told), "x: no such file, expected a new file");
    }

    #[test]
    fn a_directory_is_refused_in_the_system_s_words() {
        let directory = tempfile::tempdir().unwrap();
        let refused = Told::Bare(open(directory.path()).unwrap_err());
        assert_eq!(line(&refused), "x: cannot read: Is a directory");
        let refused = Told::Bare(std::fs::read(directory.path()).unwrap_err());
        assert_eq!(line(&refused), "x: cannot read: Is a directory");
    }

    #[test]
    fn the_number_of_an_error_is_not_told() {
        let cause = |errno| io::Error::from_raw_os_error(errno);
        assert_eq!(
            line(&Told::Bare(cause(2))),
            "x: cannot read: No such file or directory"
        );
        let two = format!("{}, then {}", cause(2), cause(13));
        assert_eq!(
            without_numbers(&two),
            "No such file or directory, then Permission denied"
        );
        for other in ["a (os error x) b", "a (os error 2"] {
            assert_eq!(without_numbers(other), other);
        }
    }

    #[test]
    fn an_error_is_one_line_whatever_a_file_is_called() {
        let told = io::Error::other("a\nb\u{1b}[2J\t\u{e9}\u{202e}: cannot read");
        assert_eq!(
            line(&told),
            "a\\nb\\u{1b}[2J\\t\u{e9}\\u{202e}: cannot read"
        );
    }
}
