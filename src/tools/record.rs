//! `hardnessd record`: a daemon that records its sensors to a file. It opens sockets only if asked
//! to.
//!
//! At the end, a warning says if there was no press. A session records one file after another.

mod session;

use std::fs::File;
use std::future::Future;
use std::io::{self, IsTerminal};
use std::path::{Path, PathBuf};
use std::pin::pin;

use clap::Args as ClapArgs;
use tokio::sync::watch;

use super::configuration::Configuration;
use super::doctor;
use super::exit::{Fail as _, Failure, IO, UNAVAILABLE, USAGE};
use crate::daemon::Daemon;
use crate::daemon::config::Setup;
use crate::daemon::log::Log;
use crate::daemon::record::{Gone, Progress, Target};
use crate::maybe;
use hardnessd_core::part;
use hardnessd_core::recording::{Labels, check_label, misspelt};
use hardnessd_core::sensor;
use hardnessd_core::wording::{escaped, positive};

/// What `--help` says below the options.
const MORE: &str = "\
    --session asks for the name of each object, and for the reading of a durometer or its level, \
    then shows the verdict on each press. Meanwhile Enter starts the next object, q and Enter or Ctrl-C \
    ends. Each object becomes a file NUMBER-NAME.mcap. A second session in the same directory continues the \
    numbers.";

/// Arguments of `record`.
#[derive(Debug, Clone, ClapArgs)]
#[command(after_long_help = MORE)]
pub struct Args {
    #[expect(missing_docs, reason = "a comment would be taken for help")]
    #[command(flatten)]
    pub config: Configuration,
    /// Recording to write, as MCAP; a file that exists is left alone
    #[arg(long, value_name = "FILE", required_unless_present = "session")]
    out: Option<PathBuf>,
    /// Ask on the terminal for one object after another, and write a recording of each into this directory,
    /// labelled for `hrn-train fit`
    #[arg(long, value_name = "DIR", conflicts_with_all = ["out", "seconds"])]
    session: Option<PathBuf>,
    /// Label to store in the recording, such as level=2, object=7 or shore=64; may be repeated
    #[arg(long = "label", value_name = "KEY=VALUE", value_parser = label)]
    labels: Vec<(String, String)>,
    /// Open the sockets of [publish.unix] too, so that a robot can send the positions of its arm
    #[arg(long)]
    sockets: bool,
    /// End after S seconds [default: at SIGINT or SIGTERM, or when no sensor is left]
    #[arg(long, value_name = "S", value_parser = positive)]
    seconds: Option<f64>,
}

impl Args {
    /// Whether it asks the user on the terminal.
    pub fn is_session(&self) -> bool {
        self.session.is_some()
    }
}

/// Records until `shutdown` comes, the time has passed or no sensor is left.
///
/// # Errors
///
/// Fails if a label names a level that the model does not have or is given twice, the
/// file cannot be made or written, a sensor is missing at the start, or the last sensor is lost.
pub async fn run(
    args: Args,
    mut setup: Setup,
    log: &Log,
    shutdown: impl Future<Output = ()>,
) -> Result<(), Failure> {
    let mut labels = Labels::new();
    for (key, value) in args.labels {
        if let Some(known) = misspelt(&key) {
            let meant = format!("warning: --label {key}: did you mean {known}?");
            say(log, &meant);
        }
        if labels.insert(key.clone(), value).is_some() {
            let twice = format!("--label {key}: given twice: give it once");
            return Err(Failure::new(USAGE, twice));
        }
    }
    check_level(&labels, &setup)?;
    setup.config.publish.unix.enabled &= args.sockets;
    if let Some(directory) = &args.session {
        let asked = ["level", "object", "name", "shore"];
        if let Some(key) = asked.into_iter().find(|&key| labels.contains_key(key)) {
            let asked = format!("--label {key}: --session asks for it: leave it out");
            return Err(Failure::new(USAGE, asked));
        }
        return session::run(directory, &labels, &setup, log, pin!(shutdown)).await;
    }
    let path = args
        .out
        .expect("clap asks for it where there is no session");
    let file = create(&path)?;
    let end = async |_| {
        tokio::select! {
            () = shutdown => {}
            () = maybe::until(maybe::after(args.seconds)) => {}
        }
    };
    let (recorded, progress) = record(setup, &path, &file, labels, end).await;
    let (frames, presses) = (progress.frames, progress.presses);
    if recorded.is_err() && frames == 0 {
        // The path must be free for the next try.
        part::remove(&path, &file);
        return recorded;
    }
    let (seen, shown) = (counted_in_words(frames, "frame", "s"), path.display());
    if io::stderr().is_terminal() {
        let pressed = counted_in_words(presses, "press", "es");
        say(log, &format!("recorded {seen}, {pressed}: {shown}"));
    }
    if recorded.is_ok() && presses == 0 {
        let why = if frames > 0 && progress.tared == 0 {
            ", because the zero was not taken: leave the sensor free at the start, and record longer"
        } else {
            ": was the sensor pressed, is it live, and is press.contact_threshold_n low enough?"
        };
        say(log, &format!("warning: {shown}: no press in {seen}{why}"));
    }
    recorded
}

/// Writes a line between those of the log, with hidden characters escaped. It waits for no terminal.
fn say(log: &Log, line: &str) {
    log.lines().say(format!("{}\n", escaped(line)).as_bytes());
}

/// Makes the file of a recording. A file that exists is left alone.
fn create(path: &Path) -> Result<File, Failure> {
    let made = part::directory_for(path).and_then(|_| File::create_new(path));
    made.of(format!("{}: name a new file", path.display()), IO)
}

/// Records into `file`, which is at `path`, until `end` is over, or until no sensor is left. Returns what the file holds
/// too. Where a sensor is missing at the start, nothing is worth keeping: the file holds nothing then.
pub(super) async fn record(
    setup: Setup,
    path: &Path,
    file: &File,
    labels: Labels,
    end: impl AsyncFnOnce(watch::Receiver<Progress>),
) -> (Result<(), Failure>, Progress) {
    let sensors = setup.config.sensors.clone();
    let end = async |counted: watch::Receiver<Progress>| {
        let mut left = counted.clone();
        tokio::select! {
            () = end(counted) => {}
            _ = left.wait_for(|progress| progress.gone.is_some()) => {}
        }
    };
    let (recorded, progress) = record_waiting(setup, path, file, labels, end).await;
    match (&recorded, &progress.gone) {
        (Ok(()), Some(Gone::Unavailable(sensor, reason))) => {
            let mut sensors = sensors.iter();
            let known = sensors.find(|known| known.name == *sensor);
            let known = known.expect("a missing sensor is one of the configuration");
            let failure = unavailable(known, reason.clone());
            (Err(failure), Progress::default())
        }
        (Ok(()), Some(Gone::Lost(sensor, reason))) => {
            let end = match progress.frames {
                0 => "nothing was recorded",
                _ => "the recording ends there",
            };
            let lost = format!("sensor {sensor:?} lost: {reason}; {end}");
            (Err(Failure::new(UNAVAILABLE, lost)), progress)
        }
        _ => (recorded, progress),
    }
}

/// The same, but it waits for sensors that are missing.
async fn record_waiting(
    setup: Setup,
    path: &Path,
    file: &File,
    labels: Labels,
    end: impl AsyncFnOnce(watch::Receiver<Progress>),
) -> (Result<(), Failure>, Progress) {
    let (progress, counted) = watch::channel(Progress::default());
    let recorded = async {
        let target = Target::File {
            path: path.to_owned(),
            file: file.try_clone().of(path.display(), IO)?,
            labels,
            progress,
        };
        let daemon = Daemon::recording(setup, target)?;
        let mut written = counted.clone();
        let end = async {
            tokio::select! {
                () = end(counted.clone()) => {}
                // The file cannot be written.
                _ = written.wait_for(|_| false) => {}
            }
        };
        Ok(daemon.run(end, None).await?)
    };
    let recorded = recorded.await;
    let progress = counted.borrow().clone();
    (recorded, progress)
}

/// The failure of a sensor whose port cannot be opened for this reason.
fn unavailable(sensor: &sensor::Settings, reason: String) -> Failure {
    let (name, port) = (&sensor.name, &sensor.port);
    let obstacle = doctor::obstacle(port).unwrap_or(reason);
    Failure::new(UNAVAILABLE, format!("sensor {name:?}: {port}: {obstacle}"))
}

fn counted_in_words(count: u64, what: &str, plural: &str) -> String {
    let plural = if count == 1 { "" } else { plural };
    format!("{count} {what}{plural}")
}

/// Checks the label `level`, which a data set is made from. A wrong number must be found before
/// anything is pressed. A name may be that of a level of the user's own, of which `hrn-train fit` makes a model.
fn check_level(labels: &Labels, setup: &Setup) -> Result<(), Failure> {
    let found = labels.get("level").and_then(|level| level.parse().ok());
    let levels = &setup.hrn.card().levels;
    if found.is_none_or(|level| (0..=levels.len() as i64).contains(&level)) {
        return Ok(());
    }
    let named = levels
        .iter()
        .map(|level| format!("{} ({})", level.level, level.label));
    let named = named.collect::<Vec<_>>().join(", ");
    let found = &labels["level"];
    let problem = format!("--label level: found {found:?}, expected 0 (unlabelled), {named}");
    Err(Failure::new(USAGE, problem))
}

/// Parses a label, `KEY=VALUE`.
fn label(text: &str) -> Result<(String, String), String> {
    let (key, value) = text.split_once('=').unwrap_or(("", text));
    check_label(key, value)?;
    Ok((key.to_owned(), value.to_owned()))
}
