//! Finds the length of a frame, and the frames, before anything is known of their parts.
//!
//! In: raw bytes. Out: distances at which a few bytes recur, and for such a distance the places of
//! the frames. A frame begins anywhere here: its bytes are a turn of the period.

use std::collections::HashMap;

/// Shorter stretches are no frames of an array.
const SHORTEST_PERIOD: usize = 9;
/// The longest period: 128x128 cells of two bytes, so that an array that is too large is found.
const LONGEST_PERIOD: usize = 33_000;
/// The most bytes that periods are looked for in.
const SAMPLE_BYTES: usize = 1 << 20;
/// The lengths of the stretches that may recur. The longest one holds a mark and the number of a
/// packet.
const ANCHOR_BYTES: [usize; 4] = [1, 2, 4, 6];
/// The least share of the bytes that a period must cover.
const LEAST_COVERAGE: f64 = 0.3;
/// The number of periods that are examined.
const PERIODS: usize = 6;
/// The most frames, and bytes of frames, that are examined.
const MOST_FRAMES: usize = 1000;
const MOST_FRAME_BYTES: usize = 4 << 20;
/// The number of consecutive frames that are examined together.
const RUN: usize = 25;

/// A distance at which some bytes recur.
#[derive(Debug, Clone)]
pub(crate) struct Period {
    pub(crate) bytes: usize,
    /// Bytes that recur at this distance.
    anchor: Vec<u8>,
}

/// The periods of `bytes`, those that cover most bytes first. Of two that cover as much, the shorter
/// one is first.
pub(crate) fn periods(bytes: &[u8]) -> Vec<Period> {
    // Presses are often in the middle, and the beginning of a stream may be something else.
    let from = bytes.len().saturating_sub(SAMPLE_BYTES) / 2;
    let sample = &bytes[from..bytes.len().min(from + SAMPLE_BYTES)];
    // For each distance, the share of the sample that it covers, and the place of the anchor.
    let mut found: HashMap<usize, (f64, Period)> = HashMap::new();
    for length in ANCHOR_BYTES {
        for (gap, at, times) in recurrences(sample, length) {
            let coverage = (times * gap) as f64 / sample.len() as f64;
            let best = found.get(&gap).map_or(LEAST_COVERAGE, |(best, _)| *best);
            if coverage > best {
                let anchor = sample[at..at + length].to_vec();
                found.insert(gap, (coverage, Period { bytes: gap, anchor }));
            }
        }
    }
    let mut periods: Vec<_> = found.into_values().collect();
    let steps = |coverage: f64| (coverage * 12.0).round() as usize;
    periods.sort_by_key(|(coverage, period)| (usize::MAX - steps(*coverage), period.bytes));
    periods.truncate(PERIODS);
    periods.into_iter().map(|(_, period)| period).collect()
}

/// Distances at which the same `length` bytes recur twice in a row, each with a place of the bytes
/// that do so most often, and how often they do. Bytes that are twice in each frame do not.
fn recurrences(bytes: &[u8], length: usize) -> Vec<(usize, usize, usize)> {
    let mut last: HashMap<u64, (usize, usize)> = HashMap::new();
    let mut gaps: Vec<(usize, u64, usize)> = Vec::new();
    for (at, gram) in bytes.windows(length).enumerate() {
        let key = gram.iter().fold(0, |key, &byte| key << 8 | u64::from(byte));
        let (before, gap_before) = last.get(&key).copied().unwrap_or((at, 0));
        let gap = at - before;
        if gap == gap_before && (SHORTEST_PERIOD..=LONGEST_PERIOD).contains(&gap) {
            gaps.push((gap, key, at));
        }
        last.insert(key, (at, gap));
    }
    gaps.sort_unstable();
    let of_gap = gaps.chunk_by(|a, b| a.0 == b.0).filter_map(|of_gap| {
        let same = of_gap
            .chunk_by(|a, b| a.1 == b.1)
            .max_by_key(|same| same.len())?;
        Some((same[0].0, same[0].2, same.len()))
    });
    of_gap.filter(|&(_, _, times)| times >= 3).collect()
}

/// Frames of one length in `bytes`. Each begins at the same turn of the period.
#[derive(Debug, Clone)]
pub(crate) struct Frames<'a> {
    bytes: &'a [u8],
    pub(crate) period: usize,
    /// Where the frames begin, in order.
    starts: Vec<usize>,
}

impl<'a> Frames<'a> {
    /// The frames of a period. A frame whose anchor is damaged, or hidden by a press, is one too if
    /// the anchors before and after it are in step.
    pub(crate) fn new(bytes: &'a [u8], period: &Period) -> Self {
        let step = period.bytes;
        let is_anchor = |at: usize| bytes[at..].starts_with(&period.anchor);
        let last = bytes.len().saturating_sub(step);
        let hits: Vec<usize> = (0..last)
            .filter(|&at| is_anchor(at) && is_anchor(at + step))
            .collect();
        let mut starts = Vec::new();
        let mut due = None;
        for (index, &hit) in hits.iter().enumerate() {
            let from = match due {
                Some(due) if hit < due => continue,
                Some(due) if (hit - due).is_multiple_of(step) => due,
                Some(due) => {
                    // Bytes may look like the anchor by chance, where the old step still holds.
                    let near = hits[index..].iter().take_while(|&&at| at <= hit + 3 * step);
                    if near.into_iter().any(|at| (at - due).is_multiple_of(step)) {
                        continue;
                    }
                    hit
                }
                None => hit,
            };
            starts.extend((from..=hit).step_by(step));
            due = Some(hit + step);
        }
        starts.extend(due.filter(|due| due + step <= bytes.len()));
        Self {
            bytes,
            period: step,
            starts,
        }
        .selected()
    }

    /// Runs of consecutive frames from all over the stream, if there are many frames.
    fn selected(self) -> Self {
        let most = MOST_FRAMES.min(MOST_FRAME_BYTES / self.period).max(2 * RUN);
        if self.starts.len() <= most {
            return self;
        }
        let runs = most / RUN;
        let starts = (0..runs).flat_map(|run| {
            let from = run * (self.starts.len() - RUN) / (runs - 1);
            self.starts[from..from + RUN].iter().copied()
        });
        Self {
            starts: starts.collect(),
            ..self
        }
    }

    /// The frames whose cells may reach over their ends, because enough bytes are before and behind them.
    pub(crate) fn inner(&self) -> Self {
        self.of(|start| start >= self.period && start + 2 * self.period <= self.bytes.len())
    }

    /// The frames that `are` so.
    pub(crate) fn retained(&self, are: impl Fn(&[u8]) -> bool) -> Self {
        self.of(|start| are(&self.bytes[start..][..self.period]))
    }

    fn of(&self, is_kept: impl Fn(usize) -> bool) -> Self {
        let starts = self.starts.iter().copied();
        Self {
            starts: starts.filter(|&start| is_kept(start)).collect(),
            ..*self
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.starts.len()
    }

    /// The bytes of a frame.
    pub(crate) fn get(&self, index: usize) -> &'a [u8] {
        &self.bytes[self.starts[index]..][..self.period]
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = &'a [u8]> + '_ {
        (0..self.len()).map(|index| self.get(index))
    }

    /// `length` bytes from `offset` on, counted from the beginning of an inner frame. They may reach into
    /// the next one, or from the one before if most of them would be in the next one.
    pub(crate) fn from(&self, index: usize, offset: usize, length: usize) -> &'a [u8] {
        let start = self.starts[index] + offset;
        let is_next = 2 * offset + length >= 2 * self.period;
        &self.bytes[if is_next { start - self.period } else { start }..][..length]
    }

    /// The pairs of frames that follow each other without a gap.
    pub(crate) fn pairs(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        self.at_distance(1)
    }

    /// The pairs of frames with `frames - 1` frames between them and no gap.
    pub(crate) fn at_distance(&self, frames: usize) -> impl Iterator<Item = (usize, usize)> + '_ {
        let pairs = self.starts.iter().zip(self.starts.iter().skip(frames));
        pairs
            .enumerate()
            .filter(move |(_, (a, b))| **b == **a + frames * self.period)
            .map(move |(index, _)| (index, index + frames))
    }

    /// Where in the period a frame begins: where bytes come after a `pause`, or else where the stream begins.
    pub(crate) fn beginning(&self, pauses: &[usize]) -> Option<usize> {
        let turn = |at: usize| {
            let before = self.starts.partition_point(|&start| start <= at);
            let start = *self.starts.get(before.saturating_sub(1))?;
            (at.abs_diff(start) < 2 * self.period)
                .then(|| (at + 2 * self.period - start) % self.period)
        };
        let mut turns: Vec<usize> = pauses.iter().filter_map(|&at| turn(at)).collect();
        if turns.len() < 4 {
            return turn(0);
        }
        turns.sort_unstable();
        let middle = turns[turns.len() / 2];
        let agree = turns.iter().filter(|&&turn| turn == middle).count();
        (10 * agree >= 8 * turns.len()).then_some(middle)
    }
}
