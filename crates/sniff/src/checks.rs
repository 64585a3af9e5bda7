//! Finds the checksum of frames, or a plain sum of the cells that the decoder does not know.
//!
//! In: frames with the bytes beside the cells, before them and after them. Out: what holds in nearly
//! all of them. Each kind is tried at each place: a wrong one never holds.

use std::ops::Range;

use hardnessd_core::wire::{Cell, Checksum};

use crate::columns::{Kind, number};
use crate::numbers;

/// What holds for the bytes at `at`. Places are counted from the end of the cells.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Check {
    pub(crate) at: Range<usize>,
    pub(crate) what: What,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum What {
    /// A checksum of everything from this place on, which is the beginning of a frame, or the end of its
    /// mark. It is counted from the end of the cells of the frame before.
    From(Checksum, usize),
    /// A checksum of the cells.
    Cells(Checksum),
    /// A plain sum of the cells, which no key describes.
    Sum,
}

/// The checksums, the most certain first. A plain sum of two bytes or four comes before the last two,
/// because its lowest byte is a `sum8`.
const LONG: [Checksum; 8] = [
    Checksum::Crc32,
    Checksum::Crc32Be,
    Checksum::Crc16Modbus,
    Checksum::Crc16ModbusBe,
    Checksum::Crc16Ccitt,
    Checksum::Crc16CcittBe,
    Checksum::Crc16Xmodem,
    Checksum::Crc16XmodemBe,
];
const SHORT: [Checksum; 4] = [
    Checksum::Sum8,
    Checksum::Xor8,
    Checksum::Lrc8,
    Checksum::Crc8,
];

/// The checksum that holds for `spans`: the cells of some frames, with the bytes beside them on both sides.
/// The kinds are those of the bytes on one side.
pub(crate) fn long(spans: &[&[u8]], beside: &[Kind]) -> Option<Check> {
    checksum(spans, beside, &LONG)
}

/// The sum of the cells or the checksum of one byte that holds.
pub(crate) fn short(spans: &[&[u8]], beside: &[Kind], cell: Cell) -> Option<Check> {
    sum(spans, beside, cell).or_else(|| checksum(spans, beside, &SHORT))
}

fn checksum(spans: &[&[u8]], beside: &[Kind], checksums: &[Checksum]) -> Option<Check> {
    let length = beside.len();
    for &checksum in checksums {
        for at in (0..=length.checked_sub(checksum.bytes())?).rev() {
            let at = at..at + checksum.bytes();
            if beside[at.clone()]
                .iter()
                .all(|kind| kind.constant().is_some())
            {
                continue;
            }
            let holds = |from: usize, cells_only: bool| {
                let sum = |span: &[u8]| {
                    let cells_end = span.len() - length;
                    let end = cells_end + if cells_only { 0 } else { at.start };
                    let found = &span[cells_end..][at.clone()];
                    let sent = checksum.sent(&span[from..end]);
                    let is_right = *found == sent[..checksum.bytes()];
                    (u32::from_le_bytes(sent), is_right)
                };
                holds(spans, sum)
            };
            // One of two bytes or more holds by chance nowhere. Others begin with the mark, or the cells.
            let mut begins = (at.end..=length).filter(|&start| {
                checksum.bytes() > 1 || start == length || beside[start].constant().is_some()
            });
            let what = begins
                .find(|&start| holds(start, false))
                .map(|start| What::From(checksum, start))
                .or_else(|| holds(length, true).then_some(What::Cells(checksum)));
            if let Some(what) = what {
                return Some(Check { at, what });
            }
        }
    }
    None
}

/// The plain sum of the cells in four bytes or two. Four, only if more than two change.
fn sum(spans: &[&[u8]], beside: &[Kind], cell: Cell) -> Option<Check> {
    let length = beside.len();
    for bytes in [4, 2] {
        for at in 0..=length.checked_sub(bytes)? {
            let at = at..at + bytes;
            let kinds = beside[at.clone()].iter();
            if kinds.filter(|kind| kind.constant().is_none()).count() <= bytes / 2 {
                continue;
            }
            for is_big_endian in [false, true] {
                let sum = |span: &[u8]| {
                    let cells_end = span.len() - length;
                    let cells = numbers::numbers(cell, &span[length..cells_end]);
                    let add = |sum: u32, cell: f32| sum.wrapping_add(cell as u32);
                    let sum = cells.into_iter().fold(0, add);
                    let found = number(&span[cells_end..][at.clone()], is_big_endian) as u32;
                    (
                        sum,
                        found.wrapping_sub(sum) & (u32::MAX >> (32 - 8 * bytes)),
                    )
                };
                // A sum may begin at another number than 0.
                let begin = spans.get(spans.len() / 2).map(|span| sum(span).1);
                let is_right = |span: &[u8]| (sum(span).0, Some(sum(span).1) == begin);
                if holds(spans, is_right) {
                    return Some(Check {
                        at,
                        what: What::Sum,
                    });
                }
            }
        }
    }
    None
}

/// Whether a sum holds in nearly all frames, and is not always the same.
fn holds(spans: &[&[u8]], sum: impl Fn(&[u8]) -> (u32, bool)) -> bool {
    let mut wrong = 0;
    let mut values = Vec::new();
    for span in spans {
        let (value, is_right) = sum(span);
        wrong += usize::from(!is_right);
        if 10 * wrong > spans.len() {
            return false;
        }
        values.push(value);
    }
    values.sort_unstable();
    values.dedup();
    spans.len() >= 8 && values.len() >= 4
}
