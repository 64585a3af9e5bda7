//! Work that may block, on a thread of its own.
//!
//! The runtime has threads for such work too, but where the system has none to spare it panics, which
//! ends the process.

use std::io;
use std::mem;
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

use tokio::sync::oneshot;

/// The error of work that the system has no thread for.
#[derive(Debug, thiserror::Error)]
#[error("no thread to spare: {0}")]
pub struct NoThread(#[from] pub io::Error);

/// Starts a thread that does `work`, and ends with the process.
///
/// # Errors
///
/// Fails if the system has no thread to spare.
pub fn start(name: &str, work: impl FnOnce() + Send + 'static) -> Result<(), NoThread> {
    let thread = thread::Builder::new().name(name.to_owned());
    Ok(thread.spawn(work).map(drop)?)
}

/// Starts a thread that does `work`. Its result comes from the receiver. Dropping the receiver does not
/// end the work.
///
/// # Errors
///
/// Fails if the system has no thread to spare.
pub fn spawn_thread<T: Send + 'static>(
    name: &str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<oneshot::Receiver<T>, NoThread> {
    let (done, result) = oneshot::channel();
    start(name, move || {
        // Perhaps nobody waits for the result any more.
        let _ = done.send(work());
    })?;
    Ok(result)
}

/// The result of `work`, which runs on a thread of its own. Dropping the future does not end the work.
///
/// # Errors
///
/// Fails if the system has no thread to spare.
///
/// # Panics
///
/// Panics if the work does.
pub async fn run<T: Send + 'static>(
    name: &str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, NoThread> {
    Ok(spawn_thread(name, work)?
        .await
        .expect("the work has not panicked"))
}

/// Waits until a write to stdout that is under way has ended, but no longer than `patience`. Nothing is written
/// after it.
pub fn finish(patience: Duration) {
    bounded(patience, || mem::forget(io::stdout().lock()));
}

/// Waits for `work`, but no longer than `patience`. Where the system has no thread for it, it is done here.
pub fn bounded(patience: Duration, work: impl FnOnce() + Clone + Send + 'static) {
    let (free, waiting) = mpsc::channel();
    let of_thread = work.clone();
    let started = start("bounded", move || {
        of_thread();
        // Perhaps nobody waits any more.
        let _ = free.send(());
    });
    match started {
        Ok(()) => drop(waiting.recv_timeout(patience)),
        Err(_) => work(),
    }
}
