//! The whole core for one sensor: bytes and their arrival times go in, events come out.
//!
//! A pipeline owns the sensor's counts (frames, presses, damage) and its link state, which continue
//! over reconnects. It never waits, never logs and never asks the time: [`Pipeline::deadline`] says
//! when the caller must call [`Pipeline::take`] with a tick. All that happens goes through
//! [`Pipeline::take`], live and in a replay.

mod at_rest;
mod input;
mod link;
mod pace;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

use jiff::Timestamp;
use serde_json::Value;

pub use self::at_rest::AtRest;
pub use self::input::{Input, Refused};
use self::link::Link;
use self::pace::Pace;
use crate::event::{Event, FrameEvent, Press, PressState, Tared};
use crate::frame::{RawFrame, Stamp};
use crate::judge::{EndedPress, Judge, Moment, OwnPresses, Unjudged};
use crate::motion::Track;
use crate::press::{Change, ContactFrame, End, FrameAt, PressTracker, Thresholds};
use crate::sensor::Sensor;
use crate::tare::{Aim, Contact, RetareError, Tare};
use crate::verdict::Model;
use crate::wire::{Decoded, Decoder};

/// The source of the frames' times.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Clock {
    /// The time of a frame is when its last byte came.
    Arrival,
    /// Frame n comes n periods after 1970-01-01T00:00:00Z. This is for bytes without times.
    FrameRate,
}

/// The state of one sensor.
#[derive(Debug)]
pub struct Pipeline {
    sensor: Arc<Sensor>,
    clock: Clock,
    decoder: Decoder,
    tare: Tare,
    tracker: PressTracker,
    judge: Judge,
    link: Link,
    /// The taxels in contact when the last press timed out, in words.
    unreleased: Option<String>,
    frames: u64,
    frames_damaged: u64,
    pace: Pace,
    /// The ends of recent chunks in the stream, and when they came.
    chunks: VecDeque<(u64, Stamp)>,
    /// When the last of the bytes came that are now decoded.
    arrival: Duration,
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
    /// use hardnessd_core::pipeline::{Clock, Input, Pipeline};
    /// use hardnessd_core::sensor::{Description, Sensor};
    /// use hardnessd_core::verdict::{BUILT_IN_HRN, Model};
    ///
    /// let sensor = Sensor::new(Description::default())?;
    /// let mut bytes = Vec::new();
    /// sensor.layout().encode(&RawFrame::default(), &mut bytes);
    ///
    /// let mut pipeline = Pipeline::new(sensor, Arc::new(Model::load(BUILT_IN_HRN)?), Clock::Arrival);
    /// let at = Stamp {
    ///     mono: Duration::from_secs(1),
    ///     wall: jiff::Timestamp::UNIX_EPOCH,
    /// };
    /// assert!(pipeline.take(Input::Opened, at)?.is_empty());
    /// let events = pipeline.take(Input::Bytes(bytes), at)?;
    /// let kinds: Vec<Kind> = events.iter().map(|event| event.kind()).collect();
    /// assert_eq!(kinds, [Kind::Status, Kind::Frame]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn new(sensor: Sensor, hrn: Arc<Model>, clock: Clock) -> Self {
        let sensor = Arc::new(sensor);
        let layout = sensor.layout();
        let mut decoder = Decoder::new(layout.clone());
        if clock == Clock::FrameRate {
            // A file of bytes begins with a frame, as if after a pause.
            decoder.settle();
        }
        Self {
            tare: Tare::new(
                sensor.calibration(),
                layout.array(),
                contact(sensor.thresholds()),
            ),
            tracker: PressTracker::new(sensor.thresholds().clone()),
            judge: Judge::new(Arc::clone(&sensor), hrn),
            decoder,
            link: Link::new(),
            unreleased: None,
            frames: 0,
            frames_damaged: 0,
            pace: Pace::default(),
            chunks: VecDeque::new(),
            arrival: Duration::ZERO,
            sensor,
            clock,
        }
    }

    /// The number of whole frames and the number of damaged frames since the start. The first includes
    /// the frames that were dropped.
    pub fn frame_counts(&self) -> (u64, u64) {
        (self.frames + self.pace.dropped, self.frames_damaged)
    }

    /// The outcome of the requested tare. The next call returns `None`.
    pub fn retared(&mut self) -> Option<Result<Tared, RetareError>> {
        let outcome = self.tare.outcome()?;
        let sensor = self.sensor.name().to_owned();
        Some(outcome.map(|[old, new]| Tared { sensor, old, new }))
    }

    /// The positions of the arm.
    pub fn track(&self) -> &Track {
        &self.judge.track
    }

    /// Takes out the missing verdicts. Each is returned once.
    pub fn unjudged(&mut self) -> Vec<Unjudged> {
        std::mem::take(&mut self.judge.unjudged)
    }

    /// Keeps each press that ends from now on, until [`Self::ended`] returns it.
    pub fn keep_courses(&mut self) {
        self.judge.ended.get_or_insert_default();
    }

    /// The kept presses that were not returned yet.
    pub fn ended(&mut self) -> Vec<EndedPress> {
        let kept = self.judge.ended.as_mut();
        kept.map(std::mem::take).unwrap_or_default()
    }

    /// The controller's context.
    pub fn context(&self) -> Option<&Value> {
        self.judge.context.as_ref()
    }

    /// The own presses of the sensor.
    pub fn own_presses(&self) -> &OwnPresses {
        &self.judge.kept.own
    }

    /// Takes over own presses of the sensor that an earlier pipeline collected.
    pub fn take_own_presses(&mut self, own: OwnPresses) {
        self.judge.take_own(own);
    }

    /// The current sensor.
    pub fn sensor(&self) -> &Sensor {
        &self.sensor
    }

    /// The current model.
    pub fn hrn(&self) -> &Arc<Model> {
        &self.judge.hrn
    }

    /// The arrival time of the last whole frame.
    pub fn last_frame(&self) -> Option<Stamp> {
        self.link.last_frame
    }

    /// Begins another tare. A tare is also allowed when a press has timed out and is not released,
    /// because this removes a drift that looks like a press.
    fn retare(&mut self) -> Result<(), RetareError> {
        if self.tracker.is_pressed() {
            return Err(RetareError::Pressed);
        }
        if !self.link.is_live() {
            return Err(RetareError::NotLive);
        }
        self.tare.retake()
    }

    /// The port is open. The next bytes do not continue the earlier bytes.
    ///
    /// Of a port that was lost, a status follows only with a frame, or when the frame is late: a port
    /// that is lost again as soon as it is open would be two statuses each time.
    fn opened(&mut self, at: Stamp) -> Option<Event> {
        self.decoder.restart();
        self.chunks.clear();
        self.link.opened(at.mono);
        match self.link.was_lost {
            true => None,
            false => self.status_if_changed(at),
        }
    }

    fn push(&mut self, bytes: &[u8], at: Stamp) -> Vec<Event> {
        let mut events = self.tick(at);
        self.decoder.push(bytes);
        if self.clock == Clock::Arrival {
            self.chunks.push_back((self.decoder.received(), at));
        }
        self.link.last_bytes = Some(at.mono);
        self.drain(at.mono, &mut events);
        if self.link.is_silent() {
            events.extend(self.status_if_changed(at));
        }
        events
    }

    /// Bytes came that nobody reads.
    fn skip(&mut self, bytes: u64, at: Stamp) -> Vec<Event> {
        self.link.skipped(at.mono);
        self.pace.skipped(at.mono);
        let mut events = self.tick(at);
        self.settle(at, &mut events);
        self.decoder.skip(bytes);
        self.chunks.clear();
        if self.link.is_live() {
            events.extend(self.status_if_changed(at));
        }
        events
    }

    /// Time has passed. A silence settles a pending frame. After a longer silence the sensor is stale.
    fn tick(&mut self, at: Stamp) -> Vec<Event> {
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
        if let Some((deadline, during)) = self.stale_deadline()
            && at.mono >= deadline
        {
            // Count from the last frame, so that both times come from one clock reading.
            let last_frame = self.link.last_frame.filter(|_| self.link.is_live());
            let since = last_frame.unwrap_or(at);
            self.link.silent(during);
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

    /// The device is gone. A press under way is aborted.
    fn lost(&mut self, reason: String, at: Stamp) -> Vec<Event> {
        let mut events = Vec::new();
        self.settle(at, &mut events);
        self.decoder.restart();
        self.link.lost(reason);
        self.tare.give_up(RetareError::NotLive);
        events.extend(self.status_if_changed(at));
        self.abort(End::Lost, &mut events);
        events
    }

    /// Ends a press under way without a verdict.
    pub(crate) fn abort(&mut self, end: End, events: &mut Vec<Event>) {
        if let Some(change) = self.tracker.abort(end) {
            self.publish(change, events);
        }
    }

    /// Call this when the recording ended. Pending bytes are settled, and the last status has the
    /// totals. `at` is the recording's last moment. Without it, the last frame's moment is used.
    pub fn end_of_recording(&mut self, at: Option<Stamp>) -> Vec<Event> {
        let mut events = Vec::new();
        self.settle(at.unwrap_or(Stamp::EPOCH), &mut events);
        self.abort(End::EndOfRecording, &mut events);
        self.link.ended("end of recording".to_owned());
        let at = at.or(self.link.last_frame).unwrap_or(Stamp::EPOCH);
        // The rest of the bytes never became a frame, so count them as skipped.
        self.decoder.restart();
        events.push(Event::Status(self.status(at)));
        events
    }

    /// Takes the pending frame, because no byte follows for now. A frame that is whole without more
    /// bytes was whole when the last byte came.
    fn settle(&mut self, at: Stamp, events: &mut Vec<Event>) {
        self.decoder.settle();
        let arrival = self.link.last_bytes.take().unwrap_or(at.mono);
        self.drain(arrival, events);
    }

    /// Takes all frames that are whole now. The last byte came at `arrival`.
    fn drain(&mut self, arrival: Duration, events: &mut Vec<Event>) {
        self.arrival = arrival;
        while let Some(found) = self.decoder.next_frame() {
            match found {
                Ok(Decoded { frame, end }) => {
                    let stamp = self.stamp_of(end);
                    let period = self.sensor.period();
                    // Without times of their own, frames come at the configured rate.
                    if self.clock == Clock::FrameRate || self.pace.takes(stamp.mono, period) {
                        self.take_frame(&frame, stamp, events);
                    } else {
                        self.link.came(stamp);
                        events.extend(self.status_if_changed(stamp));
                    }
                }
                Err(_damage) => {
                    self.frames_damaged += 1;
                    if self.clock == Clock::FrameRate {
                        // The frames of a file follow each other without a pause.
                        self.decoder.resync();
                    }
                }
            }
        }
        let decoded = self.decoder.place().decoded;
        while self.chunks.front().is_some_and(|&(end, _)| end <= decoded) {
            self.chunks.pop_front();
        }
    }

    /// The arrival time of the byte before `end`.
    fn stamp_of(&self, end: u64) -> Stamp {
        match self.clock {
            Clock::Arrival => self
                .chunks
                .iter()
                .find(|&&(chunk_end, _)| chunk_end >= end)
                .map_or(Stamp::EPOCH, |&(_, stamp)| stamp),
            Clock::FrameRate => {
                let frame_rate_hz = self.sensor.frame_rate_hz();
                let mono = Duration::from_secs_f64(self.frames as f64 / frame_rate_hz);
                Stamp {
                    mono,
                    wall: Stamp::EPOCH
                        .wall
                        .checked_add(mono)
                        .unwrap_or(Timestamp::MAX),
                }
            }
        }
    }

    /// Takes in a whole frame.
    fn take_frame(&mut self, raw: &RawFrame, stamp: Stamp, events: &mut Vec<Event>) {
        let at = FrameAt {
            frame: self.frames,
            stamp,
        };
        self.frames += 1;
        let before = self.link.frame(stamp);

        let frame = self.tare.apply(raw);
        // During a tare on request, presses are tracked with the old baseline.
        let tared = !matches!(self.tare.aim(), Some(Aim::First { .. }));
        let threshold_n = self.sensor.thresholds().contact_threshold_n;
        let full_scale = self.sensor.layout().full_scale();
        let contact_area_taxels = frame.contact_area_taxels(threshold_n);
        // Most frames touch nothing: they change nothing while no press is under way.
        let is_idle = contact_area_taxels == 0 && self.tracker.is_idle();
        let contact = (!is_idle).then(|| ContactFrame {
            saturated: full_scale.is_some_and(|most| self.tare.is_saturated(raw, most)),
            ..ContactFrame::new(&frame, threshold_n, at)
        });
        let force_n = contact.as_ref().map_or(0.0, |contact| contact.force_n);
        let tracked = contact.filter(|_| tared);
        let change = tracked.and_then(|contact| self.tracker.push(contact));
        if self.tracker.is_pressed() {
            self.tare.give_up(RetareError::Pressed);
        }
        if let Some(Change::End {
            end: End::Timeout, ..
        }) = &change
        {
            self.unreleased = Some(link::in_contact(&frame, threshold_n));
        }
        // Use the seconds of the clock, so that a resumed pipeline keeps the same pace.
        let is_due = before.is_some_and(|b| b.mono.as_secs() != stamp.mono.as_secs());
        if is_due && tared && self.tracker.is_idle() {
            self.tare.follow(raw);
        }
        self.tare.observe(raw);
        events.extend(self.status_if_changed(stamp));
        let approach_mm = self.tracker.so_far().and_then(|press| {
            let delay_ms = self.sensor.arm().delay_ms;
            let track = &self.judge.track;
            track.latest(press.began, stamp.mono, delay_ms)
        });
        events.push(Event::Frame(FrameEvent {
            sensor: self.sensor.name().to_owned(),
            time: stamp.wall,
            frame: at.frame,
            rows: frame.array.rows,
            cols: frame.array.cols,
            contact_area_taxels,
            force_n: tared.then_some(force_n),
            newtons: frame.newtons.into_vec(),
            tared,
            approach_mm,
        }));
        if let Some(change) = change {
            self.publish(change, events);
        }
        if let Some(press) = self.tracker.so_far() {
            let early = self.judge.early(press, self.moment());
            events.extend(early.map(Event::Hardness));
        }
    }

    /// What a verdict must know of this moment.
    fn moment(&self) -> Moment {
        Moment {
            state: self.link_state(),
            is_live: self.clock == Clock::Arrival,
            arrival: self.arrival,
        }
    }

    /// Adds the events of a change.
    fn publish(&mut self, change: Change, events: &mut Vec<Event>) {
        match change {
            Change::Begin { press, at } => {
                self.judge.begin();
                events.push(self.press(press, PressState::Begin, at, 1, None));
            }
            Change::End { press, end } => {
                let now = self.moment();
                // A contact may settle in the frame with which its press ends.
                let early = self.judge.early(&press, now);
                events.extend(early.map(Event::Hardness));
                let (state, verdict) = match end.is_judged() {
                    true => (PressState::End, self.judge.end(&press, now)),
                    false => (PressState::Aborted, None),
                };
                let (last, frames) = (press.last(), press.frames);
                events.push(self.press(press.press, state, last, frames, end.reason()));
                events.extend(verdict.map(Event::Hardness));
            }
        }
    }

    fn press(
        &self,
        press: u64,
        state: PressState,
        at: FrameAt,
        frames: u64,
        reason: Option<&'static str>,
    ) -> Event {
        Event::Press(Press {
            seq: None,
            sensor: self.sensor.name().to_owned(),
            time: at.stamp.wall,
            press,
            state,
            frame: at.frame,
            reason,
            frames,
            context: self.judge.context.clone(),
        })
    }
}

fn contact(press: &Thresholds) -> Contact {
    Contact {
        threshold_n: press.contact_threshold_n,
        area_taxels: press.begin_area_taxels,
    }
}

#[cfg(test)]
mod tests;
