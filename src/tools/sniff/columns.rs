//! Says what each byte of a frame is, as far as its own values show it.
//!
//! In: frames of one length. Out: a [`Kind`] for each byte, and the numbers that grow.

use super::period::Frames;

/// What a byte of a frame does over the frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// It has one value, also while something presses. A taxel at rest may have this value.
    Resting(u8),
    /// It has one value, and no taxel at rest does: it must belong to a mark.
    Marking(u8),
    /// It is a part of a number that grows steadily.
    Number,
    /// It changes as much in frames that hardly change as in others, as a checksum does.
    Restless,
    /// It changes in another way, as a taxel does.
    Active,
}

/// A number that grows steadily: a counter or a clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Number {
    pub(super) at: usize,
    /// Without high bytes that never change.
    pub(super) bytes: usize,
    /// Whether the high byte is first. `None` for one byte.
    pub(super) is_big_endian: Option<bool>,
    /// By how much it grows in a frame.
    pub(super) step: u64,
    /// Whether it has begun again at 0. Then it has no higher bytes.
    pub(super) wraps: bool,
}

#[derive(Debug, Clone)]
pub(super) struct Columns {
    pub(super) kinds: Vec<Kind>,
    /// The most frequent value of each byte.
    pub(super) rest: Vec<u8>,
    /// The number of frames in which each byte has another value.
    pub(super) changes: Vec<u32>,
    pub(super) numbers: Vec<Number>,
    /// The places of the bytes that must belong to a mark.
    pub(super) marks: Vec<usize>,
    /// How many bytes are restless.
    pub(super) restless: usize,
    /// Whether most of the bytes that change do so as a checksum does. No array is among them.
    pub(super) are_random: bool,
}

/// Two frames that follow each other.
type Pair<'a> = (&'a [u8], &'a [u8]);

/// The share of frames in which damage may change a constant byte.
const DAMAGED_SHARE: f64 = 0.05;
/// The most bytes that count as restless. If there are more, they are noisy taxels.
const MOST_RESTLESS: usize = 10;
/// The mean difference of two random bytes is 64, counted the shorter way around.
const RESTLESS_DIFFERENCE: f64 = 42.0;
/// The longest number.
const MOST_NUMBER_BYTES: usize = 8;

impl Kind {
    pub(super) fn constant(self) -> Option<u8> {
        match self {
            Kind::Resting(value) | Kind::Marking(value) => Some(value),
            _ => None,
        }
    }
}

impl Columns {
    pub(super) fn new(frames: &Frames) -> Self {
        let period = frames.period();
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
                Kind::Resting(value)
            } else {
                Kind::Active
            }
        });
        let mut columns = Self {
            kinds: kinds.collect(),
            rest,
            changes,
            numbers: Vec::new(),
            marks: Vec::new(),
            restless: 0,
            are_random: false,
        };
        columns.find_numbers(&pairs);
        columns.find_restless(&pairs);
        columns
    }

    /// Finds the numbers. Where two of them overlap, the one that has grown from the fewest bytes is
    /// right, and then the longest: the other order of some bytes often grows as steadily.
    fn find_numbers(&mut self, pairs: &[Pair]) {
        for bytes in [1, 2, 4] {
            let places = 0..self.kinds.len();
            let both = places.flat_map(|at| [(at, false), (at, true)]);
            let mut found: Vec<(Number, usize)> = both
                .filter_map(|(at, is_big_endian)| self.number(at, bytes, is_big_endian, pairs))
                .collect();
            found.sort_by_key(|(number, steady)| std::cmp::Reverse((number.bytes, *steady)));
            for (number, _) in found {
                let kinds = &mut self.kinds[number.at..number.at + number.bytes];
                if !kinds.contains(&Kind::Number) {
                    kinds.fill(Kind::Number);
                    self.numbers.push(number);
                }
            }
        }
    }

    /// The number at `at`, if these bytes are free and grow steadily, and how many pairs have about its
    /// step.
    fn number(
        &self,
        at: usize,
        bytes: usize,
        is_big_endian: bool,
        pairs: &[Pair],
    ) -> Option<(Number, usize)> {
        let kinds = self.kinds.get(at..at + bytes)?;
        // The lowest byte changes in any case.
        let lowest = if is_big_endian { bytes - 1 } else { 0 };
        if kinds.contains(&Kind::Number) || kinds[lowest] != Kind::Active {
            return None;
        }
        let (step, mut steady) = steady_step(pairs, at, bytes, is_big_endian)?;
        let mut number = Number {
            at,
            bytes,
            is_big_endian: (bytes > 1).then_some(is_big_endian),
            step,
            wraps: false,
        };
        // A higher byte belongs to it if the longer number is as steady.
        while number.bytes < MOST_NUMBER_BYTES {
            let longer = [(false, number.at), (true, number.at.wrapping_sub(1))]
                .into_iter()
                .find_map(|(is_big_endian, at)| {
                    let higher = if is_big_endian { at } else { at + number.bytes };
                    if number.is_big_endian == Some(!is_big_endian)
                        || self.kinds.get(higher) != Some(&Kind::Active)
                    {
                        return None;
                    }
                    let bytes = number.bytes + 1;
                    let (step, more) = steady_step(pairs, at, bytes, is_big_endian)?;
                    let longer = Number {
                        at,
                        bytes,
                        is_big_endian: Some(is_big_endian),
                        step,
                        wraps: false,
                    };
                    (more >= steady).then_some((longer, more))
                });
            match longer {
                Some(longer) => (number, steady) = longer,
                None => break,
            }
        }
        let bytes = number.at..number.at + number.bytes;
        let value =
            |frame: &[u8]| self::number(&frame[bytes.clone()], number.is_big_endian == Some(true));
        // Damage may make it smaller too, but not by a step.
        let mask = u64::MAX >> (64 - 8 * number.bytes);
        number.wraps = pairs.iter().any(|(a, b)| {
            let (before, after) = (value(a), value(b));
            after < before && after.wrapping_sub(before) & mask <= 2 * number.step
        });
        Some((number, steady))
    }

    /// How much the taxels of two frames differ.
    pub(super) fn change(&self, a: &[u8], b: &[u8]) -> u32 {
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
        self.are_random = 2 * restless.len() > active.len();
        if restless.len() <= MOST_RESTLESS.min(active.len() / 2) {
            self.restless = restless.len();
            for at in restless {
                self.kinds[at] = Kind::Restless;
            }
        }
    }

    /// How much the taxels of each frame differ from their rest.
    pub(super) fn activity(&self, frames: &Frames) -> Vec<u32> {
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

/// The step of the number at `at`, and how many pairs have about this step, if nearly all have.
fn steady_step(
    pairs: &[Pair],
    at: usize,
    bytes: usize,
    is_big_endian: bool,
) -> Option<(u64, usize)> {
    if pairs.len() < 8 {
        return None;
    }
    let value = |frame: &[u8]| number(&frame[at..at + bytes], is_big_endian);
    let mask = u64::MAX >> (64 - 8 * bytes);
    let steps: Vec<u64> = pairs
        .iter()
        .map(|(a, b)| value(b).wrapping_sub(value(a)) & mask)
        .collect();
    let mut sorted = steps.clone();
    sorted.sort_unstable();
    let median = sorted[sorted.len() / 2];
    let slack = median.min((mask - median).wrapping_add(1)) / 3;
    let is_steady = |&&step: &&u64| {
        let off = step.wrapping_sub(median) & mask;
        off.min((mask - off).wrapping_add(1)) <= slack
    };
    let steady = steps.iter().filter(is_steady).count();
    (median > 0 && 10 * steady >= 9 * steps.len()).then_some((median, steady))
}

/// The number in these bytes.
pub(super) fn number(bytes: &[u8], is_big_endian: bool) -> u64 {
    let join = |value: u64, &byte: &u8| value << 8 | u64::from(byte);
    if is_big_endian {
        bytes.iter().fold(0, join)
    } else {
        bytes.iter().rev().fold(0, join)
    }
}
