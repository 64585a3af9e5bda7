//! One subscriber in the hub: its subscription, the events that wait for it, and the events that it
//! missed.

use std::collections::{BTreeSet, VecDeque};

use super::{HELD, Line};
use crate::daemon::request::{Policy, Subscription};
use hardnessd_core::event::{Kind, Reply};

/// The most events that wait for a subscriber (`docs/controller.md`).
const QUEUE: usize = 1024;

/// A batch ends with the line that reaches this many bytes. So one write carries many events, and a
/// subscriber that has stopped reading holds little beyond its queue.
const BATCH_BYTES: usize = 32 * 1024;

/// A subscriber's state.
pub(super) struct Subscriber {
    kinds: BTreeSet<Kind>,
    policy: Policy,
    /// A `gap` to send before all else, because `since` reached back too far.
    missing: Option<Reply>,
    /// The held events that `since` asked for, oldest first, by number and kind.
    replay: VecDeque<(u64, Kind)>,
    /// The events that wait to be fetched.
    queue: VecDeque<Line>,
    /// The number of events of its kinds that were dropped since its last line.
    lost: u64,
    /// `gap` lines sent since the hub last counted them.
    pub(super) gaps: u64,
    handed: Handed,
}

impl Default for Subscriber {
    fn default() -> Self {
        let Subscription { kinds, policy, .. } = Subscription::default();
        Self {
            kinds,
            policy,
            missing: None,
            replay: VecDeque::new(),
            queue: VecDeque::new(),
            lost: 0,
            gaps: 0,
            handed: Handed([0; HELD / 64]),
        }
    }
}

impl Subscriber {
    pub(super) fn wants(&self, kind: Kind) -> bool {
        self.kinds.contains(&kind)
    }

    /// Changes the subscription. Events that wait and are no longer wanted are removed without a
    /// `gap`.
    pub(super) fn change(&mut self, kinds: BTreeSet<Kind>, policy: Policy) {
        (self.kinds, self.policy) = (kinds, policy);
        let kinds = &self.kinds;
        self.replay.retain(|(_, kind)| kinds.contains(kind));
        self.queue
            .retain(|line| line.about().is_some_and(|(kind, _)| kinds.contains(&kind)));
        if policy != Policy::Queue {
            for line in std::mem::take(&mut self.queue) {
                self.enqueue(line);
            }
        }
    }

    /// Sends the `held` events before any live event, except those that this subscriber has had.
    /// `missing` is the number of its events that are no longer held, or `None` if that is unknown.
    pub(super) fn replay(&mut self, held: impl Iterator<Item = (u64, Kind)>, missing: Option<u64>) {
        self.missing = (missing != Some(0)).then_some(Reply::Gap { lost: missing });
        // Numbered events that wait are also held, and the replay sends them.
        self.queue.retain(|line| line.seq.is_none());
        self.lost = 0;
        self.replay = held
            .filter(|&(seq, kind)| self.kinds.contains(&kind) && !self.handed.contains(seq))
            .collect();
    }

    /// Queues a new event if it is wanted. Returns the number of older events that it displaced and
    /// that the next `gap` counts.
    pub(super) fn offer(&mut self, line: &Line) -> u64 {
        if let Some(seq) = line.seq {
            self.handed.remove(seq);
        }
        match line.about() {
            Some((kind, _)) if self.wants(kind) => self.enqueue(line.clone()),
            _ => 0,
        }
    }

    fn enqueue(&mut self, line: Line) -> u64 {
        let frame = |line: &Line| matches!(line.about(), Some((Kind::Frame, _)));
        let newest_counts = match self.policy {
            Policy::Queue => false,
            Policy::Latest => true,
            Policy::LatestFrames => frame(&line),
        };
        let older = || self.queue.iter().position(|e| e.about() == line.about());
        let superseded = if newest_counts { older() } else { None };
        let superseded = superseded.or_else(|| (self.queue.len() == QUEUE).then_some(0));
        let mut lost = 0;
        if let Some(place) = superseded
            && let Some(dropped) = self.queue.remove(place)
        {
            // With `latest`, a newer frame replaces an older one without a `gap`.
            let silent = self.policy != Policy::Queue && frame(&dropped);
            lost = u64::from(!silent);
        }
        self.lost += lost;
        self.queue.push_back(line);
        lost
    }

    /// Whether lines wait to be fetched.
    pub(super) fn has_lines(&self) -> bool {
        self.missing.is_some() || !self.replay.is_empty() || !self.queue.is_empty()
    }

    /// The subscriber's next batch of lines. `held` looks up a numbered event.
    pub(super) fn take(&mut self, held: impl Fn(u64) -> Option<Line>) -> Vec<Line> {
        let mut lines = Vec::new();
        let mut bytes = 0;
        if let Some(gap) = self.missing.take() {
            self.gaps += 1;
            lines.push(gap.into());
        }
        while bytes < BATCH_BYTES
            && let Some((seq, _)) = self.replay.pop_front()
        {
            match held(seq) {
                Some(line) => {
                    lines.extend(self.gap());
                    self.handed.insert(seq);
                    bytes += line.json.len();
                    lines.push(line);
                }
                // The event is no longer held, because the subscriber was too slow.
                None => self.lost += 1,
            }
        }
        while bytes < BATCH_BYTES
            && let Some(line) = self.queue.pop_front()
        {
            lines.extend(self.gap());
            if let Some(seq) = line.seq
                && held(seq).is_some()
            {
                self.handed.insert(seq);
            }
            bytes += line.json.len();
            lines.push(line);
        }
        lines
    }

    fn gap(&mut self) -> Option<Line> {
        let lost = std::mem::take(&mut self.lost);
        (lost > 0).then(|| {
            self.gaps += 1;
            Reply::Gap { lost: Some(lost) }.into()
        })
    }
}

/// The held events that this subscriber has had, one bit for each.
struct Handed([u64; HELD / 64]);

impl Handed {
    fn place(seq: u64) -> (usize, u64) {
        let bit = usize::try_from(seq % HELD as u64).expect("below HELD");
        (bit / 64, 1 << (bit % 64))
    }

    fn contains(&self, seq: u64) -> bool {
        let (word, bit) = Self::place(seq);
        self.0[word] & bit != 0
    }

    fn insert(&mut self, seq: u64) {
        let (word, bit) = Self::place(seq);
        self.0[word] |= bit;
    }

    fn remove(&mut self, seq: u64) {
        let (word, bit) = Self::place(seq);
        self.0[word] &= !bit;
    }
}
