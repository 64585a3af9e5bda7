//! How good a recogniser is: the paper's Eqs. 11 to 14, and what they leave out.
//!
//! In: the true level, the probabilities and the object of every labelled sample. Out: an
//! [`Evaluation`], which is what `evaluate --json` prints. All ratios are taken on counts.
//!
//! Presses of one object are near-copies, so an interval over frames is too narrow: ours draws
//! whole objects.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::random::Stream;

/// Equal-width bins of the largest probability in the expected calibration error.
const CALIBRATION_BINS: usize = 15;
/// Draws of the bootstrap.
const BOOTSTRAP_DRAWS: usize = 2_000;
/// A probability of 0 for what happened would make the NLL infinite.
const SMALLEST_PROBABILITY: f64 = 1e-12;

/// One labelled sample and what was said of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Judged {
    /// The true level, 1..=L.
    pub level: u8,
    /// `[L]`, of levels 1..=L.
    pub probabilities: Vec<f32>,
    /// The object that was pressed, if known.
    pub object: Option<u32>,
}

impl Judged {
    /// The predicted level, from 0; equal probabilities go to the lower level (Eq. 10).
    fn prediction(&self) -> usize {
        (1..self.probabilities.len()).fold(0, |best, index| {
            if self.probabilities[index] > self.probabilities[best] {
                index
            } else {
                best
            }
        })
    }

    fn truth(&self) -> usize {
        usize::from(self.level) - 1
    }
}

/// The fields of `evaluate --json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Labelled samples.
    pub n: usize,
    /// Eq. 12: right ones among all, 0..1.
    pub accuracy: f64,
    /// Eq. 11: right ones among each level's; null for an absent level.
    pub category_accuracy: Vec<Option<f64>>,
    /// Counts; rows are the truth, columns the prediction.
    pub confusion: Vec<Vec<u64>>,
    /// Cohen's kappa on the counts; null where chance alone would always agree.
    pub kappa: Option<f64>,
    /// The same with quadratic weights: levels are ordinal.
    pub kappa_quadratic: Option<f64>,
    /// Expected calibration error, 0..1.
    pub ece: f64,
    /// Mean negative log-likelihood, nats.
    pub nll: f64,
    /// 95 % interval of the accuracy by a bootstrap over objects within each level; null
    /// without objects.
    pub accuracy_interval_by_object: Option<[f64; 2]>,
}

impl Evaluation {
    /// Evaluates `judged`, whose levels and rows of probabilities are all of 1..=`levels`.
    ///
    /// # Panics
    ///
    /// If `judged` is empty or a level lies outside 1..=`levels`.
    pub fn of(judged: &[Judged], levels: usize) -> Self {
        assert!(!judged.is_empty(), "there is nothing to evaluate");
        let mut confusion = vec![vec![0_u64; levels]; levels];
        for one in judged {
            confusion[one.truth()][one.prediction()] += 1;
        }
        Self {
            n: judged.len(),
            accuracy: accuracy(&confusion),
            category_accuracy: category_accuracy(&confusion),
            kappa: kappa(&confusion),
            kappa_quadratic: kappa_quadratic(&confusion),
            confusion,
            ece: calibration_error(judged),
            nll: negative_log_likelihood(judged),
            accuracy_interval_by_object: interval_by_object(judged, levels),
        }
    }
}

fn total(confusion: &[Vec<u64>]) -> f64 {
    confusion.iter().flatten().sum::<u64>() as f64
}

/// Eq. (12): `P_overall = Z / N`.
fn accuracy(confusion: &[Vec<u64>]) -> f64 {
    let right: u64 = confusion
        .iter()
        .enumerate()
        .map(|(level, row)| row[level])
        .sum();
    right as f64 / total(confusion)
}

/// Eq. (11): `P_i = Z_i / N_i`.
fn category_accuracy(confusion: &[Vec<u64>]) -> Vec<Option<f64>> {
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

/// Eq. (14) on counts. As printed, on the rows' shares, it equals Cohen's kappa only when all
/// levels have equally many samples. Eq. (13)'s text calls `N_hw` the falsely recognised ones;
/// the diagonal, which Eq. (14) needs, is of course the rightly recognised.
fn kappa(confusion: &[Vec<u64>]) -> Option<f64> {
    weighted_kappa(confusion, |h, w| if h == w { 0.0 } else { 1.0 })
}

fn kappa_quadratic(confusion: &[Vec<u64>]) -> Option<f64> {
    weighted_kappa(confusion, |h, w| (h as f64 - w as f64).powi(2))
}

/// Mean over the samples of |accuracy - mean confidence| of their bin.
fn calibration_error(judged: &[Judged]) -> f64 {
    // Of each bin: samples, right ones, sum of confidences.
    let mut bins = [(0.0, 0.0, 0.0); CALIBRATION_BINS];
    for one in judged {
        let prediction = one.prediction();
        let confidence = f64::from(one.probabilities[prediction]);
        let bin = ((confidence * CALIBRATION_BINS as f64) as usize).min(CALIBRATION_BINS - 1);
        bins[bin].0 += 1.0;
        bins[bin].1 += f64::from(u8::from(prediction == one.truth()));
        bins[bin].2 += confidence;
    }
    bins.iter()
        .map(|(_, right, confidence)| (right - confidence).abs())
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

/// Draws whole objects, with replacement, as many as each level has; seed 0.
fn interval_by_object(judged: &[Judged], levels: usize) -> Option<[f64; 2]> {
    // Of each level's objects: right ones, samples.
    let mut objects: Vec<BTreeMap<u32, (u64, u64)>> = vec![BTreeMap::new(); levels];
    for one in judged {
        let counts = objects[one.truth()].entry(one.object?).or_default();
        counts.0 += u64::from(one.prediction() == one.truth());
        counts.1 += 1;
    }
    let objects: Vec<Vec<(u64, u64)>> = objects
        .into_iter()
        .map(|level| level.into_values().collect())
        .collect();
    let mut stream = Stream::new(0, "bootstrap by object");
    let mut accuracies: Vec<f64> = (0..BOOTSTRAP_DRAWS)
        .map(|_| {
            let (mut right, mut samples) = (0, 0);
            for level in &objects {
                for _ in level {
                    let drawn = level[stream.below(level.len())];
                    right += drawn.0;
                    samples += drawn.1;
                }
            }
            right as f64 / samples as f64
        })
        .collect();
    accuracies.sort_by(f64::total_cmp);
    Some([quantile(&accuracies, 0.025), quantile(&accuracies, 0.975)])
}

/// Linear between the two nearest, as numpy's default.
fn quantile(sorted: &[f64], q: f64) -> f64 {
    let place = q * (sorted.len() - 1) as f64;
    let below = place.floor() as usize;
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + (place - below as f64) * (sorted[above] - sorted[below])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Table 3 of the paper as counts of 250 a level, with its kappas and Table 2's accuracies.
    const TABLE_3: [(&str, [[u64; 4]; 4], f64, f64); 8] = [
        (
            "HRN15",
            [
                [168, 51, 19, 12],
                [30, 153, 53, 14],
                [19, 56, 142, 33],
                [11, 25, 35, 179],
            ],
            0.5227,
            0.642,
        ),
        (
            "HRN50",
            [
                [224, 15, 7, 4],
                [13, 211, 17, 9],
                [11, 24, 202, 13],
                [2, 5, 14, 229],
            ],
            0.8213,
            0.866,
        ),
        (
            "HRN100",
            [
                [244, 5, 1, 0],
                [5, 236, 7, 2],
                [6, 10, 231, 3],
                [0, 0, 2, 248],
            ],
            0.9453,
            0.959,
        ),
        (
            "SGAN",
            [
                [223, 19, 5, 3],
                [12, 210, 18, 10],
                [11, 26, 201, 12],
                [2, 7, 13, 228],
            ],
            0.8160,
            0.862,
        ),
        (
            "IGAN",
            [
                [229, 14, 5, 2],
                [12, 213, 16, 9],
                [10, 24, 204, 12],
                [2, 5, 11, 232],
            ],
            0.8373,
            0.878,
        ),
        (
            "NAHRN",
            [
                [223, 17, 7, 3],
                [13, 208, 19, 10],
                [12, 27, 197, 14],
                [3, 5, 13, 229],
            ],
            0.8093,
            0.857,
        ),
        (
            "NIHRN",
            [
                [231, 11, 6, 2],
                [9, 221, 15, 5],
                [9, 21, 212, 8],
                [1, 5, 7, 237],
            ],
            0.8680,
            0.901,
        ),
        (
            "Ours",
            [
                [241, 6, 3, 0],
                [5, 232, 10, 3],
                [6, 18, 225, 1],
                [0, 0, 4, 246],
            ],
            0.9253,
            0.944,
        ),
    ];

    fn rows(counts: &[[u64; 4]; 4]) -> Vec<Vec<u64>> {
        counts.iter().map(|row| row.to_vec()).collect()
    }

    #[test]
    fn every_kappa_of_table_3_follows_from_its_counts() {
        for (name, counts, expected_kappa, expected_accuracy) in &TABLE_3 {
            let confusion = rows(counts);
            assert!(
                counts.iter().all(|row| row.iter().sum::<u64>() == 250),
                "{name}"
            );
            let kappa = kappa(&confusion).unwrap();
            assert!(
                (kappa - expected_kappa).abs() < 0.5e-4,
                "{name}: kappa {kappa}"
            );
            let accuracy = accuracy(&confusion);
            assert!(
                (accuracy - expected_accuracy).abs() < 0.5e-3,
                "{name}: accuracy {accuracy}"
            );
        }
    }

    #[test]
    fn quadratic_kappa_forgives_the_neighbouring_level() {
        // HRN15 and HRN100 by hand from Table 3's counts.
        for (index, expected) in [(0, 0.682), (2, 0.973), (7, 0.963)] {
            let kappa = kappa_quadratic(&rows(&TABLE_3[index].1)).unwrap();
            assert!(
                (kappa - expected).abs() < 0.5e-3,
                "{}: {kappa}",
                TABLE_3[index].0
            );
        }
    }

    fn judged(level: u8, probabilities: [f32; 4], object: u32) -> Judged {
        Judged {
            level,
            probabilities: probabilities.to_vec(),
            object: Some(object),
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
        // Bin of 0.7: two of three right; bin of 0.95: one of one right.
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
    }

    #[test]
    fn a_tie_goes_to_the_lower_level() {
        assert_eq!(judged(1, [0.1, 0.4, 0.4, 0.1], 0).prediction(), 1);
    }

    #[test]
    fn the_interval_is_wide_when_whole_objects_fail() {
        // 20 objects of 50 presses, one of the five a level always wrong: frames would give
        // +-2.5 points, objects give about +-18 (binomial, 20 draws).
        let samples: Vec<Judged> = (0..20_u32)
            .flat_map(|object| (0..50).map(move |_| object))
            .map(|object| {
                let level = (object % 4) as u8 + 1;
                let said = if object / 4 == 0 {
                    level % 4
                } else {
                    level - 1
                };
                let mut probabilities = [0.1; 4];
                probabilities[usize::from(said)] = 0.7;
                judged(level, probabilities, object)
            })
            .collect();
        let [low, high] = Evaluation::of(&samples, 4)
            .accuracy_interval_by_object
            .unwrap();
        assert!((0.55..0.70).contains(&low), "low {low}");
        assert!((0.90..=1.0).contains(&high), "high {high}");
    }

    #[test]
    fn without_objects_there_is_no_interval_and_one_class_has_no_kappa() {
        let sample = Judged {
            level: 1,
            probabilities: vec![0.9, 0.1, 0.0, 0.0],
            object: None,
        };
        let evaluation = Evaluation::of(&[sample], 4);
        assert_eq!(evaluation.accuracy_interval_by_object, None);
        assert_eq!(evaluation.kappa, None);
    }
}
