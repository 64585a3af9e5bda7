//! Intervals of an accuracy, by a bootstrap over objects and over seeds.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::Judged;
use crate::random::Stream;

/// The number of draws of the bootstrap.
const DRAWS: usize = 2_000;

/// How often an object was judged rightly.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ObjectCount {
    /// The object's true level, 1..=L.
    pub level: u8,
    /// The object's number.
    pub object: u32,
    /// Samples judged rightly.
    pub right: u64,
    /// All samples of the object.
    pub samples: u64,
}

/// The objects of `judged` in the order of level and number; `None` if a sample has no object.
pub fn by_object(judged: &[Judged]) -> Option<Vec<ObjectCount>> {
    let mut objects: BTreeMap<(u8, u32), (u64, u64)> = BTreeMap::new();
    for one in judged {
        let (right, samples) = objects.entry((one.level, one.object?)).or_default();
        *right += u64::from(one.prediction() == one.truth());
        *samples += 1;
    }
    let count = |((level, object), (right, samples))| ObjectCount {
        level,
        object,
        right,
        samples,
    };
    Some(objects.into_iter().map(count).collect())
}

/// A share of samples, or a difference of two, with its 95 % interval by a bootstrap over objects
/// within each level, and over seeds if there are several. The interval of one seed does not cover
/// what another seed or another rounding would have given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Estimate {
    /// The value over all samples, and over the seeds if there are several.
    pub mean: f64,
    /// Low and high end. `None` where no level has two objects, because every draw is then the same
    /// and says nothing about other objects.
    pub interval: Option<[f64; 2]>,
}

/// A method's accuracy over its seeds' judgements of the same samples; `None` if there are none.
pub fn accuracy_by_object(seeds: &[&[ObjectCount]]) -> Option<Estimate> {
    let right = |count: &ObjectCount| (*count, count.right as i64);
    let seeds: Vec<Vec<_>> = seeds
        .iter()
        .map(|counts| counts.iter().map(right).collect())
        .collect();
    bootstrap(&seeds)
}

/// A method's accuracy minus another's. Each pair of `seeds` holds both methods' judgements of the
/// same samples under one seed. Each draw takes an object and a seed for both methods, so that what
/// is hard for both cancels out. `None` without pairs, or if the two of a pair do not count the
/// same samples.
pub fn difference_by_object(seeds: &[(&[ObjectCount], &[ObjectCount])]) -> Option<Estimate> {
    let samples = |count: &ObjectCount| (count.level, count.object, count.samples);
    let mut differences = Vec::new();
    for (method, other) in seeds {
        if !method.iter().map(samples).eq(other.iter().map(samples)) {
            return None;
        }
        let pairs = method.iter().zip(*other);
        differences.push(
            pairs
                .map(|(a, b)| (*a, a.right as i64 - b.right as i64))
                .collect(),
        );
    }
    bootstrap(&differences)
}

/// An object's values and samples under each seed, added up over some draw of the seeds.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    value: i64,
    samples: u64,
}

impl Sum {
    fn add(&mut self, value: i64, samples: u64) {
        self.value += value;
        self.samples += samples;
    }

    fn ratio(self) -> f64 {
        self.value as f64 / self.samples as f64
    }
}

/// Estimates a sum of values over objects, divided by their samples; `seeds` has the counts and
/// values seed by seed. Each draw takes seeds, if there are several, and as many whole objects as
/// each level has, both with replacement. A drawn object counts under every drawn seed. The draws
/// themselves use seed 0.
fn bootstrap(seeds: &[Vec<(ObjectCount, i64)>]) -> Option<Estimate> {
    let mut levels: BTreeMap<u8, BTreeMap<u32, Vec<Sum>>> = BTreeMap::new();
    for (seed, counts) in seeds.iter().enumerate() {
        for (count, value) in counts {
            let objects = levels.entry(count.level).or_default();
            let sums = objects.entry(count.object);
            let sums = sums.or_insert_with(|| vec![Sum::default(); seeds.len()]);
            sums[seed].add(*value, count.samples);
        }
    }
    let levels: Vec<Vec<Vec<Sum>>> = levels
        .into_values()
        .map(|objects| objects.into_values().collect())
        .collect();
    if levels.is_empty() {
        return None;
    }
    let mut total = Sum::default();
    for sum in levels.iter().flatten().flatten() {
        total.add(sum.value, sum.samples);
    }
    let mean = total.ratio();
    if levels.iter().all(|objects| objects.len() < 2) {
        let interval = None;
        return Some(Estimate { mean, interval });
    }
    let mut stream = Stream::new(0, "bootstrap by object");
    let mut draws: Vec<f64> = (0..DRAWS)
        .map(|_| {
            let drawn: Vec<usize> = match seeds.len() {
                1 => vec![0],
                several => (0..several).map(|_| stream.below(several)).collect(),
            };
            let mut total = Sum::default();
            for objects in &levels {
                for _ in objects {
                    let object = &objects[stream.below(objects.len())];
                    for &seed in &drawn {
                        total.add(object[seed].value, object[seed].samples);
                    }
                }
            }
            total.ratio()
        })
        .collect();
    draws.sort_by(f64::total_cmp);
    Some(Estimate {
        mean,
        interval: Some([quantile(&draws, 0.025), quantile(&draws, 0.975)]),
    })
}

/// The quantile, linear between the two nearest values, as numpy does by default.
fn quantile(sorted: &[f64], q: f64) -> f64 {
    let place = q * (sorted.len() - 1) as f64;
    let below = place.floor() as usize;
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + (place - below as f64) * (sorted[above] - sorted[below])
}

#[cfg(test)]
mod tests {
    use super::super::{Evaluation, tests::judged};
    use super::*;

    /// Objects of one level with 50 samples each, of which `right` were judged rightly.
    fn counts(right: &[u64]) -> Vec<ObjectCount> {
        (0..)
            .zip(right)
            .map(|(object, &right)| ObjectCount {
                level: 1,
                object,
                right,
                samples: 50,
            })
            .collect()
    }

    #[test]
    fn a_difference_that_is_the_same_on_every_object_is_certain() {
        // The objects differ widely, but the second method is two samples better on each object.
        let (first, second) = (counts(&[0, 10, 48, 30]), counts(&[2, 12, 50, 32]));
        let difference = difference_by_object(&[(&first, &second)]).unwrap();
        assert_eq!(difference.mean, -0.04);
        assert_eq!(difference.interval, Some([-0.04, -0.04]));
        assert_eq!(difference_by_object(&[(&first, &second[..3])]), None);
        assert_eq!(difference_by_object(&[]), None);
    }

    #[test]
    fn one_object_a_level_has_no_interval() {
        let (first, second) = (counts(&[40]), counts(&[45]));
        let accuracy = accuracy_by_object(&[&first]).unwrap();
        assert_eq!((accuracy.mean, accuracy.interval), (0.8, None));
        let difference = difference_by_object(&[(&first, &second)]).unwrap();
        assert_eq!((difference.mean, difference.interval), (-0.1, None));
        let samples = [1, 2].map(|level| judged(level, [0.7, 0.1, 0.1, 0.1], u32::from(level)));
        let evaluation = Evaluation::of(&samples, 4);
        assert_eq!(evaluation.accuracy_interval_by_object, None);
        let two = [3, 4].map(|object| judged(1, [0.7, 0.1, 0.1, 0.1], object));
        let evaluation = Evaluation::of(&[&samples[..], &two].concat(), 4);
        assert!(evaluation.accuracy_interval_by_object.is_some());
    }

    #[test]
    fn the_interval_of_a_difference_is_the_normal_one_for_many_objects() {
        // The first method is 10 samples better on half of 400 objects and 10 worse on the others,
        // and each seed gives the same. So the mean's standard deviation is 0.2 / sqrt(400) = 0.01
        // for any number of seeds.
        let first = counts(&[30; 400]);
        let second = counts(&[[20; 200], [40; 200]].concat());
        let pair = (&first[..], &second[..]);
        for pairs in [&[pair][..], &[pair, pair]] {
            let Estimate { mean, interval } = difference_by_object(pairs).unwrap();
            assert_eq!(mean, 0.0);
            for (end, expected) in interval.unwrap().into_iter().zip([-0.0196, 0.0196]) {
                assert!((end - expected).abs() < 0.0012, "{interval:?}");
            }
        }
    }

    #[test]
    fn seeds_that_differ_widen_the_interval() {
        // One seed is better by 10 of 50 samples on every object, the other is worse by 10. Both
        // drawn seeds are the better one in a quarter of the draws, and the worse one in another
        // quarter.
        let (low, middle, high) = (counts(&[20; 40]), counts(&[30; 40]), counts(&[40; 40]));
        let pairs = [(&high[..], &middle[..]), (&low[..], &middle[..])];
        let difference = difference_by_object(&pairs).unwrap();
        assert_eq!(difference.mean, 0.0);
        assert_eq!(difference.interval, Some([-0.2, 0.2]));
        let accuracy = accuracy_by_object(&[&high, &low]).unwrap();
        assert_eq!(accuracy.interval, Some([0.4, 0.8]));
    }
}
