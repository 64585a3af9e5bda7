//! Temperature scaling: the one number by which logits are divided, so that probabilities say how
//! often a verdict is right (Guo et al. 2017, "On calibration of modern neural networks").
//!
//! In: logits of held-out samples with their levels. Out: the temperature, and probabilities.

use burn::tensor::{Device, Tensor, activation};

use crate::net::network::numbers;

/// The level of a sample, from 0, and its logits.
pub type LevelAndLogits = (usize, Vec<f32>);

/// Mean cross-entropy of logits over `temperature`.
pub fn mean_loss(judged: &[LevelAndLogits], temperature: f64) -> f64 {
    let loss = |(level, logits): &LevelAndLogits| {
        let scaled: Vec<f64> = logits.iter().map(|&l| f64::from(l) / temperature).collect();
        let top = scaled.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        top + scaled.iter().map(|l| (l - top).exp()).sum::<f64>().ln() - scaled[*level]
    };
    judged.iter().map(loss).sum::<f64>() / judged.len() as f64
}

/// The temperature of least mean cross-entropy, between 1/8 and 8.
pub fn fit(judged: &[LevelAndLogits]) -> f32 {
    least(|temperature| mean_loss(judged, temperature))
}

/// The temperature of least loss, between 1/8 and 8. The loss of logits is convex in 1/T, so a
/// shrinking bracket finds its minimum.
pub fn least(loss: impl Fn(f64) -> f64) -> f32 {
    let (mut low, mut high) = (0.125_f64, 8.0_f64);
    for _ in 0..60 {
        let (left, right) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
        if loss(1.0 / left) < loss(1.0 / right) {
            high = right;
        } else {
            low = left;
        }
    }
    (2.0 / (low + high)) as f32
}

/// The softmax of the logits over `temperature`, one row per row of logits.
pub fn probabilities(logits: &[Vec<f32>], temperature: f32, device: &Device) -> Vec<Vec<f32>> {
    let one = |row: &Vec<f32>| {
        let scaled = Tensor::<1>::from_floats(row.as_slice(), device).div_scalar(temperature);
        numbers(&activation::softmax(scaled, 0))
    };
    logits.iter().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_temperature_undoes_overconfidence() {
        // The larger logit is right in 3 of 4 cases, but the logits are 4 times those of
        // probability 3/4.
        let honest = 3.0_f64.ln();
        let judged: Vec<LevelAndLogits> = (0..8)
            .map(|n| (usize::from(n % 4 == 0), vec![(4.0 * honest) as f32, 0.0]))
            .collect();
        assert!((fit(&judged) - 4.0).abs() < 1e-3, "{}", fit(&judged));
        assert!(mean_loss(&judged, 4.0) < mean_loss(&judged, 1.0));
    }
}
