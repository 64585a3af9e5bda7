//! Frames of one length: `sync, length, header bytes, cells, footer bytes, checksum, tail`, or several
//! packets of these parts.
//!
//! A length, a checksum or a tail is checked at its place, and so is the number of a packet, and that
//! each cell is a number. After a failure the search continues one byte further, *inside* the rejected
//! candidate. If a frame has neither a checksum nor a tail (`jq`), it is whole when the header of the
//! next frame follows it, because the header can also occur in the data. A header in the data, with
//! another one a frame later, is taken for a frame if the search meets it first: that damage cannot be
//! told.
//!
//! A frame that is packed ends with a byte that occurs nowhere else. A frame with neither `sync` nor
//! `tail` begins where a frame ended, or after a pause.

use std::ops::Range;

use super::cells::Cells;
use super::checksum::{Checksum, ChecksumOver, Sums};
use super::scan::{Context, Scan};
use super::settings::{Cell, FooterBytes, Framing, HexBytes, LengthField, Packets, Settings};
use crate::frame::{Array, RawFrame};
use crate::range::{self, OutOfRange};

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fixed {
    framing: Framing,
    sync: Vec<u8>,
    /// `sync` and the length field, which are the same in every packet.
    mark: Vec<u8>,
    header_bytes: usize,
    cell: Cell,
    /// The bytes from one cell to the next.
    stride: usize,
    /// The bytes of one packet from its first cell to the end of its last one.
    cell_bytes: usize,
    checksum: Checksum,
    checksum_over: ChecksumOver,
    tail: Vec<u8>,
    /// How the packets are numbered, if there are several.
    packets: Option<Packets>,
    /// The footer bytes of each packet of a frame, in order.
    footers: Vec<usize>,
    /// Whether a frame is the answer to a request, so that nothing comes before the first one.
    is_answer: bool,
}

impl Fixed {
    pub(super) fn new(keys: &Settings, array: Array) -> Result<Self, OutOfRange> {
        let bytes = |given: &Option<HexBytes>| given.clone().unwrap_or_default().0;
        let (sync, tail) = (bytes(&keys.sync), bytes(&keys.tail));
        let length = keys.length.unwrap_or_default();
        let header_bytes = keys.header_bytes.unwrap_or_default();
        let cell = keys.cell.unwrap_or_default();
        let framing = keys.framing.unwrap_or_default();
        range::check(
            "length",
            format_args!("a length field without sync"),
            !sync.is_empty() || length == LengthField::None || framing != Framing::None,
            "sync before it",
        )?;
        let cells = array.taxels();
        let count = keys.packets.map_or(1, |packets| packets.count);
        range::check(
            "packets.count",
            count,
            (1..=cells).contains(&count) && cells.is_multiple_of(count),
            format_args!("1 to {cells} that divides the {cells} cells evenly"),
        )?;
        let stride = keys.stride_bytes.unwrap_or(cell.bytes());
        range::check(
            "stride_bytes",
            stride,
            stride >= cell.bytes(),
            format_args!("at least the {} bytes of a cell", cell.bytes()),
        )?;
        let cell_bytes = (cells / count - 1) * stride + cell.bytes();
        let (length, max): (Vec<u8>, usize) = match length {
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
        let mark = [sync.as_slice(), &length].concat();
        let footers = footers(keys.footer_bytes.clone().unwrap_or_default(), count)?;
        if keys.packets.is_some() && (sync.is_empty() || framing != Framing::None) {
            let found = format_args!("no sync, or framing");
            let expected = "sync, with which each packet begins, and no framing";
            return Err(OutOfRange::new("packets", found, expected));
        }
        if let Some(packets) = keys.packets {
            check_numbers(packets, header_bytes)?;
        }
        let fixed = Self {
            framing,
            sync,
            mark,
            header_bytes,
            cell,
            stride,
            cell_bytes,
            checksum: keys.checksum.unwrap_or_default(),
            checksum_over: keys.checksum_over.unwrap_or_default(),
            tail,
            packets: keys.packets,
            footers,
            is_answer: keys.request.is_some(),
        };
        range::check(
            "stride_bytes",
            format_args!("a frame of {} bytes", fixed.frame_bytes()),
            fixed.frame_bytes() <= MOST_BYTES,
            format_args!("at most {MOST_BYTES} bytes"),
        )?;
        Ok(fixed)
    }

    /// Whether the first byte of a stream counts as the beginning of a frame. Only a sync shows whether
    /// it is one, and nothing comes before the answer to a request.
    pub(super) fn begins_in_sync(&self) -> bool {
        self.framing == Framing::None && (!self.sync.is_empty() || self.is_bare() && self.is_answer)
    }

    /// Whether the search stays in sync when it skips bytes: each byte that ends a packed frame may
    /// begin the next one.
    pub(super) fn stays_in_sync(&self) -> bool {
        self.framing != Framing::None
    }

    /// Whether a frame begins after a pause, because it has no mark.
    pub(super) fn is_bare(&self) -> bool {
        self.framing == Framing::None && self.sync.is_empty() && self.tail.is_empty()
    }

    /// The number of bytes of a frame before it is packed.
    fn frame_bytes(&self) -> usize {
        let bytes = self.footers.iter().map(|&footer| self.packet_bytes(footer));
        bytes.sum()
    }

    /// The bytes of the mark of the next frame, which may be needed to know that a frame is whole.
    pub(super) fn mark_bytes(&self) -> usize {
        self.mark.len()
    }

    /// The numbers of bytes of the shortest and of the longest frame.
    pub(super) fn least_and_most_bytes(&self) -> (usize, usize) {
        let bytes = self.frame_bytes();
        match self.framing {
            Framing::None => (bytes, bytes),
            Framing::Slip => (bytes + 1, 2 * bytes + 2),
            Framing::Cobs => (bytes + 2, bytes + bytes / 254 + 2),
        }
    }

    fn packet_bytes(&self, footer: usize) -> usize {
        self.cells_in_packet().end + footer + self.checksum.bytes() + self.tail.len()
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
            ChecksumOver::AfterSync => self.sync.len()..at,
            ChecksumOver::Cells => self.cells_in_packet(),
        }
    }

    pub(super) fn encode(&self, cells: impl Iterator<Item = f32>, out: &mut Vec<u8>) {
        let frame = self.encoded(cells);
        match self.framing {
            Framing::None => out.extend(frame),
            Framing::Slip => {
                let mut encoder = slip_codec::SlipEncoder::new(false);
                let written = encoder.encode(&frame, out);
                written.expect("a vector takes all bytes");
            }
            Framing::Cobs => {
                out.extend(cobs::encode_vec(&frame));
                out.push(0);
            }
        }
    }

    fn encoded(&self, mut cells: impl Iterator<Item = f32>) -> Vec<u8> {
        let mut out = Vec::with_capacity(self.frame_bytes());
        for (index, footer) in self.footers.iter().enumerate() {
            let start = out.len();
            out.extend_from_slice(&self.mark);
            out.resize(start + self.cells_in_packet().start, 0);
            if let Some(packets) = self.packets {
                let mut number = Vec::new();
                let value = packets.first + packets.step * index as u16;
                packets.number.write(value.into(), &mut number);
                let at = start + self.mark.len() + packets.number_at;
                out[at..][..number.len()].copy_from_slice(&number);
            }
            for (at, cell) in cells.by_ref().take(self.cells_of_a_packet()).enumerate() {
                let place = start + self.cells_in_packet().start + at * self.stride;
                out.resize(place, 0);
                self.cell.write(cell, &mut out);
            }
            out.resize(out.len() + footer, 0);
            let covered = self.covered(out.len() - start);
            let checksum = self.checksum.sent(&out[start..][covered]);
            out.extend_from_slice(&checksum[..self.checksum.bytes()]);
            out.extend_from_slice(&self.tail);
        }
        out
    }

    fn cells_of_a_packet(&self) -> usize {
        (self.cell_bytes - self.cell.bytes()) / self.stride + 1
    }

    pub(super) fn scan(&self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        match self.framing {
            Framing::None if self.is_bare() => self.scan_bare(cells, bytes, context),
            Framing::None if self.sync.is_empty() => self.scan_for_tail(cells, bytes, context),
            Framing::None => self.scan_for_sync(cells, bytes, context),
            Framing::Slip | Framing::Cobs => self.scan_packed(cells, bytes, context),
        }
    }

    fn scan_for_sync(&self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        let mut sums = Sums::new(self.checksum, bytes);
        let (mut at, mut damaged) = (0, 0);
        loop {
            at += find(&bytes[at..], &self.sync);
            let rest = &bytes[at..];
            if rest.is_empty() {
                return Scan::past(at, damaged);
            }
            if self.begins_later_packet(rest) {
                // The packets before it are missing.
                damaged += u64::from(context.in_sync && at == 0);
            } else {
                match self.is_whole(&mut sums, bytes, at, context) {
                    None => return Scan::past(at, damaged),
                    Some(true) => match self.frame(cells, rest) {
                        Some(_) if at > 0 => return Scan::past(at, damaged),
                        Some(frame) => return self.found(frame),
                        None => damaged += 1,
                    },
                    Some(false) => damaged += 1,
                }
            }
            at += 1;
        }
    }

    /// Whether a whole frame begins at `at`. `None` if more bytes are needed to know. A frame without
    /// a checksum and a tail is whole when the mark of the next one follows it, or the settled end of
    /// the input. The mark may be that of any packet, because a missing packet does not damage the
    /// frame before it. The answer to a request is whole at once: no other one follows it by itself.
    fn is_whole(&self, sums: &mut Sums, bytes: &[u8], at: usize, context: Context) -> Option<bool> {
        let has_packets = self.has_packets(sums, bytes, at)?;
        let is_marked_at_its_end = self.checksum != Checksum::None || !self.tail.is_empty();
        let is_answer = self.is_answer && context.in_sync && at == 0;
        if !has_packets || is_marked_at_its_end || is_answer {
            return Some(has_packets);
        }
        let next = &bytes[at + self.frame_bytes()..];
        match shares(next, &self.mark) {
            false => Some(false),
            true => (next.len() >= self.mark.len() || context.settled).then_some(true),
        }
    }

    /// Whether `bytes` begin with a packet that does not begin a frame: the packets before it are
    /// missing, or the candidate that they began was damaged and has been counted.
    fn begins_later_packet(&self, bytes: &[u8]) -> bool {
        bytes.starts_with(&self.mark)
            && self
                .index(bytes)
                .is_some_and(|index| (1..self.footers.len()).contains(&index))
    }

    /// The place of `packet` among those of a frame by its number, if it has one.
    fn index(&self, packet: &[u8]) -> Option<usize> {
        let Packets {
            number_at,
            number,
            first,
            step,
            ..
        } = self.packets?;
        let at = self.mark.len() + number_at;
        let number = number.read(packet.get(at..at + number.bytes())?) as u16;
        let by = number.checked_sub(first)?;
        by.is_multiple_of(step).then_some(usize::from(by / step))
    }

    /// Whether the packets of a frame begin at `at`, each with the right mark, number, checksum and
    /// tail. `None` if more bytes are needed to know.
    fn has_packets(&self, sums: &mut Sums, bytes: &[u8], mut at: usize) -> Option<bool> {
        for (index, &footer) in self.footers.iter().enumerate() {
            let rest = &bytes[at..];
            if !shares(rest, &self.mark) {
                return Some(false);
            }
            if let Some(packets) = self.packets {
                rest.get(..self.mark.len() + packets.number_at + packets.number.bytes())?;
                if self.index(rest) != Some(index) {
                    return Some(false);
                }
            }
            let packet = rest.get(..self.packet_bytes(footer))?;
            let checksum_at = packet.len() - self.tail.len() - self.checksum.bytes();
            let (found, tail) = packet[checksum_at..].split_at(self.checksum.bytes());
            let covered = self.covered(checksum_at);
            let mut expected = || sums.sent(at + covered.start, at + covered.end);
            if tail != self.tail || !found.is_empty() && !expected().starts_with(found) {
                return Some(false);
            }
            at += packet.len();
        }
        Some(true)
    }

    /// The frame that begins `bytes`, if each cell is a number.
    fn frame(&self, cells: &Cells, bytes: &[u8]) -> Option<RawFrame> {
        let mut start = 0;
        let packets = self.footers.iter().flat_map(|&footer| {
            let payload = &bytes[start..][self.cells_in_packet()];
            start += self.packet_bytes(footer);
            payload.chunks(self.stride).map(|cell| self.cell.read(cell))
        });
        cells.frame(packets)
    }

    fn found(&self, frame: RawFrame) -> Scan {
        Scan::Frame {
            bytes: self.frame_bytes(),
            frame,
        }
    }

    /// Searches a layout that has a tail but no sync. A frame is whole when the tail is at its
    /// place. Without a mark at its beginning, only the first candidate after a whole frame counts as
    /// damaged. After that the decoder searches.
    fn scan_for_tail(&self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        let mut sums = Sums::new(self.checksum, bytes);
        let tail_at = self.frame_bytes() - self.tail.len();
        let (mut at, mut damaged) = (0, 0);
        loop {
            let frame = match self.has_packets(&mut sums, bytes, at) {
                None => return Scan::past(at, damaged),
                Some(is_whole) => is_whole.then(|| self.frame(cells, &bytes[at..])).flatten(),
            };
            match frame {
                Some(frame) if at == 0 => return self.found(frame),
                Some(_) => return Scan::past(at, damaged),
                // Continue at the next place where a tail may be.
                None => {
                    damaged += u64::from(context.in_sync && at == 0);
                    at += 1 + find(&bytes[at + tail_at + 1..], &self.tail);
                }
            }
        }
    }

    /// Searches a layout without marks. Its frames follow each other, and the first one follows a
    /// pause.
    fn scan_bare(&self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        let length = self.frame_bytes();
        let damaged = u64::from(context.in_sync);
        if context.in_sync && bytes.len() >= length {
            let mut sums = Sums::new(self.checksum, bytes);
            let is_whole = self.has_packets(&mut sums, bytes, 0) == Some(true);
            let frame = is_whole.then(|| self.frame(cells, bytes)).flatten();
            return match frame {
                Some(frame) => self.found(frame),
                None if context.settled => Scan::past(bytes.len(), damaged),
                None => Scan::past(length, damaged),
            };
        }
        match context.settled {
            true => Scan::past(bytes.len(), damaged),
            false => Scan::past(bytes.len().saturating_sub(length), 0),
        }
    }

    /// Searches frames that are packed.
    fn scan_packed(&self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        let (_, most) = self.least_and_most_bytes();
        let end = self.framing.end();
        let found = bytes.iter().position(|&byte| byte == end);
        let Some(packed) = found.map(|at| &bytes[..=at]) else {
            return Scan::past(bytes.len().saturating_sub(most), 0);
        };
        if packed.len() > most {
            return Scan::noise(packed.len());
        }
        let unpacked = self.framing.unpacked(packed).unwrap_or_default();
        let is_whole = unpacked.len() == self.frame_bytes()
            && self.has_packets(&mut Sums::new(self.checksum, &unpacked), &unpacked, 0)
                == Some(true);
        let frame = is_whole.then(|| self.frame(cells, &unpacked)).flatten();
        let is_candidate = context.in_sync && packed.len() > 1 && shares(&unpacked, &self.sync);
        match frame {
            Some(frame) => Scan::Frame {
                bytes: packed.len(),
                frame,
            },
            None => Scan::past(packed.len(), is_candidate.into()),
        }
    }
}

impl Framing {
    /// The byte that ends a packed frame, and occurs nowhere else.
    pub fn end(self) -> u8 {
        match self {
            Framing::Slip => 0xC0,
            Framing::None | Framing::Cobs => 0,
        }
    }

    /// The bytes of a frame that was packed, with the byte that ends it. `None` if it was damaged.
    pub fn unpacked(self, packed: &[u8]) -> Option<Vec<u8>> {
        match self {
            Framing::None => Some(packed.to_vec()),
            Framing::Slip => {
                let mut frame = Vec::new();
                let decoded = slip_codec::SlipDecoder::new().decode(&mut &*packed, &mut frame);
                decoded.is_ok().then_some(frame)
            }
            Framing::Cobs => cobs::decode_vec(packed.strip_suffix(&[0])?).ok(),
        }
    }
}

/// The longest frame: 64x64 taxels of four numbers of four bytes, and as much beside them.
const MOST_BYTES: usize = 128 * 1024;

/// Checks that the number of each packet lies in the header, and fits.
fn check_numbers(packets: Packets, header_bytes: usize) -> Result<(), OutOfRange> {
    let Packets {
        count,
        number_at,
        number,
        first,
        step,
    } = packets;
    range::check(
        "packets.number_at",
        number_at,
        number_at + number.bytes() <= header_bytes,
        format_args!("a place in the header (header_bytes: {header_bytes})"),
    )?;
    range::check("packets.step", step, step > 0, "at least 1")?;
    let max = number.range().map_or(0, |(_, most)| most as usize);
    let last = usize::from(first) + (count - 1) * usize::from(step);
    range::check(
        "packets.first",
        format_args!("{first}, and {last} for the last packet"),
        last <= max.min(usize::from(u16::MAX)),
        format_args!("at most {max} for this number"),
    )
}

/// The footer bytes of each packet.
fn footers(footer_bytes: FooterBytes, packets: usize) -> Result<Vec<usize>, OutOfRange> {
    let footers = match footer_bytes {
        FooterBytes::Each(bytes) => vec![bytes; packets],
        FooterBytes::Of(list) => list,
    };
    range::check(
        "footer_bytes",
        format_args!("{} numbers", footers.len()),
        footers.len() == packets,
        format_args!("one for each packet ({packets})"),
    )?;
    Ok(footers)
}

/// Whether `bytes` begin with `mark`, as far as they reach.
fn shares(bytes: &[u8], mark: &[u8]) -> bool {
    let shared = bytes.len().min(mark.len());
    bytes[..shared] == mark[..shared]
}

/// The place where `mark` first occurs in `bytes`, or where it may begin once more bytes come.
/// `bytes.len()` if there is no such place.
fn find(bytes: &[u8], mark: &[u8]) -> usize {
    (0..bytes.len())
        .find(|&at| shares(&bytes[at..], mark))
        .unwrap_or(bytes.len())
}
