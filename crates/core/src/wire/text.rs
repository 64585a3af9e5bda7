//! Frames as text: a row on each line, with decimals separated by spaces, tabs or commas, and LF or
//! CRLF. A blank line ends the frame.

use super::cells::Cells;
use super::scan::{Context, Scan};
use crate::frame::{Array, RawFrame};

/// The number of bytes of the longest frame that is found: every value at its widest with two
/// separators, CRLF after each row, and the blank line.
pub(super) fn max_frame_bytes(cells: &Cells) -> usize {
    let array = cells.array;
    let digits = cells.mask.to_string().len();
    array.rows * (array.cols * (digits + 2) + 2) + 2
}

/// The number of bytes of the shortest frame: one digit for each value, one separator or LF after
/// each, and the blank line.
pub(super) fn min_frame_bytes(array: Array) -> usize {
    array.rows * array.cols * 2 + 1
}

pub(super) fn encode(cells: impl Iterator<Item = u16>, cols: usize, out: &mut Vec<u8>) {
    for (index, cell) in cells.enumerate() {
        out.extend_from_slice(cell.to_string().as_bytes());
        out.push(if (index + 1).is_multiple_of(cols) {
            b'\n'
        } else {
            b' '
        });
    }
    out.push(b'\n');
}

pub(super) fn scan(cells: &Cells, bytes: &[u8], context: Context) -> Scan {
    let Array { rows, cols } = cells.array;
    let mut lines = Lines { bytes, at: 0 };
    // The places where the last `rows` lines began.
    let mut starts = [0; crate::frame::MOST_SIDE];
    let mut count = 0;
    loop {
        let start = lines.at;
        let Some(line) = lines.next() else { break };
        if !line.iter().all(|byte| matches!(byte, b' ' | b'\t' | b'\r')) {
            starts[count % rows] = start;
            count += 1;
            continue;
        }
        // Bytes that arrive one at a time are cut to this length before their end arrives. Cut
        // bytes that arrive at once in the same way.
        if let Some(excess @ 1..) = lines.at.checked_sub(max_frame_bytes(cells) + 1) {
            return Scan::Excess(excess);
        }
        if count == 0 {
            // This may be the rest of a line whose beginning was too long to keep. No frame ends
            // here.
            return Scan::Excess(lines.at);
        }
        let row = if count >= rows {
            starts[count % rows]
        } else {
            0
        };
        let first = row + row_start(&bytes[row..start], cols);
        // Refuse a longer frame: whether it is found would depend on how many bytes arrive at once.
        let is_short = lines.at - first <= max_frame_bytes(cells);
        let frame = parse(cells, &bytes[first..start], rows, cols);
        return match frame.filter(|_| is_short) {
            Some(_) if first > 0 => Scan::Skip(first),
            Some(frame) => Scan::Frame(lines.at, frame),
            None if context.locked => Scan::Damaged(lines.at),
            None => Scan::Skip(lines.at),
        };
    }
    match bytes.len().checked_sub(max_frame_bytes(cells)) {
        Some(excess) if excess > 0 => Scan::Excess(excess),
        _ => Scan::Wait,
    }
}

fn is_separator(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t' | b',' | b'\r')
}

/// The place where the row begins that ends the first line of `text`. Noise, or the rest of a
/// damaged frame, may be right before the row.
///
/// A cell has only digits. So the row begins after the last other byte of its first token, and the
/// bytes before that are noise. They might also be damage: `5x12` may be noise `5x` before a cell
/// of 12, or a cell of 5012 with a wrong byte. The bytes hold a whole frame either way, and a frame
/// that is whole in the bytes is never lost.
fn row_start(text: &[u8], cols: usize) -> usize {
    let end = text.iter().position(|&byte| byte == b'\n');
    let line = &text[..end.unwrap_or(text.len())];
    let mut start = line.len();
    for _ in 0..cols {
        let Some(last) = line[..start].iter().rposition(|&byte| !is_separator(byte)) else {
            return 0;
        };
        let before = line[..last].iter().rposition(|&byte| is_separator(byte));
        start = before.map_or(0, |before| before + 1);
    }
    let token = line[start..].iter().position(|&byte| is_separator(byte));
    let token = &line[start..token.map_or(line.len(), |length| start + length)];
    match token.iter().rposition(|byte| !byte.is_ascii_digit()) {
        Some(strange) => start + strange + 1,
        // Separators before the first cell belong to the frame.
        None if line[..start].iter().all(|&byte| is_separator(byte)) => 0,
        None => start,
    }
}

fn parse(cells: &Cells, text: &[u8], rows: usize, cols: usize) -> Option<RawFrame> {
    let mut frame = RawFrame::zero(cells.array);
    let mut index = 0;
    for line in (Lines { bytes: text, at: 0 }) {
        let row_end = index + cols;
        for token in line.split(|&byte| is_separator(byte)) {
            if token.is_empty() {
                continue;
            }
            if index == row_end || index == rows * cols {
                return None;
            }
            cells.place(&mut frame, index, decimal(token)?);
            index += 1;
        }
        if index != row_end {
            return None;
        }
    }
    (index == rows * cols).then_some(frame)
}

fn decimal(token: &[u8]) -> Option<u16> {
    token.iter().try_fold(0_u16, |value, digit| {
        let digit = digit.is_ascii_digit().then(|| digit - b'0')?;
        value.checked_mul(10)?.checked_add(u16::from(digit))
    })
}

/// Complete lines, without their LF.
struct Lines<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Iterator for Lines<'a> {
    type Item = &'a [u8];

    fn next(&mut self) -> Option<&'a [u8]> {
        let rest = &self.bytes[self.at..];
        let end = rest.iter().position(|&byte| byte == b'\n')?;
        self.at += end + 1;
        Some(&rest[..end])
    }
}
