//! The model: how many bits a lossless coder needs for the captured bytes under a layout.
//!
//! The layout that needs the fewest bits is the likeliest, and one that needs n bits more is 2^n times
//! less likely. Pictures of one press are much alike, so all of them count as one. So do presses at one
//! place, and a press that covers the array says nothing. The bits of a layout are the sum of these terms:
//!
//! | term | what is coded | how |
//! |---|---|---|
//! | name | which layout it is | a rare type of cells, a long and narrow array and unknown bytes take more |
//! | beside | what is beside the cells: constant bytes | 8 bits each, once; what is known beforehand takes none: a length, the high bytes of a number, the mark of a known board |
//! | | numbers that grow, and checksums | none |
//! | | other bytes | by what they do in other presses ([`unknown`]) |
//! | rest | a cell that never changes | by the cells near it: their values at rest, and whether they are as still |
//! | presses | the change of each cell | by its neighbours in the array ([`rows`]), whose each second row may run the other way |
//! | | of cells on their own | by what they do in other presses ([`alone`]) |
//!
//! Changes are whole numbers of steps. They are coded as what is left of a prediction, by a geometric
//! distribution whose mean is that of all changes with as much going on around them. This is how
//! pictures are compressed without loss (LOCO-I, ISO 14495-1).

use hardnessd_core::frame::Array;

use super::pictures::{Picture, Pictures};

/// So many bits are odds of a thousand to one.
pub(crate) const SURE_BITS: f64 = 10.0;
/// The most bits in favour of a layout that the presses at one place may have. One place is never enough.
const PRESS_BITS: f64 = 8.0;
/// The most bits against it.
const AGAINST_BITS: f64 = 6.0;
/// A constant byte that nothing predicts.
pub(crate) const CONSTANT_BITS: f64 = 8.0;
/// Another constant byte of 0, which pads.
pub(crate) const ZERO_BITS: f64 = 6.0;
/// What is known beforehand, but for whether it is there.
pub(crate) const EXPECTED_BITS: f64 = 1.0;
/// That a board sends a byte of which nothing is known: one like a checksum, and one like a taxel.
pub(crate) const UNKNOWN_BITS: f64 = 4.0;
pub(crate) const UNKNOWN_TAXEL_BITS: f64 = 12.0;
/// That a taxel changes as a checksum does.
pub(crate) const RESTLESS_TAXEL_BITS: f64 = 12.0;
/// That a taxel has several numbers, each more.
pub(crate) const CHANNEL_BITS: f64 = 8.0;
/// That each second row runs the other way.
pub(crate) const SERPENTINE_BITS: f64 = 4.0;
/// That the last binary digit of all numbers is not used.
pub(crate) const UNUSED_DIGIT_BITS: f64 = 2.0;

/// The most numbers of one taxel.
pub(crate) const MOST_CHANNELS: usize = 4;
/// The most arrays in a stack.
const MOST_STACKED: usize = 4;
/// By so many bits, numbers at an end of the cells are likelier alone than a taxel.
pub(crate) const ALONE_BITS: f64 = 2.0;
/// The longest row that is tried.
const LONGEST_ROW: usize = 128;
/// What is left of a prediction is about this share of what goes on around, ...
const LEFT_OF_AROUND: f32 = 0.1;
/// ... and of how far the cells are from rest, for taxels differ.
const LEFT_OF_OWN: f32 = 0.1;
/// How far from rest a byte beside the cells usually is, and by how much it moves, in steps.
const STEP: f32 = 1.0;
/// What goes on around is noise up to so many times the noise at rest.
const NOISE: f32 = 4.0;

/// The bits of a whole number by a Cauchy distribution of this width, which has no surprise that is too
/// large.
fn bits(left: f32, width: f32) -> f32 {
    const PI: f32 = std::f32::consts::PI;
    let width = width.max(1.0 / PI);
    (PI * (width + left * left / width)).log2()
}

/// The bits of a number of which two predictions are as likely.
fn either(one: f32, other: f32) -> f32 {
    1.0 + one.min(other) - (1.0 + (-(one - other).abs()).exp2()).log2()
}

/// The bits of each press, if the cells are rows of `cols` taxels of `channels` numbers each: the sums of [`stacked`].
pub(crate) fn rows(pictures: &Pictures, cols: usize, channels: usize) -> Vec<f64> {
    sums(&stacked(pictures, cols, channels, usize::MAX))
}

/// The bits of all cells of each press.
pub(crate) fn sums(presses: &[Vec<f64>]) -> Vec<f64> {
    presses.iter().map(|press| press.iter().sum()).collect()
}

/// The bits of each press and cell in its first frame, if the cells are rows of `cols` taxels of `channels` numbers
/// each, in an array or in a stack of arrays of `rows` rows. A cell is predicted to be like those before it and above
/// it, or to be at rest, beside an edge of what presses: both are as likely. Where little goes on around, it is at
/// rest. All moments of a press count as one.
fn stacked(pictures: &Pictures, cols: usize, channels: usize, rows: usize) -> Vec<Vec<f64>> {
    let width = cols * channels;
    let noise = pictures.noise;
    let of_cell = |change: &[f32], at: usize| {
        let place = at % width;
        let back = |by: usize| change[at - by];
        let (has_west, has_north) = (place >= channels, !(at / width).is_multiple_of(rows));
        let west = if has_west { back(channels) } else { 0.0 };
        let north = if has_north { back(width) } else { 0.0 };
        let east = if has_north && place + channels < width {
            back(width - channels)
        } else {
            north
        };
        let (predicted, around) = match (has_west, has_north) {
            (true, true) => {
                let corner = back(width + channels);
                let around = (west - corner).abs() + (north - corner).abs() + (north - east).abs();
                // Between the two, on the slope of the row above.
                let between = (west + north) / 2.0 + (east - corner) / 4.0;
                (between.round(), around)
            }
            (true, false) => {
                let before = if place >= 2 * channels {
                    back(2 * channels)
                } else {
                    0.0
                };
                (west, 2.0 * (west - before).abs())
            }
            _ => (north, 2.0 * (north - east).abs()),
        };
        let own = west.abs() + north.abs();
        if around + own <= NOISE * noise {
            return bits(change[at], noise);
        }
        let width = LEFT_OF_AROUND * around + LEFT_OF_OWN * own / 2.0 + noise;
        either(bits(change[at] - predicted, width), bits(change[at], noise))
    };
    let of_press = |press: &Vec<Picture>| -> Vec<f64> {
        let mut cells = vec![0.0; pictures.changes.len()];
        for at in pictures.changing() {
            let bits = press.iter().map(|picture| of_cell(&picture.change, at));
            cells[at] = f64::from(bits.sum::<f32>()) / press.len() as f64;
        }
        cells
    };
    pictures.presses.iter().map(of_press).collect()
}

/// How much cells differ on average from those `by` places before them in the same row.
pub(crate) fn difference(pictures: &Pictures, cols: usize, by: usize) -> f64 {
    let (mut sum, mut count) = (0.0, 0_usize);
    for Picture { change, .. } in pictures.presses.iter().flatten() {
        for at in pictures.changing().filter(|at| at % cols >= by) {
            sum += f64::from((change[at] - change[at - by]).abs());
            count += 1;
        }
    }
    sum / count.max(1) as f64
}

/// The bits of each press in its later frames, whatever the shape of the array and how many numbers a taxel
/// has.
pub(crate) fn later(pictures: &Pictures) -> Vec<f64> {
    let of_picture = |picture: &Picture| -> f64 {
        let cells = pictures.changing();
        cells.map(|at| later_bits(pictures, picture, at)).sum()
    };
    let of_press = |press: &Vec<Picture>| press.iter().map(of_picture).sum();
    pictures.presses.iter().map(of_press).collect()
}

/// The bits of a cell in a later frame. It is predicted to stay, as nearly as the one before it did.
fn later_bits(pictures: &Pictures, Picture { change, before }: &Picture, at: usize) -> f64 {
    let west = at.checked_sub(1).map_or(0.0, |at| change[at] - before[at]);
    let width = LEFT_OF_AROUND * west.abs() + LEFT_OF_OWN * before[at].abs() + pictures.noise;
    bits(change[at] - before[at], width).into()
}

/// The bits of each press and cell in its first frame, if cells have nothing to do with those around them. A
/// cell is about as far from rest as in the other presses, and, as if that were one more, as all cells are.
pub(crate) fn alone(pictures: &Pictures) -> Vec<Vec<f64>> {
    let cells = pictures.changing().count().max(1) as f32;
    let all: f32 = pictures
        .presses
        .iter()
        .map(|press| {
            let far = pictures.changing();
            far.map(|at| mean(press, &|picture| picture.change[at]))
                .sum::<f32>()
        })
        .sum();
    let usual = all / (pictures.presses.len() as f32 * cells);
    of_changing(pictures, |at| {
        as_in_others(pictures, usual, pictures.noise, &|picture| {
            picture.change[at]
        })
    })
}

/// The bits of each press and byte beside the cells, of which nothing is known. It is about as far from rest as in the
/// other presses, and moves as much in each frame. Bytes near it have nothing to do with it.
pub(crate) fn unknown(pictures: &Pictures) -> Vec<Vec<f64>> {
    of_changing(pictures, |at| {
        let far = as_in_others(pictures, STEP, 0.0, &|picture| picture.change[at]);
        let moved = as_in_others(pictures, STEP, 0.0, &|picture| {
            picture.change[at] - picture.before[at]
        });
        let of_press =
            |(press, (far, moved)): (&Vec<Picture>, (f32, f32))| far + moved * press.len() as f32;
        let moves = far.into_iter().zip(moved);
        pictures.presses.iter().zip(moves).map(of_press).collect()
    })
}

/// By press, the bits of each cell: what `of` says of one that changes, a number a press, and 0 for the others.
fn of_changing(pictures: &Pictures, of: impl Fn(usize) -> Vec<f32>) -> Vec<Vec<f64>> {
    let mut bits = vec![vec![0.0; pictures.changes.len()]; pictures.presses.len()];
    for at in pictures.changing() {
        for (bits, of_press) in bits.iter_mut().zip(of(at)) {
            bits[at] = of_press.into();
        }
    }
    bits
}

/// The mean size of a value in the pictures of a press.
fn mean(press: &[Picture], of: &impl Fn(&Picture) -> f32) -> f32 {
    press.iter().map(|picture| of(picture).abs()).sum::<f32>() / press.len() as f32
}

/// The bits of a value in a picture of each press, if it is about as large as in the other presses and, as if that were
/// one more, as is `usual`.
fn as_in_others(
    pictures: &Pictures,
    usual: f32,
    noise: f32,
    of: &impl Fn(&Picture) -> f32,
) -> Vec<f32> {
    let presses = &pictures.presses;
    let means: Vec<f32> = presses.iter().map(|press| mean(press, of)).collect();
    let all: f32 = means.iter().sum();
    let of_press = |(press, mean): (&Vec<Picture>, f32)| {
        let width = (all - mean + usual) / presses.len() as f32 + noise;
        let sum: f32 = press.iter().map(|picture| bits(of(picture), width)).sum();
        sum / press.len() as f32
    };
    presses.iter().zip(means).map(of_press).collect()
}

/// The bits by which one is more than the other, press by press.
#[derive(Debug, Clone, Default)]
pub(crate) struct Score {
    /// The bits of each press.
    pub(crate) presses: Vec<f64>,
    /// How much each press counts, by its pictures.
    pub(crate) weights: Vec<f64>,
    /// The bits of all that is coded once.
    pub(crate) once: f64,
}

impl Score {
    pub(crate) fn bits(&self) -> f64 {
        self.once + self.presses.iter().sum::<f64>()
    }

    /// Whether this one is surely likelier than `other`. However much a press is in favour, it is one. All bits say so
    /// too: of noise that passes for presses, some are in favour of anything.
    pub(crate) fn is_surely_less(&self, other: &Self) -> bool {
        let is_less = other.bits() - self.bits() >= SURE_BITS;
        is_less && other.once - self.once + self.lead_of_presses(other) >= SURE_BITS
    }

    /// Whether this one is surely likelier than `other`, whose cells are the same but for a few at the ends.
    pub(crate) fn is_surely_before(&self, other: &Self) -> bool {
        other.once - self.once + self.lead_of_presses(other) >= SURE_BITS
    }

    fn lead_of_presses(&self, other: &Self) -> f64 {
        lead(&self.presses, &other.presses, &self.weights)
    }
}

/// By how many bits presses are in favour of what has the bits `own` rather than `other`.
fn lead(own: &[f64], other: &[f64], weights: &[f64]) -> f64 {
    let presses = own.iter().zip(other).zip(weights);
    presses
        .map(|((own, other), weight)| weight * (other - own).clamp(-AGAINST_BITS, PRESS_BITS))
        .sum()
}

/// The number of taxels in a row that explains the presses about as well as `cols`. Rows that make no array must be
/// likelier: in packets, or where other numbers are behind an array, the right ones make none.
pub(crate) fn other_row(pictures: &Pictures, cols: usize, channels: usize) -> Option<usize> {
    let own = rows(pictures, cols, channels);
    let taxels = pictures.changes.len() / channels;
    let is_likely = |&other: &usize| {
        let is_array = taxels.is_multiple_of(other);
        lead(&own, &rows(pictures, other, channels), &pictures.weights)
            < if is_array { SURE_BITS } else { 0.0 }
    };
    (2..=(taxels / 2).min(LONGEST_ROW)).find(|other| *other != cols && is_likely(other))
}

/// The number of arrays, such as one for each axis of a force, whose stack surely explains the presses better than one
/// array: where one ends, the next does not go on.
pub(crate) fn stack(
    pictures: &Pictures,
    Array { rows, cols }: Array,
    channels: usize,
) -> Option<usize> {
    let own = self::rows(pictures, cols, channels);
    let is_stack = |count: &usize| {
        let bits = sums(&stacked(pictures, cols, channels, rows / count));
        // The three axes of a force are the likeliest stack.
        let are_axes = *count == 3;
        let most = if are_axes { 0.0 } else { -SURE_BITS };
        are_axes && pictures.are_stacked(*count) || lead(&own, &bits, &pictures.weights) < most
    };
    (2..=MOST_STACKED).find(|count| rows.is_multiple_of(*count) && rows > *count && is_stack(count))
}

/// By how many bits the number `at` an end of the cells acts as its neighbours in rows do, rather than as one alone.
pub(crate) fn as_neighbour(pictures: &Pictures, cols: usize, channels: usize, at: usize) -> f64 {
    let of = |cells: &[Vec<f64>]| -> Vec<f64> { cells.iter().map(|press| press[at]).collect() };
    let own = of(&stacked(pictures, cols, channels, usize::MAX));
    lead(&own, &of(&alone(pictures)), &pictures.weights)
}

/// A cell near another one.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Near {
    /// Its value at rest.
    pub(crate) rest: u8,
    /// Whether it is always the same where nothing presses.
    pub(crate) is_still: bool,
    /// Whether it is always the same.
    pub(crate) is_constant: bool,
}

/// The share of the cells near a still one that are still, of those near one that never changes that never
/// do, of those near one that changes, and of those that may have any value at rest.
const AS_STILL: f64 = 0.95;
const AS_CONSTANT: f64 = 0.8;
const STILL_CONSTANT: f64 = 0.25;
const ANY_VALUE: f64 = 0.005;

/// The bits of a cell that is always `value`, by the cells near it.
pub(crate) fn resting(value: u8, near: &[Near]) -> f64 {
    if near.is_empty() {
        return CONSTANT_BITS;
    }
    let mut values: Vec<u8> = near.iter().map(|near| near.rest).collect();
    values.sort_unstable();
    let median = values[values.len() / 2];
    let deviation = values
        .iter()
        .map(|value| f64::from(value.abs_diff(median)))
        .sum::<f64>()
        / values.len() as f64;
    // A cell is about as far from one near it as these are from each other.
    let width = (0.3 + 0.4 * deviation).max(2.0 / std::f64::consts::PI);
    let likelihood = |near: &Near| {
        let apart = f64::from(near.rest.abs_diff(value)) / width;
        let still = if near.is_still {
            AS_STILL
        } else {
            1.0 - AS_STILL
        };
        let constant = if near.is_constant {
            AS_CONSTANT
        } else {
            STILL_CONSTANT
        };
        still * constant * 2.0 / (std::f64::consts::PI * width * (1.0 + apart * apart).powi(2))
    };
    let mean = near.iter().map(likelihood).sum::<f64>() / near.len() as f64;
    -((1.0 - ANY_VALUE) * mean + ANY_VALUE / 256.0).log2()
}
