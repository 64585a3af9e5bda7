//! Calibrates verdicts on held-out objects: the temperature (Guo et al. 2017, "On calibration of modern
//! neural networks"), and for each knowledge of a sensor the limits of sets of levels and of intervals
//! (split conformal prediction). The unit that counts is what is new on a robot: the cover, or the object
//! if all presses are of one sensor.

use std::collections::{BTreeMap, BTreeSet};

use super::{Learning, Outputs, Stage};
use crate::data::presses::{Presses, Unit};
use crate::net::network::Weights;
use hardnessd_core::verdict::{Conformal, Knowledge, Limits, TAIL, argmax};
use hardnessd_simulator::random::Stream;

/// Sets of levels and intervals of Shore hardness miss the truth in at most this share of cases.
pub const ALPHA: f32 = 0.1;
/// The fewest held-out units with which [`ALPHA`] can be promised: with n units, at least one in
/// n + 1 cases may exceed the greatest value among them.
const LEAST_UNITS: usize = 9;
/// A quantile is the mean over this many draws of one press from each unit.
const DRAWS: usize = 50;
/// The share of the covers, the worst ones, whose confidence is calibrated: a robot's own cover may be one. A tenth of
/// a few covers may be one or two of which the network knows nothing.
const WORST_COVERS: f64 = 0.5;

/// The highest temperature. A network that knows its few objects by heart needs far more than one that errs.
const HOTTEST: f32 = 1000.0;

/// The calibration computed from the held-out presses.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// The divisor of the logits.
    pub temperature: f32,
    /// The limits for each knowledge of a sensor. Empty if nothing can be promised.
    pub limits: BTreeMap<Knowledge, Limits>,
    /// The number of held-out units, and of those whose Shore hardness was measured.
    units: [usize; 2],
    /// What a unit is.
    unit: Unit,
}

/// What the network says of a press of a held-out object.
#[derive(Debug, Clone)]
pub(crate) struct Judged {
    /// The press's cover, or its object if all presses are of one sensor.
    pub(crate) unit: u64,
    /// The level, from 0.
    pub(crate) level: usize,
    /// The Shore hardness, if it was measured.
    pub(crate) shore: Option<f32>,
    /// The logits.
    pub(crate) row: Vec<f32>,
}

impl Judged {
    /// What it says of a press. A press without a known unit is of a unit of its own.
    pub(crate) fn of(presses: &Presses, place: usize, unit: Option<u64>, row: Vec<f32>) -> Self {
        let press = &presses.all[place];
        Self {
            unit: unit.unwrap_or(u64::MAX - place as u64),
            level: usize::from(press.level) - 1,
            shore: press.shore,
            row,
        }
    }
}

impl Calibration {
    /// Calibrates on the held-out presses, varied and with references like the training presses. Without
    /// any, it changes nothing and promises nothing.
    pub fn of(learning: &dyn Learning, weights: &[Weights], stream: &mut Stream) -> Self {
        let Stage { presses, parts, .. } = learning.stage();
        let mut judged = BTreeMap::new();
        for knowledge in Knowledge::ALL {
            let questions = learning.questions(knowledge, stream);
            let Some(questions) = questions.filter(|_| !parts.held_out.is_empty()) else {
                continue;
            };
            let rows = learning.judge(weights, &questions, Some(stream));
            let asked = questions.iter().flat_map(|question| &question.presses);
            let asked: Vec<usize> = asked.copied().collect();
            let units = presses.units(&asked);
            let one = |(number, (&place, row)): (usize, (&usize, Vec<f32>))| {
                let unit = units.as_ref().map(|units| units.1[number].into());
                Judged::of(presses, place, unit, row)
            };
            let of_knowledge = asked.iter().zip(rows).enumerate().map(one).collect();
            judged.insert(knowledge, of_knowledge);
        }
        let unit = presses.units(&parts.held_out).map(|(unit, _)| unit);
        let unit = unit.unwrap_or(Unit::Object);
        Self::on(&judged, unit, &learning.outputs(), stream)
    }

    /// Calibrates on these.
    pub(crate) fn on(
        judged: &BTreeMap<Knowledge, Vec<Judged>>,
        unit: Unit,
        outputs: &Outputs,
        stream: &mut Stream,
    ) -> Self {
        let of_truth = |judged: &Judged, temperature: f32| {
            outputs.probabilities(&judged.row, temperature)[judged.level]
        };
        // Rare levels count as much as frequent ones.
        let mut counts = BTreeMap::<usize, f64>::new();
        let all = || judged.values().flatten();
        for judged in all() {
            *counts.entry(judged.level).or_default() += 1.0;
        }
        // A cover's loss is the mean over its presses. Objects are too small for a mean of their own.
        let loss = |temperature: f64| {
            let mut units = BTreeMap::<u64, [f64; 2]>::new();
            for judged in all() {
                let p = of_truth(judged, temperature as f32).max(f32::MIN_POSITIVE);
                let own = match unit {
                    Unit::Cover => judged.unit,
                    Unit::Object => 0,
                };
                let [sum, weight] = units.entry(own).or_default();
                *sum -= f64::from(p).ln() / counts[&judged.level];
                *weight += 1.0 / counts[&judged.level];
            }
            let mut losses: Vec<f64> = units.values().map(|[sum, weight]| sum / weight).collect();
            losses.sort_by(|one, other| other.total_cmp(one));
            let worst = (WORST_COVERS * losses.len() as f64).ceil() as usize;
            losses[..worst].iter().sum::<f64>()
        };
        let mut of_levels = BTreeMap::<usize, BTreeSet<u64>>::new();
        for judged in all() {
            let units = of_levels.entry(judged.level).or_default();
            units.insert(judged.unit);
        }
        let fewest = of_levels.values().map(BTreeSet::len).min();
        let units: BTreeSet<u64> = all().map(|judged| judged.unit).collect();
        let units = units.len().min(fewest.unwrap_or(0) * of_levels.len());
        let confidence = |temperature: f32| {
            let of = |judged: &Judged| argmax(&outputs.probabilities(&judged.row, temperature)).1;
            let sum: f32 = all().map(of).sum();
            sum / all().count() as f32
        };
        let temperature = match all().next() {
            None => 1.0,
            Some(_) => at_most(least(loss), confidence, most_confidence(units)),
        };
        let (mut limits, mut units) = (BTreeMap::new(), [0; 2]);
        for (&knowledge, judged) in judged {
            let wrong = by_unit(judged, |judged| Some(-of_truth(judged, temperature)));
            // The share of the distribution beyond the truth, on its side.
            let beyond = by_unit(judged, |judged| {
                let below = outputs.below(&judged.row, temperature, judged.shore?)?;
                Some(-below.min(1.0 - below))
            });
            let measured = by_unit(judged, |judged| judged.shore).len();
            if knowledge == Knowledge::None {
                units = [wrong.len(), measured];
            }
            if let Some(wrong) = quantile(&wrong, stream) {
                let tail = quantile(&beyond, stream).map_or(TAIL, |beyond| -beyond);
                let threshold = -wrong;
                limits.insert(knowledge, Limits { threshold, tail });
            }
        }
        Self {
            temperature,
            limits,
            units,
            unit,
        }
    }

    /// The same without a promise of sets of levels.
    pub(crate) fn without_sets(self) -> Self {
        Self {
            limits: BTreeMap::new(),
            units: [0; 2],
            ..self
        }
    }

    /// What a file says of the limits.
    pub fn conformal(&self) -> Option<Conformal> {
        let none = self.limits.get(&Knowledge::None)?;
        Some(Conformal {
            alpha: ALPHA,
            threshold: none.threshold,
            contexts: self.limits.clone(),
        })
    }

    /// What the calibration cannot promise, and why, in one line. `None` if it promises both the
    /// sets of levels and the interval of the Shore hardness.
    pub fn missing(&self) -> Option<String> {
        let [units, measured] = self.units;
        let (of, found, lost) = match units < LEAST_UNITS {
            true => ("", units, "there are no sets of levels, and "),
            false => (" with a measured Shore hardness", measured, ""),
        };
        let unit = match self.unit {
            Unit::Object => "objects",
            Unit::Cover => "covers",
        };
        (found < LEAST_UNITS).then(|| {
            format!(
                "held-out {unit}{of}: found {found}, expected at least {LEAST_UNITS}: {lost}nothing promises that \
                 the interval of the Shore hardness holds"
            )
        })
    }
}

/// The temperature of least loss, between 1/8 and 8. The loss of logits is convex in 1/T, and so is the sum of the
/// greatest of several. So a shrinking bracket finds its minimum.
fn least(loss: impl Fn(f64) -> f64) -> f32 {
    let (mut low, mut high) = (0.125_f64, 8.0_f64);
    for _ in 0..60 {
        let (left, right) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
        if loss(1.0 / left) < loss(1.0 / right) {
            high = right;
        } else {
            low = left;
        }
    }
    (2.0 / (low + high)) as f32
}

/// The most that a verdict on something new may claim after so many units, all of which were judged rightly (Laplace's
/// rule of succession). A level with few of them counts for all.
fn most_confidence(units: usize) -> f32 {
    (units + 1) as f32 / (units + 2) as f32
}

/// The temperature, or the one above it at which the confidence is `most`, if it is more. The confidence falls as the
/// temperature rises.
fn at_most(temperature: f32, confidence: impl Fn(f32) -> f32, most: f32) -> f32 {
    let (mut low, mut high) = (temperature, HOTTEST);
    if confidence(low) <= most {
        return low;
    }
    for _ in 0..40 {
        let middle = (low * high).sqrt();
        if confidence(middle) > most {
            low = middle;
        } else {
            high = middle;
        }
    }
    high
}

/// The values of the presses of each unit.
fn by_unit(judged: &[Judged], value: impl Fn(&Judged) -> Option<f32>) -> Vec<Vec<f32>> {
    let mut units = BTreeMap::<u64, Vec<f32>>::new();
    for judged in judged {
        units.entry(judged.unit).or_default().extend(value(judged));
    }
    units.retain(|_, values| !values.is_empty());
    units.into_values().collect()
}

/// The split-conformal quantile of 1 - [`ALPHA`] for exchangeable units: with one press of each of n
/// units, the value of rank ceil((1 - alpha)(n + 1)), averaged over draws of the presses. `None` with
/// fewer units than the rank: no value is then large enough.
fn quantile(units: &[Vec<f32>], stream: &mut Stream) -> Option<f32> {
    let rank = ((1.0 - ALPHA) * (units.len() + 1) as f32).ceil() as usize;
    if rank > units.len() {
        return None;
    }
    let mut sum = 0.0;
    for _ in 0..DRAWS {
        let drawn = units.iter().map(|own| own[stream.below(own.len())]);
        let mut drawn: Vec<f32> = drawn.collect();
        drawn.sort_by(f32::total_cmp);
        sum += drawn[rank - 1];
    }
    Some(sum / DRAWS as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_quantile_counts_units_not_presses() {
        let mut stream = Stream::new(1, "quantile");
        // 99 units of value 1 to 99; the last has a thousand presses.
        let mut units: Vec<Vec<f32>> = (1..=99_u8).map(|n| vec![f32::from(n)]).collect();
        units[98] = vec![99.0; 1000];
        assert_eq!(quantile(&units, &mut stream), Some(90.0));
        // Of nine units, the rank is the greatest value. Fewer units are too few for it.
        assert_eq!(quantile(&units[..LEAST_UNITS], &mut stream), Some(9.0));
        for few in 0..LEAST_UNITS {
            assert_eq!(quantile(&units[..few], &mut stream), None, "{few}");
        }
    }

    /// A press whose larger logit is the logarithm of these odds, at its level if it is right.
    fn judged(unit: u64, level: usize, is_right: bool, odds: f32) -> Judged {
        let mut row = vec![0.0; 2];
        row[if is_right { level } else { 1 - level }] = odds.ln();
        Judged {
            unit,
            level,
            shore: None,
            row,
        }
    }

    fn temperature(judged: impl Iterator<Item = Judged>, unit: Unit) -> f32 {
        let judged = BTreeMap::from([(Knowledge::None, judged.collect())]);
        let stream = &mut Stream::new(1, "calibration");
        Calibration::on(&judged, unit, &Outputs::Levels, stream).temperature
    }

    #[test]
    fn the_temperature_undoes_overconfidence() {
        // The larger logit is right in 3 of 4 cases, but the logits are 4 times those of
        // probability 3/4.
        let judged = (0..16).map(|unit| {
            let level = usize::from(unit % 2 == 0);
            judged(unit, level, unit % 8 >= 2, 3.0_f32.powi(4))
        });
        let found = temperature(judged, Unit::Object);
        assert!((found - 4.0).abs() < 1e-2, "{found}");
    }

    #[test]
    fn few_objects_that_are_all_judged_rightly_make_no_verdict_certain() {
        for (objects, expected) in [(4, 5.0 / 6.0), (30, 31.0 / 32.0)] {
            let judged = (0..10 * objects).map(|press| {
                let object = press / 10;
                judged(object, usize::from(object % 2 == 0), true, 1e6)
            });
            let found = temperature(judged, Unit::Object);
            let confidence = 1.0 / (1.0 + 1e-6_f32.powf(1.0 / found));
            assert!(
                (confidence - expected).abs() < 1e-3,
                "{objects}: {confidence}"
            );
        }
    }

    #[test]
    fn the_temperature_is_that_of_the_worst_covers() {
        // The larger logit is right in 9 of 10 presses under half of the covers, and in 6 of 10 under the others.
        let judged = (0..200).map(|press| {
            let (unit, level) = (press / 10, usize::from(press % 2 == 0));
            let right = if unit % 2 == 0 { 6 } else { 9 };
            judged(unit, level, press % 10 < right, 9.0)
        });
        let found = temperature(judged, Unit::Cover);
        let expected = 9.0_f32.ln() / 1.5_f32.ln();
        assert!((found - expected).abs() < 0.05, "{found}");
    }

    #[test]
    fn few_objects_give_no_sets_and_promise_nothing() {
        let of = |objects: u64, measured: u64| {
            let press = |n: u64| Judged {
                unit: n / 3,
                level: (n % 2) as usize,
                shore: (n / 3 < measured).then_some(50.0),
                row: vec![1.0, 1.0],
            };
            let judged = (0..3 * objects).map(press).collect();
            let judged = BTreeMap::from([(Knowledge::None, judged)]);
            let stream = &mut Stream::new(1, "calibration");
            Calibration::on(&judged, Unit::Object, &Outputs::Levels, stream)
        };
        let threshold = |found: &Calibration| Some(found.limits.get(&Knowledge::None)?.threshold);
        let (enough, few, unmeasured) = (of(9, 9), of(8, 8), of(9, 2));
        let least = threshold(&enough).unwrap();
        assert!((least - 0.5).abs() < 1e-3, "{enough:?}");
        assert_eq!((enough.missing(), threshold(&few)), (None, None));
        let missing = few.missing().unwrap();
        let expected = "found 8, expected at least 9";
        assert!(missing.contains(expected), "{missing}");
        assert!(threshold(&unmeasured).unwrap() > 0.0);
        let missing = unmeasured.missing().unwrap();
        assert!(missing.contains("Shore hardness: found 2"), "{missing}");
        assert!(of(0, 0).missing().unwrap().contains("found 0"));
    }
}
