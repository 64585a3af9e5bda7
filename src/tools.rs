//! What stands around the daemon: a sensor to try it on, recordings played again, eyes on a terminal.

pub mod check;
pub mod demo;
pub mod doctor;
mod faults;
pub mod generate;
mod player;
mod pty;
pub mod record;
pub mod recover;
pub mod replay;
pub mod simulate;
pub mod sniff;
pub mod tail;
pub mod watch;

use std::error::Error;
use std::fs::File;
use std::io::{self, ErrorKind, Write};
use std::path::Path;

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
    line
}

/// Opens a file to read from. A directory is refused here: the system would do so at the first read
/// only, when what was asked for has begun.
fn open(path: &Path) -> io::Result<File> {
    let file = File::open(path)?;
    if file.metadata()?.is_dir() {
        return Err(ErrorKind::IsADirectory.into());
    }
    Ok(file)
}

/// Writes lines to stdout at once. `Ok(false)`: nobody reads any more, which ends a tool quietly.
///
/// # Errors
///
/// If stdout cannot be written to for another reason.
pub fn print(lines: &[u8]) -> io::Result<bool> {
    let mut out = io::stdout().lock();
    match out.write_all(lines).and_then(|()| out.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(false),
        written => written.map(|()| true),
    }
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
}
