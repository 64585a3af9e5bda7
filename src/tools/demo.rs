//! `hardnessd demo`: a simulated JX255N on a pty, the whole daemon on it, and a subscriber that
//! prints what it receives.
//!
//! Nothing is short-circuited: bytes go through the tty, events through the socket. On a terminal,
//! stdout shows one line for each press, with the pressed material beside the verdict, and a count
//! at the end. Elsewhere, stdout gets the lines that a subscriber reads, `hello` first. Stderr
//! names the live page and the socket.

mod account;
mod place;

use std::future::Future;
use std::io::{self, IsTerminal};
use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use clap::Args as ClapArgs;
use serde_json::Value;
use tokio::io::{AsyncBufReadExt, BufReader};
use tokio::net::UnixStream;
use tokio::sync::oneshot;
use tokio::time::Instant;

use self::account::Account;
use self::place::Place;
pub(super) use self::place::sockets;
use super::Stdout;
use super::configuration::ModelFile;
use super::exit::Failure;
use super::faults::Faults;
use super::player::{self, Pace, Player};
use super::robot::Robot;
use super::simulate::{OutOfRange, within};
use crate::daemon::Daemon;
use crate::daemon::baud::BITS_A_BYTE;
use crate::daemon::config::{Config, Http, SensorTable, Setup};
use crate::maybe;
use hardnessd_core::exit::{Coded, FAILED, IO};
use hardnessd_core::motion;
use hardnessd_core::wire::Layout;
use hardnessd_simulator::{ARM_N_PER_MM, SequenceSettings};

/// What `--help` says below the options.
const MORE: &str = "\
    The presses are of four materials in turn, with 5 to 25 N. On a terminal, stdout has one \
    line per press; elsewhere it has the events as JSON lines. stderr has the address of the \
    live page and the socket, which `tail` and `watch` find by themselves.";

/// Arguments of `demo`.
#[derive(Debug, Clone, ClapArgs)]
#[command(after_help = MORE)]
pub struct Args {
    /// End after the final verdicts of N presses [default: no limit]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    presses: Option<u32>,
    /// Seed of everything random
    #[arg(long, value_name = "S", default_value_t = SEED)]
    seed: u64,
    /// Address of the live page; port 0 takes a free one
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:0")]
    http: SocketAddr,
    /// Play X times as fast, 0.01 to 100
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = speed)]
    speed: f64,
    /// Print events as JSON lines on a terminal too
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    model: ModelFile,
}

/// The reason why the demonstration failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The pty or the socket failed.
    #[error("{what}: {source}")]
    Io {
        /// The part that failed, such as the pty.
        what: &'static str,
        /// The system's error.
        source: io::Error,
    },
    /// Some presses got no verdict.
    #[error("only {found} of {presses} presses got a verdict")]
    Missed {
        /// The number of verdicts.
        found: u32,
        /// The number of presses.
        presses: u32,
    },
    /// The daemon closed the connection.
    #[error("the daemon closed the connection")]
    Closed,
}

impl Coded for Error {
    fn exit_code(&self) -> u8 {
        match self {
            Error::Missed { .. } | Error::Closed => FAILED,
            Error::Io { .. } => IO,
        }
    }
}

/// The first four presses of this seed show each kind of answer, and none is near another.
const SEED: u64 = 2;

/// The longest time from the last byte to the last verdict.
const PATIENCE: Duration = Duration::from_secs(3);

/// Runs until the presses have their verdicts, `shutdown` comes or nobody reads stdout.
///
/// # Errors
///
/// Returns a [`Failure`] if the daemon, the pty, the socket or stdout fails, or a press gets no
/// verdict.
pub async fn run(args: Args, shutdown: impl Future<Output = ()>) -> Result<(), Failure> {
    let io = |what| move |source| Error::Io { what, source };
    let place = Place::new().map_err(io("directory for socket and port"))?;
    let port = place.port();
    let mut sensor = SensorTable {
        name: "demo".to_owned(),
        ..SensorTable::new(port.clone())
    };
    let layout = Layout::new(&sensor.frame).expect("the default layout can be used");
    let line_s = layout.max_frame_bytes() as f64 * BITS_A_BYTE / f64::from(sensor.baud.get());
    sensor.arm = motion::Settings {
        stiffness_n_per_mm: Some(ARM_N_PER_MM),
        // A frame's stamp is the time of its last byte. The arm's stamp is the time of its
        // movement.
        delay_ms: (1e3 * line_s / args.speed).min(1e3),
        ..motion::Settings::default()
    };
    let pace = Pace::new(sensor.frame_rate_hz, sensor.baud.get(), args.speed);
    let sequence = SequenceSettings {
        seed: args.seed,
        frame_rate_hz: sensor.frame_rate_hz,
        presses: args.presses,
        ..SequenceSettings::default()
    };
    let shown = if args.json || !io::stdout().is_terminal() {
        Shown::Json
    } else {
        Shown::Lines(Account::new(&sequence.materials))
    };
    let player = Player::new(Some(&port), layout, pace, Faults::none()).map_err(io("pty"))?;

    let socket = place.socket();
    let mut config = hastened(sensor, &socket, args.speed);
    config.http = Some(Http { listen: args.http });
    let robot = Robot {
        socket: config.publish.unix.control_path(),
        sensor: None,
        position: Box::new(player.position()),
    };
    let daemon = Daemon::bind(Setup::of(
        config.with_model(args.model.path()?.as_deref()),
        Path::new("demo"),
    )?)?;
    if let Some(address) = daemon.http_address() {
        hardnessd_core::stderr_line!("live page: http://{address}/");
    }
    let listen = "`hardnessd watch` and `hardnessd tail` find it";
    hardnessd_core::stderr_line!("socket: {} ({listen})", socket.display());
    let subscriber = UnixStream::connect(&socket).await.map_err(io("socket"))?;
    let (stop, stopped) = oneshot::channel::<()>();
    let daemon = daemon.run(
        async {
            // Dropping the sender has the same effect as sending.
            let _ = stopped.await;
        },
        None,
    );
    let printing = async {
        let printed = print(subscriber, args.presses, player, sequence, shown, shutdown);
        let printed = tokio::select! {
            printed = printed => printed,
            () = robot.run() => Ok(()),
        };
        let _ = stop.send(());
        printed
    };
    let (served, printed) = tokio::join!(daemon, printing);
    printed?;
    Ok(served?)
}

/// Parses `--speed`. Above 100, less than 2 ms would remain between frames, which a busy machine's
/// timers cannot keep.
fn speed(text: &str) -> Result<f64, OutOfRange> {
    within(text, 0.01, 100.0)
}

/// The default configuration for a sensor that plays `speed` times as fast: the times of a press
/// are divided by `speed`.
fn hastened(sensor: SensorTable, socket: &Path, speed: f64) -> Config {
    let frame_rate_hz = sensor.frame_rate_hz * speed;
    let mut config = Config::new(vec![SensorTable {
        frame_rate_hz,
        ..sensor
    }]);
    config.press.early_settle_s /= speed;
    config.press.max_seconds /= speed;
    config.publish.unix = config.publish.unix.at(socket.to_owned());
    config
}

/// The output on stdout.
enum Shown {
    /// Every event as it comes.
    Json,
    /// One line for each press.
    Lines(Account),
}

impl Shown {
    /// The text for an event, with its newline. Empty if the event has no text.
    fn of(&mut self, line: Vec<u8>, event: &Value) -> Vec<u8> {
        match self {
            Self::Json => line,
            Self::Lines(account) => account
                .line(event)
                .map_or_else(Vec::new, |line| (line + "\n").into_bytes()),
        }
    }
}

/// How long a terminal may take for the last line.
const LAST_LINE: Duration = Duration::from_millis(500);

/// Prints what the subscriber receives while the sensor plays, and the count at the end.
async fn print(
    subscriber: UnixStream,
    presses: Option<u32>,
    player: Player,
    sequence: SequenceSettings,
    mut shown: Shown,
    shutdown: impl Future<Output = ()>,
) -> Result<(), Failure> {
    let printed = print_events(subscriber, presses, player, sequence, &mut shown, shutdown).await;
    if let Shown::Lines(account) = &shown {
        let last = super::print_apart((account.close() + "\n").into_bytes());
        // A blocked terminal does not hold the demonstration up.
        let _ = tokio::time::timeout(LAST_LINE, last).await;
    }
    printed
}

async fn print_events(
    subscriber: UnixStream,
    presses: Option<u32>,
    player: Player,
    sequence: SequenceSettings,
    shown: &mut Shown,
    shutdown: impl Future<Output = ()>,
) -> Result<(), Failure> {
    let io = |what| move |source| Error::Io { what, source };
    let mut lines = BufReader::new(subscriber);
    let mut line = Vec::new();
    let mut finals = 0;
    // Whether a slow reader missed events. Verdicts may be among them.
    let mut missed = false;
    let frames = player::sequence(sequence)?;
    let mut played = std::pin::pin!(player.play(frames, Instant::now()));
    let mut shutdown = std::pin::pin!(shutdown);
    let mut last_byte: Option<Instant> = None;
    // The line that is being written. The sensor and the daemon do not wait for the reader of
    // stdout.
    let mut printing = std::pin::pin!(None);
    loop {
        let patience = last_byte.map(|at| at + PATIENCE);
        tokio::select! {
            // Read the lines that have arrived before checking for a timeout.
            biased;
            () = &mut shutdown => return Ok(()),
            printed = maybe::wait(printing.as_mut().as_pin_mut()) => {
                printing.set(None);
                let printed: Result<bool, Stdout> = printed;
                if !printed? || Some(finals) == presses {
                    return Ok(());
                }
            }
            read = lines.read_until(b'\n', &mut line), if printing.is_none() => {
                if read.map_err(io("socket"))? == 0 {
                    return Err(Error::Closed.into());
                }
                let event = serde_json::from_slice(&line).unwrap_or_default();
                finals += u32::from(is_final(&event));
                missed |= event["type"] == "gap";
                let text = shown.of(std::mem::take(&mut line), &event);
                if !text.is_empty() {
                    printing.set(Some(super::print_apart(text)));
                }
            }
            ended = &mut played, if last_byte.is_none() => {
                ended.map_err(io("pty"))?;
                last_byte = Some(Instant::now());
            }
            () = maybe::until(patience), if printing.is_none() => {
                if missed {
                    return Ok(());
                }
                let presses = presses.unwrap_or(0);
                return Err(Error::Missed { found: finals, presses }.into());
            }
        }
    }
}

fn is_final(event: &Value) -> bool {
    event["type"] == "hardness" && event["phase"] == "final"
}
