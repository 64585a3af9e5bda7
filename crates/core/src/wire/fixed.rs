//! Frames of one length: `sync, length, header bytes, cells, footer bytes, checksum, tail`, or several
//! packets of these parts.
//!
//! The layout decides when a candidate is whole. A length, a checksum or a tail is checked at its
//! place, and so is the number of a packet. After a failure the search continues one byte further,
//! *inside* the rejected candidate. If a frame has only a header (`jq`), it is whole when another
//! header follows, because the header can also occur in the data. If a frame has only a tail, it is
//! whole when the tail is at its place.

use std::ops::Range;

use super::cells::Cells;
use super::checksum::{Checksum, ChecksumOver};
use super::preset::Keys;
use super::scan::{Context, Scan};
use super::settings::{Cell, FooterBytes, LayoutError, LengthField, Packets};
use crate::range::{self, OutOfRange};

/// The most bytes that a layout can skip before or after the cells: as many as the cells of a large
/// array, which a board may send beside the one that is read.
const MOST_SKIPPED_BYTES: usize = 8192;

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fixed {
    sync: Vec<u8>,
    /// `sync` and the length field, which are the same in every packet.
    mark: Vec<u8>,
    header_bytes: usize,
    cell: Cell,
    /// The bytes of the cells of one packet.
    cell_bytes: usize,
    checksum: Checksum,
    checksum_over: ChecksumOver,
    tail: Vec<u8>,
    /// The packets of a frame, in order.
    packets: Vec<Packet>,
    /// Whether a cell never holds the tail, which has one byte.
    tail_not_in_cells: bool,
}

/// What differs between the packets of a frame.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Packet {
    /// The place of the packet's number and its value, if it has one.
    number: Option<(usize, u8)>,
    footer_bytes: usize,
}

impl Cell {
    /// The number of bytes that the cell takes on the wire.
    pub fn bytes(self) -> usize {
        match self {
            Cell::U8 => 1,
            Cell::U16le | Cell::U16be => 2,
        }
    }
}

impl Fixed {
    pub(super) fn new(keys: Keys) -> Result<Self, LayoutError> {
        if keys.sync.is_empty() && keys.tail.is_empty() {
            return Err(LayoutError::Unmarked);
        }
        if keys.sync.is_empty() && keys.length != LengthField::None {
            return Err(LayoutError::LengthWithoutSync);
        }
        is_skippable("header_bytes", keys.header_bytes)?;
        let cells = keys.rows * keys.cols;
        let count = keys.packets.map_or(1, |packets| packets.count);
        range::check(
            "packets.count",
            count,
            (1..=255).contains(&count) && cells.is_multiple_of(count),
            format_args!("1 to 255 that divides the {cells} cells evenly"),
        )?;
        let cell_bytes = cells / count * keys.cell.bytes();
        let (length, max): (Vec<u8>, usize) = match keys.length {
            LengthField::None => (Vec::new(), usize::MAX),
            LengthField::U8 => (vec![cell_bytes as u8], 0xFF),
            LengthField::U16le => ((cell_bytes as u16).to_le_bytes().to_vec(), 0xFFFF),
            LengthField::U16be => ((cell_bytes as u16).to_be_bytes().to_vec(), 0xFFFF),
        };
        range::check(
            "length",
            format_args!("{cell_bytes} payload bytes"),
            cell_bytes <= max,
            format_args!("at most {max} for this field"),
        )?;
        let mark = [keys.sync.as_slice(), &length].concat();
        let footers = footers(&keys.footer_bytes, count)?;
        let numbers = match keys.packets {
            None => vec![None],
            Some(_) if keys.sync.is_empty() => return Err(LayoutError::PacketsWithoutSync),
            Some(packets) => numbers(packets, keys.header_bytes)?
                .map(|number| Some((mark.len() + packets.number_at, number)))
                .collect(),
        };
        let packets = numbers.into_iter().zip(footers);
        let packets: Vec<Packet> = packets
            .map(|(number, footer_bytes)| Packet {
                number,
                footer_bytes,
            })
            .collect();
        Ok(Self {
            tail_not_in_cells: keys.tail_not_in_cells,
            sync: keys.sync,
            mark,
            header_bytes: keys.header_bytes,
            cell: keys.cell,
            cell_bytes,
            checksum: keys.checksum,
            checksum_over: keys.checksum_over,
            tail: keys.tail,
            packets,
        })
    }

    pub(super) fn has_sync(&self) -> bool {
        !self.sync.is_empty()
    }

    /// The value of a cell with all ones.
    pub(super) fn all_ones(&self) -> u16 {
        match self.cell {
            Cell::U8 => 0xFF,
            Cell::U16le | Cell::U16be => 0xFFFF,
        }
    }

    pub(super) fn largest_cell(&self) -> u16 {
        if self.tail_not_in_cells {
            u16::from(self.tail[0]) - 1
        } else {
            self.all_ones()
        }
    }

    pub(super) fn frame_bytes(&self) -> usize {
        self.packets
            .iter()
            .map(|packet| self.bytes_of(packet))
            .sum()
    }

    fn bytes_of(&self, packet: &Packet) -> usize {
        self.cells_in_packet().end + packet.footer_bytes + self.checksum.bytes() + self.tail.len()
    }

    /// The place of the cells in each packet.
    fn cells_in_packet(&self) -> Range<usize> {
        let start = self.mark.len() + self.header_bytes;
        start..start + self.cell_bytes
    }

    /// The bytes that the checksum at `at` of a packet covers.
    fn covered(&self, at: usize) -> Range<usize> {
        match self.checksum_over {
            ChecksumOver::All => 0..at,
            ChecksumOver::Cells => self.cells_in_packet(),
        }
    }

    pub(super) fn encode(&self, mut cells: impl Iterator<Item = u16>, out: &mut Vec<u8>) {
        out.reserve(self.frame_bytes());
        for packet in &self.packets {
            let start = out.len();
            out.extend_from_slice(&self.mark);
            out.resize(start + self.cells_in_packet().start, 0);
            if let Some((at, number)) = packet.number {
                out[start + at] = number;
            }
            for cell in cells.by_ref().take(self.cell_bytes / self.cell.bytes()) {
                match self.cell {
                    Cell::U8 => out.push(cell as u8),
                    Cell::U16le => out.extend_from_slice(&cell.to_le_bytes()),
                    Cell::U16be => out.extend_from_slice(&cell.to_be_bytes()),
                }
            }
            out.resize(out.len() + packet.footer_bytes, 0);
            let covered = self.covered(out.len() - start);
            let checksum = self.checksum.sent(&out[start..][covered]);
            out.extend_from_slice(&checksum[..self.checksum.bytes()]);
            out.extend_from_slice(&self.tail);
        }
    }

    pub(super) fn scan(&self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        if self.sync.is_empty() {
            return self.scan_for_tail(cells, bytes, context);
        }
        match find(bytes, &self.sync) {
            0 => {}
            skip => return Scan::Skip(skip),
        }
        if self.begins_later_packet(bytes) {
            return lost(1, context);
        }
        match self.is_frame(bytes) {
            None => Scan::Wait,
            Some(false) => Scan::Damaged(1),
            Some(true) if self.checksum == Checksum::None && self.tail.is_empty() => {
                self.scan_for_follower(cells, bytes, context)
            }
            Some(true) => self.whole(cells, bytes),
        }
    }

    /// Whether `bytes` begin with a packet that does not begin a frame: the packets before it are
    /// missing, or the candidate that they began was damaged and has been counted.
    fn begins_later_packet(&self, bytes: &[u8]) -> bool {
        bytes.starts_with(&self.mark)
            && self.packets[1..]
                .iter()
                .filter_map(|packet| packet.number)
                .any(|(at, number)| bytes.get(at) == Some(&number))
    }

    /// Whether `bytes` begin with the packets of a frame, each with the right mark, number, checksum
    /// and tail. `None` if more bytes are needed to know.
    fn is_frame(&self, bytes: &[u8]) -> Option<bool> {
        let mut rest = bytes;
        for packet in &self.packets {
            let shared = rest.len().min(self.mark.len());
            if rest[..shared] != self.mark[..shared] {
                return Some(false);
            }
            if let Some((at, number)) = packet.number
                && *rest.get(at)? != number
            {
                return Some(false);
            }
            let (bytes, after) = rest.split_at_checked(self.bytes_of(packet))?;
            let checksum_at = bytes.len() - self.tail.len() - self.checksum.bytes();
            let (found, tail) = bytes[checksum_at..].split_at(self.checksum.bytes());
            let expected = self.checksum.sent(&bytes[self.covered(checksum_at)]);
            if tail != self.tail || !expected.starts_with(found) {
                return Some(false);
            }
            rest = after;
        }
        Some(true)
    }

    fn whole(&self, cells: &Cells, bytes: &[u8]) -> Scan {
        let mut start = 0;
        let packets = self.packets.iter().map(|packet| {
            let payload = &bytes[start..][self.cells_in_packet()];
            start += self.bytes_of(packet);
            payload
        });
        let frame = match self.cell {
            Cell::U8 => cells.frame(packets.map(|bytes| bytes.iter().map(|&byte| byte.into()))),
            Cell::U16le => cells.frame(packets.map(|bytes| pairs(bytes).map(u16::from_le_bytes))),
            Cell::U16be => cells.frame(packets.map(|bytes| pairs(bytes).map(u16::from_be_bytes))),
        };
        Scan::Frame(self.frame_bytes(), frame)
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

    /// Whether the packets of a frame begin `bytes`, and a mark or the settled end of the input
    /// follows them. `None` if more bytes are needed to know. The mark may be that of any packet,
    /// because a missing packet does not damage the frame before it.
    fn is_followed(&self, bytes: &[u8], settled: bool) -> Option<bool> {
        match self.is_frame(bytes) {
            Some(true) => {}
            None if settled => return Some(false),
            other => return other,
        }
        let rest = &bytes[self.frame_bytes()..];
        let shared = rest.len().min(self.mark.len());
        if rest[..shared] != self.mark[..shared] {
            return Some(false);
        }
        (shared == self.mark.len() || settled).then_some(true)
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
        let period = self.frame_bytes();
        let distance = |at: usize| {
            let phase = (context.offset + at as u64 - context.anchor) % period as u64;
            phase.min(period as u64 - phase)
        };
        let mut best = 0;
        let mut at = 1;
        while at < period {
            at += find(&bytes[at..], &self.mark);
            if at >= period || at + self.mark.len() > bytes.len() {
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
        let tail_at = self.frame_bytes() - self.tail.len();
        if self.tail_not_in_cells
            && let Some(end) = bytes
                .iter()
                .take(tail_at)
                .position(|&byte| byte == self.tail[0])
        {
            return lost(end + 1, context);
        }
        match self.is_frame(bytes) {
            None => Scan::Wait,
            Some(true) => self.whole(cells, bytes),
            // Continue at the next place where a tail may be.
            Some(false) => lost(1 + find(&bytes[tail_at + 1..], &self.tail), context),
        }
    }
}

fn pairs(bytes: &[u8]) -> impl Iterator<Item = [u8; 2]> {
    bytes.chunks_exact(2).map(|pair| [pair[0], pair[1]])
}

fn is_skippable(key: &'static str, bytes: usize) -> Result<(), OutOfRange> {
    let found = format_args!("{bytes} bytes");
    let expected = format_args!("0 to {MOST_SKIPPED_BYTES}");
    range::check(key, found, bytes <= MOST_SKIPPED_BYTES, expected)
}

/// The footer bytes of each packet.
fn footers(footer_bytes: &FooterBytes, packets: usize) -> Result<Vec<usize>, LayoutError> {
    let footers = match footer_bytes {
        FooterBytes::Each(bytes) => vec![*bytes; packets],
        FooterBytes::Of(list) => list.clone(),
    };
    range::check(
        "footer_bytes",
        format_args!("{} numbers", footers.len()),
        footers.len() == packets,
        format_args!("one for each packet ({packets})"),
    )?;
    for &bytes in &footers {
        is_skippable("footer_bytes", bytes)?;
    }
    Ok(footers)
}

/// The numbers of the packets.
fn numbers(packets: Packets, header_bytes: usize) -> Result<impl Iterator<Item = u8>, LayoutError> {
    range::check(
        "packets.number_at",
        packets.number_at,
        packets.number_at < header_bytes,
        format_args!("a byte of the header (header_bytes: {header_bytes})"),
    )?;
    let max = 256 - packets.count;
    range::check(
        "packets.first",
        packets.first,
        usize::from(packets.first) <= max,
        format_args!("at most {max}: a packet's number is one byte"),
    )?;
    Ok((packets.first..=u8::MAX).take(packets.count))
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
