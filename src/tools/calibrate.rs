//! `hardnessd calibrate`: what a configuration should say of the sensor and the arm that presses with it.
//!
//! A daemon with sockets serves the sensor and records in the meantime, so the robot's controller runs
//! as it always does. Afterwards the recording is read, and stdout gets the values, their spread and the
//! lines for the configuration.

mod arm;
mod force;
mod gather;

use std::fs::{self, File};
use std::future::Future;
use std::io::{self, Seek, SeekFrom};
use std::path::PathBuf;
use std::pin::pin;
use std::time::Duration;

use clap::{Args as ClapArgs, ValueEnum};
use tokio::sync::watch;

use self::gather::Gathered;
use super::configuration::Configuration;
use super::simulate::{OutOfRange, within};
use crate::daemon::config::Setup;
use crate::daemon::record::Progress;
use crate::daemon::{self, Daemon, Sockets};
use crate::recording::{Labels, PlaybackError};

/// Arguments of `calibrate`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    /// arm: press something rigid a few times, while the robot tells where its arm is. force: put known
    /// weights on the sensor
    what: What,
    #[expect(missing_docs, reason = "a comment would be taken for help")]
    #[command(flatten)]
    pub config: Configuration,
    /// Sensor to calibrate [default: the first]
    #[arg(long, value_name = "NAME")]
    sensor: Option<String>,
    /// force: the weights, in newtons, in the order in which they are put on (1 kg is 9.81 N)
    #[arg(long, value_name = "N", num_args = 1.., required_if_eq("what", "force"), value_parser = newtons)]
    newtons: Vec<f64>,
    /// arm: presses to make, 2 to 1000
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u64).range(2..=1000))]
    presses: u64,
}

/// What can be calibrated.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum What {
    /// Stiffness of the arm, and the delay of its stamps.
    Arm,
    /// Newtons of a count.
    Force,
}

/// Why there are no values.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// There is no such sensor.
    #[error("--sensor: found {found:?}, expected one of {}", names.join(", "))]
    NoSensor {
        /// As given.
        found: String,
        /// Those of the configuration.
        names: Vec<String>,
    },
    /// Weights for the arm.
    #[error("--newtons: found weights, expected none: they are for `calibrate force`")]
    Unasked,
    /// The daemon cannot serve, or has stopped.
    #[error(transparent)]
    Daemon(#[from] daemon::Error),
    /// There is no place for the recording.
    #[error("{path}: {source}")]
    Temporary {
        /// Of the recording.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// What was recorded cannot be read.
    #[error("what was recorded: {0}")]
    Recording(#[from] crate::recording::Error),
    /// What was recorded cannot be played.
    #[error("what was recorded: {0}")]
    Playback(#[from] PlaybackError),
    /// The presses do not say it.
    #[error(transparent)]
    Arm(#[from] arm::Unfit),
    /// The weights do not say it.
    #[error(transparent)]
    Force(#[from] force::Unfit),
    /// Presses were made that are no presses of a weight.
    #[error("found {found} presses, expected {expected}: put each weight on once")]
    Count {
        /// As recorded.
        found: usize,
        /// Weights.
        expected: usize,
    },
    /// Stdout fails.
    #[error("stdout: {0}")]
    Print(#[source] io::Error),
}

/// Positions are awaited for this long after the last press.
const LAST_POSITIONS: Duration = Duration::from_secs(1);

/// Serves the sensor until there are enough presses, and prints what they say. It ends early, without
/// values, when `shutdown` comes.
///
/// # Errors
///
/// [`Error`], if the daemon cannot serve, or the presses do not say what is asked.
pub async fn run(
    args: Args,
    setup: Setup,
    shutdown: impl Future<Output = ()>,
) -> Result<(), Error> {
    if matches!(args.what, What::Arm) && !args.newtons.is_empty() {
        return Err(Error::Unasked);
    }
    let sensor = chosen(&args, &setup)?;
    let described = setup.sensors.iter().find(|known| known.name() == sensor);
    let calibration = described.map(|known| known.description().calibration.clone());
    let calibration = calibration.unwrap_or_default();
    let hrn = setup.hrn.clone();
    let path =
        std::env::temp_dir().join(format!("hardnessd-calibrate-{}.mcap", std::process::id()));
    let temporary = |source| Error::Temporary {
        path: path.clone(),
        source,
    };
    let open = File::options()
        .read(true)
        .write(true)
        .create_new(true)
        .open(&path);
    let file = open.map_err(temporary)?;
    // Nobody else needs it, and it goes with this process.
    fs::remove_file(&path).map_err(temporary)?;
    let mut recorded = file.try_clone().map_err(temporary)?;

    let (progress, mut counted) = watch::channel(Progress::default());
    let labels = Labels::new();
    let sockets = Sockets::Configured;
    let daemon = Daemon::recording(setup, path.clone(), file, labels, progress, sockets)?;
    let wanted = match args.what {
        What::Arm => args.presses,
        What::Force => args.newtons.len() as u64,
    };
    say_next(&args, 0);
    let enough = async {
        let mut seen = 0;
        while seen < wanted && counted.changed().await.is_ok() {
            let presses = counted.borrow_and_update().presses;
            if presses > seen {
                seen = presses;
                say_next(&args, seen);
            }
        }
        tokio::time::sleep(LAST_POSITIONS).await;
    };
    let mut stopped = false;
    let end = async {
        let (enough, shutdown) = (pin!(enough), pin!(shutdown));
        tokio::select! {
            () = enough => {}
            () = shutdown => stopped = true,
        }
    };
    daemon.run(end, None).await?;
    if stopped {
        return Ok(());
    }
    recorded.seek(SeekFrom::Start(0)).map_err(temporary)?;
    let gathered = Gathered::read(recorded, &sensor, hrn)?;
    let text = match args.what {
        What::Arm => of_arm(&arm::Fit::of(&gathered.presses)?),
        What::Force => {
            let (found, expected) = (gathered.presses.len(), args.newtons.len());
            if found != expected {
                return Err(Error::Count { found, expected });
            }
            let weights = args.newtons.iter().copied().zip(&gathered.presses);
            of_force(&force::Fit::of(&weights.collect::<Vec<_>>(), &calibration)?)
        }
    };
    super::print_apart(text.into_bytes())
        .await
        .map_err(Error::Print)?;
    Ok(())
}

fn chosen(args: &Args, setup: &Setup) -> Result<String, Error> {
    let names: Vec<String> = setup.sensors.iter().map(|s| s.name().to_owned()).collect();
    match &args.sensor {
        None => Ok(names[0].clone()),
        Some(found) if names.contains(found) => Ok(found.clone()),
        Some(found) => Err(Error::NoSensor {
            found: found.clone(),
            names,
        }),
    }
}

/// Says on stderr what to do next, after so many presses.
fn say_next(args: &Args, seen: u64) {
    match args.what {
        What::Arm if seen == 0 => eprintln!(
            "press something rigid {} times, while the robot tells where its arm is",
            args.presses
        ),
        What::Arm => eprintln!("press {seen} of {}", args.presses),
        What::Force => match args.newtons.get(seen as usize) {
            Some(newtons) => {
                eprintln!("put {newtons} N on the sensor, wait until it rests, and take it off");
            }
            None => eprintln!("done"),
        },
    }
}

/// A weight of the command line.
fn newtons(text: &str) -> Result<f64, OutOfRange> {
    within(text, 0.001, 1e6)
}

/// The values, their spread and the lines for the configuration.
fn of_force(fit: &force::Fit) -> String {
    let mut text = String::from("weight        read          error\n");
    for (newtons, read) in &fit.weights {
        let error = 100.0 * (read / newtons - 1.0);
        let [newtons, read] = [newtons, read].map(|n| format!("{n:.3} N"));
        text += &format!("{newtons:<13} {read:<13} {error:+.1} %\n");
    }
    let force::Fit {
        newtons_per_count,
        alone: [least, most],
        exponent,
        line_error,
        power,
        ..
    } = fit;
    text += &format!(
        "\nnewtons_per_count  {newtons_per_count:.5} (weight by weight {least:.5} to {most:.5})\n\
         line               error {:.1} %\n",
        100.0 * line_error
    );
    text += &match power {
        Some((exponent, error)) => {
            format!(
                "power law          exponent {exponent:.2}, error {:.1} %\n",
                100.0 * error
            )
        }
        None => "power law          needs three different weights, one twice another\n".to_owned(),
    };
    text += &format!(
        "\n[sensor.calibration]\nnewtons_per_count = {newtons_per_count:.5}\nexponent = {exponent:.2}\n"
    );
    text
}

/// The values, their spread and the lines for the configuration.
fn of_arm(fit: &arm::Fit) -> String {
    let arm::Fit {
        presses,
        force_n,
        n_per_mm,
        delay_ms,
        residual_mm,
    } = fit;
    format!(
        "presses    {presses}, up to {:.1} to {:.1} N\n\
         stiffness  {:.2} N/mm (press by press {:.2} to {:.2})\n\
         delay      {:.1} ms (press by press {:.1} to {:.1})\n\
         residual   {residual_mm:.3} mm\n\
         \n\
         [sensor.arm]\n\
         stiffness_n_per_mm = {:.2}\n\
         delay_ms = {:.1}\n",
        force_n[0],
        force_n[1],
        n_per_mm.value,
        n_per_mm.least,
        n_per_mm.most,
        delay_ms.value,
        delay_ms.least,
        delay_ms.most,
        n_per_mm.value,
        delay_ms.value,
    )
}
