//! Bytes in, whole frames and damage out.

use serde::{Deserialize, Serialize};

use super::{Framing, Layout, text, zero_run};
use crate::frame::RawFrame;

/// A candidate frame was dropped: it had a valid sync and failed length, tail, checksum or what must
/// follow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Damage;

/// A whole frame and where in the stream it ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Decoded {
    /// The counts.
    pub frame: RawFrame,
    /// Bytes of the stream up to and including the frame's last one.
    pub end: u64,
}

/// What the bytes at hand amount to.
#[expect(
    clippy::large_enum_variant,
    reason = "a frame is handed on by value: boxing it would allocate each one"
)]
pub(super) enum Scan {
    /// More bytes are needed.
    Wait,
    /// So many bytes belong to no frame.
    Skip(usize),
    /// A candidate is damaged; so many bytes of it are passed over, and the search goes on
    /// inside the rest.
    Damaged(usize),
    /// The first so many bytes are a frame.
    Frame(usize, RawFrame),
    /// So many bytes belong to no frame, and whether one ended with them is not known.
    Excess(usize),
}

/// What a scan may know beside the bytes.
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

/// Finds frames in a stream of bytes. It holds on to at most the bytes of one pending frame and the
/// header that must follow it. Only a layout that begins with a sync, without checksum or tail, may
/// come to hold two: after damage, where headers in the data leave it unsure of its phase.
#[derive(Debug)]
pub struct Decoder {
    layout: Layout,
    buffer: Vec<u8>,
    start: usize,
    received: u64,
    skipped: u64,
    settled: bool,
    locked: bool,
    anchor: u64,
}

/// What a [`Decoder`] has seen and still holds, without its layout.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    pending: Vec<u8>,
    received: u64,
    skipped: u64,
    settled: bool,
    locked: bool,
    anchor: u64,
}

impl Memory {
    /// Whether a decoder can have come to this that gave so many frames, whole and damaged ones.
    pub(crate) fn is_possible(&self, frames: u64) -> bool {
        let passed = self.received.checked_sub(self.pending.len() as u64);
        self.received < MOST_BYTES
            && passed.is_some_and(|passed| {
                self.skipped <= passed && self.anchor <= passed && frames <= passed
            })
    }
}

/// More than any line brings.
const MOST_BYTES: u64 = 1 << 62;

impl Decoder {
    /// A decoder at the start of a stream.
    pub fn new(layout: Layout) -> Self {
        let capacity = 4 * layout.max_frame_bytes();
        let locked = matches!(&layout.framing, Framing::Fixed(fixed) if fixed.has_sync());
        Self {
            layout,
            buffer: Vec::with_capacity(capacity),
            start: 0,
            received: 0,
            skipped: 0,
            settled: false,
            locked,
            anchor: 0,
        }
    }

    /// What it has seen and still holds.
    pub fn memory(&self) -> Memory {
        Memory {
            pending: self.buffer[self.start..].to_vec(),
            received: self.received,
            skipped: self.skipped,
            settled: self.settled,
            locked: self.locked,
            anchor: self.anchor,
        }
    }

    /// Goes on where the one stood whose memory this is.
    pub fn recall(&mut self, memory: Memory) {
        Memory {
            pending: self.buffer,
            received: self.received,
            skipped: self.skipped,
            settled: self.settled,
            locked: self.locked,
            anchor: self.anchor,
        } = memory;
        self.start = 0;
    }

    /// The layout it decodes.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Takes bytes in. Never blocks and never fails; call [`Self::next_frame`] until it is `None`
    /// before the next push, or the buffer grows.
    pub fn push(&mut self, bytes: &[u8]) {
        if bytes.is_empty() {
            return;
        }
        self.settled = false;
        if self.start > 0 {
            self.buffer.drain(..self.start);
            self.start = 0;
        }
        self.buffer.extend_from_slice(bytes);
        self.received += bytes.len() as u64;
    }

    /// Says that the input ended or paused for half a period: a complete frame that only waited
    /// for the next header is whole.
    pub fn settle(&mut self) {
        self.settled = true;
    }

    /// Drops what is pending, as after a reconnect: what comes next does not continue it.
    pub fn restart(&mut self) {
        let pending = self.pending();
        self.skipped += pending as u64;
        self.buffer.clear();
        self.start = 0;
        self.settled = false;
        self.anchor = self.received;
        self.locked = matches!(&self.layout.framing, Framing::Fixed(fixed) if fixed.has_sync());
    }

    /// The next frame or damaged candidate, or `None` when more bytes are needed.
    pub fn next_frame(&mut self) -> Option<Result<Decoded, Damage>> {
        loop {
            let bytes = &self.buffer[self.start..];
            let offset = self.received - bytes.len() as u64;
            let context = Context {
                settled: self.settled,
                locked: self.locked,
                offset,
                anchor: self.anchor,
            };
            let scan = match &self.layout.framing {
                Framing::Fixed(fixed) => fixed.scan(&self.layout, bytes, context),
                Framing::Text => text::scan(&self.layout, bytes, context),
                Framing::ZeroRun => zero_run::scan(&self.layout, bytes, context),
            };
            match scan {
                Scan::Wait => return None,
                Scan::Skip(count) => self.pass_over(count),
                Scan::Excess(count) => {
                    self.start += count;
                    self.skipped += count as u64;
                }
                Scan::Damaged(count) => {
                    self.pass_over(count);
                    return Some(Err(Damage));
                }
                Scan::Frame(count, frame) => {
                    self.start += count;
                    self.locked = true;
                    self.anchor = offset + count as u64;
                    return Some(Ok(Decoded {
                        frame,
                        end: self.anchor,
                    }));
                }
            }
        }
    }

    /// Bytes taken in since the start.
    pub fn received(&self) -> u64 {
        self.received
    }

    /// Bytes that belonged to no whole frame.
    pub fn skipped(&self) -> u64 {
        self.skipped
    }

    /// Bytes held that may yet become a frame.
    pub fn pending(&self) -> usize {
        self.buffer.len() - self.start
    }

    fn pass_over(&mut self, count: usize) {
        self.start += count;
        self.skipped += count as u64;
        // A text or run-length frame ends where the dropped one did: there the next begins.
        self.locked = match &self.layout.framing {
            Framing::Fixed(_) => false,
            Framing::Text | Framing::ZeroRun => true,
        };
    }
}
