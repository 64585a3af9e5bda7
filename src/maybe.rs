//! Waiting for what may be missing. Without it, the wait never ends.

use std::future::Future;
use std::time::Duration;

use tokio::time::Instant;

/// The output of the future. Without a future, this never completes.
pub(crate) async fn wait<T: Future>(one: Option<T>) -> T::Output {
    match one {
        Some(one) => one.await,
        None => std::future::pending().await,
    }
}

/// Waits until the moment. Without a moment, this never completes.
pub(crate) async fn until(moment: Option<Instant>) {
    wait(moment.map(tokio::time::sleep_until)).await;
}

/// The moment after some seconds. A time that is too long to count has no moment.
pub(crate) fn after(seconds: Option<f64>) -> Option<Instant> {
    let time = Duration::try_from_secs_f64(seconds?).ok()?;
    Instant::now().checked_add(time)
}
