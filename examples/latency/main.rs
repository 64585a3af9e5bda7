//! Measures byte in to event out: from the write of a frame's last byte on a pty to its event at a
//! client.
//!
//!     cargo build --release && cargo run --release --example latency -- --seconds 60
//!
//! It plays sensors to a daemon of its own and reads with as many clients as you ask for. It prints
//! percentiles, the number of lost events, and the daemon's processor time and memory. `--server
//! gpsd` does the same with gpsd and NMEA sentences. `--server bare` uses a process that only
//! copies bytes, as the lower bound. Start the example with `chrt --rr 20`, so that a busy machine
//! delays the daemon and not the measurement.

mod clients;
#[path = "../../src/tools/pty/pair.rs"]
mod pair;
mod sensors;
mod server;

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::thread;
use std::time::{Duration, Instant};

use clap::{Parser, ValueEnum};
use rustix::process::{Resource, Rlimit};
use sensors::Sensors;
use server::Server;

type Failure = Box<dyn std::error::Error + Send + Sync>;

/// The time for which everything runs before the measurement begins.
const WARM: Duration = Duration::from_secs(2);

#[derive(Parser, Clone)]
struct Args {
    /// What is measured
    #[arg(long, value_enum, default_value_t = Kind::Hardnessd)]
    server: Kind,
    /// Path of hardnessd, for --server hardnessd
    #[arg(long, default_value = "target/release/hardnessd")]
    program: PathBuf,
    /// Sensors
    #[arg(long, default_value_t = 1)]
    sensors: usize,
    /// Rows and columns of each array, with hardnessd
    #[arg(long, default_value_t = 28)]
    side: usize,
    /// Frames a second of each
    #[arg(long, default_value_t = 100.0)]
    rate: f64,
    /// Clients, each with all events that are measured
    #[arg(long, default_value_t = 1)]
    clients: usize,
    /// What is measured
    #[arg(long, value_enum, default_value_t = What::Frame)]
    event: What,
    /// Over TCP, and not a Unix socket
    #[arg(long)]
    tcp: bool,
    /// How the server is scheduled
    #[arg(long, value_enum, default_value_t = Scheduling::Other)]
    scheduling: Scheduling,
    /// Seconds to measure, after 2 s to warm up
    #[arg(long, default_value_t = 60.0)]
    seconds: f64,
    /// More lines of the daemon's configuration
    #[arg(long, default_value = "")]
    configuration: String,
    /// Copy bytes from this device to a client; --server bare starts this program again with it
    #[arg(long, hide = true)]
    copy: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Kind {
    Hardnessd,
    Gpsd,
    Bare,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum What {
    /// Every frame
    Frame,
    /// The final verdict of every press
    Verdict,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Scheduling {
    /// Ordinary
    Other,
    /// As the shipped unit: rr, priority 10, ordinary threads
    Rr,
}

fn main() -> ExitCode {
    let args = Args::parse();
    let done = match &args.copy {
        Some(device) => server::copy(device, &args),
        None => measure(&args),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("latency: {error}");
            ExitCode::FAILURE
        }
    }
}

/// Raises the limit of descriptors: each sensor needs two and each client one, more than most
/// systems allow at first.
fn raise_descriptors() {
    let limit = rustix::process::getrlimit(Resource::Nofile);
    let raised = Rlimit {
        current: limit.maximum,
        ..limit
    };
    let _ = rustix::process::setrlimit(Resource::Nofile, raised);
}

fn measure(args: &Args) -> Result<(), Failure> {
    raise_descriptors();
    let length = WARM + Duration::from_secs_f64(args.seconds);
    let sensors = Sensors::plug(args, length)?;
    let server = Server::start(args, &sensors.devices())?;
    let (received, sent) = (Arc::new(clients::Received::default()), sensors.sent());
    let listeners = thread::spawn({
        let (args, place) = (args.clone(), server.place());
        let (sent, received) = (Arc::clone(&sent), Arc::clone(&received));
        move || clients::listen(&args, &place, &sent, &received)
    });
    clients::wait(&received, args.clients)?;
    server.opens(args.sensors)?;
    let player = thread::spawn(move || sensors.play(length));
    thread::sleep(WARM);
    received.begin();
    let (before, start) = (server.processor_time()?, Instant::now());
    // The sensors stay plugged in until all events are read.
    let (_sensors, late) = player.join().map_err(|_| "the sensors stopped")??;
    let taken = start.elapsed();
    let busy = server.processor_time()?.saturating_sub(before);
    // Wait for the last events, which are on their way.
    thread::sleep(Duration::from_millis(300));
    let memory = server.anonymous_kb()?;
    drop(server);
    let problems = listeners.join().map_err(|_| "the clients stopped")?;
    let figures = received.figures(args, &sent);
    let frames = args.sensors as f64 * args.rate * taken.as_secs_f64();
    println!(
        "{:?} sensors {} side {} rate {} clients {} {:?} scheduling {:?} s {:.0}: {figures}; \
         processor {:.1} us a frame, {:.1} % of a core; anonymous memory {memory} kB; \
         the sensors were at most {:.2} ms late",
        args.server,
        args.sensors,
        args.side,
        args.rate,
        args.clients,
        args.event,
        args.scheduling,
        taken.as_secs_f64(),
        busy.as_secs_f64() * 1e6 / frames,
        100.0 * busy.as_secs_f64() / taken.as_secs_f64(),
        late.as_secs_f64() * 1e3,
    );
    problems.map_or(Ok(()), |problem| Err(problem.into()))
}
