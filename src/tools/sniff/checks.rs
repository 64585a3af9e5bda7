//! Finds the checksum of frames, and sums that the decoder does not know.
//!
//! In: frames that begin with the cells and end with the stretch that holds the mark. Out: the
//! checksum with the bytes that it covers, or the bytes of a sum.

use std::ops::Range;

use hardnessd_core::wire::{Cell, Checksum};

use super::columns::{Columns, Kind};
use super::period::Frames;

/// A checksum that holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Check {
    pub(super) checksum: Checksum,
    /// The place of its first byte, counted from the cells.
    pub(super) at: usize,
    pub(super) over: Over,
}

/// What a checksum covers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Over {
    /// Everything from this place on, which is then the beginning of a frame. It is counted from the
    /// cells of the frame before.
    All(usize),
    /// These bytes, which are then the cells.
    Cells(Range<usize>),
}

/// The checksums, the most certain first. A plain sum of two bytes or four comes before the last two,
/// because its lowest byte is a `sum8`.
const LONG: [Checksum; 6] = [
    Checksum::Crc32,
    Checksum::Crc32Be,
    Checksum::Crc16Modbus,
    Checksum::Crc16ModbusBe,
    Checksum::Crc16Ccitt,
    Checksum::Crc16CcittBe,
];
const SHORT: [Checksum; 2] = [Checksum::Sum8, Checksum::Xor8];
/// A checksum may be this far before the mark, with a part of the tail between.
const BEFORE_MARK: usize = 12;
/// The most bytes before and after the cells that a checksum over the cells may leave out.
const BESIDE_CELLS: usize = 8;
/// The number of frames that a checksum is tried on.
const TRIED: usize = 40;

/// What holds for frames whose last `overhead` bytes hold the mark.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Holds {
    Checksum(Check),
    /// A plain sum of the cells, which no key describes.
    Sum(Range<usize>),
}

pub(super) fn holding(frames: &Frames, columns: &Columns, overhead: usize) -> Option<Holds> {
    let of = |checksums: &[Checksum]| {
        checksum(frames, columns, overhead, checksums).map(Holds::Checksum)
    };
    of(&LONG)
        .or_else(|| sum(frames, columns, overhead).map(Holds::Sum))
        .or_else(|| of(&SHORT))
}

fn checksum(
    frames: &Frames,
    columns: &Columns,
    overhead: usize,
    checksums: &[Checksum],
) -> Option<Check> {
    let period = frames.period();
    let mark_at = period - overhead;
    let is_cell = |at: usize| columns.kinds[at] == Kind::Active;
    for &checksum in checksums {
        for at in (mark_at.saturating_sub(BEFORE_MARK)..=period - checksum.bytes()).rev() {
            let end = at + checksum.bytes();
            let changes = (at..end).any(|at| !matches!(columns.kinds[at], Kind::Constant(_)));
            if !changes || (end..mark_at).any(is_cell) {
                continue;
            }
            let mut begins = (end.max(mark_at)..=period).filter(|&start| {
                start == period || matches!(columns.kinds[start], Kind::Constant(_))
            });
            let all =
                begins.find(|&start| holds(frames, checksum, at, Some(period - start), 0..at));
            if let Some(start) = all {
                return Some(Check {
                    checksum,
                    at,
                    over: Over::All(start),
                });
            }
            for end in (at.saturating_sub(BESIDE_CELLS)..=at).rev() {
                for start in 0..=BESIDE_CELLS.min(end) {
                    if holds(frames, checksum, at, None, start..end) {
                        return Some(Check {
                            checksum,
                            at,
                            over: Over::Cells(start..end),
                        });
                    }
                }
            }
        }
    }
    None
}

/// Whether the checksum at `at` covers these bytes, in nearly all frames of several. With `before`,
/// it covers that many bytes before the frame too.
fn holds(
    frames: &Frames,
    checksum: Checksum,
    at: usize,
    before: Option<usize>,
    covered: Range<usize>,
) -> bool {
    let step = frames.len().div_ceil(TRIED).max(1);
    let (mut tried, mut wrong) = (0, 0);
    let mut values = Vec::new();
    for index in (0..frames.len()).step_by(step) {
        let frame = frames.get(index);
        let Some(before) = frames.before(index, before.unwrap_or(0)) else {
            continue;
        };
        let bytes = [before, &frame[covered.clone()]].concat();
        let sum = checksum.of(&bytes);
        let found = &frame[at..at + checksum.bytes()];
        let is_big_endian = matches!(
            checksum,
            Checksum::Crc32Be | Checksum::Crc16ModbusBe | Checksum::Crc16CcittBe
        );
        let expected = sum.to_le_bytes();
        let mut expected = expected[..checksum.bytes()].to_vec();
        if is_big_endian {
            expected.reverse();
        }
        tried += 1;
        wrong += usize::from(expected != found);
        if 10 * wrong > TRIED.min(frames.len()) {
            return false;
        }
        values.push(sum);
    }
    values.sort_unstable();
    values.dedup();
    tried >= 8 && values.len() >= 4
}

/// The place of a plain sum of the cells in two or four bytes. Four, only if more than two change.
fn sum(frames: &Frames, columns: &Columns, overhead: usize) -> Option<Range<usize>> {
    let period = frames.period();
    let mark_at = period - overhead;
    for bytes in [4, 2] {
        for at in mark_at.saturating_sub(BEFORE_MARK)..=period - bytes {
            let own = at..at + bytes;
            let changing = own
                .clone()
                .filter(|&at| !matches!(columns.kinds[at], Kind::Constant(_)));
            if changing.count() < bytes / 2 + 1
                || (own.end..mark_at).any(|at| columns.kinds[at] == Kind::Active)
            {
                continue;
            }
            // A number between the cells and the sum does not count.
            let number =
                (at.saturating_sub(BEFORE_MARK)..at).find(|&at| columns.kinds[at] == Kind::Number);
            let ends = [Some(at), number].into_iter().flatten();
            let ranges = ends.flat_map(|end| [0..end, 1..end]);
            for cells in ranges {
                for is_big_endian in [false, true] {
                    for cell in [Cell::U8, Cell::U16le, Cell::U16be] {
                        if is_sum(frames, own.clone(), is_big_endian, cells.clone(), cell) {
                            return Some(own);
                        }
                    }
                }
            }
        }
    }
    None
}

/// Whether the number at `own` and the sum of the cells differ by the same in nearly all frames.
fn is_sum(
    frames: &Frames,
    own: Range<usize>,
    is_big_endian: bool,
    cells: Range<usize>,
    cell: Cell,
) -> bool {
    let join = |value: u32, &byte: &u8| value << 8 | u32::from(byte);
    let little = |bytes: &[u8]| bytes.iter().rev().fold(0, join);
    let big = |bytes: &[u8]| bytes.iter().fold(0, join);
    let total = |cells: &[u8]| -> u32 {
        match cell {
            Cell::U8 => cells.iter().map(|&byte| u32::from(byte)).sum(),
            Cell::U16le => cells.chunks(2).map(little).sum(),
            Cell::U16be => cells.chunks(2).map(big).sum(),
        }
    };
    let mask = u32::MAX >> (32 - 8 * own.len());
    let step = frames.len().div_ceil(TRIED).max(1);
    let mut sums = Vec::new();
    let mut rests: Vec<u32> = Vec::new();
    for frame in frames.iter().step_by(step) {
        let sum = total(&frame[cells.clone()]);
        let value = if is_big_endian {
            big(&frame[own.clone()])
        } else {
            little(&frame[own.clone()])
        };
        sums.push(sum & mask);
        rests.push(value.wrapping_sub(sum) & mask);
        // Most do not hold.
        if rests.len() == 6
            && rests.iter().filter(|rest| **rest == rests[0]).count() < 2
            && rests[1] != rests[2]
        {
            return false;
        }
    }
    rests.sort_unstable();
    sums.sort_unstable();
    sums.dedup();
    let same = rests
        .chunk_by(|a, b| a == b)
        .map(<[u32]>::len)
        .max()
        .unwrap_or(0);
    sums.len() >= 6 && 10 * same >= 9 * rests.len()
}
