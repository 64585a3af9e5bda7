//! The answer of the search for a frame at the beginning of some bytes.

use crate::frame::RawFrame;

/// The mark of a dropped candidate frame. The candidate had a valid sync, but its length, its tail,
/// its checksum or the header after it was wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Damage;

/// The answer of a search: what the first bytes are.
pub(super) struct Scan {
    /// The number of bytes. Without any, more must come to know.
    pub(super) bytes: usize,
    /// The frame that these bytes are. Without one, no frame begins in them.
    pub(super) frame: Option<RawFrame>,
    /// How many candidates among the bytes look like a frame, and so count as a damaged one.
    pub(super) damaged: u64,
}

impl Scan {
    pub(super) fn found(bytes: usize, frame: RawFrame) -> Self {
        Self {
            bytes,
            frame: Some(frame),
            damaged: 0,
        }
    }

    /// Passes over `bytes`.
    pub(super) fn past(bytes: usize, damaged: u64) -> Self {
        Self {
            bytes,
            frame: None,
            damaged,
        }
    }
}

/// What the search knows beside the bytes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Context {
    /// Whether the input ended or paused after these bytes.
    pub(super) settled: bool,
    /// Whether the bytes begin where a frame ended. In text: whether there was a frame.
    pub(super) in_sync: bool,
}
