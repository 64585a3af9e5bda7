//! Says what each byte of a frame is, as far as its own values show it.
//!
//! In: frames of one length. Out: a [`Kind`] for each byte, and the numbers that grow.

use std::collections::BTreeMap;

use crate::model::{self, Near};
use crate::period::Frames;
use crate::pictures::some;

/// What a byte of a frame does over the frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// It has one value, also while something presses.
    Constant(u8),
    /// It is a part of a number that grows steadily.
    Number,
    /// It changes as much in frames that hardly change as in others, as a checksum does.
    Restless,
    /// It changes in another way, as a taxel does.
    Active,
}

/// A number that grows steadily: a counter or a clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Number {
    pub(crate) at: usize,
    /// Without high bytes that never change.
    pub(crate) bytes: usize,
    is_big_endian: bool,
    /// By how much it grows in a frame.
    pub(crate) step: u64,
    /// How many pairs of frames have about this step.
    steady: usize,
    /// Whether it has begun again at 0. Then it has no higher bytes.
    wraps: bool,
}

#[derive(Debug, Clone)]
pub(crate) struct Columns {
    pub(crate) kinds: Vec<Kind>,
    /// The most frequent value of each byte.
    pub(crate) rest: Vec<u8>,
    pub(crate) numbers: Vec<Number>,
    /// Whether the bytes look like numbers of 64 bits.
    pub(crate) are_of_64_bits: bool,
    /// The bits of each byte as a cell, of those that hardly look like one, and of all of them.
    pub(crate) cell_bits: Vec<f64>,
    pub(crate) all_cell_bits: f64,
}

/// Two frames that follow each other.
type Pair<'a> = (&'a [u8], &'a [u8]);

/// The share of frames in which damage may change a constant byte.
const DAMAGED_SHARE: f64 = 0.05;
/// The fewest frames in which a status has the same other value. Damage gives it to fewer.
const STATUS_FRAMES: usize = 4;
/// The most bytes that count as restless. If there are more, they are noisy taxels.
const MOST_RESTLESS: usize = 10;
/// The mean difference of two random bytes is 64, counted the shorter way around.
const RESTLESS_DIFFERENCE: f64 = 42.0;
/// The bytes that a constant one is compared with: how many, how far away, and how long a mark is at most.
const NEAR: usize = 64;
const FARTHEST: usize = 4096;
const MARK_BYTES: usize = 12;
/// The most quiet frames that are looked at.
const QUIET: usize = 100;
/// The longest number.
const MOST_NUMBER_BYTES: usize = 8;
/// Up to this length a number may have high bytes that are 0 all the time: of a u32 that counts from 0, two
/// are until 65536 frames have come.
const MOST_ZERO_EXTENDED: usize = 4;

impl Kind {
    pub(crate) fn constant(self) -> Option<u8> {
        match self {
            Kind::Constant(value) => Some(value),
            _ => None,
        }
    }
}

impl Columns {
    pub(crate) fn new(frames: &Frames) -> Self {
        let period = frames.period;
        let mut counts = vec![[0_u32; 256]; period];
        for frame in frames.iter() {
            for (count, &byte) in counts.iter_mut().zip(frame) {
                count[usize::from(byte)] += 1;
            }
        }
        let most = |count: &[u32; 256]| (0..=u8::MAX).max_by_key(|&byte| count[usize::from(byte)]);
        let rest: Vec<u8> = counts.iter().filter_map(most).collect();
        let others =
            |(count, &rest): (&[u32; 256], &u8)| frames.len() as u32 - count[usize::from(rest)];
        let changes: Vec<u32> = counts.iter().zip(&rest).map(others).collect();
        let pairs: Vec<Pair> = frames
            .pairs()
            .map(|(a, b)| (frames.get(a), frames.get(b)))
            .collect();
        let kinds = (0..period).map(|at| {
            let value = rest[at];
            // Damage changes a byte in one frame, a press in several.
            let held = pairs
                .iter()
                .filter(|(a, b)| a[at] != value && b[at] != value)
                .count();
            if held < 2 && f64::from(changes[at]) <= (DAMAGED_SHARE * frames.len() as f64).max(1.0)
            {
                Kind::Constant(value)
            } else {
                Kind::Active
            }
        });
        let mut columns = Self {
            kinds: kinds.collect(),
            rest,
            numbers: Vec::new(),
            are_of_64_bits: false,
            cell_bits: Vec::new(),
            all_cell_bits: 0.0,
        };
        columns.find_numbers(&pairs);
        columns.find_restless(&pairs);
        columns.cell_bits = columns.cell_bits(frames);
        columns.find_statuses(frames);
        columns.all_cell_bits = columns.cell_bits.iter().sum();
        columns
    }

    /// Finds the bytes of a status. They look like a part of a mark, but have the same other value again and again, in
    /// frames that are otherwise whole. Damage seldom leaves one value twice, or it changes other bytes too. If the mark
    /// had such a byte, all these frames would be lost.
    fn find_statuses(&mut self, frames: &Frames) {
        let mut alone: BTreeMap<(usize, u8), usize> = BTreeMap::new();
        for frame in frames.iter() {
            let kinds = self.kinds.iter().zip(frame).enumerate();
            let mut others = kinds.filter_map(|(at, (kind, &byte))| {
                let constant = kind.constant()?;
                (constant != byte).then_some((at, byte))
            });
            if let (Some(other), None) = (others.next(), others.next()) {
                *alone.entry(other).or_default() += 1;
            }
        }
        for (&(at, _), &times) in &alone {
            if times >= STATUS_FRAMES && self.cell_bits[at] > model::CONSTANT_BITS {
                self.kinds[at] = Kind::Restless;
                self.cell_bits[at] = model::RESTLESS_TAXEL_BITS;
            }
        }
    }

    /// Finds the numbers. Where two of them overlap, the one that has grown from the fewest bytes is
    /// right, and then the longest: the other order of some bytes often grows as steadily.
    fn find_numbers(&mut self, pairs: &[Pair]) {
        for bytes in [1, 2, 4] {
            let places = 0..self.kinds.len();
            let both = places.flat_map(|at| [(at, false), (at, true)]);
            let mut found: Vec<Number> = both
                .filter_map(|(at, is_big_endian)| self.number(at, bytes, is_big_endian, pairs))
                .collect();
            found.sort_by_key(|number| std::cmp::Reverse((number.bytes, number.steady)));
            for number in found {
                let kinds = &mut self.kinds[number.at..number.at + number.bytes];
                if !kinds.contains(&Kind::Number) {
                    kinds.fill(Kind::Number);
                    self.numbers.push(number);
                }
            }
        }
    }

    /// The number at `at`, if these bytes are free and grow steadily.
    fn number(
        &self,
        at: usize,
        bytes: usize,
        is_big_endian: bool,
        pairs: &[Pair],
    ) -> Option<Number> {
        let kinds = self.kinds.get(at..at + bytes)?;
        // The lowest byte changes in any case.
        let lowest = if is_big_endian { bytes - 1 } else { 0 };
        if kinds.contains(&Kind::Number) || kinds[lowest] != Kind::Active {
            return None;
        }
        let mut number = Number::steady(at, bytes, is_big_endian, pairs)?;
        // A higher byte belongs to it if the longer number is as steady.
        while number.bytes < MOST_NUMBER_BYTES
            && self.kinds.get(number.higher()) == Some(&Kind::Active)
            && let Some(longer) = number.longer(pairs)
            && longer.steady >= number.steady
        {
            number = longer;
        }
        Some(number)
    }

    /// Whether a constant byte may be a high one of a number, which is 0 as long as the number is small.
    pub(crate) fn is_high_byte(&self, at: usize) -> bool {
        let period = self.kinds.len();
        let is_zero = |at: &usize| self.kinds[*at] == Kind::Constant(0);
        let is_high_of = |number: &Number| {
            let room = MOST_ZERO_EXTENDED.saturating_sub(number.bytes);
            let after = (0..room).map(|by| (number.at + number.bytes + by) % period);
            let before = (1..=room).map(|by| (number.at + period - by) % period);
            let is_one_byte = number.bytes == 1;
            (is_one_byte || !number.is_big_endian)
                && after.take_while(is_zero).any(|zero| zero == at)
                || (is_one_byte || number.is_big_endian)
                    && before.take_while(is_zero).any(|zero| zero == at)
        };
        let mut numbers = self.numbers.iter().filter(|number| !number.wraps);
        numbers.any(is_high_of)
    }

    /// Whether a frame has all constant bytes, as one without damage has.
    pub(crate) fn is_whole(&self, frame: &[u8]) -> bool {
        self.kinds
            .iter()
            .zip(frame)
            .all(|(kind, &byte)| kind.constant().is_none_or(|constant| constant == byte))
    }

    /// How much the taxels of two frames differ.
    pub(crate) fn change(&self, a: &[u8], b: &[u8]) -> u32 {
        let active = self.kinds.iter().zip(a.iter().zip(b));
        let changes = active.filter(|(kind, _)| **kind == Kind::Active);
        changes
            .map(|(_, (a, b))| u32::from(a.abs_diff(*b).min(32)))
            .sum()
    }

    fn find_restless(&mut self, pairs: &[Pair]) {
        let active: Vec<usize> = (0..self.kinds.len())
            .filter(|&at| self.kinds[at] == Kind::Active)
            .collect();
        let mut changed: Vec<(u32, Pair)> = pairs
            .iter()
            .map(|pair| (self.change(pair.0, pair.1), *pair))
            .filter(|(change, _)| *change > 0)
            .collect();
        changed.sort_by_key(|(change, _)| *change);
        // A taxel changes little where the others do.
        let little = &changed[..changed.len() / 2];
        if little.len() < 6 {
            return;
        }
        // The mean difference, counted the shorter way around.
        let is_restless = |&at: &usize| {
            let differences = little.iter().map(|(_, (a, b))| {
                let difference = a[at].wrapping_sub(b[at]);
                f64::from(difference.min(difference.wrapping_neg()))
            });
            differences.sum::<f64>() / little.len() as f64 > RESTLESS_DIFFERENCE
        };
        let restless: Vec<usize> = active.iter().copied().filter(is_restless).collect();
        self.are_of_64_bits = are_of_64_bits(&restless, self.kinds.len());
        if restless.len() <= MOST_RESTLESS.min(active.len() / 2) {
            for at in restless {
                self.kinds[at] = Kind::Restless;
            }
        }
    }

    fn cell_bits(&self, frames: &Frames) -> Vec<f64> {
        let is_still = self.still(frames);
        let period = self.kinds.len();
        // The bytes near a byte at even distances, so that high bytes are compared with high bytes. Constant
        // ones that are close may be of the same mark.
        let near = |at: usize| -> Vec<Near> {
            let is_cell = |distance: usize, other: usize| match self.kinds[other] {
                Kind::Active => true,
                Kind::Constant(_) => distance > MARK_BYTES,
                Kind::Number | Kind::Restless => false,
            };
            let of = |other: usize| Near {
                rest: self.rest[other],
                is_still: is_still[other],
                is_constant: self.kinds[other].constant().is_some(),
            };
            let distances = (2..=(period / 2).min(FARTHEST)).step_by(2);
            let sides = distances.flat_map(|distance| {
                [
                    (distance, (at + distance) % period),
                    (distance, (at + period - distance) % period),
                ]
            });
            let near = sides.filter(|&(distance, other)| is_cell(distance, other));
            near.map(|(_, other)| of(other)).take(NEAR).collect()
        };
        let bits = |at: usize| match self.kinds[at] {
            Kind::Constant(value) => model::resting(value, &near(at)),
            Kind::Restless => model::RESTLESS_TAXEL_BITS,
            Kind::Number | Kind::Active => 0.0,
        };
        (0..period).map(bits).collect()
    }

    /// Whether each byte is always the same where nothing presses.
    fn still(&self, frames: &Frames) -> Vec<bool> {
        let activity = self.activity(frames);
        let mut sorted = activity.clone();
        sorted.sort_unstable();
        let quarter = sorted.get(sorted.len() / 4).copied().unwrap_or(0);
        let is_quiet = |&index: &usize| activity[index] <= quarter;
        let quiet: Vec<usize> = (0..frames.len()).filter(is_quiet).collect();
        let quiet = some(&quiet, QUIET);
        let changes = |at: usize| {
            quiet
                .iter()
                .filter(|&&index| frames.get(index)[at] != self.rest[at])
                .count()
        };
        (0..self.kinds.len())
            .map(|at| 20 * changes(at) < quiet.len())
            .collect()
    }

    /// How much the taxels of each frame differ from their rest.
    pub(crate) fn activity(&self, frames: &Frames) -> Vec<u32> {
        let active: Vec<usize> = (0..self.kinds.len())
            .filter(|&at| self.kinds[at] == Kind::Active)
            .collect();
        let of_frame = |frame: &[u8]| {
            let changes = active
                .iter()
                .map(|&at| frame[at].abs_diff(self.rest[at]).min(64));
            changes.map(u32::from).sum()
        };
        frames.iter().map(of_frame).collect()
    }
}

impl Number {
    /// The number in these bytes, if nearly all pairs of frames have about the same step.
    fn steady(at: usize, bytes: usize, is_big_endian: bool, pairs: &[Pair]) -> Option<Self> {
        let value = |frame: &[u8]| value(&frame[at..at + bytes], is_big_endian);
        let mask = u64::MAX >> (64 - 8 * bytes);
        let steps = pairs.iter();
        let steps = steps.map(|(a, b)| value(b).wrapping_sub(value(a)) & mask);
        let mut steps: Vec<u64> = steps.collect();
        steps.sort_unstable();
        let step = *steps.get(steps.len() / 2)?;
        let slack = step.min((mask - step).wrapping_add(1)) / 3;
        let is_steady = |&&other: &&u64| {
            let off = other.wrapping_sub(step) & mask;
            off.min((mask - off).wrapping_add(1)) <= slack
        };
        let steady = steps.iter().filter(is_steady).count();
        // Damage may make it smaller too, but not by a step.
        let wraps = pairs.iter().any(|(a, b)| {
            let (before, after) = (value(a), value(b));
            after < before && after.wrapping_sub(before) & mask <= step.saturating_mul(2)
        });
        (step > 0 && steps.len() >= 8 && 10 * steady >= 9 * steps.len()).then_some(Self {
            at,
            bytes,
            is_big_endian,
            step,
            steady,
            wraps,
        })
    }

    /// The place of the next higher byte.
    fn higher(&self) -> usize {
        if self.is_big_endian {
            self.at.wrapping_sub(1)
        } else {
            self.at + self.bytes
        }
    }

    /// The same number with the next higher byte.
    fn longer(&self, pairs: &[Pair]) -> Option<Self> {
        let at = self.at.min(self.higher());
        Self::steady(at, self.bytes + 1, self.is_big_endian, pairs)
    }
}

/// Whether of each eight bytes of a frame one is nearly always restless, and the fourth after it hardly ever:
/// the first are digits of a long number below the noise. Numbers of four bytes and fewer recur after four.
fn are_of_64_bits(restless: &[usize], period: usize) -> bool {
    let of_eight = |phase: usize| restless.iter().filter(|&&at| at % 8 == phase).count() * 8;
    (0..8).any(|phase| 5 * of_eight(phase) > 4 * period && 5 * of_eight((phase + 4) % 8) < period)
}

/// The number in these bytes.
fn value(bytes: &[u8], is_big_endian: bool) -> u64 {
    let join = |value: u64, &byte: &u8| value << 8 | u64::from(byte);
    if is_big_endian {
        bytes.iter().fold(0, join)
    } else {
        bytes.iter().rev().fold(0, join)
    }
}
