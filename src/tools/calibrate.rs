//! `hardnessd calibrate`: what a configuration should say of the sensor and the arm that presses with it.
//!
//! A daemon with sockets serves the sensor and records in the meantime, so the robot's controller runs
//! as it always does. Afterwards the recording is read, and stdout gets the values, their spread and the
//! lines for the configuration.

mod fit;
mod gather;

use std::fs::{self, File};
use std::future::Future;
use std::io::{self, Seek, SeekFrom};
use std::path::PathBuf;
use std::pin::pin;
use std::time::Duration;

use clap::{Args as ClapArgs, ValueEnum};
use tokio::sync::watch;

use self::fit::{Fit, Unfit};
use self::gather::Gathered;
use super::configuration::Configuration;
use crate::daemon::config::Setup;
use crate::daemon::record::Progress;
use crate::daemon::{self, Daemon, Sockets};
use crate::recording::{Labels, PlaybackError};

/// Arguments of `calibrate`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    /// What to calibrate. arm: press something rigid a few times, while the robot tells where its arm is
    what: What,
    #[expect(missing_docs, reason = "a comment would be taken for help")]
    #[command(flatten)]
    pub config: Configuration,
    /// Sensor to calibrate [default: the first]
    #[arg(long, value_name = "NAME")]
    sensor: Option<String>,
    /// Presses to make, 2 to 1000
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u64).range(2..=1000))]
    presses: u64,
}

/// What can be calibrated.
#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum What {
    /// Stiffness of the arm, and the delay of its stamps.
    Arm,
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
    Unfit(#[from] Unfit),
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
    let What::Arm = args.what;
    let sensor = chosen(&args, &setup)?;
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
    eprintln!(
        "press something rigid {} times, while the robot tells where its arm is",
        args.presses
    );
    let enough = async {
        let mut seen = 0;
        while seen < args.presses && counted.changed().await.is_ok() {
            let presses = counted.borrow_and_update().presses;
            if presses > seen {
                seen = presses;
                eprintln!("press {seen} of {}", args.presses);
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
    let fit = Fit::of(&gathered.presses)?;
    let text = described(&fit);
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

/// The values, their spread and the lines for the configuration.
fn described(fit: &Fit) -> String {
    let Fit {
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
