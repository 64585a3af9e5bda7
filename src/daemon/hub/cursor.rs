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
    wanted: [bool; Kind::ALL.len()],
    pub(super) policy: Policy,
    /// Of each kind, the number of the first event that the subscriber has not passed.
    next: Place,
    /// Of each kind, the number of the first event since which it missed none.
    begun: Place,
    /// Of each kind, events that it had before a `since`, which does not give them again.
    had: [Vec<Range<u64>>; Kind::ALL.len()],
    /// How many events the subscriber may be behind.
    allowed: u64,
    /// The events that it has missed since its last line. `None`: an unknown number.
    lost: Option<u64>,
    pub(super) waker: Option<Waker>,
}

impl Cursor {
    /// A cursor at the end of the log.
    pub(super) fn new(wanted: &Subscription, end: Place) -> Self {
        Self {
            wanted: Kind::ALL.map(|kind| wanted.kinds.contains(&kind)),
            policy: wanted.policy,
            next: end,
            begun: end,
            had: Default::default(),
            allowed: QUEUE,
            lost: Some(0),
            waker: None,
        }
    }

    pub(super) fn wants_kind(&self, kind: Kind) -> bool {
        self.wanted[kind as usize]
    }

    /// Whether a newer event of the kind and of the same sensor replaces an older one.
    pub(super) fn wants_newest(&self, kind: Kind) -> bool {
        match self.policy {
            Policy::Queue => false,
            Policy::Latest => true,
            Policy::LatestFrames => kind == Kind::Frame,
        }
    }

    /// The kinds that a `gap` counts. With the policies for views, frames are replaced silently.
    fn counted(&self) -> impl Iterator<Item = Kind> + '_ {
        let is_counted =
            |kind: Kind| self.wants_kind(kind) && (kind != Kind::Frame || !self.wants_newest(kind));
        Kind::ALL.into_iter().filter(move |&kind| is_counted(kind))
    }

    /// Whether the subscriber has passed `entry` and all that it wants before.
    pub(super) fn has_passed(&self, entry: &Entry) -> bool {
        let mut wanted = Kind::ALL.into_iter().filter(|&kind| self.wants_kind(kind));
        wanted.all(|kind| entry.before.of(kind) < self.next.of(kind))
    }

    /// Whether the subscriber wants `entry` and has not passed it.
    pub(super) fn wants(&self, entry: &Entry) -> bool {
        self.wants_kind(entry.kind) && entry.before.of(entry.kind) >= self.next.of(entry.kind)
    }

    /// The first frame that must be kept for this subscriber.
    pub(super) fn first_frame(&self) -> Option<u64> {
        let queues = self.wants_kind(Kind::Frame) && !self.wants_newest(Kind::Frame);
        queues.then(|| self.next.of(Kind::Frame))
    }

    /// The number of its events from `place` to `end` that it has not passed.
    fn between(&self, place: Place, end: Place) -> u64 {
        let of = |kind| {
            let first = place.of(kind).max(self.next.of(kind));
            end.of(kind).saturating_sub(first)
        };
        self.counted().map(of).sum()
    }

    /// Whether the subscriber is too far behind to get `entry`.
    pub(super) fn drops(&self, entry: &Entry, end: Place) -> bool {
        let is_counted = self.counted().any(|kind| kind == entry.kind);
        is_counted && self.between(entry.before, end) > self.allowed
    }

    /// Whether the subscriber had this entry before a `since`.
    pub(super) fn has_had(&self, entry: &Entry) -> bool {
        let number = entry.before.of(entry.kind);
        let mut had = self.had[entry.kind as usize].iter();
        had.any(|had| had.contains(&number))
    }

    /// Passes `entry`, which the subscriber gets or has had. What it has missed before is lost.
    pub(super) fn pass(&mut self, entry: &Entry) {
        self.pass_to(entry.before);
        self.next = self.next.after(entry.kind);
    }

    /// Moves to `place`. What the subscriber wanted up to there is lost.
    pub(super) fn pass_to(&mut self, place: Place) {
        let missed = self.between(Place::default(), place);
        if missed > 0 {
            self.lost = self.lost.map(|lost| lost + missed);
            Kind::NUMBERED
                .into_iter()
                .for_each(|kind| self.note_had(kind));
            self.begun = place;
        }
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
        for kind in Kind::ALL {
            let (index, is_wanted) = (kind as usize, wanted.kinds.contains(&kind));
            if self.wanted[index] && !is_wanted {
                self.note_had(kind);
            } else if is_wanted && !self.wanted[index] {
                (self.next.0[index], self.begun.0[index]) = (end.of(kind), end.of(kind));
            }
            self.wanted[index] = is_wanted;
        }
        self.policy = wanted.policy;
    }

    fn note_had(&mut self, kind: Kind) {
        let mut had = self.begun.of(kind)..self.next.of(kind);
        if !self.wants_kind(kind) || had.is_empty() {
            return;
        }
        let ranges = &mut self.had[kind as usize];
        ranges.retain(|other| {
            let is_apart = other.end < had.start || had.end < other.start;
            if !is_apart {
                had = had.start.min(other.start)..had.end.max(other.end);
            }
            is_apart
        });
        ranges.push(had);
    }

    /// Forgets what the subscriber had before `oldest`, because nothing can give it again.
    pub(super) fn forget_had(&mut self, oldest: Place) {
        for kind in Kind::NUMBERED {
            self.had[kind as usize].retain(|had| had.end > oldest.of(kind));
        }
    }

    /// Goes back to `place`, for numbered events. Frames go on where they are.
    pub(super) fn go_back(&mut self, place: Place, lost: Option<u64>, end: Place) {
        for kind in Kind::NUMBERED {
            self.note_had(kind);
            self.next.0[kind as usize] = place.of(kind);
        }
        (self.begun, self.lost) = (place, lost);
        self.allowed = self.between(place, end).max(QUEUE);
    }
}
