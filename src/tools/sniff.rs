//! `hardnessd sniff`: raw bytes in, a proposed `[sensor.frame]` out.
//!
//! On stdout: TOML, to be appended below a `[[sensor]]`; how sure it is stands in its comments.

mod candidates;
mod proposal;
#[cfg(test)]
mod tests;

use std::fmt::Write;
use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{ArgGroup, Args as ClapArgs};

use self::proposal::{Proposal, propose};
use super::shown;
use super::simulate::positive;
use crate::daemon::serial::{Link, Turn};
use crate::recording::{self, Entry, FileKind, Input, Reader};
use crate::wire::Settings;

/// Arguments of `sniff`.
#[derive(Debug, Clone, ClapArgs)]
#[command(group(ArgGroup::new("source").args(["file", "port"]).required(true)))]
pub struct Args {
    /// Recording of `record`, or raw bytes back to back; best with presses in it
    file: Option<PathBuf>,
    /// Listen to this port instead; press the sensor meanwhile
    #[arg(long, value_name = "P")]
    port: Option<PathBuf>,
    /// Speed of the port in bits per second
    #[arg(long, value_name = "B", default_value_t = 115_200, conflicts_with = "file",
        value_parser = clap::value_parser!(u32).range(1..))]
    baud: u32,
    /// Seconds to listen to the port
    #[arg(long, value_name = "S", default_value_t = 10.0, conflicts_with = "file",
        value_parser = positive)]
    seconds: f64,
}

/// Why there is no proposal.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The recording cannot be read.
    #[error("{path}: cannot read: {source}")]
    Unreadable {
        /// Of the recording.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// It is damaged, or none of ours.
    #[error("{path}: {source}")]
    Recording {
        /// Of the recording.
        path: PathBuf,
        /// What is wrong with it.
        source: recording::Error,
    },
    /// The port does not open, or was lost before a byte came.
    #[error("{path}: {reason}; `hardnessd doctor --port {path}` says more")]
    Unavailable {
        /// Of the port.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// No layout explains the bytes.
    #[error(
        "{path}: found no layout that explains half of {bytes} bytes, expected 20 frames or more \
         of a constant length (a wrong baud rate looks like this too)"
    )]
    Unexplained {
        /// Of the recording or the port.
        path: PathBuf,
        /// Looked at.
        bytes: usize,
    },
    /// Stdout fails.
    #[error("stdout: {0}")]
    Print(#[source] io::Error),
}

/// Bytes looked at, from the beginning: 20,000 frames of the JX255N.
const MOST_BYTES: usize = 16 << 20;

/// Prints a proposal.
///
/// # Errors
///
/// [`Error`], if there are no bytes, or nothing explains them.
pub async fn run(args: Args) -> Result<(), Error> {
    let listened = match &args.port {
        Some(port) => Some(listen(port, args.baud, args.seconds).await?),
        None => None,
    };
    let path = args.file.or(args.port);
    let path = path.expect("clap asks for a port where there is no file");
    // A file may be a pipe, and many bytes take their time: a signal is looked for here.
    let told = tokio::task::spawn_blocking(move || match listened {
        Some(bytes) => tell(path, &bytes),
        None => read(&path).and_then(|bytes| tell(path, &bytes)),
    });
    told.await.expect("a proposal is made without a panic")
}

/// Prints what explains `bytes`.
fn tell(path: PathBuf, bytes: &[u8]) -> Result<(), Error> {
    let proposals = propose(bytes);
    let Some((best, others)) = proposals.split_first() else {
        let bytes = bytes.len();
        return Err(Error::Unexplained { path, bytes });
    };
    let toml = toml(&path, bytes.len(), best, others.first());
    super::print(toml.as_bytes())
        .map(drop)
        .map_err(Error::Print)
}

fn read(path: &Path) -> Result<Vec<u8>, Error> {
    let file = super::open(path).map_err(|source| Error::Unreadable {
        path: path.to_owned(),
        source,
    })?;
    let unreadable = |source| Error::Unreadable {
        path: path.to_owned(),
        source,
    };
    let (kind, file) = FileKind::read(file).map_err(unreadable)?;
    let mut bytes = Vec::new();
    if kind == FileKind::Recording {
        // Of several sensors, the first one's.
        let mut sensor = None;
        for found in Reader::new(BufReader::new(file)) {
            let found = found.map_err(|source| Error::Recording {
                path: path.to_owned(),
                source,
            })?;
            if let Entry::Input(Input::Bytes(more)) = found.entry
                && *sensor.get_or_insert(found.sensor.clone()) == found.sensor
            {
                bytes.extend_from_slice(&more);
            }
            if bytes.len() >= MOST_BYTES {
                break;
            }
        }
        return Ok(bytes);
    }
    let read = file.take(MOST_BYTES as u64).read_to_end(&mut bytes);
    read.map_err(unreadable)?;
    Ok(bytes)
}

/// What comes from the port in `seconds`; less if it is lost.
async fn listen(path: &Path, baud: u32, seconds: f64) -> Result<Vec<u8>, Error> {
    let mut link = Link::new(path, baud);
    let mut bytes = Vec::new();
    let mut lost = None;
    // Longer than there is time: until the port is lost or the bytes are many.
    let listened = Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX);
    let _ = tokio::time::timeout(listened, async {
        while bytes.len() < MOST_BYTES {
            match link.turn().await {
                Turn::Opened => {
                    let path = shown(&path.display().to_string());
                    eprintln!("listening at {path} for {seconds} s: press the sensor");
                }
                Turn::Bytes(read) => bytes.extend_from_slice(read),
                Turn::Unavailable(reason) | Turn::Lost(reason) => {
                    lost = Some(reason);
                    return;
                }
            }
        }
    })
    .await;
    match lost {
        Some(reason) if bytes.is_empty() => Err(Error::Unavailable {
            path: path.to_owned(),
            reason,
        }),
        _ => Ok(bytes),
    }
}

fn toml(path: &Path, bytes: usize, best: &Proposal, next: Option<&Proposal>) -> String {
    let mut toml = String::new();
    let mut remark =
        |words: String| writeln!(toml, "# {}", shown(&words)).expect("a string takes it all");
    remark(format!("{}: {bytes} bytes", path.display()));
    remark(format!("explained: {}", said(best)));
    match next {
        Some(next) => {
            let keys = keys(&next.settings).trim_end().replace('\n', ", ");
            let margin = 100.0 * (best.share - next.share);
            remark(format!("next, {margin:.1} points behind: {}", said(next)));
            remark(format!("    {keys}"));
        }
        None => remark("nothing else explains half of them".to_owned()),
    }
    if best.frames_changed == 0 {
        remark("all frames are the same: sniff again with presses to be sure".to_owned());
    }
    remark("not seen in bytes: order, mask, invert; which side of the sensor is up".to_owned());
    toml + "[sensor.frame]\n" + &keys(&best.settings)
}

fn said(proposal: &Proposal) -> String {
    format!(
        "{:.1} % of the bytes, {} whole frames ({} unlike the one before), {} damaged",
        100.0 * proposal.share,
        proposal.frames,
        proposal.frames_changed,
        proposal.frames_damaged
    )
}

fn keys(settings: &Settings) -> String {
    toml::to_string(settings).expect("settings are keys and plain values")
}
