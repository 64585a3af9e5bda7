//! Columns of numbers brought to one scale before a network sees them.

use crate::train::net::builder::Builder;

/// Columns are clipped at so many standard deviations from their mean: beyond what was trained on,
/// a network extrapolates.
const CLIP: f32 = 4.0;

/// Mean and standard deviation of each column over what was learnt from.
#[derive(Debug, Clone, PartialEq)]
pub struct Standard {
    /// A number a column.
    pub mean: Vec<f32>,
    /// Standard deviation of each column.
    pub deviation: Vec<f32>,
}

impl Standard {
    /// Of rows of `columns` numbers.
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
            // A column that never varies is no divisor.
            deviation: variance.iter().map(|v| v.sqrt().max(1e-3) as f32).collect(),
        }
    }

    /// A column's number as the network takes it.
    pub fn apply(&self, column: usize, x: f32) -> f32 {
        ((x - self.mean[column]) / self.deviation[column]).clamp(-CLIP, CLIP)
    }

    /// Adds the nodes that bring `x` `[rows, columns]` to the scale, and gives their output's name.
    pub(super) fn nodes(&self, b: &mut Builder, x: &str) -> String {
        let dims = [self.mean.len()];
        let mean = b.0.constant("column means", &dims, &self.mean);
        let deviation = b.0.constant("column deviations", &dims, &self.deviation);
        let centred = b.node("Sub", &[x, &mean], "centred");
        let scaled = b.node("Div", &[&centred, &deviation], "standardised");
        b.clipped(&scaled, -CLIP, CLIP)
    }
}
