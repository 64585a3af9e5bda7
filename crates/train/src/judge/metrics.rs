//! The quality of a recogniser: the paper's Eqs. 11 to 14, and measures that the paper leaves out.
//!
//! In: the true level, the probabilities and the object of every labelled sample. Out: an
//! [`Evaluation`], which `evaluate --json` prints. All ratios are computed from counts.
//!
//! Presses of one object are near-copies, so an interval over frames is too narrow. Our interval
//! draws whole objects.

mod by_object;

use serde::{Deserialize, Serialize};

use hardnessd_core::verdict::argmax;

pub use by_object::{
    Clusters, Estimate, ObjectCount, accuracy_by_object, by_object, difference_by_object,
};

/// Number of equal bins of the largest probability in the expected calibration error.
const CALIBRATION_BINS: usize = 15;
/// The least probability in the NLL, because a probability of 0 for the true level would make it
/// infinite.
const SMALLEST_PROBABILITY: f64 = 1e-12;

/// One labelled sample and its verdict.
#[derive(Debug, Clone, PartialEq)]
pub struct Judged {
    /// The true level, 1..=L.
    pub level: u8,
    /// Probabilities `[L]` of the levels 1..=L.
    pub probabilities: Vec<f32>,
    /// The object that was pressed, if known.
    pub object: Option<u32>,
}

impl Judged {
    /// The predicted level, from 0; equal probabilities go to the lower level (Eq. 10).
    fn prediction(&self) -> usize {
        argmax(&self.probabilities).0
    }

    fn truth(&self) -> usize {
        usize::from(self.level) - 1
    }

    /// The verdict before the logits were divided by `temperature`: softmax(z) is softmax(z / T) to
    /// the power of T, normalised to a sum of 1.
    #[must_use]
    pub fn before_temperature(&self, temperature: f64) -> Self {
        let powers = self
            .probabilities
            .iter()
            .map(|&p| f64::from(p).powf(temperature));
        let sum: f64 = powers.clone().sum();
        Self {
            probabilities: powers.map(|power| (power / sum) as f32).collect(),
            ..*self
        }
    }
}

/// The fields of `evaluate --json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// The number of labelled samples.
    pub n: usize,
    /// Eq. 12: share of all samples judged rightly, 0..1.
    pub accuracy: f64,
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
    /// 95 % interval of the accuracy by a bootstrap over objects within each level. Null without
    /// objects, and where no level has two objects.
    pub accuracy_interval_by_object: Option<[f64; 2]>,
}

impl Evaluation {
    /// Whether the counts are a square with a row for each level, as in any evaluation that was not
    /// damaged.
    pub fn is_square(&self) -> bool {
        let levels = self.category_accuracy.len();
        let mut rows = self.confusion.iter();
        self.confusion.len() == levels && rows.all(|row| row.len() == levels)
    }

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
        Self {
            n: judged.len(),
            accuracy: accuracy(&confusion),
            category_accuracy: category_accuracy(&confusion),
            kappa: kappa(&confusion),
            kappa_quadratic: kappa_quadratic(&confusion),
            confusion,
            ece: calibration_error(judged),
            nll: negative_log_likelihood(judged),
            accuracy_interval_by_object: by_object(judged)
                .and_then(|objects| accuracy_by_object(&[&objects], Clusters::Objects))
                .and_then(|estimate| estimate.interval),
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

/// Eq. (14) on counts. The paper prints it with the rows' shares, which equals Cohen's kappa only
/// when all levels have the same number of samples. Eq. (13)'s text calls `N_hw` the samples
/// recognised falsely, but the diagonal, which Eq. (14) needs, counts those recognised rightly.
fn kappa(confusion: &[Vec<u64>]) -> Option<f64> {
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
pub fn calibration(judged: &[Judged]) -> Vec<Bin> {
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
pub fn calibration_error(judged: &[Judged]) -> f64 {
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
    fn every_kappa_of_table_3_follows_from_its_counts() {
        for row in &paper::TABLES {
            let kappa = kappa(&row.counts()).unwrap();
            assert!(
                (kappa - row.kappa).abs() < 0.5e-4,
                "{}: {kappa}",
                row.method
            );
            let percent = accuracy(&row.counts()) * 100.0;
            assert!(
                (percent - row.accuracy_percent).abs() < 0.051,
                "{}: {percent}",
                row.method
            );
        }
    }

    #[test]
    fn quadratic_kappa_forgives_the_neighbouring_level() {
        // These values are computed by hand from Table 3's counts; the paper does not print them.
        for (method, expected) in [("hrn15", 0.682), ("hrn100", 0.973), ("ours", 0.963)] {
            let kappa = kappa_quadratic(&paper::row(method).unwrap().counts()).unwrap();
            assert!((kappa - expected).abs() < 0.5e-3, "{method}: {kappa}");
        }
    }

    pub(super) fn judged(level: u8, probabilities: [f32; 4], object: u32) -> Judged {
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
    }

    #[test]
    fn temperature_can_be_taken_back() {
        // The logits ln 8, 0 and 0 give 2, 1 and 1 of 4 at temperature 3.
        let tempered = judged(1, [0.5, 0.25, 0.25, 0.0], 0).before_temperature(3.0);
        for (found, expected) in tempered.probabilities.iter().zip([0.8, 0.1, 0.1, 0.0]) {
            assert!(
                (found - expected).abs() < 1e-6,
                "{:?}",
                tempered.probabilities
            );
        }
    }

    #[test]
    fn a_tie_goes_to_the_lower_level() {
        assert_eq!(judged(1, [0.1, 0.4, 0.4, 0.1], 0).prediction(), 1);
    }

    #[test]
    fn the_interval_is_wide_when_whole_objects_fail() {
        // There are 20 objects of 50 presses, and one of the five objects of each level is always
        // judged wrongly. Frames would give +-2.5 points, objects give about +-18 (binomial, 20
        // draws).
        let samples: Vec<Judged> = (0..20_u32)
            .flat_map(|object| (0..50).map(move |_| object))
            .map(|object| {
                let level = (object % 4) as u8 + 1;
                let likeliest = if object / 4 == 0 {
                    level % 4
                } else {
                    level - 1
                };
                let mut probabilities = [0.1; 4];
                probabilities[usize::from(likeliest)] = 0.7;
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
