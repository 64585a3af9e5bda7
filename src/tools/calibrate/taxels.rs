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

/// The two sides of a comparison.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Compared {
    /// A taxel and its two neighbours on opposite sides, as places in the frame.
    Trio(usize, [usize; 2]),
    /// A taxel and the array's median.
    Array(usize),
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
    /// Taxels that read nothing while all their neighbours did, `[row, col]`.
    pub(super) dead: Vec<[usize; 2]>,
}

/// A taxel is loaded well from this force on: five counts of 0.04 N.
const LEAST_N: f32 = 0.2;
/// The pressure on an array is even if this share of its taxels is loaded well.
const EVEN_SHARE: f64 = 0.9;
/// A taxel is dead if it reads nothing in this share of the presses around it.
const DEAD_SHARE: f64 = 0.5;
/// The least number of presses around a taxel that can show that it is dead.
const DEAD_PRESSES: usize = 3;
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
        let dead = places
            .iter()
            .filter(|&&p| !is_dead[p] && looks_dead(presses, array, &is_dead, p));
        let position = |&place: &usize| <[usize; 2]>::from(array.position(place));
        Ok(Self {
            gains: places.iter().map(|&p| (-logs[p]).exp() as f32).collect(),
            presses: places.iter().map(|&p| reached[p]).collect(),
            even: presses
                .iter()
                .filter(|press| is_even(press, array, &is_dead))
                .count(),
            spread: deviation(own),
            error: 0.5 * deviation(apart),
            dead: dead.map(position).collect(),
        })
    }
}

/// The logarithm of each taxel's sensitivity, with a mean of 0, and the number of presses in which
/// each taxel was compared.
fn solve(presses: &[&Plain], array: Array, is_dead: &[bool]) -> (Vec<f64>, Vec<usize>) {
    let (rows, noise) = compare(presses, array, is_dead);
    let mut reached = vec![0; array.taxels()];
    for row in &rows {
        let (Compared::Trio(place, _) | Compared::Array(place)) = row.compared;
        reached[place] = reached[place].max(row.presses);
    }
    // With D the comparisons, W their weights, y their values and s the expected spread:
    // (D' W D + 1/s^2) logs = D' W y.
    let weight = |row: &Row| {
        let always = match row.compared {
            Compared::Trio(..) => UNEVEN,
            Compared::Array(_) => EVEN,
        };
        1.0 / (noise * noise / row.presses as f64 + always * always)
    };
    let across = |logs: &[f64], compared: Compared| match compared {
        Compared::Trio(place, [one, other]) => logs[place] - 0.5 * (logs[one] + logs[other]),
        Compared::Array(place) => logs[place],
    };
    let back = |into: &mut [f64], compared: Compared, value: f64| match compared {
        Compared::Trio(place, sides) => {
            into[place] += value;
            sides.iter().for_each(|&side| into[side] -= 0.5 * value);
        }
        Compared::Array(place) => into[place] += value,
    };
    let prior = 1.0 / (EXPECTED_SPREAD * EXPECTED_SPREAD);
    let apply = |logs: &[f64]| {
        let mut applied: Vec<f64> = logs.iter().map(|log| prior * log).collect();
        for row in &rows {
            back(
                &mut applied,
                row.compared,
                weight(row) * across(logs, row.compared),
            );
        }
        applied
    };
    let mut wanted = vec![0.0; array.taxels()];
    for row in &rows {
        back(&mut wanted, row.compared, weight(row) * row.value);
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
    let trios = trios(array, is_dead);
    let mut values: Vec<Vec<f64>> = vec![Vec::new(); trios.len()];
    let mut evens: Vec<Vec<f64>> = vec![Vec::new(); array.taxels()];
    for press in presses {
        let even = is_even(press, array, is_dead);
        let frames = press.frames.iter();
        let loaded: Vec<Vec<f64>> = frames.map(|frame| logs(frame)).collect();
        let mut own = Vec::new();
        for (&(place, sides), values) in trios.iter().zip(&mut values) {
            own.clear();
            own.extend(loaded.iter().filter_map(|logs| {
                let value = logs[place] - 0.5 * (logs[sides[0]] + logs[sides[1]]);
                value.is_finite().then_some(value)
            }));
            values.extend(median(&mut own));
        }
        if !even {
            continue;
        }
        let middles: Vec<f64> = loaded
            .iter()
            .map(|logs| {
                let mut well: Vec<f64> = (0..array.taxels()).map(|p| logs[p]).collect();
                well.retain(|log| log.is_finite());
                median(&mut well).unwrap_or(f64::NAN)
            })
            .collect();
        for place in (0..array.taxels()).filter(|&place| !is_dead[place]) {
            let values = loaded
                .iter()
                .zip(&middles)
                .map(|(logs, middle)| logs[place] - middle);
            let mut values: Vec<f64> = values.filter(|value| value.is_finite()).collect();
            evens[place].extend(median(&mut values));
        }
    }
    let mut rows = Vec::new();
    let mut rests = Vec::new();
    let mut add = |compared, mut values: Vec<f64>| {
        let presses = values.len();
        if let Some(value) = median(&mut values) {
            if presses > 2 {
                rests.extend(values.iter().map(|one| (one - value).abs()));
            }
            rows.push(Row {
                compared,
                value,
                presses,
            });
        }
    };
    for (&(place, sides), values) in trios.iter().zip(values) {
        add(Compared::Trio(place, sides), values);
    }
    for (place, values) in evens.into_iter().enumerate() {
        add(Compared::Array(place), values);
    }
    // A dome is higher in its middle than around it, wherever it is. So remove the median over all
    // trios.
    let is_trio = |row: &&mut Row| matches!(row.compared, Compared::Trio(..));
    let mut curved: Vec<f64> = rows
        .iter()
        .filter(|r| matches!(r.compared, Compared::Trio(..)))
        .map(|r| r.value)
        .collect();
    let curved = median(&mut curved).unwrap_or(0.0);
    rows.iter_mut()
        .filter(is_trio)
        .for_each(|row| row.value -= curved);
    // In a normal distribution, the median distance from the median is 0.6745 standard deviations.
    let noise = median(&mut rests).map_or(LEAST_NOISE, |rest| (rest / 0.6745).max(LEAST_NOISE));
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

/// Every live taxel between two live ones, along rows and columns.
fn trios(array: Array, is_dead: &[bool]) -> Vec<(usize, [usize; 2])> {
    let mut trios = Vec::new();
    for row in 0..array.rows {
        for col in 0..array.cols {
            if row > 0 && row + 1 < array.rows {
                let sides = [array.place(row - 1, col), array.place(row + 1, col)];
                trios.push((array.place(row, col), sides));
            }
            if col > 0 && col + 1 < array.cols {
                let sides = [array.place(row, col - 1), array.place(row, col + 1)];
                trios.push((array.place(row, col), sides));
            }
        }
    }
    trios.retain(|&(place, [one, other])| !is_dead[place] && !is_dead[one] && !is_dead[other]);
    trios
}

/// Whether a press loads the whole array.
fn is_even(press: &Plain, array: Array, is_dead: &[bool]) -> bool {
    let live = || (0..array.taxels()).filter(|&place| !is_dead[place]);
    press.frames.iter().any(|frame| {
        let well = live().filter(|&place| frame[place] >= LEAST_N).count();
        well as f64 >= EVEN_SHARE * live().count() as f64
    })
}

/// Whether a taxel reads nothing while all its live neighbours along its row and column are loaded
/// well.
fn looks_dead(presses: &[Plain], array: Array, is_dead: &[bool], place: usize) -> bool {
    let (row, col) = array.position(place);
    let beside = [
        (row.wrapping_sub(1), col),
        (row + 1, col),
        (row, col.wrapping_sub(1)),
        (row, col + 1),
    ];
    let beside = beside
        .into_iter()
        .filter(|&(r, c)| r < array.rows && c < array.cols);
    let beside: Vec<usize> = beside
        .map(|(r, c)| array.place(r, c))
        .filter(|&p| !is_dead[p])
        .collect();
    let (mut around, mut silent) = (0, 0);
    for press in presses {
        let is_around = |frame: &&Vec<f32>| beside.iter().all(|&p| frame[p] >= LEAST_N);
        let mut frames = press.frames.iter().filter(is_around).peekable();
        if frames.peek().is_some() {
            around += 1;
            silent += usize::from(frames.all(|frame| frame[place] <= 0.0));
        }
    }
    around >= DEAD_PRESSES && silent as f64 >= DEAD_SHARE * around as f64
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

fn median(values: &mut [f64]) -> Option<f64> {
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
