//! The longest time that the sensors' thread worked without a wait.
//!
//! While this thread works on one thing, everything else in it waits: a frame of another sensor, an
//! event for another subscriber. The time is the thread's processor time. Other programs that take
//! the core away do not count.

use std::cell::Cell;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};

static LONGEST: Longest = Longest::new();

thread_local! {
    /// The processor time of this thread when its last wait ended.
    static BEGUN: Cell<Option<Duration>> = const { Cell::new(None) };
    /// The processor time of this thread at its last pause by [`rest`].
    static RESTED: Cell<Duration> = const { Cell::new(Duration::ZERO) };
}

/// For `on_thread_unpark` of the runtime: a wait of this thread has ended.
pub fn begins() {
    BEGUN.set(used());
}

/// For `on_thread_park` of the runtime: this thread is about to wait.
pub fn ends() {
    LONGEST.end();
}

/// Forgets the time so far. The daemon calls this when it has started, because nobody waits for it
/// before that.
pub(super) fn forget() {
    LONGEST.0.store(0, Ordering::Relaxed);
    begins();
}

/// The longest time without a wait since the daemon has started. It is 0 if the runtime calls
/// neither [`begins`] nor [`ends`].
pub fn longest() -> Duration {
    LONGEST.get()
}

/// Work for this long is followed by a pause. `LimitRTTIME` in the unit is 500 ms.
const MOST: Duration = Duration::from_millis(20);
const PAUSE: Duration = Duration::from_micros(100);

/// Pauses this thread for a moment after each 20 ms of work. In real-time scheduling the system kills a
/// process whose thread never sleeps. Clients that subscribe again and again, each time since the start, or a
/// sensor that sends without end could leave it no sleep of its own: where something is there, a wait returns
/// at once. Call it between two pieces of work for others.
pub(super) fn rest() {
    let Some(now) = used() else { return };
    if now.saturating_sub(RESTED.get()) > MOST {
        RESTED.set(now);
        ends();
        std::thread::sleep(PAUSE);
        begins();
    }
}

/// The processor time of this thread.
fn used() -> Option<Duration> {
    Duration::try_from(clock_gettime(ClockId::ThreadCPUTime)).ok()
}

/// A longest time in nanoseconds.
struct Longest(AtomicU64);

impl Longest {
    const fn new() -> Self {
        Self(AtomicU64::new(0))
    }

    fn end(&self) {
        if let (Some(begun), Some(now)) = (BEGUN.take(), used()) {
            let worked = now.saturating_sub(begun).as_nanos();
            let worked = u64::try_from(worked).unwrap_or(u64::MAX);
            self.0.fetch_max(worked, Ordering::Relaxed);
        }
    }

    fn get(&self) -> Duration {
        Duration::from_nanos(self.0.load(Ordering::Relaxed))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    /// Works for this much processor time.
    fn work(time: Duration) {
        let begun = used().unwrap();
        while used().unwrap() - begun < time {}
    }

    #[test]
    fn work_without_a_wait_counts_and_waits_do_not() {
        let longest = Arc::new(Longest::new());
        let found = longest.clone();
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_time()
            .on_thread_unpark(begins)
            .on_thread_park(move || found.end())
            .build()
            .unwrap();
        let (short, long) = (Duration::from_millis(5), Duration::from_millis(40));
        runtime.block_on(async {
            for _ in 0..10 {
                work(short);
                tokio::time::sleep(long).await;
            }
        });
        let found = longest.get();
        assert!(found >= short && found < long, "{found:?}");
        runtime.block_on(async {
            tokio::time::sleep(short).await;
            work(long);
            tokio::time::sleep(short).await;
        });
        assert!(longest.get() >= long);
    }
}
