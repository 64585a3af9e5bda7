//! The answer of the search for a frame at the beginning of some bytes.

use crate::frame::RawFrame;

/// The answer of a search.
pub(super) enum Scan {
    /// More bytes are needed to know.
    Wait,
    /// No frame begins in the first `bytes` bytes.
    Skip {
        /// The number of bytes.
        bytes: usize,
        /// How many candidates among them look like a frame, and so count as a damaged one.
        damaged: u64,
    },
    /// The first `bytes` bytes are a frame.
    Frame {
        /// The number of bytes.
        bytes: usize,
        /// The frame.
        frame: RawFrame,
    },
}

impl Scan {
    /// These bytes belong to no frame and do not look like one.
    pub(super) fn noise(bytes: usize) -> Self {
        Self::Skip { bytes, damaged: 0 }
    }

    /// Passes over `bytes`. Without any, more must come.
    pub(super) fn past(bytes: usize, damaged: u64) -> Self {
        match bytes {
            0 => Self::Wait,
            bytes => Self::Skip { bytes, damaged },
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
