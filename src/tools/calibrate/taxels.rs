//! Computes a gain for each taxel from presses at many places, or from an even pressure.
//!
//! Under a smooth pressure, the logarithm of a taxel's reading is the mean of those of its two
//! neighbours along a row or a column. A difference comes from the gains of the three. Each such
//! trio counts once a press, in the middle of the contact. Under a pressure on the whole array, a
//! taxel is also compared with the array's median. The gains that fit all comparisons best are
//! found by least squares, and drawn towards 1 where there are few presses.

use anyhow::{Result, bail};

use hardnessd_core::frame::Array;

/// A press without gains.
pub(super) struct Plain {
    /// The newtons on each taxel of each frame, as they would read with gains of 1.
    pub(super) frames: Vec<Vec<f32>>,
}

/// A comparison of a taxel with its two neighbours on opposite sides, or with the array's median.
struct Compared {
    /// The place of the taxel in the frame.
    place: usize,
    /// The places of the neighbours. None for the array's median.
    sides: Vec<usize>,
}

impl Compared {
    /// The taxel's logarithm, less the mean of its neighbours'.
    fn across(&self, logs: &[f64]) -> f64 {
        let sides: f64 = self.sides.iter().map(|&side| logs[side]).sum();
        logs[self.place] - sides / self.sides.len().max(1) as f64
    }

    /// Adds what [`Self::across`] times `value` has of each taxel.
    fn back(&self, into: &mut [f64], value: f64) {
        into[self.place] += value;
        for &side in &self.sides {
            into[side] -= value / self.sides.len() as f64;
        }
    }
}

/// One comparison, over all presses.
struct Row {
    compared: Compared,
    /// The median over the presses.
    value: f64,
    presses: usize,
}

/// The gains that presses give.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Fit {
    /// The factor for each taxel's newtons, `[rows, cols]` of the array. 1 where nothing is known.
    pub(super) gains: Vec<f32>,
    /// The number of presses in which each taxel was compared, `[rows, cols]` of the array.
    pub(super) presses: Vec<usize>,
    /// The number of presses that loaded the whole array.
    pub(super) even: usize,
    /// Standard deviation of the logarithm of the gains that were measured.
    pub(super) spread: f64,
    /// The relative error of such a gain: half of the standard deviation of the difference between
    /// two halves of the presses.
    pub(super) error: f64,
}

/// A taxel is loaded well from this force on: five counts of 0.04 N.
const LEAST_N: f32 = 0.2;
/// The pressure on an array is even if this share of its taxels is loaded well.
const EVEN_SHARE: f64 = 0.9;
/// The expected spread of gains (standard deviation of the logarithm). On a public film array it
/// was 0.16 between taxels, 0.03 between rows and 0.055 between columns.
const EXPECTED_SPREAD: f64 = 0.18;
/// The least noise of one press in a comparison.
const LEAST_NOISE: f64 = 0.02;
/// The errors of a comparison with two sides and of one with an even array. They remain however
/// many presses there are, because a pressure is never as smooth as supposed. Any `UNEVEN` from
/// 0.05 to 0.2 changes little for simulated presses. Without it, slow waves over the array would be
/// taken for gains.
const UNEVEN: f64 = 0.1;
const EVEN: f64 = 0.02;
/// The least number of taxels that must have been measured.
const LEAST_TAXELS: usize = 16;
/// The most steps of the method of conjugate gradients. Without rounding, 784 steps would be exact.
const STEPS: usize = 400;

impl Fit {
    /// Computes the gains from presses on `array`. `dead` are the taxels whose newtons are no
    /// measurement.
    pub(super) fn of(presses: &[Plain], array: Array, dead: &[[usize; 2]]) -> Result<Self> {
        let mut is_dead = vec![false; array.taxels()];
        for &[row, col] in dead {
            is_dead[array.place(row, col)] = true;
        }
        let all: Vec<&Plain> = presses.iter().collect();
        let (logs, reached) = solve(&all, array, &is_dead);
        let places: Vec<usize> = (0..array.taxels()).collect();
        let taxels = places.iter().filter(|&&place| !is_dead[place]).count();
        let measured: Vec<usize> = places.iter().copied().filter(|&p| reached[p] > 1).collect();
        if measured.len() < LEAST_TAXELS {
            bail!(
                "only {} of {taxels} taxels were in the middle of two presses or more: press harder, at \
                 more places, or with something wide and soft ({} presses found)",
                measured.len(),
                presses.len()
            );
        }
        let halves = [0, 1].map(|half| {
            let half: Vec<&Plain> = all.iter().copied().skip(half).step_by(2).collect();
            solve(&half, array, &is_dead).0
        });
        let apart = measured.iter().map(|&p| halves[0][p] - halves[1][p]);
        let own = measured.iter().map(|&p| logs[p]);
        Ok(Self {
            gains: places.iter().map(|&p| (-logs[p]).exp() as f32).collect(),
            presses: places.iter().map(|&p| reached[p]).collect(),
            even: presses
                .iter()
                .filter(|press| is_even(press, array, &is_dead))
                .count(),
            spread: deviation(own),
            error: 0.5 * deviation(apart),
        })
    }
}

/// The logarithm of each taxel's sensitivity, with a mean of 0, and the number of presses in which
/// each taxel was compared.
fn solve(presses: &[&Plain], array: Array, is_dead: &[bool]) -> (Vec<f64>, Vec<usize>) {
    let (rows, noise) = compare(presses, array, is_dead);
    let mut reached = vec![0; array.taxels()];
    for row in &rows {
        let reached = &mut reached[row.compared.place];
        *reached = row.presses.max(*reached);
    }
    // With D the comparisons, W their weights, y their values and s the expected spread:
    // (D' W D + 1/s^2) logs = D' W y.
    let weight = |row: &Row| {
        let always = match row.compared.sides.is_empty() {
            true => EVEN,
            false => UNEVEN,
        };
        1.0 / (noise * noise / row.presses as f64 + always * always)
    };
    let prior = 1.0 / (EXPECTED_SPREAD * EXPECTED_SPREAD);
    let apply = |logs: &[f64]| {
        let mut applied: Vec<f64> = logs.iter().map(|log| prior * log).collect();
        for row in &rows {
            let value = weight(row) * row.compared.across(logs);
            row.compared.back(&mut applied, value);
        }
        applied
    };
    let mut wanted = vec![0.0; array.taxels()];
    for row in &rows {
        row.compared.back(&mut wanted, weight(row) * row.value);
    }
    let mut logs = conjugate_gradients(apply, &wanted);
    // The common scale of all taxels belongs to `newtons_per_count`, so remove the mean.
    let measured: Vec<usize> = (0..array.taxels())
        .filter(|&place| reached[place] > 0)
        .collect();
    let mean = measured.iter().map(|&p| logs[p]).sum::<f64>() / measured.len().max(1) as f64;
    measured.iter().for_each(|&place| logs[place] -= mean);
    (logs, reached)
}

/// All comparisons, and the noise of one press in one of them.
fn compare(presses: &[&Plain], array: Array, is_dead: &[bool]) -> (Vec<Row>, f64) {
    let all = comparisons(array, is_dead);
    let mut values: Vec<Vec<f64>> = vec![Vec::new(); all.len()];
    for press in presses {
        let is_even = is_even(press, array, is_dead);
        let loaded: Vec<Vec<f64>> = press.frames.iter().map(|frame| logs(frame)).collect();
        let middle = |logs: &Vec<f64>| median(logs.clone()).unwrap_or(f64::NAN);
        let middles: Vec<f64> = match is_even {
            true => loaded.iter().map(middle).collect(),
            false => vec![f64::NAN; loaded.len()],
        };
        for (compared, values) in all.iter().zip(&mut values) {
            let value = |(logs, middle): (&Vec<f64>, &f64)| {
                let taken = if compared.sides.is_empty() {
                    *middle
                } else {
                    0.0
                };
                compared.across(logs) - taken
            };
            values.extend(median(loaded.iter().zip(&middles).map(value).collect()));
        }
    }
    let mut rows = Vec::new();
    let mut rests = Vec::new();
    for (compared, values) in all.into_iter().zip(values) {
        let presses = values.len();
        let Some(value) = median(values.clone()) else {
            continue;
        };
        if presses > 2 {
            rests.extend(values.iter().map(|one| (one - value).abs()));
        }
        rows.push(Row {
            compared,
            value,
            presses,
        });
    }
    // A dome is higher in its middle than around it, wherever it is. So remove the median over all
    // comparisons with neighbours.
    let has_sides = |row: &&mut Row| !row.compared.sides.is_empty();
    let curved = rows.iter_mut().filter(has_sides).map(|row| row.value);
    let curved = median(curved.collect()).unwrap_or(0.0);
    for row in rows.iter_mut().filter(has_sides) {
        row.value -= curved;
    }
    // In a normal distribution, the median distance from the median is 0.6745 standard deviations.
    let noise = median(rests).map_or(LEAST_NOISE, |rest| (rest / 0.6745).max(LEAST_NOISE));
    (rows, noise)
}

/// The logarithm of each taxel's newtons. NaN where the taxel is not loaded well.
fn logs(frame: &[f32]) -> Vec<f64> {
    let log = |&newtons: &f32| match newtons >= LEAST_N {
        true => f64::from(newtons).ln(),
        false => f64::NAN,
    };
    frame.iter().map(log).collect()
}

/// Every live taxel between two live ones, along rows and columns, and every one beside the array.
fn comparisons(array: Array, is_dead: &[bool]) -> Vec<Compared> {
    let mut all = Vec::new();
    for place in 0..array.taxels() {
        let (row, col) = array.position(place);
        let mut sides = vec![Vec::new()];
        if row > 0 && row + 1 < array.rows {
            sides.push(vec![array.place(row - 1, col), array.place(row + 1, col)]);
        }
        if col > 0 && col + 1 < array.cols {
            sides.push(vec![array.place(row, col - 1), array.place(row, col + 1)]);
        }
        all.extend(sides.into_iter().map(|sides| Compared { place, sides }));
    }
    all.retain(|one| !is_dead[one.place] && !one.sides.iter().any(|&side| is_dead[side]));
    all
}

/// Whether a press loads the whole array.
fn is_even(press: &Plain, array: Array, is_dead: &[bool]) -> bool {
    let live = || (0..array.taxels()).filter(|&place| !is_dead[place]);
    press.frames.iter().any(|frame| {
        let well = live().filter(|&place| frame[place] >= LEAST_N).count();
        well as f64 >= EVEN_SHARE * live().count() as f64
    })
}

/// Solves `apply(x) = wanted` for a symmetric positive `apply`.
fn conjugate_gradients(apply: impl Fn(&[f64]) -> Vec<f64>, wanted: &[f64]) -> Vec<f64> {
    let dot =
        |one: &[f64], other: &[f64]| -> f64 { one.iter().zip(other).map(|(a, b)| a * b).sum() };
    let mut found = vec![0.0; wanted.len()];
    let mut rest = wanted.to_vec();
    let mut direction = rest.clone();
    let mut square = dot(&rest, &rest);
    let enough = 1e-16 * square;
    for _ in 0..STEPS {
        if square <= enough {
            break;
        }
        let applied = apply(&direction);
        let step = square / dot(&direction, &applied);
        for place in 0..found.len() {
            found[place] += step * direction[place];
            rest[place] -= step * applied[place];
        }
        let next = dot(&rest, &rest);
        let turn = next / square;
        square = next;
        for (direction, rest) in direction.iter_mut().zip(&rest) {
            *direction = rest + turn * *direction;
        }
    }
    found
}

/// The median of the numbers that are finite.
fn median(mut values: Vec<f64>) -> Option<f64> {
    values.retain(|value| value.is_finite());
    values.sort_by(f64::total_cmp);
    let middle = values.len() / 2;
    match values.len() {
        0 => None,
        odd if odd % 2 == 1 => Some(values[middle]),
        _ => Some(0.5 * (values[middle - 1] + values[middle])),
    }
}

fn deviation(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let count = values.clone().count().max(1) as f64;
    let mean = values.clone().sum::<f64>() / count;
    (values.map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt()
}

#[cfg(test)]
mod tests;
