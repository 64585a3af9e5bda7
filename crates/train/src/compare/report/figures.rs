//! The report's figures.

use super::plot::{Axis, Chart};
use crate::judge::metrics::Bin;
use crate::run::history::History;

/// A figure of a stage: its name, its axis, the factor of its columns, and the columns with their
/// style classes.
type Picture = (
    &'static str,
    &'static str,
    f64,
    &'static [(&'static str, &'static str)],
);

/// The figures of each stage.
const PICTURES: [Picture; 5] = [
    (
        "losses",
        "loss, nats",
        1.0,
        &[
            ("loss", "train"),
            ("validation_loss", "valid"),
            ("generator_loss", "valid"),
        ],
    ),
    (
        "accuracy",
        "accuracy, %",
        100.0,
        &[("accuracy", "train"), ("validation_accuracy", "valid")],
    ),
    (
        "sigma",
        "least, mean, greatest",
        1.0,
        &[
            ("sigma_min", "train"),
            ("sigma_mean", "train"),
            ("sigma_max", "train"),
        ],
    ),
    (
        "taxels' deviation",
        "of images in [-1, 1]",
        1.0,
        &[
            ("pixel_std", "train"),
            ("pixel_std_component", "valid"),
            ("pixel_std_real", "diagonal"),
        ],
    ),
    (
        "distance of features",
        "share of the largest",
        1.0,
        &[("feature_distance", "train")],
    ),
];

/// Figures of the metrics of runs of one method, against the steps of each stage: a line for each run.
pub(super) fn stages(runs: &[&History]) -> Vec<String> {
    let mut pictures = Vec::new();
    for stage in runs.first().into_iter().flat_map(|run| &run.stages) {
        let of_runs = runs.iter().flat_map(|run| &run.stages);
        let all: Vec<_> = of_runs.filter(|other| other.name == stage.name).collect();
        let most = all.iter().map(|stage| stage.steps()).max().unwrap_or(1);
        for (name, axis, factor, columns) in PICTURES {
            let mut curves = Vec::new();
            for stage in &all {
                for (column, class) in columns {
                    let curve = stage.curve(column).into_iter();
                    let scaled = curve.map(|(step, value)| (step, factor * value));
                    curves.push((*class, scaled.collect::<Vec<_>>()));
                }
            }
            let values = curves.iter().flat_map(|(_, curve)| curve);
            let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
                (low.min(v.1), high.max(v.1))
            });
            // One point is no curve.
            if curves.iter().all(|(_, curve)| curve.len() < 2) {
                continue;
            }
            let room = (0.05 * (high - low)).max(0.02 * high.abs()).max(1e-3);
            let title = format!("{}: {name}", stage.name);
            let x = Axis::linear("steps", 0.0, most.max(1) as f64);
            let y = Axis::linear(axis, low - room, high + room);
            let chart = curves
                .iter()
                .fold(Chart::new(&title, x, y), |chart, (class, curve)| {
                    chart.line(class, curve)
                });
            pictures.push(chart.svg());
        }
    }
    pictures
}

/// Accuracy against confidence, bin by bin. On the diagonal, confidence equals accuracy. Larger
/// dots hold more samples.
pub(super) fn reliability(bins: &[Bin], title: &str) -> String {
    let title = format!("calibration of {title}");
    let x = Axis::linear("confidence, %", 0.0, 100.0);
    let y = Axis::linear("right, %", 0.0, 100.0);
    let mut chart = Chart::new(&title, x, y).line("diagonal", &[(0.0, 0.0), (100.0, 100.0)]);
    let total: u64 = bins.iter().map(|bin| bin.samples).sum();
    for bin in bins.iter().filter(|bin| bin.samples > 0) {
        let samples = bin.samples as f64;
        let confidence = 100.0 * bin.confidence / samples;
        let right = 100.0 * bin.right as f64 / samples;
        let radius = 2.0 + 6.0 * (samples / total as f64).sqrt();
        let tip = format!("{samples} samples: confidence {confidence:.0} %, right {right:.0} %");
        chart = chart.dot((confidence, right), radius, &tip);
    }
    chart.svg()
}

/// The sums of the bins of several runs.
pub(super) fn added(runs: &[&[Bin]]) -> Vec<Bin> {
    let mut sum = vec![Bin::default(); runs.iter().map(|bins| bins.len()).max().unwrap_or(0)];
    for bins in runs {
        for (total, bin) in sum.iter_mut().zip(*bins) {
            total.samples += bin.samples;
            total.right += bin.right;
            total.confidence += bin.confidence;
        }
    }
    sum
}
