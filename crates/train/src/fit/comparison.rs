//! The comparison of the candidates, and the choice.
//!
//! In: what each candidate says of presses that it did not learn from. Out: the best one, what to write, and a
//! [`Report`] of all, with what the figures do not show.

use std::collections::{BTreeMap, BTreeSet};

use indicatif::ProgressBar;
use rayon::prelude::*;
use serde::Serialize;

use super::candidate::Candidate;
use super::folds::Fold;
use crate::data::presses::{Presses, Unit};
use crate::judge::interval::{self, Drawn, Mean};
use crate::learn::Outputs;
use crate::learn::calibration::{self, Calibration};
use hardnessd_core::verdict::{Knowledge, Level, argmax};
use hardnessd_simulator::random::Stream;

/// A candidate must be right this much more often than guessing, by the low end of its interval. Less is of
/// no use.
const LEAST_GAIN: f64 = 0.1;

/// What was compared, as `--json` prints it.
#[derive(Debug, Serialize)]
pub struct Report {
    /// The number of labelled presses.
    pub presses: usize,
    /// The levels, with what there is of each.
    pub levels: Vec<OfLevel>,
    /// The candidates. The built-in model is the first.
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
#[derive(Debug, Default, Serialize)]
pub struct Row {
    /// Its name.
    pub name: String,
    /// On objects that it has not met.
    pub new_objects: Option<Estimate>,
    /// On the later presses of each object, after it learnt from the earlier ones.
    pub later_presses: Option<Estimate>,
    /// Why it was left out.
    pub left_out: Option<String>,
    /// What it said under each division.
    #[serde(skip)]
    pub(super) judged: [Option<Judged>; 2],
}

/// The presses that were judged under one division, in order, each with its logits.
pub(super) type Judged = Vec<(usize, Vec<f32>)>;

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
    /// 95 %, over objects, or over the later presses of known objects where a level has one object.
    pub interval: Option<[f64; 2]>,
    /// The low end of the bootstrap's intervals alone, over objects and over presses, by which a candidate is chosen: two
    /// objects a level may be alike by chance. If nothing varies, it is the value: a few objects that are all judged
    /// rightly are worth a model, whose confidence is as low as they are few.
    #[serde(skip)]
    worth: f64,
}

impl Estimate {
    /// The mean over the levels of values of presses, with its interval.
    fn of(presses: &Presses, values: &[(usize, f64)], division: Division) -> Self {
        let places: Vec<usize> = values.iter().map(|(press, _)| *press).collect();
        let objects = presses.by_object(&places);
        let mut counts = BTreeMap::<u8, usize>::new();
        for (_, level, ..) in objects.keys() {
            *counts.entry(*level).or_default() += 1;
        }
        let has_several = counts.values().all(|&count| count > 1);
        let units = objects.values().zip(0_u32..);
        let units = units.flat_map(|(own, unit)| own.iter().map(move |&press| (press, unit)));
        let units: BTreeMap<usize, u32> = units.collect();
        let drawn = |by_object: bool| -> Vec<Drawn> {
            let one = |&(press, value): &(usize, f64)| Drawn {
                stratum: presses.all[press].level,
                unit: match by_object {
                    true => units[&press],
                    false => press as u32,
                },
                value,
            };
            values.iter().map(one).collect()
        };
        let balanced_accuracy = interval::mean(&drawn(false), Mean::OfStrata);
        let low = |by_object| match interval::of(&drawn(by_object), Mean::OfStrata) {
            Some([low, _]) if balanced_accuracy < 1.0 => low,
            // One press of a level says little, unless all are right.
            None if balanced_accuracy < 1.0 => 0.0,
            _ => balanced_accuracy,
        };
        let worth = low(has_several).min(low(false));
        let shown = drawn(has_several || division == Division::NewObjects);
        Self {
            balanced_accuracy,
            interval: interval::of_balanced(&shown),
            worth,
        }
    }
}

/// The two ways to divide the presses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Division {
    /// Whole objects are judged by what was learnt from others.
    NewObjects,
    /// The later presses of each object are judged by what was learnt from the earlier ones.
    LaterPresses,
}

impl Row {
    pub(super) fn of(
        name: &str,
        judged: [Option<Judged>; 2],
        left_out: Option<String>,
        presses: &Presses,
    ) -> Self {
        let estimate = |division| {
            let judged: &Option<Judged> = &judged[division as usize];
            let right = right(presses, judged.as_ref()?);
            Some(Estimate::of(presses, &right, division))
        };
        let [new_objects, later_presses] =
            [Division::NewObjects, Division::LaterPresses].map(estimate);
        Self {
            name: name.to_owned(),
            new_objects,
            later_presses,
            left_out,
            judged,
        }
    }

    pub(super) fn judged(&self, division: Division) -> Option<&Judged> {
        self.judged[division as usize].as_ref()
    }

    fn estimate(&self, division: Division) -> Option<Estimate> {
        match division {
            Division::NewObjects => self.new_objects,
            Division::LaterPresses => self.later_presses,
        }
    }

    /// How much more often it is right than another one, on the presses that both judged.
    fn lead(&self, other: &Self, division: Division, presses: &Presses) -> Option<Estimate> {
        let other = right(presses, other.judged(division)?);
        let other: BTreeMap<usize, f64> = other.into_iter().collect();
        let own = right(presses, self.judged(division)?).into_iter();
        let of_both = own.filter_map(|(press, right)| Some((press, right - other.get(&press)?)));
        let of_both: Vec<(usize, f64)> = of_both.collect();
        Some(Estimate::of(presses, &of_both, division))
    }
}

/// What a candidate says of the presses of all folds.
pub(super) fn judge(
    candidate: &Candidate,
    presses: &Presses,
    folds: &[Fold],
    bar: &ProgressBar,
) -> anyhow::Result<Judged> {
    let judge = |fold: &Fold| {
        let rows = candidate.judge(presses, fold)?;
        bar.inc(1);
        Ok(fold.test.iter().copied().zip(rows).collect())
    };
    let judged: anyhow::Result<Vec<Judged>> = match candidate {
        // A training takes minutes, so one group of presses has to do.
        Candidate::Hrn => {
            bar.inc(folds.len() as u64 - 1);
            folds.iter().take(1).map(judge).collect()
        }
        _ => folds.par_iter().map(judge).collect(),
    };
    let mut judged = judged?.concat();
    judged.sort_by_key(|(press, _)| *press);
    Ok(judged)
}

/// Each press, with 1 where it was judged rightly.
fn right(presses: &Presses, judged: &Judged) -> Vec<(usize, f64)> {
    let right = judged.iter().map(|(press, row)| {
        let is_right = argmax(row).0 + 1 == usize::from(presses.all[*press].level);
        (*press, f64::from(u8::from(is_right)))
    });
    right.collect()
}

/// Which candidates were judged on some of the presses only.
fn partly_judged(candidates: &[Row]) -> Option<String> {
    let judged = |row: &Row| row.judged(Division::NewObjects).map_or(0, Vec::len);
    let most = candidates.iter().map(judged).max()?;
    let is_partly = |row: &&Row| (1..most).contains(&judged(row));
    let row = candidates.iter().find(is_partly)?;
    Some(format!(
        "{} is judged on {} of the {most} presses of new objects, because it takes minutes to learn from the others: compare \
         its figures by their intervals",
        row.name,
        judged(row)
    ))
}

/// The calibration of a model that was judged so.
pub(super) fn calibration(
    judged: &Judged,
    presses: &Presses,
    outputs: &Outputs,
    stream: &mut Stream,
) -> Calibration {
    let judged = judged.iter().map(|(place, row)| {
        let press = &presses.all[*place];
        let of_level = |object| u64::from(object) << 8 | u64::from(press.level);
        calibration::Judged::of(presses, *place, press.object.map(of_level), row.clone())
    });
    let judged = BTreeMap::from([(Knowledge::None, judged.collect())]);
    Calibration::on(&judged, Unit::Object, outputs, stream)
}

/// All that was compared.
pub(super) struct Comparison<'a> {
    pub(super) presses: &'a Presses,
    pub(super) places: &'a [usize],
    /// Whether the daemon uses these presses as references of the built-in model.
    pub(super) has_references: bool,
    /// The built-in model is the first.
    pub(super) candidates: Vec<Row>,
    pub(super) control: Row,
}

impl Comparison<'_> {
    /// The report, and the place of the candidate that is written. The built-in model gets references. The best
    /// candidate is chosen by new objects, or where nothing there is better than guessing, by later presses.
    pub(super) fn report(self) -> (Report, Option<usize>) {
        let mut remarks = self.remarks_on_objects();
        remarks.extend(partly_judged(&self.candidates));
        if !self.has_references && self.candidates[0].left_out.is_none() {
            remarks.push(
                "as references of the built-in model these presses make verdicts on each other worse, so the daemon would \
                 not use them, and they are not written"
                    .to_owned(),
            );
        }
        let divisions = [Division::NewObjects, Division::LaterPresses];
        let useful = divisions.into_iter().find_map(|division| {
            let best = self.best(division)?;
            let found = self.candidates[best].estimate(division)?;
            let least = self.guessing(division) + LEAST_GAIN;
            (found.worth >= least).then_some((division, best))
        });
        let (division, best, place) = match useful {
            Some((division, best)) => {
                let place = self.choose(division, best, &mut remarks);
                (division, Some(best), Some(place))
            }
            None => {
                let then = match self.has_references {
                    true => {
                        "these presses become references of the built-in model, and more may show more"
                    }
                    false => "press more objects of each level",
                };
                remarks.push(format!("no candidate is shown to be of use: {then}"));
                let of_new = self.best(Division::NewObjects);
                let division = match of_new {
                    Some(_) => Division::NewObjects,
                    None => Division::LaterPresses,
                };
                let place = self.has_references.then_some(0);
                (division, self.best(division), place)
            }
        };
        let guess = |division| {
            self.best(division).map(|_| Estimate {
                balanced_accuracy: self.guessing(division),
                interval: None,
                worth: self.guessing(division),
            })
        };
        let guessing = Row {
            name: "guessing".to_owned(),
            new_objects: guess(Division::NewObjects),
            later_presses: guess(Division::LaterPresses),
            ..Row::default()
        };
        let best = best.map(|best| &self.candidates[best]);
        let judged = best.and_then(|best| best.judged(division));
        let (confusion, wrong) = judged.map(|of| self.errors(of)).unwrap_or_default();
        let report = Report {
            presses: self.places.len(),
            levels: self.of_levels(),
            best: best.map(|best| best.name.clone()),
            chosen_by: best.map(|_| division),
            writes: place.and_then(|place| match place {
                0 => self.has_references.then_some("references"),
                _ => Some("model"),
            }),
            confusion,
            wrong,
            remarks,
            candidates: self.candidates,
            controls: vec![guessing, self.control],
        };
        (report, place)
    }

    /// The place of what is written, where the candidate in the place `best` is of use. Adds what its user must know.
    fn choose(&self, division: Division, best: usize, remarks: &mut Vec<String>) -> usize {
        let (row, built_in) = (&self.candidates[best], &self.candidates[0]);
        let name = &row.name;
        let lead = |other: &Row| row.lead(other, division, self.presses);
        let is_no_better = |other: &Row| lead(other).is_some_and(|lead| lead.worth <= 0.0);
        let control = self.control.estimate(division);
        let tells = |control: Estimate| control.worth > self.guessing(division);
        let are_sessions = control.is_some_and(tells) && is_no_better(&self.control);
        if are_sessions {
            remarks.push(format!(
                "the unloaded sensor alone tells the levels as well as {name}: the sessions tell them apart, and not the \
                 hardness. Record each object in several sessions, all objects in turn, with a new zero before each"
            ));
        }
        if division == Division::LaterPresses {
            let on_new = row.new_objects.map_or_else(String::new, |new| {
                let percent = 100.0 * new.balanced_accuracy;
                format!(", where it is right in {percent:.0} %")
            });
            remarks.push(format!(
                "{name} knows the objects that were recorded when they are pressed again. Do not use it for other \
                 objects{on_new}: no candidate is shown to be of use there. Record more objects of each level, of several \
                 shapes"
            ));
        }
        if best > 0 && !are_sessions && !is_no_better(built_in) {
            return best;
        }
        let why = match best {
            0 => "the built-in model is the best one".to_owned(),
            _ if are_sessions => format!("{name} may know the sessions alone"),
            _ => format!("{name} is not better than the built-in model by more than chance"),
        };
        let then = match self.has_references {
            true => "these presses become its references",
            false => "use it as it is",
        };
        remarks.push(format!("{why}: {then}"));
        0
    }

    /// What the objects cannot show.
    fn remarks_on_objects(&self) -> Vec<String> {
        let (unseen, levels): (Vec<_>, Vec<_>) =
            self.of_levels().into_iter().partition(|of| of.objects == 0);
        let mut remarks = Vec::new();
        if !unseen.is_empty() {
            let unseen: Vec<&str> = unseen.iter().map(|of| of.level.label.as_str()).collect();
            let unseen = unseen.join(", ");
            remarks.push(format!(
                "no press is of level {unseen}: what learns from these presses never names it"
            ));
        }
        let (alone, others): (Vec<_>, Vec<_>) = levels.into_iter().partition(|of| of.objects == 1);
        if alone.is_empty() {
            return remarks;
        }
        let alone: Vec<&str> = alone.iter().map(|of| of.level.label.as_str()).collect();
        let shown = match others.len() {
            0 | 1 => {
                "nothing shows whether its hardness or the object is recognised. Record at least two objects of each \
                 level, of several shapes"
            }
            _ => "its presses are learnt from, and not judged as those of a new object",
        };
        let alone = alone.join(", ");
        remarks.push(format!("only one object is of level {alone}: {shown}"));
        remarks
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
        let judged = self.candidates.iter().filter_map(|of| of.judged(division));
        let presses = judged.flatten().map(|(press, _)| *press);
        let levels = presses.map(|press| self.presses.all[press].level);
        1.0 / levels.collect::<BTreeSet<u8>>().len().max(1) as f64
    }

    fn of_levels(&self) -> Vec<OfLevel> {
        let objects = self.presses.by_object(self.places);
        let levels = self.presses.levels().into_iter().map(|level| {
            let own = || objects.iter().filter(|((_, of, ..), _)| *of == level.level);
            OfLevel {
                presses: own().map(|(_, presses)| presses.len()).sum(),
                objects: own().count(),
                level,
            }
        });
        levels.collect()
    }

    /// Counts by true and named level, and the wrong verdicts.
    fn errors(&self, judged: &Judged) -> (Vec<Vec<u64>>, Vec<Wrong>) {
        let levels = self.presses.levels();
        let mut confusion = vec![vec![0; levels.len()]; levels.len()];
        let mut wrong = Vec::new();
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
        (confusion, wrong)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::split::tests::presses as presses_of;

    #[test]
    fn objects_that_are_alike_by_chance_are_worth_no_model() {
        let presses = presses_of((0..24).map(|press| (1 + press as u8 % 2, press % 4, 0)));
        // Two of three presses of each object are judged rightly.
        let values = (0..24).map(|press| (press, f64::from(u8::from(press / 4 % 3 > 0))));
        let found = Estimate::of(&presses, &values.collect::<Vec<_>>(), Division::NewObjects);
        assert!(found.worth < 0.5 + LEAST_GAIN, "{found:?}");
    }
}
