//! Computes newtons per count from known weights on the sensor.
//!
//! A weight of N newtons gives c1, c2, ... counts on the taxels, so N = a (c1^e + c2^e + ...). With
//! e = 1, this is a line whose a is `newtons_per_count`. Film arrays are often nearer to another
//! power.

use super::gather::Press;
use crate::tare;

/// The values that known weights give.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Fit {
    /// Each weight, and the sensor's reading of it with the values below, in newtons.
    pub(super) weights: Vec<(f64, f64)>,
    pub(super) newtons_per_count: f64,
    /// The least and the greatest `newtons_per_count` of single weights.
    pub(super) alone: [f64; 2],
    pub(super) exponent: f64,
    /// Root mean square error of a line, as a part of the weight.
    pub(super) line_error: f64,
    /// The best exponent and the error that it leaves, if the weights can determine an exponent.
    pub(super) power: Option<(f64, f64)>,
}

/// The reason why weights give no values.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Unfit {
    /// A press shows no force.
    #[error("press {press}, of {newtons} N, shows no force: was the weight on the sensor?")]
    Nothing {
        /// The number of the press, from 1.
        press: usize,
        /// The weight in newtons.
        newtons: f64,
    },
}

/// The weight is at rest while the sum of counts has at least this share of its maximum.
const RESTING_SHARE: f64 = 0.8;
/// An exponent needs at least this number of different weights.
const LEAST_WEIGHTS: usize = 3;
/// For an exponent, the heaviest weight must be at least this many times the lightest.
const LEAST_RATIO: f64 = 2.0;
/// No exponent is proposed if the relative error of a line is at most this.
const LEAST_ERROR: f64 = 0.02;
/// The exponent must leave less than this share of the line's error.
const MOST_LEFT: f64 = 0.5;
/// The step between the exponents that are tried.
const STEP: f64 = 0.01;

impl Fit {
    /// Computes the values from `weights` in newtons, each with its press. `settings` are those
    /// with which the presses were recorded.
    pub(super) fn of(weights: &[(f64, &Press)], settings: &tare::Settings) -> Result<Self, Unfit> {
        let mut resting = Vec::with_capacity(weights.len());
        for (press, (newtons, frames)) in (1..).zip(weights) {
            let counts = rest(frames, settings);
            if counts.is_empty() {
                let newtons = *newtons;
                return Err(Unfit::Nothing { press, newtons });
            }
            resting.push((*newtons, counts));
        }
        let (_, line_error) = scale(&resting, 1.0);
        let (lightest, heaviest) = resting
            .iter()
            .fold((f64::MAX, 0.0_f64), |(low, high), one| {
                (low.min(one.0), high.max(one.0))
            });
        let mut different: Vec<f64> = resting.iter().map(|one| one.0).collect();
        different.sort_by(f64::total_cmp);
        different.dedup();
        let says_power = different.len() >= LEAST_WEIGHTS && heaviest >= LEAST_RATIO * lightest;
        let (least, most) = tare::EXPONENTS;
        let tried =
            (0..=((most - least) / STEP).round() as u32).map(|n| least + f64::from(n) * STEP);
        let errors = tried.map(|exponent| (exponent, scale(&resting, exponent).1));
        let power = errors.min_by(|one, other| one.1.total_cmp(&other.1));
        let power = power.filter(|_| says_power);
        let exponent = match power {
            Some((exponent, error))
                if line_error > LEAST_ERROR && error < MOST_LEFT * line_error =>
            {
                exponent
            }
            _ => 1.0,
        };
        let (newtons_per_count, _) = scale(&resting, exponent);
        let alone = resting
            .iter()
            .map(|one| scale(std::slice::from_ref(one), exponent).0);
        let read = |(newtons, counts): &(f64, Vec<f64>)| {
            (*newtons, newtons_per_count * raised(counts, exponent))
        };
        Ok(Self {
            weights: resting.iter().map(read).collect(),
            newtons_per_count,
            alone: [
                alone.clone().fold(f64::INFINITY, f64::min),
                alone.fold(0.0, f64::max),
            ],
            exponent,
            line_error,
            power,
        })
    }
}

/// The counts of one frame of a press: the median frame, by its sum, of those in which the weight
/// is at rest.
fn rest(press: &Press, settings: &tare::Settings) -> Vec<f64> {
    let (a, e) = (
        f64::from(settings.newtons_per_count),
        f64::from(settings.exponent),
    );
    let counts = press.frames.iter().map(|frame| -> Vec<f64> {
        let newtons = frame.iter().filter(|&&newtons| newtons > 0.0);
        newtons
            .map(|&newtons| (f64::from(newtons) / a).powf(1.0 / e))
            .collect()
    });
    let mut counts: Vec<(f64, Vec<f64>)> = counts.map(|c| (c.iter().sum(), c)).collect();
    let most = counts.iter().map(|one| one.0).fold(0.0, f64::max);
    counts.retain(|one| one.0 > 0.0 && one.0 >= RESTING_SHARE * most);
    counts.sort_by(|one, other| one.0.total_cmp(&other.0));
    let middle = counts.len() / 2;
    counts
        .into_iter()
        .nth(middle)
        .map_or_else(Vec::new, |one| one.1)
}

fn raised(counts: &[f64], exponent: f64) -> f64 {
    counts.iter().map(|count| count.powf(exponent)).sum()
}

/// The a that fits the weights best with this exponent, and the root mean square error that is
/// left, as a part of the weight.
fn scale(weights: &[(f64, Vec<f64>)], exponent: f64) -> (f64, f64) {
    let logs = weights
        .iter()
        .map(|(newtons, counts)| (newtons / raised(counts, exponent)).ln());
    let count = weights.len() as f64;
    let mean = logs.clone().sum::<f64>() / count;
    let squares: f64 = logs.map(|log| (log - mean).powi(2)).sum();
    (mean.exp(), (squares / count).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A press of `newtons` over 20 taxels of a film with the values `a` and `e`, as a sensor with
    /// `settings` reads it.
    fn press(newtons: f64, a: f64, e: f64, settings: &tare::Settings) -> Press {
        let shares = (1..=20).map(|n| f64::from(n) / 210.0);
        let read = |count: f64| {
            let read = f64::from(settings.newtons_per_count) * count.powf(settings.exponent.into());
            read as f32
        };
        let frame: Vec<f32> = shares
            .map(|share| read((newtons * share / a).powf(1.0 / e)))
            .collect();
        let half = frame.iter().map(|newtons| 0.5 * newtons).collect();
        Press {
            frames: vec![half, frame.clone(), frame.clone(), frame],
            ..Press::default()
        }
    }

    fn fit(a: f64, e: f64, weights: &[f64], settings: &tare::Settings) -> Fit {
        let presses: Vec<Press> = weights.iter().map(|&n| press(n, a, e, settings)).collect();
        let weights: Vec<(f64, &Press)> = weights.iter().copied().zip(&presses).collect();
        Fit::of(&weights, settings).unwrap()
    }

    #[test]
    fn a_line_is_found_whatever_the_present_settings() {
        for exponent in [1.0, 1.5] {
            let settings = tare::Settings {
                exponent,
                ..tare::Settings::default()
            };
            let fit = fit(0.031, 1.0, &[5.0, 10.0, 20.0], &settings);
            assert!((fit.newtons_per_count - 0.031).abs() < 1e-6, "{fit:?}");
            assert_eq!(fit.exponent, 1.0);
            assert!(fit.line_error < 1e-6 && (fit.alone[1] - fit.alone[0]) < 1e-6);
        }
    }

    #[test]
    fn a_power_law_is_found_where_the_weights_can_say_it() {
        let settings = tare::Settings::default();
        let found = fit(0.01, 1.4, &[2.0, 5.0, 10.0, 20.0], &settings);
        assert!((found.exponent - 1.4).abs() < 0.011, "{found:?}");
        assert!(
            (found.newtons_per_count / 0.01 - 1.0).abs() < 0.05,
            "{found:?}"
        );
        for (newtons, read) in &found.weights {
            assert!((read / newtons - 1.0).abs() < 0.01, "{found:?}");
        }
        // Two different weights cannot determine an exponent.
        assert_eq!(fit(0.01, 1.4, &[2.0, 20.0, 20.0], &settings).exponent, 1.0);
    }

    #[test]
    fn a_press_without_a_weight_is_named() {
        let settings = tare::Settings::default();
        let good = press(5.0, 0.04, 1.0, &settings);
        let none = Press::default();
        let found = Fit::of(&[(5.0, &good), (7.0, &none)], &settings);
        assert_eq!(
            found,
            Err(Unfit::Nothing {
                press: 2,
                newtons: 7.0
            })
        );
    }
}
