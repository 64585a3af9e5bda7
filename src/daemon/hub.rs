//! The hub, which numbers events, holds them and hands them to subscribers.
//!
//! In: events of the sensors, in the order in which they happen. Out: lines. Each line is
//! serialised once and shared by all subscribers that want it. Subscribers fetch their lines, so a
//! slow subscriber costs a bounded queue and does not delay the others. When its queue is full, the
//! oldest event is dropped and counted, and a `gap` reports the number before the next event. This
//! file has no clock and no channel: [`task`] has both.

mod history;
mod subscriber;
mod tally;
mod task;

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

pub(crate) use self::history::History;
use self::subscriber::Subscriber;
pub(crate) use self::tally::{Counts, Tally, Verdicts};
pub(crate) use self::task::{Closed, Handle, start};
use super::log;
use super::record::EventRecorder;
use super::request::Subscription;
use hardnessd_core::event::{Event, Hello, Kind, Reply, Status};

/// A line to send.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Line {
    /// The number of the event, if it has one. In a `hello`, the number of the latest event.
    pub(crate) seq: Option<u64>,
    /// The JSON of the line, with its newline.
    pub(crate) json: Arc<str>,
    /// The event that the line was made from. A reply has none, and neither has a line that is
    /// held.
    pub(crate) event: Option<Arc<Event>>,
}

impl From<Reply> for Line {
    fn from(reply: Reply) -> Self {
        Self {
            seq: None,
            json: reply.to_line().into(),
            event: None,
        }
    }
}

impl From<Arc<Event>> for Line {
    fn from(event: Arc<Event>) -> Self {
        Self {
            seq: event.seq(),
            json: event.to_line().into(),
            event: Some(event),
        }
    }
}

impl From<Status> for Line {
    fn from(status: Status) -> Self {
        Arc::new(Event::Status(status)).into()
    }
}

impl Line {
    /// The kind and the sensor of the line's event.
    fn about(&self) -> Option<(Kind, &str)> {
        let event = self.event.as_deref()?;
        Some((event.kind(), event.sensor()))
    }

    /// The same line to hold for a long time, with its text but without its event.
    pub(crate) fn to_hold(&self) -> Self {
        Self {
            event: None,
            ..self.clone()
        }
    }
}

/// The number of events that are held for `since` (`docs/controller.md`).
const HELD: usize = 4096;

/// A numbered event as it was sent.
#[derive(Debug, Clone)]
struct Held {
    kind: Kind,
    line: Line,
}

/// The whole state of the hub. It has no clock.
struct Hub {
    hello: Hello,
    /// The last [`HELD`] events. The newest has the number `hello.seq`.
    held: VecDeque<Held>,
    /// The number of events that are no longer held, by kind.
    forgotten: [u64; Kind::NUMBERED.len()],
    /// The last final verdict of each sensor.
    finals: BTreeMap<String, Line>,
    /// The force and contact area of each sensor.
    histories: BTreeMap<String, History>,
    tally: Tally,
    recorder: EventRecorder,
    subscribers: BTreeMap<u64, Subscriber>,
    joined: u64,
}

impl Hub {
    fn new(hello: Hello) -> Self {
        Self {
            hello,
            held: VecDeque::new(),
            forgotten: [0; Kind::NUMBERED.len()],
            finals: BTreeMap::new(),
            histories: BTreeMap::new(),
            tally: Tally::default(),
            recorder: EventRecorder::default(),
            subscribers: BTreeMap::new(),
            joined: 0,
        }
    }

    /// Numbers `event` and offers it to every subscriber that wants it. Returns whether there was
    /// anything to offer. `now` is a time of CLOCK_MONOTONIC.
    fn publish(&mut self, mut event: Event, now: Duration) -> bool {
        let kind = event.kind();
        if let Event::Hardness(verdict) = &mut event {
            // Round to microseconds, because further digits are noise of the clock.
            verdict.age_at_publish_ms = verdict.mono_ns.map(|at| {
                let age = now.saturating_sub(Duration::from_nanos(at));
                (age.as_secs_f64() * 1e6).round() / 1e3
            });
            let latency = now.saturating_sub(verdict.arrival).as_micros();
            verdict.latency_us = Some(u64::try_from(latency).unwrap_or(u64::MAX));
        }
        if kind != Kind::Frame {
            self.hello.seq += 1;
            event.number(self.hello.seq);
        }
        self.recorder.event(&event);
        if let Event::Frame(frame) = &event {
            match self.histories.get_mut(&frame.sensor) {
                Some(history) => history.add(frame),
                None => self
                    .histories
                    .entry(frame.sensor.clone())
                    .or_default()
                    .add(frame),
            }
        }
        let mut subscribers = self.subscribers.values();
        if kind == Kind::Frame && !subscribers.any(|subscriber| subscriber.wants(kind)) {
            return false;
        }
        let event = Arc::new(event);
        let line = Line::from(event.clone());
        if line.seq.is_some() {
            log::event(&event);
            self.tally.count(&event);
            self.keep(Held {
                kind,
                line: line.to_hold(),
            });
        }
        if let Event::Hardness(verdict) = &*event
            && verdict.phase == hardnessd_core::event::Phase::Final
        {
            self.finals.insert(verdict.sensor.clone(), line.to_hold());
        }
        for subscriber in self.subscribers.values_mut() {
            self.tally.dropped += subscriber.offer(&line);
        }
        true
    }

    /// Describes the daemon with `hello` from now on. The run and the numbers stay. What was counted and
    /// kept of sensors that `hello` lacks is forgotten.
    fn describe(&mut self, hello: Hello) {
        self.hello = Hello {
            seq: self.hello.seq,
            run: std::mem::take(&mut self.hello.run),
            ..hello
        };
        let sensors = &self.hello.sensors;
        let is_there = |name: &str| sensors.iter().any(|sensor| sensor.name == name);
        self.finals.retain(|name, _| is_there(name));
        self.histories.retain(|name, _| is_there(name));
        self.tally.sensors.retain(|name, _| is_there(name));
    }

    fn keep(&mut self, held: Held) {
        if self.held.len() == HELD {
            let oldest = self.held.pop_front().expect("HELD is not 0");
            self.forgotten[oldest.kind as usize] += 1;
        }
        self.held.push_back(held);
    }

    /// The number of the oldest event that is held.
    fn oldest(&self) -> u64 {
        self.hello.seq + 1 - self.held.len() as u64
    }

    /// Adds a subscriber, with the default subscription from now on.
    fn join(&mut self) -> (u64, Line) {
        self.joined += 1;
        self.subscribers.insert(self.joined, Subscriber::default());
        let hello = Line {
            seq: Some(self.hello.seq),
            ..Reply::Hello(self.hello.clone()).into()
        };
        (self.joined, hello)
    }

    /// Changes what a subscriber gets from now on.
    fn subscribe(&mut self, id: u64, wanted: &Subscription) -> Result<(), Ahead> {
        let (latest, oldest) = (self.hello.seq, self.oldest());
        let Some(subscriber) = self.subscribers.get_mut(&id) else {
            return Ok(());
        };
        let Some(since) = &wanted.since else {
            subscriber.change(wanted.kinds.clone(), wanted.policy);
            return Ok(());
        };
        let known = since.run == self.hello.run;
        if known && since.seq > latest {
            let found = since.seq;
            return Err(Ahead { found, latest });
        }
        subscriber.change(wanted.kinds.clone(), wanted.policy);
        let first = if known { since.seq + 1 } else { oldest };
        let is_wanted = |kind: &Kind| wanted.kinds.contains(kind);
        let missing = match first.max(oldest) - first {
            0 if known => Some(0),
            // Every numbered event is wanted, so each number that is no longer held is a missed
            // event.
            gone if known && Kind::NUMBERED.iter().all(is_wanted) => Some(gone),
            // From the start of the run, every event that is no longer held was missed.
            _ if known && since.seq == 0 => {
                let wanted = Kind::NUMBERED.into_iter().filter(is_wanted);
                Some(wanted.map(|kind| self.forgotten[kind as usize]).sum())
            }
            // The kinds of the missed events are no longer known.
            _ => None,
        };
        let held = (first.max(oldest)..=latest).zip(
            self.held
                .iter()
                .skip(usize::try_from(first.max(oldest) - oldest).expect("HELD fits in a usize")),
        );
        subscriber.replay(held.map(|(seq, held)| (seq, held.kind)), missing);
        Ok(())
    }

    /// The force and contact area of a sensor in the last two minutes. `None` if there is no such
    /// sensor.
    fn history(&self, sensor: &str) -> Option<History> {
        let known = self.hello.sensors.iter().any(|one| one.name == sensor);
        known.then(|| self.histories.get(sensor).cloned().unwrap_or_default())
    }

    /// Whether lines wait for a subscriber.
    fn has_lines(&self, id: u64) -> bool {
        let subscriber = self.subscribers.get(&id);
        subscriber.is_some_and(Subscriber::has_lines)
    }

    /// The next lines of a subscriber; empty if there are none.
    fn take(&mut self, id: u64) -> Vec<Line> {
        let oldest = self.oldest();
        let Some(subscriber) = self.subscribers.get_mut(&id) else {
            return Vec::new();
        };
        let lines = subscriber.take(|seq| {
            let place = usize::try_from(seq.checked_sub(oldest)?).ok()?;
            Some(self.held.get(place)?.line.clone())
        });
        self.tally.gaps += std::mem::take(&mut subscriber.gaps);
        lines
    }
}

/// The current state of the hub.
#[derive(Debug)]
pub(crate) struct Survey {
    /// The `hello` with the number of the latest event.
    pub(crate) hello: Hello,
    /// The last final verdict of each sensor.
    pub(crate) finals: BTreeMap<String, Line>,
    pub(crate) tally: Tally,
    pub(crate) subscribers: usize,
}

/// The error of a `since` that this run has not reached.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error("since: found {found}, expected at most {latest}")]
pub(crate) struct Ahead {
    found: u64,
    latest: u64,
}

#[cfg(test)]
pub(super) mod tests;
