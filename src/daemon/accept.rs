//! Accepting connections: as many at a time as there is room for, until the order to stop.
//!
//! Every listener uses this one loop. The caller says what is done with a connection, and what one
//! too many is told.

use std::future::Future;
use std::io;
use std::time::Duration;

use tokio::sync::watch;
use tokio::task::JoinSet;
use tracing::warn;

/// Pause after the system had no room for a connection.
const PAUSE: Duration = Duration::from_millis(100);

/// Orders to listeners. When the sender is dropped they stop; a value that is sent before asks them
/// to look whether they can still be reached.
pub(crate) type Stop = watch::Receiver<()>;

/// Waits for the order to stop.
pub(crate) async fn stopped(stop: &mut Stop) {
    while stop.changed().await.is_ok() {}
}

/// Where connections come from.
pub(crate) trait Listener {
    /// A connection.
    type Stream: Send;

    /// The next connection. Nothing is lost if the wait is given up.
    fn accept(&mut self) -> impl Future<Output = io::Result<Self::Stream>> + Send;
}

/// What is done with connections.
pub(crate) trait Serve<S> {
    /// Serves one to its end.
    fn serve(&self, stream: S) -> impl Future<Output = ()> + Send + 'static;

    /// Tells one too many so, without waiting.
    fn refuse(&self, stream: S);
}

/// Serves connections, at most `most` at a time. Once `stop` comes there are no new ones and the
/// listener is gone; it ends when those there have come to their end.
pub(crate) async fn accept<L: Listener>(
    mut listener: L,
    most: usize,
    service: impl Serve<L::Stream>,
    mut stop: Stop,
) {
    let mut clients = JoinSet::new();
    let mut refusing = false;
    loop {
        let accepted = tokio::select! {
            // Those that have gone make room before the next is looked at.
            biased;
            () = stopped(&mut stop) => break,
            Some(_) = clients.join_next() => continue,
            accepted = listener.accept() => accepted,
        };
        match accepted {
            Ok(stream) if clients.len() >= most => service.refuse(stream),
            Ok(stream) => {
                refusing = false;
                clients.spawn(service.serve(stream));
            }
            // Out of descriptors or memory: later, perhaps. Said once.
            Err(error) => {
                if !refusing {
                    warn!(%error, "connections cannot be accepted");
                }
                refusing = true;
                tokio::time::sleep(PAUSE).await;
            }
        }
    }
    drop(listener);
    while clients.join_next().await.is_some() {}
}
