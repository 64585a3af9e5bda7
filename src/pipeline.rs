//! All of the core in a row, for one sensor: bytes and the moment they came go in, events come
//! out.
//!
//! It owns the sensor's numbers (frames, presses, damage) and its link state, which go on over
//! reconnects. It never waits, never logs and never asks the time: [`Pipeline::deadline`] says
//! when it wants to be told that time has passed.

mod events;
mod link;
mod retare;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use self::link::Link;
pub(crate) use self::link::STALE_PERIODS;
pub use self::retare::RetareError;
use crate::event::{self, Event, FrameEvent, LinkState, Phase, Tared};
use crate::frame::{RawFrame, Stamp};
use crate::press::{self, Abort, Moment, PressTracker};
use crate::tare::{self, Contact, Offsets, Tare};
use crate::verdict::{Hrn, ModelError};
use crate::wire::{self, Decoded, Decoder, Layout};

/// What a pipeline is made for.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Name of the sensor.
    pub sensor: String,
    /// Expected rate.
    pub frame_rate_hz: f64,
    /// How its frames are written.
    pub layout: Layout,
    /// The parts that may change while it runs.
    pub criteria: Criteria,
}

/// The part of the settings that a reload may change.
#[derive(Debug, Clone)]
pub struct Criteria {
    /// Counts to newtons.
    pub calibration: tare::Settings,
    /// What a press is.
    pub press: press::Settings,
    /// A verdict below this confidence is rejected.
    pub min_confidence: f32,
    /// A verdict on less force is rejected.
    pub min_force_n: f64,
    /// Who judges.
    pub hrn: Arc<Hrn>,
}

impl Criteria {
    /// `hrn` judges, with default settings, and rejects nothing.
    pub fn new(hrn: Arc<Hrn>) -> Self {
        Self {
            calibration: tare::Settings::default(),
            press: press::Settings::default(),
            min_confidence: 0.0,
            min_force_n: 0.0,
            hrn,
        }
    }
}

/// Where the times of frames come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    /// The moment the frame's last byte came.
    Arrival,
    /// Frame n comes n periods after 1970-01-01T00:00:00Z: bytes without times.
    FrameRate,
}

/// A verdict that was due and did not come: the model failed.
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

/// The measured rate is that over so many frames.
const RATE_FRAMES: usize = 32;

/// The state of one sensor.
#[derive(Debug)]
pub struct Pipeline {
    sensor: String,
    period: Duration,
    frame_rate_hz: f64,
    clock: Clock,
    decoder: Decoder,
    tare: Tare,
    tracker: PressTracker,
    criteria: Criteria,
    seen: Seen,
    /// When the last of the bytes came that are being decoded.
    arrival: Duration,
    /// What became of a tare that was asked for, until it is fetched.
    retared: Option<Result<Tared, RetareError>>,
    /// Verdicts that did not come, until they are fetched.
    unjudged: Vec<Unjudged>,
}

/// What the pipeline itself knows of the past.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Seen {
    link: Link,
    tare_met_contact: bool,
    /// The offsets before the tare that was asked for and is being taken.
    retaring: Option<Offsets>,
    context: Option<serde_json::Value>,
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

/// All that a pipeline has seen, without its settings: one of the same settings that recalls it
/// goes on as the first would, event for event. Recordings begin with it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    decoder: wire::Memory,
    tare: tare::Memory,
    tracker: press::Memory,
    pipeline: Seen,
}

impl Memory {
    /// Whether a pipeline can have come to this: a recording may say anything.
    pub(crate) fn is_possible(&self) -> bool {
        let Seen {
            frames,
            frames_damaged,
            recent,
            context,
            ..
        } = &self.pipeline;
        let is_context = |context: &serde_json::Value| {
            context.is_object() && context.to_string().len() < event::CONTEXT_BYTES
        };
        self.decoder
            .is_possible(frames.saturating_add(*frames_damaged))
            && self.tare.is_possible()
            && self.tracker.is_possible(*frames)
            && recent.len() <= RATE_FRAMES
            && context.as_ref().is_none_or(is_context)
    }

    /// What the controller had said it was doing.
    pub(crate) fn context(&self) -> Option<&serde_json::Value> {
        self.pipeline.context.as_ref()
    }
}

impl Pipeline {
    /// A pipeline whose port has not been opened.
    pub fn new(settings: Settings, clock: Clock) -> Self {
        let Settings {
            sensor,
            frame_rate_hz,
            layout,
            criteria,
        } = settings;
        Self {
            sensor,
            period: Duration::from_secs_f64(1.0 / frame_rate_hz),
            frame_rate_hz,
            clock,
            tare: Tare::new(
                &criteria.calibration,
                layout.array(),
                contact(&criteria.press),
            ),
            tracker: PressTracker::new(criteria.press.clone()),
            decoder: Decoder::new(layout),
            criteria,
            seen: Seen {
                link: Link::Closed { reason: None },
                tare_met_contact: false,
                retaring: None,
                context: None,
                frames: 0,
                frames_damaged: 0,
                chunks: VecDeque::new(),
                recent: VecDeque::with_capacity(RATE_FRAMES),
                last_bytes: None,
                last_frame: None,
                told: (LinkState::Connecting, None),
            },
            arrival: Duration::ZERO,
            retared: None,
            unjudged: Vec::new(),
        }
    }

    /// All it has seen.
    pub fn memory(&self) -> Memory {
        Memory {
            decoder: self.decoder.memory(),
            tare: self.tare.memory(),
            tracker: self.tracker.memory(),
            pipeline: self.seen.clone(),
        }
    }

    /// Goes on where the one of the same settings stood whose memory this is.
    pub fn recall(&mut self, memory: Memory) {
        self.decoder.recall(memory.decoder);
        self.tare.recall(memory.tare);
        self.tracker.recall(memory.tracker);
        self.seen = memory.pipeline;
        self.retared = None;
    }

    /// Whole frames and damaged ones since the start.
    pub fn frame_counts(&self) -> (u64, u64) {
        (self.seen.frames, self.seen.frames_damaged)
    }

    /// Takes over changed settings at once. The baseline and a press under way stay.
    pub fn reload(&mut self, criteria: Criteria) {
        if criteria.calibration.tare_frames == 0 {
            self.abandon_retare(RetareError::NoFrames);
            self.seen.tare_met_contact = false;
        }
        self.tare
            .reload(&criteria.calibration, contact(&criteria.press));
        self.tracker.reload(criteria.press.clone());
        self.criteria = criteria;
    }

    /// What the controller says it is doing: echoed in presses and verdicts until it changes.
    pub fn set_context(&mut self, context: Option<serde_json::Value>) {
        self.seen.context = context;
    }

    /// Verdicts that did not come, each told once.
    pub fn unjudged(&mut self) -> Vec<Unjudged> {
        std::mem::take(&mut self.unjudged)
    }

    /// Name of the sensor.
    pub fn sensor(&self) -> &str {
        &self.sensor
    }

    /// When the last whole frame came.
    pub fn last_frame(&self) -> Option<Stamp> {
        self.seen.last_frame
    }

    /// What may change while it runs, as it is now.
    pub fn criteria(&self) -> &Criteria {
        &self.criteria
    }

    /// The port is open: what comes next does not continue what came before.
    pub fn opened(&mut self, at: Stamp) -> Vec<Event> {
        self.decoder.restart();
        self.seen.chunks.clear();
        self.seen.last_bytes = None;
        if matches!(self.seen.link, Link::Closed { .. }) {
            self.seen.link = Link::Opened { since: at.mono };
        }
        self.status_if_changed(at)
    }

    /// The port could not be opened. Once it has been open, the loss already says so.
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

    /// Time has passed: a silence settles a pending frame, and a longer one is stale.
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
            self.seen.link = Link::Stale;
            self.abandon_retare(RetareError::NotLive);
            // From the last frame on, so that its time and this one are of one clock reading.
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
        self.abandon_retare(RetareError::NotLive);
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

    /// The recording ended: what is pending is settled, and the last status carries the totals.
    /// `at` is the recording's own last moment; without one, that of the last frame.
    pub fn end_of_recording(&mut self, at: Option<Stamp>) -> Vec<Event> {
        let mut events = Vec::new();
        self.settle(at.unwrap_or(EPOCH), &mut events);
        self.abort(Abort::EndOfRecording, &mut events);
        self.seen.link = Link::Lost {
            reason: Abort::EndOfRecording.reason().to_owned(),
        };
        let at = at.or(self.seen.last_frame).unwrap_or(EPOCH);
        // What is left over never became a frame.
        self.decoder.restart();
        events.push(Event::Status(self.status(at)));
        events
    }

    /// No byte follows for now. What is whole then was so with the last byte that came.
    fn settle(&mut self, at: Stamp, events: &mut Vec<Event>) {
        self.decoder.settle();
        let arrival = self.seen.last_bytes.take().unwrap_or(at.mono);
        self.drain(arrival, events);
    }

    /// Takes what is whole now that bytes have come, the last at `arrival`.
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
                let mono = Duration::from_secs_f64(self.seen.frames as f64 / self.frame_rate_hz);
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
        self.seen.last_frame = Some(stamp);
        // A rate is not one over a silence.
        if self.seen.link == Link::Stale {
            self.seen.recent.clear();
        }
        if self.seen.recent.len() == RATE_FRAMES {
            self.seen.recent.pop_front();
        }
        self.seen.recent.push_back(stamp.mono);
        self.seen.link = Link::Live { since: stamp.mono };

        let frame = self.tare.apply(raw);
        // A baseline stands, be it that another is being taken.
        let tared = !self.tare.is_taking() || self.seen.retaring.is_some();
        let changes = if tared {
            let marks = self.marks(raw, &frame);
            self.tracker.push(&frame, marks, at)
        } else {
            Vec::new()
        };
        if self.tracker.is_pressed() {
            self.abandon_retare(RetareError::Pressed);
        }
        self.observe(raw);
        events.extend(self.status_if_changed(stamp));
        events.push(Event::Frame(FrameEvent::new(
            self.sensor.clone(),
            stamp.wall,
            at.frame,
            frame.newtons.to_vec(),
            frame.contact_area_taxels(self.criteria.press.contact_threshold_n),
        )));
        for change in changes {
            self.publish(change, events);
        }
    }

    fn abort(&mut self, reason: Abort, events: &mut Vec<Event>) {
        if let Some(change) = self.tracker.abort(reason) {
            self.publish(change, events);
        }
    }
}

/// Before any frame of a recording without times.
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
