//! Columns of numbers brought to one scale before a network sees them.

use crate::net::builder::Builder;

/// The number of standard deviations from the mean at which a column is clipped, because a network
/// extrapolates beyond its training data.
const CLIP: f32 = 4.0;

/// Mean and standard deviation of each column over the training data.
#[derive(Debug, Clone, PartialEq)]
pub struct Standard {
    /// Mean of each column.
    pub mean: Vec<f32>,
    /// Standard deviation of each column.
    pub deviation: Vec<f32>,
}

impl Standard {
    /// Computes mean and deviation over rows of `columns` numbers.
    pub fn of<'a>(columns: usize, rows: impl Iterator<Item = &'a [f32]> + Clone) -> Self {
        let count = rows.clone().count().max(1) as f64;
        let mut mean = vec![0.0; columns];
        for row in rows.clone() {
            mean.iter_mut()
                .zip(row)
                .for_each(|(sum, &x)| *sum += f64::from(x) / count);
        }
        let mut variance = vec![0.0; columns];
        for row in rows {
            for ((sum, &x), mean) in variance.iter_mut().zip(row).zip(&mean) {
                *sum += (f64::from(x) - mean).powi(2) / count;
            }
        }
        Self {
            mean: mean.iter().map(|&mean| mean as f32).collect(),
            // The lower limit avoids a division by 0 for a column that never varies.
            deviation: variance.iter().map(|v| v.sqrt().max(1e-3) as f32).collect(),
        }
    }

    /// All numbers that an interrupted training must find unchanged.
    pub fn numbers(&self) -> impl Iterator<Item = f32> {
        self.mean.iter().chain(&self.deviation).copied()
    }

    /// A column's number on the scale that the network takes.
    pub fn apply(&self, column: usize, x: f32) -> f32 {
        ((x - self.mean[column]) / self.deviation[column]).clamp(-CLIP, CLIP)
    }

    /// Adds the nodes that bring `x` to the scale, and returns their output's name. Each column is
    /// a row of `x` `[columns, n]`.
    pub(super) fn nodes(&self, b: &mut Builder, x: &str) -> String {
        let dims = [self.mean.len(), 1];
        let mean = b.0.constant("column means", &dims, &self.mean);
        let deviation = b.0.constant("column deviations", &dims, &self.deviation);
        let centred = b.node("Sub", &[x, &mean], "centred");
        let scaled = b.node("Div", &[&centred, &deviation], "standardised");
        b.clipped(&scaled, -CLIP, CLIP)
    }
}
