//! The factor between a sensor's newtons and those that a model knows.
//!
//! A sensor may be calibrated wrongly, or have another cover. Then all its forces are too large or
//! too small by about the same factor, and a model of other presses judges all of them too hard or
//! too soft. A few labelled presses are enough to find one number.
//!
//! In: labels, and a model's logits for a factor. Out: the factor that makes the labels most
//! probable.

use std::collections::BTreeSet;

use burn::tensor::Device;

use crate::learn::temperature;

/// Steps of the search for an octave, and octaves on either side of 1.
const STEPS: i32 = 8;
const OCTAVES: i32 = 2;
/// The standard deviation of the logarithm of the factor, before any press is seen: two sensors in
/// three are off by a factor of less than 1.65.
const DEVIATION: f64 = 0.5;
/// Smaller probabilities are raised to this, so that no single press decides.
const LEAST_PROBABILITY: f32 = 1e-6;

/// The level 1..=L of a press, and the number of its object. No two objects have the same number.
pub type Label = (u8, u32);

/// The factor of the forces that makes the labels most probable. `logits` judges the labelled
/// presses with their forces times its argument; `temperature` divides the logits.
///
/// # Errors
///
/// Returns an error of `logits`.
pub fn factor(
    labels: &[Label],
    temperature: f32,
    device: &Device,
    mut logits: impl FnMut(f32) -> anyhow::Result<Vec<Vec<f32>>>,
) -> anyhow::Result<f32> {
    let objects: BTreeSet<u32> = labels.iter().map(|&(_, object)| object).collect();
    most_probable(objects.len(), |factor| {
        let said = temperature::probabilities(&logits(factor)?, temperature, device);
        Ok(mean_loss(&said, labels))
    })
}

/// The factor that makes labels most probable, if it is lognormal about 1. `loss` gives the mean
/// negative log-likelihood of the labels when all forces are multiplied by its argument. Presses of
/// one object err alike, so the labels count as much as `objects` independent ones.
fn most_probable(
    objects: usize,
    mut loss: impl FnMut(f32) -> anyhow::Result<f64>,
) -> anyhow::Result<f32> {
    let mut best = (f64::INFINITY, 1.0);
    for step in -OCTAVES * STEPS..=OCTAVES * STEPS {
        let factor = f32::powf(2.0, step as f32 / STEPS as f32);
        let logarithm = f64::from(factor).ln();
        let unlikely = (logarithm / DEVIATION).powi(2) / 2.0;
        let surprise = loss(factor)? * objects as f64 + unlikely;
        if surprise < best.0 {
            best = (surprise, factor);
        }
    }
    Ok(best.1)
}

/// The mean negative log-likelihood of the labels' levels under rows of probabilities.
fn mean_loss(probabilities: &[Vec<f32>], labels: &[Label]) -> f64 {
    let of_one = |(row, &(level, _)): (&Vec<f32>, &Label)| {
        let probability = row[usize::from(level) - 1].max(LEAST_PROBABILITY);
        -f64::from(probability).ln()
    };
    let sum: f64 = probabilities.iter().zip(labels).map(of_one).sum();
    sum / probabilities.len().max(1) as f64
}

/// A line about a factor, for the user. `None` if it is 1.
pub fn account(factor: f32) -> Option<String> {
    ((factor - 1.0).abs() > 1e-3).then(|| {
        format!(
            "forces times {factor:.2}: by the labels, this sensor's newtons are {:.2} times those that the \
             model knows",
            1.0 / factor
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_factor_is_where_the_labels_are_most_probable() {
        // A model that is sure only at 0.5.
        let loss = |factor: f32| Ok(f64::from((factor / 0.5).ln().abs()));
        assert_eq!(most_probable(12, loss).unwrap(), 0.5);
    }

    #[test]
    fn without_evidence_the_factor_is_1() {
        assert_eq!(most_probable(12, |_| Ok(1.0)).unwrap(), 1.0);
        let weak = |factor: f32| Ok(0.01 * f64::from((factor / 0.5).ln().abs()));
        assert_eq!(most_probable(1, weak).unwrap(), 1.0);
    }

    #[test]
    fn one_press_does_not_decide() {
        let rows = [vec![0.0, 1.0], vec![0.5, 0.5]];
        let loss = mean_loss(&rows, &[(1, 0), (2, 1)]);
        let expected = (1e6_f64.ln() + 2.0_f64.ln()) / 2.0;
        assert!((loss - expected).abs() < 1e-3, "{loss}");
    }
}
