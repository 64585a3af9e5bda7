//! The thread that serves everything that clients do, with a runtime of its own.
//!
//! The sensors' thread has real-time scheduling under systemd, and this thread has not. So clients
//! that ask without end delay other clients, and no sensor.

use std::io;
use std::sync::Arc;
use std::thread;

use tokio::runtime::{Builder, Handle};
use tokio::sync::oneshot;

/// The thread. Dropping this waits until its tasks are dropped, with their sockets, and the thread has ended.
#[derive(Debug)]
pub(crate) struct Clients {
    pub(super) runtime: Handle,
    /// Ends the thread when it is dropped.
    ending: Option<oneshot::Sender<()>>,
    thread: Option<thread::JoinHandle<()>>,
}

impl Clients {
    /// Starts the thread.
    ///
    /// # Errors
    ///
    /// Fails if the system has no thread or descriptors for it.
    pub(super) fn start() -> io::Result<Self> {
        let runtime = Arc::new(Builder::new_current_thread().enable_all().build()?);
        let handle = runtime.handle().clone();
        let (ending, ended) = oneshot::channel::<()>();
        let of_thread = runtime.clone();
        let thread = thread::Builder::new().name("clients".to_owned());
        let started = thread.spawn(move || {
            // The wait always ends with an error, because the sender is only dropped.
            let _ = of_thread.block_on(ended);
        });
        if started.is_err()
            && let Some(runtime) = Arc::into_inner(runtime)
        {
            // Dropped on the sensors' thread, it would wait, and panic.
            runtime.shutdown_background();
        }
        Ok(Self {
            runtime: handle,
            ending: Some(ending),
            thread: Some(started?),
        })
    }
}

impl Drop for Clients {
    fn drop(&mut self) {
        drop(self.ending.take());
        // A panic on that thread has been reported by itself.
        let _ = self.thread.take().map(thread::JoinHandle::join);
    }
}
