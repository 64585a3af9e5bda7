//! The state of a pipeline at rest, from which another pipeline can continue.

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Clock, Link, Pace, Pipeline};
use crate::frame::{Array, Stamp};
use crate::judge::{self, OwnPresses};
use crate::sensor::Sensor;
use crate::verdict::Hrn;
use crate::wire::{Decoder, HexBytes, Place};
use crate::{motion, tare};

/// The state of a pipeline while no press is under way. A pipeline of the same sensor that continues
/// from it returns the same events from there on. Recordings begin with it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AtRest {
    frames: u64,
    frames_damaged: u64,
    pace: Pace,
    presses: u64,
    context: Option<Value>,
    link: Link,
    decoder: Place,
    /// The bytes that have not become a frame yet, and when they came.
    pending: Vec<(Stamp, HexBytes)>,
    tare: tare::AtRest,
    motion: motion::AtRest,
    judge: judge::Kept,
}

/// No line ever delivers so many bytes.
const MOST_BYTES: u64 = 1 << 62;

impl AtRest {
    /// Whether a pipeline of `array` can continue from it. A recording may hold anything.
    pub(crate) fn is_usable(&self, array: Array) -> bool {
        let (frames, presses) = (self.frames, self.presses);
        let counts = [frames, self.frames_damaged, self.pace.dropped, presses];
        counts.iter().all(|&count| count <= self.decoder.decoded)
            && self.decoder.skipped <= self.decoder.decoded
            && self.decoder.decoded < MOST_BYTES
            && self.tare.is_usable(array)
            && self.motion.is_usable()
            && self.judge.is_usable()
    }

    /// The controller's context.
    pub(crate) fn context(&self) -> Option<&Value> {
        self.context.as_ref()
    }
}

impl Pipeline {
    /// Whether neither a press nor a tare is under way.
    pub fn is_at_rest(&self) -> bool {
        self.tracker.is_idle() && self.tare.is_at_rest()
    }

    /// The state, if no press is under way, and no tare. There is none either while a press that
    /// timed out is not released.
    pub fn at_rest(&self) -> Option<AtRest> {
        if !self.is_at_rest() {
            return None;
        }
        let since = self.link.last_frame.map(|frame| frame.mono);
        Some(AtRest {
            frames: self.frames,
            frames_damaged: self.frames_damaged,
            pace: self.pace.clone(),
            presses: self.tracker.presses,
            context: self.judge.context.clone(),
            link: self.link.clone(),
            decoder: self.decoder.place(),
            pending: self.pending(),
            tare: self.tare.at_rest(),
            motion: self.judge.track.since(since.unwrap_or_default()),
            judge: self.judge.kept.clone(),
        })
    }

    /// The pipeline that judges with `hrn` from now on, as `sensor` says. `None` unless at rest: a press
    /// under way is judged by the model that it began with. Of the tables of `sensor`, only `[model]`
    /// may differ.
    pub fn with_model(&self, sensor: Sensor, hrn: Arc<Hrn>) -> Option<Self> {
        let state = AtRest {
            judge: self.judge.kept_for(&hrn),
            ..self.at_rest()?
        };
        Some(Self::resumed(sensor, hrn, state))
    }

    /// The pipeline of a sensor that begins anew with other tables. Its counters, its context and the
    /// positions of the arm go on.
    #[must_use]
    pub fn restarted(mut self, sensor: Sensor, hrn: Arc<Hrn>) -> Self {
        self.decoder.restart();
        let mut kept = self.judge.kept_for(&hrn);
        if judge::owner(&sensor, &hrn) != judge::owner(&self.sensor, self.hrn()) {
            kept.own = OwnPresses::default();
        }
        let mut next = Self::new(sensor, hrn, self.clock);
        let place = Place {
            in_sync: next.decoder.place().in_sync,
            ..self.decoder.place()
        };
        next.decoder = Decoder::at(next.sensor.layout().clone(), place);
        next.tracker.presses = self.tracker.presses;
        next.judge = next.judge.after(kept, self.judge.track, self.judge.context);
        (next.frames, next.frames_damaged) = (self.frames, self.frames_damaged);
        next.pace = self.pace;
        next
    }

    /// A pipeline of `sensor` that continues from a usable state.
    pub(crate) fn resumed(sensor: Sensor, hrn: Arc<Hrn>, state: AtRest) -> Self {
        let mut pipeline = Self::new(sensor, hrn, Clock::Arrival);
        pipeline.decoder = Decoder::at(pipeline.sensor.layout().clone(), state.decoder);
        for (at, HexBytes(bytes)) in state.pending {
            pipeline.hold(&bytes, at);
        }
        pipeline.tare.resume(state.tare);
        pipeline.tracker.presses = state.presses;
        let track = state.motion.into();
        pipeline.judge = pipeline.judge.after(state.judge, track, state.context);
        pipeline.link = state.link;
        pipeline.frames = state.frames;
        pipeline.frames_damaged = state.frames_damaged;
        pipeline.pace = state.pace;
        pipeline
    }

    /// The bytes that have not become a frame yet, and when they came.
    fn pending(&self) -> Vec<(Stamp, HexBytes)> {
        let mut pending = self.decoder.pending();
        let mut begin = self.decoder.place().decoded;
        let chunk = |&(end, at): &(u64, Stamp)| {
            let length = end.saturating_sub(begin) as usize;
            let (chunk, rest) = pending.split_at(length.min(pending.len()));
            (pending, begin) = (rest, end.max(begin));
            (at, HexBytes(chunk.to_vec()))
        };
        let chunks: Vec<_> = self.chunks.iter().map(chunk).collect();
        chunks
            .into_iter()
            .filter(|(_, HexBytes(chunk))| !chunk.is_empty())
            .collect()
    }
}
