//! How fast the requests of one connection are read.

use std::time::Duration;

use tokio::time::Instant;

/// A connection may send this many requests at once, and one in every [`REQUEST_EVERY`] after that. The
/// rest waits in the system's buffers, so that one who asks without end does not delay the sensors, which
/// share the daemon's thread.
const REQUESTS_AT_ONCE: u32 = 64;
const REQUEST_EVERY: Duration = Duration::from_micros(500);

/// When the next request of a connection is read.
pub(super) struct Pace {
    /// When all requests so far would have been answered at an even pace.
    due: Instant,
}

impl Pace {
    pub(super) fn new() -> Self {
        Self {
            due: Instant::now(),
        }
    }

    /// Waits until another request may be read. Nothing is lost if the wait is given up.
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
        // The runtime's timer has milliseconds.
        assert!(
            (wanted..wanted + Duration::from_millis(3))
                .contains(&(taken + Duration::from_millis(1))),
            "{taken:?}"
        );
    }
}
