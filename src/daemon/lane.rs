//! The processor time that the requests of clients may take together.
//!
//! One thread serves the sensors and all clients. In real-time scheduling the system kills it when it
//! works without a wait for too long (`LimitRTTIME` in the unit). So clients that ask much take turns in
//! a lane, which has a share of the thread's time.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::time::Instant;

/// A lane. Clones are the same lane.
#[derive(Debug, Clone)]
pub(super) struct Lane {
    /// When all the work so far would have ended, had it begun at once and one after the other.
    ends: Arc<Mutex<Instant>>,
}

impl Lane {
    pub(super) fn new() -> Self {
        Self {
            ends: Arc::new(Mutex::new(Instant::now())),
        }
    }

    /// Reserves `time` behind all that is reserved. Returns when the work may begin.
    pub(super) fn reserve(&self, time: Duration) -> Instant {
        let mut ends = self.ends.lock().unwrap_or_else(PoisonError::into_inner);
        let begins = (*ends).max(Instant::now());
        *ends = begins + time;
        begins
    }

    /// Reserves `time`, and waits for the turn. Work of less than `free` in advance does not wait.
    pub(super) async fn take(&self, time: Duration, free: Duration) {
        let begins = self.reserve(time);
        if begins > Instant::now() + free {
            tokio::time::sleep_until(begins - free).await;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn work_takes_turns_and_a_few_go_at_once() {
        let lane = Lane::new();
        let (time, free) = (Duration::from_millis(2), Duration::from_millis(100));
        let start = Instant::now();
        for _ in 0..50 {
            lane.clone().take(time, free).await;
        }
        assert_eq!(start.elapsed(), Duration::ZERO);
        for _ in 0..500 {
            lane.clone().take(time, free).await;
        }
        let wanted = 500 * time;
        let taken = start.elapsed();
        assert!(
            taken + Duration::from_millis(4) >= wanted && taken <= wanted + time,
            "{taken:?}"
        );
    }
}
