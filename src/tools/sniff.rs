//! `hardnessd sniff`: raw bytes in, a proposed `[sensor.frame]` out.
//!
//! It prints TOML on stdout, to be appended below a `[[sensor]]`. The comments in the TOML say how
//! sure the proposal is and why it was preferred. With `--out`, it writes a whole configuration to
//! a file instead.

mod candidates;
mod proposal;
#[cfg(test)]
mod tests;

use std::fmt::Write;
use std::fs::File;
use std::io::{self, BufReader, Read, Write as _};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{ArgGroup, Args as ClapArgs};

use self::proposal::{Proposal, propose};
use super::doctor;
use super::simulate::positive;
use crate::daemon::port::Port;
use crate::daemon::serial::{self, Link, Turn};
use hardnessd_core::exit::{Coded, FAILED, IO, NO_INPUT, UNAVAILABLE};
use hardnessd_core::pipeline::Input;
use hardnessd_core::recording::{self, Entry, FileKind, Reader};
use hardnessd_core::sensor::DEFAULT_FRAME_RATE_HZ;
use hardnessd_core::wire::Settings;
use hardnessd_core::wording::escaped;

/// Arguments of `sniff`.
#[derive(Debug, Clone, ClapArgs)]
#[command(group(ArgGroup::new("source").args(["file", "port"]).required(true)))]
pub struct Args {
    /// Recording of `record`, or raw bytes back to back; best with presses in it
    file: Option<PathBuf>,
    /// Listen to this port instead; press the sensor meanwhile
    #[arg(long, value_name = "P")]
    port: Option<Port>,
    /// Speed of the port in bits per second
    #[arg(long, value_name = "B", default_value_t = 115_200, conflicts_with = "file",
        value_parser = clap::value_parser!(u32).range(1..))]
    baud: u32,
    /// Seconds to listen to the port
    #[arg(long, value_name = "S", default_value_t = 10.0, conflicts_with = "file",
        value_parser = positive)]
    seconds: f64,
    /// Write a whole configuration to this new file, instead of a [sensor.frame] on stdout
    #[arg(long, value_name = "TOML")]
    out: Option<PathBuf>,
}

/// The reason why `sniff` proposes nothing.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The recording cannot be read.
    #[error("{path}: cannot read: {source}")]
    Unreadable {
        /// Path of the recording.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The recording is damaged, or of another program.
    #[error("{path}: {source}")]
    Recording {
        /// Path of the recording.
        path: PathBuf,
        /// The error of the recording.
        source: recording::Error,
    },
    /// The port does not open, or it was lost before the first byte.
    #[error("{path}: {reason}")]
    Unavailable {
        /// Path of the port.
        path: PathBuf,
        /// The fault that was found, or the system's reason.
        reason: String,
    },
    /// No layout explains the bytes.
    #[error(
        "{path}: no layout explains half of the {bytes} bytes with at most a tenth of its frames damaged: \
         press the sensor meanwhile, give it 20 frames or more, and try another --baud"
    )]
    Unexplained {
        /// Path of the recording or the port.
        path: PathBuf,
        /// The number of bytes.
        bytes: usize,
    },
    /// The configuration cannot be written.
    #[error("--out {path}: {source}")]
    Write {
        /// The path of the configuration.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// Stdout cannot be written to.
    #[error("stdout: {0}")]
    Print(#[source] io::Error),
}

impl Coded for Error {
    fn exit_code(&self) -> u8 {
        match self {
            Error::Unreadable { .. } => NO_INPUT,
            Error::Recording { .. } | Error::Unexplained { .. } => FAILED,
            Error::Unavailable { .. } => UNAVAILABLE,
            Error::Print(_) | Error::Write { .. } => IO,
        }
    }
}

/// The most bytes that are examined, from the beginning: 20,000 frames of the JX255N.
const MOST_BYTES: usize = 16 << 20;

/// Prints a proposal, or writes it to a file.
///
/// # Errors
///
/// Returns [`Error`] if the bytes cannot be read, no layout explains them, or the output fails.
pub async fn run(args: Args) -> Result<(), Error> {
    let listened = match &args.port {
        Some(port) => Some(listen(port, args.baud, args.seconds).await?),
        None => None,
    };
    // This runs on another thread, because the file may be a pipe and many bytes take long.
    let told = tokio::task::spawn_blocking(move || match listened {
        Some(bytes) => tell(&args, &bytes),
        None => read(&args.source()).and_then(|bytes| tell(&args, &bytes)),
    });
    told.await.expect("a proposal is made without a panic")
}

impl Args {
    /// The file or the port.
    fn source(&self) -> PathBuf {
        let port = self.port.as_ref().map(|port| port.to_string().into());
        let source = self.file.clone().or(port);
        source.expect("clap asks for a port where there is no file")
    }
}

/// Prints or writes the layout that explains `bytes`.
fn tell(args: &Args, bytes: &[u8]) -> Result<(), Error> {
    let path = &args.source();
    let proposals = propose(bytes);
    let Some((best, others)) = proposals.split_first() else {
        return Err(Error::Unexplained {
            path: path.to_owned(),
            bytes: bytes.len(),
        });
    };
    let frame = toml(path, bytes.len(), best, others.first());
    let Some(out) = &args.out else {
        return super::print(frame.as_bytes())
            .map(drop)
            .map_err(Error::Print);
    };
    let listened_s = args.port.as_ref().map(|_| args.seconds);
    let text = configuration(args, listened_s.map(|s| best.frames as f64 / s)) + &frame;
    let written = File::create_new(out).and_then(|mut file| file.write_all(text.as_bytes()));
    written.map_err(|source| Error::Write {
        path: out.clone(),
        source,
    })?;
    let next = if args.port.is_some() {
        "`hardnessd check --config` says what would run"
    } else {
        "set its port and frame_rate_hz, which a file does not say"
    };
    hardnessd_core::say!("wrote {}: {next}", escaped(&out.display().to_string()));
    Ok(())
}

/// The part of a configuration above `[sensor.frame]`.
fn configuration(args: &Args, frame_rate_hz: Option<f64>) -> String {
    let port = match &args.port {
        // The configuration may be in another directory.
        Some(Port::Device(path)) => std::path::absolute(path)
            .map_or(path.clone(), |path| path)
            .into(),
        Some(port) => port.clone(),
        None => Port::Device("/dev/serial/by-id/...".into()),
    };
    let port = toml::Value::String(port.to_string());
    let baud = args.baud;
    let mut text = format!("[[sensor]]\nname = \"sensor\"\nport = {port}\nbaud = {baud}\n");
    match frame_rate_hz {
        // The duration is not exact enough for more digits.
        Some(hz) => {
            text += &format!(
                "frame_rate_hz = {:?}  # as counted\n",
                (hz * 10.0).round().max(1.0) / 10.0
            );
        }
        None => text += &format!("# frame_rate_hz = {DEFAULT_FRAME_RATE_HZ:?}\n"),
    }
    text
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
        // If there are several sensors, take the bytes of the first.
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

/// After this silence another sender of datagrams is taken.
const STALE_AFTER: Duration = Duration::from_secs(1);

/// The bytes that come from the port in `seconds`. Fewer if the port is lost.
async fn listen(port: &Port, baud: u32, seconds: f64) -> Result<Vec<u8>, Error> {
    let settings = serial::Settings {
        stale_after: STALE_AFTER,
        start: Vec::new(),
        request: None,
    };
    let mut link = Link::new(port, baud, settings);
    let mut bytes = Vec::new();
    let mut lost = None;
    // If the duration is too long to count, listening ends when the port is lost or enough bytes
    // have come.
    let listened = Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX);
    let _ = tokio::time::timeout(listened, async {
        while bytes.len() < MOST_BYTES {
            match link.turn().await {
                Turn::Opened => {
                    let port = escaped(&port.to_string());
                    hardnessd_core::say!("listening at {port} for {seconds} s: press the sensor");
                }
                Turn::Bytes(read) => bytes.extend_from_slice(read),
                Turn::Restored(_) | Turn::Stranger(_) => {}
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
            path: port.to_string().into(),
            reason: doctor::obstacle(port).unwrap_or(reason),
        }),
        _ => Ok(bytes),
    }
}

fn toml(path: &Path, bytes: usize, best: &Proposal, next: Option<&Proposal>) -> String {
    let mut toml = String::new();
    let mut remark =
        |words: String| writeln!(toml, "# {}", escaped(&words)).expect("a string takes it all");
    remark(format!("{}: {bytes} bytes", path.display()));
    remark(format!("explained: {}", said(best)));
    match next {
        Some(next) => {
            let keys = keys(&next.settings).trim_end().replace('\n', ", ");
            remark(comparison(best, next));
            remark(format!("next: {}", said(next)));
            remark(format!("    {keys}"));
        }
        None => remark("no other layout explains half of them".to_owned()),
    }
    if best.frames_changed == 0 {
        remark("all frames are the same: sniff again with presses to be sure".to_owned());
    }
    remark(
        "bytes do not show order, mask and invert, nor which side of the sensor is up".to_owned(),
    );
    toml + "[sensor.frame]\n" + &keys(&best.settings)
}

/// Why `best` is preferred to `next`, or what would tell them apart.
fn comparison(best: &Proposal, next: &Proposal) -> String {
    match best.reason(next) {
        Some(reason) => format!("preferred to the next because {reason}"),
        None if best.is_same_but_for_the_ends(next) => {
            "cannot be told from the next, because a header and a tail look the same here: record \
             from the moment the sensor is switched on, or read its data sheet"
                .to_owned()
        }
        None => "nothing tells it from the next: read the sensor's data sheet".to_owned(),
    }
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
