//! Figures that follow from the counts of a confusion matrix: the paper's Eqs. 11 to 14, and kappa with weights.
//! Rows are the truth, columns the prediction.

fn total(confusion: &[Vec<u64>]) -> f64 {
    confusion.iter().flatten().sum::<u64>() as f64
}

/// Eq. (12): `P_overall = Z / N`.
pub fn accuracy(confusion: &[Vec<u64>]) -> f64 {
    let rows = confusion.iter().enumerate();
    let right: u64 = rows.map(|(level, row)| row[level]).sum();
    right as f64 / total(confusion)
}

/// Eq. (11): `P_i = Z_i / N_i`.
pub fn category_accuracy(confusion: &[Vec<u64>]) -> Vec<Option<f64>> {
    let of_row = |(level, row): (usize, &Vec<u64>)| {
        let count: u64 = row.iter().sum();
        (count > 0).then(|| row[level] as f64 / count as f64)
    };
    confusion.iter().enumerate().map(of_row).collect()
}

/// Cohen's kappa with the weight of disagreement `weight(truth, prediction)`:
/// 1 - observed / expected disagreement.
fn weighted_kappa(confusion: &[Vec<u64>], weight: impl Fn(usize, usize) -> f64) -> Option<f64> {
    let n = total(confusion);
    let levels = confusion.len();
    let of_row = |row: &Vec<u64>| row.iter().sum::<u64>() as f64;
    let rows: Vec<f64> = confusion.iter().map(of_row).collect();
    let of_column = |w: usize| confusion.iter().map(|row| row[w]).sum::<u64>() as f64;
    let columns: Vec<f64> = (0..levels).map(of_column).collect();
    let (mut observed, mut expected) = (0.0, 0.0);
    for h in 0..levels {
        for w in 0..levels {
            observed += weight(h, w) * confusion[h][w] as f64 / n;
            expected += weight(h, w) * rows[h] * columns[w] / (n * n);
        }
    }
    (expected > 0.0).then(|| 1.0 - observed / expected)
}

/// Eq. (14) on counts. The paper prints it with the rows' shares, which equals Cohen's kappa only
/// when all levels have the same number of samples. Eq. (13)'s text calls `N_hw` the samples
/// recognised falsely, but the diagonal, which Eq. (14) needs, counts those recognised rightly.
pub fn kappa(confusion: &[Vec<u64>]) -> Option<f64> {
    weighted_kappa(confusion, |h, w| if h == w { 0.0 } else { 1.0 })
}

/// Cohen's kappa on counts with quadratic weights; `None` where chance alone would always agree.
pub fn kappa_quadratic(confusion: &[Vec<u64>]) -> Option<f64> {
    weighted_kappa(confusion, |h, w| (h as f64 - w as f64).powi(2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::judge::paper;

    #[test]
    fn the_papers_other_figures_follow_from_its_confusion_matrices() {
        // Table 2's category accuracies and overall accuracy, Table 3's kappa, and the kappa with quadratic
        // weights, which the paper does not print, computed by hand.
        for (method, categories, overall, cohen, quadratic) in [
            ("hrn15", [67.2, 61.2, 56.8, 71.6], 64.2, 0.5227, 0.682),
            ("hrn100", [97.6, 94.4, 92.4, 99.2], 95.9, 0.9453, 0.973),
            ("sgan", [89.2, 84.0, 80.4, 91.2], 86.2, 0.816, 0.889),
            ("ours", [96.4, 92.8, 90.0, 98.4], 94.4, 0.9253, 0.963),
        ] {
            let counts = paper::confusion(method).unwrap();
            let alike = |found: f64, expected: f64, tolerance: f64| {
                assert!(
                    (found - expected).abs() < tolerance,
                    "{method}: {found}, {expected}"
                );
            };
            for (found, expected) in category_accuracy(&counts).into_iter().zip(categories) {
                alike(100.0 * found.unwrap(), expected, 1e-9);
            }
            alike(100.0 * accuracy(&counts), overall, 1e-9);
            alike(kappa(&counts).unwrap(), cohen, 0.5e-4);
            alike(kappa_quadratic(&counts).unwrap(), quadratic, 0.5e-3);
        }
    }
}
