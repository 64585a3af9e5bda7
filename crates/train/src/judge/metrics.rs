//! The quality of a recogniser: the paper's Eqs. 11 to 14, and measures that the paper leaves out.
//!
//! In: the true level, the probabilities and the object of every labelled press. Out: an
//! [`Evaluation`], which `evaluate --json` prints. All ratios are computed from counts.

use serde::{Deserialize, Serialize};

use super::interval::{self, Mean};
use crate::data::presses::Unit;
use hardnessd_core::verdict::argmax;

/// Number of equal bins of the largest probability in the expected calibration error.
const CALIBRATION_BINS: usize = 15;
/// The least probability in the NLL, because a probability of 0 for the true level would make it
/// infinite.
const SMALLEST_PROBABILITY: f64 = 1e-12;

/// One labelled press and its verdict.
#[derive(Debug, Clone, PartialEq)]
pub struct Judged {
    /// The true level, 1..=L.
    pub level: u8,
    /// Probabilities `[L]` of the levels 1..=L.
    pub probabilities: Vec<f32>,
    /// What the interval draws it with, if that is known: its object, or the cover of its sensor.
    pub unit: Option<(Unit, u32)>,
}

impl Judged {
    /// The predicted level, from 0; equal probabilities go to the lower level (Eq. 10).
    pub fn prediction(&self) -> usize {
        argmax(&self.probabilities).0
    }

    fn truth(&self) -> usize {
        usize::from(self.level) - 1
    }
}

/// The fields of `evaluate --json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// The number of labelled samples.
    pub n: usize,
    /// Eq. 12: share of all samples judged rightly, 0..1.
    pub accuracy: f64,
    /// Mean of `category_accuracy` over the levels that are there: the accuracy if all levels were
    /// equally frequent.
    pub balanced_accuracy: f64,
    /// Eq. 11: share of each level's samples judged rightly. Null for an absent level.
    pub category_accuracy: Vec<Option<f64>>,
    /// Counts; rows are the truth, columns the prediction.
    pub confusion: Vec<Vec<u64>>,
    /// Cohen's kappa on the counts. Null where chance alone would always agree.
    pub kappa: Option<f64>,
    /// Cohen's kappa with quadratic weights, because levels are ordinal.
    pub kappa_quadratic: Option<f64>,
    /// Expected calibration error, 0..1.
    pub ece: f64,
    /// Mean negative log-likelihood, nats.
    pub nll: f64,
    /// The bins of `ece`.
    pub calibration: Vec<Bin>,
    /// 95 % interval of the accuracy by a bootstrap over objects within each level. Null without
    /// objects, where a level has only one, and where covers are drawn.
    pub accuracy_interval_by_object: Option<[f64; 2]>,
    /// The same over covers, if the data has several sensors: all sensors under a cover press the same
    /// objects.
    pub accuracy_interval_by_cover: Option<[f64; 2]>,
}

impl Evaluation {
    /// Evaluates `judged`, whose levels and rows of probabilities are all of 1..=`levels`.
    ///
    /// # Panics
    ///
    /// Panics if `judged` is empty or a level lies outside 1..=`levels`.
    pub fn of(judged: &[Judged], levels: usize) -> Self {
        assert!(!judged.is_empty(), "there is nothing to evaluate");
        let mut confusion = vec![vec![0_u64; levels]; levels];
        for one in judged {
            confusion[one.truth()][one.prediction()] += 1;
        }
        let unit = judged[0].unit.map(|(unit, _)| unit);
        let drawn: Option<Vec<_>> = judged.iter().map(Judged::drawn).collect();
        let interval = drawn.and_then(|drawn| interval::of(&drawn, Mean::OfPresses));
        let category_accuracy = category_accuracy(&confusion);
        Self {
            n: judged.len(),
            accuracy: accuracy(&confusion),
            balanced_accuracy: mean(category_accuracy.iter().flatten().copied()),
            category_accuracy,
            kappa: kappa(&confusion),
            kappa_quadratic: kappa_quadratic(&confusion),
            confusion,
            ece: calibration_error(judged),
            nll: negative_log_likelihood(judged),
            calibration: calibration(judged),
            accuracy_interval_by_object: interval.filter(|_| unit == Some(Unit::Object)),
            accuracy_interval_by_cover: interval.filter(|_| unit == Some(Unit::Cover)),
        }
    }
}

impl Judged {
    /// What the interval needs. Objects are drawn within each level.
    fn drawn(&self) -> Option<interval::Drawn> {
        let (unit, number) = self.unit?;
        let stratum = match unit {
            Unit::Object => self.level,
            Unit::Cover => 0,
        };
        Some(interval::Drawn {
            stratum,
            unit: number,
            value: f64::from(u8::from(self.prediction() == self.truth())),
        })
    }
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, n), value| (sum + value, n + 1.0));
    sum / count
}

fn total(confusion: &[Vec<u64>]) -> f64 {
    confusion.iter().flatten().sum::<u64>() as f64
}

/// Eq. (12): `P_overall = Z / N`.
pub fn accuracy(confusion: &[Vec<u64>]) -> f64 {
    let right: u64 = confusion
        .iter()
        .enumerate()
        .map(|(level, row)| row[level])
        .sum();
    right as f64 / total(confusion)
}

/// Eq. (11): `P_i = Z_i / N_i`.
pub fn category_accuracy(confusion: &[Vec<u64>]) -> Vec<Option<f64>> {
    let of_row = |(level, row): (usize, &Vec<u64>)| {
        let count: u64 = row.iter().sum();
        (count > 0).then(|| row[level] as f64 / count as f64)
    };
    confusion.iter().enumerate().map(of_row).collect()
}

/// Cohen's kappa with the weight of disagreement `weight(truth, prediction)`:
/// 1 - observed / expected disagreement.
fn weighted_kappa(confusion: &[Vec<u64>], weight: impl Fn(usize, usize) -> f64) -> Option<f64> {
    let n = total(confusion);
    let levels = confusion.len();
    let rows: Vec<f64> = confusion
        .iter()
        .map(|row| row.iter().sum::<u64>() as f64)
        .collect();
    let columns: Vec<f64> = (0..levels)
        .map(|w| confusion.iter().map(|row| row[w]).sum::<u64>() as f64)
        .collect();
    let (mut observed, mut expected) = (0.0, 0.0);
    for h in 0..levels {
        for w in 0..levels {
            observed += weight(h, w) * confusion[h][w] as f64 / n;
            expected += weight(h, w) * rows[h] * columns[w] / (n * n);
        }
    }
    (expected > 0.0).then(|| 1.0 - observed / expected)
}

/// Eq. (14) on counts. The paper prints it with the rows' shares, which equals Cohen's kappa only
/// when all levels have the same number of samples. Eq. (13)'s text calls `N_hw` the samples
/// recognised falsely, but the diagonal, which Eq. (14) needs, counts those recognised rightly.
pub fn kappa(confusion: &[Vec<u64>]) -> Option<f64> {
    weighted_kappa(confusion, |h, w| if h == w { 0.0 } else { 1.0 })
}

/// Cohen's kappa on counts with quadratic weights; `None` where chance alone would always agree.
pub fn kappa_quadratic(confusion: &[Vec<u64>]) -> Option<f64> {
    weighted_kappa(confusion, |h, w| (h as f64 - w as f64).powi(2))
}

/// One bin of the calibration error.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Bin {
    /// Samples whose largest probability falls into the bin.
    pub samples: u64,
    /// Samples of the bin that were judged rightly.
    pub right: u64,
    /// Sum of the largest probabilities of the bin's samples.
    pub confidence: f64,
}

/// The bins of the expected calibration error, equally wide from 0 to 1.
fn calibration(judged: &[Judged]) -> Vec<Bin> {
    let mut bins = vec![Bin::default(); CALIBRATION_BINS];
    for one in judged {
        let prediction = one.prediction();
        let confidence = f64::from(one.probabilities[prediction]);
        let bin = ((confidence * CALIBRATION_BINS as f64) as usize).min(CALIBRATION_BINS - 1);
        bins[bin].samples += 1;
        bins[bin].right += u64::from(prediction == one.truth());
        bins[bin].confidence += confidence;
    }
    bins
}

/// Mean over the samples of |accuracy - mean confidence| of their bin.
fn calibration_error(judged: &[Judged]) -> f64 {
    calibration(judged)
        .iter()
        .map(|bin| (bin.right as f64 - bin.confidence).abs())
        .sum::<f64>()
        / judged.len() as f64
}

fn negative_log_likelihood(judged: &[Judged]) -> f64 {
    let of_one = |one: &Judged| {
        -f64::from(one.probabilities[one.truth()])
            .max(SMALLEST_PROBABILITY)
            .ln()
    };
    judged.iter().map(of_one).sum::<f64>() / judged.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::judge::paper;

    #[test]
    fn the_papers_other_figures_follow_from_its_confusion_matrices() {
        // Table 2's category accuracies and overall accuracy, Table 3's kappa, and the kappa with quadratic
        // weights, which the paper does not print, computed by hand.
        for (method, categories, overall, cohen, quadratic) in [
            ("hrn15", [67.2, 61.2, 56.8, 71.6], 64.2, 0.5227, 0.682),
            ("hrn100", [97.6, 94.4, 92.4, 99.2], 95.9, 0.9453, 0.973),
            ("sgan", [89.2, 84.0, 80.4, 91.2], 86.2, 0.816, 0.889),
            ("ours", [96.4, 92.8, 90.0, 98.4], 94.4, 0.9253, 0.963),
        ] {
            let counts = paper::confusion(method).unwrap();
            let alike = |found: f64, expected: f64, tolerance: f64| {
                assert!(
                    (found - expected).abs() < tolerance,
                    "{method}: {found}, {expected}"
                );
            };
            for (found, expected) in category_accuracy(&counts).into_iter().zip(categories) {
                alike(100.0 * found.unwrap(), expected, 1e-9);
            }
            alike(100.0 * accuracy(&counts), overall, 1e-9);
            alike(kappa(&counts).unwrap(), cohen, 0.5e-4);
            alike(kappa_quadratic(&counts).unwrap(), quadratic, 0.5e-3);
        }
    }

    fn judged(level: u8, probabilities: [f32; 4], object: u32) -> Judged {
        Judged {
            level,
            probabilities: probabilities.to_vec(),
            unit: Some((Unit::Object, object)),
        }
    }

    #[test]
    fn calibration_and_likelihood_follow_their_definitions() {
        let samples = [
            judged(1, [0.7, 0.1, 0.1, 0.1], 0),
            judged(1, [0.7, 0.1, 0.1, 0.1], 0),
            judged(2, [0.7, 0.1, 0.1, 0.1], 1),
            judged(2, [0.05, 0.95, 0.0, 0.0], 1),
        ];
        let evaluation = Evaluation::of(&samples, 4);
        // In the bin of 0.7, two of three are right. In the bin of 0.95, one of one is right.
        let expected_ece = (3.0 * (2.0 / 3.0_f64 - 0.7).abs() + 0.05) / 4.0;
        assert!(
            (evaluation.ece - expected_ece).abs() < 1e-6,
            "ece {}",
            evaluation.ece
        );
        let expected_nll = -(2.0 * 0.7_f64.ln() + 0.1_f64.ln() + 0.95_f64.ln()) / 4.0;
        assert!(
            (evaluation.nll - expected_nll).abs() < 1e-6,
            "nll {}",
            evaluation.nll
        );
        assert_eq!(
            evaluation.category_accuracy,
            [Some(1.0), Some(0.5), None, None]
        );
        assert_eq!(evaluation.confusion[1], [1, 1, 0, 0]);
        assert_eq!(
            (evaluation.accuracy, evaluation.balanced_accuracy),
            (0.75, 0.75)
        );
        let uneven = Evaluation::of(&samples[1..], 4);
        assert_eq!(
            (uneven.accuracy, uneven.balanced_accuracy),
            (2.0 / 3.0, 0.75)
        );
    }

    #[test]
    fn a_tie_goes_to_the_lower_level() {
        assert_eq!(judged(1, [0.1, 0.4, 0.4, 0.1], 0).prediction(), 1);
    }

    #[test]
    fn covers_are_drawn_with_all_their_objects() {
        // Twenty covers with four objects, one a level, of 10 presses. Half of the covers are all wrong.
        type UnitOf = fn(u32) -> (Unit, u32);
        let press = |(number, unit): (u32, UnitOf)| {
            let level = (number / 10 % 4) as u8 + 1;
            let cover = number / 40;
            let likeliest = if cover.is_multiple_of(2) {
                level - 1
            } else {
                level % 4
            };
            let mut probabilities = [0.1; 4];
            probabilities[usize::from(likeliest)] = 0.7;
            Judged {
                level,
                probabilities: probabilities.to_vec(),
                unit: Some(unit(number)),
            }
        };
        let evaluated = |unit| {
            let all: Vec<Judged> = (0..800).map(|number| press((number, unit))).collect();
            Evaluation::of(&all, 4)
        };
        let covers = evaluated(|number| (Unit::Cover, number / 40));
        let objects = evaluated(|number| (Unit::Object, number / 10));
        assert_eq!(covers.accuracy_interval_by_object, None);
        assert_eq!(objects.accuracy_interval_by_cover, None);
        let width = |[low, high]: [f64; 2]| high - low;
        let covers = width(covers.accuracy_interval_by_cover.unwrap());
        let objects = width(objects.accuracy_interval_by_object.unwrap());
        assert!((covers / objects - 2.0).abs() < 0.3, "{covers} {objects}");
    }

    #[test]
    fn without_objects_there_is_no_interval_and_one_class_has_no_kappa() {
        let sample = Judged {
            level: 1,
            probabilities: vec![0.9, 0.1, 0.0, 0.0],
            unit: None,
        };
        let evaluation = Evaluation::of(&[sample], 4);
        assert_eq!(evaluation.accuracy_interval_by_object, None);
        assert_eq!(evaluation.kappa, None);
    }
}
