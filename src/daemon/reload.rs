//! Reads the configuration again while the daemon runs (SIGHUP).
//!
//! In: the path of the file, and the current setup. Out: the new setup, or the reason why nothing
//! changes. A thread of its own reads the file and the model, and is abandoned after [`PATIENCE`]: a pipe
//! may have no writer and a file system may hang, and a thread that reads from them cannot be ended.

use std::path::PathBuf;
use std::time::Duration;

use tokio::sync::mpsc;

use super::config::{self, Setup};
use super::log::Log;
use super::record;
use crate::thread::{NoThread, spawn_thread};

/// How long reading the files of a configuration may take. The built-in model takes well under a
/// second.
const PATIENCE: Duration = Duration::from_secs(10);

/// The requests to a running daemon to read its configuration again.
pub struct Reload {
    /// One item for each request.
    pub requests: mpsc::Receiver<()>,
    /// The path of the configuration.
    pub path: PathBuf,
    /// The model that replaces the configuration's own, if there is one.
    pub model: Option<PathBuf>,
    /// The log, whose format may change.
    pub log: Log,
}

/// The reason a reload was refused.
#[derive(Debug, thiserror::Error)]
pub(super) enum Refusal {
    #[error(transparent)]
    Config(#[from] config::Error),
    #[error("{key} has changed, which a running daemon cannot take over: restart it")]
    Fixed { key: String },
    #[error(transparent)]
    Record(#[from] record::Error),
    #[error("{path}: reading it and its files did not end within {} s", PATIENCE.as_secs())]
    Late { path: PathBuf },
    #[error("{path}: cannot start a thread to read it: {source}")]
    Thread {
        path: PathBuf,
        source: std::io::Error,
    },
}

/// Reads the configuration at `path` and its model, or `model` in its place.
pub(super) async fn read((path, model): (PathBuf, Option<PathBuf>)) -> Result<Setup, Refusal> {
    let named = path.clone();
    let reading = spawn_thread("reload", move || Setup::load(&named, model.as_deref()));
    let reading = match reading {
        Ok(reading) => reading,
        Err(NoThread(source)) => return Err(Refusal::Thread { path, source }),
    };
    match tokio::time::timeout(PATIENCE, reading).await {
        Ok(loaded) => Ok(loaded.expect("a configuration is read without a panic")?),
        Err(_) => Err(Refusal::Late { path }),
    }
}

/// Waits for the next request to reload, and returns the path to read, and that of the model in the
/// place of the configuration's own. If no request can come, this waits forever.
pub(super) async fn requested(reload: &mut Option<Reload>) -> (PathBuf, Option<PathBuf>) {
    if let Some(reload) = reload
        && reload.requests.recv().await.is_some()
    {
        return (reload.path.clone(), reload.model.clone());
    }
    std::future::pending().await
}

/// Returns `changed` if all of it can change while the daemon runs.
pub(super) fn change(setup: &Setup, changed: Setup) -> Result<Setup, Refusal> {
    match setup.config.fixed_difference(&changed.config) {
        Some(key) => Err(Refusal::Fixed { key }),
        None => Ok(changed),
    }
}

/// Changes the log if its settings differ.
pub(super) fn change_log(setup: &Setup, changed: &Setup, log: Option<&Log>) {
    if let Some(log) = log
        && changed.config.log != setup.config.log
    {
        log.change(changed.config.log);
    }
}
