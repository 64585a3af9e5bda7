//! The file of each sensor's own presses, which outlive the daemon.
//!
//! In: the own presses of a sensor after each press, and their owner. Out: files in a directory of the
//! service, one for each sensor, each whole or not there; and at the next start what they hold, if the
//! owner is still the same. One thread writes, so no sensor waits for a disk.

use std::collections::BTreeMap;
use std::env;
use std::ffi::OsString;
use std::fs;
use std::iter;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, Sender, channel};

use anyhow::ensure;
use serde::{Deserialize, Serialize};
use tokio::sync::oneshot;
use tracing::warn;

use super::config::directory_of_service;
use super::log;
use super::port::is_simulated;
use crate::thread::{NoThread, spawn_thread};
use hardnessd_core::judge::{OwnPresses, owner};
use hardnessd_core::part::{Part, directory_of};
use hardnessd_core::pipeline::Pipeline;
use hardnessd_core::sensor::Sensor;

/// The largest file that is read. Ours have a tenth of it.
const MOST_BYTES: u64 = 1 << 20;

/// What a file holds.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Kept {
    /// What the presses belong to, as [`owner`] says it.
    owner: String,
    presses: OwnPresses,
}

/// Comes when the thread has written all.
pub(super) type Written = oneshot::Receiver<()>;

/// The files of own presses, in a directory.
#[derive(Debug, Clone)]
pub(super) struct Store {
    path: PathBuf,
    changed: Sender<(PathBuf, Kept)>,
    /// Whether it is the user's. It has no presses of simulated sensors, such as those of a demo.
    is_of_user: bool,
}

impl Store {
    /// The store in the directory that systemd or the user's environment names, and its end: all that was saved is
    /// written some time after the last store was dropped. Without a directory, own presses last as long as the daemon.
    pub(super) fn of_environment() -> Result<Option<(Self, Written)>, NoThread> {
        let service = directory_of_service("STATE_DIRECTORY").map(|path| (path, false));
        let user = || Some((of_user(|variable| env::var_os(variable))?, true));
        let directory = service.or_else(user);
        let store = directory.map(|(path, is_of_user)| Self::in_directory(path, is_of_user));
        store.transpose()
    }

    fn in_directory(path: PathBuf, is_of_user: bool) -> Result<(Self, Written), NoThread> {
        let (changed, inbox) = channel();
        let written = spawn_thread("own presses", move || write_all(&inbox))?;
        let store = Self {
            path,
            changed,
            is_of_user,
        };
        Ok((store, written))
    }

    /// Where the presses of a sensor are, if any are kept. Of a simulated one a user keeps none: it may have the name of
    /// a real one.
    fn file_of(&self, sensor: &Sensor) -> Option<PathBuf> {
        let sensor = &sensor.description().sensor;
        let is_kept = sensor.own_presses > 0 && !(self.is_of_user && is_simulated(&sensor.port));
        is_kept.then(|| self.path.join(format!("own-{}.json", sensor.name)))
    }

    /// Gives a pipeline the own presses of its sensor, if they are of its calibration and model.
    pub(super) fn load(&self, pipeline: &mut Pipeline) {
        let Some(path) = self.file_of(pipeline.sensor()) else {
            return;
        };
        match read(&path) {
            Ok(Some(kept)) if kept.owner == owner(pipeline.sensor(), pipeline.hrn()) => {
                pipeline.take_own_presses(kept.presses);
            }
            Ok(_) => {}
            Err(error) => warn!(path = %path.display(), %error, "own presses are not read"),
        }
    }

    /// Writes the own presses of a pipeline, soon.
    pub(super) fn save(&self, pipeline: &Pipeline) {
        let sensor = pipeline.sensor();
        let Some(path) = self.file_of(sensor) else {
            return;
        };
        let kept = Kept {
            owner: owner(sensor, pipeline.hrn()),
            presses: pipeline.own_presses().clone().for_another_start(),
        };
        // The thread ends only after all senders.
        let _ = self.changed.send((path, kept));
    }
}

/// The directory of a user's own state, by the XDG Base Directory Specification.
fn of_user(variable: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let named = |name| variable(name).filter(|value| !value.is_empty());
    let home = || Some(Path::new(&named("HOME")?).join(".local/state"));
    let state = named("XDG_STATE_HOME").map(PathBuf::from).or_else(home);
    Some(state?.join("hardnessd"))
}

/// What a file holds. `None` if there is none.
fn read(path: &Path) -> anyhow::Result<Option<Kept>> {
    let Ok(found) = fs::metadata(path) else {
        return Ok(None);
    };
    ensure!(found.is_file(), "found no file");
    ensure!(
        found.len() <= MOST_BYTES,
        "found more than {MOST_BYTES} bytes"
    );
    Ok(Some(serde_json::from_slice(&fs::read(path)?)?))
}

/// Writes what comes, until all senders are gone. Of the changes of a file that wait, the last one counts.
fn write_all(changed: &Receiver<(PathBuf, Kept)>) {
    while let Ok(first) = changed.recv() {
        let waiting: BTreeMap<_, _> = iter::once(first).chain(changed.try_iter()).collect();
        for (path, kept) in waiting {
            let written = fs::create_dir_all(directory_of(&path)).and_then(|()| {
                let text = serde_json::to_vec(&kept)?;
                Part::over(&path)?.write(&text)
            });
            if let Err(error) = written {
                log::limited("own presses", || {
                    warn!(path = %path.display(), %error, "own presses are not written");
                });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use hardnessd_core::pipeline::{Clock, Input};
    use hardnessd_core::sensor::Description;
    use hardnessd_core::tests::support::{at, sensor_of};
    use hardnessd_core::verdict::{BUILT_IN, Model};
    use hardnessd_simulator::{Sequence, SequenceSettings};

    fn pipeline(change: impl FnOnce(&mut Description)) -> Pipeline {
        let hrn = Arc::new(Model::load(BUILT_IN).unwrap());
        Pipeline::new(sensor_of(change), hrn, Clock::FrameRate)
    }

    fn store(directory: &Path) -> Store {
        Store::in_directory(directory.to_owned(), false).unwrap().0
    }

    #[test]
    fn the_users_state_is_in_its_directory_or_below_the_home() {
        for (state, home, expected) in [
            (Some("/s"), Some("/h"), Some("/s/hardnessd")),
            (Some(""), Some("/h"), Some("/h/.local/state/hardnessd")),
            (None, Some("/h"), Some("/h/.local/state/hardnessd")),
            (None, None, None),
        ] {
            let variable = |name: &str| if name == "HOME" { home } else { state };
            let found = of_user(|name| variable(name).map(Into::into));
            assert_eq!(found, expected.map(PathBuf::from));
        }
    }

    #[test]
    fn own_presses_outlive_the_daemon_and_not_another_calibration() {
        let directory = tempfile::tempdir().unwrap();
        let mut first = pipeline(|_| {});
        let frames = Sequence::new(SequenceSettings {
            presses: Some(3),
            ..SequenceSettings::default()
        });
        for frame in frames {
            let mut bytes = Vec::new();
            first.sensor().layout().encode(&frame.raw, &mut bytes);
            first.take(Input::Bytes(bytes), at(0)).unwrap();
        }
        assert_eq!(first.own_presses().count(), 3);
        let (saving, written) = Store::in_directory(directory.path().to_owned(), false).unwrap();
        saving.save(&first);
        drop(saving);
        written.blocking_recv().unwrap();
        let path = directory.path().join("own-forearm.json");

        let loaded = |pipeline: Pipeline| {
            let mut pipeline = pipeline;
            store(directory.path()).load(&mut pipeline);
            pipeline.own_presses().count()
        };
        assert_eq!(loaded(pipeline(|_| {})), 3);
        let scaled = |of: &mut Description| of.sensor.calibration.newtons_per_count *= 2.0;
        assert_eq!(loaded(pipeline(scaled)), 0);
        for most in [2, 0] {
            let of_most = |of: &mut Description| of.sensor.own_presses = most;
            assert_eq!(loaded(pipeline(of_most)), most as usize);
        }
        let whole = fs::read_to_string(&path).unwrap();
        // A file that somebody changed says nothing of known objects, and is whole.
        let labelled = whole.replace(r#""own""#, r#""labelled""#);
        for changed in [labelled.as_str(), &whole[..whole.len() / 2]] {
            assert_ne!(changed, whole);
            fs::write(&path, changed).unwrap();
            assert_eq!(loaded(pipeline(|_| {})), 0);
        }
    }
}
