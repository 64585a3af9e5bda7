//! Columns of numbers brought to one scale before a network sees them.

use crate::net::graph::Graph;

/// The number of standard deviations from the mean at which a column is clipped, because a network
/// extrapolates beyond its training data.
const CLIP: f32 = 4.0;
/// The least standard deviation of a column.
const LEAST: f64 = 1e-3;
/// The names of mean and standard deviation in an exported file.
pub(super) const MEANS: &str = "column means";
pub(super) const DEVIATIONS: &str = "column deviations";

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
            let sums = mean.iter_mut().zip(row);
            sums.for_each(|(sum, &x)| *sum += f64::from(x) / count);
        }
        let mut variance = vec![0.0; columns];
        for row in rows {
            for ((sum, &x), mean) in variance.iter_mut().zip(row).zip(&mean) {
                *sum += (f64::from(x) - mean).powi(2) / count;
            }
        }
        // The lower limit avoids a division by 0 for a column that never varies.
        let deviation = variance.iter().map(|v| v.sqrt().max(LEAST) as f32);
        Self {
            mean: mean.iter().map(|&mean| mean as f32).collect(),
            deviation: deviation.collect(),
        }
    }

    /// Whether a column varies over the training data.
    pub fn varies(&self, column: usize) -> bool {
        self.deviation[column] > LEAST as f32
    }

    /// A row on the scale that the network takes.
    pub fn row(&self, row: &[f32]) -> Vec<f32> {
        let columns = row.iter().zip(&self.mean).zip(&self.deviation);
        let standardised = columns.map(|((x, mean), deviation)| (x - mean) / deviation);
        standardised.map(|x| x.clamp(-CLIP, CLIP)).collect()
    }

    /// Adds the nodes that bring `columns` to the scale, as `standardised`.
    pub fn add_to(&self, graph: &mut Graph, columns: &str) {
        let dims = [1, self.mean.len()];
        graph.constant(MEANS, &dims, &self.mean);
        graph.constant(DEVIATIONS, &dims, &self.deviation);
        let unit = format!("Div(Sub({columns}, {MEANS}), {DEVIATIONS})");
        let formula = format!("standardised = Clip({unit}, -{CLIP}, {CLIP})");
        graph.add(&formula);
    }
}
