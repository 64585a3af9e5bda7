//! The arrays that frames may hold, the likeliest first.
//!
//! In: frames of one length, and what their bytes are. Out: [`Hypothesis`]es with a score. All bytes
//! but the mark, numbers and sums are cells, as far as some array has as many. What is left is
//! skipped.

use hardnessd_core::frame::{Array, MOST_SIDE};
use hardnessd_core::wire::Cell;

use super::checks::{Check, Holds, Over};
use super::columns::{Columns, Kind};
use super::period::Frames;
use super::picture::{Pictures, Score};

/// Frames that begin with the cells and end with the stretch that holds the mark, and what is known
/// of their bytes.
#[derive(Debug, Clone)]
pub(super) struct Framed<'a> {
    pub(super) frames: Frames<'a>,
    pub(super) columns: Columns,
    /// The number of bytes at the end that are no cells.
    pub(super) overhead: usize,
    pub(super) holds: Option<Holds>,
    /// The most bytes beside the mark that change in an unknown way and still are no cells.
    pub(super) most_unknown: usize,
}

/// An array, and where its cells are.
#[derive(Debug, Clone)]
pub(super) struct Hypothesis {
    pub(super) array: Array,
    pub(super) cell: Cell,
    /// The bytes that are skipped before the first cell and after the last, beside the mark.
    pub(super) skipped: (usize, usize),
    pub(super) score: Score,
    /// The strongest press.
    pub(super) picture: Vec<f32>,
}

/// What the user knows of the array.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Known {
    pub(super) rows: Option<usize>,
    pub(super) cols: Option<usize>,
    pub(super) cell: Option<Cell>,
}

/// The share of the strongest press at which a frame makes a picture.
const STRONG: f64 = 0.3;
/// The most presses, the most frames of a press that make pictures, and the most that make the rest.
const PRESSES: usize = 16;
const PICTURES: usize = 4;
const RESTS: usize = 15;
/// The longest side that is tried, so that an array that is too large is found.
const LONGEST_SIDE: usize = 128;
/// The most bytes beside the mark that are constant and still no cells.
const MOST_SKIPPED: usize = 8;
/// What skipped bytes cost, as a score. They are less likely if nothing explains them.
const SKIPPED: f64 = 0.3;
const UNEXPLAINED: f64 = 1.5;
const UNKNOWN: f64 = 0.3;
const LENGTH_FIELD: f64 = 2.0;
/// A field with the length of the cells is at most this far before them.
const WITHIN_HEADER: usize = 12;
/// What it costs that an array is e times as long as it is wide, or as wide as it is long.
pub(super) const ELONGATED: f64 = 0.3;
/// The logarithm of how much more the low byte of a cell changes from cell to cell than the high one.
const UNLIKE: f64 = 1.4;

impl Known {
    pub(super) fn is_complete(&self) -> bool {
        self.rows.is_some() && self.cols.is_some() && self.cell.is_some()
    }

    pub(super) fn allows(&self, array: Array, cell: Option<Cell>) -> bool {
        self.rows.is_none_or(|rows| rows == array.rows)
            && self.cols.is_none_or(|cols| cols == array.cols)
            && (self.cell.is_none() || cell.is_none() || self.cell == cell)
    }
}

pub(super) fn cell_bytes(cell: Cell) -> usize {
    if cell == Cell::U8 { 1 } else { 2 }
}

/// The numbers of the frames in which something presses, by press, and of those in which nothing
/// does. `None` if nothing presses in any.
pub(super) fn pressed(activity: &[u32]) -> Option<(Vec<Vec<usize>>, Vec<usize>)> {
    let mut sorted = activity.to_vec();
    sorted.sort_unstable();
    let at = |share: usize| f64::from(sorted[(sorted.len() - 1) * share / 100]);
    let (least, quarter, most) = (at(0), at(25), at(98));
    let mean = activity.iter().map(|&value| f64::from(value)).sum::<f64>() / activity.len() as f64;
    let spread: f64 = activity
        .iter()
        .map(|&value| (f64::from(value) - mean).powi(2))
        .sum();
    let steps: f64 = activity
        .array_windows()
        .map(|&[a, b]| f64::from(a.abs_diff(b)).powi(2))
        .sum();
    // Noise differs from frame to frame as much as from its mean. A press lasts.
    if most <= least || (steps > spread && most - quarter < 4.0 * (quarter - least).max(1.0)) {
        return None;
    }
    let over = |share: f64| least + share * (most - least);
    let is_strong = |frame: &usize| f64::from(activity[*frame]) > over(STRONG);
    let strong: Vec<usize> = (0..activity.len()).filter(is_strong).collect();
    let presses = strong.chunk_by(|a, b| a + 1 == *b);
    let presses: Vec<Vec<usize>> = presses
        .filter(|press| press.len() > 1)
        .map(|press| some(press, PICTURES))
        .collect();
    let quiet = quarter.min(over(STRONG / 2.0));
    let rest = (0..activity.len()).filter(|&frame| f64::from(activity[frame]) <= quiet);
    Some((some(&presses, PRESSES), rest.collect()))
}

/// About `most` of `of`, from all over it.
pub(super) fn some<T: Clone>(of: &[T], most: usize) -> Vec<T> {
    of.iter()
        .cloned()
        .step_by(of.len().div_ceil(most).max(1))
        .collect()
}

impl Framed<'_> {
    /// The arrays that these frames may hold, the likeliest first. `None` if nothing presses.
    pub(super) fn hypotheses(&self, known: Known) -> Option<Vec<Hypothesis>> {
        let (presses, rest) = pressed(&self.columns.activity(&self.frames))?;
        let rest = some(&rest, RESTS);
        let mut found = Vec::new();
        for cell in [Cell::U8, Cell::U16le, Cell::U16be] {
            if known.cell.is_some_and(|known| known != cell) {
                continue;
            }
            for parity in 0..cell_bytes(cell) {
                if self.is_other_order(cell, parity) {
                    continue;
                }
                let pictures = self.pictures(&presses, &rest, cell, parity);
                let unlike = if cell == Cell::U8 {
                    0.0
                } else {
                    self.unlikeness(&presses, cell, parity)
                };
                let from = found.len();
                self.try_shapes(&pictures, cell, parity, known, &mut found);
                found[from..]
                    .iter_mut()
                    .for_each(|hypothesis| hypothesis.score.prior -= unlike);
            }
        }
        found.sort_by(|a, b| b.score.total().total_cmp(&a.score.total()));
        Some(found)
    }

    /// The bytes of the frame `index` that may be cells.
    fn cells(&self, index: usize) -> &[u8] {
        let bytes = self.frames.get(index);
        &bytes[..bytes.len() - self.overhead]
    }

    fn pictures(
        &self,
        presses: &[Vec<usize>],
        rest: &[usize],
        cell: Cell,
        parity: usize,
    ) -> Pictures {
        let values = |&index: &usize| -> Vec<f32> {
            let bytes = self.cells(index);
            let pairs = bytes[parity..]
                .chunks_exact(2)
                .map(|pair| [pair[0], pair[1]]);
            match cell {
                Cell::U8 => bytes.iter().map(|&byte| f32::from(byte)).collect(),
                Cell::U16le => pairs
                    .map(|pair| f32::from(u16::from_le_bytes(pair)))
                    .collect(),
                Cell::U16be => pairs
                    .map(|pair| f32::from(u16::from_be_bytes(pair)))
                    .collect(),
            }
        };
        let rests: Vec<Vec<f32>> = rest.iter().map(values).collect();
        let mut zero = Vec::new();
        for at in 0..rests.first().map_or(0, Vec::len) {
            let mut of_cell: Vec<f32> = rests.iter().map(|frame| frame[at]).collect();
            of_cell.sort_by(f32::total_cmp);
            zero.push(of_cell[of_cell.len() / 2]);
        }
        let change = |frame: Vec<f32>| {
            frame
                .iter()
                .zip(&zero)
                .map(|(value, zero)| value - zero)
                .collect()
        };
        let of_press = |press: &Vec<usize>| press.iter().map(values).map(change).collect();
        Pictures(presses.iter().map(of_press).collect())
    }

    /// Whether the high bytes change and the low ones never do: then the other order is right.
    fn is_other_order(&self, cell: Cell, parity: usize) -> bool {
        let cells = parity..self.columns.kinds.len() - self.overhead;
        let is_constant = |at: usize| matches!(self.columns.kinds[at], Kind::Constant(_));
        let low = if cell == Cell::U16le { 0 } else { 1 };
        cell != Cell::U8 && cells.skip(low).step_by(2).all(is_constant)
    }

    /// What it costs that the high bytes of cells of two bytes change as much from cell to cell as the
    /// low ones do, as if they were cells of one byte, or more, as if the order were the other one.
    fn unlikeness(&self, presses: &[Vec<usize>], cell: Cell, parity: usize) -> f64 {
        let mut differences = [1.0_f64; 2];
        for &index in presses.iter().flatten() {
            let bytes = self.cells(index);
            for (at, pair) in bytes[parity..].windows(3).enumerate() {
                differences[at % 2] += f64::from(pair[0].abs_diff(pair[2])).powi(2);
            }
        }
        let [first, second] = differences;
        let ratio = if cell == Cell::U16le {
            first / second
        } else {
            second / first
        };
        UNLIKE - ratio.ln().clamp(-UNLIKE, UNLIKE)
    }

    fn try_shapes(
        &self,
        pictures: &Pictures,
        cell: Cell,
        parity: usize,
        known: Known,
        found: &mut Vec<Hypothesis>,
    ) {
        let width = cell_bytes(cell);
        let room = self.columns.kinds.len() - self.overhead;
        for cols in 1..=LONGEST_SIDE {
            let rows = known.rows.unwrap_or(room / width / cols).min(LONGEST_SIDE);
            let array = Array { rows, cols };
            let Some(left) = room.checked_sub(rows * cols * width) else {
                continue;
            };
            // Where a smaller array may be it, the larger ones are not.
            let is_too_large = Self::is_too_large(array) && array.taxels() <= MOST_SIDE * MOST_SIDE;
            let is_strip = cols == 1 && rows > 1;
            if rows == 0
                || left > MOST_SKIPPED
                || is_strip
                || is_too_large
                || !known.allows(array, Some(cell))
            {
                continue;
            }
            for before in (parity..=left).step_by(width) {
                let skipped = (before, left - before);
                let Some(prior) = self.prior(skipped, array, width) else {
                    continue;
                };
                let (first, cells) = (before / width, rows * cols);
                found.push(Hypothesis {
                    array,
                    cell,
                    skipped,
                    score: pictures.score(first, cells, cols, prior),
                    picture: pictures.strongest()[first..first + cells].to_vec(),
                });
            }
        }
    }

    /// What the bytes beside the cells add to the score. `None` if these bytes must be cells.
    fn prior(&self, (before, after): (usize, usize), array: Array, width: usize) -> Option<f64> {
        let kinds = &self.columns.kinds;
        let end = kinds.len() - self.overhead;
        let is_constant = |at: usize| matches!(kinds[at], Kind::Constant(_));
        let is_number = |at: usize| kinds[at] == Kind::Number;
        let changing = (0..before)
            .chain(end - after..end)
            .filter(|&at| !is_constant(at))
            .count();
        if changing > self.most_unknown || (before..end - after).any(is_number) {
            return None;
        }
        let length = array.taxels() * width;
        if let Some(Holds::Checksum(Check {
            checksum,
            over: Over::Cells(cells),
            ..
        })) = &self.holds
            && checksum.bytes() > 1
            && *cells != (before..end - after)
        {
            return None;
        }
        let field_end = self.length_field(before, length);
        let mut score = match field_end {
            Some(end) if end <= self.overhead => LENGTH_FIELD,
            _ => 0.0,
        };
        score -= ELONGATED * (array.rows as f64 / array.cols as f64).ln().abs();
        if before + after > changing {
            score -= SKIPPED;
        }
        score -= UNKNOWN * changing as f64;
        let is_explained =
            self.completes_number(before) || self.completes_mark(before, length, width);
        if before > 0 && changing == 0 && !is_explained {
            score -= UNEXPLAINED + SKIPPED * before as f64;
        }
        if after > 0 && changing == 0 && !self.is_number_at_cells(after) {
            score -= UNEXPLAINED + SKIPPED * after as f64;
        }
        Some(score)
    }

    /// Whether the first `before` bytes of what might be cells complete the mark.
    pub(super) fn completes_mark(&self, before: usize, length: usize, width: usize) -> bool {
        self.length_field(before, length) == Some(self.overhead + before)
            || self.is_mark_of_words(width, before)
    }

    /// The end of a field of two bytes with the number of bytes of the cells, counted from the first
    /// byte after the cells. It may hold the first `before` bytes of what might be cells.
    fn length_field(&self, before: usize, length: usize) -> Option<usize> {
        let mut bytes: Vec<u8> =
            self.columns.rest[self.columns.rest.len() - self.overhead..].to_vec();
        bytes.extend(&self.columns.rest[..before]);
        let fields = [(length as u16).to_le_bytes(), (length as u16).to_be_bytes()];
        let from = bytes.len().saturating_sub(before + WITHIN_HEADER);
        let at = bytes[from..]
            .array_windows()
            .position(|pair| fields.contains(pair))?;
        Some(from + at + 2)
    }

    fn is_zero(&self, at: usize) -> bool {
        self.columns.kinds.get(at) == Some(&Kind::Constant(0))
    }

    /// Whether `before` bytes complete a number that ends right before them, low byte first.
    fn completes_number(&self, before: usize) -> bool {
        let end = self.columns.kinds.len();
        self.columns.numbers.iter().any(|number| {
            number.at + number.bytes == end
                && number.is_big_endian != Some(true)
                && !self.is_zero(number.at.wrapping_sub(1))
                && (number.bytes + before).is_power_of_two()
        })
    }

    /// Whether `after` bytes complete a number that begins right after them, high byte first.
    fn is_number_at_cells(&self, after: usize) -> bool {
        let at = self.columns.kinds.len() - self.overhead;
        if let Some(Holds::Sum(sum)) = &self.holds
            && sum.start == at
        {
            return (sum.len() + after).is_power_of_two();
        }
        self.columns.numbers.iter().any(|number| {
            number.at == at
                && number.is_big_endian != Some(false)
                && !self.is_zero(at + number.bytes)
                && (number.bytes + after).is_power_of_two()
        })
    }

    /// Whether the mark is written in words of two bytes like the cells, each with a high byte of 0.
    fn is_mark_of_words(&self, width: usize, before: usize) -> bool {
        let mark = &self.columns.rest[self.columns.rest.len() - self.overhead..];
        width == 2
            && before == 1
            && mark.len() >= 3
            && mark.iter().skip(1).step_by(2).all(|&byte| byte == 0)
    }

    /// Whether the array is larger than any that the daemon reads.
    pub(super) fn is_too_large(array: Array) -> bool {
        array.rows.max(array.cols) > MOST_SIDE
    }
}
