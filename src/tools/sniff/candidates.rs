//! Finds layouts that bytes may have, from repetitions in the bytes.
//!
//! In: a sample of raw bytes. Out: free layouts that are worth decoding it with, with every key
//! given. Between the cells of two frames are `checksum, tail, sync, length`. All but the checksum
//! are the same in every frame. So the search finds the distances at which pairs of bytes recur,
//! the square arrays that fit such a distance, and the bytes that are constant at it. Nothing is
//! decoded here.
//!
//! The bytes cannot show the following:
//!
//! - Whether a mark comes before its cells or after them, if there is no checksum. The frames are
//!   the same.
//! - Whether a zero beside a mark belongs to the mark or is a taxel that is never pressed.
//! - An array that is smaller than 4x4.
//! - An array that is not square, except in `ascii`.

use std::collections::BTreeMap;

use hardnessd_core::frame::Array;
use hardnessd_core::wire::{Cell, Checksum, HexBytes, LengthField, Settings};

/// The smallest side of an array that is looked for. Any short repetition would fit a smaller
/// array.
const SMALLEST_SIDE: usize = 4;
/// The longest side that is looked for.
const LARGEST_SIDE: usize = 28;
/// The most bytes of a frame beside its cells: `jq-u16` has 8.
const MOST_OVERHEAD_BYTES: usize = 12;
/// The number of distances that are examined. Rows of a press recur too, so the distance of frames
/// is not always the first.
const PERIODS: usize = 8;
/// With fewer recurrences, a distance may be an accident.
const LEAST_RECURRENCES: usize = 3;
/// The least share of frames in which a constant byte has its value: some frames are damaged.
const CONSTANT_SHARE: f64 = 0.75;
/// The number of constant stretches that are examined for each array and checksum.
const BLOCKS: usize = 4;

const CHECKSUMS: [Checksum; 5] = [
    Checksum::None,
    Checksum::Sum8,
    Checksum::Xor8,
    Checksum::Crc16Modbus,
    Checksum::Crc16Ccitt,
];

/// The least information of the constant bytes in a frame of `period` bytes, in bits. It is about
/// that of one byte that occurs once a frame and hardly anywhere else, but at most that of one byte
/// of noise.
fn least_bits(period: usize) -> f64 {
    f64::min(8.0, 0.85 * (period as f64).log2())
}

/// Layouts worth trying, each with the information of its constant bytes in bits. Cells of two
/// bytes are taken as low byte first, because only the frames show the order.
pub(super) fn candidates(bytes: &[u8]) -> Vec<(Settings, u32)> {
    let rarity = rarity(bytes);
    let mut found = Vec::new();
    for (period, mark) in periods(bytes) {
        let columns = columns(bytes, period, mark);
        for (side, cell, overhead) in payloads(period) {
            for checksum in CHECKSUMS {
                let constant = overhead.saturating_sub(checksum.bytes());
                for (bits, block) in constant_blocks(&columns, constant, &rarity) {
                    // A header of zeros would be found at many places of every frame at rest.
                    let is_header = |header: &[u8]| {
                        header.is_empty() || told(header, &rarity) >= least_bits(period)
                    };
                    found.extend(
                        (0..=constant)
                            .filter(|&tail| is_header(&block[tail..]))
                            .map(|tail| {
                                let settings = free(&block, tail, side, cell, checksum);
                                (settings, bits.round() as u32)
                            }),
                    );
                }
            }
        }
    }
    found
}

/// Distances at which a pair of bytes recurs, most frequent first, each with that pair.
fn periods(bytes: &[u8]) -> Vec<(usize, u16)> {
    let longest = 2 * LARGEST_SIDE * LARGEST_SIDE + MOST_OVERHEAD_BYTES;
    let mut last = vec![None; 1 << 16];
    let mut gaps: Vec<(usize, u16)> = Vec::new();
    for (at, pair) in bytes.array_windows().enumerate() {
        let pair = u16::from_be_bytes(*pair);
        if let Some(before) = last[usize::from(pair)].replace(at)
            && (SMALLEST_SIDE * SMALLEST_SIDE..=longest).contains(&(at - before))
        {
            gaps.push((at - before, pair));
        }
    }
    gaps.sort_unstable();
    let mut periods: Vec<(usize, (usize, u16))> = gaps
        .chunk_by(|a, b| a.0 == b.0)
        .filter_map(|of_period| {
            of_period
                .chunk_by(|a, b| a == b)
                .map(|same| (same.len(), same[0]))
                .max()
        })
        .filter(|&(recurrences, (period, _))| {
            recurrences >= LEAST_RECURRENCES && !payloads(period).is_empty()
        })
        .collect();
    periods.sort_unstable_by(|a, b| b.cmp(a));
    periods.truncate(PERIODS);
    periods.into_iter().map(|(_, found)| found).collect()
}

/// Square arrays that fit a frame of `period` bytes: side, cell, bytes beside the cells.
fn payloads(period: usize) -> Vec<(usize, Cell, usize)> {
    let mut payloads = Vec::new();
    for side in (SMALLEST_SIDE..=LARGEST_SIDE).rev() {
        for (cell, cell_bytes) in [(Cell::U8, 1), (Cell::U16le, 2)] {
            let overhead = period.saturating_sub(side * side * cell_bytes);
            if (1..=MOST_OVERHEAD_BYTES).contains(&overhead) {
                payloads.push((side, cell, overhead));
            }
        }
    }
    payloads
}

/// The value of each byte of a frame, counted from `mark`, if that value is constant.
fn columns(bytes: &[u8], period: usize, mark: u16) -> Vec<Option<u8>> {
    let is_mark = |at: usize| bytes.get(at..at + 2) == Some(&mark.to_be_bytes()[..]);
    let mut counts = vec![[0_u32; 256]; period];
    let mut frames = 0;
    for at in (0..bytes.len()).filter(|&at| is_mark(at) && is_mark(at + period)) {
        frames += 1;
        for (count, &byte) in counts.iter_mut().zip(&bytes[at..at + period]) {
            count[usize::from(byte)] += 1;
        }
    }
    let least = CONSTANT_SHARE * f64::from(frames);
    counts
        .iter()
        .map(|count| (0..=u8::MAX).find(|&byte| f64::from(count[usize::from(byte)]) >= least))
        .collect()
}

/// Stretches of `length` constant bytes with their information in bits, most first. Cells are
/// constant too where nothing presses, but those are zeros, which are frequent.
fn constant_blocks(
    columns: &[Option<u8>],
    length: usize,
    rarity: &[f64; 256],
) -> Vec<(f64, Vec<u8>)> {
    if length == 0 {
        return Vec::new();
    }
    let around: Vec<Option<u8>> = columns.iter().chain(columns).copied().collect();
    let mut blocks: Vec<(f64, Vec<u8>)> = around
        .windows(length)
        .take(columns.len())
        .filter_map(|block| block.iter().copied().collect::<Option<Vec<u8>>>())
        .map(|block| (told(&block, rarity), block))
        .filter(|&(bits, _)| bits >= least_bits(columns.len()))
        .collect();
    blocks.sort_by(|a, b| b.0.total_cmp(&a.0).then_with(|| a.1.cmp(&b.1)));
    blocks.dedup();
    blocks.truncate(BLOCKS);
    blocks
}

/// The information of `block`, in bits.
fn told(block: &[u8], rarity: &[f64; 256]) -> f64 {
    block.iter().map(|&byte| rarity[usize::from(byte)]).sum()
}

/// The information of each byte value, in bits. A rare value has more. A value that makes up a
/// quarter of all bytes is a taxel at rest and counts 0. Otherwise, such bytes beside a mark would
/// improve the mark.
fn rarity(bytes: &[u8]) -> [f64; 256] {
    let mut counts = [1_u32; 256];
    for &byte in bytes {
        counts[usize::from(byte)] += 1;
    }
    let total = (bytes.len() + 256) as f64;
    counts.map(|count| match (total / f64::from(count)).log2() {
        bits if bits > 2.0 => bits,
        _ => 0.0,
    })
}

/// The layout whose constant bytes are `block`: first `tail` bytes of tail, then sync, then a
/// length if the last bytes hold the right one.
fn free(block: &[u8], tail: usize, side: usize, cell: Cell, checksum: Checksum) -> Settings {
    let (tail, header) = block.split_at(tail);
    let payload_bytes = side * side * if cell == Cell::U8 { 1 } else { 2 };
    let little = (payload_bytes as u16).to_le_bytes();
    let big = (payload_bytes as u16).to_be_bytes();
    let fields: [(LengthField, &[u8]); 3] = [
        (LengthField::U16le, &little),
        (LengthField::U16be, &big),
        (LengthField::U8, &little[..1]),
    ];
    let (length, sync) = fields
        .into_iter()
        .filter(|&(length, _)| length != LengthField::U8 || payload_bytes <= 0xFF)
        .find_map(|(length, field)| {
            let sync = header.strip_suffix(field)?;
            (!sync.is_empty()).then_some((length, sync))
        })
        .unwrap_or((LengthField::None, header));
    Settings {
        sync: Some(HexBytes(sync.to_vec())),
        tail: Some(HexBytes(tail.to_vec())),
        length: Some(length),
        cell: Some(cell),
        checksum: Some(checksum),
        rows: Some(side),
        cols: Some(side),
        ..Settings::default()
    }
}

/// The array that most blocks of lines have, if the bytes are rows of text.
pub(super) fn text_array(bytes: &[u8]) -> Option<Array> {
    let words = |line: &[u8]| {
        line.split(|byte| matches!(byte, b' ' | b'\t' | b'\r' | b','))
            .filter(|word| !word.is_empty())
            .count()
    };
    let lines: Vec<usize> = bytes.split(|&byte| byte == b'\n').map(words).collect();
    let blocks = lines.split(|&words| words == 0);
    most_frequent(blocks.filter_map(|block| Some((block.len(), *block.last()?))))
}

/// The square array whose number of cells is most frequent among the stretches between two FF.
pub(super) fn marked_array(bytes: &[u8]) -> Option<Array> {
    let stretches = bytes.split(|&byte| byte == 0xFF);
    most_frequent(stretches.filter_map(|stretch| square(stretch.len())))
}

/// The square array that most stretches between two FF unpack to. Only stretches with zeros count,
/// because those without also fit `ff-tail`.
pub(super) fn packed_array(bytes: &[u8]) -> Option<Array> {
    let cells = |packed: &[u8]| {
        let mut bytes = packed.iter();
        let mut cells = 0;
        while let Some(&byte) = bytes.next() {
            cells += if byte == 0 {
                usize::from(*bytes.next()?)
            } else {
                1
            };
        }
        Some(cells)
    };
    let stretches = bytes.split(|&byte| byte == 0xFF);
    let packed = stretches.filter(|stretch| stretch.contains(&0));
    most_frequent(packed.filter_map(cells).filter_map(square))
}

/// Rows and columns of the square array with this number of cells, if there is one.
fn square(cells: usize) -> Option<(usize, usize)> {
    let side = cells.isqrt();
    (side * side == cells).then_some((side, side))
}

/// The most frequent array. Of several, the largest. Arrays that are too small or too large do not
/// count.
fn most_frequent(arrays: impl Iterator<Item = (usize, usize)>) -> Option<Array> {
    let mut counts: BTreeMap<(usize, usize), usize> = BTreeMap::new();
    for (rows, cols) in arrays {
        if (SMALLEST_SIDE..=LARGEST_SIDE).contains(&rows)
            && (SMALLEST_SIDE..=LARGEST_SIDE).contains(&cols)
        {
            *counts.entry((rows, cols)).or_default() += 1;
        }
    }
    let ((rows, cols), _) = counts
        .into_iter()
        .max_by_key(|&(array, count)| (count, array))?;
    Some(Array { rows, cols })
}
