//! The quality of a recogniser's verdicts: levels, Shore hardness and sets of levels.
//!
//! In: the verdict on every labelled press, and the truth. Out: an [`Evaluated`], which `evaluate --json` prints.

use serde::Serialize;

use super::interval::{self, Drawn, Mean};
use super::metrics::{accuracy, category_accuracy, kappa, kappa_quadratic};
use crate::data::presses::Unit;
use hardnessd_core::verdict::{Level, Shore, Verdict, argmax};

/// Number of equal bins of the largest probability in the expected calibration error.
const CALIBRATION_BINS: usize = 15;
/// The least probability in the NLL, because a probability of 0 for the true level would make it
/// infinite.
const SMALLEST_PROBABILITY: f64 = 1e-12;

/// A verdict on a labelled press, and the truth.
#[derive(Debug, Clone)]
pub struct Case {
    /// The press.
    pub press: usize,
    /// The hardness level.
    pub level: u8,
    /// The Shore hardness, if it is known.
    pub shore: Option<f32>,
    /// The number of the object, if it is known.
    pub object: Option<u32>,
    /// What an interval draws the press with, if that is known.
    pub unit: Option<(Unit, u32)>,
    /// The verdict.
    pub verdict: Verdict,
}

impl Case {
    /// The place of the level that the verdict names, with its probability. Equal probabilities go to the lower level
    /// (Eq. 10).
    fn prediction(&self) -> (usize, f32) {
        argmax(&self.verdict.probabilities)
    }

    fn truth(&self) -> usize {
        usize::from(self.level) - 1
    }

    /// Whether the verdict names the true level.
    pub fn is_right(&self) -> bool {
        self.prediction().0 == self.truth()
    }

    /// What the interval needs. Objects are drawn within each level.
    fn drawn(&self) -> Option<Drawn> {
        let (unit, number) = self.unit?;
        let stratum = match unit {
            Unit::Object => self.level,
            Unit::Cover => 0,
        };
        Some(Drawn {
            stratum,
            unit: number,
            value: f64::from(u8::from(self.is_right())),
        })
    }
}

/// The evaluation of a model, which `evaluate --json` prints.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evaluated {
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
    /// Share of verdicts whose level is off by more than one.
    pub beyond_neighbour: f64,
    /// The evaluation of the Shore hardness; null for a model or data without it.
    pub shore: Option<ShoreEvaluation>,
    /// The evaluation of the sets of levels; null for a model without them.
    pub sets: Option<SetEvaluation>,
}

/// The evaluation of the Shore hardness.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ShoreEvaluation {
    /// Root mean square error, in Shore OO.
    pub rmse: f64,
    /// Root mean square error of each level; null for a level without verdicts.
    pub rmse_by_level: Vec<Option<f64>>,
    /// Share of verdicts whose interval contains the true hardness. The model promises 0.9.
    pub coverage: f64,
    /// Mean width of the intervals, in Shore OO.
    pub width: f64,
}

/// The evaluation of the sets of levels.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SetEvaluation {
    /// Share of verdicts whose set contains the true level. The model promises 0.9.
    pub coverage: f64,
    /// Share of verdicts whose set has more than one level. Such verdicts are rejected as ambiguous.
    pub ambiguous: f64,
    /// Accuracy of the verdicts that are not ambiguous; null if there are none.
    pub accuracy_of_others: Option<f64>,
}

/// One bin of the calibration error.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Bin {
    /// Samples whose largest probability falls into the bin.
    pub samples: u64,
    /// Samples of the bin that were judged rightly.
    pub right: u64,
    /// Sum of the largest probabilities of the bin's samples.
    pub confidence: f64,
}

/// The bins of the expected calibration error, equally wide from 0 to 1.
fn calibration(cases: &[Case]) -> Vec<Bin> {
    let mut bins = vec![Bin::default(); CALIBRATION_BINS];
    for case in cases {
        let (prediction, confidence) = case.prediction();
        let confidence = f64::from(confidence);
        let bin = ((confidence * CALIBRATION_BINS as f64) as usize).min(CALIBRATION_BINS - 1);
        bins[bin].samples += 1;
        bins[bin].right += u64::from(prediction == case.truth());
        bins[bin].confidence += confidence;
    }
    bins
}

impl Evaluated {
    /// Evaluates at least one verdict of a model of these levels.
    ///
    /// # Panics
    ///
    /// Panics if there is no verdict, or a true level is none of these.
    pub fn of(cases: &[Case], levels: &[Level]) -> Self {
        assert!(!cases.is_empty(), "there is nothing to evaluate");
        let n = cases.len() as f64;
        let mut confusion = vec![vec![0_u64; levels.len()]; levels.len()];
        for case in cases {
            confusion[case.truth()][case.prediction().0] += 1;
        }
        let unit = cases[0].unit.map(|(unit, _)| unit);
        let drawn: Option<Vec<Drawn>> = cases.iter().map(Case::drawn).collect();
        let interval = drawn.and_then(|drawn| interval::of(&drawn, Mean::OfPresses));
        let category_accuracy = category_accuracy(&confusion);
        let there: Vec<f64> = category_accuracy.iter().copied().flatten().collect();
        let calibration = calibration(cases);
        let errors = calibration.iter();
        let errors = errors.map(|bin| (bin.right as f64 - bin.confidence).abs());
        let loss = |case: &Case| {
            let probability = f64::from(case.verdict.probabilities[case.truth()]);
            -probability.max(SMALLEST_PROBABILITY).ln()
        };
        let is_far = |case: &&Case| case.level.abs_diff(case.verdict.level) > 1;
        Self {
            n: cases.len(),
            accuracy: accuracy(&confusion),
            balanced_accuracy: mean(there.into_iter()),
            category_accuracy,
            kappa: kappa(&confusion),
            kappa_quadratic: kappa_quadratic(&confusion),
            confusion,
            ece: errors.sum::<f64>() / n,
            nll: mean(cases.iter().map(loss)),
            calibration,
            accuracy_interval_by_object: interval.filter(|_| unit == Some(Unit::Object)),
            accuracy_interval_by_cover: interval.filter(|_| unit == Some(Unit::Cover)),
            beyond_neighbour: cases.iter().filter(is_far).count() as f64 / n,
            shore: shore(cases, levels.len()),
            sets: sets(cases),
        }
    }
}

/// What a second model does better than a first one, on the same presses.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Difference {
    /// The accuracy of the second one, less that of the first.
    pub accuracy: f64,
    /// The 95 % interval of the difference, by a bootstrap over the units; null where the data have none or do
    /// not vary.
    pub interval: Option<[f64; 2]>,
    /// The number of presses that only the first, and only the second judges rightly.
    pub only: [usize; 2],
}

impl Difference {
    /// Compares verdicts of two models on the same presses.
    pub fn of(first: &[Case], second: &[Case]) -> Self {
        let both = first.iter().zip(second);
        let both = both.map(|(first, second)| [first.is_right(), second.is_right()]);
        let pairs: Vec<[bool; 2]> = both.collect();
        let value = |[first, second]: [bool; 2]| f64::from(i8::from(second) - i8::from(first));
        let drawn = |(case, &pair): (&Case, &[bool; 2])| {
            Some(Drawn {
                value: value(pair),
                ..case.drawn()?
            })
        };
        let drawn: Option<Vec<Drawn>> = first.iter().zip(&pairs).map(drawn).collect();
        let count = |wanted| pairs.iter().filter(|&&pair| pair == wanted).count();
        Self {
            accuracy: pairs.iter().map(|&pair| value(pair)).sum::<f64>() / pairs.len() as f64,
            interval: drawn.and_then(|drawn| interval::of(&drawn, Mean::OfPresses)),
            only: [count([true, false]), count([false, true])],
        }
    }
}

/// The evaluation of the Shore hardness of verdicts; `None` for a model or data without it.
fn shore(cases: &[Case], levels: usize) -> Option<ShoreEvaluation> {
    let both = |case: &Case| Some((case.level, f64::from(case.shore?), case.verdict.shore?));
    let pairs: Vec<(u8, f64, Shore)> = cases.iter().filter_map(both).collect();
    let rmse = |of: &dyn Fn(u8) -> bool| {
        let chosen = pairs.iter().filter(|(level, ..)| of(*level));
        let errors = chosen.map(|(_, truth, shore)| f64::from(shore.value) - truth);
        let squares: Vec<f64> = errors.map(|error| error.powi(2)).collect();
        (!squares.is_empty()).then(|| mean(squares.into_iter()).sqrt())
    };
    let holds = |(_, truth, shore): &(u8, f64, Shore)| {
        let interval = f64::from(shore.low)..=f64::from(shore.high);
        f64::from(u8::from(interval.contains(truth)))
    };
    let width = |(.., shore): &(u8, f64, Shore)| f64::from(shore.high - shore.low);
    Some(ShoreEvaluation {
        rmse: rmse(&|_| true)?,
        rmse_by_level: (1..=levels as u8)
            .map(|level| rmse(&|of| of == level))
            .collect(),
        coverage: mean(pairs.iter().map(holds)),
        width: mean(pairs.iter().map(width)),
    })
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len() as f64;
    values.sum::<f64>() / count
}

fn sets(cases: &[Case]) -> Option<SetEvaluation> {
    let of = |case: &Case| {
        let set = case.verdict.levels.as_ref()?;
        Some((set.contains(&case.level), set.len() > 1))
    };
    let sets: Vec<(bool, bool)> = cases.iter().filter_map(of).collect();
    if sets.is_empty() {
        return None;
    }
    let n = sets.len() as f64;
    let share = |count: usize| count as f64 / n;
    let single: Vec<bool> = sets.iter().filter(|set| !set.1).map(|set| set.0).collect();
    let right = single.iter().filter(|&&holds| holds).count();
    Some(SetEvaluation {
        coverage: share(sets.iter().filter(|set| set.0).count()),
        ambiguous: share(sets.len() - single.len()),
        accuracy_of_others: (!single.is_empty()).then(|| right as f64 / single.len() as f64),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::source::papers_levels;

    /// A verdict of the level `said`, with this confidence.
    fn case(level: u8, (said, confidence): (u8, f32), unit: Option<(Unit, u32)>) -> Case {
        let mut probabilities = vec![(1.0 - confidence) / 3.0; 4];
        probabilities[usize::from(said) - 1] = confidence;
        Case {
            press: 0,
            level,
            shore: None,
            object: None,
            unit,
            verdict: Verdict {
                level: said,
                logits: Vec::new(),
                probabilities,
                confidence,
                shore: None,
                levels: None,
            },
        }
    }

    fn evaluated(cases: &[Case]) -> Evaluated {
        Evaluated::of(cases, &papers_levels())
    }

    #[test]
    fn calibration_and_likelihood_follow_their_definitions() {
        let cases = [(1, (1, 0.7)), (1, (1, 0.7)), (2, (1, 0.7)), (2, (2, 0.97))];
        let cases = cases.map(|(level, said)| case(level, said, None));
        let found = evaluated(&cases);
        // In the bin of 0.7, two of three are right. In the bin of 0.97, one of one is right.
        let ece = (3.0 * (2.0 / 3.0_f64 - 0.7).abs() + 0.03) / 4.0;
        let nll = -(2.0 * 0.7_f64.ln() + 0.1_f64.ln() + 0.97_f64.ln()) / 4.0;
        for (found, expected) in [(found.ece, ece), (found.nll, nll)] {
            assert!((found - expected).abs() < 1e-6, "{found}, {expected}");
        }
        assert_eq!(found.category_accuracy, [Some(1.0), Some(0.5), None, None]);
        assert_eq!(found.confusion[1], [1, 1, 0, 0]);
        assert_eq!((found.accuracy, found.balanced_accuracy), (0.75, 0.75));
        assert_eq!(found.accuracy_interval_by_object, None);
        let uneven = evaluated(&cases[1..]);
        let accuracies = (uneven.accuracy, uneven.balanced_accuracy);
        assert_eq!(accuracies, (2.0 / 3.0, 0.75));
        // One class has no kappa. Equal probabilities go to the lower level.
        assert_eq!(evaluated(&cases[..1]).kappa, None);
        assert!(case(1, (1, 0.25), None).is_right());
    }

    #[test]
    fn covers_are_drawn_with_all_their_objects() {
        // Twenty covers with four objects, one a level, of 10 presses. Half of the covers are all wrong.
        let found = |unit: fn(u32) -> (Unit, u32)| {
            let press = |number: u32| {
                let level = (number / 10 % 4) as u8 + 1;
                let is_right = (number / 40).is_multiple_of(2);
                let said = if is_right { level } else { level % 4 + 1 };
                case(level, (said, 0.7), Some(unit(number)))
            };
            evaluated(&(0..800).map(press).collect::<Vec<_>>())
        };
        let covers = found(|number| (Unit::Cover, number / 40));
        let objects = found(|number| (Unit::Object, number / 10));
        assert_eq!(covers.accuracy_interval_by_object, None);
        assert_eq!(objects.accuracy_interval_by_cover, None);
        let width = |[low, high]: [f64; 2]| high - low;
        let covers = width(covers.accuracy_interval_by_cover.unwrap());
        let objects = width(objects.accuracy_interval_by_object.unwrap());
        assert!((covers / objects - 2.0).abs() < 0.3, "{covers} {objects}");
    }

    #[test]
    fn two_models_are_compared_press_by_press() {
        // The second one is right on every third object of those that the first one has wrong.
        let judged = |is_right: fn(u32) -> bool| {
            let press = |object: u32| {
                let level = 1 + (object / 20) as u8;
                let said = if is_right(object) { level } else { 4 };
                case(level, (said, 0.7), Some((Unit::Object, object)))
            };
            (0..40).map(press).collect::<Vec<Case>>()
        };
        let (first, second) = (judged(|_| false), judged(|object| object % 3 == 0));
        let found = Difference::of(&first, &second);
        assert_eq!((found.accuracy, found.only), (0.35, [0, 14]));
        let [low, high] = found.interval.unwrap();
        assert!((0.15..0.3).contains(&low) && (0.4..0.55).contains(&high));
        assert_eq!(Difference::of(&second, &first).accuracy, -0.35);
        assert_eq!(Difference::of(&first, &first).interval, None);
    }

    #[test]
    fn shore_is_evaluated_over_all_and_over_each_level() {
        // The second verdict alone does not hold the truth.
        let cases = [
            (1, 80.0, 83.0),
            (2, 63.0, 57.0),
            (2, 65.0, 63.0),
            (4, 30.0, 30.0),
        ];
        let cases = cases.map(|(level, truth, value)| {
            let mut case = case(level, (level, 0.7), None);
            (case.shore, case.verdict.shore) = (
                Some(truth),
                Some(Shore::from([value, value - 4.0, value + 5.0])),
            );
            case
        });
        let expected = ShoreEvaluation {
            rmse: (49.0_f64 / 4.0).sqrt(),
            rmse_by_level: vec![Some(3.0), Some(20.0_f64.sqrt()), None, Some(0.0)],
            coverage: 0.75,
            width: 9.0,
        };
        assert_eq!(evaluated(&cases).shore, Some(expected));
    }
}
