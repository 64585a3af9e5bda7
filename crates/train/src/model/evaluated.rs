//! Evaluates a model's verdicts: levels, Shore hardness and sets of levels.

use serde::{Deserialize, Serialize};

use crate::data::presses::{Presses, Unit};
use crate::judge::interval::{self, Drawn, Mean};
use crate::judge::metrics::{Evaluation, Judged};
use hardnessd_core::verdict::{Borders, Level, Shore, Verdict};

/// A verdict on a labelled press, and the truth.
#[derive(Debug, Clone)]
pub struct Case {
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

/// Verdicts on presses in the form that is evaluated.
pub fn cases(presses: &Presses, verdicts: &[(usize, Verdict)]) -> Vec<Case> {
    let places: Vec<usize> = verdicts.iter().map(|&(place, _)| place).collect();
    let units = presses.units(&places);
    let case = |(number, (place, verdict)): (usize, &(usize, Verdict))| {
        let press = &presses.all[*place];
        Case {
            level: press.level,
            shore: press.shore,
            object: press.object,
            unit: units
                .as_ref()
                .map(|(unit, numbers)| (*unit, numbers[number])),
            verdict: verdict.clone(),
        }
    };
    verdicts.iter().enumerate().map(case).collect()
}

/// The evaluation of a model, which `evaluate --json` prints.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evaluated {
    /// The evaluation of the levels.
    #[serde(flatten)]
    pub levels: Evaluation,
    /// Share of verdicts whose level is off by more than one.
    pub beyond_neighbour: f64,
    /// The evaluation of the Shore hardness; null for a model or data without it.
    pub shore: Option<ShoreEvaluation>,
    /// The evaluation of the sets of levels; null for a model without them.
    pub sets: Option<SetEvaluation>,
}

/// The evaluation of the Shore hardness.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ShoreEvaluation {
    /// Root mean square error, in Shore OO.
    pub rmse: f64,
    /// Root mean square error of each level; null for a level without verdicts.
    pub rmse_by_level: Vec<Option<f64>>,
    /// Root mean square error where the truth is at most [`NEAR_BORDER`] from a border of two
    /// levels; null without such verdicts.
    pub rmse_near_borders: Option<f64>,
    /// Share of verdicts whose interval contains the true hardness. The model promises 0.9.
    pub coverage: f64,
    /// Mean width of the intervals, in Shore OO.
    pub width: f64,
}

/// The evaluation of the sets of levels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SetEvaluation {
    /// Share of verdicts whose set contains the true level. The model promises 0.9.
    pub coverage: f64,
    /// Share of verdicts whose set has more than one level. Such verdicts are rejected as ambiguous.
    pub ambiguous: f64,
    /// Accuracy of the verdicts that are not ambiguous; null if there are none.
    pub accuracy_of_others: Option<f64>,
}

/// The distance from a border of two levels that counts as near, in Shore OO.
pub const NEAR_BORDER: f64 = 3.0;

/// The verdicts in the form that the metrics take.
fn judged(cases: &[Case]) -> Vec<Judged> {
    let judged = |case: &Case| Judged {
        level: case.level,
        probabilities: case.verdict.probabilities.clone(),
        unit: case.unit,
    };
    cases.iter().map(judged).collect()
}

impl Evaluated {
    /// Evaluates at least one verdict of a model of these levels.
    pub fn of(cases: &[Case], levels: &[Level]) -> Self {
        let far = cases
            .iter()
            .filter(|case| case.level.abs_diff(case.verdict.level) > 1);
        Self {
            levels: Evaluation::of(&judged(cases), levels.len()),
            beyond_neighbour: far.count() as f64 / cases.len() as f64,
            shore: shore(cases, levels),
            sets: sets(cases),
        }
    }
}

/// What a second model does better than a first one, on the same presses.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
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
        let is_right = |case: &Case| case.level == case.verdict.level;
        let pairs: Vec<[bool; 2]> = first
            .iter()
            .zip(second)
            .map(|(first, second)| [is_right(first), is_right(second)])
            .collect();
        let value = |[first, second]: [bool; 2]| f64::from(i8::from(second) - i8::from(first));
        let drawn: Option<Vec<Drawn>> = first
            .iter()
            .zip(&pairs)
            .map(|(case, &pair)| {
                Some(Drawn {
                    stratum: case.level,
                    unit: case.unit?.1,
                    value: value(pair),
                })
            })
            .collect();
        let count = |wanted| pairs.iter().filter(|&&pair| pair == wanted).count();
        Self {
            accuracy: pairs.iter().map(|&pair| value(pair)).sum::<f64>() / pairs.len() as f64,
            interval: drawn.and_then(|drawn| interval::of(&drawn, Mean::OfPresses)),
            only: [count([true, false]), count([false, true])],
        }
    }
}

/// The evaluation of the Shore hardness of verdicts; `None` for a model or data without it.
fn shore(cases: &[Case], levels: &[Level]) -> Option<ShoreEvaluation> {
    let both = |case: &Case| Some((case.level, f64::from(case.shore?), case.verdict.shore?));
    let pairs: Vec<(u8, f64, Shore)> = cases.iter().filter_map(both).collect();
    if pairs.is_empty() {
        return None;
    }
    let rmse = |of: &dyn Fn(u8, f64) -> bool| {
        let errors: Vec<f64> = pairs
            .iter()
            .filter(|(level, truth, _)| of(*level, *truth))
            .map(|(_, truth, shore)| (f64::from(shore.value) - truth).powi(2))
            .collect();
        (!errors.is_empty()).then(|| (errors.iter().sum::<f64>() / errors.len() as f64).sqrt())
    };
    let borders: Vec<f64> = Borders::of(levels).map_or_else(
        |_| Vec::new(),
        |borders| {
            (1..levels.len())
                .map(|place| borders.part(place)[1].into())
                .collect()
        },
    );
    let is_near = |truth: f64| {
        borders
            .iter()
            .any(|border| (truth - border).abs() <= NEAR_BORDER)
    };
    let n = pairs.len() as f64;
    let held = pairs
        .iter()
        .filter(|(_, truth, shore)| (f64::from(shore.low)..=f64::from(shore.high)).contains(truth));
    Some(ShoreEvaluation {
        rmse: rmse(&|_, _| true).expect("there are verdicts"),
        rmse_by_level: (1..=levels.len() as u8)
            .map(|level| rmse(&|of, _| of == level))
            .collect(),
        rmse_near_borders: rmse(&|_, truth| is_near(truth)),
        coverage: held.count() as f64 / n,
        width: pairs
            .iter()
            .map(|(.., shore)| f64::from(shore.high - shore.low))
            .sum::<f64>()
            / n,
    })
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

    #[test]
    fn two_models_are_compared_press_by_press() {
        let case = |object: u32, level: u8, said: u8| Case {
            level,
            shore: None,
            object: Some(object),
            unit: Some((Unit::Object, object)),
            verdict: Verdict {
                level: said,
                logits: Vec::new(),
                probabilities: Vec::new(),
                confidence: 1.0,
                shore: None,
                levels: None,
            },
        };
        let truth = |object: u32| 1 + (object / 20) as u8;
        // The second one is right on every third object of those that the first one has wrong.
        let first: Vec<Case> = (0..40)
            .map(|object| case(object, truth(object), 9))
            .collect();
        let second = |object: u32| match object % 3 {
            0 => truth(object),
            _ => 9,
        };
        let second: Vec<Case> = (0..40)
            .map(|object| case(object, truth(object), second(object)))
            .collect();
        let found = Difference::of(&first, &second);
        assert_eq!((found.accuracy, found.only), (0.35, [0, 14]));
        let [low, high] = found.interval.unwrap();
        assert!(
            low > 0.15 && low < 0.3 && high > 0.4 && high < 0.55,
            "{found:?}"
        );
        assert_eq!(Difference::of(&second, &first).accuracy, -0.35);
        assert_eq!(Difference::of(&first, &first).interval, None);
    }

    #[test]
    fn shore_is_evaluated_over_all_over_each_level_and_near_the_borders() {
        let case = |(level, truth, value): (u8, f32, f32)| Case {
            level,
            shore: Some(truth),
            object: None,
            unit: None,
            verdict: Verdict {
                level,
                logits: Vec::new(),
                probabilities: Vec::new(),
                confidence: 1.0,
                shore: Some(Shore {
                    value,
                    low: value - 4.0,
                    high: value + 5.0,
                }),
                levels: None,
            },
        };
        // The paper's borders are 50.5, 60.5 and 70.5. The second verdict alone does not hold the truth.
        let cases = [
            (1, 80.0, 83.0),
            (2, 63.0, 57.0),
            (2, 65.0, 63.0),
            (4, 30.0, 30.0),
        ]
        .map(case);
        let found = shore(&cases, &papers_levels()).unwrap();
        let expected = ShoreEvaluation {
            rmse: (49.0_f64 / 4.0).sqrt(),
            rmse_by_level: vec![Some(3.0), Some(20.0_f64.sqrt()), None, Some(0.0)],
            rmse_near_borders: Some(6.0),
            coverage: 0.75,
            width: 9.0,
        };
        assert_eq!(found, expected);
        assert_eq!(
            shore(&cases[3..], &papers_levels())
                .unwrap()
                .rmse_near_borders,
            None
        );
    }
}
