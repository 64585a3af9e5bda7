//! `hardnessd recover`: saves the whole parts of a damaged recording in a new one.

use std::ffi::OsString;
use std::fs::{self, File, Metadata, TryLockError};
use std::io::{self, BufReader, BufWriter, ErrorKind};
use std::os::unix::fs::{FileExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;
use jiff::Timestamp;
use rustix::fs::OFlags;

use hardnessd_core::recording::{self, FileKind, RecoverError, Recovered};

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
    /// The damaged file cannot be read.
    #[error("{path}: cannot read: {source}")]
    Unreadable {
        /// The path of the damaged file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// Reading the damaged file failed halfway.
    #[error("{path}: {source}")]
    Broken {
        /// The path of the damaged file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
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
    /// The new file cannot be written.
    #[error("--out {path}: {source}")]
    Write {
        /// The path of the new file.
        path: PathBuf,
        /// The error of the new recording.
        source: recording::Error,
    },
}

/// Saves the whole parts. Stderr says what was saved and what was lost.
///
/// # Errors
///
/// Returns [`Error`] if there is nothing to save, or a file cannot be read or written. The new file
/// does not exist then.
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
    // `file` stays open until all is done, because it holds the lock.
    let (part, file) = is_new(&args.out)
        .and_then(|()| part(&args.out))
        .map_err(|error| unwritten(error.into()))?;
    let saved = save(broken, &file).and_then(|recovered| {
        if has_ours(&recovered) {
            let put = is_new(&args.out)
                .and_then(|()| fs::rename(&part, &args.out))
                .and_then(|()| sync_directory(&args.out));
            put.map_err(recording::Error::from)?;
        }
        Ok(recovered)
    });
    let recovered = match saved {
        Ok(recovered) if has_ours(&recovered) => recovered,
        other => {
            // The file may have its final name already.
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
    hardnessd_core::say!("{}", account(&recovered));
    Ok(())
}

/// Fails if anything is at `out`, even a link to a file that does not exist.
fn is_new(out: &Path) -> io::Result<()> {
    if out.symlink_metadata().is_ok() {
        let exists = "a file or link is there already: name a new one";
        return Err(io::Error::new(ErrorKind::AlreadyExists, exists));
    }
    Ok(())
}

/// Makes and locks a file beside `out`, so that a file at `out` is always whole. An existing file
/// belongs to somebody and is kept, unless an interrupted `recover` left it. The lock keeps two
/// processes from writing the same file.
fn part(out: &Path) -> io::Result<(PathBuf, File)> {
    let mut end = OsString::from(".part");
    loop {
        let mut name = out.file_name().unwrap_or_default().to_owned();
        name.push(&end);
        let part = out.with_file_name(name);
        let file = match File::create_new(&part) {
            Err(error) if error.kind() == ErrorKind::AlreadyExists => match left_over(&part) {
                Some(file) => file,
                None => {
                    end.push(".part");
                    continue;
                }
            },
            made => made?,
        };
        // On a file system without locks, nobody holds one, so other errors do not matter.
        if let Err(TryLockError::WouldBlock) = file.try_lock() {
            let held = "another `hardnessd recover` is writing it: wait for it";
            return Err(io::Error::new(ErrorKind::ResourceBusy, held));
        }
        // The process that held the lock may have renamed the file meanwhile.
        let ours = file.metadata()?;
        let is_ours = |there: Metadata| (there.dev(), there.ino()) == (ours.dev(), ours.ino());
        if fs::metadata(&part).is_ok_and(is_ours) {
            file.set_len(0)?;
            return Ok((part, file));
        }
    }
}

/// The file at `part`, if it is empty or begins like a recording. A link is not followed, because
/// it may lead to somebody's file.
fn left_over(part: &Path) -> Option<File> {
    let no_link = OFlags::NOFOLLOW.bits().cast_signed();
    let mut options = File::options();
    let file = options
        .read(true)
        .write(true)
        .custom_flags(no_link)
        .open(part)
        .ok()?;
    let mut start = [0; recording::MAGIC.len()];
    let read = file.read_at(&mut start, 0).ok()?;
    (FileKind::of(&start[..read]) == FileKind::Recording).then_some(file)
}

fn save(broken: File, part: &File) -> Result<Recovered, RecoverError> {
    let (recovered, written) = recording::recover(BufReader::new(broken), BufWriter::new(part))?;
    let written = written.into_inner().map_err(io::IntoInnerError::into_error);
    let synced = written.and_then(File::sync_all);
    synced.map_err(recording::Error::from)?;
    Ok(recovered)
}

/// Flushes the directory, because only then is the file's name on the disk.
fn sync_directory(file: &Path) -> io::Result<()> {
    let directory = file.parent().filter(|path| !path.as_os_str().is_empty());
    File::open(directory.unwrap_or(Path::new(".")))?.sync_all()
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

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    #[test]
    fn no_link_is_followed() {
        let directory = tempfile::tempdir().unwrap();
        let (out, theirs) = (
            directory.path().join("good.mcap"),
            directory.path().join("theirs"),
        );
        symlink(&theirs, &out).unwrap();
        assert_eq!(is_new(&out).unwrap_err().kind(), ErrorKind::AlreadyExists);
        // A link at the path of the part is not followed either.
        fs::write(&theirs, recording::MAGIC).unwrap();
        symlink(&theirs, directory.path().join("other.mcap.part")).unwrap();
        let (part, _file) = part(&directory.path().join("other.mcap")).unwrap();
        assert!(part.ends_with("other.mcap.part.part"), "{}", part.display());
        assert_eq!(fs::read(&theirs).unwrap(), recording::MAGIC);
    }

    #[test]
    fn two_do_not_write_one_file() {
        let directory = tempfile::tempdir().unwrap();
        let out = directory.path().join("good.mcap");
        let (first, held) = part(&out).unwrap();
        fs::write(&first, recording::MAGIC).unwrap();
        let refused = part(&out).unwrap_err();
        assert_eq!(refused.kind(), ErrorKind::ResourceBusy);
        assert_eq!(fs::read(&first).unwrap(), recording::MAGIC);
        // The first process ends before it has finished.
        drop(held);
        let (second, file) = part(&out).unwrap();
        assert_eq!(second, first);
        assert_eq!(file.metadata().unwrap().len(), 0);
    }
}
