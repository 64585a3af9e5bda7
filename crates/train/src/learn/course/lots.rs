//! Which presses a step learns from, and with which references.
//!
//! In: presses with the numbers of their sensors. Out: groups of presses of one sensor, with references
//! that are drawn anew each time: none, the sensor's own presses of objects of which nothing is known,
//! rigid pieces, objects of known hardness, or several of these. So one network learns to judge with
//! whatever a robot has.

use std::collections::BTreeMap;

use crate::data::presses::Presses;
use crate::learn::Question;
use hardnessd_core::verdict::{Borders, Knowledge, Piece};
use hardnessd_simulator::random::Stream;

/// The number of presses that are judged with the same references.
pub(super) const GROUP: usize = 16;
/// The share of the groups that have own presses, and their number.
const OWN: f64 = 0.6;
const LEAST_OWN: usize = 4;
const MOST_OWN: usize = 16;
/// The share of the groups whose own presses are of a lopsided mix of levels.
const LOPSIDED: f64 = 0.5;
/// The share of the groups that have neither rigid pieces nor labelled objects.
const WITHOUT: f64 = 0.4;
/// The shares of the others that have rigid pieces, each of the two forms, and labelled objects.
const RIGID: f64 = 0.8;
const FORM: f64 = 0.9;
const LABELLED: f64 = 0.4;
/// The most presses of each rigid piece, and of labelled objects.
const MOST_RIGID: usize = 5;
const MOST_LABELLED: usize = 6;
/// The share of the labelled objects whose Shore hardness is known, and not only the level.
const MEASURED: f64 = 0.5;
/// The share of the groups in which a rigid piece is judged too, if it is no reference.
const JUDGED_RIGID: f64 = 0.3;

/// The kinds of references that a group gets.
#[derive(Debug, Clone, Copy)]
struct Kinds {
    own: bool,
    rigid: bool,
    labelled: bool,
}

impl Kinds {
    fn draw(stream: &mut Stream) -> Self {
        let own = stream.uniform() < OWN;
        let has_pieces = stream.uniform() >= WITHOUT;
        Self {
            own,
            rigid: has_pieces && stream.uniform() < RIGID,
            labelled: has_pieces && stream.uniform() < LABELLED,
        }
    }

    /// The kinds of a knowledge. Own presses and labelled objects come with rigid pieces in half of
    /// the groups.
    fn of(knowledge: Knowledge, stream: &mut Stream) -> Self {
        let is_identified = stream.uniform() < 0.5;
        let (own, rigid, labelled) = match knowledge {
            Knowledge::None => (false, false, false),
            Knowledge::Rigid => (false, true, false),
            Knowledge::Own => (true, is_identified, false),
            Knowledge::Labelled => (stream.uniform() < 0.5, is_identified, true),
        };
        Self {
            own,
            rigid,
            labelled,
        }
    }
}

/// The presses of one sensor, as indices.
#[derive(Debug, Default)]
struct Lot {
    presses: Vec<usize>,
    /// Presses on flat pieces, and on balls.
    rigid: [Vec<usize>; 2],
}

/// The presses to learn from, by sensor.
#[derive(Debug)]
pub(super) struct Lots<'a> {
    presses: &'a Presses,
    borders: Borders,
    lots: Vec<Lot>,
}

impl<'a> Lots<'a> {
    /// Sorts the presses `train` by their sensors. Presses on rigid pieces count for these sensors,
    /// whatever their split.
    pub(super) fn of(presses: &'a Presses, borders: Borders, train: &[usize]) -> Self {
        let mut lots = BTreeMap::<u32, Lot>::new();
        for &place in train {
            let lot = lots.entry(presses.all[place].sensor).or_default();
            lot.presses.push(place);
        }
        for (place, press) in presses.all.iter().enumerate() {
            let form = match press.reference {
                Some(Piece::Flat { .. }) => 0,
                Some(Piece::Ball { .. }) => 1,
                Some(Piece::Shore { .. }) | None => continue,
            };
            if let Some(lot) = lots.get_mut(&press.sensor) {
                lot.rigid[form].push(place);
            }
        }
        Self {
            presses,
            borders,
            lots: lots.into_values().collect(),
        }
    }

    /// The same of other presses.
    pub(super) fn with(&self, places: &[usize]) -> Self {
        Self::of(self.presses, self.borders.clone(), places)
    }

    /// Whether a sensor has presses that may serve as references.
    pub(super) fn have_references(&self) -> bool {
        self.lots.iter().any(Lot::is_identified)
    }

    /// Numbers of lots, each as often as it has groups.
    pub(super) fn tickets(&self) -> Vec<usize> {
        let lots = self.lots.iter().enumerate();
        lots.flat_map(|(place, lot)| {
            let groups = lot.presses.len().div_ceil(GROUP);
            std::iter::repeat_n(place, groups)
        })
        .collect()
    }

    /// Draws a group of a lot.
    pub(super) fn draw(&self, lot: usize, stream: &mut Stream) -> Question {
        let lot = &self.lots[lot];
        let mut order = lot.presses.clone();
        let wanted = GROUP + MOST_LABELLED + MOST_OWN;
        let drawn = shuffled(&mut order, wanted, stream);
        let (judged, others) = drawn.split_at(GROUP.min(drawn.len()));
        let kinds = Kinds::draw(stream);
        let references = self.references(lot, judged, others, kinds, stream);
        let mut presses = judged.to_vec();
        if stream.uniform() < JUDGED_RIGID {
            // One that is no reference.
            let mut rigid = lot.rigid.concat();
            rigid.retain(|place| references.iter().all(|(other, _)| other != place));
            presses.extend((!rigid.is_empty()).then(|| rigid[stream.below(rigid.len())]));
        }
        Question {
            presses,
            references,
        }
    }

    /// All presses of each lot in groups, with references as a knowledge of the sensor has them.
    pub(super) fn all(&self, knowledge: Knowledge, stream: &mut Stream) -> Vec<Question> {
        let mut questions = Vec::new();
        for lot in &self.lots {
            let mut order = lot.presses.clone();
            for judged in lot.presses.chunks(GROUP) {
                let others = shuffled(&mut order, lot.presses.len(), stream);
                let kinds = Kinds::of(knowledge, stream);
                questions.push(Question {
                    presses: judged.to_vec(),
                    references: self.references(lot, judged, others, kinds, stream),
                });
            }
        }
        questions
    }

    /// Draws references of a lot, those without a piece from `others`. No object that is judged is among them:
    /// its press would tell its label.
    fn references(
        &self,
        lot: &Lot,
        judged: &[usize],
        others: &[usize],
        kinds: Kinds,
        stream: &mut Stream,
    ) -> Vec<(usize, Piece)> {
        let mut references = Vec::new();
        if !lot.is_identified() {
            return references;
        }
        let object = |place: &usize| self.presses.all[*place].object;
        let is_judged = |other: &usize| judged.iter().any(|own| object(own) == object(other));
        let others = others.iter().copied().filter(|other| !is_judged(other));
        let mut others: Vec<usize> = others.collect();
        if kinds.rigid {
            for form in &lot.rigid {
                if stream.uniform() < FORM {
                    let count = 1 + stream.below(MOST_RIGID);
                    for &place in shuffled(&mut form.clone(), count, stream) {
                        let piece = self.presses.all[place].reference;
                        references.extend(piece.map(|piece| (place, piece)));
                    }
                }
            }
        }
        if kinds.labelled && !others.is_empty() {
            let count = 1 + stream.below(MOST_LABELLED.min(others.len()));
            for place in others.drain(..count) {
                let press = &self.presses.all[place];
                let range = match press.shore {
                    Some(shore) if stream.uniform() < MEASURED => [shore; 2],
                    _ => self.borders.part(usize::from(press.level) - 1),
                };
                references.push((place, Piece::Shore { range }));
            }
        }
        if kinds.own {
            let count = LEAST_OWN + stream.below(MOST_OWN - LEAST_OWN + 1);
            if stream.uniform() < LOPSIDED {
                others = self.lopsided(&others, count, stream);
            }
            let own = others.into_iter().take(count);
            references.extend(own.map(|place| (place, Piece::UNKNOWN)));
        }
        references
    }

    /// Up to `count` of `others`, in which one or two levels outweigh the rest.
    fn lopsided(&self, others: &[usize], count: usize, stream: &mut Stream) -> Vec<usize> {
        let mut of_level = BTreeMap::<u8, Vec<usize>>::new();
        for &place in others {
            let of_level = of_level.entry(self.presses.all[place].level).or_default();
            of_level.push(place);
        }
        // The cube of an exponential variate is at times far above its mean.
        let mut weight = || (-stream.uniform().max(1e-12).ln()).powi(3);
        let weighed = of_level.into_values().map(|places| (weight(), places));
        let mut weighed: Vec<(f64, Vec<usize>)> = weighed.collect();
        let mut chosen = Vec::new();
        while chosen.len() < count && !weighed.is_empty() {
            let mut at = stream.uniform() * weighed.iter().map(|(weight, _)| weight).sum::<f64>();
            let heavy = weighed.iter().position(|(weight, _)| {
                at -= weight;
                at <= 0.0
            });
            let level = heavy.unwrap_or(weighed.len() - 1);
            chosen.extend(weighed[level].1.pop());
            if weighed[level].1.is_empty() {
                weighed.remove(level);
            }
        }
        chosen
    }
}

impl Lot {
    /// Whether there are presses of rigid pieces. Only then do the numbers of sensors mean something.
    fn is_identified(&self) -> bool {
        self.rigid.iter().any(|form| !form.is_empty())
    }
}

/// Draws up to `count` elements, each at most once, to the front.
fn shuffled<'a>(order: &'a mut [usize], count: usize, stream: &mut Stream) -> &'a [usize] {
    let count = count.min(order.len());
    for place in 0..count {
        let other = place + stream.below(order.len() - place);
        order.swap(place, other);
    }
    &order[..count]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::presses::Press;
    use crate::data::source::papers_levels;

    #[test]
    fn no_reference_is_a_press_of_an_object_that_is_judged() {
        // Two presses of each of 20 objects, and two of a rigid piece.
        let press = |number: u32| Press {
            level: 2,
            shore: Some(65.0),
            object: Some(number / 2),
            reference: (number >= 40).then_some(Piece::Ball { radius_mm: 10.0 }),
            ..Press::default()
        };
        let mut presses = Presses::default();
        presses.all = (0..42).map(press).collect();
        let train: Vec<usize> = (0..40).collect();
        let borders = Borders::of(&papers_levels()).unwrap();
        let lots = Lots::of(&presses, borders, &train);
        let (mut labelled, mut own) = (0, 0);
        for seed in 0..200 {
            let mut stream = Stream::new(seed, "lots");
            let drawn = lots.draw(0, &mut stream);
            for &(place, piece) in &drawn.references {
                let reference = &presses.all[place];
                let is_same = |&judged: &usize| match reference.reference {
                    Some(_) => judged == place,
                    None => presses.all[judged].object == reference.object,
                };
                assert!(!drawn.presses.iter().any(is_same), "seed {seed}");
                own += u32::from(piece.is_unknown());
                labelled += u32::from(reference.reference.is_none() && !piece.is_unknown());
            }
        }
        assert!(labelled > 100, "{labelled} labelled references");
        assert!(own > 1000, "{own} own presses");
    }
}
