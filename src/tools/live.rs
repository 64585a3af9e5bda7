//! Records presses of one sensor for a command that measures something with them.
//!
//! A daemon with sockets serves the sensor meanwhile, so the robot's controller runs as it always
//! does. The recording has no name: it vanishes with the command.

use std::fs::File;
use std::future::Future;
use std::io::{self, Seek, SeekFrom};
use std::path::PathBuf;
use std::pin::pin;
use std::time::Duration;

use tokio::sync::watch;

use super::exit::Failure;
use super::record;
use crate::daemon::Sockets;
use crate::daemon::config::Setup;
use crate::daemon::record::Progress;
use hardnessd_core::exit::{Coded, IO};
use hardnessd_core::recording::Labels;

/// The temporary file for the recording cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{directory}: {source}")]
struct Temporary {
    directory: PathBuf,
    source: io::Error,
}

impl Coded for Temporary {
    fn exit_code(&self) -> u8 {
        IO
    }
}

/// What an error calls the recording in place of its path.
pub(super) const RECORDED: &str = "what was recorded";

/// How long to wait for positions after the last press.
const LAST_POSITIONS: Duration = Duration::from_secs(1);

/// Records `wanted` presses of `sensor`; `None` if `shutdown` comes first. `say_next` is called with
/// the number of presses so far, when the zero is taken and after each press. The other sensors of
/// the configuration stay closed: their presses would count, and a missing one would end the
/// command.
pub(super) async fn record(
    mut setup: Setup,
    sensor: &str,
    wanted: u64,
    print_next: impl Fn(u64),
    shutdown: impl Future<Output = ()>,
) -> Result<Option<File>, Failure> {
    setup.sensors.retain(|one| one.name() == sensor);
    setup.config.sensors.retain(|one| one.name == sensor);
    let path = std::env::temp_dir();
    let temporary = |source| Temporary {
        directory: path.clone(),
        source,
    };
    // Nobody else needs the file. Without a name, it vanishes when this process ends.
    let file = tempfile::tempfile().map_err(temporary)?;
    let mut recorded = file.try_clone().map_err(temporary)?;

    let (progress, mut counted) = watch::channel(Progress::default());
    let enough = async {
        hardnessd_core::stderr_line!("leave the sensor free until its zero is taken");
        // The presses at the last prompt.
        let mut shown = None;
        while shown < Some(wanted) && counted.changed().await.is_ok() {
            let Progress { tared, presses, .. } = *counted.borrow_and_update();
            if tared > 0 && shown != Some(presses) {
                shown = Some(presses);
                print_next(presses);
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
    let (sockets, labels) = (Sockets::Configured, Labels::new());
    record::record(setup, sockets, &path, file, labels, progress, end).await?;
    if stopped {
        return Ok(None);
    }
    recorded.seek(SeekFrom::Start(0)).map_err(temporary)?;
    Ok(Some(recorded))
}
