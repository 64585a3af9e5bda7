//! The search for frames: bytes go in, whole frames and damage come out.

use serde::{Deserialize, Serialize};

use super::layout::Layout;
use super::scan::{Context, Scan};
use crate::frame::RawFrame;

/// The mark of a dropped candidate frame. The candidate had a valid sync, but its length, its tail,
/// its checksum or the header after it was wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Damage;

/// A whole frame, and the place in the stream where it ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Decoded {
    /// The frame.
    pub frame: RawFrame,
    /// The number of bytes of the stream up to and including the frame's last byte.
    pub end: u64,
}

/// Finds frames in a stream of bytes.
///
/// It holds at most the bytes of one pending frame and the header that must follow it. If a layout
/// has a sync but neither a checksum nor a tail, the decoder may hold two frames: after damage, a
/// header in the data may look like the beginning of the next frame.
///
/// # Example
///
/// A frame arrives in two pieces, behind some noise.
///
/// ```
/// use hardnessd_core::frame::RawFrame;
/// use hardnessd_core::wire::{Decoder, Layout, Settings};
///
/// let layout = Layout::new(&Settings::default())?;
/// let mut bytes = b"noise".to_vec();
/// layout.encode(&RawFrame::default(), &mut bytes);
///
/// let mut decoder = Decoder::new(layout);
/// decoder.push(&bytes[..300]);
/// assert!(decoder.next_frame().is_none());
/// decoder.push(&bytes[300..]);
/// let decoded = decoder.next_frame().unwrap().unwrap();
/// assert_eq!(decoded.frame, RawFrame::default());
/// assert_eq!((decoder.skipped(), decoder.pending()), (5, 0));
/// # Ok::<(), hardnessd_core::wire::LayoutError>(())
/// ```
#[derive(Debug)]
pub struct Decoder {
    layout: Layout,
    /// The state. Before its pending bytes are those that were taken and not yet removed.
    memory: Memory,
    /// The number of bytes that were taken and not yet removed.
    start: usize,
}

/// The state of a [`Decoder`], without its layout.
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
    /// Whether a decoder that returned `frames` frames, damaged ones included, can have this state.
    pub(crate) fn is_possible(&self, frames: u64) -> bool {
        let passed = self.received.checked_sub(self.pending.len() as u64);
        self.received < MOST_BYTES
            && passed.is_some_and(|passed| {
                self.skipped <= passed && self.anchor <= passed && frames <= passed
            })
    }
}

/// More bytes than any line ever delivers.
const MOST_BYTES: u64 = 1 << 62;

impl Decoder {
    /// A decoder at the start of a stream.
    pub fn new(layout: Layout) -> Self {
        let capacity = 4 * layout.max_frame_bytes();
        let locked = layout.begins_locked();
        Self {
            layout,
            memory: Memory {
                pending: Vec::with_capacity(capacity),
                received: 0,
                skipped: 0,
                settled: false,
                locked,
                anchor: 0,
            },
            start: 0,
        }
    }

    /// The decoder's state.
    pub fn memory(&self) -> Memory {
        let mut memory = self.memory.clone();
        memory.pending.drain(..self.start);
        memory
    }

    /// Continues from the state of another decoder.
    pub fn recall(&mut self, memory: Memory) {
        self.memory = memory;
        self.start = 0;
    }

    /// Takes bytes in. It never blocks and never fails. Call [`Self::next_frame`] until it is
    /// `None` before the next push, or the buffer grows.
    pub fn push(&mut self, bytes: &[u8]) {
        if bytes.is_empty() {
            return;
        }
        self.memory.settled = false;
        if self.start > 0 {
            self.memory.pending.drain(..self.start);
            self.start = 0;
        }
        self.memory.pending.extend_from_slice(bytes);
        self.memory.received += bytes.len() as u64;
    }

    /// Tells the decoder that the input ended or paused for half a period. A complete frame that
    /// only waited for the next header is then whole.
    pub fn settle(&mut self) {
        self.memory.settled = true;
    }

    /// Drops the pending bytes, for example after a reconnect: the next bytes do not continue them.
    pub fn restart(&mut self) {
        let pending = self.pending();
        self.memory.skipped += pending as u64;
        self.memory.pending.clear();
        self.start = 0;
        self.memory.settled = false;
        self.memory.anchor = self.memory.received;
        self.memory.locked = self.layout.begins_locked();
    }

    /// The next frame or damaged candidate, or `None` when more bytes are needed.
    pub fn next_frame(&mut self) -> Option<Result<Decoded, Damage>> {
        loop {
            let bytes = &self.memory.pending[self.start..];
            let offset = self.memory.received - bytes.len() as u64;
            let context = Context {
                settled: self.memory.settled,
                locked: self.memory.locked,
                offset,
                anchor: self.memory.anchor,
            };
            match self.layout.scan(bytes, context) {
                Scan::Wait => return None,
                Scan::Skip(count) => self.pass_over(count),
                Scan::Excess(count) => {
                    self.start += count;
                    self.memory.skipped += count as u64;
                }
                Scan::Damaged(count) => {
                    self.pass_over(count);
                    return Some(Err(Damage));
                }
                Scan::Frame(count, frame) => {
                    self.start += count;
                    self.memory.locked = true;
                    self.memory.anchor = offset + count as u64;
                    return Some(Ok(Decoded {
                        frame,
                        end: self.memory.anchor,
                    }));
                }
            }
        }
    }

    /// The number of bytes taken in since the start.
    pub fn received(&self) -> u64 {
        self.memory.received
    }

    /// The number of bytes that belonged to no whole frame.
    pub fn skipped(&self) -> u64 {
        self.memory.skipped
    }

    /// The number of held bytes that may yet become a frame.
    pub fn pending(&self) -> usize {
        self.memory.pending.len() - self.start
    }

    fn pass_over(&mut self, count: usize) {
        self.start += count;
        self.memory.skipped += count as u64;
        self.memory.locked = self.layout.ends_with_dropped();
    }
}
