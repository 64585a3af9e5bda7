//! Reads the configuration again while the daemon runs (SIGHUP).
//!
//! In: the path of the file, and the current setup. Out: the new setup, or the reason why nothing
//! changes. A separate thread reads the file and the model within [`PATIENCE`]. It does not wait
//! longer for a pipe that no program writes to. If it takes longer all the same, it is abandoned: a
//! file system may hang, and a thread that reads from it cannot be ended. So at most
//! [`MOST_READERS`] threads may be left behind.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::{Semaphore, TryAcquireError, mpsc};

use super::config::{self, Setup};
use super::log::{self, Log};
use crate::apart::{self, NoThread};

/// How long reading the files of a configuration may take. The built-in model takes well under a
/// second.
const PATIENCE: Duration = Duration::from_secs(10);

/// A thread is abandoned this long after [`PATIENCE`], so that a thread that gives up by itself can
/// report which file kept it waiting.
const MARGIN: Duration = Duration::from_secs(1);

/// The most threads that read at a time: the current one, and those that were abandoned.
const MOST_READERS: usize = 4;

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
    Log(#[from] log::Error),
    #[error("{path}: reading it and its model took over {} s: given up", patience.as_secs_f64())]
    Late { path: PathBuf, patience: Duration },
    #[error("{path}: {MOST_READERS} reloads that were given up still read: restart to reload")]
    Stuck { path: PathBuf },
    #[error("{path}: cannot start a thread to read it: {source}")]
    Thread {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{path}: the thread that read it ended without a result")]
    Ended { path: PathBuf },
}

/// The threads that read configurations.
pub(super) struct Readers(Arc<Semaphore>);

impl Default for Readers {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(MOST_READERS)))
    }
}

impl Readers {
    /// Reads the configuration at `path` and its model, or `model` in its place.
    pub(super) fn read(
        &self,
        (path, model): (PathBuf, Option<PathBuf>),
    ) -> impl Future<Output = Result<Setup, Refusal>> + use<> {
        let readers = Arc::clone(&self.0);
        let read =
            move |path: &Path| Setup::load_until(path, model.as_deref(), Instant::now() + PATIENCE);
        async move { load(readers, path, PATIENCE + MARGIN, read).await }
    }
}

/// Calls `read` with `path` in a thread, and waits for its result, but not longer than `patience`.
async fn load<T: Send + 'static>(
    readers: Arc<Semaphore>,
    path: PathBuf,
    patience: Duration,
    read: impl FnOnce(&Path) -> Result<T, config::Error> + Send + 'static,
) -> Result<T, Refusal> {
    let reader = match readers.try_acquire_owned() {
        Ok(reader) => reader,
        Err(TryAcquireError::NoPermits | TryAcquireError::Closed) => {
            return Err(Refusal::Stuck { path });
        }
    };
    let thread_path = path.clone();
    let result = match apart::start("reload", move || {
        let loaded = read(&thread_path);
        drop(reader);
        loaded
    }) {
        Ok(result) => result,
        Err(NoThread(source)) => return Err(Refusal::Thread { path, source }),
    };
    match tokio::time::timeout(patience, result).await {
        Ok(Ok(loaded)) => Ok(loaded?),
        Ok(Err(_)) => Err(Refusal::Ended { path }),
        Err(_) => Err(Refusal::Late { path, patience }),
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

/// Returns `changed` if all of it can change while the daemon runs. Otherwise nothing changes.
pub(super) fn change(setup: &Setup, changed: Setup, log: Option<&Log>) -> Result<Setup, Refusal> {
    if let Some(key) = setup.config.fixed_difference(&changed.config) {
        return Err(Refusal::Fixed { key });
    }
    if let Some(log) = log
        && changed.config.log != setup.config.log
    {
        log.change(changed.config.log)?;
    }
    Ok(changed)
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    type Read = fn(&mpsc::Receiver<()>) -> Result<(), config::Error>;

    #[tokio::test]
    async fn a_load_that_does_not_end_is_given_up_and_later_ones_work_until_too_many_are() {
        let readers = Arc::new(Semaphore::new(MOST_READERS));
        let path = PathBuf::from("hardnessd.toml");
        let load = |patience, read: Read| {
            let (end, wait) = mpsc::channel();
            let loaded = load(readers.clone(), path.clone(), patience, move |_| {
                read(&wait)
            });
            async move { (loaded.await, end) }
        };
        let mut stuck = Vec::new();
        for _ in 0..MOST_READERS {
            let (loaded, _) = load(PATIENCE, |_| Ok(())).await;
            assert!(loaded.is_ok(), "{loaded:?}");
            let waits: Read = |end| {
                let _ = end.recv();
                Ok(())
            };
            let (loaded, end) = load(Duration::from_millis(10), waits).await;
            let reason = loaded.unwrap_err().to_string();
            let expected = "hardnessd.toml: reading it and its model took over 0.01 s: given up";
            assert_eq!(reason, expected);
            stuck.push(end);
        }
        let (loaded, _) = load(PATIENCE, |_| Ok(())).await;
        assert!(matches!(loaded, Err(Refusal::Stuck { .. })), "{loaded:?}");
        // A thread that was abandoned makes room when it ends.
        stuck.clear();
        while readers.available_permits() < MOST_READERS {
            std::thread::yield_now();
        }
        let (loaded, _) = load(PATIENCE, |_| Ok(())).await;
        assert!(loaded.is_ok(), "{loaded:?}");
    }
}
