//! The whole core for one sensor: bytes and their arrival times go in, events come out.
//!
//! A pipeline owns the sensor's counts (frames, presses, damage) and its link state, which continue
//! over reconnects. It never waits, never logs and never asks the time: [`Pipeline::deadline`] says
//! when the caller must call [`Pipeline::tick`].

mod approach;
mod events;
mod input;
mod link;
mod memory;
mod objects;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

pub use self::approach::{approach_by_speed, approach_speed_mm_s, is_informative};
pub use self::events::{FIRST_LOOK, look_after};
pub use self::input::Input;
use self::link::Link;
pub use self::memory::Memory;
use self::objects::Objects;
use crate::event::{Event, FrameEvent, Phase, Tared};
use crate::frame::{RawFrame, Stamp};
use crate::motion::{Point, StepBack, Track};
use crate::press::{Abort, FrameAt, PressTracker, Thresholds};
use crate::sensor::Sensor;
use crate::tare::{self, Aim, Contact, RetareError, Tare};
use crate::verdict::{Course, Hrn, ModelError};
use crate::wire::{Decoded, Decoder};

/// The source of the frames' times.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    /// The time of a frame is when its last byte came.
    Arrival,
    /// Frame n comes n periods after 1970-01-01T00:00:00Z. This is for bytes without times.
    FrameRate,
}

/// The error of a changed description that a running pipeline cannot take over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{key} cannot change while the sensor runs")]
pub struct FixedError {
    /// The key that differs.
    pub key: &'static str,
}

/// A verdict that is missing because the model failed.
#[derive(Debug)]
pub struct Unjudged {
    /// The sensor's name.
    pub sensor: String,
    /// The press's number.
    pub press: u64,
    /// The phase of the verdict.
    pub phase: Phase,
    /// The model's error.
    pub error: ModelError,
}

/// The state of one sensor.
#[derive(Debug)]
pub struct Pipeline {
    sensor: Sensor,
    hrn: Arc<Hrn>,
    clock: Clock,
    decoder: Decoder,
    tare: Tare,
    tracker: PressTracker,
    track: Track,
    seen: Seen,
    /// When the last of the bytes came that are now decoded.
    arrival: Duration,
    /// The missing verdicts that are not fetched yet.
    unjudged: Vec<Unjudged>,
    /// The courses of presses that ended and are not fetched yet, if they are kept.
    courses: Option<Vec<Course>>,
}

/// The pipeline's own state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Seen {
    link: Link,
    context: Option<serde_json::Value>,
    objects: Objects,
    /// The speed of the approach when the press under way, or the last one, began.
    speed_mm_s: Option<f64>,
    /// The number of frames in contact at which a model of the course next judges the press under
    /// way. It is the greatest number once the early verdict has come.
    next_look: u64,
    frames: u64,
    frames_damaged: u64,
    /// The ends of recent chunks in the stream, and when they came.
    chunks: VecDeque<(u64, Stamp)>,
}

impl Pipeline {
    /// A pipeline of a sensor whose port has not been opened. The model is `hrn`.
    ///
    /// # Example
    ///
    /// One frame goes in. Out come a status (the sensor is live) and the frame.
    ///
    /// ```
    /// use std::sync::Arc;
    /// use std::time::Duration;
    ///
    /// use hardnessd_core::event::Kind;
    /// use hardnessd_core::frame::{RawFrame, Stamp};
    /// use hardnessd_core::pipeline::{Clock, Pipeline};
    /// use hardnessd_core::sensor::{Description, Sensor};
    /// use hardnessd_core::verdict::{BUILT_IN_HRN, Hrn};
    ///
    /// let sensor = Sensor::new(Description::default())?;
    /// let mut bytes = Vec::new();
    /// sensor.layout().encode(&RawFrame::default(), &mut bytes);
    ///
    /// let mut pipeline = Pipeline::new(sensor, Arc::new(Hrn::load(BUILT_IN_HRN)?), Clock::Arrival);
    /// let at = Stamp {
    ///     mono: Duration::from_secs(1),
    ///     wall: jiff::Timestamp::UNIX_EPOCH,
    /// };
    /// assert!(pipeline.opened(at).is_empty());
    /// let kinds: Vec<Kind> = pipeline.push(&bytes, at).iter().map(|event| event.kind()).collect();
    /// assert_eq!(kinds, [Kind::Status, Kind::Frame]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn new(sensor: Sensor, hrn: Arc<Hrn>, clock: Clock) -> Self {
        let described = sensor.description();
        let layout = sensor.layout();
        Self {
            tare: Tare::new(
                &described.calibration,
                layout.array(),
                contact(sensor.thresholds()),
            ),
            tracker: PressTracker::new(sensor.thresholds().clone()),
            track: Track::default(),
            decoder: Decoder::new(layout.clone()),
            seen: Seen {
                link: Link::new(),
                context: None,
                objects: Objects::default(),
                speed_mm_s: None,
                next_look: 0,
                frames: 0,
                frames_damaged: 0,
                chunks: VecDeque::new(),
            },
            sensor,
            hrn,
            clock,
            arrival: Duration::ZERO,
            unjudged: Vec::new(),
            courses: None,
        }
    }

    /// The number of whole frames and the number of damaged frames since the start.
    pub fn frame_counts(&self) -> (u64, u64) {
        (self.seen.frames, self.seen.frames_damaged)
    }

    /// Takes over a changed description of the sensor, and the model for verdicts from now on. The
    /// baseline and a press under way stay.
    ///
    /// # Errors
    ///
    /// Returns an error if the description differs in a key that cannot change while the sensor
    /// runs. Nothing has changed then.
    pub fn reload(&mut self, sensor: Sensor, hrn: Arc<Hrn>) -> Result<(), FixedError> {
        let described = sensor.description();
        if let Some(key) = self.sensor.description().fixed_difference(described) {
            return Err(FixedError { key });
        }
        self.tare
            .reload(&described.calibration, contact(sensor.thresholds()));
        self.tracker.reload(sensor.thresholds().clone());
        self.sensor = sensor;
        let is_same = hrn.sha256() == self.hrn.sha256()
            && hrn.known_references() == self.hrn.known_references();
        if !is_same {
            // Another model errs in other ways, and so does one that knows the sensor better.
            self.seen.objects = Objects::default();
        }
        self.hrn = hrn;
        Ok(())
    }

    /// Takes another tare from the next frames on. [`Self::retared`] returns its outcome. A tare is
    /// also allowed when a press has timed out and is not released, because this removes a drift
    /// that looks like a press.
    ///
    /// # Errors
    ///
    /// Returns a [`RetareError`] if no tare can be taken now. Nothing has changed then.
    pub fn retare(&mut self) -> Result<(), RetareError> {
        if self.tracker.is_pressed() {
            return Err(RetareError::Pressed);
        }
        if !self.seen.link.is_live() {
            return Err(RetareError::NotLive);
        }
        self.tare.retake()
    }

    /// The outcome of the requested tare. The next call returns `None`.
    pub fn retared(&mut self) -> Option<Result<Tared, RetareError>> {
        let sensor = self.sensor.name();
        let tared = |tare::Retaken { old, new }| Tared {
            sensor: sensor.to_owned(),
            old,
            new,
        };
        self.tare.ended().map(|outcome| outcome.map(tared))
    }

    /// Takes the controller's context. Presses and verdicts repeat it until it changes.
    pub fn set_context(&mut self, context: Option<serde_json::Value>) {
        self.seen.context = context;
    }

    /// Takes positions of the arm from the robot. `points` are finite.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Track::push`]. The points are taken nevertheless.
    pub fn add_positions(&mut self, points: &[Point]) -> Result<(), StepBack> {
        self.track.push(points)
    }

    /// Takes in that this machine's calendar clock was set: see [`Track::clock_set`].
    pub fn clock_set(&mut self, until_ns: i64) {
        self.track.clock_set(until_ns);
    }

    /// The number of positions since the start, and the number of them that came too late for their
    /// verdict.
    pub fn motion_counts(&self) -> (u64, u64) {
        self.track.counts()
    }

    /// The positions of the arm.
    pub fn track(&self) -> &Track {
        &self.track
    }

    /// Takes out the missing verdicts. Each is returned once.
    pub fn unjudged(&mut self) -> Vec<Unjudged> {
        std::mem::take(&mut self.unjudged)
    }

    /// Keeps the course of each press that ends from now on, as a model of courses takes it, until
    /// [`Self::courses`] returns it.
    pub fn keep_courses(&mut self) {
        self.courses.get_or_insert_default();
    }

    /// The kept courses that were not returned yet.
    pub fn courses(&mut self) -> Vec<Course> {
        let kept = self.courses.as_mut();
        kept.map(std::mem::take).unwrap_or_default()
    }

    /// The current sensor.
    pub fn sensor(&self) -> &Sensor {
        &self.sensor
    }

    /// The current model.
    pub fn hrn(&self) -> &Arc<Hrn> {
        &self.hrn
    }

    /// The arrival time of the last whole frame.
    pub fn last_frame(&self) -> Option<Stamp> {
        self.seen.link.last_frame
    }

    /// Call this when the port is open. The next bytes do not continue the earlier bytes.
    ///
    /// Of a port that was lost, a status follows only with a frame, or when the frame is late: a port
    /// that is lost again as soon as it is open would be two statuses each time.
    pub fn opened(&mut self, at: Stamp) -> Vec<Event> {
        self.decoder.restart();
        self.seen.chunks.clear();
        self.seen.link.opened(at.mono, self.decoder.received());
        if self.seen.link.was_lost() {
            return Vec::new();
        }
        self.status_if_changed(at)
    }

    /// Call this when the port could not be opened. A changed reason is a status, also of a sensor that
    /// is lost.
    pub fn unavailable(&mut self, reason: String, at: Stamp) -> Vec<Event> {
        self.seen.link.unavailable(reason);
        self.status_if_changed(at)
    }

    /// Takes bytes in.
    pub fn push(&mut self, bytes: &[u8], at: Stamp) -> Vec<Event> {
        let mut events = self.tick(at);
        self.decoder.push(bytes);
        self.seen.link.last_bytes = Some(at.mono);
        if self.clock == Clock::Arrival {
            self.seen.chunks.push_back((self.decoder.received(), at));
        }
        self.drain(at.mono, &mut events);
        events
    }

    /// Call this when time has passed. A silence settles a pending frame. After a longer silence
    /// the sensor is stale.
    pub fn tick(&mut self, at: Stamp) -> Vec<Event> {
        let mut events = Vec::new();
        if self.clock == Clock::FrameRate {
            return events;
        }
        if self
            .pause_deadline()
            .is_some_and(|deadline| at.mono >= deadline)
        {
            self.settle(at, &mut events);
        }
        if let Some(deadline) = self.stale_deadline()
            && at.mono >= deadline
        {
            // Count from the last frame, so that both times come from one clock reading.
            let last_frame = self
                .seen
                .link
                .last_frame
                .filter(|_| self.seen.link.is_live());
            let since = last_frame.unwrap_or(at);
            self.seen.link.silent();
            self.tare.give_up(RetareError::NotLive);
            let wait = deadline.saturating_sub(since.mono);
            let wall = since.wall.checked_add(wait).unwrap_or(at.wall);
            events.extend(self.status_if_changed(Stamp {
                mono: deadline,
                wall,
            }));
        }
        events
    }

    /// Call this when the device is gone. A press under way is aborted.
    pub fn lost(&mut self, reason: String, at: Stamp) -> Vec<Event> {
        let mut events = Vec::new();
        self.settle(at, &mut events);
        self.decoder.restart();
        self.seen.link.lost(reason);
        self.tare.give_up(RetareError::NotLive);
        events.extend(self.status_if_changed(at));
        self.abort(Abort::Lost, &mut events);
        events
    }

    /// Call this when the daemon stops. A press under way is aborted.
    pub fn shutdown(&mut self) -> Vec<Event> {
        let mut events = Vec::new();
        self.abort(Abort::Shutdown, &mut events);
        events
    }

    /// Call this when the recording ended. Pending bytes are settled, and the last status has the
    /// totals. `at` is the recording's last moment. Without it, the last frame's moment is used.
    pub fn end_of_recording(&mut self, at: Option<Stamp>) -> Vec<Event> {
        let mut events = Vec::new();
        self.settle(at.unwrap_or(EPOCH), &mut events);
        self.abort(Abort::EndOfRecording, &mut events);
        let reason = Abort::EndOfRecording.reason().to_owned();
        self.seen.link.ended(reason);
        let at = at.or(self.seen.link.last_frame).unwrap_or(EPOCH);
        // The rest of the bytes never became a frame, so count them as skipped.
        self.decoder.restart();
        events.push(Event::Status(self.status(at)));
        events
    }

    /// Takes the pending frame, because no byte follows for now. A frame that is whole without more
    /// bytes was whole when the last byte came.
    fn settle(&mut self, at: Stamp, events: &mut Vec<Event>) {
        self.decoder.settle();
        let arrival = self.seen.link.last_bytes.take().unwrap_or(at.mono);
        self.drain(arrival, events);
    }

    /// Takes all frames that are whole now. The last byte came at `arrival`.
    fn drain(&mut self, arrival: Duration, events: &mut Vec<Event>) {
        self.arrival = arrival;
        while let Some(found) = self.decoder.next_frame() {
            match found {
                Ok(Decoded { frame, end }) => {
                    let stamp = self.stamp_of(end);
                    self.take_frame(&frame, stamp, events);
                }
                Err(_damage) => self.seen.frames_damaged += 1,
            }
        }
        let settled = self.decoder.received() - self.decoder.pending() as u64;
        while self
            .seen
            .chunks
            .front()
            .is_some_and(|&(end, _)| end <= settled)
        {
            self.seen.chunks.pop_front();
        }
    }

    /// The arrival time of the byte before `end`.
    fn stamp_of(&self, end: u64) -> Stamp {
        match self.clock {
            Clock::Arrival => self
                .seen
                .chunks
                .iter()
                .find(|&&(chunk_end, _)| chunk_end >= end)
                .map_or(EPOCH, |&(_, stamp)| stamp),
            Clock::FrameRate => {
                let frame_rate_hz = self.sensor.description().frame_rate_hz;
                let mono = Duration::from_secs_f64(self.seen.frames as f64 / frame_rate_hz);
                Stamp {
                    mono,
                    wall: EPOCH.wall.checked_add(mono).unwrap_or(Timestamp::MAX),
                }
            }
        }
    }

    /// Takes in a whole frame.
    fn take_frame(&mut self, raw: &RawFrame, stamp: Stamp, events: &mut Vec<Event>) {
        let at = FrameAt {
            frame: self.seen.frames,
            stamp,
        };
        self.seen.frames += 1;
        let before = self.seen.link.frame(stamp, &self.sensor);

        let frame = self.tare.apply(raw);
        // During a tare on request, presses are tracked with the old baseline.
        let tared = !matches!(self.tare.aim(), Some(Aim::First { .. }));
        let changes = if tared {
            let marks = self.marks(raw, &frame);
            self.tracker.push(&frame, marks, at)
        } else {
            Vec::new()
        };
        if self.tracker.is_pressed() {
            self.tare.give_up(RetareError::Pressed);
        }
        // Use the seconds of the clock, so that a recalled pipeline keeps the same pace.
        let is_due = before.is_some_and(|b| b.mono.as_secs() != stamp.mono.as_secs());
        if is_due && tared && self.tracker.is_idle() {
            self.tare.follow(raw);
        }
        self.tare.observe(raw);
        events.extend(self.status_if_changed(stamp));
        let approach_mm = self.tracker.began().and_then(|began| {
            let delay_ms = self.sensor.description().arm.delay_ms;
            self.track.latest(began, stamp.mono, delay_ms)
        });
        let threshold_n = self.sensor.thresholds().contact_threshold_n;
        events.push(Event::Frame(FrameEvent {
            sensor: self.sensor.name().to_owned(),
            time: stamp.wall,
            frame: at.frame,
            rows: frame.array.rows,
            cols: frame.array.cols,
            contact_area_taxels: frame.contact_area_taxels(threshold_n),
            newtons: frame.newtons.into_vec(),
            tared,
            approach_mm,
        }));
        for change in changes {
            self.publish(change, events);
        }
        self.look(events);
    }

    fn abort(&mut self, reason: Abort, events: &mut Vec<Event>) {
        if let Some(change) = self.tracker.abort(reason) {
            self.publish(change, events);
        }
    }
}

/// The moment before the first frame of a recording without times.
const EPOCH: Stamp = Stamp {
    mono: Duration::ZERO,
    wall: Timestamp::UNIX_EPOCH,
};

fn contact(press: &Thresholds) -> Contact {
    Contact {
        threshold_n: press.contact_threshold_n,
        area_taxels: press.begin_area_taxels,
    }
}

#[cfg(test)]
mod tests;
