//! Says which constant bytes of a frame belong to a mark.
//!
//! In: what each byte does, and its value at rest. Out: [`Kind::Marking`] for bytes that no taxel at rest
//! is like. A taxel is like the taxels near it: in its value at rest, and in its noise.

use super::columns::{Columns, Kind};
use super::period::Frames;

/// The most active bytes on a side that a constant byte is compared with.
const NEAR: usize = 64;
/// The greatest distance of such a byte.
const FARTHEST: usize = 4096;
/// A side with fewer says little beside the other, and one with fewer than many does not show the
/// range well.
const FEWEST_NEAR: usize = 8;
const MANY_NEAR: usize = 24;
/// The share of the quiet frames in which a noisy byte changes.
const NOISY_SHARE: f64 = 0.05;
/// The fewest bytes that show whether taxels are noisy, and the share of them that is.
const FEWEST_NOISY: usize = 8;
const MOSTLY_NOISY: f64 = 0.75;
/// More bytes than this, in all of a frame, are not all of a mark.
const MOST_MARKS: usize = 100;
/// The greatest distance of two bytes of a mark.
const NEAR_MARK: usize = 8;

impl Columns {
    /// Tells the constant bytes that no taxel at rest has.
    pub(super) fn find_marking(&mut self, frames: &Frames) {
        let period = self.kinds.len();
        let mut constant = [0; 256];
        for value in self.kinds.iter().filter_map(|kind| kind.constant()) {
            constant[usize::from(value)] += 1;
        }
        // The high bytes of taxels at rest are often all 0, and never change.
        let many = (period / 10).max(6);
        let is_rare = |at: usize| {
            let value = self.kinds[at].constant();
            value.is_some_and(|value| constant[usize::from(value)] < many)
        };
        let is_noisy = self.noisy(frames);
        // Bytes that no taxel near them is like, and bytes that are still where all taxels are noisy.
        let (mut marking, mut still) = (Vec::new(), Vec::new());
        for at in (0..period).filter(|&at| is_rare(at)) {
            let sides = self.sides(at);
            let among: Vec<&Vec<usize>> = sides
                .iter()
                .filter(|near| self.is_among(self.rest[at], near))
                .collect();
            // Some taxels read 0 whatever their noise.
            let is_still = self.changes[at] == 0 && self.rest[at] != 0;
            if among.is_empty() {
                marking.push(at);
            } else if is_still && among.iter().all(|near| are_mostly(near, &is_noisy)) {
                still.push(at);
            }
        }
        if marking.is_empty() {
            marking = longest_run(&still);
        } else if marking.len() > MOST_MARKS {
            // Taxels that never change have all kinds of values.
            marking = longest_run(&marking);
        } else {
            // Far from a mark it is a taxel that is stuck.
            let is_near = |at: &usize| {
                let distance = |mark: &usize| at.abs_diff(*mark);
                let near = |mark| distance(mark).min(period - distance(mark)) <= NEAR_MARK;
                marking.iter().any(near)
            };
            let near: Vec<usize> = still.into_iter().filter(is_near).collect();
            marking.extend(near);
        }
        for &at in &marking {
            self.kinds[at] = Kind::Marking(self.rest[at]);
        }
        self.marks = marking;
    }

    /// The bytes near `at` that have its role if it is a taxel at an end of the array: the nearest on
    /// each side, at even distances, because the low bytes and the high bytes of cells differ.
    fn sides(&self, at: usize) -> Vec<Vec<usize>> {
        let period = self.kinds.len();
        let distances = || (2..(period / 2).min(FARTHEST)).step_by(2);
        let after = distances().map(|distance| (at + distance) % period);
        let before = distances().map(|distance| (at + period - distance) % period);
        let sides = [self.near(after), self.near(before)];
        let says_much = |side: &&Vec<usize>| self.active(side).count() >= FEWEST_NEAR;
        let much: Vec<Vec<usize>> = sides.iter().filter(says_much).cloned().collect();
        if much.is_empty() {
            vec![sides.concat()]
        } else {
            much
        }
    }

    /// As many of these bytes as [`NEAR`] active ones reach, without numbers and checksums.
    fn near(&self, places: impl Iterator<Item = usize>) -> Vec<usize> {
        let is_cell = |at: &usize| !matches!(self.kinds[*at], Kind::Number | Kind::Restless);
        let mut active = 0;
        let is_within = |&at: &usize| {
            active += usize::from(self.kinds[at] == Kind::Active);
            active <= NEAR
        };
        places.filter(is_cell).take_while(is_within).collect()
    }

    /// The active bytes of these.
    fn active<'a>(&'a self, places: &'a [usize]) -> impl Iterator<Item = usize> + 'a {
        let places = places.iter().copied();
        places.filter(|&at| self.kinds[at] == Kind::Active)
    }

    /// Whether `value` is among the values at rest of the active bytes of `near`.
    fn is_among(&self, value: u8, near: &[usize]) -> bool {
        let mut values: Vec<u8> = self.active(near).map(|at| self.rest[at]).collect();
        values.sort_unstable();
        // A few of these bytes may be a checksum.
        let few = (values.len() / 8).clamp(1, 4);
        let few = few.min(values.len().saturating_sub(1) / 2);
        let range = values.get(few).zip(values.iter().rev().nth(few));
        range.is_some_and(|(&least, &most)| {
            let part = if values.len() < MANY_NEAR { 1 } else { 2 };
            let slack = if most > least {
                ((most - least) / part).saturating_add(2)
            } else {
                0
            };
            (least.saturating_sub(slack)..=most.saturating_add(slack)).contains(&value)
        })
    }

    /// Whether each byte changes also where nothing presses.
    fn noisy(&self, frames: &Frames) -> Vec<bool> {
        let activity = self.activity(frames);
        let mut sorted = activity.clone();
        sorted.sort_unstable();
        let quarter = sorted.get(sorted.len() / 4).copied().unwrap_or(0);
        let quiet: Vec<&[u8]> = frames
            .iter()
            .zip(&activity)
            .filter(|(_, activity)| **activity <= quarter)
            .map(|(frame, _)| frame)
            .collect();
        let is_noisy = |at: usize| {
            let changed = quiet.iter().filter(|frame| frame[at] != self.rest[at]);
            changed.count() as f64 >= NOISY_SHARE * quiet.len() as f64
        };
        (0..self.kinds.len())
            .map(|at| self.kinds[at] == Kind::Active && is_noisy(at))
            .collect()
    }
}

/// Whether most of the bytes at `near` are noisy.
fn are_mostly(near: &[usize], is_noisy: &[bool]) -> bool {
    let noisy = near.iter().filter(|&&at| is_noisy[at]).count();
    near.len() >= FEWEST_NOISY && noisy as f64 >= MOSTLY_NOISY * near.len() as f64
}

/// The longest run of consecutive places. Empty if there are several.
fn longest_run(places: &[usize]) -> Vec<usize> {
    let runs = || places.chunk_by(|a, b| a + 1 == *b);
    let longest = runs().map(<[usize]>::len).max().unwrap_or(0);
    let mut longest_runs = runs().filter(|run| run.len() == longest);
    match (longest_runs.next(), longest_runs.next()) {
        (Some(run), None) => run.to_vec(),
        _ => Vec::new(),
    }
}
