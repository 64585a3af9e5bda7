//! `hardnessd sniff`: raw bytes in, a proposed `[sensor.frame]` out.
//!
//! It prints TOML on stdout, to be appended below a `[[sensor]]`. The comments in the TOML say how
//! sure the proposal is. With `--out`, it writes a whole configuration to a file instead. If it is not
//! sure, it shows the likeliest arrays as pictures on stderr, and the user chooses. The crate
//! `hardnessd-sniff` finds the layouts.

mod framing;

use std::fmt::Write;
use std::fs;
use std::io::{BufReader, Read};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::{ArgGroup, Args as ClapArgs};
use hardnessd_sniff::{Capture, Found, Known, Proposal, Ranked, Scale, sniff};

use super::exit::{FAILED, Fail, Failure, IO, UNAVAILABLE};
use super::{absolute, cannot_read, doctor};
use crate::daemon::serial;
use crate::thread::spawn_thread;
use hardnessd_core::frame::MOST_SIDE;
use hardnessd_core::part::Part;
use hardnessd_core::pipeline::Input;
use hardnessd_core::port::Port;
use hardnessd_core::recording::{Entry, FileKind, Reader};
use hardnessd_core::sensor::DEFAULT_FRAME_RATE_HZ;
use hardnessd_core::stderr_line;
use hardnessd_core::tare::NEWTONS_PER_COUNT;
use hardnessd_core::wire::{Cell, Order};
use hardnessd_core::wording::{escaped, name, named, positive};

/// What `--help` says below the options.
const MORE: &str = "\
    Press the sensor meanwhile, with one finger at several places and at the edges: only presses \
    show the shape of the array. It finds frames of one length with a constant mark, \
    lines of numbers, SLIP and COBS, and jq-glove, of up to 64x64 taxels. If two arrays are likely, it \
    shows a picture of each with the options that choose it. A column-major `order`, `mask` and \
    `invert` leave no trace in the bytes, and without a checksum a header and a tail look the same. Exit code 1: \
    no layout was found, it is not sure, or the daemon cannot read what it found.";

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
    #[arg(long, value_name = "R", value_parser = clap::value_parser!(u8).range(1..=MOST_SIDE as i64))]
    rows: Option<u8>,
    /// Columns of the array, if you know them
    #[arg(long, value_name = "C", value_parser = clap::value_parser!(u8).range(1..=MOST_SIDE as i64))]
    cols: Option<u8>,
    /// Type of a cell, if you know it, as in `[sensor.frame]`
    #[arg(long, value_name = "T", value_parser = named::<Cell>)]
    cell: Option<Cell>,
    /// Write a whole configuration to this new file, instead of a [sensor.frame] on stdout
    #[arg(long, value_name = "TOML")]
    out: Option<PathBuf>,
}

/// The most bytes that are examined, from the beginning: 20,000 frames of the JX255N.
const MOST_BYTES: usize = 16 << 20;

/// The frames in a second. `None` if the times are unknown, or too short to tell.
fn frame_rate_hz(captured: &Capture, frames: u64) -> Option<f64> {
    let arrivals = &captured.arrivals;
    let seconds = arrivals.last()?.time_s - arrivals.first()?.time_s;
    // The duration is not exact enough for more digits.
    let hz = (frames.saturating_sub(1) as f64 / seconds * 10.0).round() / 10.0;
    (seconds >= LEAST_SECONDS).then_some(hz.max(0.1))
}

/// The shortest time that a frame rate is counted in.
const LEAST_SECONDS: f64 = 1.0;

/// Prints a proposal, or writes it to a file.
///
/// # Errors
///
/// Fails if the bytes cannot be read, there is no layout or more than one for them, or the output
/// fails.
pub async fn run(args: Args) -> Result<(), Failure> {
    let listened = match &args.port {
        Some(port) => Some(listen(port, args.baud, args.seconds).await?),
        None => None,
    };
    // This runs on another thread, because the file may be a pipe and many bytes take long.
    let proposed = spawn_thread("sniff", move || match listened {
        Some(captured) => propose(&args, &captured),
        None => read(&args.source()).and_then(|captured| propose(&args, &captured)),
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

/// Prints or writes the layout that explains the bytes.
fn propose(args: &Args, captured: &Capture) -> Result<(), Failure> {
    let path = &args.source();
    let known = Known {
        rows: args.rows.map(usize::from),
        cols: args.cols.map(usize::from),
        cell: args.cell,
    };
    let found = sniff(captured, known);
    let found = found.of(path.display(), FAILED)?;
    if let Some(doubt) = &found.doubt {
        for ranked in [&found.best].into_iter().chain(&found.next) {
            show(ranked);
        }
        let message = format!("{}: not sure: {doubt}", path.display());
        return Err(Failure::new(FAILED, message));
    }
    let proposal = &found.best.proposal;
    let frame = toml(path, captured.bytes.len(), &found, proposal);
    let Some(out) = &args.out else {
        super::print(frame.as_bytes())?;
        return Ok(());
    };
    let rate = frame_rate_hz(captured, proposal.frames);
    let scale = Scale::of(&proposal.settings, &captured.bytes);
    let text = configuration(args, rate) + &frame + &newtons(&scale) + PAGE;
    let written = Part::new(out).and_then(|part| part.write(text.as_bytes()));
    written.of(format!("--out {}", out.display()), IO)?;
    let out = escaped(&out.display().to_string());
    let next = if args.port.is_some() {
        format!("`hardnessd check --config {out}` says what would run")
    } else {
        "set its port and frame_rate_hz, which a file does not say".to_owned()
    };
    stderr_line!("wrote {out}: {next}");
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
    let rate = match frame_rate_hz {
        Some(hz) => format!("frame_rate_hz = {:?}  # counted: {hz:?}", usual(hz)),
        None => format!("# frame_rate_hz = {DEFAULT_FRAME_RATE_HZ:?}"),
    };
    format!("[[sensor]]\nname = \"sensor\"\nport = {port}\nbaud = {baud}\n{rate}\n")
}

/// The usual frame rate that was counted, or what was counted where none is within 3 %.
fn usual(hz: f64) -> f64 {
    const USUAL_HZ: [f64; 18] = [
        5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 40.0, 50.0, 60.0, 75.0, 80.0, 100.0, 120.0, 125.0,
        150.0, 200.0, 250.0, 500.0,
    ];
    let is_near = |usual: &&f64| (*usual - hz).abs() <= 0.03 * *usual;
    let near = USUAL_HZ.iter().filter(is_near);
    near.min_by(|a, b| (*a - hz).abs().total_cmp(&(*b - hz).abs()))
        .copied()
        .unwrap_or(hz)
}

/// The end of a configuration.
const PAGE: &str = "\n# [http]\n# listen = \"127.0.0.1:8256\"  # a live page for your browser\n";

/// The part below `[sensor.frame]`, with values where the defaults would take the sensor at rest for a touch.
fn newtons(scale: &Scale) -> String {
    let mut text = String::new();
    text += "\n[sensor.calibration]\n# pitch_mm = 3.5  # from the centre of a taxel to the next: measure it\n\
             # The bytes say neither the pitch nor the newtons of a count. A wrong one gives wrong verdicts.\n";
    text += &match scale.newtons_per_count {
        // Of counts of 24 bits, one has fewer than a millionth.
        Some(newtons) => format!(
            "newtons_per_count = {newtons:.digits$}  # a guess from counts up to {}: measure it with weights\n",
            scale.most_counts,
            digits = (3.0 - newtons.log10().floor()).max(6.0) as usize
        ),
        None => format!("# newtons_per_count = {NEWTONS_PER_COUNT}  # measure it with weights\n"),
    };
    if let Some(most) = scale.tare_max_n {
        text += &format!("tare_max_n = {most:.3}  # taxels at rest differ\n");
    }
    if let Some(threshold) = scale.contact_threshold_n {
        text += &format!(
            "\n[press]\ncontact_threshold_n = {threshold:.3}  # counts at rest vary by {}, which is no touch\n",
            scale.noise_counts
        );
    }
    text
}

fn read(path: &Path) -> Result<Capture, Failure> {
    let unreadable = cannot_read(path);
    let (kind, file) = FileKind::read(super::open(path)?).map_err(&unreadable)?;
    let mut captured = Capture::default();
    if kind == FileKind::Recording {
        // If there are several sensors, take the bytes of the first.
        let mut sensor = None;
        for found in Reader::new(BufReader::new(file)) {
            let found = found.of(path.display(), FAILED)?;
            if let Entry::Input(Input::Bytes(more)) = found.entry
                && *sensor.get_or_insert(found.sensor.clone()) == found.sensor
            {
                captured.take(&more, found.at.mono.as_secs_f64());
            }
            if captured.bytes.len() >= MOST_BYTES {
                break;
            }
        }
        return Ok(captured);
    }
    let read = file
        .take(MOST_BYTES as u64)
        .read_to_end(&mut captured.bytes);
    read.map_err(unreadable)?;
    Ok(captured)
}

/// After this silence another sender of datagrams is taken.
const STALE_AFTER: Duration = Duration::from_secs(1);

/// The bytes that come from the port in `seconds`. Fewer if the port is lost.
async fn listen(port: &Port, baud: u32, seconds: f64) -> Result<Capture, Failure> {
    let settings = serial::Settings {
        stale_after: STALE_AFTER,
        start: Vec::new(),
        request: None,
        on_the_line: Duration::ZERO,
        bytes_at_once: usize::MAX,
        bytes_per_s: f64::INFINITY,
    };
    let errors_before = framing_errors(port);
    let mut source = serial::open(port, baud, &[settings]).remove(0);
    let mut captured = Capture::default();
    let mut lost = None;
    let begin = Instant::now();
    // If the duration is too long to count, listening ends when the port is lost or enough bytes
    // have come.
    let listened = Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX);
    let _ = tokio::time::timeout(listened, async {
        while captured.bytes.len() < MOST_BYTES {
            match source.next().await {
                Input::Opened => {
                    let port = escaped(&port.to_string());
                    stderr_line!("listening at {port} for {seconds} s: press the sensor");
                }
                Input::Bytes(read) => captured.take(&read, begin.elapsed().as_secs_f64()),
                Input::Unavailable(reason) | Input::Lost(reason) => {
                    lost = Some(reason);
                    return;
                }
                _ => {}
            }
        }
    })
    .await;
    let errors = framing_errors(port).zip(errors_before);
    let errors = errors.map_or(0, |(after, before)| after.saturating_sub(before));
    if errors > captured.bytes.len() as u64 / FRAMED_BYTES {
        let port = escaped(&port.to_string());
        stderr_line!("{port}: {errors} framing errors: try another --baud");
    }
    match lost {
        Some(reason) if captured.bytes.is_empty() => {
            let reason = doctor::obstacle(port).unwrap_or(reason);
            Err(Failure::new(UNAVAILABLE, format!("{port}: {reason}")))
        }
        _ => Ok(captured),
    }
}

/// More framing errors than one in so many bytes mean another baud rate. Opening the port within a byte may give
/// one.
const FRAMED_BYTES: u64 = 100;

/// The framing errors of `port` since the system started, if they are shown.
fn framing_errors(port: &Port) -> Option<u64> {
    let device = fs::metadata(port.device()?).ok()?;
    framing::errors(Path::new("/"), device.rdev())
}

/// Shows the strongest press as an array would have it.
fn show(ranked: &Ranked) {
    stderr_line!("{}:", ranked.options());
    for line in draw(&ranked.picture, ranked.array.cols) {
        stderr_line!("    |{line}|");
    }
}

/// The most characters of a drawing, down and across.
const DRAWN: (usize, usize) = (16, 32);

/// A small picture for a terminal, a line for each row. Large arrays are drawn coarser.
fn draw(cells: &[f32], cols: usize) -> Vec<String> {
    let rows = cells.len() / cols;
    let step = rows.div_ceil(DRAWN.0).max(cols.div_ceil(DRAWN.1)).max(1);
    let highest = |most: f32, value: &f32| most.max(value.abs());
    let most = cells.iter().fold(f32::MIN_POSITIVE, highest);
    let shade = |row: usize, col: usize| {
        let near = (row..rows.min(row + step))
            .flat_map(|row| (col..cols.min(col + step)).map(move |col| &cells[row * cols + col]));
        let shades = b" .:-=+*#%@";
        let value = near.fold(0.0, highest);
        char::from(shades[((value / most * 9.0).round() as usize).min(9)])
    };
    (0..rows)
        .step_by(step)
        .map(|row| (0..cols).step_by(step).map(|col| shade(row, col)).collect())
        .collect()
}

fn toml(path: &Path, bytes: usize, found: &Found, proposal: &Proposal) -> String {
    let mut toml = String::new();
    let mut remark =
        |words: &str| writeln!(toml, "# {}", escaped(words)).expect("a string takes it all");
    let Found { best, next, .. } = found;
    remark(&format!("{}: {bytes} bytes", path.display()));
    remark(&format!(
        "explained: {:.1} % of the bytes, {} whole frames, {} damaged",
        100.0 * proposal.share,
        proposal.frames,
        proposal.frames_damaged
    ));
    remark(&match (next, found.lead_bits()) {
        (Some(next), Some(lead)) => format!(
            "{}: its picture is {} times as likely as the next, {}",
            array_in_words(best),
            lead.exp2().min(1e6).round(),
            array_in_words(next)
        ),
        _ if best.picture.is_empty() => {
            format!("{}: its frames themselves say so", array_in_words(best))
        }
        _ => format!("{}: no other array makes a picture", array_in_words(best)),
    });
    for words in &proposal.remarks {
        remark(words);
    }
    remark(
        "bytes do not show mask, invert and column-major order, nor which side of the sensor is up",
    );
    toml + "[sensor.frame]\n" + &proposal.toml()
}

fn array_in_words(ranked: &Ranked) -> String {
    let array = ranked.array;
    let order = match ranked.order {
        Order::RowMajor => String::new(),
        other => format!(" {}", name(&other)),
    };
    match ranked.cell {
        Some(cell) => format!("{array}{order} {}", name(&cell)),
        None => format!("{array} decimals"),
    }
}

#[cfg(test)]
mod tests {
    use super::usual;

    #[test]
    fn a_rate_within_three_per_cent_of_a_usual_one_is_that_one() {
        for (counted, expected) in [
            (49.0, 50.0),
            (5.1, 5.0),
            (123.0, 125.0),
            (46.0, 46.0),
            (97.0, 100.0),
        ] {
            assert_eq!(usual(counted), expected);
        }
    }
}
