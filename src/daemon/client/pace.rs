//! Limits how fast the requests of one connection are read.

use std::time::Duration;

use tokio::time::Instant;

/// A connection may send this many requests at once, and after that one in every [`REQUEST_EVERY`].
/// Further requests wait in the system's buffers, so that a client that never stops asking does not
/// delay the sensors, which share the daemon's thread.
const REQUESTS_AT_ONCE: u32 = 64;
const REQUEST_EVERY: Duration = Duration::from_micros(500);

/// The limit on the rate of one connection's requests.
pub(super) struct Pace {
    /// The time at which all requests so far would have been read at one in every
    /// [`REQUEST_EVERY`].
    due: Instant,
}

impl Pace {
    pub(super) fn new() -> Self {
        Self {
            due: Instant::now(),
        }
    }

    /// Waits until another request may be read. Cancelling the wait loses nothing.
    pub(super) async fn wait(&self) {
        let ahead = REQUESTS_AT_ONCE * REQUEST_EVERY;
        if self.due > Instant::now() + ahead {
            tokio::time::sleep_until(self.due - ahead).await;
        }
    }

    /// Counts a request.
    pub(super) fn count(&mut self) {
        self.due = self.due.max(Instant::now()) + REQUEST_EVERY;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn requests_without_end_are_read_at_an_even_pace() {
        let mut pace = Pace::new();
        let start = Instant::now();
        for _ in 0..REQUESTS_AT_ONCE {
            pace.wait().await;
            pace.count();
        }
        assert_eq!(start.elapsed(), Duration::ZERO);
        for _ in 0..2000 {
            pace.wait().await;
            pace.count();
        }
        let wanted = 2000 * REQUEST_EVERY;
        let taken = start.elapsed();
        // The runtime's timer has a resolution of 1 ms.
        assert!(
            (wanted..wanted + Duration::from_millis(3))
                .contains(&(taken + Duration::from_millis(1))),
            "{taken:?}"
        );
    }
}
