//! `hardnessd sniff`: raw bytes in, a proposed `[sensor.frame]` out.
//!
//! It prints TOML on stdout, to be appended below a `[[sensor]]`. The comments in the TOML say how
//! sure the proposal is. With `--out`, it writes a whole configuration to a file instead. If two
//! arrays are likely, it shows both as pictures on stderr, and the user chooses.
//!
//! The files below are in reading order: the length of a frame, what each byte is, how good a picture
//! of a press is, which checksums hold, where the cells may be, and how an array is written as
//! settings. Each uses only those above it.

mod period;
mod columns;
mod marking;
mod picture;
mod checks;
mod places;
mod proposal;
mod found;
mod noise;
mod text;
mod find;
#[cfg(test)]
mod generator;
#[cfg(test)]
mod tests;

use std::fmt::Write;
use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{ArgGroup, Args as ClapArgs};

use self::find::find;
pub use self::found::Failure;
use self::found::{Found, Known, Shown};
use self::noise::noise_counts;
use self::picture::draw;
use super::simulate::positive;
use super::{CannotRead, absolute, doctor, exit};
use crate::apart;
use crate::daemon::port::Port;
use crate::daemon::serial::{self, Link, Turn};
use hardnessd_core::exit::{Coded, FAILED, IO, UNAVAILABLE};
use hardnessd_core::frame::{MOST_SIDE, Pitch};
use hardnessd_core::part::Part;
use hardnessd_core::pipeline::Input;
use hardnessd_core::recording::{self, Entry, FileKind, Reader};
use hardnessd_core::sensor::DEFAULT_FRAME_RATE_HZ;
use hardnessd_core::tare::NEWTONS_PER_COUNT;
use hardnessd_core::wire::Cell;
use hardnessd_core::wording::escaped;

/// What `--help` says below the options.
const MORE: &str = "\
    Press the sensor meanwhile, with one finger at several places and at the edges: only presses \
    show the shape of the array. It finds frames of one length with a constant mark, and \
    ff-tail, zero-run, ascii, csv and jq-glove, of up to 64x64 taxels. If two arrays are likely, \
    it shows a picture of each with the options that choose it. `order`, `mask` and `invert` \
    leave no trace in the bytes, and without a checksum a header and a tail look the same. Exit \
    code 1: no layout was found, or it is not sure.";

/// Arguments of `sniff`.
#[derive(Debug, Clone, ClapArgs)]
#[command(after_long_help = MORE)]
#[command(group(ArgGroup::new("source").args(["file", "port"]).required(true)))]
pub struct Args {
    /// Recording of `record`, or raw bytes back to back, with presses in it
    file: Option<PathBuf>,
    /// Listen to this port instead: a device, tcp://HOST:PORT or udp://ADDRESS:PORT
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
    /// Rows of the array, if you know them
    #[arg(long, value_name = "R", value_parser = side)]
    rows: Option<usize>,
    /// Columns of the array, if you know them
    #[arg(long, value_name = "C", value_parser = side)]
    cols: Option<usize>,
    /// Type of a cell, if you know it: `u8`, `u16le` or `u16be`
    #[arg(long, value_name = "T", value_parser = cell)]
    cell: Option<Cell>,
    /// Write a whole configuration to this new file, instead of a [sensor.frame] on stdout
    #[arg(long, value_name = "TOML")]
    out: Option<PathBuf>,
}

/// The reason why `sniff` proposes nothing.
#[derive(Debug, thiserror::Error)]
pub enum Error {
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
    /// There is no layout for the bytes.
    #[error("{path}: {failure}")]
    Unexplained {
        /// Path of the recording or the port.
        path: PathBuf,
        /// What the bytes are instead.
        failure: Failure,
    },
    /// Two arrays are likely.
    #[error(
        "{path}: not sure: choose with `{options}` or as the pictures say, or press with one finger at several \
         places and at the edges"
    )]
    Unsure {
        /// Path of the recording or the port.
        path: PathBuf,
        /// The options for the likelier array.
        options: String,
    },
    /// The configuration cannot be written.
    #[error("--out {path}: {source}")]
    Write {
        /// The path of the configuration.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
}

impl Coded for Error {
    fn exit_code(&self) -> u8 {
        match self {
            Error::Recording { .. } | Error::Unexplained { .. } | Error::Unsure { .. } => FAILED,
            Error::Unavailable { .. } => UNAVAILABLE,
            Error::Write { .. } => IO,
        }
    }
}

/// The most bytes that are examined, from the beginning: 20,000 frames of the JX255N.
const MOST_BYTES: usize = 16 << 20;

/// Prints a proposal, or writes it to a file.
///
/// # Errors
///
/// Returns an [`exit::Failure`] if the bytes cannot be read, there is no layout or more than one for
/// them, or the output fails.
pub async fn run(args: Args) -> Result<(), exit::Failure> {
    let listened = match &args.port {
        Some(port) => Some(listen(port, args.baud, args.seconds).await?),
        None => None,
    };
    // This runs on another thread, because the file may be a pipe and many bytes take long.
    let proposed = apart::start("sniff", move || match listened {
        Some(bytes) => propose(&args, &bytes),
        None => read(&args.source()).and_then(|bytes| propose(&args, &bytes)),
    })?;
    proposed.await.expect("a proposal is made without a panic")
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
fn propose(args: &Args, bytes: &[u8]) -> Result<(), exit::Failure> {
    let path = &args.source();
    let Args {
        rows, cols, cell, ..
    } = *args;
    let found = find(bytes, Known { rows, cols, cell }).map_err(|failure| Error::Unexplained {
        path: path.to_owned(),
        failure,
    })?;
    if !found.is_sure() {
        for shown in [&found.best].into_iter().chain(&found.next) {
            show(shown);
        }
        return Err(Error::Unsure {
            path: path.to_owned(),
            options: options(&found.best),
        }
        .into());
    }
    let frame = toml(path, bytes.len(), &found);
    let Some(out) = &args.out else {
        super::print(frame.as_bytes())?;
        return Ok(());
    };
    let proposal = &found.best.proposal;
    let listened_s = args.port.as_ref().map(|_| args.seconds);
    let text = configuration(args, listened_s.map(|s| proposal.frames as f64 / s))
        + &frame
        + &thresholds(
            proposal.most_counts,
            noise_counts(&proposal.settings, bytes),
        )
        + PAGE;
    let written = Part::new(out).and_then(|part| part.write(text.as_bytes()));
    written.map_err(|source| Error::Write {
        path: out.clone(),
        source,
    })?;
    let out = escaped(&out.display().to_string());
    let next = if args.port.is_some() {
        format!("`hardnessd check --config {out}` says what would run")
    } else {
        "set its port and frame_rate_hz, which a file does not say".to_owned()
    };
    hardnessd_core::stderr_line!("wrote {out}: {next}");
    Ok(())
}

/// The part of a configuration above `[sensor.frame]`.
fn configuration(args: &Args, frame_rate_hz: Option<f64>) -> String {
    let port = match &args.port {
        // The configuration may be in another directory.
        Some(Port::Device(path)) => absolute(path).into(),
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

/// The end of a configuration.
const PAGE: &str = "\n# [http]\n# listen = \"127.0.0.1:8256\"  # a live page for your browser\n";

/// The part below `[sensor.frame]`, where the noise at rest would pass for a touch by default. Counts
/// that are finer than a byte get fewer newtons: full scale is as many newtons as that of a byte.
fn thresholds(most_counts: u16, noise_counts: u16) -> String {
    let mut text = String::new();
    let mut newtons = NEWTONS_PER_COUNT;
    let full_scale = (u32::from(most_counts) + 1).next_power_of_two() - 1;
    if full_scale > u32::from(u8::MAX) {
        newtons *= f32::from(u8::MAX) / full_scale as f32;
        text += &format!(
            "\n[sensor.calibration]\nnewtons_per_count = {newtons:.5}  # a guess from counts up to {most_counts}: \
             measure it with weights\n"
        );
    }
    // What is as large as this may be a touch.
    let is_noise = 10 * u32::from(noise_counts) < u32::from(most_counts);
    // The zero may be taken where the noise goes the other way.
    if is_noise && 2.0 * f32::from(noise_counts) * newtons >= Pitch::JX255N.contact_threshold_n() {
        let threshold_n = (f32::from(noise_counts) + 1.5) * newtons;
        let plural = if noise_counts == 1 { "" } else { "s" };
        text += &format!(
            "\n[press]\ncontact_threshold_n = {threshold_n:.3}  # noise of {noise_counts} count{plural} at rest is \
             no touch\n"
        );
    }
    text
}

fn read(path: &Path) -> Result<Vec<u8>, exit::Failure> {
    let unreadable = CannotRead::at(path);
    let (kind, file) = FileKind::read(super::open(path)?).map_err(&unreadable)?;
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
                    hardnessd_core::stderr_line!(
                        "listening at {port} for {seconds} s: press the sensor"
                    );
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

/// The options that choose an array.
fn options(shown: &Shown) -> String {
    let array = format!("--rows {} --cols {}", shown.array.rows, shown.array.cols);
    match shown.cell {
        Some(cell) => format!("{array} --cell {}", name(cell)),
        None => array,
    }
}

/// Shows the strongest press as an array would have it.
fn show(shown: &Shown) {
    hardnessd_core::stderr_line!("{}:", options(shown));
    for line in draw(&shown.picture, shown.array.cols) {
        hardnessd_core::stderr_line!("    |{line}|");
    }
}

fn toml(path: &Path, bytes: usize, found: &Found) -> String {
    let mut toml = String::new();
    let mut remark =
        |words: &str| writeln!(toml, "# {}", escaped(words)).expect("a string takes it all");
    let Found { best, next, .. } = found;
    let proposal = &best.proposal;
    remark(&format!("{}: {bytes} bytes", path.display()));
    remark(&format!(
        "explained: {:.1} % of the bytes, {} whole frames, {} damaged",
        100.0 * proposal.share,
        proposal.frames,
        proposal.frames_damaged
    ));
    remark(&match (next, found.lead()) {
        (Some(next), Some(lead)) => format!(
            "{}: its picture is {} times as likely as the next, {}",
            array_in_words(best),
            lead.min(1e6).round(),
            array_in_words(next)
        ),
        _ => format!("{}: no other array makes a picture", array_in_words(best)),
    });
    for words in proposal.remarks.iter().chain(&proposal.doubt) {
        remark(words);
    }
    remark("bytes do not show order, mask and invert, nor which side of the sensor is up");
    toml + "[sensor.frame]\n"
        + &toml::to_string(&proposal.settings).expect("settings are keys and plain values")
}

fn array_in_words(shown: &Shown) -> String {
    match shown.cell {
        Some(cell) => format!("{} {}", shown.array, name(cell)),
        None => shown.array.to_string(),
    }
}

/// The name of a type of cells in a configuration.
fn name(cell: Cell) -> &'static str {
    match cell {
        Cell::U8 => "u8",
        Cell::U16le => "u16le",
        Cell::U16be => "u16be",
    }
}

fn cell(text: &str) -> Result<Cell, String> {
    let cells = [Cell::U8, Cell::U16le, Cell::U16be];
    let found = cells.into_iter().find(|&cell| name(cell) == text);
    found.ok_or_else(|| "expected u8, u16le or u16be".to_owned())
}

fn side(text: &str) -> Result<usize, String> {
    let found = text
        .parse()
        .ok()
        .filter(|side| (1..=MOST_SIDE).contains(side));
    found.ok_or_else(|| format!("expected 1 to {MOST_SIDE}"))
}
