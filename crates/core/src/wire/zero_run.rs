//! Frames with packed zeros: 1..254 is a value, `00 n` is a run of n = 1..254 zeros, and `FF` ends
//! the frame.

use super::cells::Cells;
use super::scan::{Context, Scan};
use crate::frame::RawFrame;

const END: u8 = 0xFF;

/// The number of zeros in the longest run.
const MAX_RUN: u8 = 254;

/// The number of bytes of the longest frame: single zeros, two bytes each, and the end.
pub(super) fn max_frame_bytes(cells: usize) -> usize {
    2 * cells + 1
}

/// The number of bytes of the shortest frame: the longest possible runs of zeros, and the end. The
/// rest may be one value.
pub(super) fn min_frame_bytes(cells: usize) -> usize {
    let full_runs = cells / usize::from(MAX_RUN);
    let rest = (cells % usize::from(MAX_RUN)).min(2);
    2 * full_runs + rest + 1
}

pub(super) fn encode(cells: impl Iterator<Item = u16>, out: &mut Vec<u8>) {
    let mut zeros = 0_u8;
    for cell in cells {
        if cell == 0 && zeros < MAX_RUN {
            zeros += 1;
            continue;
        }
        if zeros > 0 {
            out.extend_from_slice(&[0, zeros]);
            zeros = 0;
        }
        if cell == 0 {
            zeros = 1;
        } else {
            out.push(cell as u8);
        }
    }
    if zeros > 0 {
        out.extend_from_slice(&[0, zeros]);
    }
    out.push(END);
}

pub(super) fn scan(cells: &Cells, bytes: &[u8], context: Context) -> Scan {
    let longest = max_frame_bytes(cells.count());
    let Some(end) = bytes.iter().position(|&byte| byte == END) else {
        return match bytes.len().checked_sub(longest) {
            Some(excess) if excess > 0 => Scan::Excess(excess),
            _ => Scan::Wait,
        };
    };
    // Noise may be right before a whole frame. The frame is the longest run of bytes before the end
    // that unpacks to exactly its cells.
    let first = (end + 1).saturating_sub(longest);
    for start in first..end {
        if let Some(frame) = unpack(cells, &bytes[start..end]) {
            return if start == 0 {
                Scan::Frame(end + 1, frame)
            } else {
                Scan::Skip(start)
            };
        }
    }
    if context.locked && end > 0 {
        Scan::Damaged(end + 1)
    } else {
        Scan::Skip(end + 1)
    }
}

fn unpack(cells: &Cells, packed: &[u8]) -> Option<RawFrame> {
    let count = cells.count();
    let mut unpacked = Vec::with_capacity(count);
    let mut bytes = packed.iter();
    while let Some(&byte) = bytes.next() {
        let run = if byte == 0 {
            usize::from(*bytes.next()?)
        } else {
            1
        };
        if run == 0 || unpacked.len() + run > count {
            return None;
        }
        unpacked.resize(unpacked.len() + run, u16::from(byte));
    }
    (unpacked.len() == count).then(|| cells.frame([unpacked]))
}
