//! Frames as text: decimals, separated by spaces, tabs, commas, semicolons or brackets. Lines end with
//! LF or CRLF.
//!
//! In `ascii` each line is a row, and a line without a digit ends the frame: a blank one, or words
//! between the frames. In `csv` each line is a frame.
//! Words before the first cell of a line of `csv` are skipped, and so are lines without a frame.

use super::cells::Cells;
use super::scan::{Context, Scan};
use crate::frame::{Array, RawFrame};

/// What ends a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum FrameEnd {
    /// A line without a digit, such as a blank one, after a line for each row.
    LineWithoutDigit,
    /// The end of the line.
    Line,
}

/// The most bytes before the first cell of a line that still belong to the frame of that line: room
/// for a date, a time and a few words.
const LEADING_BYTES: usize = 64;

impl FrameEnd {
    /// The number of bytes of the longest frame that is found: every value at its widest with two
    /// separators, CRLF after each line, and the blank line or the leading words.
    pub(super) fn max_frame_bytes(self, cells: &Cells) -> usize {
        let Array { rows, cols } = cells.array;
        let cell = cells.mask.to_string().len() + 2;
        match self {
            FrameEnd::LineWithoutDigit => rows * (cols * cell + 2) + 2,
            FrameEnd::Line => LEADING_BYTES + rows * cols * cell + 2,
        }
    }

    /// The number of bytes of the shortest frame: one digit for each value, one separator or LF
    /// after each, and the blank line.
    pub(super) fn min_frame_bytes(self, cells: &Cells) -> usize {
        let blank_line = match self {
            FrameEnd::LineWithoutDigit => 1,
            FrameEnd::Line => 0,
        };
        cells.count() * 2 + blank_line
    }

    pub(super) fn encode(self, cells: impl Iterator<Item = u16>, array: Array, out: &mut Vec<u8>) {
        let (on_line, separator) = match self {
            FrameEnd::LineWithoutDigit => (array.cols, b' '),
            FrameEnd::Line => (array.rows * array.cols, b','),
        };
        for (index, cell) in cells.enumerate() {
            out.extend_from_slice(cell.to_string().as_bytes());
            let ends_line = (index + 1).is_multiple_of(on_line);
            out.push(if ends_line { b'\n' } else { separator });
        }
        if self == FrameEnd::LineWithoutDigit {
            out.push(b'\n');
        }
    }

    pub(super) fn scan(self, cells: &Cells, bytes: &[u8], context: Context) -> Scan {
        match self {
            FrameEnd::LineWithoutDigit => scan_rows(cells, bytes, context),
            FrameEnd::Line => scan_line(cells, bytes, context),
        }
    }
}

fn scan_rows(cells: &Cells, bytes: &[u8], context: Context) -> Scan {
    let Array { rows, cols } = cells.array;
    let most = FrameEnd::LineWithoutDigit.max_frame_bytes(cells);
    let mut lines = Lines { bytes, at: 0 };
    // The places where the last `rows` lines began.
    let mut starts = vec![0; rows];
    let mut count = 0;
    loop {
        let start = lines.at;
        let Some(line) = lines.next() else { break };
        if line.iter().any(u8::is_ascii_digit) {
            starts[count % rows] = start;
            count += 1;
            continue;
        }
        // Bytes that arrive one at a time are cut to this length before their end arrives. Cut
        // bytes that arrive at once in the same way.
        if let Some(excess @ 1..) = lines.at.checked_sub(most + 1) {
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
        let is_short = lines.at - first <= most;
        let frame = parse(cells, &bytes[first..start], rows, cols);
        return match frame.filter(|_| is_short) {
            Some(_) if first > 0 => Scan::Skip(first),
            Some(frame) => Scan::Frame(lines.at, frame),
            None if context.locked => Scan::Damaged(lines.at),
            None => Scan::Skip(lines.at),
        };
    }
    match bytes.len().checked_sub(most) {
        Some(excess) if excess > 0 => Scan::Excess(excess),
        _ => Scan::Wait,
    }
}

/// Looks for a frame on the first line of `bytes`.
fn scan_line(cells: &Cells, bytes: &[u8], context: Context) -> Scan {
    let count = cells.count();
    let most = FrameEnd::Line.max_frame_bytes(cells);
    let end = bytes.iter().position(|&byte| byte == b'\n');
    let length = end.map_or(bytes.len(), |end| end + 1);
    // One byte more than the longest frame is kept. It shows whether the first number of a frame is
    // the rest of a number that was cut.
    if let Some(excess @ 1..) = length.checked_sub(most + 1) {
        return Scan::Excess(excess);
    }
    let Some(end) = end else { return Scan::Wait };
    let line = &bytes[..end];
    let Some(first) = first_cell(line, count) else {
        return not_a_frame(line, length, count, context);
    };
    let frame = parse(cells, &bytes[first..length], 1, count);
    let Some(frame) = frame.filter(|_| length - first <= most) else {
        return not_a_frame(line, length, count, context);
    };
    // Most of a frame before this one is a frame that lost its LF.
    if length > most || has_most_of_a_frame(&line[..first], count) {
        return not_a_frame(&line[..first], first, count, context);
    }
    Scan::Frame(length, frame)
}

/// The answer for the first `skip` bytes, which are `text` and hold no whole frame. With most of the
/// numbers of a frame they are a damaged one. Other lines are words between the frames.
fn not_a_frame(text: &[u8], skip: usize, cells: usize, context: Context) -> Scan {
    if context.locked && has_most_of_a_frame(text, cells) {
        Scan::Damaged(skip)
    } else {
        Scan::Skip(skip)
    }
}

fn has_most_of_a_frame(text: &[u8], cells: usize) -> bool {
    let numbers = text
        .split(|&byte| is_separator(byte))
        .filter(|token| !token.is_empty() && decimal(token).is_some());
    2 * numbers.count() > cells
}

/// Whether a byte separates the cells of a text.
pub fn is_separator(byte: u8) -> bool {
    matches!(
        byte,
        b' ' | b'\t' | b',' | b';' | b'\r' | b'[' | b']' | b'(' | b')' | b'{' | b'}'
    )
}

/// The place where the row begins that ends the first line of `text`. Noise, or the rest of a
/// damaged frame, may be right before the row. Separators before the first cell belong to the row.
fn row_start(text: &[u8], cols: usize) -> usize {
    let end = text.iter().position(|&byte| byte == b'\n');
    let line = &text[..end.unwrap_or(text.len())];
    match first_cell(line, cols) {
        Some(first) if !line[..first].iter().all(|&byte| is_separator(byte)) => first,
        _ => 0,
    }
}

/// The place of the first of the `cells` that end `line`, if it has as many tokens.
///
/// A cell has only digits. So the first cell begins after the last other byte of its token, and the
/// bytes before that are noise. They might also be damage: `5x12` may be noise `5x` before a cell
/// of 12, or a cell of 5012 with a wrong byte. The bytes hold a whole frame either way, and a frame
/// that is whole in the bytes is never lost.
fn first_cell(line: &[u8], cells: usize) -> Option<usize> {
    let mut start = line.len();
    for _ in 0..cells {
        let last = line[..start]
            .iter()
            .rposition(|&byte| !is_separator(byte))?;
        let before = line[..last].iter().rposition(|&byte| is_separator(byte));
        start = before.map_or(0, |before| before + 1);
    }
    let token = line[start..].iter().position(|&byte| is_separator(byte));
    let token = &line[start..token.map_or(line.len(), |length| start + length)];
    let strange = token.iter().rposition(|byte| !byte.is_ascii_digit());
    Some(strange.map_or(start, |strange| start + strange + 1))
}

/// The frame that `text` holds in `rows` lines of `cols` cells each.
fn parse(cells: &Cells, text: &[u8], rows: usize, cols: usize) -> Option<RawFrame> {
    let mut numbers = Vec::with_capacity(rows * cols);
    for line in (Lines { bytes: text, at: 0 }) {
        let row_end = numbers.len() + cols;
        for token in line.split(|&byte| is_separator(byte)) {
            if token.is_empty() {
                continue;
            }
            if numbers.len() == row_end || numbers.len() == rows * cols {
                return None;
            }
            numbers.push(decimal(token)?);
        }
        if numbers.len() != row_end {
            return None;
        }
    }
    (numbers.len() == rows * cols).then(|| cells.frame([numbers]))
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
