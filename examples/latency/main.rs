//! Measures byte in to event out: from the write of a frame's last byte on a pty to its event at a
//! client.
//!
//!     cargo build --release && cargo run --release --example latency -- --seconds 60
//!
//! It plays sensors to a daemon of its own and reads with as many clients as you ask for. It prints
//! percentiles, the number of lost events, and the daemon's processor time and memory. `--server
//! gpsd` does the same with gpsd and NMEA sentences. Start the example with `chrt --rr 20`, so that a
//! busy machine delays the daemon and not the measurement.

mod clients;
#[path = "../../src/tools/pty/pair.rs"]
mod pair;
mod sensors;
mod server;

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

use clap::{Parser, ValueEnum};
use rustix::process::{Resource, Rlimit};
use sensors::Sensors;
use server::Server;

type Failure = Box<dyn std::error::Error + Send + Sync>;

/// The time for which everything runs before the measurement begins.
const WARM: Duration = Duration::from_secs(2);
/// How long the server may take to start, to open the sensors, and to answer a client.
const PATIENCE: Duration = Duration::from_secs(30);

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
    /// Over TCP, and not a Unix socket; always with gpsd
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
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Kind {
    Hardnessd,
    Gpsd,
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
    match measure(&Args::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("latency: {error}");
            ExitCode::FAILURE
        }
    }
}

fn measure(args: &Args) -> Result<(), Failure> {
    // Each sensor needs two descriptors and each client one, more than most systems allow at first.
    let limit = rustix::process::getrlimit(Resource::Nofile);
    let raised = Rlimit {
        current: limit.maximum,
        ..limit
    };
    let _ = rustix::process::setrlimit(Resource::Nofile, raised);
    let length = WARM + Duration::from_secs_f64(args.seconds);
    let sensors = Sensors::plug(args, length)?;
    let devices = sensors.devices();
    let server = Server::start(args, &devices)?;
    let (received, sent) = (
        Arc::new(clients::Received::default()),
        Arc::clone(&sensors.sent),
    );
    let listeners = thread::spawn({
        let (args, place) = (args.clone(), server.place.clone());
        let (sent, received) = (Arc::clone(&sent), Arc::clone(&received));
        move || clients::listen(&args, &place, &sent, &received)
    });
    wait("answer all clients", || received.ready() == args.clients)?;
    wait("open the sensors", || server.has_opened(&devices))?;
    sleep(Duration::from_millis(500));
    let player = thread::spawn(move || sensors.play(length));
    sleep(WARM);
    received.begin();
    let (before, start) = (server.processor_time()?, Instant::now());
    // The sensors stay plugged in until all events are read.
    let (_sensors, late) = player.join().map_err(|_| "the sensors stopped")??;
    let taken = start.elapsed();
    let busy = server.processor_time()?.saturating_sub(before);
    // Wait for the last events, which are on their way.
    sleep(Duration::from_millis(300));
    let memory = server.anonymous_kb()?;
    drop(server);
    let problem = listeners.join().map_err(|_| "the clients stopped")?;
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
    problem.map_or(Ok(()), |problem| Err(problem.into()))
}

/// Waits until the server has done something.
fn wait(what: &str, is_done: impl Fn() -> bool) -> Result<(), Failure> {
    let start = Instant::now();
    while !is_done() {
        if start.elapsed() > PATIENCE {
            return Err(format!("the server does not {what}").into());
        }
        sleep(Duration::from_millis(5));
    }
    Ok(())
}
