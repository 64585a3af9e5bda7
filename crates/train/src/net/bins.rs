//! One distribution over Shore hardness: a network's outputs as equal bins from 0 to 100 Shore OO.
//!
//! The levels' probabilities, the value and the interval of a verdict all follow from the
//! distribution ([`hardnessd_core::verdict::Distribution`]), so none contradicts another.

use burn::tensor::{Device, Tensor, TensorData, activation};

use crate::net::network::{numbers, targets};
use hardnessd_core::verdict::Borders;

/// The number of bins. A border between two of the paper's levels is a border between two bins.
pub const BINS: usize = 50;
/// The graph's constant with the lifts.
pub const LIFTS: &str = "lifts of bins";
/// Width of a bin in Shore OO.
const WIDTH: f32 = 100.0 / BINS as f32;
/// The standard deviation in Shore OO of the readings that a press is taught with: repeated readings
/// of a durometer differ about so much.
const READING: f32 = 1.5;
/// A level is taken as at least this likely, so that its logarithm stays finite.
const LEAST: f32 = 1e-6;

/// A label of a press: its level, from 1, and its Shore hardness where it was measured.
pub type Label = (u8, Option<f32>);

/// The share of each bin that lies in each level, `[BINS, levels]`.
pub fn parts(borders: &Borders, levels: usize, device: &Device) -> Tensor<2> {
    let mut shares = vec![0.0; BINS * levels];
    for (place, share) in shares.iter_mut().enumerate() {
        *share = part(borders, place / levels, place % levels);
    }
    Tensor::from_data(TensorData::new(shares, [BINS, levels]), device)
}

/// The reading of a durometer as a distribution over the bins. 0 everywhere if there is none.
fn reading(shore: Option<f32>) -> Vec<f32> {
    let Some(shore) = shore else {
        return vec![0.0; BINS];
    };
    let density = |bin: usize| {
        let off = ((bin as f32 + 0.5) * WIDTH - shore.clamp(0.0, 100.0)) / READING;
        (-0.5 * off * off).exp()
    };
    let densities: Vec<f32> = (0..BINS).map(density).collect();
    let sum: f32 = densities.iter().sum();
    densities.into_iter().map(|density| density / sum).collect()
}

/// What is added to the logits of the bins so that they are of a world in which all levels are equally
/// frequent. `counts` has the number of training presses of each level.
pub fn lifts(borders: &Borders, counts: &[usize]) -> Vec<f32> {
    let sum: usize = counts.iter().map(|&count| count.max(1)).sum();
    let rarity = |level: usize| -(counts[level].max(1) as f32 / sum as f32).ln();
    let of_bin = |bin: usize| {
        let levels = 0..counts.len();
        let rarities = levels.map(|level| part(borders, bin, level) * rarity(level));
        rarities.sum::<f32>()
    };
    (0..BINS).map(of_bin).collect()
}

/// The share of a bin that lies in a level.
fn part(borders: &Borders, bin: usize, level: usize) -> f32 {
    let [low, high] = borders.part(level);
    let (from, to) = (bin as f32 * WIDTH, (bin + 1) as f32 * WIDTH);
    ((to.min(high) - from.max(low)) / WIDTH).max(0.0)
}

/// The mean loss of presses: the cross-entropy of the levels, and that of the readings where there
/// are any. Also returns the levels' probabilities, press by press.
pub fn loss(outputs: Tensor<2>, labels: &[Label], parts: &Tensor<2>) -> (Tensor<1>, Vec<f32>) {
    let (count, [_, levels]) = (labels.len(), parts.dims());
    let device = outputs.device();
    let readings = labels.iter().flat_map(|&(_, shore)| reading(shore));
    let readings: Vec<f32> = readings.collect();
    let readings = Tensor::<2>::from_data(TensorData::new(readings, [count, BINS]), &device);
    let is_level = targets(labels.iter().map(|&(level, _)| level), levels, &device);

    let logarithms = activation::log_softmax(outputs, 1);
    let of_levels = logarithms.clone().exp().matmul(parts.clone());
    let judged = numbers(&of_levels);
    let level_loss = of_levels.clamp_min(LEAST).log().mul(is_level).sum_dim(1);
    let reading_loss = logarithms.mul(readings).sum_dim(1);
    let loss = level_loss.add(reading_loss).sum().neg();
    (loss.div_scalar(count as f32), judged)
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::verdict::Level;

    /// Levels that touch, as in simulated data.
    fn touching() -> Borders {
        let level = |(level, shore): (u8, &str)| Level::new(level, "any", shore);
        let ranges = [">70", "60-70", "50-60", "<=50"];
        let levels: Vec<Level> = (1..).zip(ranges).map(level).collect();
        Borders::of(&levels).unwrap()
    }

    #[test]
    fn a_level_has_its_part_of_the_scale() {
        let device = Device::flex();
        let borders = touching();
        let parts = parts(&borders, 4, &device);
        let of_levels = numbers(&parts.clone().sum_dim(0));
        assert_eq!(of_levels, [15.0, 5.0, 5.0, 25.0]);
        assert!(
            numbers(&parts.sum_dim(1))
                .iter()
                .all(|&sum| (sum - 1.0).abs() < 1e-6)
        );
    }

    #[test]
    fn lifted_bins_are_of_a_world_of_equally_frequent_levels() {
        let borders = touching();
        let counts = [30, 10, 10, 50];
        let lifts = lifts(&borders, &counts);
        // Logits of the frequencies alone.
        let frequency = |bin: usize| {
            let level = (0..4)
                .find(|&level| part(&borders, bin, level) > 0.5)
                .unwrap();
            let [low, high] = borders.part(level);
            (counts[level] as f32 / (high - low)).ln()
        };
        let lifted: Vec<f32> = (0..BINS).map(|bin| frequency(bin) + lifts[bin]).collect();
        let levels = hardnessd_core::verdict::Distribution::of(&lifted).levels(&borders);
        assert!(levels.iter().all(|p| (p - 0.25).abs() < 1e-5), "{levels:?}");
    }

    #[test]
    fn the_loss_is_least_at_the_reading_and_in_the_level() {
        let device = Device::flex();
        let borders = touching();
        let parts = parts(&borders, 4, &device);
        let at = |bin: usize, label: Label| {
            let mut logits = vec![0.0; BINS];
            logits[bin] = 5.0;
            let data = TensorData::new(logits, [1, BINS]);
            let (loss, judged) = loss(Tensor::from_data(data, &device), &[label], &parts);
            assert!((judged.iter().sum::<f32>() - 1.0).abs() < 1e-5);
            numbers(&loss)[0]
        };
        // 63 is in bin 31, and level 2 has the bins 30 to 34.
        let measured = (2, Some(63.0));
        assert!(at(31, measured) < at(30, measured) && at(30, measured) < at(29, measured));
        assert!((at(30, (2, None)) - at(34, (2, None))).abs() < 1e-5);
        assert!(at(30, (2, None)) < at(29, (2, None)) - 1.0);
    }
}
