//! How labelled presses are divided, so that each is judged by what was learnt from others.

use std::collections::BTreeMap;

use crate::data::presses::Presses;
use crate::data::source::Object;
use hardnessd_simulator::random::Stream;

/// Up to this many objects, each is left out alone. More are left out in [`GROUPS`] groups.
const LEFT_OUT_ALONE: usize = 12;
const GROUPS: usize = 5;
/// The share of the presses of each object that the later ones are judged by.
const EARLIER: f64 = 0.6;

/// Presses to learn from and presses to judge, as indices.
#[derive(Debug, Clone, PartialEq)]
pub struct Fold {
    /// The presses to learn from.
    pub train: Vec<usize>,
    /// The presses to judge.
    pub test: Vec<usize>,
}

/// The presses of each object, in their order. A press whose object is not known is of one of its own.
pub fn objects(presses: &Presses, places: &[usize]) -> BTreeMap<(u8, Object, usize), Vec<usize>> {
    let mut objects = BTreeMap::<_, Vec<usize>>::new();
    for &place in places {
        let press = &presses.all[place];
        let unknown = Object {
            number: u32::MAX,
            material: None,
            level: press.level,
        };
        let (object, alone) = match press.pressed() {
            Some(object) => (object, 0),
            None => (unknown, place),
        };
        objects
            .entry((press.level, object, alone))
            .or_default()
            .push(place);
    }
    objects
}

/// Whole objects are left out and judged. An object that is alone in its level is always learnt from and
/// never judged. `None` if that leaves fewer than two levels to tell apart.
pub fn by_object(presses: &Presses, places: &[usize], seed: u64) -> Option<Vec<Fold>> {
    let objects = objects(presses, places);
    let mut of_levels = BTreeMap::<u8, Vec<&Vec<usize>>>::new();
    for ((level, ..), own) in &objects {
        of_levels.entry(*level).or_default().push(own);
    }
    of_levels.retain(|_, objects| objects.len() > 1);
    if of_levels.len() < 2 {
        return None;
    }
    let count = of_levels.values().map(Vec::len).sum();
    let groups = if count <= LEFT_OUT_ALONE {
        count
    } else {
        GROUPS
    };
    let mut tests = vec![Vec::new(); groups];
    let mut stream = Stream::new(seed, "groups of objects");
    // Dealt out level by level, so that each group has some of each level.
    let dealt = of_levels.into_values().flat_map(|mut objects| {
        stream.shuffle(&mut objects);
        objects
    });
    for (number, object) in dealt.enumerate() {
        tests[number % groups].extend(object);
    }
    Some(tests.into_iter().map(|test| fold(places, test)).collect())
}

/// The later presses of each object are judged by what was learnt from the earlier ones. `None` if no object
/// has two presses.
pub fn by_time(presses: &Presses, places: &[usize]) -> Option<Vec<Fold>> {
    let later = objects(presses, places).into_values().flat_map(|own| {
        let earlier = (EARLIER * own.len() as f64).round().max(1.0) as usize;
        own.into_iter().skip(earlier)
    });
    let later: Vec<usize> = later.collect();
    (!later.is_empty()).then(|| vec![fold(places, later)])
}

fn fold(places: &[usize], mut test: Vec<usize>) -> Fold {
    test.sort_unstable();
    let is_learnt = |place: &usize| test.binary_search(place).is_err();
    Fold {
        train: places.iter().copied().filter(is_learnt).collect(),
        test,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::presses::Press;

    /// Five presses of each object, in turn. The objects have these levels.
    fn presses(levels: &[u8]) -> (Presses, Vec<usize>) {
        let mut presses = Presses::default();
        for _ in 0..5 {
            presses
                .all
                .extend((0..).zip(levels).map(|(object, &level)| Press {
                    level,
                    object: Some(object),
                    ..Press::default()
                }));
        }
        let places = (0..presses.all.len()).collect();
        (presses, places)
    }

    #[test]
    fn each_object_is_judged_once_and_never_by_itself() {
        let many: Vec<u8> = (0..40).map(|n| n % 4 + 1).collect();
        for (levels, folds) in [(&[1, 1, 2, 2, 2][..], 5), (&many, 5), (&many[..12], 12)] {
            let (presses, places) = presses(levels);
            let found = by_object(&presses, &places, 1).unwrap();
            assert_eq!(found.len(), folds);
            let mut judged: Vec<usize> = found.iter().flat_map(|fold| fold.test.clone()).collect();
            judged.sort_unstable();
            assert_eq!(judged, places);
            for Fold { train, test } in &found {
                let object = |&place: &usize| presses.all[place].object;
                assert!(
                    test.iter()
                        .all(|place| !train.iter().map(object).any(|o| o == object(place)))
                );
            }
        }
    }

    #[test]
    fn an_object_alone_in_its_level_is_learnt_from_only() {
        let (mut one, places) = presses(&[1, 1, 2, 2, 3]);
        let folds = by_object(&one, &places, 1).unwrap();
        assert!(
            folds
                .iter()
                .all(|fold| fold.test.iter().all(|&p| one.all[p].level < 3))
        );
        assert!(
            folds
                .iter()
                .all(|fold| fold.train.iter().any(|&p| one.all[p].level == 3))
        );
        one.all
            .iter_mut()
            .for_each(|press| press.level = press.level.max(2));
        assert!(by_object(&one, &places, 1).is_none());
    }

    #[test]
    fn the_later_presses_are_judged() {
        let (presses, places) = presses(&[1, 2]);
        let [fold] = &by_time(&presses, &places).unwrap()[..] else {
            panic!("one fold");
        };
        assert_eq!(
            (&fold.train[..], &fold.test[..]),
            (&places[..6], &places[6..])
        );
        assert!(by_time(&presses, &places[..2]).is_none());
    }
}
