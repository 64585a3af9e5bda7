//! What presses do to the cells.
//!
//! In: how much each frame differs from rest, and the numbers of a frame. Out: for each press some
//! pictures, which hold the change of each cell in whole steps.

/// The numbers of some frames in which something presses, by press, and of some in which nothing does.
#[derive(Debug, Clone)]
pub(crate) struct Presses {
    presses: Vec<Vec<usize>>,
    rest: Vec<usize>,
    idle: Vec<usize>,
}

/// The share of the strongest press at which a frame makes a picture.
const STRONG: f64 = 0.12;
/// The most presses, the most pictures of a press, and the most frames that make the rest.
const PRESSES: usize = 16;
const PICTURES: usize = 4;
const RESTS: usize = 15;
/// The most frames with hardly a press.
const IDLE: usize = 60;
/// The correlation from which numbers are alike, and from which presses are at the same place. The square of that
/// with a picture whose cells all change alike from which a press covers the array.
const ALIKE: f64 = 0.9;
const SAME_PLACE: f64 = 0.9;
const COVERING: f64 = 0.8;

impl Presses {
    /// Finds the presses by how much each frame differs from rest. `None` if nothing presses in any.
    pub(crate) fn of(activity: &[u32]) -> Option<Self> {
        let [least, quarter, most] = quantiles(activity)?;
        let mean =
            activity.iter().map(|&value| f64::from(value)).sum::<f64>() / activity.len() as f64;
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
        // Three standard deviations of noise above its mean: the quarter lies two thirds of one below it, and
        // the least some three.
        let noise = (quarter + 2.0 * (quarter - least)).min(over(0.5));
        let is_strong = |frame: &usize| f64::from(activity[*frame]) > over(STRONG).max(noise);
        let strong: Vec<usize> = (0..activity.len()).filter(is_strong).collect();
        let idle: Vec<usize> = (0..activity.len())
            .filter(|frame| !is_strong(frame))
            .collect();
        let moments = |press: &[usize]| -> Vec<usize> {
            let most = press
                .iter()
                .map(|&frame| activity[frame])
                .max()
                .unwrap_or(0);
            // The one before each is in the same press.
            let deep: Vec<usize> = press[1..]
                .iter()
                .copied()
                .filter(|&frame| 2 * activity[frame] > most)
                .collect();
            some(&deep, PICTURES)
        };
        let presses = strong
            .chunk_by(|a, b| a + 1 == *b)
            .map(moments)
            .filter(|press| !press.is_empty());
        let presses: Vec<Vec<usize>> = presses.collect();
        let quiet = quarter.min(over(STRONG / 2.0));
        let rest: Vec<usize> = (0..activity.len())
            .filter(|&frame| f64::from(activity[frame]) <= quiet)
            .collect();
        (!presses.is_empty()).then(|| Self {
            presses: some(&presses, PRESSES),
            rest: some(&rest, RESTS),
            idle: some(&idle, IDLE),
        })
    }

    /// The frames of all presses.
    pub(crate) fn frames(&self) -> impl Iterator<Item = usize> + '_ {
        self.presses.iter().flatten().copied()
    }

    /// Some frames in which nothing presses.
    pub(crate) fn rest(&self) -> impl Iterator<Item = usize> + '_ {
        self.rest.iter().copied()
    }

    /// Some frames with hardly a press, also those that are less quiet than the rest.
    pub(crate) fn idle(&self) -> impl Iterator<Item = usize> + '_ {
        self.idle.iter().copied()
    }
}

/// The least of these, and that above a quarter and above 98 % of them. `None` without any.
pub(crate) fn quantiles(activity: &[u32]) -> Option<[f64; 3]> {
    let mut sorted = activity.to_vec();
    sorted.sort_unstable();
    let last = sorted.len().checked_sub(1)?;
    Some([0, 25, 98].map(|share| f64::from(sorted[last * share / 100])))
}

/// About `most` of `of`, from all over it.
pub(crate) fn some<T: Clone>(of: &[T], most: usize) -> Vec<T> {
    of.iter()
        .cloned()
        .step_by(of.len().div_ceil(most).max(1))
        .collect()
}

/// The pictures of all presses, as a type of cells has them.
#[derive(Debug, Clone)]
pub(crate) struct Pictures {
    pub(crate) presses: Vec<Vec<Picture>>,
    /// How much each press says of the shape of the array: nothing if it covers the array, and as much as all others
    /// at the same place together.
    pub(crate) weights: Vec<f64>,
    /// Whether each cell changes in any of them.
    pub(crate) changes: Vec<bool>,
    /// How far a cell is from rest on average where nothing presses, in steps.
    pub(crate) noise: f32,
    /// The smallest number that all numbers are multiples of, as a power of two.
    pub(crate) step_exponent: i32,
    /// For each press, the bits of a picture that are smaller than a step: of floats that are small.
    pub(crate) below_step_bits: Vec<f64>,
}

/// A moment of a press.
#[derive(Debug, Clone)]
pub(crate) struct Picture {
    /// How far each cell is from rest, in steps.
    pub(crate) change: Vec<f32>,
    /// The same one frame before.
    pub(crate) before: Vec<f32>,
}

/// Whether the sizes of two changes have about the same ratio in all pairs: their correlation.
fn are_alike(pairs: impl Iterator<Item = [f32; 2]>) -> bool {
    let (mut both, mut first, mut second) = (0.0_f64, 0.0_f64, 0.0_f64);
    for pair in pairs {
        let [a, b] = pair.map(|change| f64::from(change.abs()));
        both += a * b;
        first += a * a;
        second += b * b;
    }
    both > ALIKE * (first * second).sqrt()
}

impl Pictures {
    /// The pictures of presses, if `frame` returns the numbers of a frame. `None` if some are none.
    pub(crate) fn of(presses: &Presses, frame: impl Fn(usize) -> Vec<f32>) -> Option<Self> {
        let read = |index: usize| {
            let numbers = frame(index);
            numbers
                .iter()
                .all(|number| number.is_finite())
                .then_some(numbers)
        };
        let rests: Vec<Vec<f32>> = presses
            .rest
            .iter()
            .map(|&index| read(index))
            .collect::<Option<_>>()?;
        let of_press = |press: &Vec<usize>| -> Option<Vec<[Vec<f32>; 2]>> {
            press
                .iter()
                .map(|&index| Some([read(index)?, read(index - 1)?]))
                .collect()
        };
        let pressed: Vec<Vec<[Vec<f32>; 2]>> = presses
            .presses
            .iter()
            .map(of_press)
            .collect::<Option<_>>()?;
        let all: Vec<&Vec<f32>> = rests
            .iter()
            .chain(pressed.iter().flatten().flatten())
            .collect();
        // A constant, such as a mark beside the cells, says nothing of how fine the numbers are.
        let all = &all;
        let varies = |at: &usize| all.iter().any(|numbers| numbers[*at] != all[0][*at]);
        let varying = (0..all[0].len()).filter(varies);
        let digits = Digits::of(varying.flat_map(|at| all.iter().map(move |numbers| numbers[at])));
        let step = 2.0_f32.powi(digits.step());
        let rest = middle(&rests);
        let change = |numbers: &Vec<f32>| -> Vec<f32> {
            numbers
                .iter()
                .zip(&rest)
                .map(|(number, rest)| ((number - rest) / step).round())
                .collect()
        };
        let picture = |[now, before]: &[Vec<f32>; 2]| Picture {
            change: change(now),
            before: change(before),
        };
        let below = |press: &Vec<[Vec<f32>; 2]>| {
            let numbers = press.iter().flat_map(|[now, _]| now);
            let bits: i32 = numbers.map(|&number| digits.below_step(number)).sum();
            // Each is coded by its neighbours, one for all of them, and each by the one before.
            f64::from(bits) * (1.0 + 1.0 / press.len() as f64)
        };
        let below_step_bits = pressed.iter().map(below).collect();
        let presses: Vec<Vec<Picture>> = pressed
            .iter()
            .map(|press| press.iter().map(picture).collect())
            .collect();
        let mut changes = vec![false; rest.len()];
        for Picture { change, before } in presses.iter().flatten() {
            let now = change.iter().zip(before);
            changes
                .iter_mut()
                .zip(now)
                .for_each(|(changes, (a, b))| *changes |= *a != 0.0 || *b != 0.0);
        }
        let far = |numbers: &Vec<f32>| {
            change(numbers)
                .iter()
                .map(|change| change.abs())
                .sum::<f32>()
        };
        let changing = (rests.len() * changes.iter().filter(|changes| **changes).count()).max(1);
        let noise = rests.iter().map(far).sum::<f32>() / changing as f32;
        Some(Self {
            weights: weights(&presses, &changes),
            presses,
            changes,
            noise,
            step_exponent: digits.step(),
            below_step_bits,
        })
    }

    /// The cells that change.
    pub(crate) fn changing(&self) -> impl Iterator<Item = usize> + '_ {
        self.changes
            .iter()
            .enumerate()
            .filter(|(_, changes)| **changes)
            .map(|(at, _)| at)
    }

    /// The picture with the strongest press.
    pub(crate) fn strongest(&self) -> &[f32] {
        let all = self.presses.iter().flatten().map(|picture| &picture.change);
        all.max_by(|a, b| energy(a).total_cmp(&energy(b)))
            .map_or(&[], Vec::as_slice)
    }

    /// Whether the numbers of a taxel are so much alike that they are taxels beside each other: the
    /// correlation of each with the next, in the strongest picture.
    pub(crate) fn are_alike(&self, channels: usize) -> bool {
        let taxels = self.strongest().chunks_exact(channels);
        are_alike(taxels.flat_map(|taxel| taxel.array_windows().copied()))
    }

    /// Whether a press is at the same place in each of so many arrays, one behind the other.
    pub(crate) fn are_stacked(&self, count: usize) -> bool {
        let change = self.strongest();
        let arrays: Vec<&[f32]> = change.chunks_exact(change.len() / count).collect();
        let mut pairs = arrays.array_windows();
        pairs.all(|[a, b]| are_alike(a.iter().zip(*b).map(|(&a, &b)| [a, b])))
    }

    /// The pictures as an array has them whose each second row of `cols` taxels runs the other way.
    pub(crate) fn turned(&self, cols: usize, channels: usize) -> Self {
        let mut turned = self.clone();
        turn(&mut turned.changes, cols, channels);
        for Picture { change, before } in turned.presses.iter_mut().flatten() {
            turn(change, cols, channels);
            turn(before, cols, channels);
        }
        turned
    }

    /// The pictures of each of so many interleaved numbers.
    pub(crate) fn split(&self, channels: usize) -> impl Iterator<Item = Self> + '_ {
        (0..channels).map(move |channel| {
            let of = |picture: &Picture| Picture {
                change: part(&picture.change, channels, channel),
                before: part(&picture.before, channels, channel),
            };
            let presses = self
                .presses
                .iter()
                .map(|press| press.iter().map(of).collect())
                .collect();
            Self {
                presses,
                changes: part(&self.changes, channels, channel),
                ..self.clone()
            }
        })
    }
}

/// The cells of one of so many interleaved numbers.
fn part<T: Copy>(cells: &[T], channels: usize, channel: usize) -> Vec<T> {
    let own = cells.iter().skip(channel).step_by(channels);
    own.copied().collect()
}

/// Turns each second row of `cols` taxels with so many numbers each.
fn turn<T>(cells: &mut [T], cols: usize, channels: usize) {
    for row in cells.chunks_exact_mut(cols * channels).skip(1).step_by(2) {
        row.reverse();
        row.chunks_exact_mut(channels).for_each(<[T]>::reverse);
    }
}

/// How much each press says of the shape of the array.
fn weights(presses: &[Vec<Picture>], changes: &[bool]) -> Vec<f64> {
    let all = changes.iter().map(|&is| f32::from(u8::from(is)));
    let all: Vec<f32> = all.collect();
    let pictures = || presses.iter().map(|press| &press[press.len() / 2].change);
    let of_press = |picture: &Vec<f32>| {
        let here = pictures().filter(|other| alike(picture, other) > SAME_PLACE);
        let is_covering = alike(picture, &all).powi(2) > COVERING;
        f64::from(u8::from(!is_covering)) / here.count().max(1) as f64
    };
    pictures().map(of_press).collect()
}

/// The correlation of two pictures.
fn alike(a: &[f32], b: &[f32]) -> f64 {
    let sum = |a: &[f32], b: &[f32]| -> f64 {
        let products = a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b));
        products.sum()
    };
    sum(a, b) / (sum(a, a) * sum(b, b)).sqrt().max(f64::MIN_POSITIVE)
}

/// How much the cells of a picture change.
pub(crate) fn energy(picture: &[f32]) -> f64 {
    picture.iter().map(|change| f64::from(change.abs())).sum()
}

/// How far the cells of a frame are from rest, all together.
pub(crate) fn distance(frame: &[f32], rest: &[f32]) -> f64 {
    let cells = frame.iter().zip(rest);
    cells
        .map(|(cell, rest)| f64::from((cell - rest).abs()))
        .sum()
}

/// The middle value of each cell.
pub(crate) fn middle(frames: &[Vec<f32>]) -> Vec<f32> {
    let cells = frames.first().map_or(0, Vec::len);
    let value = |cell: usize| {
        let mut values: Vec<f32> = frames.iter().map(|frame| frame[cell]).collect();
        values.sort_by(f32::total_cmp);
        values[values.len() / 2]
    };
    (0..cells).map(value).collect()
}

/// Which binary digits some numbers have, as exponents of two.
#[derive(Debug, Clone, Copy)]
struct Digits {
    highest: i32,
    lowest: i32,
    /// The digits of the fraction of a float that are always 0.
    zeros: i32,
}

/// The digits of an f32 after its first one.
const FRACTION: i32 = 23;

impl Digits {
    fn of(numbers: impl Iterator<Item = f32>) -> Self {
        let mut digits = Self {
            highest: -149,
            lowest: 128,
            zeros: FRACTION,
        };
        for (exponent, zeros) in numbers.filter_map(digits_of) {
            digits.highest = digits.highest.max(exponent);
            digits.lowest = digits.lowest.min(exponent - FRACTION + zeros);
            digits.zeros = digits.zeros.min(zeros);
        }
        digits.lowest = digits.lowest.min(digits.highest.max(0));
        digits
    }

    fn step(self) -> i32 {
        self.lowest.max(self.highest - FRACTION)
    }

    fn below_step(self, number: f32) -> i32 {
        let last = |(exponent, _): (i32, i32)| (exponent - FRACTION + self.zeros).max(self.lowest);
        digits_of(number).map_or(0, |digits| (self.step() - last(digits)).max(0))
    }
}

/// The exponent of a number's first digit, and how many zeros end its fraction. `None` for 0.
fn digits_of(number: f32) -> Option<(i32, i32)> {
    let bits = number.to_bits();
    let exponent = (bits >> FRACTION & 0xFF) as i32 - 127;
    let zeros = (bits & ((1 << FRACTION) - 1))
        .trailing_zeros()
        .min(FRACTION as u32);
    (number != 0.0).then_some((exponent, zeros as i32))
}
