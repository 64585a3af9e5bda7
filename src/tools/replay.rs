//! `hardnessd replay`: sends a recording through the daemon's pipeline, and prints the events on
//! stdout.
//!
//! All times come from the recording, so the output depends neither on the speed nor on how the
//! bytes are cut.

pub mod motion;

use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use clap::Args as ClapArgs;

use super::configuration::ModelFile;
use super::exit::Failure;
use super::played::Played;
use super::readable::printed;
use crate::daemon::config::{Config, Setup};
use hardnessd_core::event::{Event, Kind};
use hardnessd_core::sensor;
use hardnessd_core::stderr_line;
use hardnessd_core::wording::positive;

/// Arguments of `replay`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    /// Recording of `record`, or raw bytes back to back
    file: PathBuf,
    /// Configuration: its model judges; raw bytes are those of its first sensor [default: the model
    /// built in, a JX255N by default settings]
    #[arg(long, value_name = "F")]
    config: Option<PathBuf>,
    /// Play X times as fast as the sensor did [default: as fast as possible]
    #[arg(long, value_name = "X", value_parser = positive)]
    speed: Option<f64>,
    /// Positions of the arm for raw bytes: CSV with the columns time_s, counted from the first whole
    /// frame, and approach_mm [default: none]
    #[arg(long, value_name = "M.csv")]
    motion: Option<PathBuf>,
    #[command(flatten)]
    model: ModelFile,
    /// Print events as JSON lines on a terminal too
    #[arg(long)]
    json: bool,
}

/// Plays to the end, or until nobody reads stdout. It blocks: a recording may be a pipe.
///
/// # Errors
///
/// Returns a [`Failure`] if the recording or the configuration cannot be used.
pub fn run(args: &Args) -> Result<(), Failure> {
    let model = args.model.path()?;
    let setup = match &args.config {
        Some(config) => Setup::load(config, model.as_deref())?,
        None => {
            let config = Config::new(vec![sensor::Settings::new(args.file.clone())]);
            Setup::of(config.with_model(model.as_deref()), Path::new("defaults"))?
        }
    };
    let path = &args.file;
    let recording = super::open(path)?;
    let levels = &setup.hrn.card().levels;
    let labels: Vec<String> = levels.iter().map(|level| level.label.clone()).collect();
    let is_json = args.json || !io::stdout().is_terminal();
    let sensor = setup.sensors.first();
    let sensor = sensor.expect("a configuration has at least one sensor");
    let mut played = Played::open(path, recording, sensor, &setup.hrn, args.motion.as_deref())?;
    played.identify(&setup);
    if played.is_raw() {
        setup.checked(path)?;
    }
    let mut first = None;
    let mut seq = 0;
    let done = played.play(|_, events, at| {
        let (start, first) = *first.get_or_insert((Instant::now(), at.mono));
        if let Some(speed) = args.speed {
            wait(start, at.mono.saturating_sub(first), speed);
        }
        print(events, &mut seq, is_json, &labels)
    });
    if let Some(model) = played.playback.other_model() {
        stderr_line!(
            "warning: {}: recorded with model {}, played with another",
            path.display(),
            model.get(..12).unwrap_or(model)
        );
    }
    done
}

/// Waits until what happened `since` the first part is due, which was played at `start`.
fn wait(start: Instant, since: Duration, speed: f64) {
    let due = Duration::try_from_secs_f64(since.as_secs_f64() / speed);
    // A moment that is too far away to count never comes.
    let due = due.unwrap_or(Duration::MAX);
    thread::sleep(due.saturating_sub(start.elapsed()));
}

/// Prints the events that a subscriber would receive, without frames. Returns `false` if nobody
/// reads stdout.
fn print(
    events: Vec<Event>,
    seq: &mut u64,
    is_json: bool,
    labels: &[String],
) -> Result<bool, Failure> {
    let mut lines = String::new();
    for mut event in events {
        if event.kind() != Kind::Frame {
            *seq += 1;
            event.number(*seq);
            lines += &printed(event.to_line().trim_end(), is_json, labels);
        }
    }
    super::print(lines.as_bytes())
}
