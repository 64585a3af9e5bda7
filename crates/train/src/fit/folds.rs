//! How labelled presses are divided, so that each is judged by what was learnt from others.

use std::collections::BTreeMap;

use super::SEED;
use crate::data::presses::Presses;
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

/// Whole objects are left out and judged. An object that is alone in its level is always learnt from and
/// never judged. `None` if that leaves fewer than two levels to tell apart.
pub fn by_object(presses: &Presses, places: &[usize]) -> Option<Vec<Fold>> {
    let mut of_levels = BTreeMap::<u8, Vec<Vec<usize>>>::new();
    for ((_, level, ..), own) in presses.by_object(places) {
        of_levels.entry(level).or_default().push(own);
    }
    of_levels.retain(|_, objects| objects.len() > 1);
    if of_levels.len() < 2 {
        return None;
    }
    let count = of_levels.values().map(Vec::len).sum();
    let groups = match count {
        0..=LEFT_OUT_ALONE => count,
        _ => GROUPS,
    };
    let mut tests = vec![Vec::new(); groups];
    let mut stream = Stream::new(SEED, "groups of objects");
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
    let objects = presses.by_object(places).into_values();
    let later = objects.flat_map(|own| {
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
    use std::collections::BTreeSet;

    use super::*;
    use crate::data::split::tests::presses as presses_of;

    /// Five presses of each object, in turn. The objects have these levels.
    fn presses(levels: &[u8]) -> (Presses, Vec<usize>) {
        let objects = (0..5).flat_map(|_| levels.iter().zip(0..));
        let presses = presses_of(objects.map(|(&level, object)| (level, object, 0)));
        let places = (0..presses.all.len()).collect();
        (presses, places)
    }

    #[test]
    fn each_object_is_judged_once_and_never_by_itself() {
        let many: Vec<u8> = (0..40).map(|n| n % 4 + 1).collect();
        for (levels, folds) in [(&[1, 1, 2, 2, 2][..], 5), (&many, 5), (&many[..12], 12)] {
            let (presses, places) = presses(levels);
            let found = by_object(&presses, &places).unwrap();
            assert_eq!(found.len(), folds);
            let judged = found.iter().flat_map(|fold| fold.test.clone());
            let judged: BTreeSet<usize> = judged.collect();
            assert!(judged.into_iter().eq(places));
            for Fold { train, test } in &found {
                let objects = |places: &[usize]| -> BTreeSet<_> {
                    presses.of(places).map(|press| press.object).collect()
                };
                assert!(objects(train).is_disjoint(&objects(test)));
            }
        }
    }

    #[test]
    fn an_object_alone_in_its_level_is_learnt_from_only() {
        let (mut one, places) = presses(&[1, 1, 2, 2, 3]);
        for Fold { train, test } in by_object(&one, &places).unwrap() {
            assert!(one.of(&test).all(|press| press.level < 3));
            assert!(one.of(&train).any(|press| press.level == 3));
        }
        for press in &mut one.all {
            press.level = press.level.max(2);
        }
        assert!(by_object(&one, &places).is_none());
    }

    #[test]
    fn the_later_presses_are_judged() {
        let (presses, places) = presses(&[1, 2]);
        let found = by_time(&presses, &places).unwrap();
        let expected = Fold {
            train: places[..6].to_vec(),
            test: places[6..].to_vec(),
        };
        assert_eq!(found, [expected]);
        assert!(by_time(&presses, &places[..2]).is_none());
    }
}
