//! Finds the checksum of frames.
//!
//! In: frames with the bytes beside the cells, before them and after them. Out: a checksum that holds in
//! nearly all of them. Each kind is tried at each place: a wrong one never holds.

use std::collections::HashMap;
use std::ops::Range;

use hardnessd_core::wire::Checksum;

use crate::columns::Kind;

/// A checksum that each frame has. Places are counted from the end of the cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Check {
    /// `None` for Adler-32, which the daemon does not read: its bytes are skipped.
    pub(crate) checksum: Option<Checksum>,
    /// The place of its first byte.
    pub(crate) at: usize,
    /// The place from which on it covers everything: the beginning of a frame, or the end of its mark. It is
    /// counted from the end of the cells of the frame before. `None` if it covers the cells.
    pub(crate) begin: Option<usize>,
}

impl Check {
    /// The places of its bytes.
    pub(crate) fn places(&self) -> Range<usize> {
        self.at..self.at + self.bytes()
    }

    pub(crate) fn bytes(&self) -> usize {
        self.checksum.map_or(4, Checksum::bytes)
    }
}

/// The Adler-32 of `bytes` (RFC 1950), as it is sent.
fn adler32(bytes: &[u8]) -> [u8; 4] {
    let (sum, sums) = bytes.iter().fold((1, 0), |(sum, sums), &byte| {
        let sum = (sum + u32::from(byte)) % 65_521;
        (sum, (sums + sum) % 65_521)
    });
    (sums << 16 | sum).to_be_bytes()
}

/// The checksums, the most certain first: the lowest byte of a `sum16` is a `sum8`.
const CHECKSUMS: [Checksum; 14] = [
    Checksum::Crc32,
    Checksum::Crc32Be,
    Checksum::Crc16Modbus,
    Checksum::Crc16ModbusBe,
    Checksum::Crc16Ccitt,
    Checksum::Crc16CcittBe,
    Checksum::Crc16Xmodem,
    Checksum::Crc16XmodemBe,
    Checksum::Sum16,
    Checksum::Sum16Be,
    Checksum::Sum8,
    Checksum::Xor8,
    Checksum::Lrc8,
    Checksum::Crc8,
];

/// Whether a checksum holds, by its index, its place, and where the bytes that it covers begin and end. Many places of
/// the cells ask for the same.
pub(crate) type Tried = HashMap<(usize, [usize; 3]), bool>;

/// The checksum that holds for `spans`: the cells of some frames, with the bytes beside them on both sides.
/// The kinds are those of the bytes on one side. The spans begin at `first` of a frame of `period` bytes.
pub(crate) fn find(
    spans: &[&[u8]],
    beside: &[Kind],
    (first, period): (usize, usize),
    tried: &mut Tried,
) -> Option<Check> {
    let length = beside.len();
    let checksums = [None].into_iter().chain(CHECKSUMS.map(Some));
    for (index, checksum) in checksums.enumerate() {
        let check = |at, begin| Check {
            checksum,
            at,
            begin,
        };
        let bytes = check(0, None).bytes();
        for at in (0..(length + 1).saturating_sub(bytes)).rev() {
            let places = check(at, None).places();
            let mut kinds = beside[places.clone()].iter();
            if kinds.all(|kind| kind.constant().is_some()) {
                continue;
            }
            let mut holds = |from: usize, end: usize| {
                let asked = [at, from, end].map(|place| (first + place) % period);
                *tried.entry((index, asked)).or_insert_with(|| {
                    holds(spans, |span| {
                        let cells_end = span.len() - length;
                        let covered = &span[from..cells_end + end];
                        let sent = checksum
                            .map_or_else(|| adler32(covered), |checksum| checksum.sent(covered));
                        let is_right = span[cells_end..][places.clone()] == sent[..bytes];
                        (sent, is_right)
                    })
                })
            };
            if holds(length, 0) {
                return Some(check(at, None));
            }
            // One of two bytes or more holds by chance nowhere. Others begin with the mark, behind it, or with the cells.
            let is_constant = |kind: &Kind| kind.constant().is_some();
            let mut begins = (places.end..=length).filter(|&begin| {
                let around = &beside[begin - 1..length.min(begin + 1)];
                bytes > 1 || begin == length || around.iter().any(is_constant)
            });
            if let Some(begin) = begins.find(|&begin| holds(begin, at)) {
                return Some(check(at, Some(begin)));
            }
        }
    }
    None
}

/// Whether a checksum holds in nearly all frames, and is not always the same.
fn holds(spans: &[&[u8]], sent: impl Fn(&[u8]) -> ([u8; 4], bool)) -> bool {
    let mut wrong = 0;
    let mut values = Vec::new();
    for span in spans {
        let (value, is_right) = sent(span);
        wrong += usize::from(!is_right);
        if 10 * wrong > spans.len() {
            return false;
        }
        if is_right {
            values.push(value);
        }
    }
    values.sort_unstable();
    values.dedup();
    spans.len() >= 8 && values.len() >= 4
}
