//! Calibrates verdicts on held-out objects: the temperature, the threshold for sets of levels, and
//! the widths of intervals (split conformal prediction, by object).

use std::collections::BTreeMap;

use burn::tensor::Device;

use crate::learn::temperature;
use hardnessd_simulator::random::Stream;

/// Sets of levels and intervals of Shore hardness miss the truth in at most this share of cases.
pub const ALPHA: f32 = 0.1;
/// The fewest held-out objects with which [`ALPHA`] can be promised: with n objects, at least one in
/// n + 1 cases may exceed the greatest value among them.
pub const LEAST_OBJECTS: usize = 9;
/// A quantile is the mean over this many draws of one press from each object.
const DRAWS: usize = 50;

/// A press of a held-out object, and the network's outputs for it.
#[derive(Debug, Clone, PartialEq)]
pub struct Judged {
    /// The number of the pressed object.
    pub object: u32,
    /// The object's level, from 0.
    pub level: usize,
    /// The measured Shore OO hardness, if any.
    pub shore: Option<f32>,
    /// Logits, before temperature.
    pub logits: Vec<f32>,
    /// The network's Shore OO: value, low, high, before the interval is widened.
    pub stated: [f32; 3],
}

/// The calibration computed from the held-out presses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Calibration {
    /// The divisor of the logits.
    pub temperature: f32,
    /// The widths added below and above the interval, in Shore OO.
    pub widths: [f32; 2],
    /// A set of levels holds the levels of at least this probability. 0 means that there are no
    /// sets.
    pub threshold: f32,
    /// The number of held-out objects, and of those whose Shore hardness was measured.
    pub objects: [usize; 2],
}

impl Calibration {
    /// The calibration without held-out presses: it changes nothing and promises nothing.
    pub const NONE: Self = Self {
        temperature: 1.0,
        widths: [0.0; 2],
        threshold: 0.0,
        objects: [0; 2],
    };

    /// Calibrates on held-out presses. `stream` draws presses of the objects. With fewer than
    /// [`LEAST_OBJECTS`] objects there are no sets. With fewer than that many measured objects, the
    /// interval is not widened.
    pub fn of(presses: &[Judged], stream: &mut Stream, device: &Device) -> Self {
        if presses.is_empty() {
            return Self::NONE;
        }
        let level_and_logits = |press: &Judged| (press.level, press.logits.clone());
        let judged: Vec<_> = presses.iter().map(level_and_logits).collect();
        let temperature = temperature::fit(&judged);
        let rows: Vec<Vec<f32>> = judged.into_iter().map(|(_, row)| row).collect();
        let probabilities = temperature::probabilities(&rows, temperature, device);
        let wrong = presses
            .iter()
            .zip(&probabilities)
            .map(|(press, row)| (press.object, -row[press.level]));
        let wrong = by_object(wrong);
        let threshold = quantile(&wrong, stream).map_or(0.0, |wrong| -wrong);
        let outside = presses.iter().filter_map(|press| {
            let [_, low, high] = press.stated;
            let shore = press.shore?;
            Some((press.object, (low - shore).max(shore - high)))
        });
        let outside = by_object(outside);
        let width = quantile(&outside, stream);
        Self {
            temperature,
            widths: width.map_or([0.0; 2], |width| [width; 2]),
            threshold,
            objects: [wrong.len(), outside.len()],
        }
    }

    /// The calibration of a distribution with this temperature. `of_truth` has for each press its
    /// object, whether the object's Shore hardness was measured, and the probability of its level.
    pub fn of_sets(
        temperature: f32,
        of_truth: impl Iterator<Item = ((u32, bool), f32)>,
        stream: &mut Stream,
    ) -> Self {
        let of_truth: Vec<_> = of_truth.collect();
        let wrong = of_truth.iter().map(|&((object, _), p)| (object, -p));
        let wrong = by_object(wrong);
        let measured = of_truth.iter().filter(|((_, is_measured), _)| *is_measured);
        let measured = by_object(measured.map(|&((object, _), p)| (object, p)));
        Self {
            temperature,
            widths: [0.0; 2],
            threshold: quantile(&wrong, stream).map_or(0.0, |wrong| -wrong),
            objects: [wrong.len(), measured.len()],
        }
    }

    /// What the calibration cannot promise, and why, in one line. `None` if it promises both the
    /// sets of levels and the interval of the Shore hardness.
    pub fn missing(&self) -> Option<String> {
        let [objects, _] = self.objects;
        if objects >= LEAST_OBJECTS {
            return self.missing_interval();
        }
        Some(format!(
            "held-out objects: found {objects}, expected at least {LEAST_OBJECTS}: there are no sets \
             of levels, and nothing promises that the interval of the Shore hardness holds"
        ))
    }

    /// The same of the interval alone.
    pub fn missing_interval(&self) -> Option<String> {
        let [_, measured] = self.objects;
        (measured < LEAST_OBJECTS).then(|| {
            format!(
                "held-out objects with a measured Shore hardness: found {measured}, expected at \
                 least {LEAST_OBJECTS}: nothing promises that the interval of the Shore hardness holds"
            )
        })
    }
}

/// Groups values of presses into one list per object.
fn by_object(values: impl Iterator<Item = (u32, f32)>) -> Vec<Vec<f32>> {
    let mut objects = BTreeMap::<u32, Vec<f32>>::new();
    for (object, value) in values {
        objects.entry(object).or_default().push(value);
    }
    objects.into_values().collect()
}

/// The split-conformal quantile of 1 - [`ALPHA`] for exchangeable objects: with one press of each
/// of n objects, the value of rank ceil((1 - alpha)(n + 1)), averaged over draws of the presses.
/// `None` with fewer objects than the rank: no value is then large enough.
fn quantile(objects: &[Vec<f32>], stream: &mut Stream) -> Option<f32> {
    let rank = ((1.0 - ALPHA) * (objects.len() + 1) as f32).ceil() as usize;
    if rank > objects.len() {
        return None;
    }
    let mut sum = 0.0;
    for _ in 0..DRAWS {
        let mut drawn: Vec<f32> = objects
            .iter()
            .map(|own| own[stream.below(own.len())])
            .collect();
        drawn.sort_by(f32::total_cmp);
        sum += drawn[rank - 1];
    }
    Some(sum / DRAWS as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_quantile_counts_objects_not_presses() {
        let mut stream = Stream::new(1, "quantile");
        // 99 objects of value 1 to 99; the last has a thousand presses.
        let mut objects: Vec<Vec<f32>> = (1..=99_u8).map(|n| vec![f32::from(n)]).collect();
        objects[98] = vec![99.0; 1000];
        assert_eq!(quantile(&objects, &mut stream), Some(90.0));
        // Of nine objects, the rank is the greatest value. Fewer objects are too few for it.
        assert_eq!(quantile(&objects[..LEAST_OBJECTS], &mut stream), Some(9.0));
        for few in 0..LEAST_OBJECTS {
            assert_eq!(quantile(&objects[..few], &mut stream), None, "{few}");
        }
    }

    /// Three presses of each of `objects` objects. The first `measured` have a Shore hardness, which
    /// lies 4 above the interval.
    fn judged(objects: u32, measured: u32) -> Vec<Judged> {
        let press = |n: u32| Judged {
            object: n / 3,
            level: (n % 2) as usize,
            shore: (n / 3 < measured).then_some(60.0),
            logits: vec![1.0, 1.0],
            stated: [55.0, 54.0, 56.0],
        };
        (0..3 * objects).map(press).collect()
    }

    #[test]
    fn few_objects_give_no_sets_and_promise_nothing() {
        let device = Device::flex();
        let of = |objects, measured| {
            let stream = &mut Stream::new(1, "calibration");
            Calibration::of(&judged(objects, measured), stream, &device)
        };
        let enough = of(9, 9);
        assert!((enough.threshold - 0.5).abs() < 1e-3, "{enough:?}");
        assert_eq!((enough.widths, enough.objects), ([4.0; 2], [9, 9]));
        assert_eq!(enough.missing(), None);

        let few = of(8, 8);
        assert_eq!((few.threshold, few.widths), (0.0, [0.0; 2]));
        let missing = few.missing().unwrap();
        assert!(
            missing.contains("found 8, expected at least 9"),
            "{missing}"
        );

        let unmeasured = of(9, 2);
        assert!(unmeasured.threshold > 0.0 && unmeasured.widths == [0.0; 2]);
        let missing = unmeasured.missing().unwrap();
        assert!(missing.contains("Shore hardness: found 2"), "{missing}");

        let none = of(0, 0);
        assert_eq!(none, Calibration::NONE);
        assert!(none.missing().unwrap().contains("found 0"));
    }
}
