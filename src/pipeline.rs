//! The whole core, for one sensor: bytes and the moment they came go in, events come out.
//!
//! It owns the sensor's numbers (frames, presses, damage) and its link state, which go on over
//! reconnects. It never waits, never logs and never asks the time: [`Pipeline::deadline`] says
//! when it must be told that time has passed.

mod course;
mod events;
mod link;
mod memory;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use self::link::Link;
pub use self::memory::Memory;
use crate::event::{Event, FrameEvent, LinkState, Phase, Tared};
use crate::frame::{RawFrame, Stamp};
use crate::motion::{Point, StepBack, Track};
use crate::press::{self, Abort, Moment, PressTracker};
use crate::sensor::Sensor;
use crate::tare::{self, Aim, Contact, RetareError, Tare};
use crate::verdict::{Hrn, ModelError};
use crate::wire::{Decoded, Decoder};

/// Where the times of frames come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    /// The moment the frame's last byte came.
    Arrival,
    /// Frame n comes n periods after 1970-01-01T00:00:00Z: bytes without times.
    FrameRate,
}

/// A changed description that a running pipeline cannot take over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("{key} cannot change while the sensor runs")]
pub struct FixedError {
    /// The key that differs.
    pub key: &'static str,
}

/// A verdict that was due, but the model failed.
#[derive(Debug)]
pub struct Unjudged {
    /// Name of the sensor.
    pub sensor: String,
    /// Number of the press.
    pub press: u64,
    /// When in the press it was to be judged.
    pub phase: Phase,
    /// How the model failed.
    pub error: ModelError,
}

/// The rate is measured over this many frames.
const RATE_FRAMES: usize = 32;

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
    /// When the last of the bytes came that are being decoded.
    arrival: Duration,
    /// Verdicts that did not come, until they are fetched.
    unjudged: Vec<Unjudged>,
}

/// What the pipeline itself knows of the past.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Seen {
    link: Link,
    context: Option<serde_json::Value>,
    /// Speed of the approach when the press under way, or the last one, began.
    #[serde(default)]
    speed_mm_s: Option<f64>,
    /// A model of the course judges the press under way when it has this many frames in contact;
    /// the greatest number once its early verdict has come.
    #[serde(default)]
    next_look: u64,
    frames: u64,
    frames_damaged: u64,
    /// Ends of recent chunks in the stream, and when they came.
    chunks: VecDeque<(u64, Stamp)>,
    /// When the latest frames came.
    recent: VecDeque<Duration>,
    last_bytes: Option<Duration>,
    last_frame: Option<Stamp>,
    /// State and reason of the last status published.
    told: (LinkState, Option<String>),
}

impl Pipeline {
    /// A pipeline of a sensor whose port has not been opened; `hrn` judges.
    ///
    /// # Example
    ///
    /// One frame goes in. Out come a status (the sensor is live) and the frame.
    ///
    /// ```
    /// use std::sync::Arc;
    /// use std::time::Duration;
    ///
    /// use hardnessd::event::Kind;
    /// use hardnessd::frame::{RawFrame, Stamp};
    /// use hardnessd::pipeline::{Clock, Pipeline};
    /// use hardnessd::sensor::{Description, Sensor};
    /// use hardnessd::verdict::{BUILT_IN, Hrn};
    ///
    /// let sensor = Sensor::new(Description::default())?;
    /// let mut bytes = Vec::new();
    /// sensor.layout().encode(&RawFrame::default(), &mut bytes);
    ///
    /// let mut pipeline = Pipeline::new(sensor, Arc::new(Hrn::load(BUILT_IN)?), Clock::Arrival);
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
                contact(&described.press),
            ),
            tracker: PressTracker::new(described.press.clone()),
            track: Track::default(),
            decoder: Decoder::new(layout.clone()),
            seen: Seen {
                link: Link::Closed { reason: None },
                context: None,
                speed_mm_s: None,
                next_look: 0,
                frames: 0,
                frames_damaged: 0,
                chunks: VecDeque::new(),
                recent: VecDeque::with_capacity(RATE_FRAMES),
                last_bytes: None,
                last_frame: None,
                told: (LinkState::Connecting, None),
            },
            sensor,
            hrn,
            clock,
            arrival: Duration::ZERO,
            unjudged: Vec::new(),
        }
    }

    /// Counts whole frames and damaged ones since the start.
    pub fn frame_counts(&self) -> (u64, u64) {
        (self.seen.frames, self.seen.frames_damaged)
    }

    /// Takes over a changed description of the sensor, and the model that judges from now on. The
    /// baseline and a press under way stay.
    ///
    /// # Errors
    ///
    /// If the description differs in what cannot change while it runs. Nothing has changed then.
    pub fn reload(&mut self, sensor: Sensor, hrn: Arc<Hrn>) -> Result<(), FixedError> {
        let described = sensor.description();
        if let Some(key) = self.sensor.description().fixed_difference(described) {
            return Err(FixedError { key });
        }
        self.tare
            .reload(&described.calibration, contact(&described.press));
        self.tracker.reload(described.press.clone());
        self.sensor = sensor;
        self.hrn = hrn;
        Ok(())
    }

    /// Takes another tare from the next frames on; [`Self::retared`] says what became of it. It is
    /// taken too when a press has timed out and is not released: that mends a drift which looks
    /// like a press.
    ///
    /// # Errors
    ///
    /// If one cannot be taken now: see [`RetareError`]. Nothing has changed then.
    pub fn retare(&mut self) -> Result<(), RetareError> {
        if self.tracker.is_pressed() {
            return Err(RetareError::Pressed);
        }
        if !matches!(self.seen.link, Link::Live { .. }) {
            return Err(RetareError::NotLive);
        }
        self.tare.retake()
    }

    /// What became of a tare that was asked for, once.
    pub fn retared(&mut self) -> Option<Result<Tared, RetareError>> {
        let sensor = self.sensor.name();
        let tared = |tare::Retaken { old, new }| Tared {
            sensor: sensor.to_owned(),
            old,
            new,
        };
        self.tare.ended().map(|outcome| outcome.map(tared))
    }

    /// Takes what the controller says it is doing. Presses and verdicts echo it until it changes.
    pub fn set_context(&mut self, context: Option<serde_json::Value>) {
        self.seen.context = context;
    }

    /// Takes what the robot tells of where its arm is. `points` are finite.
    ///
    /// # Errors
    ///
    /// As [`Track::push`]: the points are taken nevertheless.
    pub fn tell(&mut self, points: &[Point]) -> Result<(), StepBack> {
        self.track.push(points)
    }

    /// Positions told since the start, and those among them that came too late for their verdict.
    pub fn motion_counts(&self) -> (u64, u64) {
        self.track.counts()
    }

    /// Gives the verdicts that did not come, each once.
    pub fn unjudged(&mut self) -> Vec<Unjudged> {
        std::mem::take(&mut self.unjudged)
    }

    /// The sensor, as it is now.
    pub fn sensor(&self) -> &Sensor {
        &self.sensor
    }

    /// The model that judges now.
    pub fn hrn(&self) -> &Arc<Hrn> {
        &self.hrn
    }

    /// When the last whole frame came.
    pub fn last_frame(&self) -> Option<Stamp> {
        self.seen.last_frame
    }

    /// The port is open. The next bytes do not continue those that came before.
    pub fn opened(&mut self, at: Stamp) -> Vec<Event> {
        self.decoder.restart();
        self.seen.chunks.clear();
        self.seen.last_bytes = None;
        if matches!(self.seen.link, Link::Closed { .. }) {
            self.seen.link = Link::Opened { since: at.mono };
        }
        self.status_if_changed(at)
    }

    /// The port could not be opened. If it has been open before, the loss already says so.
    pub fn unavailable(&mut self, reason: String, at: Stamp) -> Vec<Event> {
        if let Link::Closed { reason: known } = &mut self.seen.link {
            *known = Some(reason);
        }
        self.status_if_changed(at)
    }

    /// Bytes came.
    pub fn push(&mut self, bytes: &[u8], at: Stamp) -> Vec<Event> {
        let mut events = self.tick(at);
        self.decoder.push(bytes);
        self.seen.last_bytes = Some(at.mono);
        if self.clock == Clock::Arrival {
            self.seen.chunks.push_back((self.decoder.received(), at));
        }
        self.drain(at.mono, &mut events);
        events
    }

    /// Time has passed. A silence settles a pending frame; after a longer one the sensor is stale.
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
            self.seen.link = match self.seen.link {
                Link::Opened { .. } => Link::Silent,
                _ => Link::Stale,
            };
            self.tare.give_up(RetareError::NotLive);
            // Counted from the last frame, so that its time and this one come from one clock reading.
            let since = self.seen.last_frame.unwrap_or(at);
            let wait = deadline.saturating_sub(since.mono);
            let wall = since.wall.checked_add(wait).unwrap_or(at.wall);
            events.extend(self.status_if_changed(Stamp {
                mono: deadline,
                wall,
            }));
        }
        events
    }

    /// The device is gone: a press under way is aborted.
    pub fn lost(&mut self, reason: String, at: Stamp) -> Vec<Event> {
        let mut events = Vec::new();
        self.settle(at, &mut events);
        self.decoder.restart();
        self.seen.recent.clear();
        self.seen.link = Link::Lost { reason };
        self.tare.give_up(RetareError::NotLive);
        events.extend(self.status_if_changed(at));
        self.abort(Abort::Lost, &mut events);
        events
    }

    /// The daemon stops: a press under way is aborted.
    pub fn shutdown(&mut self) -> Vec<Event> {
        let mut events = Vec::new();
        self.abort(Abort::Shutdown, &mut events);
        events
    }

    /// The recording ended. What is pending is settled, and the last status carries the totals. `at`
    /// is the recording's last moment; without one, the last frame's is taken.
    pub fn end_of_recording(&mut self, at: Option<Stamp>) -> Vec<Event> {
        let mut events = Vec::new();
        self.settle(at.unwrap_or(EPOCH), &mut events);
        self.abort(Abort::EndOfRecording, &mut events);
        self.seen.link = Link::Lost {
            reason: Abort::EndOfRecording.reason().to_owned(),
        };
        let at = at.or(self.seen.last_frame).unwrap_or(EPOCH);
        // The bytes that are left never became a frame.
        self.decoder.restart();
        events.push(Event::Status(self.status(at)));
        events
    }

    /// No byte follows for now. A frame that is whole then was whole when the last byte came.
    fn settle(&mut self, at: Stamp, events: &mut Vec<Event>) {
        self.decoder.settle();
        let arrival = self.seen.last_bytes.take().unwrap_or(at.mono);
        self.drain(arrival, events);
    }

    /// Takes the frames that are whole now. The last byte came at `arrival`.
    fn drain(&mut self, arrival: Duration, events: &mut Vec<Event>) {
        self.arrival = arrival;
        while let Some(found) = self.decoder.next_frame() {
            match found {
                Ok(Decoded { frame, end }) => {
                    let stamp = self.stamp_of(end);
                    self.take(&frame, stamp, events);
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

    /// When the byte before `end` came.
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

    /// A whole frame.
    fn take(&mut self, raw: &RawFrame, stamp: Stamp, events: &mut Vec<Event>) {
        let at = Moment {
            frame: self.seen.frames,
            stamp,
        };
        self.seen.frames += 1;
        let before = self.seen.last_frame.replace(stamp);
        // A rate over a silence would be none.
        if matches!(self.seen.link, Link::Silent | Link::Stale) {
            self.seen.recent.clear();
        }
        if self.seen.recent.len() == RATE_FRAMES {
            self.seen.recent.pop_front();
        }
        self.seen.recent.push_back(stamp.mono);
        self.seen.link = Link::Live { since: stamp.mono };

        let frame = self.tare.apply(raw);
        // While another baseline is taken on request, presses are tracked with the one in force.
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
        // With the seconds of the clock: a pipeline that is recalled keeps the same pace.
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
        let shown = FrameEvent::new(
            self.sensor.name().to_owned(),
            stamp.wall,
            at.frame,
            frame.newtons.to_vec(),
            frame.contact_area_taxels(self.sensor.description().press.contact_threshold_n),
            tared,
        );
        events.push(Event::Frame(FrameEvent {
            approach_mm,
            ..shown
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

fn contact(press: &press::Settings) -> Contact {
    Contact {
        threshold_n: press.contact_threshold_n,
        area_taxels: press.begin_area_taxels,
    }
}

#[cfg(test)]
mod tests;
