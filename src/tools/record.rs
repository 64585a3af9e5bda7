//! `hardnessd record`: a daemon without sockets that writes what comes to a file.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::future::Future;
use std::io;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args as ClapArgs;

use super::configuration::Configuration;
use super::simulate::positive;
use crate::daemon::config::Setup;
use crate::daemon::{self, Daemon, record};
use crate::recording::{LabelError, check_label};
use crate::verdict::Level;

/// Arguments of `record`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    #[expect(missing_docs, reason = "a comment would be taken for help")]
    #[command(flatten)]
    pub config: Configuration,
    /// Recording to write, as MCAP; a file that exists is left alone
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Label to store in the recording, such as level=2 or object=7; may be repeated
    #[arg(long = "label", value_name = "KEY=VALUE", value_parser = label)]
    labels: Vec<(String, String)>,
    /// End after S seconds [default: at SIGINT or SIGTERM, or when no sensor is left]
    #[arg(long, value_name = "S", value_parser = positive)]
    seconds: Option<f64>,
}

/// Why there is no recording, or why it ended before its time.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A label that says what was pressed, by a level that there is not.
    #[error(
        "--label level: found {found:?}, expected 0 (unlabelled) or one of the model's: {levels}"
    )]
    Level {
        /// As given.
        found: String,
        /// Those of the model.
        levels: String,
    },
    /// Two labels of one key.
    #[error("--label {key}: found it twice, expected it once")]
    Twice {
        /// The key.
        key: String,
    },
    /// The file cannot be made.
    #[error("--out {path}: {source}, expected a new file")]
    Create {
        /// As given.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// Recording failed, or the sensors were not there.
    #[error(transparent)]
    Daemon(#[from] daemon::Error),
}

/// Records until `shutdown` comes, the time is over or no sensor is left.
///
/// # Errors
///
/// [`Error`], if a label says a level that the model has not or one is given twice, the file cannot be
/// made or written, a sensor is not there to begin with, or the last one is lost.
pub async fn run(
    args: Args,
    setup: Setup,
    shutdown: impl Future<Output = ()>,
) -> Result<(), Error> {
    check_level(&args.labels, &setup.hrn.card().levels)?;
    let mut labels = BTreeMap::new();
    for (key, value) in args.labels {
        if labels.insert(key.clone(), value).is_some() {
            return Err(Error::Twice { key });
        }
    }
    let path = args.out;
    let file = File::create_new(&path).map_err(|source| Error::Create {
        path: path.clone(),
        source,
    })?;
    let daemon = Daemon::recording(setup, path.clone(), file, labels)?;
    let over = async {
        match args.seconds {
            // A time beyond counting is none.
            Some(seconds) => {
                let time = Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX);
                tokio::time::sleep(time).await;
            }
            None => std::future::pending().await,
        }
    };
    let end = async {
        tokio::select! {
            () = shutdown => {}
            () = over => {}
        }
    };
    let recorded = daemon.run(end, None).await;
    if let Err(daemon::Error::Record(record::Error::Unavailable { .. })) = &recorded {
        // It holds nothing, and the next try shall find its place free.
        let _ = fs::remove_file(&path);
    }
    Ok(recorded?)
}

/// What is labelled `level` becomes a data set: a level that is none is found out before anything
/// is pressed.
fn check_level(labels: &[(String, String)], levels: &[Level]) -> Result<(), Error> {
    let is_level = |found: &str| {
        found
            .parse()
            .is_ok_and(|found: u8| found == 0 || levels.iter().any(|level| level.level == found))
    };
    let mut said = labels.iter().filter(|(key, _)| key == "level");
    match said.find(|(_, found)| !is_level(found)) {
        None => Ok(()),
        Some((_, found)) => {
            let one = |level: &Level| format!("{} ({})", level.level, level.label);
            let levels: Vec<String> = levels.iter().map(one).collect();
            Err(Error::Level {
                found: found.clone(),
                levels: levels.join(", "),
            })
        }
    }
}

/// `KEY=VALUE`.
fn label(text: &str) -> Result<(String, String), LabelError> {
    let (key, value) = text.split_once('=').ok_or(LabelError::NoKey)?;
    check_label(key, value)?;
    Ok((key.to_owned(), value.to_owned()))
}
