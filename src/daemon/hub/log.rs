//! The log: the last numbered events, the frames that somebody still reads, and the state of each
//! sensor. It has no clock and no channel.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use super::cursor::{Cursor, Place, QUEUE};
use crate::daemon::record::Jobs;
use crate::daemon::request::{Since, Subscription};
use crate::daemon::sensor::SensorState;
use crate::daemon::{log, now};
use hardnessd_core::event::{Event, Hello, Kind, LinkState, Phase, Reply, Status, name};

/// The number of numbered events that are held for `since` (`docs/controller.md`).
pub(super) const HELD: usize = 4096;

/// A read ends with the line that reaches this many bytes. So one write carries many events, and a
/// subscriber that has stopped reading holds little beside the log.
const BATCH_BYTES: usize = 32 * 1024;

/// A line to send.
#[derive(Debug)]
pub(crate) struct Line {
    /// The event that the line was made from. A reply has none.
    pub(crate) event: Option<Box<Event>>,
    /// The JSON with its newline, once somebody needs it.
    text: OnceLock<Box<str>>,
}

impl Line {
    /// The number of the event, if it has one.
    pub(crate) fn seq(&self) -> Option<u64> {
        self.event.as_ref()?.seq()
    }

    /// The JSON of the line, with its newline.
    pub(crate) fn json(&self) -> &str {
        self.text.get_or_init(|| {
            let event = self.event.as_ref();
            event
                .expect("a line without an event has its text")
                .to_line()
                .into()
        })
    }

    fn of_event(event: Event) -> Arc<Self> {
        Arc::new(Self {
            event: Some(Box::new(event)),
            text: OnceLock::new(),
        })
    }

    /// The line of a reply.
    pub(crate) fn reply(reply: &Reply) -> Arc<Self> {
        Arc::new(Self {
            event: None,
            text: OnceLock::from(reply.to_line().into_boxed_str()),
        })
    }

    /// The line of a status that is not an event: it has no number.
    pub(crate) fn status(status: Status) -> Arc<Self> {
        let line = Self::of_event(Event::Status(status));
        // Whoever makes it also formats it, because the sensors' thread has no time for it.
        line.json();
        line
    }
}

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

/// The name of a metric, and the labels of one of its series.
pub(crate) type Series = (&'static str, Vec<(&'static str, String)>);

/// Counts of one sensor.
pub(crate) type Counts = BTreeMap<Series, u64>;

/// The series that an event counts in.
fn series_of(event: &Event) -> Option<Series> {
    match event {
        Event::Status(_) | Event::Frame(_) => None,
        Event::Press(press) => Some(("presses", vec![("state", name(&press.state))])),
        Event::Hardness(verdict) => {
            let phase = ("phase", name(&verdict.phase));
            match (&verdict.rejected, verdict.level) {
                (Some(reason), _) => {
                    Some(("verdicts_rejected", vec![phase, ("reason", name(reason))]))
                }
                (None, level) => {
                    level.map(|level| ("verdicts", vec![phase, ("level", level.to_string())]))
                }
            }
        }
    }
}

/// What the log keeps of a sensor.
#[derive(Debug, Default)]
struct OfSensor {
    state: Option<SensorState>,
    /// The last final verdict.
    last: Option<Arc<Line>>,
    counts: Counts,
    /// The numbers of its numbered events and of its frames in the log so far.
    entries: [u64; 2],
}

impl OfSensor {
    /// The number of its events so far that are counted together with those of `kind`.
    fn entries(&self, kind: Kind) -> u64 {
        self.entries[usize::from(kind == Kind::Frame)]
    }

    /// How many of these there were from `entry` on.
    fn since(&self, entry: &Entry) -> u64 {
        self.entries(entry.kind).saturating_sub(entry.nth)
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

/// The whole state of the hub. It belongs to the sensors' thread.
#[derive(Debug, Default)]
pub(crate) struct Log {
    hello: Hello,
    recorder: Option<Jobs>,
    /// The last [`HELD`] numbered events, and older ones within the share of their sensor.
    events: VecDeque<Entry>,
    /// The newest frame of each sensor, and those that a subscriber with a queue has not read. There are
    /// none if nobody wants frames.
    pub(super) frames: VecDeque<Entry>,
    /// The place after the newest event. Frames that nobody wanted do not count.
    end: Place,
    sensors: BTreeMap<Arc<str>, OfSensor>,
    pub(super) subscribers: BTreeMap<u64, Cursor>,
    joined: u64,
    gaps: u64,
    dropped: u64,
    pub(super) is_closed: bool,
}

impl Log {
    pub(super) fn new(hello: Hello) -> Self {
        Self {
            hello,
            ..Self::default()
        }
    }

    /// Numbers `event`, holds it, and wakes the subscribers that want it. `now` is a time of
    /// CLOCK_MONOTONIC.
    pub(crate) fn publish(&mut self, mut event: Event, now: Duration) {
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
        if let Some(recorder) = &self.recorder {
            recorder.event(&event);
        }
        if kind == Kind::Frame && !self.wants_frames() {
            return;
        }
        let sensor: Arc<str> = event.sensor().into();
        let of_sensor = self.sensors.entry(Arc::clone(&sensor)).or_default();
        if let Some(series) = series_of(&event) {
            *of_sensor.counts.entry(series).or_default() += 1;
        }
        log::event(&event);
        let is_final = matches!(&event, Event::Hardness(verdict) if verdict.phase == Phase::Final);
        let line = Line::of_event(event);
        if kind != Kind::Frame {
            line.json();
        }
        if is_final {
            of_sensor.last = Some(Arc::clone(&line));
        }
        let nth = of_sensor.entries(kind);
        of_sensor.entries[usize::from(kind == Kind::Frame)] += 1;
        let before = self.end;
        self.end = before.after(kind);
        let held = match kind {
            Kind::Frame => &mut self.frames,
            _ => &mut self.events,
        };
        held.push_back(Entry {
            before,
            kind,
            sensor,
            nth,
            line,
        });
        self.forget();
        let interested = self.subscribers.values();
        interested
            .filter(|subscriber| subscriber.wants_kind(kind))
            .for_each(|subscriber| subscriber.changed.notify_one());
    }

    fn wants_frames(&self) -> bool {
        let mut subscribers = self.subscribers.values();
        subscribers.any(|one| one.wants_kind(Kind::Frame))
    }

    /// Forgets the entries that are old, and the frames that nobody reads any more. Each sensor has an
    /// equal share of a queue, and keeps it.
    fn forget(&mut self) {
        let (sensors, end) = (&self.sensors, self.end);
        let is_held = |entry: &Entry| {
            entry.before.seq() + HELD as u64 >= end.seq() || is_in_share(sensors, entry)
        };
        while self.events.front().is_some_and(|entry| !is_held(entry)) {
            self.events.pop_front();
        }
        // The other ones are looked through only now and then.
        if self.events.len() > HELD + 3 * QUEUE as usize / 2 {
            self.events.retain(is_held);
        }
        if !self.wants_frames() {
            self.frames.clear();
        }
        let read = self.subscribers.values().filter_map(Cursor::first_frame);
        let read = read.min().unwrap_or(u64::MAX);
        self.frames.retain(|entry| {
            let frame = entry.before.of(Kind::Frame);
            let is_newest = || {
                sensors
                    .get(&entry.sensor)
                    .is_some_and(|of_sensor| of_sensor.since(entry) == 1)
            };
            let is_new = || frame + QUEUE >= end.of(Kind::Frame) || is_in_share(sensors, entry);
            frame >= read && is_new() || is_newest()
        });
    }

    /// Takes over the current state of a sensor.
    pub(crate) fn report(&mut self, state: SensorState) {
        // No name is made where there is one, because this happens with each frame.
        match self.sensors.get_mut(state.status.sensor.as_str()) {
            Some(of_sensor) => of_sensor.state = Some(state),
            None => {
                let of_sensor = self.sensors.entry(state.status.sensor.as_str().into());
                of_sensor.or_default().state = Some(state);
            }
        }
    }

    /// Passes every event on to `recorder` from now on.
    pub(crate) fn record(&mut self, recorder: Jobs) {
        self.recorder = Some(recorder);
    }

    /// Changes the `hello` of new subscribers. The run and the numbers stay.
    pub(crate) fn describe(&mut self, hello: Hello) {
        self.hello = Hello {
            seq: self.hello.seq,
            run: std::mem::take(&mut self.hello.run),
            ..hello
        };
    }

    /// Closes the log after its last event. Subscribers get the remaining lines, and then no more.
    pub(crate) fn close(&mut self) {
        self.is_closed = true;
        self.recorder = None;
        for subscriber in self.subscribers.values() {
            subscriber.changed.notify_one();
        }
    }

    /// The number of sensors that are live, and of all.
    pub(crate) fn live(&self) -> (usize, usize) {
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

    /// Adds a subscriber, and returns its number. The error is for the subscriber.
    pub(super) fn join(&mut self, wanted: &Subscription) -> Result<u64, String> {
        let id = self.joined + 1;
        self.subscribers.insert(id, Cursor::new(self.end));
        self.subscribe(id, wanted).inspect_err(|_| self.leave(id))?;
        self.joined = id;
        Ok(id)
    }

    pub(super) fn leave(&mut self, id: u64) {
        self.subscribers.remove(&id);
        self.forget();
    }

    /// Changes what a subscriber gets from now on.
    pub(super) fn subscribe(&mut self, id: u64, wanted: &Subscription) -> Result<(), String> {
        let since = wanted.since.as_ref();
        let from = since
            .map(|since| self.place_of(since, wanted))
            .transpose()?;
        if let Some(cursor) = self.subscribers.get_mut(&id) {
            cursor.change(wanted, self.end);
            if let Some((place, lost)) = from {
                cursor.go_back(place, lost, self.end);
            }
        }
        self.forget();
        Ok(())
    }

    /// The first place that is held after `since`, and the number of wanted events that are no longer
    /// held before it. `None` if that is not known.
    fn place_of(
        &self,
        since: &Since,
        wanted: &Subscription,
    ) -> Result<(Place, Option<u64>), String> {
        let (found, latest) = (since.seq, self.hello.seq);
        if since.run != self.hello.run {
            let oldest = self.events.front().map_or(self.end, |entry| entry.before);
            return Ok((oldest, None));
        }
        if found > latest {
            return Err(format!("since: found {found}, expected at most {latest}"));
        }
        // The event `since` itself may be held, or the one after it.
        let is_before = |entry: &Entry| entry.before.seq() < found;
        let next = self.events.partition_point(is_before);
        let held = self.events.get(next).map_or(self.end, |entry| entry.before);
        let last = next.checked_sub(1).map(|index| &self.events[index]);
        let after = last.map(|entry| entry.before.after(entry.kind));
        let mut places = [after, Some(held)].into_iter().flatten();
        if let Some(place) = places.find(|place| place.seq() == found) {
            return Ok((place, Some(0)));
        }
        // The kinds of the events between are no longer known.
        let wants_all = Kind::NUMBERED
            .iter()
            .all(|kind| wanted.kinds.contains(kind));
        Ok((held, wants_all.then(|| held.seq() - found)))
    }

    /// The next lines of a subscriber. Empty if there are none.
    pub(super) fn read(&mut self, id: u64) -> Vec<Arc<Line>> {
        let end = self.end;
        let Some(cursor) = self.subscribers.get_mut(&id) else {
            return Vec::new();
        };
        if cursor.has_all(end) {
            return Vec::new();
        }
        cursor.forget_had(&self.events);
        let held = [&self.events, &self.frames].into_iter();
        let is_ahead = |entry: &&Entry| !cursor.has_passed(entry);
        let ahead = held.flat_map(|held| held.iter().rev().take_while(is_ahead));
        let mut entries: Vec<&Entry> = ahead.filter(|entry| cursor.wants(entry)).collect();
        // The newest first, because it replaces those of its kind and sensor where only the newest counts.
        entries.sort_unstable_by_key(|entry| Reverse(entry.before.total()));
        let mut newer = BTreeSet::new();
        entries.retain(|entry| {
            !cursor.wants_newest(entry.kind)
                || newer.insert((entry.kind, &*entry.sensor))
                || cursor.has_had(entry)
        });
        let mut announced = |cursor: &mut Cursor| {
            let lost = cursor.take_lost()?;
            self.gaps += 1;
            self.dropped += lost.unwrap_or(0);
            Some(Line::reply(&Reply::Gap { lost }))
        };
        let mut lines = Vec::new();
        let mut bytes = 0;
        for entry in entries.into_iter().rev() {
            if cursor.has_had(entry) {
                cursor.pass(entry);
                continue;
            }
            if cursor.drops(entry, end) && !is_in_share(&self.sensors, entry) {
                continue;
            }
            cursor.pass(entry);
            lines.extend(announced(cursor));
            bytes += entry.line.json().len();
            lines.push(Arc::clone(&entry.line));
            if bytes >= BATCH_BYTES {
                cursor.tighten(end);
                return lines;
            }
        }
        // Events after the last one are of other kinds, or they are no longer held.
        cursor.pass_to(end);
        lines.extend(announced(cursor));
        cursor.tighten(end);
        lines
    }
}

/// Whether a subscriber gets `entry` however far it is behind. Each sensor has an equal share of a
/// queue. So events of one that sends much do not displace those of the others.
fn is_in_share(sensors: &BTreeMap<Arc<str>, OfSensor>, entry: &Entry) -> bool {
    let share = QUEUE / (sensors.len() as u64).max(1);
    let of_sensor = sensors.get(&entry.sensor);
    of_sensor.is_some_and(|of_sensor| of_sensor.since(entry) <= share)
}
