//! The input and the answer of the search for a frame.

use crate::frame::RawFrame;

/// The answer of a search.
pub(super) enum Scan {
    /// More bytes are needed.
    Wait,
    /// This many bytes belong to no frame.
    Skip(usize),
    /// A candidate is damaged. The decoder skips this many of its bytes and continues the search
    /// inside the rest.
    Damaged(usize),
    /// The first bytes are a frame. The number is the frame's length in bytes.
    Frame(usize, RawFrame),
    /// This many bytes belong to no frame. It is unknown whether a frame ended with them.
    Excess(usize),
}

/// The input of a search beside the bytes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Context {
    /// Whether the input ended or paused after these bytes.
    pub settled: bool,
    /// Whether the bytes begin where a frame ended.
    pub locked: bool,
    /// The place of the first byte in the stream.
    pub offset: u64,
    /// The place in the stream where the last whole frame ended, or where the stream began.
    pub anchor: u64,
}
