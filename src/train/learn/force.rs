//! The factor between a sensor's newtons and those that a model knows.
//!
//! A sensor may be calibrated wrongly, or have another cover. Then all its forces are too large or
//! too small by about the same factor, and a model of other presses judges all of them too hard or
//! too soft. A few labelled presses are enough to find one number.

/// Steps of the search for an octave, and octaves on either side of 1.
const STEPS: i32 = 8;
const OCTAVES: i32 = 2;
/// The standard deviation of the logarithm of the factor, before any press is seen: two sensors in
/// three are off by less than 1.65.
const DEVIATION: f64 = 0.5;

/// The factor that makes labels most probable, if it is lognormal about 1. `loss` gives the mean
/// negative log-likelihood of the labels when all forces are multiplied by its argument. Presses of
/// one object err alike, so the labels count as much as `objects` independent ones.
///
/// # Errors
///
/// Returns an error of `loss`.
pub fn factor(
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

/// The mean negative log-likelihood of levels, each 1..=L, under rows of probabilities.
pub fn mean_loss(probabilities: &[Vec<f32>], levels: impl Iterator<Item = u8>) -> f64 {
    let of_one = |(row, level): (&Vec<f32>, u8)| {
        // A level that is all but impossible costs no more than this, so that no single press decides.
        -f64::from(row[usize::from(level) - 1].max(1e-6)).ln()
    };
    let sum: f64 = probabilities.iter().zip(levels).map(of_one).sum();
    sum / probabilities.len().max(1) as f64
}

/// What the user is told of a factor, if it is not 1.
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
        assert_eq!(factor(12, loss).unwrap(), 0.5);
    }

    #[test]
    fn without_evidence_the_factor_is_1() {
        assert_eq!(factor(12, |_| Ok(1.0)).unwrap(), 1.0);
        let weak = |factor: f32| Ok(0.01 * f64::from((factor / 0.5).ln().abs()));
        assert_eq!(factor(1, weak).unwrap(), 1.0);
        assert_eq!(account(1.0), None);
    }

    #[test]
    fn one_press_does_not_decide() {
        let rows = [vec![0.0, 1.0], vec![0.5, 0.5]];
        let loss = mean_loss(&rows, [1, 2].into_iter());
        let expected = (1e6_f64.ln() + 2.0_f64.ln()) / 2.0;
        assert!((loss - expected).abs() < 1e-3, "{loss}");
    }
}
