//! The last minute of one sensor, to look at a fault after it happened.

use std::collections::VecDeque;
use std::time::Duration;

use super::Entry;
use crate::frame::Stamp;

/// The time for which entries are kept.
const KEPT: Duration = Duration::from_secs(60);
/// The most bytes that are kept, even if they cover less time. So neither a device that floods its
/// line nor a controller that floods the control socket can fill the memory. The JX255N sends 5 MB
/// a minute at 100 frames/s.
const KEPT_BYTES: usize = 32 << 20;

/// Entries of one sensor, in stretches that each begin with a state.
///
/// # Example
///
/// A ring keeps entries from the first state on.
///
/// ```
/// use std::sync::Arc;
/// use std::time::Duration;
///
/// use hardnessd_core::frame::Stamp;
/// use hardnessd_core::pipeline::{Clock, Input, Pipeline};
/// use hardnessd_core::recording::{Entry, Labels, Ring, State};
/// use hardnessd_core::sensor::{Description, Sensor};
/// use hardnessd_core::verdict::{BUILT_IN_HRN, Model};
///
/// let sensor = Sensor::new(Description::default())?;
/// let pipeline = Pipeline::new(sensor, Arc::new(Model::load(BUILT_IN_HRN)?), Clock::Arrival);
/// let at = Stamp {
///     mono: Duration::from_secs(1),
///     wall: jiff::Timestamp::UNIX_EPOCH,
/// };
/// let mut ring = Ring::default();
/// ring.push(at, Entry::Input(Input::Opened));
/// let state = State::of(&pipeline, &Labels::new()).expect("a new pipeline is at rest");
/// ring.push(at, Entry::State(Box::new(state)));
/// ring.push(at, Entry::Input(Input::Tick));
/// assert_eq!(ring.all().count(), 2);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Default)]
pub struct Ring {
    stretches: VecDeque<Stretch>,
    /// Whether a stretch without an end was dropped, and no state has come since.
    is_waiting: bool,
}

#[derive(Debug)]
struct Stretch {
    entries: Vec<(Stamp, Entry)>,
    bytes: usize,
}

impl Ring {
    /// Adds an entry, and drops the stretches that a minute does not need. Nothing is kept before
    /// the first state, nor of a stretch that takes too much memory by itself, such as that of a
    /// press that is held for hours: the ring then waits for the next state.
    pub fn push(&mut self, at: Stamp, entry: Entry) {
        if matches!(entry, Entry::State(_)) {
            self.is_waiting = false;
            self.stretches.push_back(Stretch {
                entries: Vec::new(),
                bytes: 0,
            });
        }
        let Some(stretch) = self.stretches.back_mut() else {
            return;
        };
        stretch.bytes += entry.weight();
        stretch.entries.push((at, entry));
        while self.is_longer_than_needed(at) {
            self.stretches.pop_front();
        }
        self.is_waiting = self.stretches.is_empty();
    }

    /// Whether the ring waits for the next state, because the stretch since the last one took too
    /// much memory.
    pub fn is_waiting(&self) -> bool {
        self.is_waiting
    }

    fn is_longer_than_needed(&self, now: Stamp) -> bool {
        let bytes: usize = self.stretches.iter().map(|stretch| stretch.bytes).sum();
        let is_old = |second: &Stretch| now.mono.saturating_sub(second.entries[0].0.mono) >= KEPT;
        bytes > KEPT_BYTES || self.stretches.get(1).is_some_and(is_old)
    }

    /// Everything that is kept: a minute, and up to one more stretch. It begins with a state.
    pub fn all(&self) -> impl Iterator<Item = &(Stamp, Entry)> {
        self.stretches.iter().flat_map(|stretch| &stretch.entries)
    }

    /// The entries from the last state on.
    pub fn latest(&self) -> impl Iterator<Item = &(Stamp, Entry)> {
        self.stretches.back().into_iter().flat_map(|s| &s.entries)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::{Clock, Input, Pipeline};
    use crate::recording::{Labels, State};
    use crate::tests::support;

    fn at(seconds: u64) -> Stamp {
        support::at(1000 * seconds)
    }

    fn state() -> Entry {
        let pipeline = Pipeline::new(support::sensor(), support::hrn(), Clock::Arrival);
        Entry::State(Box::new(State::of(&pipeline, &Labels::new()).unwrap()))
    }

    #[test]
    fn a_minute_is_kept_and_begins_with_a_state() {
        let mut ring = Ring::default();
        let state = state();
        ring.push(at(0), Entry::Input(Input::Tick));
        assert_eq!(ring.all().count(), 0);
        for second in 0..200 {
            if second % 10 == 0 {
                ring.push(at(second), state.clone());
            }
            ring.push(at(second), Entry::Input(Input::Tick));
        }
        let first = ring.all().next().unwrap();
        assert!(matches!(first.1, Entry::State(_)));
        assert_eq!(first.0, at(130));
        assert_eq!(ring.latest().count(), 11);
    }

    #[test]
    fn a_stretch_that_never_ends_is_dropped_until_the_next_state() {
        let mut ring = Ring::default();
        let flood = Entry::Input(Input::Bytes(vec![0; 1 << 20]));
        ring.push(at(0), state());
        for _ in 0..40 {
            ring.push(at(1), flood.clone());
        }
        assert_eq!(ring.all().count(), 0);
        assert!(ring.is_waiting());
        ring.push(at(2), state());
        ring.push(at(2), flood);
        assert_eq!(ring.all().count(), 2);
        assert!(!ring.is_waiting());
    }
}
