//! `hardnessd recover`: what is whole in a damaged recording, into a new one.

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, BufReader, BufWriter, ErrorKind, Read};
use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;
use jiff::Timestamp;

use crate::recording::{self, RecoverError, Recovered};

/// Arguments of `recover`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    /// Recording that is damaged or was cut off; it is not changed
    broken: PathBuf,
    /// Recording to write (.mcap); a file that exists is left alone
    #[arg(long, value_name = "GOOD")]
    out: PathBuf,
}

/// Why nothing was saved.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The damaged file cannot be read.
    #[error("{path}: cannot read: {source}")]
    Unreadable {
        /// As given.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// Its disk failed while it was read.
    #[error("{path}: {source}")]
    Broken {
        /// As given.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// There is nothing to be saved.
    #[error("{path}: found no whole chunk of messages in {bytes} bytes, expected a recording")]
    Nothing {
        /// As given.
        path: PathBuf,
        /// All of it.
        bytes: u64,
    },
    /// MCAP, but no recording of ours.
    #[error(
        "{path}: found {messages} messages of other programs and no other, expected a recording of \
         hardnessd"
    )]
    Foreign {
        /// As given.
        path: PathBuf,
        /// Whole ones.
        messages: u64,
    },
    /// The new file cannot be written.
    #[error("--out {path}: {source}")]
    Write {
        /// As given.
        path: PathBuf,
        /// Why not.
        source: recording::Error,
    },
}

/// Saves what is whole; says on stderr what that is, and what is lost.
///
/// # Errors
///
/// [`Error`], if there is nothing to be saved or a file cannot be read or written. The new file is
/// then not there.
pub fn run(args: &Args) -> Result<(), Error> {
    let unreadable = |source| Error::Unreadable {
        path: args.broken.clone(),
        source,
    };
    let broken = super::open(&args.broken).map_err(unreadable)?;
    let bytes = broken.metadata().map_err(unreadable)?.len();
    let unwritten = |source: recording::Error| Error::Write {
        path: args.out.clone(),
        source,
    };
    if args.out.exists() {
        let exists = io::Error::new(ErrorKind::AlreadyExists, "exists, expected a new file");
        return Err(unwritten(exists.into()));
    }
    let (part, file) = part(&args.out).map_err(|error| unwritten(error.into()))?;
    let saved = save(broken, file).and_then(|recovered| {
        if has_ours(&recovered) {
            let put = fs::rename(&part, &args.out).and_then(|()| sync_directory(&args.out));
            put.map_err(recording::Error::from)?;
        }
        Ok(recovered)
    });
    let recovered = match saved {
        Ok(recovered) if has_ours(&recovered) => recovered,
        other => {
            // It may be in its place already.
            let _ = fs::remove_file(&part);
            return Err(match other {
                Ok(Recovered { messages, .. }) if messages > 0 => Error::Foreign {
                    path: args.broken.clone(),
                    messages,
                },
                Ok(_) => Error::Nothing {
                    path: args.broken.clone(),
                    bytes,
                },
                Err(RecoverError::Read(error)) if error.kind() == ErrorKind::NotSeekable => {
                    unreadable(error)
                }
                Err(RecoverError::Read(source)) => Error::Broken {
                    path: args.broken.clone(),
                    source,
                },
                Err(RecoverError::Write(error)) => unwritten(error),
            });
        }
    };
    eprintln!("{}", account(&recovered));
    Ok(())
}

/// A new file beside the place of `out`, so that one of that name is always a whole one. What stands
/// there already is somebody's, unless it is what an earlier try that was ended has left.
fn part(out: &Path) -> io::Result<(PathBuf, File)> {
    let mut end = OsString::from(".part");
    loop {
        let mut name = out.file_name().unwrap_or_default().to_owned();
        name.push(&end);
        let part = out.with_file_name(name);
        match File::create_new(&part) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists && is_left_over(&part) => {
                return File::create(&part).map(|file| (part, file));
            }
            Err(error) if error.kind() == ErrorKind::AlreadyExists => end.push(".part"),
            made => return made.map(|file| (part, file)),
        }
    }
}

/// Whether a file is the beginning of a recording, or nothing yet.
fn is_left_over(part: &Path) -> bool {
    let begins = |file: File| -> io::Result<bool> {
        let mut start = Vec::new();
        file.take(mcap::MAGIC.len() as u64)
            .read_to_end(&mut start)?;
        Ok(mcap::MAGIC.starts_with(&start))
    };
    super::open(part).and_then(begins).unwrap_or(false)
}

fn save(broken: File, part: File) -> Result<Recovered, RecoverError> {
    let (recovered, part) = recording::recover(BufReader::new(broken), BufWriter::new(part))?;
    let part = part.into_inner().map_err(io::IntoInnerError::into_error);
    let synced = part.and_then(|part| part.sync_all());
    synced.map_err(recording::Error::from)?;
    Ok(recovered)
}

/// A name is on the disk when its directory is.
fn sync_directory(file: &Path) -> io::Result<()> {
    let directory = file.parent().filter(|path| !path.as_os_str().is_empty());
    File::open(directory.unwrap_or(Path::new(".")))?.sync_all()
}

/// Whether anything of ours was saved.
fn has_ours(recovered: &Recovered) -> bool {
    recovered.messages > recovered.messages_foreign
}

/// What was saved and what was lost, in lines.
fn account(recovered: &Recovered) -> String {
    let Recovered {
        messages,
        chunks,
        span_ns,
        lost,
        messages_unknown,
        complete,
        messages_foreign: _,
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
    if *messages_unknown > 0 {
        text += &format!("\nlost {messages_unknown} messages of channels that nothing describes");
    }
    if !complete {
        text += "\nthe end was missing: the recording was cut off, or it is still being written";
    }
    if recovered.is_whole() {
        text += "\nlost nothing";
    }
    text
}
