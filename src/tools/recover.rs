//! `hardnessd recover`: saves the whole parts of a damaged recording in a new one.

use std::fs::File;
use std::io::{self, BufReader, BufWriter, ErrorKind};
use std::path::PathBuf;

use clap::Args as ClapArgs;
use jiff::Timestamp;

use super::exit::{FAILED, Failure, IO};
use super::{cannot_read, unplayable};
use hardnessd_core::part::Part;
use hardnessd_core::recording::{self, RecoverError, Recovered};
use hardnessd_core::stderr_line;

/// Arguments of `recover`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    /// Recording that is damaged or was cut off; it is not changed
    broken: PathBuf,
    /// Recording to write (.mcap); a file that exists is left alone
    #[arg(long, value_name = "GOOD")]
    out: PathBuf,
}

/// Saves the whole parts. Stderr says what was saved and what was lost.
///
/// # Errors
///
/// Returns a [`Failure`] if there is nothing to save, or a file cannot be read or written. The new
/// file does not exist then.
pub fn run(args: &Args) -> Result<(), Failure> {
    let unreadable = cannot_read(&args.broken);
    let broken = super::open(&args.broken)?;
    let bytes = broken.metadata().map_err(&unreadable)?.len();
    let unwritten =
        |error: recording::Error| Failure::of(IO, format!("--out {}", args.out.display()), error);
    let part = Part::new(&args.out).map_err(|error| unwritten(error.into()))?;
    let recovered = save(broken, part.as_file()).map_err(|error| match error {
        RecoverError::Read(error) if error.kind() == ErrorKind::NotSeekable => unreadable(error),
        RecoverError::Read(error) => unplayable(&args.broken)(error),
        RecoverError::Write(error) => unwritten(error),
    })?;
    let path = args.broken.display();
    if recovered.messages == 0 {
        let problem = format!(
            "{path}: not a recording, or no chunk of messages in it is whole ({bytes} bytes read); \
             `mcap recover` rewrites chunks of over 64 MiB"
        );
        return Err(Failure::new(FAILED, problem));
    }
    part.finish().map_err(|error| unwritten(error.into()))?;
    stderr_line!("{}", account(&recovered));
    Ok(())
}

fn save(broken: File, part: &File) -> Result<Recovered, RecoverError> {
    let (recovered, written) = recording::recover(BufReader::new(broken), BufWriter::new(part))?;
    let written = written.into_inner().map_err(io::IntoInnerError::into_error);
    written.map_err(recording::Error::from)?;
    Ok(recovered)
}

/// Lines that say what was saved and what was lost.
fn account(recovered: &Recovered) -> String {
    let time = |ns: u64| {
        let time = Timestamp::from_nanosecond(i128::from(ns));
        time.map_or_else(|_| "?".to_owned(), |time| format!("{time:.3}"))
    };
    let span = recovered.span_ns;
    let (first, last) = span.map_or_else(Default::default, |(a, b)| (time(a), time(b)));
    let (messages, chunks) = (recovered.messages, recovered.chunks);
    let mut text = format!("saved {messages} messages in {chunks} chunks, {first} to {last}");
    for (place, bytes) in &recovered.lost {
        text +=
            &format!("\nlost {bytes} bytes at byte {place}: damaged, or a chunk of over 64 MiB");
    }
    let lost = recovered.messages_lost;
    if lost > 0 {
        text += &format!("\nlost {lost} messages that cannot be read, or that nothing describes");
    }
    if !recovered.complete {
        text += "\nthe end was missing: the recording was cut off, or it is still being written";
    }
    if recovered.states == 0 {
        text += "\nno state of a sensor is left: `hardnessd replay` has nothing to begin with, \
                 `hardnessd sniff` reads the bytes";
    }
    if recovered.is_whole() {
        text += "\nlost nothing";
    }
    text
}
