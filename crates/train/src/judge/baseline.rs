//! The trivial baseline: multinomial logistic regression on hand-made features of a frame or a
//! press.
//!
//! The baseline shows how much area, force and spread alone say. Every table includes it.

use crate::judge::features::{FEATURES, Moments, feature_graph};
use crate::net::graph::Graph;

/// Weight of the squared coefficients relative to the mean loss. It keeps Newton's method solvable
/// where two features carry the same information, and is too small to matter otherwise.
const RIDGE: f64 = 1e-4;

/// A fitted baseline.
#[derive(Debug, Clone, PartialEq)]
pub struct Baseline {
    /// Of the features over the training samples.
    moments: Moments,
    /// `[L][features + 1]`: for each level a coefficient per feature, and the bias.
    coefficients: Vec<Vec<f64>>,
    /// Newton steps that the fit took.
    pub steps: u32,
    /// Mean loss on the training samples plus the ridge.
    pub loss: f64,
}

impl Baseline {
    /// Fits rows of features to their levels by Newton's method. Levels count from 0.
    pub fn fit(rows: &[Vec<f32>], level_of: &[usize], levels: usize) -> Self {
        let moments = Moments::of(rows);
        let coefficients = vec![vec![0.0; moments.mean.len() + 1]; levels];
        let mut baseline = Self {
            moments,
            coefficients,
            steps: 0,
            loss: 0.0,
        };
        let rows: Vec<Vec<f64>> = rows.iter().map(|row| baseline.standardised(row)).collect();

        baseline.loss = baseline.loss_on(&rows, level_of);
        for _ in 0..50 {
            let step = baseline.newton_step(&rows, level_of);
            // Halve the step until the loss falls, because a whole step far from the optimum may
            // overshoot.
            let mut share = 1.0;
            let next = loop {
                let mut next = baseline.moved(&step, share);
                next.loss = next.loss_on(&rows, level_of);
                if next.loss < baseline.loss {
                    break Some(next);
                }
                share /= 2.0;
                if share < 1e-6 {
                    break None;
                }
            };
            let Some(next) = next else { break };
            let gain = baseline.loss - next.loss;
            baseline = next;
            baseline.steps += 1;
            if gain < 1e-9 {
                break;
            }
        }
        baseline
    }

    /// The standardised features, and a 1 for the bias.
    fn standardised(&self, row: &[f32]) -> Vec<f64> {
        let mut row = self.moments.standardised(row);
        row.push(1.0);
        row
    }

    fn probabilities_of(&self, row: &[f64]) -> Vec<f64> {
        let logits: Vec<f64> = self
            .coefficients
            .iter()
            .map(|level| level.iter().zip(row).map(|(c, x)| c * x).sum())
            .collect();
        let top = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let shares: Vec<f64> = logits.iter().map(|logit| (logit - top).exp()).collect();
        let sum: f64 = shares.iter().sum();
        shares.iter().map(|share| share / sum).collect()
    }

    /// Probabilities of the levels for one row of features.
    pub fn probabilities(&self, row: &[f32]) -> Vec<f32> {
        let probabilities = self.probabilities_of(&self.standardised(row));
        probabilities.into_iter().map(|p| p as f32).collect()
    }

    /// Mean cross-entropy plus the ridge.
    fn loss_on(&self, rows: &[Vec<f64>], level_of: &[usize]) -> f64 {
        let losses = rows
            .iter()
            .zip(level_of)
            .map(|(row, &level)| -self.probabilities_of(row)[level].ln());
        let squares: f64 = self.coefficients.iter().flatten().map(|c| c * c).sum();
        losses.sum::<f64>() / rows.len() as f64 + 0.5 * RIDGE * squares
    }

    /// Gradient and Hessian of the loss, solved for the step downhill.
    fn newton_step(&self, rows: &[Vec<f64>], level_of: &[usize]) -> Vec<f64> {
        let (levels, width) = (self.coefficients.len(), self.moments.mean.len() + 1);
        let size = levels * width;
        let flat: Vec<f64> = self.coefficients.concat();
        let mut gradient: Vec<f64> = flat.iter().map(|c| RIDGE * c).collect();
        let mut hessian = vec![vec![0.0; size]; size];
        for (index, row) in hessian.iter_mut().enumerate() {
            row[index] = RIDGE;
        }
        let n = rows.len() as f64;
        for (row, &level) in rows.iter().zip(level_of) {
            let p = self.probabilities_of(row);
            for a in 0..levels {
                let residual = (p[a] - f64::from(u8::from(a == level))) / n;
                for i in 0..width {
                    gradient[a * width + i] += residual * row[i];
                }
                for b in 0..=a {
                    let curvature = p[a] * (f64::from(u8::from(a == b)) - p[b]) / n;
                    for i in 0..width {
                        let scaled = curvature * row[i];
                        let target = &mut hessian[a * width + i][b * width..][..width];
                        target
                            .iter_mut()
                            .zip(row)
                            .for_each(|(h, x)| *h += scaled * x);
                    }
                }
            }
        }
        solve(hessian, gradient)
    }

    fn moved(&self, step: &[f64], share: f64) -> Self {
        let mut moved = self.clone();
        let coefficients = moved.coefficients.iter_mut().flatten();
        coefficients.zip(step).for_each(|(c, s)| *c -= share * s);
        moved
    }

    /// The graph from newtons to logits, and the logits' name, for a baseline fitted to features of
    /// frames. The graph includes the standardisation.
    pub fn graph(&self) -> (Graph, String) {
        let (mut graph, features) = feature_graph();
        let levels = self.coefficients.len();
        let narrow = |values: &[f64]| values.iter().map(|&v| v as f32).collect::<Vec<f32>>();
        let Moments { mean, deviation } = &self.moments;
        let mean = graph.constant("mean of features", &[1, FEATURES], &narrow(mean));
        let deviation = graph.constant("deviation of features", &[1, FEATURES], &narrow(deviation));
        let centred = graph.node("Sub", &[&features, &mean], "centred", Vec::new());
        let standard = graph.node("Div", &[&centred, &deviation], "standardised", Vec::new());
        let matrix: Vec<f64> = (0..FEATURES)
            .flat_map(|feature| self.coefficients.iter().map(move |level| level[feature]))
            .collect();
        let bias: Vec<f64> = self
            .coefficients
            .iter()
            .map(|level| level[FEATURES])
            .collect();
        let matrix = graph.constant("matrix", &[FEATURES, levels], &narrow(&matrix));
        let bias = graph.constant("bias", &[levels], &narrow(&bias));
        let logits = graph.node(
            "Gemm",
            &[&standard, &matrix, &bias],
            "raw_logits",
            Vec::new(),
        );
        (graph, logits)
    }
}

/// Solves `matrix x = right` by Cholesky's decomposition. It reads only the lower triangle. The
/// matrix is positive definite because of the ridge.
fn solve(mut matrix: Vec<Vec<f64>>, mut right: Vec<f64>) -> Vec<f64> {
    let n = right.len();
    for i in 0..n {
        for j in 0..=i {
            let known: f64 = (0..j).map(|k| matrix[i][k] * matrix[j][k]).sum();
            let rest = matrix[i][j] - known;
            matrix[i][j] = if i == j {
                rest.sqrt()
            } else {
                rest / matrix[j][j]
            };
        }
    }
    for i in 0..n {
        let known: f64 = (0..i).map(|k| matrix[i][k] * right[k]).sum();
        right[i] = (right[i] - known) / matrix[i][i];
    }
    for i in (0..n).rev() {
        let known: f64 = (i + 1..n).map(|k| matrix[k][i] * right[k]).sum();
        right[i] = (right[i] - known) / matrix[i][i];
    }
    right
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_solver_solves() {
        let matrix = vec![vec![4.0, 0.0], vec![2.0, 3.0]];
        // [[4, 2], [2, 3]] x = [8, 7] has x = [1.25, 1.5].
        let x = solve(matrix, vec![8.0, 7.0]);
        assert!(
            (x[0] - 1.25).abs() < 1e-12 && (x[1] - 1.5).abs() < 1e-12,
            "{x:?}"
        );
    }

    #[test]
    fn the_fit_finds_the_optimum() {
        // Only feature 0 shows the level, and is wrong in one of four cases, so the best logit is
        // ln 3.
        let row = |x: f32| {
            let mut row = vec![0.0; FEATURES];
            row[0] = x;
            row
        };
        let rows: Vec<Vec<f32>> = (0..80)
            .map(|n| row(if n % 2 == 0 { 1.0 } else { -1.0 }))
            .collect();
        let level_of: Vec<usize> = (0..80).map(|n| (n % 2) ^ usize::from(n % 8 < 2)).collect();
        let baseline = Baseline::fit(&rows, &level_of, 2);
        let p = baseline.probabilities(&row(1.0))[0];
        assert!((p - 0.75).abs() < 2e-3, "{p}");
    }
}
