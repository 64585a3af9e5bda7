//! What a running daemon is to use next.
//!
//! In: SIGHUP, and the path of the configuration. Out: what was read, or why it cannot be used. It changes nothing.

use std::path::PathBuf;
use std::time::Duration;

use tokio::signal::unix::Signal;
use tokio::sync::mpsc;

use super::config::Setup;
use super::log::Log;
use super::systemd;
use crate::thread;

/// How long reading the files of a configuration may take. The built-in model takes well under a
/// second.
const PATIENCE: Duration = Duration::from_secs(10);

/// The reason a reload was refused, in words: nobody tells reasons apart.
pub(super) type Refusal = String;

/// The configurations that a running daemon is to use next.
pub struct Reload {
    setups: mpsc::Receiver<Result<Setup, Refusal>>,
    /// Its format may change. It lasts until the end.
    log: Log,
}

impl Reload {
    /// Reads the configuration at `path` after each SIGHUP, in a task of its own. `model` replaces the configuration's
    /// own. A request while another one waits is the same one: what is read then has all changes.
    pub fn start(mut requests: Signal, path: PathBuf, model: Option<PathBuf>, log: Log) -> Self {
        let (sender, setups) = mpsc::channel(1);
        tokio::spawn(async move {
            while requests.recv().await.is_some() {
                systemd::reloading();
                // The daemon may have ended.
                let _ = sender.send(read(path.clone(), model.clone()).await).await;
            }
        });
        Self { setups, log }
    }

    /// The next configuration, or why it cannot be used, and the log.
    pub(super) async fn next(&mut self) -> Option<(Result<Setup, Refusal>, &Log)> {
        Some((self.setups.recv().await?, &self.log))
    }
}

/// Reads the configuration at `path` and its model, or `model` in its place. A thread of its own reads, and is abandoned
/// after [`PATIENCE`]: a pipe may have no writer and a file system may hang, and a thread that reads from them cannot be
/// ended.
async fn read(path: PathBuf, model: Option<PathBuf>) -> Result<Setup, Refusal> {
    let shown = path.display().to_string();
    let reading = thread::run("reload", move || Setup::load(&path, model.as_deref()));
    match tokio::time::timeout(PATIENCE, reading).await {
        Ok(Ok(loaded)) => loaded.map_err(|error| error.to_string()),
        Ok(Err(error)) => Err(format!("{shown}: {error}")),
        Err(_) => Err(format!(
            "{shown}: reading it and its files did not end within {} s",
            PATIENCE.as_secs()
        )),
    }
}
