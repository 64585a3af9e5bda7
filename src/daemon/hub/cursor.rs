//! A subscriber's place in the log, and which events it gets from there on.

use std::ops::Range;
use std::task::Waker;

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
    kinds: [bool; Kind::ALL.len()],
    pub(super) policy: Policy,
    pub(super) place: Place,
    /// Of each kind, the first events that the subscriber does not get: it wanted the kind later, or
    /// has had them.
    from: Place,
    /// How many events the subscriber may be behind.
    allowed: u64,
    /// The events that it has missed since its last line. `None`: an unknown number.
    lost: Option<u64>,
    /// The numbered events that earlier subscriptions of this connection gave it. A `since` does not
    /// give them again.
    had: Vec<Had>,
    /// The number of the last event before the current subscription.
    begun: u64,
    pub(super) waker: Option<Waker>,
}

/// Events of these kinds and numbers.
#[derive(Debug)]
struct Had {
    kinds: [bool; Kind::ALL.len()],
    seqs: Range<u64>,
}

impl Cursor {
    /// A cursor at the end of the log.
    pub(super) fn new(wanted: &Subscription, end: Place) -> Self {
        Self {
            kinds: kinds(wanted),
            policy: wanted.policy,
            place: end,
            from: end,
            allowed: QUEUE,
            lost: Some(0),
            had: Vec::new(),
            begun: end.seq(),
            waker: None,
        }
    }

    pub(super) fn wants_kind(&self, kind: Kind) -> bool {
        self.kinds[kind as usize]
    }

    /// Whether a `gap` counts the kind. With the policies for views, a newer frame replaces an older
    /// one silently.
    fn counts(&self, kind: Kind) -> bool {
        self.wants_kind(kind) && (self.policy == Policy::Queue || kind != Kind::Frame)
    }

    pub(super) fn wants(&self, entry: &Entry) -> bool {
        self.wants_kind(entry.kind) && entry.before.of(entry.kind) >= self.first(entry.kind)
    }

    /// The first event of a kind that the subscriber may still get.
    fn first(&self, kind: Kind) -> u64 {
        self.place.of(kind).max(self.from.of(kind))
    }

    /// The number of frames that nobody keeps for this subscriber.
    pub(super) fn frames_read(&self) -> Option<u64> {
        let queues = self.wants_kind(Kind::Frame) && self.policy == Policy::Queue;
        queues.then(|| self.first(Kind::Frame))
    }

    /// The number of events between the subscriber's place and `entry` that it does not get.
    fn missed(&self, entry: &Entry) -> u64 {
        let kinds = Kind::ALL.into_iter().filter(|&kind| self.counts(kind));
        kinds
            .map(|kind| entry.before.of(kind).saturating_sub(self.first(kind)))
            .sum()
    }

    /// The number of its events from `place` to `end`.
    fn behind(&self, place: Place, end: Place) -> u64 {
        let kinds = Kind::ALL.into_iter().filter(|&kind| self.counts(kind));
        kinds
            .map(|kind| end.of(kind) - place.of(kind).max(self.from.of(kind)).min(end.of(kind)))
            .sum()
    }

    /// Whether the subscriber is too far behind to get `entry`.
    pub(super) fn drops(&self, entry: &Entry, end: Place) -> bool {
        self.counts(entry.kind) && self.behind(entry.before, end) > self.allowed
    }

    /// Whether an earlier subscription gave the subscriber this entry.
    pub(super) fn has_had(&self, entry: &Entry) -> bool {
        let seq = entry.line.seq;
        seq.is_some_and(|seq| {
            let mut had = self.had.iter();
            had.any(|had| had.kinds[entry.kind as usize] && had.seqs.contains(&seq))
        })
    }

    /// Moves to `entry`, which the subscriber gets or has had. What it has missed before is lost.
    /// `oldest` is the first number that the log holds.
    pub(super) fn reach(&mut self, entry: &Entry, oldest: u64) {
        let missed = self.missed(entry);
        if missed > 0 {
            self.lost = self.lost.map(|lost| lost + missed);
            self.note_had(oldest);
            self.begun = entry.before.seq();
        }
        self.place = entry.before.after(entry.kind);
    }

    /// Moves to `end`. What it wanted up to there is lost.
    pub(super) fn reach_end(&mut self, end: Place, oldest: u64) {
        let missed = self.behind(self.place, end);
        if missed > 0 {
            self.lost = self.lost.map(|lost| lost + missed);
            self.note_had(oldest);
            self.begun = end.seq();
        }
        self.place = end;
    }

    /// Whether the subscriber has everything up to `end`.
    pub(super) fn has_all(&self, end: Place) -> bool {
        self.place == end && self.lost == Some(0)
    }

    /// The number of lost events that a `gap` must announce now, if there are any.
    pub(super) fn take_lost(&mut self) -> Option<Option<u64>> {
        let lost = self.lost.replace(0);
        (lost != Some(0)).then_some(lost)
    }

    /// After a `since`, the subscriber may be as far behind as it asked for, until it has caught up.
    pub(super) fn tighten(&mut self, end: Place) {
        if self.behind(self.place, end) <= QUEUE {
            self.allowed = QUEUE;
        }
    }

    /// Notes what the subscriber had until now.
    pub(super) fn note_had(&mut self, oldest: u64) {
        let seqs = self.begun + 1..self.place.seq() + 1;
        self.begun = self.place.seq();
        self.had.retain(|had| had.seqs.end > oldest);
        if !seqs.is_empty() {
            let kinds = self.kinds;
            self.had.push(Had { kinds, seqs });
        }
    }

    /// Changes what the subscriber gets from now on. Events that wait and are no longer wanted are
    /// left out without a `gap`.
    pub(super) fn change(&mut self, wanted: &Subscription, end: Place) {
        let kinds = kinds(wanted);
        for kind in Kind::ALL {
            if !self.wants_kind(kind) {
                self.from.0[kind as usize] = end.of(kind);
            }
        }
        (self.kinds, self.policy) = (kinds, wanted.policy);
    }

    /// Goes back to `place`, for numbered events. Frames go on where they are.
    pub(super) fn go_back(&mut self, place: Place, lost: Option<u64>, end: Place) {
        let frames = self.first(Kind::Frame);
        self.from = Place::default();
        self.from.0[Kind::Frame as usize] = frames;
        (self.place, self.lost, self.begun) = (place, lost, place.seq());
        self.allowed = self.behind(place, end).max(QUEUE);
    }
}

fn kinds(wanted: &Subscription) -> [bool; Kind::ALL.len()] {
    Kind::ALL.map(|kind| wanted.kinds.contains(&kind))
}
