//! Plays sensors with faults to a daemon for a long time, and accounts for every press.
//!
//!     cargo build --release && cargo run --release --example soak -- --minutes 120
//!
//! Each sensor sends simulated presses over a pty, with a fault in every second press. Arrays are 28x28
//! to 64x64. There are subscribers of all kinds, recordings, and a reload every ten seconds. At the
//! end, every press must have its verdict, or must be lost with the link, by its number. Memory,
//! descriptors and threads must not have grown. Otherwise the exit code is 1.

mod account;
mod line;
mod listener;
#[path = "../../src/tools/pty/pair.rs"]
mod pair;
mod player;

use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

use account::{account, growth, usage};
use clap::Parser;
use hardnessd_core::recording::Reader;
use hardnessd_simulator::random::Stream;
use line::Line;
use listener::{Link, come_and_go, receive};
use player::{FAULTS, Player, library};
use rustix::process::{Pid, Signal, kill_process};

type Failure = Box<dyn std::error::Error + Send + Sync>;

const FRAMES_PER_S: f64 = 100.0;
const PERIOD: Duration = Duration::from_millis(10);
/// How long any action of the daemon may take.
const PATIENCE: Duration = Duration::from_secs(60);
/// The number of recordings that are kept.
const KEPT: usize = 16;

#[derive(Parser)]
struct Args {
    /// Minutes to play, at least 3
    #[arg(long, default_value_t = 120.0)]
    minutes: f64,
    /// Sensors
    #[arg(long, default_value_t = 8)]
    sensors: usize,
    /// Seed of the faults
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

fn main() -> ExitCode {
    let done = soak(&Args::parse());
    let problems = done.unwrap_or_else(|error| vec![error.to_string()]);
    for problem in &problems {
        eprintln!("soak: {problem}");
    }
    ExitCode::from(u8::from(!problems.is_empty()))
}

/// The sides of the arrays, in taxels, which the sensors have in turn.
const SIDES: [usize; 4] = [28, 28, 48, 64];

/// The `[[sensor]]` tables of the configuration.
fn tables(players: &[Player]) -> String {
    let mut text = String::new();
    for (index, player) in players.iter().enumerate() {
        let side = SIDES[index % SIDES.len()];
        let share = 28.0 / side as f64;
        let _ = write!(
            text,
            "[[sensor]]\nname = \"{}\"\nport = \"{}\"\nbaud = 3000000\n\
             frame_rate_hz = {FRAMES_PER_S:.1}\n",
            player.name,
            player.line.port.display()
        );
        let _ = write!(
            text,
            "[sensor.frame]\nrows = {side}\ncols = {side}\n[sensor.calibration]\n\
             newtons_per_count = {}\npitch_mm = {}\n",
            0.04 * share * share,
            3.5 * share
        );
    }
    text
}

fn configure(path: &Path, tables: &str, min_confidence: f64) -> io::Result<()> {
    let text = format!(
        "robot = \"soak\"\n{tables}[publish.unix]\npath = \"events.sock\"\n\
         [model]\nmin_confidence = {min_confidence}\n\
         [record]\ndir = \"rec\"\nrotate_s = 20\nkeep_free_mb = 0\n"
    );
    let born = path.with_extension("new");
    fs::write(&born, text)?;
    fs::rename(born, path)
}

/// All recordings, the oldest first.
fn recordings(directory: &Path) -> io::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(directory)? {
        let entry = entry?;
        found.push((entry.metadata()?.modified()?, entry.path()));
    }
    found.sort();
    Ok(found.into_iter().map(|(_, path)| path).collect())
}

fn soak(args: &Args) -> Result<Vec<String>, Failure> {
    if !(3.0..=100_000.0).contains(&args.minutes) || !(1..=100).contains(&args.sensors) {
        return Err("expected at least 3 minutes and 1 to 100 sensors".into());
    }
    let directory = tempfile::tempdir()?;
    let at = |name: &str| directory.path().join(name);
    let libraries = SIDES.map(|side| library(side).map(Arc::new));
    let root = Stream::new(args.seed, "soak");
    let links: Vec<Arc<Link>> = (0..args.sensors).map(|_| Arc::default()).collect();
    let mut players = Vec::new();
    for (index, link) in links.iter().enumerate() {
        let name = format!("s{index}");
        let library = libraries[index % SIDES.len()].as_ref();
        players.push(Player {
            line: Line::new(at(&name))?,
            name,
            library: Arc::clone(library.map_err(ToString::to_string)?),
            stream: root.child(index as u64),
            link: Arc::clone(link),
            sent: Vec::new(),
            faults: [0; FAULTS.len()],
            due: Instant::now(),
        });
    }
    let tables = tables(&players);
    let config = at("soak.toml");
    configure(&config, &tables, 0.0)?;
    // Examples are built into a folder beside the program.
    let mut daemon = Command::new(std::env::current_exe()?.with_file_name("../hardnessd"))
        .args(["run", "--config"])
        .arg(&config)
        .env("RUST_LOG", "warn")
        .stderr(File::create(at("log"))?)
        .stdin(Stdio::null())
        .spawn()?;
    let played = attend(args, &mut daemon, players, &links, (&config, &tables));
    // The daemon has already ended, unless something failed.
    let _ = daemon.kill();
    let _ = daemon.wait();
    let log = fs::read_to_string(at("log"))?;
    let mut problems = played.inspect_err(|_| eprintln!("{log}"))?;
    // Errors are above all those of refused reloads.
    let errors = log.lines().filter(|line| line.contains("ERROR"));
    problems.extend(errors.map(str::to_owned));
    let mut records = 0;
    for path in recordings(&at("rec"))? {
        for found in Reader::new(File::open(&path)?) {
            match found {
                Ok(_) => records += 1,
                Err(error) => problems.push(format!("{}: {error}", path.display())),
            }
        }
    }
    println!("recordings: the last {KEPT} have {records} whole entries");
    Ok(problems)
}

/// Plays to the daemon until its time is over, ends it, and returns the problems.
fn attend(
    args: &Args,
    daemon: &mut Child,
    players: Vec<Player>,
    links: &[Arc<Link>],
    (config, tables): (&Path, &str),
) -> Result<Vec<String>, Failure> {
    let pid = Pid::from_raw(i32::try_from(daemon.id())?).ok_or("no process")?;
    let socket = config.with_file_name("events.sock");
    let start = Instant::now();
    while UnixStream::connect(&socket).is_err() {
        if start.elapsed() > PATIENCE || daemon.try_wait()?.is_some() {
            return Err("the daemon does not start".into());
        }
        sleep(PERIOD);
    }

    // Subscribers that read everything until the daemon ends. The first one's links tell the players
    // about their sensors.
    let mut listening = Vec::new();
    for number in 0..17 {
        let links: Vec<Arc<Link>> = match number {
            0 => links.to_vec(),
            _ => links.iter().map(|_| Arc::default()).collect(),
        };
        let connection = UnixStream::connect(&socket)?;
        listening.push(thread::spawn(move || receive(connection, &links)));
    }
    // Subscribers that come and go, and one that never reads.
    let over = Arc::new(AtomicBool::new(false));
    let guests = [0, 1].map(|seed| {
        let (socket, over) = (socket.clone(), Arc::clone(&over));
        thread::spawn(move || come_and_go(&socket, seed, &over))
    });
    let mut deaf = UnixStream::connect(&socket)?;
    deaf.write_all(b"{\"subscribe\":[\"frame\",\"press\",\"hardness\",\"status\"]}\n")?;

    // Meanwhile the daemon is reloaded, old recordings are removed, and its usage is looked at.
    let start = Instant::now();
    let length = Duration::from_secs_f64(60.0 * args.minutes);
    let playing: Vec<_> = players
        .into_iter()
        .map(|player| thread::spawn(move || player.play(start + length)))
        .collect();
    let (mut usages, mut reloads, mut removed) = (Vec::new(), 0, 0);
    while playing.iter().any(|player| !player.is_finished()) {
        if daemon.try_wait()?.is_some() {
            return Err("the daemon has ended".into());
        }
        if start.elapsed().as_secs() / 10 > reloads {
            reloads += 1;
            configure(config, tables, 0.001 * (reloads % 2) as f64)?;
            kill_process(pid, Signal::HUP)?;
            removed += remove_old(&config.with_file_name("rec"))?;
        }
        usages.push((start.elapsed(), usage(daemon)?));
        sleep(Duration::from_secs(1));
    }
    let mut sent = Vec::new();
    for player in playing {
        sent.push(player.join().map_err(|_| "a player panicked")??);
    }
    over.store(true, Relaxed);
    for guest in guests {
        guest.join().map_err(|_| "a guest panicked")??;
    }
    // Let the subscribers read the events so far.
    sleep(Duration::from_secs(1));
    kill_process(pid, Signal::TERM)?;
    let ended = daemon.wait()?;

    let mut problems = Vec::new();
    if !ended.success() {
        problems.push(format!("the daemon ended with {ended}"));
    }
    let (sensors, minutes) = (args.sensors, args.minutes);
    for (number, listener) in listening.into_iter().enumerate() {
        let received = listener.join().map_err(|_| "a subscriber panicked")??;
        if number == 0 {
            let events = received.events;
            println!("{sensors} sensors for {minutes:.1} minutes, {events} events");
        }
        let own = received.problems.iter();
        problems.extend(own.map(|problem| format!("subscriber {number}: {problem}")));
        for problem in account(&sent, &received.ends, number == 0) {
            // All subscribers report the same problem, so keep it once.
            if !problems.contains(&problem) {
                problems.push(problem);
            }
        }
    }
    let faults = FAULTS.iter().enumerate().map(|(kind, name)| {
        let count: u64 = sent.iter().map(|player| player.faults[kind]).sum();
        format!("{count} {name}")
    });
    println!("faults: {}", faults.collect::<Vec<_>>().join(", "));
    println!("reloads: {reloads}; recordings removed meanwhile: {removed}");
    problems.extend(growth(&usages));
    Ok(problems)
}

/// Removes all recordings but the last [`KEPT`], and returns their number.
fn remove_old(directory: &Path) -> io::Result<u64> {
    let mut removed = 0;
    for old in recordings(directory)?.iter().rev().skip(KEPT) {
        fs::remove_file(old)?;
        removed += 1;
    }
    Ok(removed)
}
