//! The places where the cells of a frame may be, the likeliest first.
//!
//! In: what each byte of a frame is. Out: [`Place`]s with the bits of what is beside the cells. Cells
//! are anywhere in the period, and beside them is a mark.

use std::ops::Range;

use hardnessd_core::wire::Checksum;

use crate::checks::Check;
use crate::columns::{Columns, Kind};
use crate::model::{CONSTANT_BITS, EXPECTED_BITS, UNKNOWN_BITS, UNKNOWN_TAXEL_BITS, ZERO_BITS};
use crate::packed;

/// A stretch of each frame that may be the cells.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Place {
    /// The place of the first cell, counted from where the frames begin.
    pub(crate) start: usize,
    /// The number of bytes of the cells.
    pub(crate) bytes: usize,
    /// What the other bytes are, from the last cell to the first cell of the next frame.
    pub(crate) beside: Vec<Beside>,
    /// The checksum among the bytes beside the cells.
    pub(crate) check: Option<Check>,
}

/// A byte beside the cells.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Beside {
    /// Its place, counted from where the frames begin.
    pub(crate) at: usize,
    pub(crate) kind: Kind,
    /// Whether it may be a high byte of a number.
    pub(crate) is_high: bool,
    /// Whether it is likelier a part of a mark than a cell that never changes.
    pub(crate) is_marking: bool,
}

impl Beside {
    pub(crate) fn constant(&self) -> Option<u8> {
        self.kind.constant()
    }

    /// Whether it looks like a cell at rest, or like a high byte.
    fn is_resting(&self) -> bool {
        self.constant().is_some() && !self.is_marking
    }

    fn bits(&self) -> f64 {
        if self.is_high {
            EXPECTED_BITS
        } else {
            constant_bits(self.kind)
        }
    }
}

/// The most bytes beside the cells.
const MOST_BESIDE: usize = 40;
/// The most places with as many bytes beside the cells. Constant cells all over a frame look like a mark, such
/// as the high halves of numbers below 0: the places beside them would crowd out the right one.
const MOST_OF_LENGTH: usize = 8;
/// The most bytes of a number that may look constant.
const MOST_HIGH_BYTES: usize = 3;
/// The least mark that is left without them.
pub(crate) const LEAST_MARK: usize = 2;
/// The fewest bytes of the cells.
const FEWEST_BYTES: usize = 4;

/// The `most` likeliest places, the likeliest first.
pub(crate) fn places(columns: &Columns, most: usize) -> Vec<Place> {
    let period = columns.kinds.len();
    let numbers: usize = columns.numbers.iter().map(|number| number.bytes).sum();
    let all: Vec<Beside> = (0..period).map(|at| beside(columns, at)).collect();
    let mut found: Vec<(f64, Place)> = Vec::new();
    for length in 1..=MOST_BESIDE.min(period.saturating_sub(FEWEST_BYTES)) {
        let shorter = found.len();
        for start in 0..period {
            let beside: Vec<Beside> = (0..length)
                .map(|by| all[(start + period - length + by) % period])
                .collect();
            let here = beside
                .iter()
                .filter(|beside| beside.kind == Kind::Number)
                .count();
            if here < numbers || !beside.iter().any(|beside| beside.is_marking) {
                continue;
            }
            let place = Place {
                start,
                bytes: period - length,
                beside,
                check: None,
            };
            found.push((place.bits(columns), place));
        }
        found[shorter..].sort_by(|a, b| a.0.total_cmp(&b.0));
        found.truncate(shorter + MOST_OF_LENGTH);
    }
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    found.truncate(most);
    found.into_iter().map(|(_, place)| place).collect()
}

fn beside(columns: &Columns, at: usize) -> Beside {
    let (kind, resting) = (columns.kinds[at], columns.cell_bits[at]);
    let is_high = columns.is_high_byte(at);
    Beside {
        at,
        kind,
        is_high,
        is_marking: kind.constant().is_some() && !is_high && resting > constant_bits(kind),
    }
}

fn constant_bits(kind: Kind) -> f64 {
    match kind.constant() {
        Some(0) => ZERO_BITS,
        Some(_) => CONSTANT_BITS,
        None => 0.0,
    }
}

impl Place {
    /// The bits of what is coded once: the constant bytes beside the cells and in them, and that there
    /// are unknown bytes.
    pub(crate) fn bits(&self, columns: &Columns) -> f64 {
        let constants: f64 = self.beside.iter().map(Beside::bits).sum();
        let field = self.length_field().map_or(0.0, |end| {
            let of_mark: f64 = self.beside[end - 2..end].iter().map(Beside::bits).sum();
            of_mark - EXPECTED_BITS
        });
        let beside = self
            .beside
            .iter()
            .map(|beside| columns.cell_bits[beside.at]);
        let in_cells = columns.all_cell_bits - beside.sum::<f64>();
        let of = |beside: &Beside| match beside.kind {
            Kind::Active => UNKNOWN_TAXEL_BITS,
            _ => UNKNOWN_BITS,
        };
        let unknown: f64 = self.unknown().map(of).sum();
        constants - field + in_cells + unknown
    }

    /// The place with this checksum. A sum of two bytes may be the low half of one of four: zeros that are next
    /// to its high byte are no cells then.
    pub(crate) fn with(mut self, check: Option<Check>) -> Self {
        let of_sum = check.map_or(0..0, |check| match check.checksum {
            Some(Checksum::Sum16) => check.at + 2..check.at + 4,
            Some(Checksum::Sum16Be) => check.at.saturating_sub(2)..check.at,
            _ => 0..0,
        });
        for beside in self.beside.iter_mut().take(of_sum.end).skip(of_sum.start) {
            beside.is_high |= beside.constant() == Some(0);
        }
        self.check = check;
        self
    }

    /// How many constant bytes beside the cells look like cells at rest, and are nothing else.
    pub(crate) fn resting(&self) -> usize {
        let field = self.length_field().map_or(0..0, |end| end - 2..end);
        let beside = self.beside.iter().enumerate();
        let resting = beside.filter(|(index, beside)| {
            beside.is_resting() && !beside.is_high && !field.contains(index)
        });
        resting.count()
    }

    /// The most constant bytes in a row that are equal. Those of a number are not among them.
    pub(crate) fn longest_run(&self) -> usize {
        let constant = |beside: &Beside| beside.constant().filter(|_| !beside.is_high);
        let runs = self.beside.chunk_by(|a, b| constant(a) == constant(b));
        let constant = runs.filter(|run| constant(&run[0]).is_some());
        constant.map(<[Beside]>::len).max().unwrap_or(0)
    }

    /// The value of a byte beside the cells, if it may belong to a mark.
    pub(crate) fn constant(&self, at: usize) -> Option<u8> {
        let (after, before) = self.skipped();
        let may_be = (after..self.beside.len() - before).contains(&at) && !self.beside[at].is_high;
        may_be.then(|| self.beside[at].constant())?
    }

    /// The end of the constant bytes that begin at `from`.
    pub(crate) fn constant_end(&self, from: usize) -> usize {
        let mut places = from..;
        places
            .find(|&at| self.constant(at).is_none())
            .expect("there is an end of the bytes")
    }

    /// The likeliest mark: the constant bytes with the most that are not 0.
    pub(crate) fn mark(&self) -> Option<Range<usize>> {
        let begins = (0..self.beside.len()).filter(|&at| {
            self.constant(at).is_some() && (at == 0 || self.constant(at - 1).is_none())
        });
        let runs = begins.map(|start| {
            let run = start..self.constant_end(start);
            let mark = self.without_high_bytes(run.clone());
            (self.weight(&run), mark == run, mark)
        });
        let best = runs
            .rev()
            .max_by_key(|&(weight, is_whole, _)| (weight, is_whole));
        best.and_then(|(weight, _, mark)| (weight > 0).then_some(mark))
    }

    /// The mark of packed frames among these constant bytes.
    pub(crate) fn own_mark(&self, run: &Range<usize>) -> Option<Range<usize>> {
        let bytes: Vec<Option<u8>> = run.clone().map(|at| self.constant(at)).collect();
        let mut places = bytes.windows(packed::MARK.len());
        let at = places.position(|part| part.iter().copied().eq(packed::MARK.map(Some)))?;
        Some(run.start + at..run.start + at + packed::MARK.len())
    }

    /// How many of these constant bytes are not 0.
    fn weight(&self, run: &Range<usize>) -> usize {
        run.clone()
            .filter(|&at| self.constant(at) != Some(0))
            .count()
    }

    /// Constant bytes without those that may be high ones of what changes beside them, such as a clock, as long as a mark
    /// is left.
    pub(crate) fn without_high_bytes(&self, whole: Range<usize>) -> Range<usize> {
        let checked = self.check.map_or(0..0, |check| check.places());
        // The highest byte that changes is seldom restless.
        let changes = |at: usize| {
            let kind = self.beside.get(at).map(|beside| beside.kind);
            matches!(kind, Some(Kind::Number | Kind::Active)) && !checked.contains(&at)
        };
        let [before, after] = [whole.start.wrapping_sub(1), whole.end].map(changes);
        let bytes = |run: &Range<usize>| -> Vec<u8> {
            run.clone().filter_map(|at| self.constant(at)).collect()
        };
        let times =
            |part: &[u8], of: &[u8]| of.windows(part.len()).filter(|&at| at == part).count();
        let all = bytes(&whole);
        let own_marks = times(&packed::MARK, &all);
        let is_mark = |run: &Range<usize>| {
            let bytes = bytes(run);
            self.weight(run) > 0
                && times(&bytes, &all) == 1
                && times(&packed::MARK, &bytes) == own_marks
        };
        let mut run = whole;
        for _ in 0..MOST_HIGH_BYTES {
            for (may_be_high, [from_start, from_end]) in [(after, [0, 1]), (before, [1, 0])] {
                let shorter = run.start + from_start..run.end - from_end;
                if may_be_high && run.len() > LEAST_MARK && is_mark(&shorter) {
                    run = shorter;
                }
            }
        }
        run
    }

    /// The bytes that change in an unknown way.
    pub(crate) fn unknown(&self) -> impl Iterator<Item = &Beside> {
        let checked = self.check.map_or(0..0, |check| check.places());
        let unknown = self.beside.iter().enumerate().filter(move |(at, beside)| {
            matches!(beside.kind, Kind::Active | Kind::Restless) && !checked.contains(at)
        });
        unknown.map(|(_, beside)| beside)
    }

    /// The numbers of bytes after the last cell and before the first one that are no part of a mark,
    /// a check or a field: they look like cells at rest.
    pub(crate) fn skipped(&self) -> (usize, usize) {
        let resting = |beside: &mut dyn Iterator<Item = &Beside>| {
            beside.take_while(|beside| beside.is_resting()).count()
        };
        let after = resting(&mut self.beside.iter());
        let before = resting(&mut self.beside.iter().rev());
        let length = self.beside.len();
        let checked = self.check.map_or(length, |check| check.at);
        let field_end = self.length_field().unwrap_or(0);
        let before = if self.is_mark_of_words() { 0 } else { before };
        (after.min(checked), before.min(length - field_end))
    }

    /// The end of a field of two bytes with the number of bytes of the cells.
    fn length_field(&self) -> Option<usize> {
        let bytes = self.bytes as u16;
        let fields = [bytes.to_le_bytes(), bytes.to_be_bytes()].map(|field| field.map(Some));
        let is_field = |pair: &[Beside]| {
            fields
                .iter()
                .any(|field| pair.iter().map(Beside::constant).eq(*field))
        };
        self.beside.windows(2).position(is_field).map(|at| at + 2)
    }

    /// Whether the mark is written in words of two bytes, each with a high byte of 0.
    fn is_mark_of_words(&self) -> bool {
        let is_word = |word: &[Beside]| {
            word.len() == 2 && word[0].constant().is_some() && word[1].constant() == Some(0)
        };
        self.beside.len() >= 4 && self.beside.chunks(2).all(is_word)
    }
}
