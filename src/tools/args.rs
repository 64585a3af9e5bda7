//! The command line of `hardnessd`: the one definition for the program, its help and its man pages.

use clap::{Parser, Subcommand};

use super::configuration::Configuration;
use super::{check, demo, doctor, record, recover, replay, simulate, sniff, tail, watch};

/// Hardness events from a tactile array on a serial port
#[derive(Debug, Parser)]
#[command(version, about, max_term_width = 100, after_long_help = EXIT_CODES)]
pub struct Args {
    /// What to do
    #[command(subcommand)]
    pub command: Command,
}

/// The commands of `hardnessd`.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Serve: sensors in, events out, until SIGTERM; SIGHUP reads the configuration again
    Run(Configuration),
    /// Show it all on a simulated sensor: what was pressed beside the verdict, or JSON lines
    Demo(demo::Args),
    /// Play a simulated sensor at a pty
    Simulate(simulate::Args),
    /// Record sensors to a file, with what they were judged to be
    Record(record::Args),
    /// Save what is whole in a damaged recording
    Recover(recover::Args),
    /// Play a recording through the same pipeline: events on stdout as JSON lines
    Replay(replay::Args),
    /// Print events of a running daemon
    Tail(tail::Args),
    /// Show the sensors of a running daemon on the terminal
    Watch(watch::Args),
    /// Check a configuration and say what would run
    Check(check::Args),
    /// Say why a port will not work, and what mends it
    Doctor(doctor::Args),
    /// Look at raw bytes and propose a [sensor.frame]: TOML on stdout
    Sniff(sniff::Args),
}

const EXIT_CODES: &str = "Exit codes: 0 done; 1 failed or bad data; 2 wrong usage; 66 a file named \
    here is missing or unreadable; 69 device or daemon unavailable; 74 I/O error; 78 bad \
    configuration or model, or a file that the configuration names. SIGINT and SIGTERM end `run`, \
    `demo`, `simulate`, `record`, `tail` and `watch` with 0, and any other command that had not \
    finished with 130 and 143.";
