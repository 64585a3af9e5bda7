//! What stands around the daemon: a sensor to try it on, recordings played again, eyes on a terminal.

pub mod args;
pub mod calibrate;
pub mod check;
pub mod configuration;
pub mod connect;
pub mod demo;
pub mod doctor;
pub mod exit;
mod faults;
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

use crate::wording;

/// What is printed of an error: one line, with the causes that it does not tell itself.
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
    shown(&without_numbers(&line))
}

/// Without the numbers that the system has for its errors: its words are there beside them.
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

/// One line of text. Whatever a file or a process in it is called, it cannot break the line or speak to
/// the terminal.
fn shown(text: &str) -> String {
    let shown = |c: char| {
        let escaped = wording::is_hidden(c).then(|| c.escape_default());
        let plain = escaped.is_none().then_some(c);
        escaped.into_iter().flatten().chain(plain)
    };
    text.chars().flat_map(shown).collect()
}

/// What clap says of arguments that it refuses, on one line, with exit code 2; or the help or version
/// that was asked for.
pub fn usage(program: &str, error: &clap::Error) -> ExitCode {
    if matches!(
        error.kind(),
        ErrorKind::DisplayHelp
            | ErrorKind::DisplayVersion
            | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand
    ) {
        return match error.print() {
            Err(failure) if !error.use_stderr() && failure.kind() != io::ErrorKind::BrokenPipe => {
                eprintln!("{program}: stdout: {failure}");
                ExitCode::from(exit::IO)
            }
            _ => ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(exit::USAGE)),
        };
    }
    let text = error.to_string();
    let told = text.split("\n\nUsage:").next().unwrap_or_default();
    let told = told.split("\n\nFor more").next().unwrap_or_default();
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
    } else if let Some(command) = where_to_look(error, &text) {
        told += &format!(": see `{command} --help`");
    }
    eprintln!("{program}: {}", shown(&told));
    ExitCode::from(exit::USAGE)
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

/// `hardnessd run hardnessd.toml`: a configuration without the option that it belongs to.
fn configuration_in_place_of_an_option(error: &clap::Error) -> Option<&str> {
    match (error.kind(), error.get(ContextKind::InvalidArg)) {
        (ErrorKind::UnknownArgument, Some(ContextValue::String(argument))) => {
            argument.ends_with(".toml").then_some(argument.as_str())
        }
        _ => None,
    }
}

/// Opens a file to read from. A directory is refused here: the system would do so at the first read
/// only, when what was asked for has begun.
fn open(path: &Path) -> io::Result<File> {
    let file = File::open(path)?;
    if file.metadata()?.is_dir() {
        return Err(io::ErrorKind::IsADirectory.into());
    }
    Ok(file)
}

/// Writes lines to stdout at once, and waits until there is room for them: not for a thread that has
/// anything else to do. `Ok(false)`: nobody reads any more, which ends a tool quietly.
///
/// # Errors
///
/// If stdout cannot be written to for another reason.
pub fn print(lines: &[u8]) -> io::Result<bool> {
    let mut out = io::stdout().lock();
    match out.write_all(lines).and_then(|()| out.flush()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(false),
        written => written.map(|()| true),
    }
}

/// As [`print`], from a thread of its own: whoever reads may take as long as they like.
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
