//! The command line of `hardnessd`: the one definition for the program, its help and its man pages.

use clap::{Args as ClapArgs, Parser, Subcommand};

use super::configuration::{Configuration, ModelFile};
#[cfg(feature = "watch")]
use super::watch;
use super::{
    calibrate, check, control, demo, doctor, identify, record, recover, replay, simulate, sniff,
    tail,
};

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
    /// Run the daemon until SIGINT or SIGTERM; SIGHUP reloads the configuration
    Run(Run),
    /// Run the whole daemon on a simulated sensor and print each press beside its verdict
    Demo(demo::Args),
    /// Simulate a sensor on a pty
    Simulate(simulate::Args),
    /// Record sensors and their verdicts to a file
    Record(record::Args),
    /// Save what is whole in a damaged recording
    Recover(recover::Args),
    /// Replay a recording through the daemon's pipeline and print its events
    Replay(replay::Args),
    /// Print events of a running daemon
    Tail(tail::Args),
    /// Show the sensors of a running daemon on the terminal
    #[cfg(feature = "watch")]
    Watch(watch::Args),
    /// `tare`, `context` and `blackbox`.
    #[command(flatten)]
    Control(control::Command),
    /// Check a configuration and its model, and print what would run; opens and creates nothing
    Check(check::Args),
    /// Measure values for the configuration: the arm, newtons, gains of taxels
    Calibrate(calibrate::Args),
    /// Make a file of presses on known pieces, which tell the model what the sensor reads
    Identify(identify::Args),
    /// Explain why a port does not work, and what to do
    Doctor(doctor::Args),
    /// Propose a [sensor.frame] for raw bytes, as TOML on stdout
    Sniff(sniff::Args),
}

/// Arguments of `run`.
#[derive(Debug, ClapArgs)]
pub struct Run {
    /// `--config`.
    #[command(flatten)]
    pub config: Configuration,
    /// `--model`.
    #[command(flatten)]
    pub model: ModelFile,
}

const EXIT_CODES: &str = "Exit codes: 0 done; 1 failed or bad data; 2 wrong usage; 66 a file named \
    here is missing or unreadable; 69 device or daemon unavailable; 74 I/O error; 78 bad \
    configuration or model, or a file that the configuration names. SIGINT and SIGTERM end `run`, \
    `demo`, `simulate`, `record`, `tail` and `watch` with 0, and any other command that had not \
    finished with 130 and 143.";
