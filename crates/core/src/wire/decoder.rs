//! The search for frames: bytes go in, whole frames and damage come out.

use serde::{Deserialize, Serialize};

use super::layout::Layout;
use super::scan::{Context, Damage, Scan};
use super::text::Lines;
use crate::frame::RawFrame;

/// A whole frame, and the place in the stream where it ended.
#[derive(Debug, Clone, PartialEq)]
pub struct Decoded {
    /// The frame.
    pub frame: RawFrame,
    /// The number of bytes of the stream up to and including the frame's last byte.
    pub end: u64,
}

/// Where a decoder is in its stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Place {
    /// The number of bytes that became frames or were skipped.
    pub decoded: u64,
    /// The number of bytes that belonged to no whole frame.
    pub skipped: u64,
    /// The number of bytes up to the end of the last whole frame, or up to the last restart, and of those
    /// that nobody read since.
    pub framed: u64,
    /// Whether the next byte follows the end of a frame.
    pub in_sync: bool,
    /// Whether the bytes since the last frame or restart began with options of telnet.
    #[serde(default)]
    pub is_telnet: bool,
}

/// Finds frames in a stream of bytes.
///
/// It holds at most the bytes of one pending frame and the header that must follow it.
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
/// assert_eq!((decoder.skipped(), decoder.pending().len()), (5, 0));
/// # Ok::<(), hardnessd_core::range::OutOfRange>(())
/// ```
#[derive(Debug)]
pub struct Decoder {
    layout: Layout,
    /// Bytes that came. The first `start` of them are decoded.
    bytes: Vec<u8>,
    start: usize,
    place: Place,
    /// Whether the input ended or paused after the last byte.
    settled: bool,
    /// The damaged candidates that were not returned yet.
    damaged: u64,
    lines: Lines,
}

impl Decoder {
    /// A decoder at the start of a stream.
    pub fn new(layout: Layout) -> Self {
        let place = Place {
            decoded: 0,
            skipped: 0,
            framed: 0,
            in_sync: layout.begins_in_sync(),
            is_telnet: false,
        };
        Self::at(layout, place)
    }

    /// A decoder that continues a stream at `place`.
    pub fn at(layout: Layout, place: Place) -> Self {
        Self {
            bytes: Vec::with_capacity(4 * layout.max_frame_bytes()),
            start: 0,
            place,
            settled: false,
            damaged: 0,
            lines: Lines::default(),
            layout,
        }
    }

    /// Takes bytes in. It never blocks and never fails. Call [`Self::next_frame`] until it is
    /// `None` before the next push, or the buffer grows.
    pub fn push(&mut self, bytes: &[u8]) {
        if bytes.is_empty() {
            return;
        }
        self.settled = false;
        if self.unframed() == 0 {
            self.place.is_telnet = is_telnet(bytes);
        }
        self.bytes.drain(..self.start);
        self.start = 0;
        self.bytes.extend_from_slice(bytes);
    }

    /// Tells the decoder that the next byte begins a frame, if a pause would show it.
    pub(crate) fn resync(&mut self) {
        self.place.in_sync |= self.layout.is_in_sync_after_pause();
    }

    /// Whether a pause would show where a frame begins.
    pub(crate) fn awaits_pause(&self) -> bool {
        !self.place.in_sync && self.layout.is_in_sync_after_pause()
    }

    /// Tells the decoder that the input ended or paused for half a period. A complete frame that
    /// only waited for the next header is then whole.
    pub fn settle(&mut self) {
        self.settled = true;
        if self.pending().is_empty() {
            self.resync();
        }
    }

    /// Drops the pending bytes, for example after a reconnect: the next bytes do not continue them.
    pub fn restart(&mut self) {
        self.skip(0);
        self.place.framed = self.place.decoded;
        self.lines = Lines::default();
        self.place.is_telnet = false;
    }

    /// Counts bytes that came and that nobody reads: they are no sign of a wrong layout. The next bytes do
    /// not continue the pending ones.
    pub(crate) fn skip(&mut self, bytes: u64) {
        self.pass(self.pending().len());
        self.settled = false;
        self.place.in_sync = self.layout.begins_in_sync();
        self.place.decoded = self.place.decoded.saturating_add(bytes);
        self.place.skipped = self.place.skipped.saturating_add(bytes);
        self.place.framed = self.place.framed.saturating_add(bytes);
        let refused = self.lines.refused.take();
        self.lines = Lines::default();
        self.lines.refused = refused;
    }

    /// The next frame or damaged candidate, or `None` when more bytes are needed.
    pub fn next_frame(&mut self) -> Option<Result<Decoded, Damage>> {
        loop {
            if self.damaged > 0 {
                self.damaged -= 1;
                return Some(Err(Damage));
            }
            let context = Context {
                settled: self.settled,
                in_sync: self.place.in_sync,
            };
            let pending = &self.bytes[self.start..];
            let Scan {
                bytes,
                frame,
                damaged,
            } = self.layout.scan(pending, context, &mut self.lines);
            if bytes == 0 {
                return None;
            }
            self.damaged = damaged;
            let Some(frame) = frame else {
                self.pass(bytes);
                continue;
            };
            self.advance(bytes);
            self.place.in_sync = true;
            let end = self.place.decoded;
            self.place.framed = end;
            return Some(Ok(Decoded { frame, end }));
        }
    }

    /// Why the bytes since the last frame are none. `None` if they are so few that they may be the
    /// beginning of one.
    pub fn problem(&self) -> Option<String> {
        let guess = match self.place.is_telnet {
            true => TELNET,
            false => "is the baud rate or the layout wrong?",
        };
        let is_enough = self.unframed() >= 2 * self.layout.min_frame_bytes() as u64;
        is_enough.then(|| self.lines.refused.clone().unwrap_or(guess.to_owned()))
    }

    /// The number of bytes taken in since the start.
    pub fn received(&self) -> u64 {
        self.place.decoded + self.pending().len() as u64
    }

    /// The number of bytes taken in since the last frame or restart.
    fn unframed(&self) -> u64 {
        self.received().saturating_sub(self.place.framed)
    }

    /// The number of bytes that belonged to no whole frame.
    pub fn skipped(&self) -> u64 {
        self.place.skipped
    }

    /// The bytes that may yet become a frame.
    pub fn pending(&self) -> &[u8] {
        &self.bytes[self.start..]
    }

    /// The place in the stream before the pending bytes.
    pub fn place(&self) -> Place {
        self.place
    }

    /// Passes over bytes that belong to no whole frame.
    fn pass(&mut self, count: usize) {
        self.place.in_sync &= self.layout.stays_in_sync();
        if self.settled && self.start + count == self.bytes.len() {
            self.place.in_sync |= self.layout.is_in_sync_after_pause();
        }
        self.place.skipped += count as u64;
        self.advance(count);
    }

    fn advance(&mut self, count: usize) {
        self.start += count;
        self.lines.pass(count);
        self.place.decoded += count as u64;
    }
}

/// What a telnet server is, and what to do.
pub const TELNET: &str =
    "the other end is a telnet server (RFC 2217), which doubles each FF: set it to raw mode";

/// Whether a stream that begins with `bytes` is that of a telnet server: it begins with an option, which
/// the server offers or asks for (RFC 854).
pub fn is_telnet(bytes: &[u8]) -> bool {
    matches!(bytes, [0xFF, 0xFB..=0xFE, 0..=44, ..])
}
