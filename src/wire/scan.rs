//! What the decoder passes to the search for a frame, and what the search answers.

use crate::frame::RawFrame;

/// What the bytes at hand amount to.
#[expect(
    clippy::large_enum_variant,
    reason = "a frame is handed on by value: boxing it would allocate each one"
)]
pub(super) enum Scan {
    /// More bytes are needed.
    Wait,
    /// This many bytes belong to no frame.
    Skip(usize),
    /// A candidate is damaged. This many of its bytes are skipped, and the search goes on inside
    /// the rest.
    Damaged(usize),
    /// The first bytes, this many, are a frame.
    Frame(usize, RawFrame),
    /// This many bytes belong to no frame. Whether a frame ended with them is not known.
    Excess(usize),
}

/// What a search knows beside the bytes.
#[derive(Debug, Clone, Copy)]
pub(super) struct Context {
    /// The input ended or paused after these bytes.
    pub settled: bool,
    /// The bytes begin where a frame ended.
    pub locked: bool,
    /// Place of the first byte in the stream.
    pub offset: u64,
    /// Place in the stream where the last whole frame ended, or the stream began.
    pub anchor: u64,
}
