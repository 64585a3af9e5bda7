//! Accepts connections, up to a maximum at a time, until the order to stop.
//!
//! Every listener uses this loop. The caller decides how a connection is served, and how a
//! connection beyond the maximum is refused.

use std::future::Future;
use std::io;
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::warn;

use super::log;

/// The pause after the system had no room for a connection.
const PAUSE: Duration = Duration::from_millis(100);

/// Whether to stop: the sender is dropped then.
pub(crate) type Stop = watch::Receiver<()>;

/// Waits for the order to stop.
pub(crate) async fn stopped(stop: &mut Stop) {
    while stop.changed().await.is_ok() {}
}

/// A source of connections.
pub(crate) trait Listener {
    /// A connection.
    type Stream: Send;

    /// Waits for the next connection. Cancelling the wait loses no connection.
    fn accept(&mut self) -> impl Future<Output = io::Result<Self::Stream>> + Send;
}

/// A service for connections.
pub(crate) trait Serve<S> {
    /// Serves a connection until it ends.
    fn serve(&self, stream: S) -> impl Future<Output = ()> + Send + 'static;

    /// Refuses a connection beyond the maximum, without waiting.
    fn refuse(&self, stream: S);
}

/// Serves connections, at most `most` at a time. On the order to stop, this closes the listener,
/// and returns when the open connections have ended.
pub(crate) async fn accept<L: Listener>(
    mut listener: L,
    most: usize,
    service: impl Serve<L::Stream>,
    mut stop: Stop,
) {
    let mut clients = JoinSet::new();
    loop {
        let accepted = tokio::select! {
            // Connections that have ended make room before the next one is accepted.
            biased;
            () = stopped(&mut stop) => break,
            Some(_) = clients.join_next() => continue,
            accepted = listener.accept() => accepted,
        };
        match accepted {
            Ok(stream) if clients.len() >= most => service.refuse(stream),
            Ok(stream) => {
                clients.spawn(service.serve(stream));
            }
            // The system is out of descriptors or memory. Try again later.
            Err(error) => {
                log::limited(
                    "new connections",
                    || warn!(%error, "connections cannot be accepted"),
                );
                tokio::time::sleep(PAUSE).await;
            }
        }
    }
    drop(listener);
    while clients.join_next().await.is_some() {}
}
