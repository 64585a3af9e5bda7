//! Evaluates a model's verdicts: levels, Shore hardness and sets of levels.

use serde::{Deserialize, Serialize};

use crate::judge::metrics::{Evaluation, Judged};
use hardnessd_core::verdict::{Shore, Verdict};

/// A verdict on a labelled sample or press, and the truth.
#[derive(Debug, Clone)]
pub struct Case {
    /// The hardness level.
    pub level: u8,
    /// The Shore hardness, if it is known.
    pub shore: Option<f32>,
    /// The number of the object, if it is known.
    pub object: Option<u32>,
    /// The verdict.
    pub verdict: Verdict,
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
pub fn judged(cases: &[Case]) -> Vec<Judged> {
    let judged = |case: &Case| Judged {
        level: case.level,
        probabilities: case.verdict.probabilities.clone(),
        object: case.object,
    };
    cases.iter().map(judged).collect()
}

impl Evaluated {
    /// Evaluates at least one verdict of a model of `levels` levels.
    pub fn of(cases: &[Case], levels: usize) -> Self {
        let far = cases
            .iter()
            .filter(|case| case.level.abs_diff(case.verdict.level) > 1);
        Self {
            levels: Evaluation::of(&judged(cases), levels),
            beyond_neighbour: far.count() as f64 / cases.len() as f64,
            shore: shore(cases, levels),
            sets: sets(cases),
        }
    }
}

/// The evaluation of the Shore hardness of verdicts; `None` for a model or data without it.
pub fn shore(cases: &[Case], levels: usize) -> Option<ShoreEvaluation> {
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
    let is_near = |truth: f64| {
        hardnessd_simulator::borders().any(|border| (truth - border).abs() <= NEAR_BORDER)
    };
    let n = pairs.len() as f64;
    let held = pairs
        .iter()
        .filter(|(_, truth, shore)| (f64::from(shore.low)..=f64::from(shore.high)).contains(truth));
    Some(ShoreEvaluation {
        rmse: rmse(&|_, _| true).expect("there are verdicts"),
        rmse_by_level: (1..=levels as u8)
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

    #[test]
    fn shore_is_evaluated_over_all_over_each_level_and_near_the_borders() {
        let case = |(level, truth, value): (u8, f32, f32)| Case {
            level,
            shore: Some(truth),
            object: None,
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
        // The borders are 50, 60 and 70. The second verdict alone does not hold the truth.
        let cases = [
            (1, 80.0, 83.0),
            (2, 63.0, 57.0),
            (2, 65.0, 63.0),
            (4, 30.0, 30.0),
        ]
        .map(case);
        let found = shore(&cases, 4).unwrap();
        let expected = ShoreEvaluation {
            rmse: (49.0_f64 / 4.0).sqrt(),
            rmse_by_level: vec![Some(3.0), Some(20.0_f64.sqrt()), None, Some(0.0)],
            rmse_near_borders: Some(6.0),
            coverage: 0.75,
            width: 9.0,
        };
        assert_eq!(found, expected);
        assert_eq!(shore(&cases[3..], 4).unwrap().rmse_near_borders, None);
    }
}
