//! Frames as text: numbers, with a sign, a point or an exponent or without them, between spaces, tabs,
//! commas, semicolons or brackets. Lines end with LF or CRLF.
//!
//! A frame is one line with all its cells, or a line for each row and then a line without a number,
//! such as a blank one. With a `heading`, it is the cells that follow this text, on as many lines as it
//! takes. Other words may be before, between and after the rows, such as `R3`, `"row3":`, `3:`, `|` or a
//! unit. What comes before the first cell of a line is skipped, and so are lines between frames.
//!
//! A line is read when its end has come. [`Lines`] holds what was found in those before it, so that
//! long runs of lines take a time in proportion to their bytes.

use std::collections::VecDeque;
use std::ops::Range;

use super::cells::Cells;
use super::scan::{Context, Scan};
use crate::frame::{Array, RawFrame};
use crate::wording::escaped;

/// The most bytes before the first cell of a line that still belong to the frame of that line: room
/// for a date, a time and a few words.
const LEADING_BYTES: usize = 64;
/// The most bytes of a number with all that is between it and the next one.
const CELL_BYTES: usize = 24;
/// The most bytes of a number.
const NUMBER_BYTES: usize = 32;
/// The most bytes of a word that a message shows.
const SHOWN_BYTES: usize = 20;

/// The lines of which a frame may be made, and how far the pending bytes were read.
#[derive(Debug, Clone, Default)]
pub(super) struct Lines {
    /// Lines with numbers, which end where the line that has not ended yet begins.
    held: VecDeque<Line>,
    begin: usize,
    /// How many of the pending bytes were searched for the end of that line.
    read: usize,
    /// What is wrong with the first line that is none, since the last frame.
    pub(super) refused: Option<Refused>,
}

#[derive(Debug, Clone, Copy)]
struct Line {
    start: usize,
    end: usize,
    numbers: usize,
}

/// Why lines are no frame, in words.
type Refused = String;

/// There are too few or too many numbers.
fn wrong_numbers(found: usize, cells: &Cells) -> Refused {
    let (cols, count) = (cells.array.cols, cells.count());
    format!("a line has {found} numbers, expected {cols} for a row or {count} for a frame")
}

/// There is something where a number should be.
fn wrong_word(word: &[u8]) -> Refused {
    let shown = String::from_utf8_lossy(&word[..word.len().min(SHOWN_BYTES)]);
    format!("a line has {:?} among its numbers", escaped(&shown))
}

/// There are too few or too many lines.
fn wrong_rows(found: usize, cells: &Cells) -> Refused {
    let rows = cells.array.rows;
    format!("{found} lines with numbers come before one without, expected {rows}")
}

impl Lines {
    /// The first `bytes` pending bytes are gone.
    pub(super) fn pass(&mut self, bytes: usize) {
        self.begin = self.begin.saturating_sub(bytes);
        self.read = self.read.saturating_sub(bytes);
        self.held.retain(|line| line.end > bytes);
        for line in &mut self.held {
            line.start = line.start.saturating_sub(bytes);
            line.end -= bytes;
        }
    }

    /// The number of bytes that are too far before `end` to be of the same frame. Lines are cut as a
    /// whole, but for the last one. The first line of several must stay if it is the one with a heading.
    fn cut(&self, end: usize, most_kept: usize, may_begin_later: bool) -> usize {
        let is_near = |line: &&Line| end - line.start <= most_kept;
        let near = match may_begin_later {
            true => self.held.iter().find(is_near),
            false => self.held.front().filter(is_near),
        };
        let cut = (end - self.begin).saturating_sub(most_kept);
        near.map_or(self.begin + cut, |line| line.start)
    }
}

/// The number of bytes of the longest frame that is found.
pub(super) fn most_bytes(cells: &Cells) -> usize {
    let Array { rows, cols } = cells.array;
    LEADING_BYTES + rows * (cols * CELL_BYTES + LEADING_BYTES)
}

/// The number of bytes of the shortest frame: one digit for each value, and one separator or LF after
/// each. And of the longest one of whole numbers up to the mask or 65535: the leading words, every value
/// at its widest with two separators, CRLF after each row, and a blank line.
pub(super) fn usual_bytes(cells: &Cells) -> (usize, usize) {
    let Array { rows, cols } = cells.array;
    let widest = cells.mask.unwrap_or(u16::MAX.into());
    let cell = widest.to_string().len() + 2;
    let most = LEADING_BYTES + rows * (cols * cell + 2) + 2;
    (cells.count() * 2, most)
}

/// Writes a frame on one line.
pub(super) fn encode(heading: &[u8], cells: impl Iterator<Item = f32>, out: &mut Vec<u8>) {
    out.extend(heading);
    if !heading.is_empty() {
        out.push(b' ');
    }
    for cell in cells {
        out.extend_from_slice(cell.to_string().as_bytes());
        out.push(b',');
    }
    if let Some(last) = out.last_mut() {
        *last = b'\n';
    }
}

/// Looks for a frame that comes after `heading`, which is empty if nothing is before a frame.
pub(super) fn scan(
    heading: &[u8],
    cells: &Cells,
    bytes: &[u8],
    context: Context,
    lines: &mut Lines,
) -> Scan {
    // Whether the first `end` bytes are most of a frame that was damaged.
    let damage = |end: usize| {
        let is_of_frame = context.in_sync && bytes.starts_with(heading);
        u64::from(is_of_frame && 2 * numbers_in(&bytes[..end]) > cells.count())
    };
    // One byte more than the longest frame is kept. It shows whether the first number of a frame is
    // the rest of a number that was cut.
    let most_kept = most_bytes(cells) + 1;
    while let Some(length) = bytes[lines.read..].iter().position(|&byte| byte == b'\n') {
        let (start, end) = (lines.begin, lines.read + length + 1);
        // Bytes that arrive one at a time are cut before the end of the line arrives. Bytes that arrive
        // at once are cut in the same way.
        let cut = lines.cut(end, most_kept, heading.is_empty());
        if cut > 0 {
            return Scan::past(cut, 0);
        }
        let found = match heading.is_empty() {
            true => on_line(cells, bytes, start..end, lines, most_kept),
            false => after_heading(heading, cells, bytes, start..end, lines),
        };
        let found = found.unwrap_or_else(|refused| {
            lines.refused.get_or_insert(refused);
            Found::Nothing(end)
        });
        match found {
            Found::Held(numbers) => {
                lines.held.push_back(Line {
                    start,
                    end,
                    numbers,
                });
                (lines.begin, lines.read) = (end, end);
            }
            Found::Frame { start: 0, frame } => {
                lines.refused = None;
                return Scan::found(end, frame);
            }
            // The line is read again when the bytes before the frame are gone.
            Found::Frame { start: bytes, .. } | Found::Nothing(bytes) => {
                return Scan::past(bytes, damage(bytes));
            }
        }
    }
    lines.read = bytes.len();
    Scan::past(lines.cut(bytes.len(), most_kept, heading.is_empty()), 0)
}

/// What a line is.
enum Found {
    /// It may be one of several of a frame, and has so many numbers.
    Held(usize),
    /// It ends a frame that begins at `start`.
    Frame { start: usize, frame: RawFrame },
    /// So many bytes are no frame.
    Nothing(usize),
}

/// What a line is where frames have no heading.
fn on_line(
    cells: &Cells,
    bytes: &[u8],
    line: Range<usize>,
    lines: &mut Lines,
    most_kept: usize,
) -> Result<Found, Refused> {
    let Array { rows, cols } = cells.array;
    let Range { start, end } = line;
    let line = &bytes[line];
    let numbers = numbers_in(line);
    // A word may end with the first cell.
    if numbers + 1 >= cells.count() {
        match cells_at_end(line, cells, cells.count()) {
            // Whether a longer frame is found would depend on how many bytes arrive at once.
            Ok((first, values)) if line.len() - first < most_kept => {
                // Most of a frame before this one is a frame that lost its LF.
                let before = numbers_in(&line[..first]);
                let is_alone = 2 * before <= cells.count() && line.len() < most_kept;
                let start = if is_alone { start } else { start + first };
                let frame = of_values(cells, values)?;
                return Ok(Found::Frame { start, frame });
            }
            Err(refused) if 2 * numbers > cells.count() => return Err(refused),
            _ => {}
        }
    }
    if 2 * numbers > cells.count() {
        return Err(wrong_numbers(numbers, cells));
    }
    let held = lines.held.len();
    let damaged = damaged_word(line);
    if numbers > 0 || damaged.is_some() {
        if let Some(word) = damaged.filter(|_| numbers == 0) {
            lines.refused.get_or_insert_with(|| wrong_word(word));
        }
        // Of more lines than a frame has, the first ones are in none.
        if held >= 2 * rows {
            lines.refused.get_or_insert(wrong_rows(held, cells));
            return Ok(Found::Nothing(lines.held[rows].start));
        }
        return Ok(Found::Held(numbers));
    }
    // The rows end here, if there are enough of them.
    let Some(first) = held.checked_sub(rows) else {
        let most = lines.held.iter().map(|line| line.numbers).max();
        return match most {
            None => Ok(Found::Nothing(end)),
            Some(found) if found != cols => Err(wrong_numbers(found, cells)),
            Some(_) => Err(wrong_rows(held, cells)),
        };
    };
    let of_rows = lines.held.range(first..);
    let of_rows = of_rows.map(|row| &bytes[row.start..row.end]);
    let (noise, values) = in_rows(of_rows, cells)?;
    Ok(Found::Frame {
        start: lines.held[first].start + noise,
        frame: of_values(cells, values)?,
    })
}

fn of_values(cells: &Cells, values: Vec<f32>) -> Result<RawFrame, Refused> {
    let refused = || "a number is not a whole one for the mask, or too large".to_owned();
    cells.frame(values).ok_or_else(refused)
}

/// What a line is where a heading comes before each frame.
fn after_heading(
    heading: &[u8],
    cells: &Cells,
    bytes: &[u8],
    line: Range<usize>,
    lines: &Lines,
) -> Result<Found, Refused> {
    let Range { start, end } = line;
    let line = &bytes[line];
    let mut windows = line.windows(heading.len()).enumerate();
    // "Sensor 1" is no heading of a line with "Sensor 11".
    let goes_on = |at: usize| {
        let next = line
            .get(at + heading.len())
            .filter(|next| next.is_ascii_digit());
        next.and(heading.last()).is_some_and(u8::is_ascii_digit)
    };
    let found = windows.rfind(|(at, window)| *window == heading && !goes_on(*at));
    let skipped = match found.map(|(at, _)| at) {
        Some(at) if start + at > 0 => return Ok(Found::Nothing(start + at)),
        Some(_) => heading.len(),
        None if !lines.held.is_empty() => 0,
        None if numbers_in(&bytes[start..end]) == 0 => return Ok(Found::Nothing(end)),
        None => {
            let heading = String::from_utf8_lossy(heading);
            return Err(format!("no line has the heading {heading:?}"));
        }
    };
    let numbers = numbers_in(&bytes[start + skipped..end]);
    let all = numbers + lines.held.iter().map(|line| line.numbers).sum::<usize>();
    if all < cells.count() {
        return Ok(Found::Held(numbers));
    }
    // The first held line begins with the heading. It may have a number of its own, as in "Frame 17".
    let in_title = lines.held.front().map_or(0, |line| line.numbers);
    let is_numbered = in_title < cells.array.cols && all == cells.count() + in_title;
    if all > cells.count() && !is_numbered {
        return Err(wrong_numbers(all, cells));
    }
    let (_, values) = cells_at_end(&bytes[heading.len()..end], cells, cells.count())?;
    let frame = of_values(cells, values)?;
    Ok(Found::Frame { start: 0, frame })
}

/// The cells in these lines, one line for each row, and the number of bytes before the first cell that
/// belong to no frame. Noise, or the rest of a damaged frame, may be right before the first row.
/// Separators before the first cell belong to it.
fn in_rows<'a>(
    rows: impl Iterator<Item = &'a [u8]>,
    cells: &Cells,
) -> Result<(usize, Vec<f32>), Refused> {
    let (mut noise, mut all) = (0, Vec::new());
    for (index, row) in rows.enumerate() {
        let (first, values) = cells_at_end(row, cells, cells.array.cols)?;
        let mut before = tokens(&row[..first]);
        match before.next_back().filter(|word| !is_word(word)) {
            None => {}
            Some(_) if index == 0 => noise = first,
            Some(word) if number(word).is_none() => return Err(wrong_word(word)),
            Some(_) => return Err(wrong_numbers(numbers_in(row), cells)),
        }
        all.extend(values);
    }
    Ok((noise, all))
}

/// The last `count` numbers of `text`, and the place of the first of them. Words may be after them, and
/// between rows.
///
/// The first number may follow other bytes of its word, which are noise. They might also be damage:
/// `5x12` may be noise `5x` before a cell of 12, or a cell of 5012 with a wrong byte. The bytes hold a
/// whole frame either way, and a frame that is whole in the bytes is never lost.
fn cells_at_end(text: &[u8], cells: &Cells, count: usize) -> Result<(usize, Vec<f32>), Refused> {
    let mut values = Vec::with_capacity(count);
    for word in tokens(text).rev() {
        let is_first = values.len() + 1 == count;
        let found = match number(word) {
            Some(value) => Some((word.len(), value)),
            None if is_first && (!is_word(word) || ends_with_number(word)) => number_at_end(word),
            None if word == b"|" => continue,
            None if values.len().is_multiple_of(cells.array.cols) && is_word(word) => continue,
            None => None,
        };
        let (length, value) = found.ok_or_else(|| wrong_word(word))?;
        values.push(value);
        if is_first {
            let end = word.as_ptr_range().end as usize - text.as_ptr() as usize;
            values.reverse();
            return Ok((end - length, values));
        }
    }
    Err(wrong_numbers(values.len(), cells))
}

fn numbers_in(text: &[u8]) -> usize {
    tokens(text).filter(|word| number(word).is_some()).count()
}

/// The first part of a line that is neither a number nor a word.
fn damaged_word(line: &[u8]) -> Option<&[u8]> {
    tokens(line).find(|word| number(word).is_none() && !is_word(word))
}

/// Whether a byte separates the cells of a text.
pub fn is_separator(byte: u8) -> bool {
    matches!(
        byte,
        b' ' | b'\t' | b',' | b';' | b'\r' | b'\n' | b'[' | b']' | b'(' | b')' | b'{' | b'}'
    )
}

fn tokens(text: &[u8]) -> impl DoubleEndedIterator<Item = &[u8]> {
    text.split(|&byte| is_separator(byte))
        .filter(|token| !token.is_empty())
}

/// Whether something that is no number may stand beside rows: it has no digit, it begins with none, or
/// it is a number with a colon.
fn is_word(token: &[u8]) -> bool {
    let is_digit = u8::is_ascii_digit;
    let begins_as_number = token
        .first()
        .is_some_and(|byte| is_digit(byte) || is_mark(*byte));
    !token.iter().any(is_digit)
        || !begins_as_number
        || token
            .strip_suffix(b":")
            .is_some_and(|row| row.iter().all(is_digit))
}

fn is_mark(byte: u8) -> bool {
    matches!(byte, b'+' | b'-' | b'.')
}

fn ends_with_number(token: &[u8]) -> bool {
    token.last().is_some_and(u8::is_ascii_digit)
}

/// The number that a word is.
fn number(token: &[u8]) -> Option<f32> {
    let is_of_number = |&byte: &u8| byte.is_ascii_digit() || is_mark(byte) || byte | 32 == b'e';
    if token.len() > NUMBER_BYTES
        || !token.iter().all(is_of_number)
        || !token.iter().any(u8::is_ascii_digit)
    {
        return None;
    }
    let text = std::str::from_utf8(token).ok()?;
    let number: f32 = text.parse().ok()?;
    number.is_finite().then_some(number)
}

/// The longest number at the end of a word, and its length.
fn number_at_end(token: &[u8]) -> Option<(usize, f32)> {
    let most = token.len().min(NUMBER_BYTES);
    let lengths = (1..=most).rev();
    lengths
        .into_iter()
        .find_map(|length| Some((length, number(&token[token.len() - length..])?)))
}
