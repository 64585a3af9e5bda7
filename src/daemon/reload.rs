//! Reads the configuration again while the daemon runs (SIGHUP).
//!
//! In: the path of the file, and the current setup. Out: the new setup, or the reason why nothing
//! changes. A thread of its own reads the file and the model, and is abandoned after [`PATIENCE`]: a pipe
//! may have no writer and a file system may hang, and a thread that reads from them cannot be ended.

use std::path::PathBuf;
use std::time::Duration;

use tokio::sync::mpsc;

use super::config::Setup;
use super::log::Log;
use crate::thread::spawn_thread;

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

/// The reason a reload was refused, in words: nobody tells reasons apart.
pub(super) type Refusal = String;

/// Reads the configuration at `path` and its model, or `model` in its place.
pub(super) async fn read((path, model): (PathBuf, Option<PathBuf>)) -> Result<Setup, Refusal> {
    let shown = path.display().to_string();
    let reading = spawn_thread("reload", move || Setup::load(&path, model.as_deref()));
    let reading = reading.map_err(|error| format!("{shown}: {error}"))?;
    match tokio::time::timeout(PATIENCE, reading).await {
        Ok(loaded) => loaded
            .expect("a configuration is read without a panic")
            .map_err(|error| error.to_string()),
        Err(_) => Err(format!(
            "{shown}: reading it and its files did not end within {} s",
            PATIENCE.as_secs()
        )),
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

/// Returns `changed` if all of it can change while the daemon runs, and writes the log as it says.
pub(super) fn change(setup: &Setup, changed: Setup, log: Option<&Log>) -> Result<Setup, Refusal> {
    if let Some(key) = setup.config.fixed_difference(&changed.config) {
        return Err(format!(
            "{key} has changed, which a running daemon cannot take over: restart it"
        ));
    }
    if let Some(log) = log {
        log.change(changed.config.log);
    }
    Ok(changed)
}
