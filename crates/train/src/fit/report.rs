//! The report of a comparison, as `fit` prints it.

use serde::Serialize;

use super::comparison::{Choice, Compared, Comparison, Division, Estimate, OfLevel, What};
use crate::judge::metrics::{Evaluation, Judged};
use crate::learn::Outputs;
use hardnessd_core::verdict::argmax;

/// What was compared, as `--json` prints it.
#[derive(Debug, Serialize)]
pub struct Report {
    /// The number of labelled presses.
    pub presses: usize,
    /// The levels, with what there is of each.
    pub levels: Vec<OfLevel>,
    /// The candidates.
    pub candidates: Vec<Row>,
    /// What needs no press: guessing, and the unloaded sensor.
    pub controls: Vec<Row>,
    /// The best candidate.
    pub best: Option<String>,
    /// What the best one was chosen by: `new_objects` or `later_presses`.
    pub chosen_by: Option<&'static str>,
    /// `model` or `references`; null if nothing is written.
    pub writes: Option<&'static str>,
    /// Counts of the best candidate; rows are the truth, columns the verdict.
    pub confusion: Vec<Vec<u64>>,
    /// The presses that the best candidate judged wrongly.
    pub wrong: Vec<Wrong>,
    /// What the figures say, a sentence each.
    pub remarks: Vec<String>,
}

/// What a candidate or a control reaches.
#[derive(Debug, Clone, Serialize)]
pub struct Row {
    /// Its name.
    pub name: String,
    /// On objects that it has not met.
    pub new_objects: Option<Estimate>,
    /// On the later presses of each object, after it learnt from the earlier ones.
    pub later_presses: Option<Estimate>,
    /// Why it was left out.
    pub left_out: Option<String>,
}

/// A press that was judged wrongly.
#[derive(Debug, Serialize)]
pub struct Wrong {
    /// The press: its recording and its number there, or its place in the data set.
    pub press: String,
    /// The labels of its level and of the verdict's.
    pub level: String,
    /// The label of the verdict's level.
    pub said: String,
}

impl Comparison<'_> {
    fn row(&self, of: &Compared) -> Row {
        Row {
            name: of.name.to_owned(),
            new_objects: self.estimate(of, Division::NewObjects),
            later_presses: self.estimate(of, Division::LaterPresses),
            left_out: of.left_out.clone(),
        }
    }

    pub(super) fn report(&self, choice: &Choice) -> Report {
        let guess = |division| {
            self.best(division).map(|_| Estimate {
                balanced_accuracy: self.guessing(division),
                interval: None,
            })
        };
        let guessing = Row {
            name: "guessing".to_owned(),
            new_objects: guess(Division::NewObjects),
            later_presses: guess(Division::LaterPresses),
            left_out: None,
        };
        let levels = self.presses.levels();
        let label = |level: usize| levels[level].label.clone();
        let judged = choice
            .best
            .and_then(|best| self.candidates[best].outcomes[choice.division as usize].as_ref());
        let judged = judged.map_or(&[][..], |outcome| &outcome.0);
        let wrong = judged.iter().filter_map(|(place, row)| {
            let press = &self.presses.all[*place];
            let (said, level) = (argmax(row).0, usize::from(press.level) - 1);
            (said != level).then(|| Wrong {
                press: press
                    .name
                    .clone()
                    .unwrap_or_else(|| format!("press {place}")),
                level: label(level),
                said: label(said),
            })
        });
        let all = judged.iter().map(|(place, row)| Judged {
            level: self.presses.all[*place].level,
            probabilities: Outputs::Levels.probabilities(row, 1.0),
            unit: None,
        });
        let all: Vec<Judged> = all.collect();
        Report {
            presses: self.places.len(),
            levels: self.of_levels(),
            candidates: self.candidates.iter().map(|of| self.row(of)).collect(),
            controls: vec![guessing, self.row(&self.control)],
            best: choice
                .best
                .map(|best| self.candidates[best].name.to_owned()),
            chosen_by: choice.best.map(|_| match choice.division {
                Division::NewObjects => "new_objects",
                Division::LaterPresses => "later_presses",
            }),
            writes: choice.writes.map(|what| match what {
                What::Model(_) => "model",
                What::References => "references",
            }),
            confusion: match all.is_empty() {
                true => Vec::new(),
                false => Evaluation::of(&all, levels.len()).confusion,
            },
            wrong: wrong.collect(),
            remarks: choice.remarks.clone(),
        }
    }
}
