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
use futures_util::FutureExt as _;
use serde_json::Value;
use tokio::sync::oneshot;
use tokio::time::{Instant, timeout};

use self::account::Account;
pub(super) use self::place::sockets;
use self::place::{SOCKET, place};
use super::configuration::ModelFile;
use super::connect::{Address, Connection};
use super::exit::{Fail, Failure, IO};
use super::faults::Faults;
use super::player::{self, Player};
use super::robot;
use crate::daemon::Daemon;
use crate::daemon::config::{Config, Http, Setup};
use crate::daemon::port::BITS_A_BYTE;
use crate::thread::spawn_thread;
use hardnessd_core::motion;
use hardnessd_core::sensor;
use hardnessd_core::stderr_line;
use hardnessd_core::wire::Layout;
use hardnessd_core::wording::within;
use hardnessd_simulator::{ARM_N_PER_MM, SequenceSettings};

/// What `--help` says below the options.
const MORE: &str = "\
    The presses are of four materials in turn, then of four random ones, and so on, with 5 to 25 N. On a \
    terminal, stdout has one line per press: what was pressed, what a durometer reads on it, the verdict, \
    whether its level is right, force and notes. Elsewhere it has the events as JSON lines. stderr has the \
    address of the live page and the socket, which `tail` and `watch` find by themselves.";

/// Arguments of `demo`.
#[derive(Debug, Clone, ClapArgs)]
#[command(after_help = MORE)]
pub struct Args {
    /// End after the final verdicts of N presses [default: go on until Ctrl-C]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    presses: Option<u32>,
    /// Seed of everything random
    #[arg(long, value_name = "S", default_value_t = SEED)]
    seed: u64,
    /// Address of the live page; port 0 takes a free one
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:0")]
    http: SocketAddr,
    /// Play X times as fast, 0.01 to 100
    // Above 100, less than 2 ms would remain between frames, which a busy machine's timers cannot keep.
    #[arg(long, value_name = "X", default_value_t = 1.0, value_parser = within(0.01, 100.0))]
    speed: f64,
    /// Print events as JSON lines on a terminal too
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    model: ModelFile,
}

/// The first four presses of this seed show each kind of answer, and none is near another.
const SEED: u64 = 2;

/// Runs until the presses have their verdicts, `shutdown` comes or nobody reads stdout.
///
/// # Errors
///
/// Returns a [`Failure`] if the daemon, the pty, the socket or stdout fails.
pub async fn run(args: Args, shutdown: impl Future<Output = ()>) -> Result<(), Failure> {
    let place = place().of("directory for socket and port", IO)?;
    let [port, socket] = ["port", SOCKET].map(|name| place.path().join(name));
    let mut sensor = sensor::Settings {
        name: "demo".to_owned(),
        ..sensor::Settings::new(port.clone())
    };
    let layout = Layout::new(&sensor.frame).expect("the default layout can be used");
    let line_s = layout.max_frame_bytes() as f64 * BITS_A_BYTE / f64::from(sensor.baud);
    sensor.arm = motion::Settings {
        stiffness_n_per_mm: Some(ARM_N_PER_MM),
        // A frame's stamp is the time of its last byte. The arm's stamp is the time of its
        // movement.
        delay_ms: (1e3 * line_s / args.speed).min(1e3),
        ..motion::Settings::default()
    };
    let sequence = SequenceSettings {
        seed: args.seed,
        frame_rate_hz: sensor.frame_rate_hz,
        presses: args.presses,
        has_random: true,
        ..SequenceSettings::default()
    };
    let is_json = args.json || !io::stdout().is_terminal();
    let account = (!is_json).then(|| Account::new(&sequence));
    let (frame_rate_hz, baud) = (sensor.frame_rate_hz, sensor.baud);
    let player = Player::new(
        Some(&port),
        layout,
        Faults::none(),
        frame_rate_hz,
        baud,
        args.speed,
    );
    let player = player.of("pty", IO)?;

    // The times of a press get shorter as its frames come faster.
    sensor.frame_rate_hz *= args.speed;
    let mut config = Config::new(vec![sensor]);
    config.press.early_settle_s /= args.speed;
    config.press.max_seconds /= args.speed;
    config.publish.unix.path = Some(socket.clone());
    config.http = Some(Http {
        listen: args.http,
        set_context: true,
    });
    let control = config.publish.unix.control_path();
    let (config, path) = (
        config.with_model(args.model.path()?.as_deref()),
        Path::new("demo"),
    );
    let daemon = Daemon::start(Setup::of(config, path)?.checked(path)?)?;
    if let Some(address) = daemon.http_address() {
        stderr_line!("live page: http://{address}/ (Ctrl-C ends the demonstration)");
    }
    let listen = "`hardnessd watch` and `hardnessd tail` find it";
    stderr_line!("socket: {} ({listen})", socket.display());
    let subscriber = Connection::open(&Address::Unix(socket))?;
    let print = move || print_events(subscriber, args.presses, account);
    let mut printed = spawn_thread("events", print)?;
    let start = Instant::now();
    robot::start(control, player.position(start))?;
    let frames = player::sequence(sequence)?;
    // When it is dropped, the daemon stops.
    let (stop, stopped) = oneshot::channel::<()>();
    let daemon = daemon.run(stopped.map(drop), None);
    let play = async {
        player.play(frames, start).await.of("pty", IO)?;
        // The loss of the port ends what is printed, unless a busy machine's daemon has never had the port.
        tokio::time::sleep(LOSS).await;
        Ok::<_, Failure>(None)
    };
    let playing = async {
        let _stop = stop;
        tokio::select! {
            () = shutdown => Ok(None),
            printed = &mut printed => Ok(Some(printed)),
            failed = play => failed,
        }
    };
    let (served, played) = tokio::join!(daemon, playing);
    let printed = match played? {
        Some(printed) => Ok(printed),
        // The daemon has closed the connection. A blocked terminal does not hold the demonstration up.
        None => timeout(LAST_LINE, printed).await,
    };
    if let Ok(printed) = printed {
        printed.expect("events are printed without a panic")?;
    }
    Ok(served?)
}

/// How long the daemon may take to say that the port is gone.
const LOSS: Duration = Duration::from_secs(5);
/// How long a terminal may take for the last line.
const LAST_LINE: Duration = Duration::from_millis(500);

/// Prints events until all presses have their final verdicts, the port goes after the last press, or the daemon ends:
/// all events as they come, or the lines of an account.
fn print_events(
    mut daemon: Connection,
    presses: Option<u32>,
    mut account: Option<Account>,
) -> Result<(), Failure> {
    let mut finals = 0;
    // If the daemon has failed, it says so itself.
    while let Ok(line) = daemon.next() {
        let event: Value = serde_json::from_str(&line).unwrap_or_default();
        finals += u32::from(event["phase"] == "final");
        let text = match &mut account {
            Some(account) => account.line(&event),
            None => Some(line),
        };
        if let Some(text) = text
            && !super::print((text + "\n").as_bytes())?
        {
            return Ok(());
        }
        let is_over = event["state"] == "lost" && event["type"] == "status";
        if Some(finals) == presses || is_over {
            break;
        }
    }
    if let Some(account) = account {
        super::print((account.close() + "\n").as_bytes())?;
    }
    Ok(())
}
