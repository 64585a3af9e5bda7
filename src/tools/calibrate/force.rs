//! Computes newtons per count from known weights on the sensor.
//!
//! A weight of N newtons gives c1, c2, ... counts on taxels with the gains g1, g2, ..., so
//! N = a (g1 c1^e + g2 c2^e + ...). With e = 1, this is a line whose a is `newtons_per_count`. Film
//! arrays are often nearer to another power. Noise is as often negative as positive, so the counts
//! keep their sign, and each is the mean over the frames in which the weight rests.

use anyhow::{Result, bail, ensure};

use super::gather::Press;
use hardnessd_core::frame::{Frame, RawFrame};
use hardnessd_core::line::extent;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::tare::{self, Tare};

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

/// A weight at rest on the sensor.
struct Weight {
    newtons: f64,
    /// The mean counts of the taxels under it, above their baseline or below it. 0 elsewhere.
    counts: RawFrame,
    /// The settings of the sensor. A taxel that was dead in the recording is dead in them too.
    settings: tare::Settings,
}

/// The weight is at rest while the sum of counts has at least this share of its maximum.
const RESTING_SHARE: f64 = 0.8;
/// The part of these frames, by their sums, that is left out at either end: the weight was still
/// being put on or taken off.
const LEFT_OUT: f64 = 0.25;
/// The weight is on the taxels with at least this share of the greatest force on one, and on those
/// around them. The present scale may be far off, so no threshold in newtons can say it. Nor is it on taxels that read no
/// more above 0 than others read below: that is noise.
const ON_SHARE: f32 = 0.05;
/// An exponent needs at least this number of different weights.
const LEAST_WEIGHTS: usize = 4;
/// For an exponent, the heaviest weight must be at least this many times the lightest.
const LEAST_RATIO: f64 = 2.0;
/// No exponent is proposed if the relative error of a line is at most this.
const LEAST_ERROR: f64 = 0.02;
/// The exponent must leave less than this share of the line's error.
const MOST_LEFT: f64 = 0.5;
/// With a larger error of a weight, the values would be worth nothing.
const MOST_ERROR: f64 = 0.2;
/// The step between the exponents that are tried.
const STEP: f64 = 0.01;

impl Fit {
    /// Computes the values from `weights` in newtons, each with its press. The values are for the
    /// gains and the dead taxels of `sensor`.
    pub(super) fn of(weights: &[(f64, &Press)], sensor: &Sensor) -> Result<Self> {
        let mut resting = Vec::with_capacity(weights.len());
        for (press, &(newtons, recorded)) in (1..).zip(weights) {
            ensure!(
                !recorded.saturated,
                "press {press}, of {newtons} N, reaches full scale on a taxel: put the weight on more \
                 taxels, or take a lighter one"
            );
            let weight = Weight::of(newtons, recorded, sensor);
            ensure!(
                weight.counts.counts.iter().any(|&counts| counts != 0.0),
                "press {press}, of {newtons} N, shows no force: was the weight on the sensor?"
            );
            resting.push(weight);
        }
        let (_, line_error) = scale(&resting, 1.0);
        let mut different: Vec<f64> = resting.iter().map(|one| one.newtons).collect();
        different.sort_by(f64::total_cmp);
        different.dedup();
        let shows_power = different.len() >= LEAST_WEIGHTS
            && different[different.len() - 1] >= LEAST_RATIO * different[0];
        let (least, most) = tare::EXPONENTS;
        let tried =
            (0..=((most - least) / STEP).round() as u32).map(|n| least + f64::from(n) * STEP);
        let errors = tried.map(|exponent| (exponent, scale(&resting, exponent).1));
        let power = errors.min_by(|one, other| one.1.total_cmp(&other.1));
        let power = power.filter(|_| shows_power);
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
        let read = |one: &Weight| (one.newtons, newtons_per_count * one.read(exponent));
        let weights: Vec<(f64, f64)> = resting.iter().map(read).collect();
        check(weights.clone())?;
        Ok(Self {
            weights,
            newtons_per_count,
            alone: extent(alone),
            exponent,
            line_error,
            power,
        })
    }

    /// Root mean square error of the proposed values, as a part of the weight.
    pub(super) fn error(&self) -> f64 {
        match self.power {
            Some((exponent, error)) if exponent == self.exponent => error,
            _ => self.line_error,
        }
    }
}

/// Checks that readings grow with their weights, and that each is near its weight.
fn check(mut weights: Vec<(f64, f64)>) -> Result<()> {
    weights.sort_by(|one, other| one.0.total_cmp(&other.0));
    for pair in weights.windows(2) {
        let [(light, less), (heavy, more)] = [pair[0], pair[1]];
        if heavy > light && more < less {
            bail!(
                "the weight of {heavy} N gives fewer counts than that of {light} N: was each weight on \
                 the sensor when its turn was?"
            );
        }
    }
    let error = |&(newtons, read): &(f64, f64)| (read / newtons - 1.0).abs();
    let worst = weights
        .iter()
        .max_by(|one, other| error(one).total_cmp(&error(other)));
    if let Some(&(newtons, read)) = worst.filter(|weight| error(weight) > MOST_ERROR) {
        bail!(
            "the weights do not fit one law: that of {newtons} N would read {read:.1} N. Put all weights \
             on the same foot and repeat it; with four weights or more, a curve is tried too"
        );
    }
    Ok(())
}

impl Weight {
    /// The weight of a press: the mean over the frames in which it rests.
    fn of(newtons: f64, press: &Press, sensor: &Sensor) -> Self {
        let recorded = &press.calibration;
        let array = sensor.layout().array();
        let mut settings = sensor.calibration().clone();
        settings.dead_taxels.extend(&recorded.dead_taxels);
        // The newtons of a dead taxel are no measurement.
        let mut frames = press.without_gains();
        for &[row, col] in &settings.dead_taxels {
            frames
                .iter_mut()
                .for_each(|frame| frame[array.place(row, col)] = 0.0);
        }
        let counts = |newtons: &f32| {
            let raised = newtons / recorded.newtons_per_count;
            f64::from(raised.abs().powf(1.0 / recorded.exponent).copysign(raised))
        };
        let counts = frames
            .iter()
            .map(|frame| frame.iter().map(counts).collect());
        let sum = |counts: &Vec<f64>| counts.iter().sum::<f64>();
        let mut frames: Vec<Vec<f64>> = counts.collect();
        let most = frames.iter().map(sum).fold(0.0, f64::max);
        frames.retain(|counts| sum(counts) > 0.0 && sum(counts) >= RESTING_SHARE * most);
        frames.sort_by(|one, other| sum(one).total_cmp(&sum(other)));
        let ends = (LEFT_OUT * frames.len() as f64) as usize;
        let resting = &frames[ends..frames.len() - ends];
        let mean = |place: usize| {
            let sum: f64 = resting.iter().map(|counts| counts[place]).sum();
            (sum / resting.len().max(1) as f64) as f32
        };
        let newtons_of_counts = (0..array.taxels()).map(mean).collect();
        let means = Frame {
            array,
            newtons: newtons_of_counts,
        };
        let means_of = means.newtons.iter().copied();
        let (greatest, noise) = (
            means_of.clone().fold(0.0, f32::max),
            -means_of.fold(0.0, f32::min),
        );
        let counts = RawFrame {
            array,
            counts: means.felt(noise.max(ON_SHARE * greatest)).newtons,
        };
        Self {
            newtons,
            counts,
            settings,
        }
    }

    /// The force that the sensor reads with this exponent, if its scale is 1.
    fn read(&self, exponent: f64) -> f64 {
        let settings = tare::Settings {
            newtons_per_count: 1.0,
            exponent: exponent as f32,
            ..self.settings.clone()
        };
        let newtons = read(&self.counts, &settings).newtons;
        newtons.iter().copied().map(f64::from).sum()
    }
}

/// The frame that a sensor with these settings reads of counts above the baseline.
fn read(counts: &RawFrame, settings: &tare::Settings) -> Frame {
    let settings = tare::Settings {
        tare_frames: 0,
        ..settings.clone()
    };
    // Only a tare looks at the thresholds of contact.
    let contact = tare::Contact {
        threshold_n: 1.0,
        area_taxels: 1,
    };
    Tare::new(&settings, counts.array, contact).apply(counts)
}

/// The a that fits the weights best with this exponent, and the root mean square error that is
/// left, as a part of the weight.
fn scale(weights: &[Weight], exponent: f64) -> (f64, f64) {
    // With a small exponent, noise may outweigh a light weight.
    let logs = weights
        .iter()
        .map(|one| (one.newtons / one.read(exponent).max(f64::MIN_POSITIVE)).ln());
    let logs: Vec<f64> = logs.collect();
    let mean = logs.iter().sum::<f64>() / logs.len() as f64;
    let squares: f64 = logs.iter().map(|log| (log - mean).powi(2)).sum();
    (mean.exp(), (squares / logs.len() as f64).sqrt())
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::tools::calibrate::gather;
    use hardnessd_core::frame::Array;
    use hardnessd_core::tare::Gains;
    use hardnessd_core::tests::support::noisy_array::{COUNT_N, NoisyArray, foot, noisy_sensor};
    use hardnessd_core::tests::support::{hrn, sensor_of};

    fn sensor(calibration: tare::Settings) -> Sensor {
        sensor_of(|described| described.sensor.calibration = calibration)
    }

    /// Gains of 0.5 to 2, and two dead taxels under the weight.
    fn uneven() -> tare::Settings {
        let gain = |row: usize, col: usize| 0.5 + 0.25 * ((3 * row + col) % 7) as f32;
        let row = |row| (0..28).map(|col| gain(row, col)).collect();
        tare::Settings {
            gains: Some(Gains::Taxels((0..28).map(row).collect())),
            dead_taxels: vec![[11, 12], [12, 13]],
            ..tare::Settings::default()
        }
    }

    /// A press of `newtons` over 20 taxels, as a sensor with `settings` reads it. A taxel with a
    /// gain g gives c counts under a g c^e newtons. The taxels are those of `film`.
    fn press(newtons: f64, (a, e): (f64, f64), film: &Sensor, settings: &tare::Settings) -> Press {
        let mut counts = RawFrame::zero(Array::JX255N);
        for n in 0..20 {
            counts.counts[28 * (10 + n / 5) + 10 + n % 5] =
                ((n + 1) as f32 / 20.0).powf(1.0 / e as f32);
        }
        let mut weight = Weight {
            newtons,
            counts,
            settings: film.calibration().clone(),
        };
        let scale = (newtons / (a * weight.read(e))).powf(1.0 / e) as f32;
        weight
            .counts
            .counts
            .iter_mut()
            .for_each(|count| *count *= scale);
        let mut frame = read(&weight.counts, settings).newtons.to_vec();
        // A dead taxel shows what is no measurement.
        for &[row, col] in &settings.dead_taxels {
            frame[28 * row + col] = 1.0;
        }
        let half = frame.iter().map(|newtons| 0.5 * newtons).collect();
        Press {
            frames: vec![half, frame.clone(), frame.clone(), frame],
            calibration: settings.clone(),
            ..Press::default()
        }
    }

    fn fit(law: (f64, f64), weights: &[f64], settings: &tare::Settings) -> Fit {
        let sensor = sensor(settings.clone());
        let presses: Vec<Press> = weights
            .iter()
            .map(|&n| press(n, law, &sensor, settings))
            .collect();
        let weights: Vec<(f64, &Press)> = weights.iter().copied().zip(&presses).collect();
        Fit::of(&weights, &sensor).unwrap()
    }

    #[test]
    fn a_power_law_is_found_where_the_weights_can_say_it() {
        for settings in [tare::Settings::default(), uneven()] {
            let found = fit((0.01, 1.4), &[2.0, 5.0, 10.0, 20.0], &settings);
            assert!((found.exponent - 1.4).abs() < 0.011, "{found:?}");
            assert!(
                (found.newtons_per_count / 0.01 - 1.0).abs() < 0.05,
                "{found:?}"
            );
            for (newtons, read) in &found.weights {
                assert!((read / newtons - 1.0).abs() < 0.01, "{found:?}");
            }
            // Two different weights cannot determine an exponent.
            let two = fit((0.01, 1.2), &[10.0, 20.0, 20.0], &settings);
            assert_eq!(two.exponent, 1.0);
        }
    }

    #[test]
    fn noise_does_not_bias_the_scale() {
        // A scale of the configuration that is a third too small, and one that is a third too large. With one
        // that is twice too large, the noise of 6 counts passes for a touch, and there is no zero.
        for present in [0.0009, 0.0018] {
            for (noise, most_rest) in [(0.0, 300.0), (3.0, 300.0), (6.0, 300.0), (6.0, 0.0)] {
                let sensor = noisy_sensor(present);
                let mut array = NoisyArray::new(3, most_rest, noise);
                let mut bytes = Vec::new();
                let mut send = |force_n: f64, frames: usize| {
                    for _ in 0..frames {
                        let raw = array.read(&foot(force_n));
                        sensor.layout().encode(&raw, &mut bytes);
                    }
                };
                let weights = [4.905, 9.81, 19.62];
                send(0.0, 6);
                for newtons in weights {
                    send(0.6 * newtons, 1);
                    send(newtons, 12);
                    send(0.0, 3);
                }
                let path = Path::new("w.bin");
                let presses = gather::presses(bytes.as_slice(), path, &sensor, &hrn()).unwrap();
                assert_eq!(presses.len(), weights.len(), "{present}, {noise}");
                let weights: Vec<(f64, &Press)> = weights.into_iter().zip(&presses).collect();
                let fit = Fit::of(&weights, &sensor).unwrap();
                let off = fit.newtons_per_count / COUNT_N - 1.0;
                // A converter that rests at 0 cuts off the lower half of its noise.
                let most_off = if most_rest > 0.0 { 0.02 } else { 0.04 };
                assert!(
                    off.abs() < most_off,
                    "{present}, {noise} on {most_rest}: {off}"
                );
            }
        }
    }

    #[test]
    fn a_press_is_read_with_the_settings_of_its_recording() {
        // The sensor of the configuration has gains, and another scale than the recordings.
        let present = tare::Settings {
            newtons_per_count: 0.02,
            ..uneven()
        };
        let configured = sensor(present.clone());
        let recorded = [
            tare::Settings::default(),
            tare::Settings {
                newtons_per_count: 0.04,
                exponent: 1.3,
                ..tare::Settings::default()
            },
            present,
        ];
        let weights = [5.0, 10.0, 20.0];
        let presses: Vec<Press> = weights
            .iter()
            .zip(&recorded)
            .map(|(&newtons, settings)| press(newtons, (0.031, 1.0), &configured, settings))
            .collect();
        let weights: Vec<(f64, &Press)> = weights.into_iter().zip(&presses).collect();
        let fit = Fit::of(&weights, &configured).unwrap();
        assert!((fit.newtons_per_count - 0.031).abs() < 1e-6, "{fit:?}");
        assert!(fit.line_error < 1e-5, "{fit:?}");
    }

    #[test]
    fn presses_that_measure_no_weight_or_fit_no_law_are_named() {
        let settings = tare::Settings::default();
        let sensor = sensor(settings.clone());
        let on = |newtons| press(newtons, (0.04, 1.0), &sensor, &settings);
        let full = Press {
            saturated: true,
            ..on(7.0)
        };
        for (presses, expected) in [
            (vec![(5.0, on(5.0)), (10.0, on(10.5)), (20.0, on(19.0))], ""),
            (
                vec![(5.0, on(5.0)), (7.0, Press::default())],
                "press 2, of 7 N, shows no force",
            ),
            (
                vec![(5.0, on(5.0)), (7.0, full)],
                "press 2, of 7 N, reaches full scale",
            ),
            (
                vec![(5.0, on(5.0)), (10.0, on(20.0)), (20.0, on(10.0))],
                "the weight of 20 N gives fewer counts than that of 10 N",
            ),
            (
                vec![(5.0, on(5.0)), (10.0, on(10.0)), (20.0, on(11.0))],
                "the weights do not fit one law",
            ),
        ] {
            let weights: Vec<(f64, &Press)> = presses.iter().map(|(n, on)| (*n, on)).collect();
            let error = Fit::of(&weights, &sensor).err();
            let error = error.map_or_else(String::new, |error| error.to_string());
            let is_expected =
                error.starts_with(expected) && error.is_empty() == expected.is_empty();
            assert!(is_expected, "{error:?}, expected {expected:?}");
        }
    }
}
