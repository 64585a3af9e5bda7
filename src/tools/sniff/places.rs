//! The places where the cells of a frame may be, the likeliest first.
//!
//! In: what each byte of a frame is. Out: [`Place`]s with what they cost. Cells are anywhere in the
//! period, and what is beside them holds a mark. Each byte that is on the unlikely side of the border
//! costs something.

use super::checks::{Check, What};
use super::columns::{Columns, Kind};

/// A stretch of each frame that may be the cells.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Place {
    /// The place of the first cell, counted from where the frames begin.
    pub(super) start: usize,
    /// The number of bytes of the cells.
    pub(super) bytes: usize,
    /// What the other bytes are, from the last cell to the first cell of the next frame.
    pub(super) beside: Vec<Kind>,
    /// What holds for the bytes beside the cells.
    pub(super) check: Option<Check>,
}

/// The most bytes beside the cells.
const MOST_BESIDE: usize = 40;
/// The fewest bytes of the cells.
const FEWEST_BYTES: usize = 4;
/// Places that cost this much more than the best one are left out.
const MOST_COST: f64 = 6.0;
/// The most places that are examined further.
const PLACES: usize = 80;
/// What it costs, as a score, that a cell has a constant value that no taxel at rest has.
const MARK_IN_CELLS: f64 = 2.0;
/// What it costs that a cell changes as a checksum does.
const RESTLESS_CELL: f64 = 0.3;
/// What it costs that bytes beside the cells change in an unknown way, as taxels do, and each of them.
const UNKNOWN: f64 = 1.5;
const UNKNOWN_BYTE: f64 = 0.5;
/// What it costs that bytes at the cells are left out though they look like cells at rest, and each
/// of them.
const SKIPPED: f64 = 1.5;
const SKIPPED_BYTE: f64 = 0.5;
/// The most bytes of a mark in a row that look like cells at rest.
const MOST_RESTING_IN_MARK: usize = 4;
/// The most such bytes at the cells that are apart from the mark, and what it costs if there are more.
const MOST_APART: usize = 2;
const APART: f64 = 1.0;
/// What is gained by a field with the number of bytes of the cells.
const LENGTH_FIELD: f64 = 2.0;
/// What is gained by a checksum.
const CHECKED: f64 = 1.0;

/// The places, the likeliest first.
pub(super) fn places(columns: &Columns) -> Vec<Place> {
    let period = columns.kinds.len();
    let mut found: Vec<(f64, Place)> = Vec::new();
    for length in 1..=MOST_BESIDE.min(period.saturating_sub(FEWEST_BYTES)) {
        for start in 0..period {
            let place = Place {
                start,
                bytes: period - length,
                beside: beside(columns, start, length),
                check: None,
            };
            found.extend(place.cost(columns).map(|cost| (cost, place)));
        }
    }
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    let most = found.first().map_or(0.0, |(cost, _)| cost + MOST_COST);
    let places = found.into_iter().take_while(|(cost, _)| *cost <= most);
    places.take(PLACES).map(|(_, place)| place).collect()
}

/// The `length` bytes that end where the cells start.
fn beside(columns: &Columns, start: usize, length: usize) -> Vec<Kind> {
    let period = columns.kinds.len();
    (0..length)
        .map(|at| columns.kinds[(start + period - length + at) % period])
        .collect()
}

impl Place {
    /// How unlikely the place is, as a score. `None` if no array can be there.
    pub(super) fn cost(&self, columns: &Columns) -> Option<f64> {
        let numbers: usize = columns.numbers.iter().map(|number| number.bytes).sum();
        let here = |is: fn(&Kind) -> bool| self.beside.iter().filter(|kind| is(kind)).count();
        let is_mark = |kind: &Kind| matches!(kind, Kind::Marking(_));
        let is_number = |kind: &Kind| *kind == Kind::Number;
        let is_restless = |kind: &Kind| *kind == Kind::Restless;
        if here(is_mark) == 0 || here(is_number) < numbers {
            return None;
        }
        let mut cost = MARK_IN_CELLS * self.marks_in_cells(columns) as f64;
        cost += RESTLESS_CELL * (columns.restless - here(is_restless)) as f64;
        let checked = self.check.as_ref().map_or(0..0, |check| check.at.clone());
        let unknown = (0..self.beside.len())
            .filter(|at| self.beside[*at] == Kind::Active && !checked.contains(at));
        match unknown.count() {
            0 => {}
            unknown => cost += UNKNOWN + UNKNOWN_BYTE * unknown as f64,
        }
        let (after, before) = self.skipped();
        if after > 0 && !self.begins_with_number(columns, after) {
            cost += SKIPPED + SKIPPED_BYTE * after as f64;
        }
        if before > 0 && !self.ends_with_number(columns) {
            cost += SKIPPED + SKIPPED_BYTE * before as f64;
        }
        cost += SKIPPED_BYTE * self.resting_in_marks(after, before) as f64;
        let backward: Vec<Kind> = self.beside.iter().rev().copied().collect();
        for apart in [apart(&self.beside), apart(&backward)] {
            if apart > MOST_APART && self.length_field().is_none() {
                cost += APART + SKIPPED_BYTE * apart as f64;
            }
        }
        if self.length_field().is_some() {
            cost -= LENGTH_FIELD;
        }
        if self.check.is_some() {
            cost -= CHECKED;
        }
        Some(cost)
    }

    /// The number of cells that have a constant value that no taxel at rest has: near the border, where
    /// the mark may be, and elsewhere those with a value of the mark. Others are taxels that never
    /// change.
    fn marks_in_cells(&self, columns: &Columns) -> usize {
        let period = columns.kinds.len();
        let marks = columns.marks.iter().filter(|&&mark| {
            let at = (mark + period - self.start) % period;
            let is_near = at < MOST_BESIDE || at + MOST_BESIDE >= self.bytes;
            at < self.bytes && (is_near || self.beside.contains(&columns.kinds[mark]))
        });
        marks.count()
    }

    /// The number of bytes that look like cells at rest within a mark, beside the `after` and `before`
    /// bytes at the cells, and are more than a mark has: a taxel that never changes may look like the
    /// end of a mark.
    fn resting_in_marks(&self, after: usize, before: usize) -> usize {
        let within = &self.beside[after..self.beside.len() - before];
        let is_resting = |kind: &Kind| matches!(kind, Kind::Resting(_));
        let runs = within.chunk_by(|a, b| is_resting(a) && is_resting(b));
        let most = runs.map(<[Kind]>::len).max().unwrap_or(0);
        most.saturating_sub(MOST_RESTING_IN_MARK)
    }

    /// The numbers of bytes after the last cell and before the first one that are no part of a mark,
    /// a check or a field: they look like cells at rest.
    pub(super) fn skipped(&self) -> (usize, usize) {
        let is_resting = |kind: &&Kind| matches!(kind, Kind::Resting(_));
        let after = self.beside.iter().take_while(is_resting).count();
        let before = self.beside.iter().rev().take_while(is_resting).count();
        let length = self.beside.len();
        let checked = self.check.as_ref().map_or(length, |check| check.at.start);
        let field_end = self.length_field().unwrap_or(0);
        let before = if self.is_mark_of_words() { 0 } else { before };
        (after.min(checked), before.min(length - field_end))
    }

    /// The end of a field of two bytes with the number of bytes of the cells.
    fn length_field(&self) -> Option<usize> {
        let bytes = self.bytes as u16;
        let fields = [bytes.to_le_bytes(), bytes.to_be_bytes()].map(|field| field.map(Some));
        let is_field = |pair: &[Kind]| {
            fields
                .iter()
                .any(|field| pair.iter().map(|kind| kind.constant()).eq(*field))
        };
        self.beside.windows(2).position(is_field).map(|at| at + 2)
    }

    /// Whether the mark is written in words of two bytes, each with a high byte of 0.
    fn is_mark_of_words(&self) -> bool {
        let mut words = self.beside.chunks(2);
        let is_word = |word: &[Kind]| {
            word.len() == 2 && word[0].constant().is_some() && word[1].constant() == Some(0)
        };
        self.beside.len() >= 4 && words.all(is_word)
    }

    /// Whether the first `skipped` bytes are high ones of a number or a sum.
    fn begins_with_number(&self, columns: &Columns, skipped: usize) -> bool {
        if let Some(Check {
            at,
            what: What::Sum,
        }) = &self.check
            && at.start == skipped
        {
            return is_whole(at.len() + skipped);
        }
        // The next ones may have values that no taxel at rest has.
        let high = constants(self.beside.iter());
        let at = (self.start + self.bytes + high) % columns.kinds.len();
        columns.numbers.iter().any(|number| {
            number.at == at && number.is_big_endian != Some(false) && is_whole(number.bytes + high)
        })
    }

    /// Whether the last bytes are the high ones of a number.
    fn ends_with_number(&self, columns: &Columns) -> bool {
        let period = columns.kinds.len();
        let high = constants(self.beside.iter().rev());
        columns.numbers.iter().any(|number| {
            (number.at + number.bytes + high) % period == self.start
                && !number.wraps
                && number.is_big_endian != Some(true)
                && is_whole(number.bytes + high)
        })
    }
}

/// The number of constant bytes that these begin with.
fn constants<'a>(kinds: impl Iterator<Item = &'a Kind>) -> usize {
    kinds.take_while(|kind| kind.constant().is_some()).count()
}

/// Whether numbers have so many bytes.
fn is_whole(bytes: usize) -> bool {
    [2, 3, 4].contains(&bytes)
}

/// The number of constant bytes that `beside` begins with, if they are apart from the mark and some look
/// like cells at rest: a taxel that never changes may look like the end of a mark.
fn apart(beside: &[Kind]) -> usize {
    let (here, beyond) = beside.split_at(constants(beside.iter()));
    let is_mark = |kind: &Kind| matches!(kind, Kind::Marking(_));
    let is_resting = |kind: &Kind| matches!(kind, Kind::Resting(_));
    let is_mixed = here.iter().any(is_mark) && here.iter().any(is_resting);
    if is_mixed && beyond.iter().any(is_mark) {
        here.len()
    } else {
        0
    }
}
