//! The memory of a pipeline, from which another pipeline can continue.

use serde::{Deserialize, Serialize};

use super::{Pipeline, Seen};
use crate::frame::Array;
use crate::motion::Track;
use crate::{event, press, tare, wire};

/// The whole state of a pipeline. A pipeline of the same sensor that recalls it returns the same
/// events from there on. Recordings begin with it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    decoder: wire::Memory,
    tare: tare::Memory,
    tracker: press::Memory,
    /// The positions that a press under way, or the next one, may need.
    track: Track,
    pipeline: Seen,
}

impl Memory {
    /// Whether a pipeline of `array` can have this state. A recording may hold anything.
    pub(crate) fn is_possible(&self, array: Array) -> bool {
        let Seen {
            frames,
            frames_damaged,
            link,
            context,
            objects,
            ..
        } = &self.pipeline;
        let is_context = |context| event::check_context(context).is_ok();
        self.decoder
            .is_possible(frames.saturating_add(*frames_damaged))
            && self.tare.is_possible(array)
            && self.tracker.is_possible(*frames, array)
            && self.track.is_possible()
            && link.is_possible()
            && objects.is_possible(*frames)
            && context.as_ref().is_none_or(is_context)
    }

    /// The controller's context.
    pub(crate) fn context(&self) -> Option<&serde_json::Value> {
        self.pipeline.context.as_ref()
    }
}

impl Pipeline {
    /// The pipeline's state.
    pub fn memory(&self) -> Memory {
        let last_frame = self.seen.link.last_frame.map(|frame| frame.mono);
        let since = self.tracker.began().or(last_frame).unwrap_or_default();
        Memory {
            track: self.track.since(since),
            decoder: self.decoder.memory(),
            tare: self.tare.memory(),
            tracker: self.tracker.memory(),
            pipeline: self.seen.clone(),
        }
    }

    /// Continues from the state of another pipeline of the same sensor.
    pub fn recall(&mut self, memory: Memory) {
        self.decoder.recall(memory.decoder);
        self.tare.recall(memory.tare);
        self.tracker.recall(memory.tracker);
        self.track = memory.track;
        self.seen = memory.pipeline;
    }
}
