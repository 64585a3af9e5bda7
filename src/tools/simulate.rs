//! `hardnessd simulate`: simulates only the sensor, on a pty or into a file of raw bytes.

use std::fs::File;
use std::future::Future;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;
use tokio::time::Instant;

use super::exit::{Fail, Failure, IO, USAGE};
use super::faults::{self, Faults, Line};
use super::player::{self, Player};
use super::robot;
use crate::daemon::config::Unix;
use crate::daemon::port::BITS_A_BYTE;
use crate::thread;
use hardnessd_core::part::Part;
use hardnessd_core::sensor::DEFAULT_FRAME_RATE_HZ;
use hardnessd_core::verdict::Piece;
use hardnessd_core::wire::{Layout, Preset, Settings as Frame};
use hardnessd_core::wording::{named, positive, within};
use hardnessd_simulator::{Material, Sequence, SequenceSettings};

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
    // A press is computed as a whole, with as many frames as it takes to reach its force. At a rate beyond any
    // sensor's, they would fill the memory.
    #[arg(long, value_name = "F", default_value_t = DEFAULT_FRAME_RATE_HZ, value_parser = within(0.1, 1000.0))]
    fps: f64,
    /// Material to press: wood, rubber, plasticine, sponge, hard-plastic, foam, soft-candy, yoga-mat; repeat the
    /// option for several in turn [default: all eight]
    #[arg(long = "material", value_name = "M", value_parser = named::<Material>)]
    materials: Vec<Material>,
    /// Rigid piece to press in place of the materials, for `identify`: flat:MM (its width) or ball:MM (its radius),
    /// 1 to 100 mm
    #[arg(long, value_name = "PIECE", conflicts_with = "materials", value_parser = piece)]
    piece: Option<Piece>,
    /// Peak force of a press in newtons, 0.01 to 200; repeat the option for several in turn [default:
    /// random, 5 to 25]
    // For the same reason: the softest material takes minutes to bear 1,000 N, and the sensor shows no more than 10 N
    // a taxel.
    #[arg(long = "force", value_name = "N", value_parser = within(0.01, 200.0))]
    forces: Vec<f64>,
    /// Seed of everything random
    #[arg(long, value_name = "S", default_value_t = 1)]
    seed: u64,
    /// End after N presses [default: no limit]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    presses: Option<u32>,
    /// Play X times as fast, 0.000001 to 1000000000
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = positive)]
    speed: f64,
    /// Bits per second on the line [default: 115200, or the first usual rate that carries the frames]
    #[arg(long, value_name = "B", value_parser = clap::value_parser!(u32).range(1..))]
    baud: Option<u32>,
    /// Control socket of a daemon, to which a simulated robot sends the positions of its first sensor's arm, 100 a
    /// second. Without SOCKET, the one that a daemon started here has by default
    #[arg(long, value_name = "SOCKET", conflicts_with = "to")]
    motion: Option<Option<PathBuf>>,
    /// Script of faults; `--help` shows its format
    #[arg(long, value_name = "FILE")]
    faults: Option<PathBuf>,
}

impl Args {
    /// Whether it ends once a file has all presses.
    pub fn is_for_file(&self) -> bool {
        self.to.is_some()
    }
}

/// Plays until the presses are over or `shutdown` comes.
///
/// # Errors
///
/// Returns a [`Failure`] if the arguments do not fit together, or the pty or a file fails.
pub async fn run(args: Args, shutdown: impl Future<Output = ()>) -> Result<(), Failure> {
    tokio::select! {
        played = play(args) => played,
        () = shutdown => Ok(()),
    }
}

async fn play(args: Args) -> Result<(), Failure> {
    let layout = Layout::new(&Frame {
        preset: Some(args.preset),
        ..Frame::default()
    })
    .of("--preset", USAGE)?;
    let (script, seed) = (args.faults.clone(), args.seed);
    // The script may be a pipe without a writer.
    let faults = thread::run("faults", move || {
        let faults = script.map(|path| Faults::load(&path, seed));
        faults.unwrap_or_else(|| Ok(Faults::none()))
    });
    let faults = faults.await??;
    if let Some(path) = args.to.clone() {
        let (settings, shown) = (sequence(&args), path.clone());
        let work = move || record(&path, &layout, settings, faults);
        return thread::run("record", work).await?.of(shown.display(), IO);
    }
    let baud = baud(&args, &layout)?;
    let link = args.link.as_deref();
    let what = link.map_or("pty".to_owned(), |link| link.display().to_string());
    let player = Player::new(link, layout, faults, args.fps, baud, args.speed);
    let player = player.of(&what, IO)?;
    let line = format!("{}\n", player.path().display());
    let (frames, start) = (player::sequence(sequence(&args))?, Instant::now());
    if let Some(socket) = args.motion {
        let socket = socket.unwrap_or_else(|| Unix::default().control_path());
        robot::start(socket, player.position(start))?;
    }
    // It is no error if nobody reads the path, because the link shows it too.
    let printed = super::print_apart(line);
    let played = async { player.play(frames, start).await.of(&what, IO) };
    tokio::try_join!(printed, played).map(drop)
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
        piece: args.piece,
        ..SequenceSettings::default()
    }
}

/// A rigid piece of the command line.
fn piece(text: &str) -> Result<Piece, &'static str> {
    match Piece::rigid(text) {
        Some(piece @ (Piece::Flat { width_mm: mm } | Piece::Ball { radius_mm: mm }))
            if (1.0..=100.0).contains(&mm) =>
        {
            Ok(piece)
        }
        _ => Err("expected flat:MM or ball:MM with 1 to 100 mm"),
    }
}

/// Writes the bytes that a sensor sends, back to back and frame by frame, until the presses are over. While the
/// sensor is silent or unplugged it sends nothing. A file that exists is left alone, but a device or a pipe
/// is written to. If a write fails, the file is removed.
fn record(
    path: &Path,
    layout: &Layout,
    settings: SequenceSettings,
    mut faults: Faults,
) -> std::io::Result<()> {
    // A device takes the bytes as they come. A file is there once it is whole.
    let is_device = path.metadata().is_ok_and(|file| !file.is_file());
    let part = (!is_device).then(|| Part::new(path)).transpose()?;
    let file = match &part {
        Some(part) => part.as_file().try_clone()?,
        None => File::options().write(true).open(path)?,
    };
    let mut file = BufWriter::new(file);
    let frame_rate_hz = settings.frame_rate_hz;
    let mut bytes = Vec::with_capacity(layout.max_frame_bytes());
    for (index, frame) in (0_u32..).zip(Sequence::new(settings)) {
        let time_s = f64::from(index) / frame_rate_hz;
        if faults.encode(time_s, &frame.raw, layout, &mut bytes) == Line::Up {
            file.write_all(&bytes)?;
        }
    }
    file.flush()?;
    part.map_or(Ok(()), Part::finish)
}

/// The baud rate of the line: the given one, or the first usual one from 115,200 on that carries the
/// longest frames.
fn baud(args: &Args, layout: &Layout) -> Result<u32, Failure> {
    const USUAL: [u32; 7] = [
        115_200, 230_400, 460_800, 921_600, 1_000_000, 2_000_000, 4_000_000,
    ];
    let needed = |bytes: usize| (args.fps * bytes as f64 * BITS_A_BYTE).ceil() as u32;
    let shortest = layout.min_frame_bytes();
    let (least, most) = (needed(shortest), needed(layout.max_frame_bytes()));
    let usual = USUAL.into_iter().find(|&usual| usual >= most);
    match args.baud.or(usual).unwrap_or(most) {
        baud if baud >= least => Ok(baud),
        baud => {
            let expected = format!(
                "at least {least} for {} frames/s of {shortest} bytes",
                args.fps
            );
            let problem = format!("--baud: found {baud}, expected {expected}");
            Err(Failure::new(USAGE, problem))
        }
    }
}
