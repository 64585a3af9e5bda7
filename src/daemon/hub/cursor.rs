//! A subscriber's place in the log, and which events it gets from there on.

use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;

use tokio::sync::Notify;

use super::log::Entry;
use crate::daemon::request::{Policy, Subscription};
use hardnessd_core::event::Kind;

/// The most events that a subscriber may be behind (`docs/controller.md`). A `since` may reach back
/// further.
pub(super) const QUEUE: u64 = 1024;

/// A place between two events: the number of events of each kind before it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct Place([u64; Kind::ALL.len()]);

impl Place {
    /// The number of events of a kind before this place.
    pub(super) fn of(&self, kind: Kind) -> u64 {
        self.0[kind as usize]
    }

    /// The number of all events before this place.
    pub(super) fn total(&self) -> u64 {
        self.0.iter().sum()
    }

    /// The number of the last numbered event before this place.
    pub(super) fn seq(&self) -> u64 {
        Kind::NUMBERED.iter().map(|&kind| self.of(kind)).sum()
    }

    /// The place after an event of this kind.
    pub(super) fn after(mut self, kind: Kind) -> Self {
        self.0[kind as usize] += 1;
        self
    }
}

/// A subscriber's place, and the events that it wants.
#[derive(Debug)]
pub(super) struct Cursor {
    wanted: BTreeSet<Kind>,
    policy: Policy,
    /// Of each kind, the number of the first event that the subscriber has not passed.
    next: Place,
    /// The numbers of the events that it had and that are still held. A `since` does not give them again.
    pub(super) had: BTreeSet<u64>,
    /// How many events the subscriber may be behind.
    allowed: u64,
    /// The events that it has missed since its last line. `None`: an unknown number.
    lost: Option<u64>,
    /// Wakes the subscriber, because there may be lines for it.
    pub(super) changed: Arc<Notify>,
}

impl Cursor {
    /// A cursor at the end of the log, which wants nothing yet.
    pub(super) fn new(end: Place) -> Self {
        Self {
            wanted: BTreeSet::new(),
            policy: Policy::default(),
            next: end,
            had: BTreeSet::new(),
            allowed: QUEUE,
            lost: Some(0),
            changed: Arc::default(),
        }
    }

    pub(super) fn wants_kind(&self, kind: Kind) -> bool {
        self.wanted.contains(&kind)
    }

    /// Whether a newer event of the kind and of the same sensor replaces an older one.
    pub(super) fn wants_newest(&self, kind: Kind) -> bool {
        match self.policy {
            Policy::Queue => false,
            Policy::Latest => true,
            Policy::LatestFrames => kind == Kind::Frame,
        }
    }

    /// Whether a `gap` counts events of this kind. With the policies for views, frames are replaced silently.
    fn counts(&self, kind: Kind) -> bool {
        self.wants_kind(kind) && (kind != Kind::Frame || !self.wants_newest(kind))
    }

    /// Whether the subscriber has passed `entry` and all that it wants before.
    pub(super) fn has_passed(&self, entry: &Entry) -> bool {
        let mut wanted = self.wanted.iter();
        wanted.all(|&kind| entry.before.of(kind) < self.next.of(kind))
    }

    /// Whether the subscriber wants `entry` and has not passed it.
    pub(super) fn wants(&self, entry: &Entry) -> bool {
        self.wants_kind(entry.kind) && entry.before.of(entry.kind) >= self.next.of(entry.kind)
    }

    /// The first frame that must be kept for this subscriber.
    pub(super) fn first_frame(&self) -> Option<u64> {
        self.counts(Kind::Frame).then(|| self.next.of(Kind::Frame))
    }

    /// The number of its events from `place` to `end` that it has not passed.
    fn between(&self, place: Place, end: Place) -> u64 {
        let counted = self.wanted.iter().filter(|&&kind| self.counts(kind));
        let of = |&kind| {
            let first = place.of(kind).max(self.next.of(kind));
            end.of(kind).saturating_sub(first)
        };
        counted.map(of).sum()
    }

    /// Whether the subscriber is too far behind to get `entry`.
    pub(super) fn drops(&self, entry: &Entry, end: Place) -> bool {
        self.counts(entry.kind) && self.between(entry.before, end) > self.allowed
    }

    /// Whether the subscriber had this entry before a `since`.
    pub(super) fn has_had(&self, entry: &Entry) -> bool {
        let seq = entry.line.seq();
        seq.is_some_and(|seq| self.had.contains(&seq))
    }

    /// Passes `entry`, which the subscriber gets or has had. What it has missed before is lost.
    pub(super) fn pass(&mut self, entry: &Entry) {
        self.pass_to(entry.before);
        self.next = self.next.after(entry.kind);
        self.had.extend(entry.line.seq());
    }

    /// Moves to `place`. What the subscriber wanted up to there is lost.
    pub(super) fn pass_to(&mut self, place: Place) {
        let missed = self.between(Place::default(), place);
        self.lost = self.lost.map(|lost| lost + missed);
        for (next, place) in self.next.0.iter_mut().zip(place.0) {
            *next = place.max(*next);
        }
    }

    /// Whether the subscriber has everything up to `end`.
    pub(super) fn has_all(&self, end: Place) -> bool {
        self.next == end && self.lost == Some(0)
    }

    /// The number of lost events that a `gap` must announce now, if there are any.
    pub(super) fn take_lost(&mut self) -> Option<Option<u64>> {
        let lost = self.lost.replace(0);
        (lost != Some(0)).then_some(lost)
    }

    /// After a `since`, the subscriber may be as far behind as it asked for, until it has caught up.
    pub(super) fn tighten(&mut self, end: Place) {
        if self.between(Place::default(), end) <= QUEUE {
            self.allowed = QUEUE;
        }
    }

    /// Changes what the subscriber gets from now on. Events that wait and are no longer wanted are
    /// left out without a `gap`.
    pub(super) fn change(&mut self, wanted: &Subscription, end: Place) {
        for &kind in wanted.kinds.difference(&self.wanted) {
            self.next.0[kind as usize] = end.of(kind);
        }
        self.wanted.clone_from(&wanted.kinds);
        self.policy = wanted.policy;
    }

    /// Forgets what the subscriber had and is no longer `held`, because nothing can give it again. The work is
    /// in proportion to what it had meanwhile.
    pub(super) fn forget_had(&mut self, held: &VecDeque<Entry>) {
        if self.had.len() > 2 * held.len() {
            let place = |seq| held.binary_search_by_key(&Some(seq), |entry| entry.line.seq());
            self.had.retain(|&seq| place(seq).is_ok());
        }
    }

    /// Goes back to `place`, for numbered events. Frames go on where they are.
    pub(super) fn go_back(&mut self, place: Place, lost: Option<u64>, end: Place) {
        for kind in Kind::NUMBERED {
            self.next.0[kind as usize] = place.of(kind);
        }
        self.lost = lost;
        self.allowed = self.between(place, end).max(QUEUE);
    }
}
