//! Says what each byte of a frame is, as far as its own values show it.
//!
//! In: frames of one length. Out: a [`Kind`] for each byte, the frames in which something presses,
//! and the stretches that must hold the mark.

use super::period::Frames;

/// What a byte of a frame does over the frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
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
pub(super) struct Number {
    pub(super) at: usize,
    pub(super) bytes: usize,
    /// Whether the high byte is first. `None` for one byte.
    pub(super) is_big_endian: Option<bool>,
    /// By how much it grows in a frame.
    pub(super) step: u64,
}

#[derive(Debug, Clone)]
pub(super) struct Columns {
    pub(super) kinds: Vec<Kind>,
    /// The most frequent value of each byte.
    pub(super) rest: Vec<u8>,
    pub(super) numbers: Vec<Number>,
}

/// A stretch of a frame, which may go on at its beginning.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Stretch {
    pub(super) start: usize,
    pub(super) length: usize,
}

/// The share of frames in which damage may change a constant byte.
const DAMAGED_SHARE: f64 = 0.05;
/// Bytes that tell a mark from taxels at rest may have this many bytes between them.
const WITHIN_MARK: usize = 16;
/// Numbers beside the mark may have this many constant bytes before them: the field of a length, and
/// their own high bytes.
const BETWEEN_NUMBERS: usize = 8;
/// The most bytes that count as restless. If there are more, they are noisy taxels.
const MOST_RESTLESS: usize = 10;
/// The mean difference of two random bytes is 64, counted the shorter way around.
const RESTLESS_DIFFERENCE: f64 = 42.0;
/// The number of pairs of frames that numbers are looked for in.
const PAIRS: usize = 200;

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
        let pairs: Vec<(&[u8], &[u8])> = frames
            .pairs()
            .map(|(a, b)| (frames.get(a), frames.get(b)))
            .collect();
        let kinds = (0..period).map(|at| {
            let value = rest[at];
            let others = frames.len() as f64 - f64::from(counts[at][usize::from(value)]);
            // Damage changes a byte in one frame, a press in several.
            let held = pairs
                .iter()
                .filter(|(a, b)| a[at] != value && b[at] != value)
                .count();
            if held < 2 && others <= (DAMAGED_SHARE * frames.len() as f64).max(1.0) {
                Kind::Constant(value)
            } else {
                Kind::Active
            }
        });
        let mut columns = Self {
            kinds: kinds.collect(),
            rest,
            numbers: Vec::new(),
        };
        let step = pairs.len().div_ceil(PAIRS).max(1);
        let some: Vec<_> = pairs.iter().copied().step_by(step).collect();
        columns.find_numbers(&some, &pairs);
        columns.find_restless(&pairs);
        columns
    }

    fn find_numbers(&mut self, pairs: &[(&[u8], &[u8])], all: &[(&[u8], &[u8])]) {
        for bytes in [1, 2, 4] {
            for at in 0..self.kinds.len() {
                for is_big_endian in [false, true] {
                    let Some(number) = self.number(at, bytes, is_big_endian, pairs, all) else {
                        continue;
                    };
                    self.numbers.push(number);
                    for own in number.at..number.at + number.bytes {
                        self.kinds[own % self.rest.len()] = Kind::Number;
                    }
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
        pairs: &[(&[u8], &[u8])],
        all: &[(&[u8], &[u8])],
    ) -> Option<Number> {
        let period = self.rest.len();
        if at + bytes > period || (at..at + bytes).any(|own| self.kinds[own] == Kind::Number) {
            return None;
        }
        // The lowest byte changes in any case.
        let lowest = if is_big_endian { at + bytes - 1 } else { at };
        if self.kinds[lowest] != Kind::Active {
            return None;
        }
        let step = steady_step(pairs, at, bytes, is_big_endian)?;
        let is_big_endian = (bytes > 1).then_some(is_big_endian);
        let mut number = Number {
            at,
            bytes,
            is_big_endian,
            step,
        };
        // Higher bytes count with it as long as they change.
        while number.bytes < 8 {
            let after = (
                number.at + number.bytes < period,
                number.at,
                number.at + number.bytes,
                false,
            );
            let before = (
                number.at > 0,
                number.at.wrapping_sub(1),
                number.at.wrapping_sub(1),
                true,
            );
            let longer = [after, before]
                .into_iter()
                .find(|&(exists, _, higher, is_big)| {
                    exists
                        && number.is_big_endian.is_none_or(|ours| ours == is_big)
                        && self.kinds[higher] == Kind::Active
                        && carries(all, &number, higher, is_big)
                });
            let Some((_, from, _, is_big)) = longer else {
                break;
            };
            number = Number {
                at: from,
                bytes: number.bytes + 1,
                is_big_endian: Some(is_big),
                ..number
            };
        }
        Some(number)
    }

    fn find_restless(&mut self, pairs: &[(&[u8], &[u8])]) {
        let active: Vec<usize> = self.of_kind(|kind| kind == Kind::Active);
        let change = |(a, b): &(&[u8], &[u8])| -> u32 {
            active
                .iter()
                .map(|&at| u32::from(a[at].abs_diff(b[at]).min(32)))
                .sum()
        };
        let mut changed: Vec<_> = pairs
            .iter()
            .map(|pair| (change(pair), *pair))
            .filter(|(change, _)| *change > 0)
            .collect();
        changed.sort_by_key(|(change, _)| *change);
        // A taxel changes little where the others do.
        let little = &changed[..changed.len() / 2];
        if little.len() < 6 {
            return;
        }
        let is_restless = |&at: &usize| {
            difference(little.iter().map(|(_, pair)| *pair), at) > RESTLESS_DIFFERENCE
        };
        let restless: Vec<usize> = active.iter().copied().filter(is_restless).collect();
        if restless.len() <= MOST_RESTLESS.min(active.len() / 2) {
            for at in restless {
                self.kinds[at] = Kind::Restless;
            }
        }
    }

    pub(super) fn of_kind(&self, is_kind: impl Fn(Kind) -> bool) -> Vec<usize> {
        (0..self.kinds.len())
            .filter(|&at| is_kind(self.kinds[at]))
            .collect()
    }

    /// How much the taxels of each frame differ from their rest.
    pub(super) fn activity(&self, frames: &Frames) -> Vec<u32> {
        let active = self.of_kind(|kind| kind == Kind::Active);
        let of_frame = |frame: &[u8]| {
            active
                .iter()
                .map(|&at| u32::from(frame[at].abs_diff(self.rest[at]).min(64)))
                .sum()
        };
        frames.iter().map(of_frame).collect()
    }

    /// Stretches that have constant bytes unlike those of taxels at rest, most such bytes first. Each
    /// reaches over the numbers and restless bytes beside it.
    pub(super) fn marks(&self) -> Vec<Stretch> {
        let period = self.kinds.len();
        let is_taxel_at_rest = self.at_rest();
        let unlike: Vec<usize> =
            self.of_kind(|kind| matches!(kind, Kind::Constant(value) if !is_taxel_at_rest(value)));
        let Some(&first) = unlike.first() else {
            return Vec::new();
        };
        // The stretches of such bytes, with their number of these bytes.
        let mut groups: Vec<(usize, Stretch)> = Vec::new();
        let is_joined = |from: usize, to: usize| {
            to - from <= WITHIN_MARK && (from..to).all(|at| self.kinds[at % period] != Kind::Active)
        };
        for &at in &unlike {
            match groups.last_mut() {
                Some((count, group)) if is_joined(group.start + group.length, at) => {
                    *count += 1;
                    group.length = at + 1 - group.start;
                }
                _ => groups.push((
                    1,
                    Stretch {
                        start: at,
                        length: 1,
                    },
                )),
            }
        }
        if let [(count, begins), .., (more, ends)] = &mut groups[..]
            && is_joined(ends.start + ends.length, first + period)
        {
            ends.length = first + period + begins.length - ends.start;
            *more += *count;
            groups.remove(0);
        }
        groups.sort_by_key(|(count, _)| usize::MAX - count);
        groups
            .into_iter()
            .map(|(_, group)| self.grown(group))
            .collect()
    }

    /// The stretch with the numbers and restless bytes beside it.
    pub(super) fn grown(&self, mut stretch: Stretch) -> Stretch {
        let period = self.kinds.len();
        let is_other = |at: usize| matches!(self.kinds[at % period], Kind::Number | Kind::Restless);
        // The high bytes of a clock may be constant, and lie between.
        let is_between = |at: usize| matches!(self.kinds[at % period], Kind::Constant(_));
        let reach = |places: &mut dyn Iterator<Item = usize>| {
            let mut reached = 0;
            for (index, at) in places.take(WITHIN_MARK).enumerate() {
                if is_other(at) {
                    reached = index + 1;
                } else if !is_between(at) || index - reached >= BETWEEN_NUMBERS {
                    break;
                }
            }
            reached
        };
        let end = stretch.start + stretch.length;
        stretch.length += reach(&mut (end..));
        let before = reach(&mut (1..).map(|back| stretch.start + 2 * period - back));
        stretch.start = (stretch.start + period - before) % period;
        stretch.length += before;
        stretch
    }

    /// Whether a constant value may be that of a taxel at rest.
    fn at_rest(&self) -> impl Fn(u8) -> bool {
        let period = self.kinds.len();
        let constants = self.of_kind(|kind| matches!(kind, Kind::Constant(_)));
        let is_constant = |at: usize| matches!(self.kinds[at % period], Kind::Constant(_));
        let is_alone = |&at: &usize| !is_constant(at + 1) && !is_constant(at + period - 1);
        let alone: Vec<usize> = constants.iter().copied().filter(is_alone).collect();
        let of: Vec<usize> = if 10 * constants.len() < period {
            // Taxels at rest are noisy.
            Vec::new()
        } else if 5 * alone.len() > 4 * constants.len() {
            // The high bytes of noisy taxels.
            alone
        } else {
            self.of_kind(|kind| kind == Kind::Active)
        };
        let mut values: Vec<u8> = of.iter().map(|&at| self.rest[at]).collect();
        values.sort_unstable();
        // A few of these bytes may be a checksum.
        let few = (values.len() / 8 + 1).min(values.len().saturating_sub(1) / 2);
        let range = values
            .get(few)
            .copied()
            .zip(values.iter().rev().nth(few).copied());
        // The high bytes of taxels at rest are often all 0, and never change.
        let mut constant = [0; 256];
        for &at in &constants {
            constant[usize::from(self.rest[at])] += 1;
        }
        let many = (period / 10).max(6);
        move |value| {
            let Some((least, most)) = range else {
                return false;
            };
            if constant[usize::from(value)] >= many {
                return true;
            }
            let slack = if most > least {
                (most - least) / 2 + 2
            } else {
                0
            };
            (least.saturating_sub(slack)..=most.saturating_add(slack)).contains(&value)
        }
    }
}

/// The mean difference of a byte in pairs of frames, counted the shorter way around.
fn difference<'a>(pairs: impl ExactSizeIterator<Item = (&'a [u8], &'a [u8])>, at: usize) -> f64 {
    let count = pairs.len().max(1) as f64;
    let differences = pairs.map(|(a, b)| {
        let difference = a[at].wrapping_sub(b[at]);
        f64::from(difference.min(difference.wrapping_neg()))
    });
    differences.sum::<f64>() / count
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

/// Whether the byte at `higher` grows by one where the number begins again, and nowhere else.
fn carries(pairs: &[(&[u8], &[u8])], number: &Number, higher: usize, is_big_endian: bool) -> bool {
    let own = number.at..number.at + number.bytes;
    let (mut carried, mut wrong) = (0, 0);
    for (a, b) in pairs {
        let is_over = value(&b[own.clone()], is_big_endian) < value(&a[own.clone()], is_big_endian);
        let grown = b[higher].wrapping_sub(a[higher]);
        carried += usize::from(is_over && grown == 1);
        wrong += usize::from(grown != u8::from(is_over));
    }
    carried > 0 && 40 * wrong <= pairs.len()
}

/// The step of the number at `at`, if it grows by about as much in nearly all pairs.
fn steady_step(
    pairs: &[(&[u8], &[u8])],
    at: usize,
    bytes: usize,
    is_big_endian: bool,
) -> Option<u64> {
    if pairs.len() < 8 {
        return None;
    }
    let value = |frame: &[u8]| value(&frame[at..at + bytes], is_big_endian);
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
    (median > 0 && 10 * steady >= 9 * steps.len()).then_some(median)
}
