//! The log: the last numbered events, the frames that somebody still reads, and the state of each
//! sensor. It has no clock and no channel.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::task::Waker;
use std::time::Duration;

use super::cursor::{Cursor, Place, QUEUE};
use super::history::History;
use super::quota::LineQuota;
use super::tally::Counts;
use super::{Line, SinceInFuture};
use crate::daemon::record::EventRecorder;
use crate::daemon::request::{Policy, Since, Subscription};
use crate::daemon::sensor::SensorState;
use crate::daemon::{log, now};
use hardnessd_core::event::{Event, Hello, Kind, LinkState, Phase, Reply};
use hardnessd_core::judge::Unjudged;

/// The number of numbered events that are held for `since` (`docs/controller.md`).
pub(super) const HELD: usize = 4096;

/// A read ends with the line that reaches this many bytes. So one write carries many events, and a
/// subscriber that has stopped reading holds little beside the log.
const BATCH_BYTES: usize = 32 * 1024;

/// Whether events are held beside their texts, for the libraries that make messages of their own of
/// them.
const HOLDS_EVENTS: bool = cfg!(any(
    feature = "foxglove",
    feature = "ros2",
    feature = "zenoh"
));

/// An event in the log.
#[derive(Debug, Clone)]
pub(super) struct Entry {
    pub(super) before: Place,
    pub(super) kind: Kind,
    sensor: Arc<str>,
    /// The number of earlier events of this sensor: of its frames, or of its numbered events.
    nth: u64,
    pub(super) line: Arc<Line>,
}

/// What the log keeps of a sensor.
#[derive(Debug, Default)]
struct OfSensor {
    state: Option<SensorState>,
    /// The last final verdict.
    last: Option<Arc<Line>>,
    history: History,
    counts: Counts,
    /// The numbers of its numbered events and of its frames in the log so far.
    entries: [u64; 2],
    lines: LineQuota,
}

impl OfSensor {
    /// The number of its events so far that are counted together with those of `kind`.
    fn entries(&mut self, kind: Kind) -> &mut u64 {
        &mut self.entries[usize::from(kind == Kind::Frame)]
    }
}

/// The current state of the log and of all sensors.
#[derive(Debug)]
pub(crate) struct Snapshot {
    /// The `hello` with the number of the latest event.
    pub(crate) hello: Hello,
    /// The state of every sensor, in the order of `hello`.
    pub(crate) sensors: Vec<SensorSnapshot>,
    pub(crate) subscribers: usize,
    /// The number of `gap` lines sent.
    pub(crate) gaps: u64,
    /// The number of events that these gaps announced as lost.
    pub(crate) dropped: u64,
}

impl Snapshot {
    /// What a connection begins with: `hello`, then the status of every sensor.
    pub(crate) fn greeting(self) -> Vec<Arc<Line>> {
        let hello = Line::reply(&Reply::Hello(self.hello.clone()));
        [hello].into_iter().chain(self.statuses()).collect()
    }

    /// The status of every sensor, without numbers.
    pub(crate) fn statuses(self) -> impl Iterator<Item = Arc<Line>> {
        let sensors = self.sensors.into_iter();
        sensors.map(|sensor| Line::status(sensor.state.status))
    }
}

/// The current state of a sensor.
#[derive(Debug)]
pub(crate) struct SensorSnapshot {
    pub(crate) state: SensorState,
    /// The age of the sensor's last whole frame.
    pub(crate) last_frame_age: Option<Duration>,
    /// The last final verdict.
    pub(crate) last: Option<Arc<Line>>,
    pub(crate) counts: Counts,
}

/// The whole state of the hub.
#[derive(Debug)]
pub(super) struct Log {
    hello: Hello,
    recorder: EventRecorder,
    /// The last [`HELD`] numbered events.
    events: VecDeque<Entry>,
    /// The frames that a subscriber with the policy `queue` has not read, at most [`QUEUE`].
    pub(super) frames: VecDeque<Entry>,
    /// The newest frame of each sensor, for the other policies.
    pub(super) newest_frames: BTreeMap<Arc<str>, Entry>,
    /// The place after the newest event. Frames that nobody wanted do not count.
    end: Place,
    sensors: BTreeMap<Arc<str>, OfSensor>,
    subscribers: BTreeMap<u64, Cursor>,
    joined: u64,
    gaps: u64,
    dropped: u64,
    is_closed: bool,
}

impl Log {
    pub(super) fn new(hello: Hello) -> Self {
        Self {
            hello,
            recorder: EventRecorder::default(),
            events: VecDeque::new(),
            frames: VecDeque::new(),
            newest_frames: BTreeMap::new(),
            end: Place::default(),
            sensors: BTreeMap::new(),
            subscribers: BTreeMap::new(),
            joined: 0,
            gaps: 0,
            dropped: 0,
            is_closed: false,
        }
    }

    /// Numbers `event`, holds it, and wakes the subscribers that want it. `now` is a time of
    /// CLOCK_MONOTONIC.
    pub(super) fn publish(&mut self, mut event: Event, now: Duration) {
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
        let (sensor, of_sensor) = self.of_sensor(event.sensor());
        match &event {
            Event::Frame(frame) => of_sensor.history.add(frame),
            event => {
                of_sensor.counts.count(event);
                of_sensor
                    .lines
                    .write(&sensor, now, log::is_routine(event), || log::event(event));
            }
        }
        let is_final = matches!(&event, Event::Hardness(verdict) if verdict.phase == Phase::Final);
        if kind == Kind::Frame && !self.subscribers.values().any(|one| one.wants_kind(kind)) {
            return;
        }
        let mut line = Line::of_event(event);
        if kind != Kind::Frame {
            line.json();
            if !HOLDS_EVENTS && let Some(line) = Arc::get_mut(&mut line) {
                line.event = None;
            }
        }
        if is_final {
            self.of_sensor(&sensor).1.last = Some(Arc::clone(&line));
        }
        let before = self.end;
        self.end = before.after(kind);
        let entries = self.of_sensor(&sensor).1.entries(kind);
        let nth = *entries;
        *entries += 1;
        self.hold(Entry {
            before,
            kind,
            sensor,
            nth,
            line,
        });
        for subscriber in self.subscribers.values_mut() {
            if subscriber.wants_kind(kind)
                && let Some(waker) = subscriber.waker.take()
            {
                waker.wake();
            }
        }
    }

    fn hold(&mut self, entry: Entry) {
        if entry.kind == Kind::Frame {
            self.newest_frames
                .insert(Arc::clone(&entry.sensor), entry.clone());
            self.frames.push_back(entry);
            self.forget_frames();
        } else {
            self.events.push_back(entry);
            let oldest = self.end.seq().saturating_sub(HELD as u64);
            let sensors = &self.sensors;
            forget(&mut self.events, HELD, |entry| {
                entry.before.seq() >= oldest || is_in_share(sensors, entry)
            });
        }
    }

    /// Logs that the model failed on a press.
    pub(super) fn unjudged(&mut self, failed: &Unjudged, now: Duration) {
        let (sensor, of_sensor) = self.of_sensor(&failed.sensor);
        let line = || log::unjudged(failed);
        of_sensor.lines.write(&sensor, now, false, line);
    }

    /// Forgets the frames that nobody reads any more.
    fn forget_frames(&mut self) {
        if !self
            .subscribers
            .values()
            .any(|one| one.wants_kind(Kind::Frame))
        {
            self.newest_frames.clear();
        }
        let read = self.subscribers.values().filter_map(Cursor::frames_read);
        let read = read.min().unwrap_or(u64::MAX);
        let oldest = self.end.of(Kind::Frame).saturating_sub(QUEUE);
        let sensors = &self.sensors;
        forget(&mut self.frames, QUEUE as usize, |entry| {
            let frame = entry.before.of(Kind::Frame);
            frame >= read && (frame >= oldest || is_in_share(sensors, entry))
        });
    }

    fn of_sensor(&mut self, name: &str) -> (Arc<str>, &mut OfSensor) {
        let known = self.sensors.get_key_value(name);
        let name = known.map_or_else(|| name.into(), |(name, _)| Arc::clone(name));
        let of_sensor = self.sensors.entry(Arc::clone(&name)).or_default();
        (name, of_sensor)
    }

    /// Takes over the current state of a sensor.
    pub(super) fn report(&mut self, state: SensorState) {
        let (_, of_sensor) = self.of_sensor(&state.status.sensor);
        of_sensor.state = Some(state);
    }

    pub(super) fn record(&mut self, recorder: EventRecorder) {
        self.recorder = recorder;
    }

    /// Describes the daemon with `hello` from now on. What is kept of sensors that `hello` lacks is
    /// forgotten.
    pub(super) fn describe(&mut self, hello: Hello) {
        self.hello = Hello {
            seq: self.hello.seq,
            run: std::mem::take(&mut self.hello.run),
            ..hello
        };
        let names = self.hello.sensors.iter();
        let names: BTreeSet<&str> = names.map(|sensor| sensor.name.as_str()).collect();
        self.sensors.retain(|name, _| names.contains(&**name));
        self.newest_frames.retain(|name, _| names.contains(&**name));
    }

    pub(super) fn close(&mut self) {
        self.is_closed = true;
        self.recorder = EventRecorder::default();
        let wakers = self.subscribers.values_mut();
        for waker in wakers.filter_map(|one| one.waker.take()) {
            waker.wake();
        }
    }

    pub(super) fn is_closed(&self) -> bool {
        self.is_closed
    }

    /// The number of sensors that are live, and of all.
    pub(super) fn live(&self) -> (usize, usize) {
        let states = self.sensors.values().filter_map(|one| one.state.as_ref());
        let live = states.filter(|one| one.status.state == LinkState::Live);
        (live.count(), self.sensors.len())
    }

    pub(super) fn snapshot(&self) -> Snapshot {
        let now = now();
        let names = self.hello.sensors.iter().map(|sensor| sensor.name.as_str());
        let sensors = names.filter_map(|name| {
            let of_sensor = self.sensors.get(name)?;
            let mut state = of_sensor.state.clone()?;
            state.status.time = now.wall;
            let last_frame = state.last_frame;
            Some(SensorSnapshot {
                state,
                last_frame_age: last_frame.map(|at| now.mono.saturating_sub(at)),
                last: of_sensor.last.clone(),
                counts: of_sensor.counts.clone(),
            })
        });
        Snapshot {
            hello: self.hello.clone(),
            sensors: sensors.collect(),
            subscribers: self.subscribers.len(),
            gaps: self.gaps,
            dropped: self.dropped,
        }
    }

    /// The force and contact area of a sensor in the last two minutes. `None` if there is no such
    /// sensor.
    pub(super) fn history(&self, sensor: &str) -> Option<History> {
        let known = self.hello.sensors.iter().any(|one| one.name == sensor);
        let of_sensor = self.sensors.get(sensor);
        known.then(|| of_sensor.map_or_else(History::default, |one| one.history.clone()))
    }

    /// Adds a subscriber, and returns its number.
    pub(super) fn join(&mut self, wanted: &Subscription) -> Result<u64, SinceInFuture> {
        let id = self.joined + 1;
        self.subscribers.insert(id, Cursor::new(wanted, self.end));
        if let Err(refused) = self.subscribe(id, wanted) {
            self.leave(id);
            return Err(refused);
        }
        self.joined = id;
        Ok(id)
    }

    pub(super) fn leave(&mut self, id: u64) {
        self.subscribers.remove(&id);
        self.forget_frames();
    }

    /// Wakes the subscriber when there may be lines for it.
    pub(super) fn wait(&mut self, id: u64, waker: &Waker) {
        if let Some(subscriber) = self.subscribers.get_mut(&id) {
            subscriber.waker = Some(waker.clone());
        }
    }

    /// The place before the oldest numbered event that is held.
    fn oldest(&self) -> Place {
        self.events.front().map_or(self.end, |entry| entry.before)
    }

    /// Changes what a subscriber gets from now on.
    pub(super) fn subscribe(
        &mut self,
        id: u64,
        wanted: &Subscription,
    ) -> Result<(), SinceInFuture> {
        let from = match &wanted.since {
            Some(since) => Some(self.place_of(since, wanted)?),
            None => None,
        };
        let (oldest, end) = (self.oldest(), self.end);
        if let Some(cursor) = self.subscribers.get_mut(&id) {
            cursor.note_had(oldest.seq());
            cursor.change(wanted, end);
            if let Some((place, lost)) = from {
                cursor.go_back(place, lost, end);
            }
        }
        self.forget_frames();
        Ok(())
    }

    /// The first place that is held after `since`, and the number of wanted events that are no longer
    /// held before it.
    fn place_of(
        &self,
        since: &Since,
        wanted: &Subscription,
    ) -> Result<(Place, Option<u64>), SinceInFuture> {
        let (oldest, latest) = (self.oldest(), self.hello.seq);
        if since.run != self.hello.run {
            return Ok((oldest, None));
        }
        if since.seq > latest {
            let found = since.seq;
            return Err(SinceInFuture { found, latest });
        }
        // The event `since` itself may be held, or the one after it.
        let next = self
            .events
            .partition_point(|entry| entry.before.seq() < since.seq);
        let held = self.events.get(next).map_or(self.end, |entry| entry.before);
        let last = next.checked_sub(1).map(|index| &self.events[index]);
        let after = last.map(|entry| entry.before.after(entry.kind));
        let places = [after, Some(held)].into_iter().flatten();
        if let Some(place) = places.into_iter().find(|place| place.seq() == since.seq) {
            return Ok((place, Some(0)));
        }
        let is_wanted = |kind: &Kind| wanted.kinds.contains(kind);
        let lost = if Kind::NUMBERED.iter().all(is_wanted) {
            Some(held.seq() - since.seq)
        } else if since.seq == 0 {
            let kinds = Kind::NUMBERED.into_iter().filter(is_wanted);
            Some(kinds.map(|kind| held.of(kind)).sum())
        } else {
            // The kinds of these events are no longer known.
            None
        };
        Ok((held, lost))
    }

    /// The next lines of a subscriber. Empty if there are none.
    pub(super) fn read(&mut self, id: u64) -> Vec<Arc<Line>> {
        let (oldest, end) = (self.oldest().seq(), self.end);
        let Some(cursor) = self.subscribers.get_mut(&id) else {
            return Vec::new();
        };
        if cursor.has_all(end) {
            return Vec::new();
        }
        let events = from(&self.events, cursor.place);
        let newest: BTreeMap<_, _> = match cursor.policy {
            Policy::Latest => events
                .clone()
                .map(|entry| (entry.about(), entry.before))
                .collect(),
            Policy::Queue | Policy::LatestFrames => BTreeMap::new(),
        };
        let frames: Vec<&Entry> = match cursor.policy {
            _ if !cursor.wants_kind(Kind::Frame) => Vec::new(),
            Policy::Queue => from(&self.frames, cursor.place).collect(),
            Policy::Latest | Policy::LatestFrames => self.newest_frames.values().collect(),
        };
        let mut entries: Vec<&Entry> = events.chain(frames).collect();
        entries.sort_unstable_by_key(|entry| entry.before.total());
        let mut announced = |cursor: &mut Cursor| {
            let lost = cursor.take_lost()?;
            self.gaps += 1;
            self.dropped += lost.unwrap_or(0);
            Some(Line::reply(&Reply::Gap { lost }))
        };
        let mut lines = Vec::new();
        let mut bytes = 0;
        for entry in entries {
            if !cursor.wants(entry) {
                continue;
            }
            if cursor.has_had(entry) {
                cursor.reach(entry, oldest);
                continue;
            }
            let is_superseded = newest
                .get(&entry.about())
                .is_some_and(|place| place.seq() > entry.before.seq());
            if is_superseded || (cursor.drops(entry, end) && !is_in_share(&self.sensors, entry)) {
                continue;
            }
            cursor.reach(entry, oldest);
            lines.extend(announced(cursor));
            bytes += entry.line.json().len();
            lines.push(Arc::clone(&entry.line));
            if bytes >= BATCH_BYTES {
                cursor.tighten(end);
                return lines;
            }
        }
        // Events after the last one are of other kinds, the subscriber has had them, or they are no longer
        // held.
        cursor.reach_end(end, oldest);
        lines.extend(announced(cursor));
        cursor.tighten(end);
        lines
    }
}

impl Entry {
    /// The kind and the sensor of the event. With the policy `latest`, the newest of each counts.
    fn about(&self) -> (Kind, &str) {
        (self.kind, &self.sensor)
    }
}

/// Whether a subscriber gets `entry` however far it is behind. Each sensor has an equal share of a
/// queue. So events of one that sends much do not displace those of the others.
fn is_in_share(sensors: &BTreeMap<Arc<str>, OfSensor>, entry: &Entry) -> bool {
    let share = QUEUE / (sensors.len() as u64).max(1);
    sensors.get(&entry.sensor).is_some_and(|of_sensor| {
        let entries = of_sensor.entries[usize::from(entry.kind == Kind::Frame)];
        (entries.saturating_sub(share)..entries).contains(&entry.nth)
    })
}

/// Forgets the oldest entries that are not kept. The other ones are looked through only now and then.
/// `held` is how many of them are usually kept.
fn forget(entries: &mut VecDeque<Entry>, held: usize, is_kept: impl Fn(&Entry) -> bool) {
    while entries.front().is_some_and(|entry| !is_kept(entry)) {
        entries.pop_front();
    }
    // At most as many as a queue holds are kept for their sensors' sake.
    let queue = QUEUE as usize;
    if entries.len() > held + queue + queue / 2 {
        entries.retain(is_kept);
    }
}

/// The entries from `place` on.
fn from(entries: &VecDeque<Entry>, place: Place) -> impl Iterator<Item = &Entry> + Clone {
    let first = entries.partition_point(|entry| entry.before.total() < place.total());
    entries.range(first..)
}
