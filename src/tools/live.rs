//! Records presses of one sensor for a command that measures something with them.
//!
//! A daemon with sockets serves the sensor meanwhile, so the robot's controller runs as it always
//! does. The recording has no name: it vanishes with the command.

use std::fs::File;
use std::future::Future;
use std::io::Seek;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::process::Signal;
use tokio::sync::watch;

use super::exit::{FAILED, Fail, Failure, IO, UNAVAILABLE};
use super::record;
use crate::daemon::config::Setup;
use crate::daemon::log::Lines;
use crate::daemon::record::Progress;
use crate::thread;
use hardnessd_core::recording::Labels;
use hardnessd_core::sensor::Sensor;

/// How long to wait for positions after the last press.
const LAST_POSITIONS: Duration = Duration::from_secs(1);
/// How long the last prompts may take at the end.
const LAST_PROMPTS: Duration = Duration::from_secs(1);

/// What `read` makes of recordings, or of `wanted` presses of `sensor` that are made now. `next` is that of
/// [`record`].
///
/// # Errors
///
/// Fails as `read` does, if the sensor cannot be recorded, or if the signal `end` comes first.
pub(super) async fn gather<T: Send + 'static>(
    setup: Setup,
    sensor: &str,
    wanted: u64,
    files: &[PathBuf],
    next: impl Fn(u64) -> String,
    end: impl Future<Output = Signal>,
    read: impl Fn(File, &Path) -> Result<Vec<T>, Failure> + Send + 'static,
) -> Result<Vec<T>, Failure> {
    if files.is_empty() {
        let made = record(setup, sensor, wanted, next, end).await?;
        let mut all = read(made, Path::new("what was recorded"))?;
        // Something else may have been pressed before the recording ended.
        all.truncate(wanted as usize);
        return Ok(all);
    }
    let files = files.to_vec();
    let work = move || {
        let mut all = Vec::new();
        for path in &files {
            all.extend(read(super::open(path)?, path)?);
        }
        Ok(all)
    };
    // A file may be a pipe that sends nothing.
    tokio::select! {
        done = thread::run("presses", work) => done?,
        signal = end => Err(Failure::interrupted(signal)),
    }
}

/// Records `wanted` presses of `sensor`. `next` says what to do after the number of presses so far, when the zero is
/// taken and after each press. The other sensors of the configuration stay closed: their presses would count, and a
/// missing one would end the command.
async fn record(
    mut setup: Setup,
    sensor: &str,
    wanted: u64,
    next: impl Fn(u64) -> String,
    end: impl Future<Output = Signal>,
) -> Result<File, Failure> {
    setup.sensors.retain(|one| one.name() == sensor);
    setup.config.sensors.retain(|one| one.name == sensor);
    for sensor in &mut setup.sensors {
        // What is pressed now is a tool, and no everyday object of the robot.
        let mut described = sensor.description().clone();
        described.sensor.own_presses = 0;
        *sensor = Sensor::new(described).exit(FAILED)?;
    }
    let path = std::env::temp_dir();
    // Nobody else needs the file. Without a name, it vanishes when this process ends.
    let mut file = tempfile::tempfile().of(path.display(), IO)?;
    let mut stopped = None;
    let prompts = Lines::start()?;
    let enough = async |mut counted: watch::Receiver<Progress>| {
        let made = async {
            prompts.say(b"leave the sensor free until its zero is taken\n");
            // The presses at the last prompt.
            let mut shown = None;
            while shown < Some(wanted) && counted.changed().await.is_ok() {
                let Progress { tared, presses, .. } = *counted.borrow_and_update();
                if tared > 0 && shown != Some(presses) {
                    shown = Some(presses);
                    prompts.say(format!("{}\n", next(presses)).as_bytes());
                }
            }
            tokio::time::sleep(LAST_POSITIONS).await;
        };
        tokio::select! {
            () = made => {}
            signal = end => stopped = Some(signal),
        }
    };
    let recorded = record::record(setup, &path, &file, Labels::new(), enough).await;
    prompts.flush(LAST_PROMPTS);
    match recorded {
        // After the last press, a sensor may be taken away.
        (Err(error), progress) if error.code != UNAVAILABLE || progress.presses < wanted => {
            return Err(error);
        }
        _ => {}
    }
    if let Some(signal) = stopped {
        return Err(Failure::interrupted(signal));
    }
    file.rewind().of(path.display(), IO)?;
    Ok(file)
}
