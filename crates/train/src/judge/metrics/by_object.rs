//! Intervals of an accuracy, by a bootstrap over objects or geometries, and by Student's t over seeds.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF as _, StudentsT};

use super::Judged;
use hardnessd_simulator::random::Stream;

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

/// Samples that are alike and therefore do not count as independent: the bootstrap draws all
/// samples of a cluster together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Clusters {
    /// Each object is a cluster. Each draw takes as many objects of a level as there are.
    Objects,
    /// Objects are pressed alike if their numbers are equal modulo this value. The objects that are
    /// pressed alike, of all levels, are a cluster.
    Geometries(u32),
}

impl Clusters {
    /// The stratum and the cluster of an object. Each draw takes as many clusters of a stratum as
    /// there are.
    fn of(self, count: &ObjectCount) -> (u8, u32) {
        match self {
            Self::Objects => (count.level, count.object),
            Self::Geometries(number) => (0, count.object % number),
        }
    }
}

/// A share of samples, or a difference of two, with its 95 % interval.
///
/// With one seed, the interval comes from a bootstrap over [`Clusters`]. It does not cover what
/// another seed or another rounding would have given.
///
/// With several seeds, the variance is that of the bootstrap plus that of the mean over the seeds.
/// The interval is Student's, with the degrees of freedom of Welch and Satterthwaite. If the seeds
/// vary most, this is nearly the t interval over the seeds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// The value over all samples, and over the seeds if there are several.
    pub mean: f64,
    /// Low and high end. `None` where a stratum has only one cluster, because nothing then says how
    /// much its clusters vary.
    pub interval: Option<[f64; 2]>,
}

/// A method's accuracy over its seeds' judgements of the same samples; `None` if there are none. It
/// has no interval if all samples were judged rightly, or none: every draw is then the same.
pub fn accuracy_by_object(seeds: &[&[ObjectCount]], clusters: Clusters) -> Option<Estimate> {
    let right = |count: &ObjectCount| (*count, count.right as i64);
    let seeds: Vec<Vec<_>> = seeds
        .iter()
        .map(|counts| counts.iter().map(right).collect())
        .collect();
    let estimate = estimate(&seeds, clusters)?;
    let varies = 0.0 < estimate.mean && estimate.mean < 1.0;
    Some(Estimate {
        interval: estimate
            .interval
            .filter(|_| varies)
            .map(|[low, high]| [low.max(0.0), high.min(1.0)]),
        ..estimate
    })
}

/// A method's accuracy minus another's. Each pair of `seeds` holds both methods' judgements of the
/// same samples under one seed. Each draw takes a cluster for both methods, so that what is hard for
/// both cancels out. `None` without pairs, or if the two of a pair do not count the same samples.
pub fn difference_by_object(
    seeds: &[(&[ObjectCount], &[ObjectCount])],
    clusters: Clusters,
) -> Option<Estimate> {
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
    let estimate = estimate(&differences, clusters)?;
    Some(Estimate {
        interval: estimate
            .interval
            .map(|[low, high]| [low.max(-1.0), high.min(1.0)]),
        ..estimate
    })
}

/// The values and samples of some objects, added up.
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
/// values seed by seed.
fn estimate(seeds: &[Vec<(ObjectCount, i64)>], clusters: Clusters) -> Option<Estimate> {
    let mut strata: BTreeMap<u8, BTreeMap<u32, Sum>> = BTreeMap::new();
    let mut of_seeds = vec![Sum::default(); seeds.len()];
    for (of_seed, counts) in of_seeds.iter_mut().zip(seeds) {
        for (count, value) in counts {
            let (stratum, cluster) = clusters.of(count);
            let sums = strata.entry(stratum).or_default();
            sums.entry(cluster).or_default().add(*value, count.samples);
            of_seed.add(*value, count.samples);
        }
    }
    let strata: Vec<Vec<Sum>> = strata
        .into_values()
        .map(|sums| sums.into_values().collect())
        .collect();
    if strata.is_empty() {
        return None;
    }
    let mut total = Sum::default();
    for sum in strata.iter().flatten() {
        total.add(sum.value, sum.samples);
    }
    let mean = total.ratio();
    if strata.iter().any(|sums| sums.len() < 2) {
        let interval = None;
        return Some(Estimate { mean, interval });
    }
    let draws = bootstrap(&strata);
    let interval = if let [_] = seeds {
        [quantile(&draws, 0.025), quantile(&draws, 0.975)]
    } else {
        let means: Vec<f64> = of_seeds.into_iter().map(Sum::ratio).collect();
        let free: usize = strata.iter().map(|sums| sums.len() - 1).sum();
        let reach = student(&[
            (variance(&means) / seeds.len() as f64, seeds.len() - 1),
            (variance(&draws), free),
        ]);
        [mean - reach, mean + reach]
    };
    Some(Estimate {
        mean,
        interval: Some(interval),
    })
}

/// The ratios of [`DRAWS`] draws in ascending order. Each draw takes as many clusters as each stratum
/// has, with replacement. The draws use seed 0.
fn bootstrap(strata: &[Vec<Sum>]) -> Vec<f64> {
    let mut stream = Stream::new(0, "bootstrap by object");
    let mut draws: Vec<f64> = (0..DRAWS)
        .map(|_| {
            let mut total = Sum::default();
            for sums in strata {
                for _ in sums {
                    let drawn = sums[stream.below(sums.len())];
                    total.add(drawn.value, drawn.samples);
                }
            }
            total.ratio()
        })
        .collect();
    draws.sort_by(f64::total_cmp);
    draws
}

/// The variance of a sample of at least two values.
fn variance(values: &[f64]) -> f64 {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    squares / (values.len() - 1) as f64
}

/// How far Student's 95 % interval reaches on either side of a mean. `parts` are the independent
/// parts of the mean's variance, each with its degrees of freedom. Those of the sum follow from
/// Welch and Satterthwaite.
fn student(parts: &[(f64, usize)]) -> f64 {
    let sum: f64 = parts.iter().map(|(variance, _)| variance).sum();
    if sum == 0.0 {
        return 0.0;
    }
    let share = |&(variance, free): &(f64, usize)| variance.powi(2) / free as f64;
    let free = sum.powi(2) / parts.iter().map(share).sum::<f64>();
    let distribution =
        StudentsT::new(0.0, 1.0, free).expect("a variance above 0 has degrees of freedom above 0");
    distribution.inverse_cdf(0.975) * sum.sqrt()
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
        let difference = difference_by_object(&[(&first, &second)], Clusters::Objects).unwrap();
        assert_eq!(difference.mean, -0.04);
        assert_eq!(difference.interval, Some([-0.04, -0.04]));
        assert_eq!(
            difference_by_object(&[(&first, &second[..3])], Clusters::Objects),
            None
        );
        assert_eq!(difference_by_object(&[], Clusters::Objects), None);
    }

    #[test]
    fn one_object_a_level_has_no_interval() {
        let (first, second) = (counts(&[40]), counts(&[45]));
        let accuracy = accuracy_by_object(&[&first], Clusters::Objects).unwrap();
        assert_eq!((accuracy.mean, accuracy.interval), (0.8, None));
        let difference = difference_by_object(&[(&first, &second)], Clusters::Objects).unwrap();
        assert_eq!((difference.mean, difference.interval), (-0.1, None));
        // Nothing varies where all verdicts are right.
        let right = counts(&[50, 50, 50]);
        let accuracy = accuracy_by_object(&[&right], Clusters::Objects).unwrap();
        assert_eq!((accuracy.mean, accuracy.interval), (1.0, None));
        let samples = [1, 2].map(|level| judged(level, [0.7, 0.1, 0.1, 0.1], u32::from(level)));
        let evaluation = Evaluation::of(&samples, 4);
        assert_eq!(evaluation.accuracy_interval_by_object, None);
        let two = [3, 4].map(|object| judged(1, [0.7, 0.1, 0.1, 0.1], object));
        // Three objects of level 1, and still one of level 2.
        let samples = [&samples[..], &two].concat();
        let evaluation = Evaluation::of(&samples, 4);
        assert_eq!(evaluation.accuracy_interval_by_object, None);
        let another = judged(2, [0.7, 0.1, 0.1, 0.1], 5);
        let evaluation = Evaluation::of(&[&samples[..], &[another]].concat(), 4);
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
            let Estimate { mean, interval } =
                difference_by_object(pairs, Clusters::Objects).unwrap();
            assert_eq!(mean, 0.0);
            for (end, expected) in interval.unwrap().into_iter().zip([-0.0196, 0.0196]) {
                assert!((end - expected).abs() < 0.0012, "{interval:?}");
            }
        }
    }

    #[test]
    fn the_interval_over_seeds_is_students() {
        // All objects are alike, so only the seeds vary: 40, 60 and 80 %. The standard deviation is
        // 20 points, and the 97.5 % quantile of Student's t with 2 degrees of freedom is 4.3027.
        let seeds = [20, 30, 40].map(|right| counts(&[right; 40]));
        let seeds: Vec<&[ObjectCount]> = seeds.iter().map(Vec::as_slice).collect();
        let middle = counts(&[30; 40]);
        let pairs: Vec<_> = seeds.iter().map(|&seed| (seed, &middle[..])).collect();
        let difference = difference_by_object(&pairs, Clusters::Objects).unwrap();
        let reach = 4.3027 * 0.2 / 3_f64.sqrt();
        assert!(difference.mean.abs() < 1e-12);
        let [low, high] = difference.interval.unwrap();
        assert!((low + reach).abs() < 1e-4, "{low}, expected {}", -reach);
        assert!((high - reach).abs() < 1e-4, "{high}, expected {reach}");
        // An accuracy is at most 1.
        let accuracy = accuracy_by_object(&seeds, Clusters::Objects).unwrap();
        assert_eq!(accuracy.interval.unwrap()[1], 1.0);
    }

    #[test]
    fn objects_that_are_pressed_alike_are_drawn_together() {
        // Twenty geometries in four levels. In one method's eyes, half of the geometries are right
        // in every level. The mean's standard deviation is 0.5 / sqrt(20), not 0.5 / sqrt(80).
        let of = |object: u32| ObjectCount {
            level: (object / 20) as u8 + 1,
            object,
            right: if object.is_multiple_of(2) { 50 } else { 0 },
            samples: 50,
        };
        let all: Vec<ObjectCount> = (0..80).map(of).collect();
        for (clusters, number) in [(Clusters::Objects, 80.0), (Clusters::Geometries(20), 20.0)] {
            let estimate = accuracy_by_object(&[&all], clusters).unwrap();
            let [low, high] = estimate.interval.unwrap();
            let expected = 2.0 * 1.96 * 0.5 / f64::sqrt(number);
            assert!(
                ((high - low) / expected - 1.0).abs() < 0.12,
                "{clusters:?}: {low} to {high}, expected a width of {expected}"
            );
        }
    }
}
