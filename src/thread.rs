//! Work that may block, on a thread of its own.
//!
//! The runtime has threads for such work too, but where the system has none to spare it panics, which
//! ends the process.

use std::io;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

use tokio::sync::oneshot;

use hardnessd_core::exit::{Coded, IO};

/// The error of work that the system has no thread for.
#[derive(Debug, thiserror::Error)]
#[error("no thread to spare: {0}")]
pub struct NoThread(#[from] pub io::Error);

impl Coded for NoThread {
    fn exit_code(&self) -> u8 {
        IO
    }
}

impl From<NoThread> for io::Error {
    fn from(error: NoThread) -> Self {
        Self::other(error)
    }
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
    let at_work = AtWork::begin();
    thread::Builder::new()
        .name(name.to_owned())
        .spawn(move || {
            // Perhaps nobody waits for the result any more.
            let _ = done.send(work());
            drop(at_work);
        })?;
    Ok(result)
}

/// Blocks until every thread of [`spawn_thread`] has done its work, but no longer than `patience`.
pub fn finish(patience: Duration) {
    let _ = IDLE.wait_timeout_while(threads(), patience, |threads| *threads > 0);
}

/// The number of threads at work.
static THREADS: Mutex<usize> = Mutex::new(0);
/// A thread has done its work.
static IDLE: Condvar = Condvar::new();

fn threads() -> MutexGuard<'static, usize> {
    // The number is right even if a thread panicked while it changed it.
    THREADS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Counts a thread as long as it lives.
struct AtWork;

impl AtWork {
    fn begin() -> Self {
        *threads() += 1;
        Self
    }
}

impl Drop for AtWork {
    fn drop(&mut self) {
        *threads() -= 1;
        IDLE.notify_all();
    }
}
