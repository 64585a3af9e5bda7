//! `hardnessd recover`: saves the whole parts of a damaged recording in a new one.

use std::fs::File;
use std::io::{self, BufReader, BufWriter, ErrorKind};
use std::path::PathBuf;

use clap::Args as ClapArgs;
use jiff::Timestamp;

use super::exit::Failure;
use super::{CannotRead, Unplayable};
use hardnessd_core::exit::{Coded, FAILED, IO};
use hardnessd_core::part::Part;
use hardnessd_core::recording::{self, RecoverError, Recovered};

/// Arguments of `recover`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    /// Recording that is damaged or was cut off; it is not changed
    broken: PathBuf,
    /// Recording to write (.mcap); a file that exists is left alone
    #[arg(long, value_name = "GOOD")]
    out: PathBuf,
}

/// The reason why nothing was saved.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// There is nothing to save.
    #[error("{path}: not a recording, or no chunk of messages in it is whole ({bytes} bytes read)")]
    Nothing {
        /// The path of the damaged file.
        path: PathBuf,
        /// The size of the file in bytes.
        bytes: u64,
    },
    /// The file is MCAP, but all its messages are of other programs.
    #[error("{path}: nothing to save: all {messages} messages are of other programs")]
    Foreign {
        /// The path of the damaged file.
        path: PathBuf,
        /// The number of whole messages.
        messages: u64,
    },
    /// Nothing was saved, because chunks that are not damaged are not read.
    #[error("{path}: nothing saved: {source}")]
    NothingRead {
        /// The path of the damaged file.
        path: PathBuf,
        /// The reason why the first of these chunks is not read.
        source: recording::Error,
    },
    /// Chunks that are not damaged were left out. The new file has all others.
    #[error("{path}: left out {chunks} chunks that are not damaged: `mcap recover` rewrites them")]
    Unread {
        /// The path of the damaged file.
        path: PathBuf,
        /// The number of these chunks.
        chunks: usize,
    },
    /// The new file cannot be written.
    #[error("--out {path}: {source}")]
    Write {
        /// The path of the new file.
        path: PathBuf,
        /// The error of the new recording.
        source: recording::Error,
    },
}

impl Coded for Error {
    fn exit_code(&self) -> u8 {
        match self {
            Error::Nothing { .. }
            | Error::NothingRead { .. }
            | Error::Foreign { .. }
            | Error::Unread { .. } => FAILED,
            Error::Write { .. } => IO,
        }
    }
}

/// Saves the whole parts. Stderr says what was saved and what was lost.
///
/// # Errors
///
/// Returns a [`Failure`] if there is nothing to save, or a file cannot be read or written. The new
/// file does not exist then, except after [`Error::Unread`].
pub fn run(args: &Args) -> Result<(), Failure> {
    let unreadable = CannotRead::at(&args.broken);
    let broken = super::open(&args.broken)?;
    let bytes = broken.metadata().map_err(&unreadable)?.len();
    let unwritten = |source: recording::Error| Error::Write {
        path: args.out.clone(),
        source,
    };
    let part = Part::new(&args.out).map_err(|error| unwritten(error.into()))?;
    let recovered = save(broken, part.as_file()).map_err(|error| match error {
        RecoverError::Read(error) if error.kind() == ErrorKind::NotSeekable => {
            Failure::from(unreadable(error))
        }
        RecoverError::Read(error) => Unplayable::at(&args.broken)(error).into(),
        RecoverError::Write(error) => unwritten(error).into(),
    })?;
    if !has_ours(&recovered) {
        let path = args.broken.clone();
        let unread = recovered.unread.into_iter().next();
        return Err(match (unread, recovered.messages) {
            (Some((_, problem)), _) => Error::NothingRead {
                path,
                source: recording::Error::Unread(problem),
            },
            (None, 0) => Error::Nothing { path, bytes },
            (None, messages) => Error::Foreign { path, messages },
        }
        .into());
    }
    part.finish().map_err(|error| unwritten(error.into()))?;
    hardnessd_core::stderr_line!("{}", account(&recovered));
    match recovered.unread.len() {
        0 => Ok(()),
        chunks => Err(Error::Unread {
            path: args.broken.clone(),
            chunks,
        }
        .into()),
    }
}

fn save(broken: File, part: &File) -> Result<Recovered, RecoverError> {
    let (recovered, written) = recording::recover(BufReader::new(broken), BufWriter::new(part))?;
    let written = written.into_inner().map_err(io::IntoInnerError::into_error);
    written.map_err(recording::Error::from)?;
    Ok(recovered)
}

/// Whether any message of this program was saved.
fn has_ours(recovered: &Recovered) -> bool {
    recovered.messages > recovered.messages_foreign
}

/// Lines that say what was saved and what was lost.
fn account(recovered: &Recovered) -> String {
    let Recovered {
        messages,
        chunks,
        span_ns,
        lost,
        unread,
        messages_unknown,
        messages_damaged,
        complete,
        messages_foreign: _,
        states,
    } = recovered;
    let time = |ns: u64| {
        let time = Timestamp::from_nanosecond(i128::from(ns));
        time.map_or_else(|_| "?".to_owned(), |time| format!("{time:.3}"))
    };
    let (first, last) = span_ns.map_or_else(Default::default, |(a, b)| (time(a), time(b)));
    let mut text = format!("saved {messages} messages in {chunks} chunks, {first} to {last}");
    for (place, bytes) in lost {
        text += &format!("\nlost {bytes} damaged bytes at byte {place}");
    }
    for (place, problem) in unread {
        text += &format!("\nleft out the chunk at byte {place}: {problem}");
    }
    if *messages_unknown > 0 {
        text += &format!("\nlost {messages_unknown} messages of channels that nothing describes");
    }
    if *messages_damaged > 0 {
        text += &format!("\nlost {messages_damaged} messages that cannot be read");
    }
    if !complete {
        text += "\nthe end was missing: the recording was cut off, or it is still being written";
    }
    if *states == 0 {
        text += "\nno state of a sensor is left: `hardnessd replay` has nothing to begin with, \
                 `hardnessd sniff` reads the bytes";
    }
    if recovered.is_whole() {
        text += "\nlost nothing";
    }
    text
}
