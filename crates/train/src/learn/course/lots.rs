//! Which presses a step learns from, and with which references.
//!
//! In: presses with the numbers of their sensors. Out: groups of presses of one sensor, with references
//! that are drawn anew each time: none, rigid pieces, objects of known hardness, or both. So one
//! network learns to judge with whatever a user has.

use std::collections::BTreeMap;

use super::Press;
use hardnessd_core::verdict::{Borders, Piece};
use hardnessd_simulator::random::Stream;

/// The number of presses that are judged with the same references.
pub(super) const GROUP: usize = 16;
/// The share of the groups that have no references, of those whose sensor has some.
const WITHOUT: f64 = 0.25;
/// The shares of the others that have rigid pieces, each of the two forms, and labelled objects.
const RIGID: f64 = 0.8;
const FORM: f64 = 0.9;
const LABELLED: f64 = 0.4;
/// The most presses of each rigid piece, and of labelled objects.
const MOST_RIGID: usize = 5;
const MOST_LABELLED: usize = 8;
/// The share of the labelled objects whose Shore hardness is known, and not only the level.
const MEASURED: f64 = 0.5;

/// The presses of one sensor, as indices.
#[derive(Debug, Default)]
struct Lot {
    presses: Vec<usize>,
    /// Presses on flat pieces, and on balls.
    rigid: [Vec<usize>; 2],
}

/// The presses to learn from, by sensor.
#[derive(Debug)]
pub(super) struct Lots(Vec<Lot>);

/// Presses of one sensor, and presses that serve as its references.
#[derive(Debug, Clone, Default)]
pub struct Drawn {
    /// The presses to judge.
    pub presses: Vec<Press>,
    /// The references.
    pub references: Vec<(Press, Piece)>,
}

impl Lots {
    /// Sorts the presses `train` by their sensors. Presses on rigid pieces count for these sensors,
    /// whatever their split.
    pub(super) fn of(presses: &[Press], train: &[usize]) -> Self {
        let mut lots = BTreeMap::<u32, Lot>::new();
        for &place in train {
            let lot = lots.entry(presses[place].sensor).or_default();
            lot.presses.push(place);
        }
        for (place, press) in presses.iter().enumerate() {
            let form = match press.piece {
                Some(Piece::Flat { .. }) => 0,
                Some(Piece::Ball { .. }) => 1,
                Some(Piece::Shore { .. }) | None => continue,
            };
            if let Some(lot) = lots.get_mut(&press.sensor) {
                lot.rigid[form].push(place);
            }
        }
        Self(lots.into_values().collect())
    }

    /// Numbers of lots, each as often as it has groups.
    pub(super) fn tickets(&self) -> Vec<usize> {
        let lots = self.0.iter().enumerate();
        lots.flat_map(|(place, lot)| {
            let groups = lot.presses.len().div_ceil(GROUP);
            std::iter::repeat_n(place, groups)
        })
        .collect()
    }

    /// Draws a group of a lot.
    pub(super) fn draw(
        &self,
        lot: usize,
        presses: &[Press],
        borders: &Borders,
        stream: &mut Stream,
    ) -> Drawn {
        let lot = &self.0[lot];
        let mut order = lot.presses.clone();
        let wanted = GROUP + MOST_LABELLED;
        let drawn = shuffled(&mut order, wanted, stream);
        let (judged, others) = drawn.split_at(GROUP.min(drawn.len()));
        let references = lot.references(others, presses, borders, stream);
        Drawn {
            presses: judged.iter().map(|&place| presses[place].clone()).collect(),
            references,
        }
    }

    /// All presses of each lot in groups, the first half without references and the others with the
    /// rigid pieces.
    pub(super) fn all(
        &self,
        presses: &[Press],
        borders: &Borders,
        stream: &mut Stream,
    ) -> Vec<Drawn> {
        let of_lot = |lot: &Lot| {
            let groups = lot.presses.chunks(GROUP);
            let drawn = groups.map(|group| Drawn {
                presses: group.iter().map(|&place| presses[place].clone()).collect(),
                references: lot.references(&[], presses, borders, stream),
            });
            drawn.collect::<Vec<_>>()
        };
        self.0.iter().flat_map(of_lot).collect()
    }
}

impl Lot {
    /// Draws references. `others` are presses of objects that may serve as such.
    fn references(
        &self,
        others: &[usize],
        presses: &[Press],
        borders: &Borders,
        stream: &mut Stream,
    ) -> Vec<(Press, Piece)> {
        let mut references = Vec::new();
        // The numbers of sensors mean something only where the data has rigid pieces.
        let is_identified = self.rigid.iter().any(|form| !form.is_empty());
        if !is_identified || stream.uniform() < WITHOUT {
            return references;
        }
        if stream.uniform() < RIGID {
            for form in &self.rigid {
                if stream.uniform() < FORM {
                    let count = 1 + stream.below(MOST_RIGID);
                    for &place in shuffled(&mut form.clone(), count, stream) {
                        let press = &presses[place];
                        references.extend(press.piece.map(|piece| (press.clone(), piece)));
                    }
                }
            }
        }
        if !others.is_empty() && stream.uniform() < LABELLED {
            let count = 1 + stream.below(others.len());
            for &place in &others[..count] {
                let press = &presses[place];
                let range = match press.shore {
                    Some(shore) if stream.uniform() < MEASURED => [shore; 2],
                    _ => borders.part(usize::from(press.level) - 1),
                };
                references.push((press.clone(), Piece::Shore { range }));
            }
        }
        references
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
