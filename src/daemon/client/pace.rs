//! Limits how fast the requests of one connection are read.

use std::time::Duration;

use tokio::time::Instant;

use crate::daemon::lane::Lane;

/// A connection may send this many requests at once, and after that one in every [`REQUEST_EVERY`].
/// Further requests wait in the system's buffers, so that a client that never stops asking does not
/// delay the sensors, which share the daemon's thread. A long request counts as one for each KiB.
const REQUESTS_AT_ONCE: u32 = 64;
const REQUEST_EVERY: Duration = Duration::from_micros(500);

/// The time in the lane of a request, and of each KiB of it: several times as long as it takes to answer
/// and to read. So the connections of a lane together take a part of the thread only.
const LANE_REQUEST_TIME: Duration = Duration::from_micros(200);
const LANE_KIB_TIME: Duration = Duration::from_micros(60);
/// A request that is longer always waits for the lane.
const SHORT_BYTES: usize = 4096;

/// The limit on the rate of one connection's requests.
pub(super) struct Pace {
    /// The time at which all requests so far would have been read at one in every
    /// [`REQUEST_EVERY`].
    due: Instant,
    /// The lane of the connections that ask much, and the turn in it.
    lane: Lane,
    turn: Instant,
}

impl Pace {
    pub(super) fn new(lane: Lane) -> Self {
        let now = Instant::now();
        Self {
            due: now,
            lane,
            turn: now,
        }
    }

    /// Waits until another request may be read. Cancelling the wait loses nothing.
    pub(super) async fn wait(&self) {
        let until = self.turn.max(self.due - REQUESTS_AT_ONCE * REQUEST_EVERY);
        if until > Instant::now() {
            tokio::time::sleep_until(until).await;
        }
    }

    /// Counts a request of this many bytes.
    pub(super) fn count(&mut self, bytes: usize) {
        let now = Instant::now();
        let parts = u32::try_from(1 + bytes / 1024).unwrap_or(u32::MAX);
        self.due = self.due.max(now) + REQUEST_EVERY * parts;
        if bytes > SHORT_BYTES || self.due > now + REQUESTS_AT_ONCE * REQUEST_EVERY {
            let time = LANE_REQUEST_TIME + LANE_KIB_TIME * parts;
            self.turn = self.lane.reserve(time) + time;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn requests_without_end_are_read_at_an_even_pace() {
        let mut pace = Pace::new(Lane::new());
        let start = Instant::now();
        for _ in 0..REQUESTS_AT_ONCE {
            pace.wait().await;
            pace.count(20);
        }
        assert_eq!(start.elapsed(), Duration::ZERO);
        for _ in 0..2000 {
            pace.wait().await;
            pace.count(20);
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

    #[tokio::test(start_paused = true)]
    async fn long_requests_of_many_connections_take_turns() {
        let lane = Lane::new();
        let mut paces: Vec<Pace> = (0..60).map(|_| Pace::new(lane.clone())).collect();
        let start = Instant::now();
        for _ in 0..10 {
            for pace in &mut paces {
                pace.wait().await;
                pace.count(64_000);
            }
        }
        // 600 requests of 63 parts each, less the last one of each connection.
        let least = 540 * 63 * LANE_KIB_TIME;
        assert!(start.elapsed() >= least, "{:?}", start.elapsed());
        // A connection that asks little does not wait behind them.
        let quiet = Pace::new(lane);
        let before = Instant::now();
        quiet.wait().await;
        assert_eq!(before.elapsed(), Duration::ZERO);
    }
}
