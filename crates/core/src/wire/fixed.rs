//! Frames of one length: `sync, length, cells, checksum, tail`.
//!
//! The layout decides when a candidate is whole. A length, a checksum or a tail is checked at its
//! place. After a failure the search continues one byte further, *inside* the rejected candidate.
//! If a frame has only a header (`jq`), it is whole when another header follows, because the header
//! can also occur in the data. If a frame has only a tail, it is whole when the tail is at its
//! place.

use super::cells::Cells;
use super::checksum::Checksum;
use super::scan::{Context, Scan};
use super::settings::{Cell, LayoutError, LengthField};
use crate::frame::RawFrame;

/// The parts of a layout.
#[derive(Debug)]
pub(super) struct Parts {
    pub(super) sync: Vec<u8>,
    pub(super) tail: Vec<u8>,
    pub(super) length: LengthField,
    pub(super) cell: Cell,
    pub(super) checksum: Checksum,
    /// Whether a cell never holds the tail, which has one byte.
    pub(super) tail_not_in_cells: bool,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fixed {
    sync: Vec<u8>,
    /// `sync` and the length field, which are both constant.
    header: Vec<u8>,
    tail: Vec<u8>,
    cell: Cell,
    payload_bytes: usize,
    checksum: Checksum,
    tail_not_in_cells: bool,
}

impl Cell {
    fn bytes(self) -> usize {
        match self {
            Cell::U8 => 1,
            Cell::U16le | Cell::U16be => 2,
        }
    }
}

impl Fixed {
    pub(super) fn new(parts: Parts, cells: usize) -> Result<Self, LayoutError> {
        let payload_bytes = cells * parts.cell.bytes();
        if parts.sync.is_empty() && parts.tail.is_empty() {
            return Err(LayoutError::Unmarked);
        }
        if parts.sync.is_empty() && parts.length != LengthField::None {
            return Err(LayoutError::LengthWithoutSync);
        }
        let (length, max): (Vec<u8>, usize) = match parts.length {
            LengthField::None => (Vec::new(), usize::MAX),
            LengthField::U8 => (vec![payload_bytes as u8], 0xFF),
            LengthField::U16le => ((payload_bytes as u16).to_le_bytes().to_vec(), 0xFFFF),
            LengthField::U16be => ((payload_bytes as u16).to_be_bytes().to_vec(), 0xFFFF),
        };
        if payload_bytes > max {
            return Err(LayoutError::LengthField {
                found: payload_bytes,
                max,
            });
        }
        Ok(Self {
            header: [parts.sync.as_slice(), &length].concat(),
            sync: parts.sync,
            tail: parts.tail,
            cell: parts.cell,
            payload_bytes,
            checksum: parts.checksum,
            tail_not_in_cells: parts.tail_not_in_cells,
        })
    }

    pub(super) fn has_sync(&self) -> bool {
        !self.sync.is_empty()
    }

    pub(super) fn largest_cell(&self) -> u16 {
        match self.cell {
            Cell::U8 => 0xFF,
            Cell::U16le | Cell::U16be => 0xFFFF,
        }
    }

    pub(super) fn frame_bytes(&self, cells: usize) -> usize {
        self.header.len() + cells * self.cell.bytes() + self.checksum.bytes() + self.tail.len()
    }

    fn total(&self) -> usize {
        self.header.len() + self.payload_bytes + self.checksum.bytes() + self.tail.len()
    }

    pub(super) fn encode(&self, cells: impl Iterator<Item = u16>, count: usize, out: &mut Vec<u8>) {
        let start = out.len();
        out.reserve(self.frame_bytes(count));
        out.extend_from_slice(&self.header);
        for cell in cells {
            match self.cell {
                Cell::U8 => out.push(cell as u8),
                Cell::U16le => out.extend_from_slice(&cell.to_le_bytes()),
                Cell::U16be => out.extend_from_slice(&cell.to_be_bytes()),
            }
        }
        let checksum = self.checksum.of(&out[start..]).to_le_bytes();
        out.extend_from_slice(&checksum[..self.checksum.bytes()]);
        out.extend_from_slice(&self.tail);
    }

    pub(super) fn scan(&self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        if self.sync.is_empty() {
            return self.scan_for_tail(cells, bytes, context);
        }
        match find(bytes, &self.sync) {
            0 => {}
            skip => return Scan::Skip(skip),
        }
        if bytes.len() < self.header.len() {
            return Scan::Wait;
        }
        if bytes[..self.header.len()] != self.header {
            return Scan::Damaged(1);
        }
        if bytes.len() < self.total() {
            return Scan::Wait;
        }
        if self.checksum == Checksum::None && self.tail.is_empty() {
            return self.scan_for_follower(cells, bytes, context);
        }
        if self.ends_well(bytes) {
            self.whole(cells, bytes)
        } else {
            Scan::Damaged(1)
        }
    }

    /// Whether a candidate of full length has the right checksum and tail.
    fn ends_well(&self, bytes: &[u8]) -> bool {
        let at = self.header.len() + self.payload_bytes;
        let expected = self.checksum.of(&bytes[..at]).to_le_bytes();
        let (found, tail) = bytes[at..self.total()].split_at(self.checksum.bytes());
        tail == self.tail && expected.starts_with(found)
    }

    fn whole(&self, cells: &Cells, bytes: &[u8]) -> Scan {
        let mut frame = RawFrame::zero(cells.array);
        let payload = &bytes[self.header.len()..self.header.len() + self.payload_bytes];
        match self.cell {
            Cell::U8 => {
                for (index, &cell) in payload.iter().enumerate() {
                    cells.place(&mut frame, index, u16::from(cell));
                }
            }
            Cell::U16le | Cell::U16be => {
                for (index, pair) in payload.chunks_exact(2).enumerate() {
                    let pair = [pair[0], pair[1]];
                    let cell = if self.cell == Cell::U16le {
                        u16::from_le_bytes(pair)
                    } else {
                        u16::from_be_bytes(pair)
                    };
                    cells.place(&mut frame, index, cell);
                }
            }
        }
        Scan::Frame(self.total(), frame)
    }

    /// Searches a layout that has only a header. A frame is whole when another header follows.
    fn scan_for_follower(&self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        match self.is_followed(bytes, context.settled) {
            None => Scan::Wait,
            Some(false) => Scan::Damaged(1),
            Some(true) if context.locked => self.whole(cells, bytes),
            Some(true) => match self.nearest_in_phase(bytes, context) {
                None => Scan::Wait,
                Some(0) => self.whole(cells, bytes),
                Some(skip) => Scan::Skip(skip),
            },
        }
    }

    /// Whether a header, or the settled end of the input, follows the candidate at the front of
    /// `bytes`. `None` if more bytes are needed to know.
    fn is_followed(&self, bytes: &[u8], settled: bool) -> Option<bool> {
        let Some(rest) = bytes.get(self.total()..) else {
            return if settled { Some(false) } else { None };
        };
        let shared = rest.len().min(self.header.len());
        if rest[..shared] != self.header[..shared] {
            return Some(false);
        }
        (shared == self.header.len() || settled).then_some(true)
    }

    /// The place in `bytes` of the candidate to take after damage, or `None` if more bytes are
    /// needed.
    ///
    /// After damage, several candidates may have something that looks like a header after them. An
    /// example is a press held still, where a header in the data repeats in every frame. Damage
    /// mostly loses or adds few bytes, so the candidate nearest to the phase before the damage is
    /// taken. Of two candidates that are as near, the earlier one is taken.
    ///
    /// A candidate that has a header after it is held, up to two frames of bytes, as long as a
    /// nearer header within it still waits for its own next header. Holding fewer bytes is not
    /// enough. Let `HuHv` be as long as a frame, and `H` its header. Two streams begin with
    /// `HuHvHu`. `Hu HvHu HvHu` is the rest of a damaged frame, then two whole frames with a header
    /// in their data. `HuHv Huvw` is two whole frames, of which the first has a header in its data.
    /// The streams first differ where the frame at the second `H` would end. A decision before that
    /// place would give a frame that was never sent in one stream, or lose a whole frame in the
    /// other.
    fn nearest_in_phase(&self, bytes: &[u8], context: Context) -> Option<usize> {
        let period = self.total() as u64;
        let distance = |at: usize| {
            let phase = (context.offset + at as u64 - context.anchor) % period;
            phase.min(period - phase)
        };
        let mut best = 0;
        let mut at = 1;
        while at < self.total() {
            at += find(&bytes[at..], &self.header);
            if at >= self.total() || at + self.header.len() > bytes.len() {
                break;
            }
            if distance(at) < distance(best) && self.is_followed(&bytes[at..], context.settled)? {
                best = at;
            }
            at += 1;
        }
        Some(best)
    }

    /// Searches a layout that has a tail but no sync. A frame is whole when the tail is at its
    /// place.
    fn scan_for_tail(&self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        let total = self.total();
        let tail_at = total - self.tail.len();
        if self.tail_not_in_cells
            && let Some(end) = bytes
                .iter()
                .take(tail_at)
                .position(|byte| *byte == self.tail[0])
        {
            return lost(end + 1, context);
        }
        if bytes.len() < total {
            return Scan::Wait;
        }
        if self.ends_well(bytes) {
            return self.whole(cells, bytes);
        }
        // Continue at the next place where a tail may be.
        lost(1 + find(&bytes[tail_at + 1..], &self.tail), context)
    }
}

/// Only the first candidate after a whole frame counts as damaged. After that the decoder searches.
fn lost(skip: usize, context: Context) -> Scan {
    if context.locked {
        Scan::Damaged(skip)
    } else {
        Scan::Skip(skip)
    }
}

/// The place where `mark` first occurs in `bytes`, or where it may begin once more bytes come.
/// `bytes.len()` if there is no such place.
fn find(bytes: &[u8], mark: &[u8]) -> usize {
    (0..bytes.len())
        .find(|&at| {
            let rest = &bytes[at..];
            let shared = rest.len().min(mark.len());
            rest[..shared] == mark[..shared]
        })
        .unwrap_or(bytes.len())
}
