//! The comparison of the candidates, and the choice.
//!
//! In: what each candidate says of presses that it did not learn from. Out: the best one, what to write, and a
//! [`Report`] of all, with what the figures do not show.

use std::collections::{BTreeMap, BTreeSet};

use indicatif::ProgressBar;
use rayon::prelude::*;
use serde::Serialize;

use super::candidate::Candidate;
use super::folds::{self, Fold};
use crate::data::presses::Presses;
use crate::judge::interval::{self, Drawn, Mean};
use crate::learn::Outputs;
use crate::learn::calibration::{self, Calibration};
use hardnessd_core::verdict::{Knowledge, Level, argmax};
use hardnessd_simulator::random::Stream;

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
    /// What the best one was chosen by.
    pub chosen_by: Option<Division>,
    /// `model` or `references`; null if nothing is written. The built-in model may be the best one as it is.
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

/// The presses of a level.
#[derive(Debug, Serialize)]
pub struct OfLevel {
    /// The level.
    #[serde(flatten)]
    pub level: Level,
    /// The number of its presses.
    pub presses: usize,
    /// The number of its objects.
    pub objects: usize,
}

/// A balanced accuracy, 0..1, or a difference of two.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    /// The mean over the levels of the share that was judged rightly.
    pub balanced_accuracy: f64,
    /// 95 %, by a bootstrap over objects, or over presses where a level has one object. Null where nothing
    /// varies.
    pub interval: Option<[f64; 2]>,
}

impl Estimate {
    /// The low end of the interval, or the value where nothing varies.
    pub(super) fn low(&self) -> f64 {
        self.interval.map_or(self.balanced_accuracy, |[low, _]| low)
    }
}

/// A candidate or the control, with what it said under each division.
pub(super) struct Compared {
    pub(super) row: Row,
    outcomes: [Option<Outcome>; 2],
}

impl Compared {
    pub(super) fn of(
        name: &str,
        outcomes: [Option<Outcome>; 2],
        left_out: Option<String>,
        presses: &Presses,
    ) -> Self {
        let estimate = |of: &Option<Outcome>| Some(estimated(presses, of.as_ref()?.right(presses)));
        let [new_objects, later_presses] = outcomes.each_ref().map(estimate);
        let row = Row {
            name: name.to_owned(),
            new_objects,
            later_presses,
            left_out,
        };
        Self { row, outcomes }
    }

    pub(super) fn outcome(&self, division: Division) -> Option<&Outcome> {
        self.outcomes[division as usize].as_ref()
    }

    fn estimate(&self, division: Division) -> Option<Estimate> {
        match division {
            Division::NewObjects => self.row.new_objects,
            Division::LaterPresses => self.row.later_presses,
        }
    }
}

/// A candidate must be right this much more often than guessing, by the low end of its interval. Less is of
/// no use.
const LEAST_GAIN: f64 = 0.1;

/// The two ways to divide the presses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Division {
    /// Whole objects are judged by what was learnt from others.
    NewObjects,
    /// The later presses of each object are judged by what was learnt from the earlier ones.
    LaterPresses,
}

impl Division {
    pub(super) fn words(self) -> &'static str {
        match self {
            Self::NewObjects => "new objects",
            Self::LaterPresses => "later presses",
        }
    }
}

/// The presses that a candidate judged under one division, in order, each with its logits.
pub(super) struct Outcome(pub(super) Vec<(usize, Vec<f32>)>);

impl Outcome {
    pub(super) fn of(
        candidate: &Candidate,
        presses: &Presses,
        folds: &[Fold],
        seed: u64,
        bar: &ProgressBar,
    ) -> anyhow::Result<Self> {
        let judge = |fold: &Fold| {
            let rows = candidate.judge(presses, fold, seed)?;
            bar.inc(1);
            Ok(fold.test.iter().copied().zip(rows).collect())
        };
        let judged: anyhow::Result<Vec<Vec<_>>> = match candidate {
            // A training takes minutes, so one group of presses has to do.
            Candidate::Hrn => {
                bar.inc(folds.len() as u64 - 1);
                folds.iter().take(1).map(judge).collect()
            }
            _ => folds.par_iter().map(judge).collect(),
        };
        let mut judged = judged?.concat();
        judged.sort_by_key(|(press, _)| *press);
        Ok(Self(judged))
    }

    /// Each press, with 1 where it was judged rightly.
    fn right(&self, presses: &Presses) -> Vec<(usize, f64)> {
        let is_right =
            |press: usize, row: &[f32]| argmax(row).0 + 1 == usize::from(presses.all[press].level);
        let right = self.0.iter();
        right
            .map(|(press, row)| (*press, f64::from(u8::from(is_right(*press, row)))))
            .collect()
    }

    /// The calibration of a model that was judged so.
    pub(super) fn calibration(
        &self,
        presses: &Presses,
        outputs: &Outputs,
        stream: &mut Stream,
    ) -> Calibration {
        let judged = self.0.iter().map(|(place, row)| {
            let press = &presses.all[*place];
            let object = press.object.map_or(u64::MAX - *place as u64, |object| {
                u64::from(object) << 8 | u64::from(press.level)
            });
            calibration::Judged {
                unit: object,
                level: usize::from(press.level) - 1,
                shore: press.shore,
                row: row.clone(),
            }
        });
        let judged = BTreeMap::from([(Knowledge::None, judged.collect())]);
        Calibration::on(&judged, outputs, stream)
    }
}

/// The best candidate, and what to write.
pub(super) struct Choice {
    /// The place of the best candidate.
    pub(super) best: Option<usize>,
    pub(super) division: Division,
    /// The place of the candidate that is written. The built-in model, which is the first, gets references.
    pub(super) writes: Option<usize>,
    pub(super) remarks: Vec<String>,
}

/// All outcomes.
pub(super) struct Comparison<'a> {
    pub(super) presses: &'a Presses,
    pub(super) places: &'a [usize],
    /// Whether the daemon uses these presses as references of the built-in model.
    pub(super) has_references: bool,
    pub(super) candidates: Vec<Compared>,
    pub(super) control: Compared,
}

impl Comparison<'_> {
    /// The choice: by new objects, or where nothing there is better than guessing, by later presses.
    pub(super) fn choice(&self) -> Choice {
        let has_built_in = self.candidates[0].row.left_out.is_none();
        let of_built_in = match self.has_references {
            true => "these presses become references of the built-in model",
            false => {
                "use it as it is. As its references these presses make verdicts on each other worse, so the daemon \
                 would not use them, and they are not written"
            }
        };
        let mut remarks = self.remarks_on_objects();
        for division in [Division::NewObjects, Division::LaterPresses] {
            let Some(best) = self.best(division) else {
                continue;
            };
            let found = self.candidates[best].estimate(division);
            let least = self.guessing(division) + LEAST_GAIN;
            if found.is_none_or(|found| found.low() < least) {
                continue;
            }
            let name = &self.candidates[best].row.name;
            let lead = |other: &Compared| {
                let other = other.outcome(division)?.right(self.presses);
                let other: BTreeMap<usize, f64> = other.into_iter().collect();
                let of_best = self.candidates[best].outcome(division)?.right(self.presses);
                let of_both = of_best.into_iter().filter_map(|(press, right)| {
                    other.get(&press).map(|other| (press, right - other))
                });
                Some(estimated(self.presses, of_both.collect()))
            };
            let control = self.control.estimate(division);
            if let (Some(control), Some(lead)) = (control, lead(&self.control))
                && control.low() > self.guessing(division)
                && lead.low() <= 0.0
            {
                remarks.push(format!(
                    "the unloaded sensor alone tells the levels as well as {name}: the sessions tell them apart, and \
                     not the hardness. Record each object in several sessions, all objects in turn, with a new zero \
                     before each"
                ));
            }
            if division == Division::LaterPresses {
                let on_new = self.candidates[best].row.new_objects;
                let on_new = on_new.map_or_else(String::new, |new| {
                    format!(
                        ", where it is right in {:.0} %",
                        100.0 * new.balanced_accuracy
                    )
                });
                remarks.push(format!(
                    "{name} knows the objects that were recorded when they are pressed again. Do not use it for other \
                     objects{on_new}: no candidate is shown to be of use there. Record more objects of each level, of \
                     several shapes"
                ));
            }
            let is_ahead = |lead: Estimate| lead.low() > 0.0;
            let writes = if has_built_in && best == 0 {
                remarks.push(format!("the built-in model is the best one: {of_built_in}"));
                0
            } else if has_built_in && !lead(&self.candidates[0]).is_none_or(is_ahead) {
                remarks.push(format!(
                    "{name} is not better than the built-in model by more than chance: {of_built_in}"
                ));
                0
            } else {
                best
            };
            return Choice {
                best: Some(best),
                division,
                writes: Some(writes),
                remarks,
            };
        }
        let none = "no candidate is shown to be of use";
        remarks.push(match (self.has_references, has_built_in) {
            (true, _) => format!("{none}: {of_built_in}, and more presses may show more"),
            (false, true) => format!(
                "{none}, and as references of the built-in model these presses make verdicts on each other worse: \
                 press more objects of each level"
            ),
            (false, false) => format!("{none}: press more objects of each level"),
        });
        let division = match self.best(Division::NewObjects) {
            Some(_) => Division::NewObjects,
            None => Division::LaterPresses,
        };
        Choice {
            best: self.best(division),
            division,
            writes: self.has_references.then_some(0),
            remarks,
        }
    }

    /// What the objects cannot show.
    fn remarks_on_objects(&self) -> Vec<String> {
        let levels = self.of_levels().into_iter().filter(|of| of.presses > 0);
        let (alone, others): (Vec<_>, Vec<_>) = levels.partition(|of| of.objects == 1);
        let alone: Vec<&str> = alone.iter().map(|of| of.level.label.as_str()).collect();
        if others.len() < 2 {
            return vec![format!(
                "only one object is of level {}: nothing shows whether its hardness or the object is recognised. Record \
                 at least two objects of each level, of several shapes",
                alone.join(", ")
            )];
        }
        let remark = format!(
            "only one object is of level {}: its presses are learnt from, and not judged as those of a new object",
            alone.join(", ")
        );
        match alone.is_empty() {
            true => Vec::new(),
            false => vec![remark],
        }
    }

    /// The place of the candidate with the greatest balanced accuracy, the first of equal ones.
    fn best(&self, division: Division) -> Option<usize> {
        let found = self.candidates.iter().enumerate().rev();
        let found = found.filter_map(|(place, of)| Some((place, of.estimate(division)?)));
        let accuracy = |(_, of): &(usize, Estimate)| of.balanced_accuracy;
        let best = found.max_by(|one, other| accuracy(one).total_cmp(&accuracy(other)));
        best.map(|(place, _)| place)
    }

    /// The balanced accuracy of guessing.
    fn guessing(&self, division: Division) -> f64 {
        let outcomes = self.candidates.iter().filter_map(|of| of.outcome(division));
        let judged = outcomes.flat_map(|outcome| &outcome.0);
        let levels = judged.map(|(press, _)| self.presses.all[*press].level);
        1.0 / levels.collect::<BTreeSet<u8>>().len().max(1) as f64
    }

    fn of_levels(&self) -> Vec<OfLevel> {
        let objects = folds::objects(self.presses, self.places);
        let levels = self.presses.levels().into_iter().map(|level| {
            let own = || objects.iter().filter(|((of, ..), _)| *of == level.level);
            OfLevel {
                presses: own().map(|(_, presses)| presses.len()).sum(),
                objects: own().count(),
                level,
            }
        });
        levels.collect()
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
        let best = choice.best.map(|best| &self.candidates[best]);
        let levels = self.presses.levels();
        let (mut confusion, mut wrong) = (Vec::new(), Vec::new());
        if let Some(Outcome(judged)) = best.and_then(|best| best.outcome(choice.division)) {
            confusion = vec![vec![0; levels.len()]; levels.len()];
            for (place, row) in judged {
                let press = &self.presses.all[*place];
                let (said, level) = (argmax(row).0, usize::from(press.level) - 1);
                confusion[level][said] += 1;
                if said != level {
                    let name = press.name.clone();
                    wrong.push(Wrong {
                        press: name.unwrap_or_else(|| format!("press {place}")),
                        level: levels[level].label.clone(),
                        said: levels[said].label.clone(),
                    });
                }
            }
        }
        Report {
            presses: self.places.len(),
            levels: self.of_levels(),
            candidates: self.candidates.iter().map(|of| of.row.clone()).collect(),
            controls: vec![guessing, self.control.row.clone()],
            best: best.map(|best| best.row.name.clone()),
            chosen_by: best.map(|_| choice.division),
            writes: choice.writes.and_then(|place| match place {
                0 => self.has_references.then_some("references"),
                _ => Some("model"),
            }),
            confusion,
            wrong,
            remarks: choice.remarks.clone(),
        }
    }
}

/// The mean over the levels of values of presses, with its interval.
fn estimated(presses: &Presses, values: Vec<(usize, f64)>) -> Estimate {
    let places: Vec<usize> = values.iter().map(|(press, _)| *press).collect();
    let objects = folds::objects(presses, &places);
    let of_level = |level| objects.keys().filter(|(of, ..)| *of == level).count();
    let has_several = objects.keys().all(|(level, ..)| of_level(*level) > 1);
    let units = objects.values().zip(0_u32..);
    let units = units.flat_map(|(own, unit)| own.iter().map(move |&press| (press, unit)));
    let units: BTreeMap<usize, u32> = units.collect();
    let drawn = values.into_iter().map(|(press, value)| Drawn {
        stratum: presses.all[press].level,
        unit: if has_several {
            units[&press]
        } else {
            press as u32
        },
        value,
    });
    let drawn: Vec<Drawn> = drawn.collect();
    Estimate {
        balanced_accuracy: interval::mean(&drawn, Mean::OfStrata),
        interval: interval::of(&drawn, Mean::OfStrata),
    }
}
