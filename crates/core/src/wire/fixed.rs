//! Frames of one length: `sync, length, header bytes, cells, footer bytes, checksum, tail`, or several
//! packets of these parts.
//!
//! What is the same in every frame is checked at its place, and so are the checksums, and that each
//! cell is a number. After a failure the search continues one byte further, *inside* the rejected
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
use super::scan::{Context, Damage, Scan};
use super::settings::{Cell, Framing, HexBytes, LengthField, Packets, Settings};
use crate::frame::{Array, RawFrame};
use crate::range::{self, OutOfRange};

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Fixed {
    framing: Framing,
    sync: Vec<u8>,
    /// `sync` and the length field, which are the same in every packet.
    mark: Vec<u8>,
    tail: Vec<u8>,
    /// The number of the first packet of a frame, and its place.
    number: (usize, Vec<u8>),
    cell: Cell,
    checksum: Checksum,
    /// The number of bytes of a frame before it is packed.
    bytes: usize,
    /// What is the same in every frame, each with its place.
    constants: Vec<(usize, Vec<u8>)>,
    /// The place of each cell, in the order of the wire.
    cells: Vec<usize>,
    /// The place of each checksum, and the bytes that it covers.
    checksums: Vec<(usize, Range<usize>)>,
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
        let count = keys.packets.map_or(1, |packets| packets.count);
        let cells = array.taxels();
        if let Some(packets) = &keys.packets {
            packets.check(cells, header_bytes)?;
            range::check(
                "packets",
                format_args!("no sync, or framing"),
                !sync.is_empty() && framing == Framing::None,
                "sync, with which each packet begins, and no framing",
            )?;
        }
        let stride = keys.stride_bytes.unwrap_or(cell.bytes());
        range::check(
            "stride_bytes",
            stride,
            stride >= cell.bytes(),
            format_args!("at least the {} bytes of a cell", cell.bytes()),
        )?;
        let cell_bytes = (cells / count - 1) * stride + cell.bytes();
        let (length, most): (Vec<u8>, usize) = match length {
            LengthField::None => (Vec::new(), usize::MAX),
            LengthField::U8 => (vec![cell_bytes as u8], 0xFF),
            LengthField::U16le => ((cell_bytes as u16).to_le_bytes().to_vec(), 0xFFFF),
            LengthField::U16be => ((cell_bytes as u16).to_be_bytes().to_vec(), 0xFFFF),
        };
        range::check(
            "length",
            format_args!("{cell_bytes} payload bytes"),
            cell_bytes <= most,
            format_args!("at most {most} for this field"),
        )?;
        let mut fixed = Self {
            framing,
            mark: [sync.as_slice(), &length].concat(),
            sync,
            tail,
            number: (0, Vec::new()),
            cell,
            checksum: keys.checksum.unwrap_or_default(),
            bytes: 0,
            constants: Vec::new(),
            cells: Vec::new(),
            checksums: Vec::new(),
            is_answer: keys.request.is_some(),
        };
        for index in 0..count {
            let start = fixed.bytes;
            fixed.constants.push((start, fixed.mark.clone()));
            let header = start + fixed.mark.len();
            if let Some(packets) = &keys.packets {
                let number = (header + packets.number_at, packets.sent(index));
                fixed.constants.push(number);
            }
            let first = header + header_bytes;
            let of_cells = first..first + cell_bytes;
            fixed.cells.extend(of_cells.clone().step_by(stride));
            let is_last = index + 1 == count;
            let footer_bytes = keys.footer_bytes.filter(|_| is_last).unwrap_or_default();
            let at = of_cells.end + footer_bytes;
            let covered = match keys.checksum_over.unwrap_or_default() {
                ChecksumOver::All => start..at,
                ChecksumOver::AfterSync => start + fixed.sync.len()..at,
                ChecksumOver::Cells => of_cells,
            };
            if fixed.checksum != Checksum::None {
                fixed.checksums.push((at, covered));
            }
            let at = at + fixed.checksum.bytes();
            fixed.constants.push((at, fixed.tail.clone()));
            fixed.bytes = at + fixed.tail.len();
        }
        if keys.packets.is_some() {
            fixed.number = fixed.constants[1].clone();
        }
        let key = match count * header_bytes > cells * stride {
            true => "header_bytes",
            false => "stride_bytes",
        };
        range::check(
            key,
            format_args!("a frame of {} bytes", fixed.bytes),
            fixed.bytes <= MOST_BYTES,
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

    /// The most bytes that may yet become a frame.
    pub(super) fn most_pending_bytes(&self) -> usize {
        match self.framing {
            // The mark of the next frame may be needed to know that a frame is whole.
            Framing::None => self.bytes + self.mark.len(),
            // A frame with some bytes too many is still known by its sync as a damaged one.
            Framing::Slip | Framing::Cobs => 2 * self.bytes + 2,
        }
    }

    /// The numbers of bytes of the shortest and of the longest frame.
    pub(super) fn least_and_most_bytes(&self) -> (usize, usize) {
        let bytes = self.bytes;
        match self.framing {
            Framing::None => (bytes, bytes),
            Framing::Slip => (bytes + 1, 2 * bytes + 2),
            Framing::Cobs => (bytes + 2, bytes + bytes / 254 + 2),
        }
    }

    pub(super) fn encode(&self, cells: impl Iterator<Item = f32>, out: &mut Vec<u8>) {
        let mut frame = vec![0; self.bytes];
        for (at, constant) in &self.constants {
            frame[*at..][..constant.len()].copy_from_slice(constant);
        }
        for (&at, cell) in self.cells.iter().zip(cells) {
            self.cell.write(cell, &mut frame[at..]);
        }
        for (at, covered) in &self.checksums {
            let sent = self.checksum.sent(&frame[covered.clone()]);
            let bytes = self.checksum.bytes();
            frame[*at..][..bytes].copy_from_slice(&sent[..bytes]);
        }
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

    pub(super) fn scan(&self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        match self.framing {
            Framing::None if self.is_bare() => self.scan_bare(cells, bytes, context),
            Framing::None => self.scan_marked(cells, bytes, context),
            Framing::Slip | Framing::Cobs => self.scan_packed(cells, bytes, context),
        }
    }

    /// The frame at `at`, or nothing of it if a cell is no number. `None` if more bytes are needed to know.
    fn frame_at(
        &self,
        cells: &Cells,
        sums: &mut Sums,
        (bytes, at): (&[u8], usize),
        context: Context,
    ) -> Option<Result<Option<RawFrame>, Damage>> {
        let rest = &bytes[at..];
        let (number_at, number) = &self.number;
        rest.get(..self.mark.len().max(number_at + number.len()))?;
        let is_there = |(place, constant): &(usize, Vec<u8>)| {
            shares(rest.get(*place..).unwrap_or_default(), constant)
        };
        if !self.constants.iter().all(is_there) {
            return Some(Err(Damage));
        }
        let frame = rest.get(..self.bytes)?;
        let is_right = |(place, covered): &(usize, Range<usize>)| {
            let sent = sums.sent(at + covered.start..at + covered.end);
            frame[*place..].starts_with(&sent[..self.checksum.bytes()])
        };
        let is_answer = self.is_answer && context.in_sync && at == 0;
        if !self.checksums.iter().all(is_right) {
            return Some(Err(Damage));
        }
        // A frame without a checksum and a tail is whole when the mark of the next one follows it, or the
        // settled end of the input. The mark may be that of any packet, because a missing packet does not
        // damage the frame before it. The answer to a request is whole at once: no other one follows it by
        // itself.
        if self.checksums.is_empty() && self.tail.is_empty() && !is_answer {
            let next = &rest[self.bytes..];
            if !shares(next, &self.mark) {
                return Some(Err(Damage));
            }
            if next.len() < self.mark.len() && !context.settled {
                return None;
            }
        }
        let numbers = self.cells.iter().map(|&at| self.cell.read(&frame[at..]));
        Some(Ok(cells.frame(numbers)))
    }

    /// Searches a layout that has a sync or a tail. Without a mark at its beginning, only the first
    /// candidate after a whole frame counts as damaged. After that the decoder searches.
    fn scan_marked(&self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        let (mark_at, mark) = match self.sync.is_empty() {
            true => (self.bytes - self.tail.len(), &self.tail),
            false => (0, &self.sync),
        };
        let (number_at, number) = &self.number;
        let mut sums = Sums::new(self.checksum, bytes);
        let (mut at, mut damaged) = (0, 0);
        loop {
            match self.frame_at(cells, &mut sums, (bytes, at), context) {
                Some(Ok(Some(frame))) if at == 0 => return Scan::found(self.bytes, frame),
                Some(Ok(None)) if at == 0 => return Scan::past(1, 1),
                Some(Ok(_)) | None => return Scan::past(at, damaged),
                Some(Err(Damage)) => {}
            }
            let rest = &bytes[at..];
            // Another packet begins no frame: those before it are missing, or the candidate that they
            // began was damaged and has been counted.
            let begins_frame = !self.sync.is_empty() && rest[*number_at..].starts_with(number);
            let follows_frame = context.in_sync && at == 0;
            let is_candidate = rest.starts_with(&self.sync) && (begins_frame || follows_frame);
            damaged += u64::from(is_candidate);
            at += 1;
            at += find(&bytes[at + mark_at..], mark);
        }
    }

    /// Searches a layout without marks. Its frames follow each other, and the first one follows a
    /// pause.
    fn scan_bare(&self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        let damaged = u64::from(context.in_sync);
        if context.in_sync && bytes.len() >= self.bytes {
            let mut sums = Sums::new(self.checksum, bytes);
            return match self.frame_at(cells, &mut sums, (bytes, 0), context) {
                Some(Ok(Some(frame))) => Scan::found(self.bytes, frame),
                _ if context.settled => Scan::past(bytes.len(), damaged),
                _ => Scan::past(self.bytes, damaged),
            };
        }
        match context.settled {
            true => Scan::past(bytes.len(), damaged),
            false => Scan::past(bytes.len().saturating_sub(self.bytes), 0),
        }
    }

    /// Searches frames that are packed.
    fn scan_packed(&self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        let most = self.most_pending_bytes();
        let end = self.framing.end();
        let found = bytes.iter().position(|&byte| byte == end);
        let Some(packed) = found.map(|at| &bytes[..=at]) else {
            return Scan::past(bytes.len().saturating_sub(most), 0);
        };
        if packed.len() > most {
            return Scan::past(packed.len(), 0);
        }
        let unpacked = self.framing.unpacked(packed).unwrap_or_default();
        // Nothing is between packed frames, so that the next one need not be awaited.
        let settled = Context {
            settled: true,
            ..context
        };
        let mut sums = Sums::new(self.checksum, &unpacked);
        let frame = self.frame_at(cells, &mut sums, (&unpacked, 0), settled);
        match frame {
            Some(Ok(Some(frame))) if unpacked.len() == self.bytes => {
                return Scan::found(packed.len(), frame);
            }
            Some(Ok(None)) if unpacked.len() == self.bytes => return Scan::past(packed.len(), 1),
            _ => {}
        }
        let is_candidate = context.in_sync && packed.len() > 1 && shares(&unpacked, &self.sync);
        Scan::past(packed.len(), is_candidate.into())
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

impl Packets {
    /// Checks that the packets share `cells` evenly, and that the number of each lies in the header and
    /// fits.
    fn check(&self, cells: usize, header_bytes: usize) -> Result<(), OutOfRange> {
        range::check(
            "packets.count",
            self.count,
            (1..=cells).contains(&self.count) && cells.is_multiple_of(self.count),
            format_args!("1 to {cells} that divides the {cells} cells evenly"),
        )?;
        range::check(
            "packets.number_at",
            self.number_at,
            self.number_at + self.number.bytes() <= header_bytes,
            format_args!("a place in the header (header_bytes: {header_bytes})"),
        )?;
        range::check("packets.step", self.step, self.step > 0, "at least 1")?;
        let most = self.number.range().map_or(0.0, |(_, most)| most);
        let most = most.min(u16::MAX.into());
        let last = self.value(self.count - 1);
        range::check(
            "packets.first",
            format_args!("{}, and {last} for the last packet", self.first),
            last <= most,
            format_args!("at most {most} for this number"),
        )
    }

    /// The number of the packet at this place of a frame.
    fn value(&self, index: usize) -> f32 {
        f32::from(self.first) + f32::from(self.step) * index as f32
    }

    /// The number as it is sent.
    fn sent(&self, index: usize) -> Vec<u8> {
        let mut bytes = vec![0; self.number.bytes()];
        self.number.write(self.value(index), &mut bytes);
        bytes
    }
}

/// The longest frame: 64x64 taxels of four numbers of four bytes, and as much beside them.
const MOST_BYTES: usize = 128 * 1024;

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
