//! Which presses a run learns from, which it holds out, and which it sees without their level.
//!
//! In: presses, a number of labels, a share and a seed. Out: a [`Parts`], in which objects stay whole.
//! Presses of one object are near-copies, so a model that was chosen by some of an object's frames has
//! practically seen the others.

use std::collections::{BTreeMap, BTreeSet};

use super::presses::{Press, Presses};
use super::source::Object;
use hardnessd_simulator::Split;
use hardnessd_simulator::random::Stream;

/// With fewer held-out sensors than this, objects are held out.
const LEAST_SENSORS: usize = 9;

/// The parts of the training presses, as indices.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Parts {
    /// Labelled presses to learn from.
    pub train: Vec<usize>,
    /// Labelled presses of held-out objects; may be empty.
    pub held_out: Vec<usize>,
    /// Training presses whose level is not used: all but the labelled ones and the other presses of the
    /// held-out objects. A method that learnt from those would be judged on what it has seen.
    pub unlabelled: Vec<usize>,
}

impl Parts {
    /// Labelled presses to learn from, and no others.
    pub fn labelled(train: Vec<usize>) -> Self {
        Self {
            train,
            ..Self::default()
        }
    }

    /// Takes `labels` of the labelled training presses, and holds `share` of their objects out.
    pub fn of(presses: &Presses, labels: usize, share: f64, seed: u64) -> Self {
        let all: Vec<usize> = presses.labelled(Split::Train).collect();
        let labelled = choose(presses, &all, labels, seed);
        let (train, held_out) = hold_out(presses, &labelled, share, seed);
        let labelled: BTreeSet<usize> = labelled.into_iter().collect();
        let held: BTreeSet<Object> = presses.of(&held_out).filter_map(Press::pressed).collect();
        // An unlabelled press may be of an object that is known with its level.
        let is_held_out = |press: &Press| {
            let object = press.pressed();
            object.is_some_and(|own| held.iter().any(|held| held.is_same_as(&own)))
        };
        let wanted = |&place: &usize| {
            let press = &presses.all[place];
            press.split == Split::Train
                && press.reference.is_none()
                && !labelled.contains(&place)
                && !is_held_out(press)
        };
        Self {
            unlabelled: (0..presses.all.len()).filter(wanted).collect(),
            train,
            held_out,
        }
    }
}

/// Objects by source and level. Each object is a list of presses.
type Groups = BTreeMap<(usize, u8), Vec<Vec<usize>>>;

/// The objects of `places` by source and level, in a random order drawn from `stream`.
fn objects(presses: &Presses, places: &[usize], stream: &Stream) -> Groups {
    let mut groups = Groups::new();
    for ((source, level, ..), own) in presses.by_object(places) {
        groups.entry((source, level)).or_default().push(own);
    }
    for (number, objects) in (0..).zip(groups.values_mut()) {
        stream.child(number).shuffle(objects);
    }
    groups
}

/// Chooses `labels` of `places`, with equal numbers for each level and source. A group with too few presses
/// gives all of them, and the other groups give more. Whole objects are chosen, except that the last object
/// of each group gives only as many presses as are still wanted.
fn choose(presses: &Presses, places: &[usize], labels: usize, seed: u64) -> Vec<usize> {
    if labels >= places.len() {
        return places.to_vec();
    }
    let groups = objects(presses, places, &Stream::new(seed, "labelled objects"));
    let size_of = |objects: &Vec<Vec<usize>>| objects.iter().map(Vec::len).sum();
    let sizes: Vec<usize> = groups.values().map(size_of).collect();
    let mut chosen = Vec::with_capacity(labels);
    for (objects, wanted) in groups.into_values().zip(shares(&sizes, labels)) {
        chosen.extend(objects.into_iter().flatten().take(wanted));
    }
    chosen.sort_unstable();
    chosen
}

/// How many of `labels` each group gives. All groups give the same number, but none more than its
/// size. If `labels` does not divide equally, the first groups that have more give one more.
fn shares(sizes: &[usize], labels: usize) -> Vec<usize> {
    let given = |each: usize| -> usize { sizes.iter().map(|size| each.min(*size)).sum() };
    let each = (0..=labels).take_while(|&each| given(each) <= labels);
    let each = each.last().unwrap_or_default();
    let mut left = labels - given(each);
    let share = |&size: &usize| {
        let one_more = size > each && left > 0;
        left -= usize::from(one_more);
        each.min(size) + usize::from(one_more)
    };
    sizes.iter().map(share).collect()
}

/// Holds `share` out: of the sensors, with all their objects, where the data has references of many sensors,
/// and else of the objects of every source and level. Gives the kept and the held-out presses, each in
/// their order.
pub fn hold_out(
    presses: &Presses,
    places: &[usize],
    share: f64,
    seed: u64,
) -> (Vec<usize>, Vec<usize>) {
    let held = held_out_sensors(presses, places, share, seed)
        .unwrap_or_else(|| held_out_objects(presses, places, share, seed));
    places.iter().partition(|place| !held.contains(place))
}

fn held_out_objects(presses: &Presses, places: &[usize], share: f64, seed: u64) -> BTreeSet<usize> {
    let groups = objects(presses, places, &Stream::new(seed, "held out objects"));
    let of_group = |objects: Vec<Vec<usize>>| {
        // At least one object stays to learn from.
        let count = (objects.len() as f64 * share).round() as usize;
        let count = count.min(objects.len() - 1);
        objects.into_iter().take(count).flatten()
    };
    groups.into_values().flat_map(of_group).collect()
}

/// Held-out sensors. Sensors that objects were pressed on in common stay together. `None` if the data
/// has too few of them, or no references, so that their numbers say nothing.
fn held_out_sensors(
    presses: &Presses,
    places: &[usize],
    share: f64,
    seed: u64,
) -> Option<BTreeSet<usize>> {
    let references = presses.all.iter().filter(|press| press.reference.is_some());
    let known: BTreeSet<u32> = references.map(|press| press.sensor).collect();
    let stations = presses.stations(places);
    let of_known = places.iter().zip(&stations);
    let of_known = of_known.filter(|(place, _)| known.contains(&presses.all[**place].sensor));
    let all: BTreeSet<u32> = of_known.clone().map(|(_, &station)| station).collect();
    let mut all: Vec<u32> = all.into_iter().collect();
    Stream::new(seed, "held-out sensors").shuffle(&mut all);
    let count = (share * all.len() as f64).round() as usize;
    if count < LEAST_SENSORS {
        return None;
    }
    let held = of_known.filter(|(_, station)| all[..count].contains(station));
    Some(held.map(|(&place, _)| place).collect())
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Presses of the level, the object and the sensor.
    pub(crate) fn presses(of: impl IntoIterator<Item = (u8, u32, u32)>) -> Presses {
        let press = |(level, object, sensor)| Press {
            level,
            object: Some(object),
            sensor,
            ..Press::default()
        };
        let mut presses = Presses::default();
        presses.all = of.into_iter().map(press).collect();
        presses
    }

    /// 4 levels x 10 objects x 5 presses.
    fn even() -> Presses {
        presses((0..200_u32).map(|i| ((i / 50) as u8 + 1, i / 5, 0)))
    }

    fn objects_of(presses: &Presses, places: &[usize]) -> BTreeSet<u32> {
        presses
            .of(places)
            .filter_map(|press| press.object)
            .collect()
    }

    #[test]
    fn held_out_objects_are_whole_and_of_every_level() {
        let presses = even();
        let parts = |labels, seed| Parts::of(&presses, labels, 0.2, seed);
        let found = parts(200, 1);
        let counts = [&found.train, &found.held_out, &found.unlabelled].map(Vec::len);
        assert_eq!(counts, [160, 40, 0]);
        let held = objects_of(&presses, &found.held_out);
        assert_eq!(held.len(), 8);
        assert!(held.is_disjoint(&objects_of(&presses, &found.train)));
        assert_ne!(held, objects_of(&presses, &parts(200, 2).held_out));
        // One object of a level is never held out.
        let first: Vec<usize> = (0..5).collect();
        assert_eq!(hold_out(&presses, &first, 0.5, 1), (first, vec![]));
    }

    #[test]
    fn labels_are_chosen_by_object_and_equally_from_each_level() {
        let presses = even();
        let chosen = Parts::of(&presses, 48, 0.0, 1).train;
        let counts = |places: &[usize]| {
            let of = |level| presses.of(places).filter(move |of| of.level == level);
            [1, 2, 3, 4].map(|level| of(level).count())
        };
        assert_eq!(counts(&chosen), [12; 4]);
        // Each level has two whole objects and two presses of a third.
        assert_eq!(objects_of(&presses, &chosen).len(), 12);
        // A choice of more labels includes the smaller choice, so methods of one seed share labels.
        let more = Parts::of(&presses, 100, 0.0, 1).train;
        assert!(chosen.iter().all(|index| more.contains(index)));
        // A level with too few presses gives all, and the others give more.
        let few: Vec<usize> = (0..10).chain(50..200).collect();
        let chosen = choose(&presses, &few, 101, 1);
        assert_eq!(counts(&chosen), [10, 31, 30, 30]);
    }

    #[test]
    fn presses_of_held_out_objects_are_not_learnt_from() {
        let mut presses = even();
        // One press of each object is unlabelled.
        let every_fifth = presses.all.iter_mut().step_by(5);
        every_fifth.for_each(|press| press.level = 0);
        let of = |share| Parts::of(&presses, 160, share, 1);
        let (all, kept) = (of(0.0).unlabelled, of(0.5));
        assert_eq!((all.len(), kept.unlabelled.len()), (40, 20));
        let held = objects_of(&presses, &kept.held_out);
        assert!(held.is_disjoint(&objects_of(&presses, &kept.unlabelled)));
    }

    #[test]
    fn sensors_are_held_out_with_all_that_share_their_objects() {
        // 60 covers with two sensors each, which press the same object.
        let mut presses = presses((0..120).map(|n| ((n / 30) as u8 + 1, n / 2, n)));
        let references = (0..120).map(|sensor| Press {
            sensor,
            reference: Some(hardnessd_core::verdict::Piece::Flat { width_mm: 20.0 }),
            ..Press::default()
        });
        presses.all.extend(references);
        let parts = Parts::of(&presses, 120, 0.2, 1);
        assert_eq!((parts.train.len(), parts.held_out.len()), (96, 24));
        let covers = |places: &[usize]| -> BTreeSet<u32> {
            presses.of(places).map(|press| press.sensor / 2).collect()
        };
        assert!(covers(&parts.train).is_disjoint(&covers(&parts.held_out)));
    }
}
