//! Reads the configuration again while the daemon runs (SIGHUP).
//!
//! In: the path of the file, and requests. Out: for each request the new setup, or the reason why nothing
//! changes. A thread of its own reads the file and the model, and is abandoned after [`PATIENCE`]: a pipe
//! may have no writer and a file system may hang, and a thread that reads from them cannot be ended.

use std::path::PathBuf;
use std::time::Duration;

use tokio::signal::unix::Signal;
use tokio::sync::mpsc;

use super::config::Setup;
use super::log::Log;
use super::systemd;
use crate::thread::spawn_thread;

/// How long reading the files of a configuration may take. The built-in model takes well under a
/// second.
const PATIENCE: Duration = Duration::from_secs(10);

/// The requests to a running daemon to read its configuration again.
pub struct Reload {
    /// SIGHUP. A request while another one waits is the same one: what is read then has all changes.
    pub requests: Signal,
    /// The path of the configuration.
    pub path: PathBuf,
    /// The model that replaces the configuration's own, if there is one.
    pub model: Option<PathBuf>,
    /// The log, whose format may change.
    pub log: Log,
}

/// The reason a reload was refused, in words: nobody tells reasons apart.
pub(super) type Refusal = String;

impl Reload {
    /// Reads the configuration at each request, in a task of its own. Returns what was read, and the log.
    pub(super) fn start(self) -> (mpsc::Receiver<Result<Setup, Refusal>>, Log) {
        let Self {
            mut requests,
            path,
            model,
            log,
        } = self;
        let (sender, setups) = mpsc::channel(1);
        tokio::spawn(async move {
            while requests.recv().await.is_some() {
                systemd::reloading();
                // The daemon may have ended.
                let _ = sender.send(read(path.clone(), model.clone()).await).await;
            }
        });
        (setups, log)
    }
}

/// Reads the configuration at `path` and its model, or `model` in its place.
async fn read(path: PathBuf, model: Option<PathBuf>) -> Result<Setup, Refusal> {
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
