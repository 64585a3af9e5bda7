//! What a pipeline remembers: enough for another to go on in its place.

use serde::{Deserialize, Serialize};

use super::{Pipeline, RATE_FRAMES, Seen};
use crate::motion::Track;
use crate::tare::{self, Aim, Offsets};
use crate::{event, press, wire};

/// Everything that a pipeline has seen. A pipeline of the same sensor that recalls it gives the same
/// events from there on. Recordings begin with it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    decoder: wire::Memory,
    tare: tare::Memory,
    tracker: press::Memory,
    /// The positions that a press under way, or the next one, may need. Older recordings have none.
    #[serde(default)]
    track: Track,
    pipeline: Noted,
}

/// What the pipeline itself knows of the past, as recordings hold it. They also hold here, and have
/// always held here, what the tare under way is for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Noted {
    /// It is the first, and something touched the sensor at an earlier try.
    tare_met_contact: bool,
    /// It was asked for, when these offsets were in force.
    retaring: Option<Offsets>,
    #[serde(flatten)]
    seen: Seen,
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
        } = &self.pipeline.seen;
        let is_context = |context: &serde_json::Value| {
            context.is_object() && context.to_string().len() < event::CONTEXT_BYTES
        };
        self.decoder
            .is_possible(frames.saturating_add(*frames_damaged))
            && self.tare.is_possible()
            && self.tracker.is_possible(*frames)
            && self.track.is_possible()
            && recent.len() <= RATE_FRAMES
            && context.as_ref().is_none_or(is_context)
    }

    /// What the controller had said it was doing.
    pub(crate) fn context(&self) -> Option<&serde_json::Value> {
        self.pipeline.seen.context.as_ref()
    }
}

impl Pipeline {
    /// All it has seen.
    pub fn memory(&self) -> Memory {
        let aim = self.tare.aim();
        let last_frame = self.seen.last_frame.map(|frame| frame.mono);
        let since = self.tracker.began().or(last_frame).unwrap_or_default();
        Memory {
            track: self.track.since(since),
            decoder: self.decoder.memory(),
            tare: self.tare.memory(),
            tracker: self.tracker.memory(),
            pipeline: Noted {
                tare_met_contact: aim == Some(Aim::First { met_contact: true }),
                retaring: (aim == Some(Aim::Request)).then(|| self.tare.offsets()),
                seen: self.seen.clone(),
            },
        }
    }

    /// Goes on where the pipeline stood whose memory this is. It is one of the same sensor.
    pub fn recall(&mut self, memory: Memory) {
        let Noted {
            tare_met_contact: met_contact,
            retaring,
            seen,
        } = memory.pipeline;
        let aim = match retaring {
            Some(_) => Aim::Request,
            None => Aim::First { met_contact },
        };
        self.decoder.recall(memory.decoder);
        self.tare.recall(memory.tare, aim);
        self.tracker.recall(memory.tracker);
        self.track = memory.track;
        self.seen = seen;
    }
}
