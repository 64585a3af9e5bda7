//! Calibrates verdicts on held-out objects: the temperature, the threshold for sets of levels, and
//! the widths of intervals (split conformal prediction, by object).

use std::collections::BTreeMap;

use burn::tensor::Device;

use crate::random::Stream;
use crate::train::learn::fit;

/// Sets of levels and intervals of Shore hardness miss the truth in at most this share of cases.
pub const ALPHA: f32 = 0.1;
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
    pub said: [f32; 3],
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
}

impl Calibration {
    /// The calibration without held-out presses: it changes nothing and promises nothing.
    pub const NONE: Self = Self {
        temperature: 1.0,
        widths: [0.0; 2],
        threshold: 0.0,
    };

    /// Calibrates on held-out presses. `stream` draws presses of the objects.
    pub fn of(presses: &[Judged], stream: &mut Stream, device: &Device) -> Self {
        let level_and_logits = |press: &Judged| (press.level, press.logits.clone());
        let judged: Vec<_> = presses.iter().map(level_and_logits).collect();
        let temperature = fit::temperature(&judged);
        let rows: Vec<Vec<f32>> = judged.into_iter().map(|(_, row)| row).collect();
        let probabilities = fit::probabilities(&rows, temperature, device);
        let wrong = presses
            .iter()
            .zip(&probabilities)
            .map(|(press, row)| (press.object, -row[press.level]));
        let Some(wrong) = quantile(&by_object(wrong), stream) else {
            return Self::NONE;
        };
        let outside = presses.iter().filter_map(|press| {
            let [_, low, high] = press.said;
            let shore = press.shore?;
            Some((press.object, (low - shore).max(shore - high)))
        });
        let width = quantile(&by_object(outside), stream).unwrap_or(0.0);
        Self {
            temperature,
            widths: [width; 2],
            threshold: -wrong,
        }
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
/// `None` without objects.
fn quantile(objects: &[Vec<f32>], stream: &mut Stream) -> Option<f32> {
    if objects.is_empty() {
        return None;
    }
    let rank = ((1.0 - ALPHA) * (objects.len() + 1) as f32).ceil() as usize;
    let mut sum = 0.0;
    for _ in 0..DRAWS {
        let mut drawn: Vec<f32> = objects
            .iter()
            .map(|own| own[stream.below(own.len())])
            .collect();
        drawn.sort_by(f32::total_cmp);
        sum += drawn[rank.min(drawn.len()) - 1];
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
        // With too few objects for the rank, the quantile is the greatest value.
        assert_eq!(quantile(&objects[..3], &mut stream), Some(3.0));
        assert_eq!(quantile(&[], &mut stream), None);
    }
}
