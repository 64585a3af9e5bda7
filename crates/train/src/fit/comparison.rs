//! The comparison of the candidates, and the choice.
//!
//! In: what each candidate says of presses that it did not learn from. Out: the best one, what to write, and
//! what the figures do not show.

use std::collections::BTreeMap;

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

/// What a candidate or the control reached under each division.
pub(super) struct Compared {
    /// Its name.
    pub(super) name: &'static str,
    /// In the order of [`Division`].
    pub(super) outcomes: [Option<Outcome>; 2],
    /// Why it was left out.
    pub(super) left_out: Option<String>,
}

/// A candidate must be right this much more often than guessing, by the low end of its interval. Less is of
/// no use.
const LEAST_GAIN: f64 = 0.1;

/// The two ways to divide the presses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Division {
    NewObjects,
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

/// What to write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum What {
    /// The model of the candidate at this place.
    Model(usize),
    /// References for the built-in model.
    References,
}

/// The best candidate, and what to write.
pub(super) struct Choice {
    /// The place of the best candidate.
    pub(super) best: Option<usize>,
    pub(super) division: Division,
    pub(super) writes: Option<What>,
    pub(super) remarks: Vec<String>,
}

/// All outcomes.
pub(super) struct Comparison<'a> {
    pub(super) presses: &'a Presses,
    pub(super) places: &'a [usize],
    pub(super) candidates: Vec<Compared>,
    pub(super) control: Compared,
}

impl Comparison<'_> {
    /// The choice: by new objects, or where nothing there is better than guessing, by later presses.
    pub(super) fn choice(&self) -> Choice {
        let built_in = self.candidates.iter().position(|of| of.left_out.is_none());
        let built_in = built_in.filter(|&place| place == 0);
        let mut remarks = self.remarks_on_objects();
        for division in [Division::NewObjects, Division::LaterPresses] {
            let Some(best) = self.best(division) else {
                continue;
            };
            let found = self.estimate(&self.candidates[best], division);
            let found = found.expect("the best candidate was judged");
            if found.low() < self.guessing(division) + LEAST_GAIN {
                continue;
            }
            let name = self.candidates[best].name;
            let lead = |other: &Compared| {
                let outcome = |of: usize| self.candidates[of].outcomes[division as usize].as_ref();
                let other = other.outcomes[division as usize].as_ref()?;
                let other: BTreeMap<usize, f64> = other.right(self.presses).into_iter().collect();
                let of_both = outcome(best)?.right(self.presses).into_iter();
                let of_both = of_both.filter_map(|(press, right)| {
                    other.get(&press).map(|other| (press, right - other))
                });
                Some(self.estimated(of_both.collect()))
            };
            let control = self.estimate(&self.control, division);
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
                let on_new = self.estimate(&self.candidates[best], Division::NewObjects);
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
            let writes = match built_in {
                Some(place) if place == best => {
                    remarks.push(
                        "the built-in model is the best one, so these presses become its references".to_owned(),
                    );
                    What::References
                }
                Some(place)
                    if lead(&self.candidates[place]).is_some_and(|lead| lead.low() <= 0.0) =>
                {
                    remarks.push(format!(
                        "{name} is not better than the built-in model by more than chance, so these presses become \
                         references of the built-in model"
                    ));
                    What::References
                }
                _ => What::Model(best),
            };
            return Choice {
                best: Some(best),
                division,
                writes: Some(writes),
                remarks,
            };
        }
        remarks.push(match built_in {
            Some(_) => "no candidate is shown to be of use: these presses become references of \
                        the built-in model, and more presses may show more"
                .to_owned(),
            None => {
                "no candidate is shown to be of use: press more objects of each level".to_owned()
            }
        });
        let division = match self.best(Division::NewObjects) {
            Some(_) => Division::NewObjects,
            None => Division::LaterPresses,
        };
        Choice {
            best: self.best(division),
            division,
            writes: built_in.map(|_| What::References),
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
    pub(super) fn best(&self, division: Division) -> Option<usize> {
        let found = self
            .candidates
            .iter()
            .enumerate()
            .rev()
            .filter_map(|(place, of)| {
                Some((place, self.estimate(of, division)?.balanced_accuracy))
            });
        let best = found.max_by(|one, other| one.1.total_cmp(&other.1));
        best.map(|(place, _)| place)
    }

    /// The balanced accuracy of guessing.
    pub(super) fn guessing(&self, division: Division) -> f64 {
        let outcomes = self
            .candidates
            .iter()
            .filter_map(|of| of.outcomes[division as usize].as_ref());
        let judged = outcomes.flat_map(|outcome| &outcome.0);
        let mut levels: Vec<u8> = judged
            .map(|(press, _)| self.presses.all[*press].level)
            .collect();
        levels.sort_unstable();
        levels.dedup();
        1.0 / levels.len().max(1) as f64
    }

    pub(super) fn estimate(&self, of: &Compared, division: Division) -> Option<Estimate> {
        let outcome = of.outcomes[division as usize].as_ref()?;
        Some(self.estimated(outcome.right(self.presses)))
    }

    /// The mean over the levels of values of presses, with its interval.
    fn estimated(&self, values: Vec<(usize, f64)>) -> Estimate {
        let places: Vec<usize> = values.iter().map(|(press, _)| *press).collect();
        let objects = folds::objects(self.presses, &places);
        let of_level = |level| objects.keys().filter(|(of, ..)| *of == level).count();
        let has_several = objects.keys().all(|(level, ..)| of_level(*level) > 1);
        let units = objects
            .values()
            .enumerate()
            .flat_map(|(unit, own)| own.iter().map(move |press| (*press, unit as u32)));
        let mut units: Vec<(usize, u32)> = units.collect();
        units.sort_unstable();
        let drawn = values
            .into_iter()
            .zip(units)
            .map(|((press, value), (_, unit))| Drawn {
                stratum: self.presses.all[press].level,
                unit: if has_several { unit } else { press as u32 },
                value,
            });
        let drawn: Vec<Drawn> = drawn.collect();
        Estimate {
            balanced_accuracy: interval::mean(&drawn, Mean::OfStrata),
            interval: interval::of(&drawn, Mean::OfStrata),
        }
    }

    pub(super) fn of_levels(&self) -> Vec<OfLevel> {
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
}
