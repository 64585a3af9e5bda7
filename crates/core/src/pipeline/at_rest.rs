//! The state of a pipeline at rest, from which another pipeline can continue.

use std::collections::VecDeque;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Clock, Link, Pace, Pipeline};
use crate::frame::{Array, Stamp};
use crate::judge::{self, OwnPresses};
use crate::motion::{Point, Track};
use crate::sensor::Sensor;
use crate::tare;
use crate::verdict::Model;
use crate::wire::{Decoder, HexBytes, Place};

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
    /// The bytes that have not become a frame yet.
    pending: HexBytes,
    /// The ends of recent chunks in the stream, and when they came.
    chunks: VecDeque<(u64, Stamp)>,
    tare: tare::AtRest,
    motion: Vec<Point>,
    judge: judge::Kept,
}

/// No line ever delivers so many bytes.
const MOST_BYTES: u64 = 1 << 62;

impl AtRest {
    /// Whether a pipeline of `array` can continue from it. A recording may hold anything.
    pub(crate) fn is_usable(&self, array: Array) -> bool {
        let (frames, presses) = (self.frames, self.presses);
        let counts = [frames, self.frames_damaged, self.pace.dropped, presses];
        let Place {
            decoded,
            skipped,
            framed,
            ..
        } = self.decoder;
        let received = decoded.saturating_add(self.pending.0.len() as u64);
        counts.iter().all(|&count| count <= decoded)
            && skipped.max(framed) <= decoded
            && received < MOST_BYTES
            && self.chunks.iter().all(|&(end, _)| end <= received)
            && self.tare.is_usable(array)
            && self.motion.iter().all(Point::is_usable)
            && self.judge.is_usable()
    }

    /// The controller's context.
    pub(crate) fn context(&self) -> Option<&Value> {
        self.context.as_ref()
    }
}

impl Pipeline {
    /// Whether neither a press is under way nor a tare that has taken in more than a frame.
    pub fn is_at_rest(&self) -> bool {
        self.tracker.is_idle() && self.tare.is_at_rest()
    }

    /// The state, if no press is under way, and no tare. There is none either while a press that
    /// timed out is not released.
    pub fn at_rest(&self) -> Option<AtRest> {
        self.is_at_rest().then(|| self.state())
    }

    /// The state without what is under way.
    fn state(&self) -> AtRest {
        let since = self.link.last_frame.map(|frame| frame.mono);
        AtRest {
            frames: self.frames,
            frames_damaged: self.frames_damaged,
            pace: self.pace.clone(),
            presses: self.tracker.presses,
            context: self.judge.context.clone(),
            link: self.link.clone(),
            decoder: self.decoder.place(),
            pending: HexBytes(self.decoder.pending().to_vec()),
            chunks: self.chunks.clone(),
            tare: self.tare.at_rest(),
            motion: self.judge.track.since(since.unwrap_or_default()),
            judge: self.judge.kept.clone(),
        }
    }

    /// The pipeline that judges with `hrn` from now on, as `sensor` says. `None` unless at rest: a press
    /// under way is judged by the model that it began with. Of the tables of `sensor`, only `[model]`
    /// may differ.
    pub fn with_model(&self, sensor: Sensor, hrn: Arc<Model>) -> Option<Self> {
        let state = AtRest {
            judge: self.judge.kept_for(&hrn),
            context: self.context_for(&hrn),
            ..self.at_rest()?
        };
        let track = self.judge.track.clone();
        Some(Self::new(sensor, hrn, self.clock).after(state, track))
    }

    /// The context for verdicts of `hrn`. The level in it is a number of a model's levels.
    fn context_for(&self, hrn: &Model) -> Option<Value> {
        let mut context = self.judge.context.clone()?;
        if hrn.card().levels != self.hrn().card().levels
            && let Some(keys) = context.as_object_mut()
        {
            keys.remove("level");
        }
        Some(context)
    }

    /// The pipeline of a sensor that begins anew with other tables. Its counters, its context and the
    /// positions of the arm go on.
    #[must_use]
    pub fn restarted(mut self, sensor: Sensor, hrn: Arc<Model>) -> Self {
        self.decoder.restart();
        self.chunks.clear();
        let mut kept = self.judge.kept_for(&hrn);
        if judge::owner(&sensor, &hrn) != judge::owner(&self.sensor, self.hrn()) {
            kept.own = OwnPresses::default();
        }
        let context = self.context_for(&hrn);
        let next = Self::new(sensor, hrn, self.clock);
        let place = Place {
            in_sync: next.decoder.place().in_sync,
            ..self.decoder.place()
        };
        let state = AtRest {
            link: self.link.anew(),
            decoder: place,
            tare: next.tare.at_rest(),
            judge: kept,
            context,
            ..self.state()
        };
        next.after(state, self.judge.track)
    }

    /// A pipeline of `sensor` that continues from a usable state.
    pub(crate) fn resumed(sensor: Sensor, hrn: Arc<Model>, state: AtRest) -> Self {
        let mut track = Track::default();
        // Of points that step back, the earlier ones are forgotten.
        let _ = track.push(&state.motion);
        Self::new(sensor, hrn, Clock::Arrival).after(state, track)
    }

    /// This new pipeline, if it continues from a usable state and has these positions of the arm.
    fn after(mut self, state: AtRest, track: Track) -> Self {
        self.decoder = Decoder::at(self.sensor.layout().clone(), state.decoder);
        self.decoder.push(&state.pending.0);
        self.chunks = state.chunks;
        self.tare.resume(state.tare);
        self.tracker.presses = state.presses;
        self.judge = self.judge.after(state.judge, track, state.context);
        self.link = state.link;
        self.frames = state.frames;
        self.frames_damaged = state.frames_damaged;
        self.pace = state.pace;
        self
    }
}
