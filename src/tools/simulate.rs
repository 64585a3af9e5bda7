//! `hardnessd simulate`: simulates only the sensor, on a pty or into a file of raw bytes.

use std::fs::File;
use std::future::Future;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::pin::pin;
use std::sync::mpsc::{self, TryRecvError};
use std::time::Duration;

use clap::Args as ClapArgs;
use tokio::time::Instant;

use super::Stdout;
use super::arm::{self, Arm};
use super::exit::Failure;
use super::faults::{self, Faults, Line};
use super::player::{self, Pace, Player};
use super::robot::Robot;
use crate::apart;
use crate::daemon::baud::BITS_A_BYTE;
use crate::daemon::socket;
use crate::maybe;
use hardnessd_core::exit::{Coded, IO, USAGE};
use hardnessd_core::part;
use hardnessd_core::sensor::DEFAULT_FRAME_RATE_HZ;
use hardnessd_core::wire::{Layout, LayoutError, Preset, Settings as Frame};
use hardnessd_core::wording::named;
use hardnessd_simulator::{Material, REST_S, Reference, SensorProfile, Sequence, SequenceSettings};

/// Arguments of `simulate`.
#[derive(Debug, Clone, ClapArgs)]
#[command(after_long_help = faults::FORMAT)]
pub struct Args {
    /// Symbolic link to make to the pty, until the end; a link that leads nowhere is replaced
    #[arg(long, value_name = "PATH")]
    link: Option<PathBuf>,
    /// Write the sensor's raw bytes to this new file (or a device or a pipe) instead, as fast as possible
    #[arg(long, value_name = "FILE", conflicts_with_all = ["link", "speed", "baud"], requires = "presses")]
    to: Option<PathBuf>,
    /// Layout of a frame: a preset of the configuration
    #[arg(long, value_name = "P", default_value = "jx255n", value_parser = named::<Preset>)]
    preset: Preset,
    /// Frames per second, 0.1 to 1000
    #[arg(long, value_name = "F", default_value_t = DEFAULT_FRAME_RATE_HZ, value_parser = frame_rate_hz)]
    fps: f64,
    /// Material to press: wood, rubber, plasticine, sponge, hard-plastic, foam, soft-candy, yoga-mat; repeat the
    /// option for several in turn [default: all eight]
    #[arg(long = "material", value_name = "M", value_parser = named::<Material>)]
    materials: Vec<Material>,
    /// Rigid piece to press in place of the materials, for `identify`: flat:MM (its width) or ball:MM (its radius),
    /// 1 to 100 mm
    #[arg(long, value_name = "PIECE", conflicts_with_all = ["materials", "arm"], value_parser = piece)]
    piece: Option<Reference>,
    /// Peak force of a press in newtons, 0.01 to 200; repeat the option for several in turn [default:
    /// random, 5 to 25]
    #[arg(long = "force", value_name = "N", value_parser = force_n)]
    forces: Vec<f64>,
    /// How alike the taxels are: clean, as after a calibration, or raw, with a gain of their own each
    #[arg(long, value_name = "PROFILE", default_value = "clean", value_parser = named::<SensorProfile>)]
    sensor_profile: SensorProfile,
    /// Seed of everything random
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// End after N presses [default: no limit]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    presses: Option<u32>,
    /// Least rest before the first press (at least 2) and after each, in seconds, 1 to 3600
    #[arg(long, value_name = "S", default_value_t = REST_S, value_parser = rest_s)]
    rest: f64,
    /// Play X times as fast, 0.000001 to 1000000000
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = positive)]
    speed: f64,
    /// Bits per second on the line [default: 115200, or the first usual rate that carries the frames]
    #[arg(long, value_name = "B", value_parser = clap::value_parser!(u32).range(1..))]
    baud: Option<u32>,
    /// Control socket of a daemon, to which a simulated robot sends the positions of its arm, 100 a second
    #[arg(long, value_name = "SOCKET", conflicts_with = "to")]
    motion: Option<PathBuf>,
    /// The daemon's sensor on the arm [default: its first]
    #[arg(long, hide_short_help = true, value_name = "NAME", requires = "motion")]
    motion_sensor: Option<String>,
    /// Play no presses: move the arm as a controller says on this new Unix socket
    #[arg(long, value_name = "SOCKET", conflicts_with_all = ["to", "speed", "presses", "forces", "rest"])]
    arm: Option<PathBuf>,
    /// Script of faults; `--help` shows its format
    #[arg(long, value_name = "FILE")]
    faults: Option<PathBuf>,
}

/// The reason why the sensor cannot be simulated.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The layout needs more than a preset.
    #[error("--preset: {0}")]
    Layout(#[source] LayoutError),
    /// The frames have more bytes than the line carries.
    #[error(
        "--baud: found {baud}, expected at least {needed} to carry {fps} frames/s of {bytes} bytes"
    )]
    Baud {
        /// The baud rate of the line.
        baud: u32,
        /// The lowest baud rate that carries the frames.
        needed: u32,
        /// The frame rate in frames/s.
        fps: f64,
        /// The number of bytes in a frame.
        bytes: usize,
    },
    /// The recording cannot be written.
    #[error("{path}: {source}")]
    Recording {
        /// Path of the recording.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The arm's socket cannot be made.
    #[error(transparent)]
    Arm(socket::Error),
    /// The pty or its link failed.
    #[error("{what}: {source}")]
    Pty {
        /// The path of the link, or `pty` if there is no link.
        what: String,
        /// The system's error.
        source: std::io::Error,
    },
}

impl Coded for Error {
    fn exit_code(&self) -> u8 {
        match self {
            Error::Layout(_) | Error::Baud { .. } => USAGE,
            Error::Recording { .. } | Error::Pty { .. } | Error::Arm(_) => IO,
        }
    }
}

/// Plays until the presses are over or `shutdown` comes.
///
/// # Errors
///
/// Returns a [`Failure`] if the arguments do not fit together, or the pty or a file fails.
pub async fn run(args: Args, shutdown: impl Future<Output = ()>) -> Result<(), Failure> {
    let layout = Layout::new(&Frame {
        preset: args.preset,
        ..Frame::default()
    })
    .map_err(Error::Layout)?;
    let mut shutdown = pin!(shutdown);
    let faults = match args.faults.clone() {
        Some(path) => {
            // The script may be a pipe without a writer.
            let seed = args.seed;
            let loaded = apart::start("faults", move || Faults::load(&path, seed))?;
            tokio::select! {
                loaded = loaded => loaded.expect("a script is read without a panic")?,
                () = &mut shutdown => return Ok(()),
            }
        }
        None => Faults::none(),
    };
    if let Some(path) = args.to.clone() {
        let settings = sequence(&args);
        // This runs on another thread, so that a signal need not wait for the physics or a slow
        // disk.
        let to = path.clone();
        let (stop, stopped) = mpsc::channel();
        let work = move || record(&to, &layout, settings, faults, &stopped);
        let mut recorded = apart::start("record", work)?;
        let finished = tokio::select! {
            finished = &mut recorded => Some(finished),
            () = shutdown => {
                drop(stop);
                tokio::time::timeout(LAST_FRAME, recorded).await.ok()
            }
        };
        let written = finished.map(|finished| finished.expect("the simulation does not panic"));
        written
            .unwrap_or(Ok(()))
            .map_err(|source| Error::Recording { path, source })?;
        return Ok(());
    }
    let (baud, warning) = baud(&args, &layout)?;
    if let Some(warning) = warning {
        hardnessd_core::stderr_line!("{warning}");
    }
    let what = args
        .link
        .as_ref()
        .map_or("pty".to_owned(), |link| link.display().to_string());
    let failed = |source| Error::Pty {
        what: what.clone(),
        source,
    };
    let pace = Pace::new(args.fps, baud, args.speed);
    let player = Player::new(args.link.as_deref(), layout, pace, faults).map_err(failed)?;
    let line = format!("{}\n", player.path().display());
    let settings = sequence(&args);
    let arm = args.arm.as_deref().map(Arm::bind).transpose();
    let arm = arm.map_err(Error::Arm)?;
    let position: Box<dyn Fn(Instant) -> Option<f64>> = match &arm {
        Some(arm) => Box::new(arm.position()),
        None => Box::new(player.position()),
    };
    let robot = args.motion.map(|socket| Robot {
        socket,
        sensor: args.motion_sensor,
        position,
    });
    let robot = maybe::wait(robot.map(Robot::run));
    let start = Instant::now();
    let (frames, start) = match &arm {
        Some(arm) => (arm.frames(settings, start)?, start + arm::SCAN),
        None => (player::sequence(settings)?, start),
    };
    let serving = maybe::wait(arm.map(Arm::serve));
    let play = async {
        // It is no error if nobody reads the path, because the link shows it too.
        let printed = super::print_apart(line.into_bytes());
        let printed = async { printed.await.map_err(|Stdout(error)| error) };
        tokio::try_join!(printed, player.play(frames, start)).map(|_| ())
    };
    tokio::select! {
        played = play => Ok(played.map_err(failed)?),
        () = robot => Ok(()),
        () = serving => Ok(()),
        () = shutdown => Ok(()),
    }
}

fn sequence(args: &Args) -> SequenceSettings {
    SequenceSettings {
        seed: args.seed,
        frame_rate_hz: args.fps,
        materials: if args.materials.is_empty() {
            Material::ALL.to_vec()
        } else {
            args.materials.clone()
        },
        forces_n: args.forces.iter().map(|&force| force as f32).collect(),
        presses: args.presses,
        rest_s: args.rest,
        profile: args.sensor_profile,
        piece: args.piece,
        ..SequenceSettings::default()
    }
}

/// A rigid piece of the command line.
fn piece(text: &str) -> Result<Reference, String> {
    let expected = || "expected flat:MM or ball:MM with 1 to 100 mm".to_owned();
    let (kind, mm) = text.split_once(':').ok_or_else(expected)?;
    let mm: f32 = mm.parse().map_err(|_| expected())?;
    match kind {
        _ if !(1.0..=100.0).contains(&mm) => Err(expected()),
        "flat" => Ok(Reference::Flat { width_mm: mm }),
        "ball" => Ok(Reference::Ball { radius_mm: mm }),
        _ => Err(expected()),
    }
}

/// How long a signal waits for the frame that is being written.
const LAST_FRAME: Duration = Duration::from_millis(500);

/// Writes the bytes that a sensor sends, back to back, until the presses are over or the other end
/// of `stopped` is dropped. A file that exists is left alone, but a device or a pipe is written to.
/// If a write fails, the file is removed.
fn record(
    path: &Path,
    layout: &Layout,
    settings: SequenceSettings,
    faults: Faults,
    stopped: &mpsc::Receiver<()>,
) -> std::io::Result<()> {
    if path.metadata().is_ok_and(|file| !file.is_file()) {
        let device = File::options().write(true).open(path)?;
        return write(&device, layout, settings, faults, stopped);
    }
    let file = File::create_new(path)?;
    let written = write(&file, layout, settings, faults, stopped);
    if written.is_err() {
        part::remove(path, &file);
    }
    written
}

/// Writes frame by frame, so that the file holds what was played whenever the simulation is
/// stopped. While the sensor is silent or unplugged it sends nothing.
fn write(
    mut file: &File,
    layout: &Layout,
    settings: SequenceSettings,
    mut faults: Faults,
    stopped: &mpsc::Receiver<()>,
) -> std::io::Result<()> {
    let frame_rate_hz = settings.frame_rate_hz;
    let mut bytes = Vec::with_capacity(layout.max_frame_bytes());
    for (index, frame) in (0_u32..).zip(Sequence::new(settings)) {
        let time_s = f64::from(index) / frame_rate_hz;
        match faults.encode(time_s, frame.raw, layout, &mut bytes) {
            Line::Up | Line::AtOnce => file.write_all(&bytes)?,
            Line::Silent | Line::Unplugged => {}
        }
        // A process that ends during a write may leave a part of a frame.
        if stopped.try_recv() == Err(TryRecvError::Disconnected) {
            return Ok(());
        }
    }
    file.sync_all()
}

/// The baud rate of the line. A given rate must carry the shortest frames. Without one, it is the
/// first usual rate from 115,200 on that carries them. The text says that this rate is not 115,200,
/// or warns that longer frames may come late.
fn baud(args: &Args, layout: &Layout) -> Result<(u32, Option<String>), Error> {
    const USUAL: [u32; 7] = [
        115_200, 230_400, 460_800, 921_600, 1_000_000, 2_000_000, 4_000_000,
    ];
    let needed = |bytes: usize| (args.fps * bytes as f64 * BITS_A_BYTE).ceil() as u32;
    let short = |baud, bytes| Error::Baud {
        baud,
        needed: needed(bytes),
        fps: args.fps,
        bytes,
    };
    let (shortest, longest) = (layout.min_frame_bytes(), layout.max_frame_bytes());
    let least = needed(shortest);
    let baud = match args.baud {
        Some(baud) if baud < least => return Err(short(baud, shortest)),
        Some(baud) => baud,
        None => {
            let usual = USUAL.into_iter().find(|&usual| usual >= least);
            usual.unwrap_or(least)
        }
    };
    let warning = if baud < needed(longest) {
        Some(format!("warning: {}", short(baud, longest)))
    } else if args.baud.is_none() && baud != USUAL[0] {
        let (usual, fps) = (USUAL[0], args.fps);
        Some(format!(
            "{usual} baud cannot carry {fps} frames/s of {shortest} bytes: played at {baud}"
        ))
    } else {
        None
    };
    Ok((baud, warning))
}

/// Parses `--fps`. A press is computed as a whole, with as many frames as it takes to reach its
/// force. At a rate beyond any sensor's, they would fill the memory.
fn frame_rate_hz(text: &str) -> Result<f64, OutOfRange> {
    within(text, 0.1, 1000.0)
}

/// Parses `--force`, which is limited for the same reason as [`frame_rate_hz`]: the softest
/// material takes minutes to bear 1,000 N, and the sensor shows no more than 10 N a taxel.
fn force_n(text: &str) -> Result<f64, OutOfRange> {
    within(text, 0.01, 200.0)
}

/// Parses `--rest`.
fn rest_s(text: &str) -> Result<f64, OutOfRange> {
    within(text, REST_S, 3600.0)
}

/// The option's value is not a number, or is out of range.
#[derive(Debug, thiserror::Error)]
#[error("expected a number from {least} to {most}")]
pub(super) struct OutOfRange {
    least: f64,
    most: f64,
}

pub(super) fn within(text: &str, least: f64, most: f64) -> Result<f64, OutOfRange> {
    match text.parse::<f64>() {
        Ok(number) if (least..=most).contains(&number) => Ok(number),
        _ => Err(OutOfRange { least, most }),
    }
}

/// Parses a number above 0 that is so near to 1 that a clock can count seconds made of it.
pub(super) fn positive(text: &str) -> Result<f64, OutOfRange> {
    within(text, 1e-6, 1e9)
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        args: Args,
    }

    #[test]
    fn the_shortest_frame_chooses_the_rate_and_the_longest_one_warns() {
        // Texts of 784 values are 1,569 to 5,546 bytes, packed zeros 9 to 1,569.
        for (arguments, expected, message) in [
            ("", Some(115_200), ""),
            ("--fps 20", Some(230_400), "played at 230400"),
            ("--preset ascii", Some(115_200), "warning"),
            ("--preset ascii --fps 2", Some(115_200), ""),
            ("--preset ascii --baud 115200", Some(115_200), "of 5546"),
            ("--preset ascii --baud 78450", Some(78_450), "warning"),
            ("--preset ascii --baud 78449", None, "of 1569"),
            ("--preset ascii --fps 10", Some(230_400), "warning"),
            ("--preset zero-run --baud 9600", Some(9_600), "of 1569"),
            ("--baud 39499", None, "at least 39500"),
        ] {
            let words = ["simulate"].into_iter().chain(arguments.split_whitespace());
            let args = Line::try_parse_from(words).unwrap().args;
            let layout = Layout::new(&Frame {
                preset: args.preset,
                ..Frame::default()
            });
            let (found, warning) = match baud(&args, &layout.unwrap()) {
                Ok((found, warning)) => (Some(found), warning.unwrap_or_default()),
                Err(error) => (None, error.to_string()),
            };
            assert_eq!(found, expected, "{arguments}");
            assert_eq!(warning.is_empty(), message.is_empty(), "{warning}");
            assert!(warning.contains(message), "{message:?} not in {warning:?}");
        }
    }
}
