//! The report's figures, each from the rows of a comparison or the files of one run.

use super::plot::{Anchor, Scale, Svg, axes};
use crate::compare::digits;
use crate::compare::results::{Row, SwapEntry};
use crate::compare::sets::PAPER_SPLIT;
use crate::compare::tables::{self, mean};
use crate::judge::metrics::Bin;
use crate::run::history::History;

/// Accuracy of every row on a set: the interval, the mean, a tick per seed, and a ring for the
/// paper's figure.
pub(super) fn accuracies(rows: &[Row], set: &str, title: &str) -> String {
    let shown: Vec<(&Row, Vec<f64>)> = rows
        .iter()
        .map(|row| {
            let accuracies = tables::evaluations(row, set);
            (row, accuracies.iter().map(|e| 100.0 * e.accuracy).collect())
        })
        .filter(|(_, accuracies): &(_, Vec<f64>)| !accuracies.is_empty())
        .collect();
    let paper_of = |row: &Row| {
        let paper = tables::paper_row(row).filter(|_| set == PAPER_SPLIT);
        paper.map(|paper| paper.accuracy_percent)
    };
    let interval_of = |row: &Row| {
        let interval = tables::accuracy(row, set)?.interval?;
        Some(interval.map(|end| 100.0 * end))
    };
    let least = shown
        .iter()
        .flat_map(|(row, accuracies)| {
            let low = interval_of(row).map(|[low, _]| low);
            accuracies.iter().copied().chain(low).chain(paper_of(row))
        })
        .fold(100.0, f64::min);
    let (left, top, line) = (240.0, 24.0, 22.0);
    let bottom = top + line * shown.len() as f64 + 6.0;
    let x = Scale::linear(((least / 5.0).floor() * 5.0 - 2.0, 101.0), (left, 700.0));
    let y = Scale::linear((0.0, 1.0), (bottom, top));
    let mut svg = Svg::new(720.0, bottom + 34.0).of_class("rows");
    axes(&mut svg, (&x, "accuracy, %"), (&y, ""), (8, 0));
    for (number, (row, accuracies)) in shown.iter().enumerate() {
        let at = top + line * (number as f64 + 0.5);
        svg.text("label", (left - 8.0, at + 4.0), Anchor::End, &row.title);
        if let Some([low, high]) = interval_of(row) {
            svg.line("whisker", (x.at(low), at), (x.at(high), at));
        }
        for accuracy in accuracies {
            let seed = x.at(*accuracy);
            svg.line("seed", (seed, at - 5.0), (seed, at + 5.0));
        }
        let tip = format!("{}: {:.1} %", row.title, mean(accuracies));
        svg.dot("mark", (x.at(mean(accuracies)), at), 4.5, &tip);
        if let Some(paper) = paper_of(row) {
            let tip = format!("{} in the paper: {paper:.1} %", row.title);
            svg.dot("ring", (x.at(paper), at), 5.5, &tip);
        }
    }
    svg.finish(title)
}

/// Accuracy against training steps, a dot per row.
pub(super) fn price(rows: &[Row], set: &str) -> String {
    let mut points: Vec<(String, f64, f64)> = Vec::new();
    for row in rows {
        let accuracies = tables::evaluations(row, set);
        let percents: Vec<f64> = accuracies.iter().map(|e| 100.0 * e.accuracy).collect();
        let steps: Vec<f64> = row.runs.iter().map(|run| run.0.steps as f64).collect();
        points.push((row.title.clone(), mean(&steps).max(1.0), mean(&percents)));
    }
    let range = |values: &mut dyn Iterator<Item = f64>| {
        values.fold((f64::INFINITY, 0.0_f64), |(low, high), v| {
            (low.min(v), high.max(v))
        })
    };
    let (fewest, most) = range(&mut points.iter().map(|point| point.1));
    let (least, best) = range(&mut points.iter().map(|point| point.2));
    let (right, bottom) = (520.0, 290.0);
    let x = Scale::logarithmic((0.7 * fewest, 1.4 * most), (50.0, right));
    let y = Scale::linear((least - 3.0, best + 3.0), (bottom, 24.0));
    let mut svg = Svg::new(720.0, 330.0).of_class("points");
    axes(
        &mut svg,
        (&x, "steps, all stages"),
        (&y, "accuracy, %"),
        (4, 6),
    );
    points.sort_by(|a, b| b.2.total_cmp(&a.2));
    let dots: Vec<(f64, f64)> = points.iter().map(|p| (x.at(p.1), y.at(p.2))).collect();
    let mut placed: Vec<Label> = Vec::new();
    for ((name, steps, percent), &dot) in points.iter().zip(&dots) {
        let label = Label::beside(dot, name, &dots, &placed);
        svg.text(
            "label",
            (label.left, label.middle + 4.0),
            Anchor::Start,
            name,
        );
        placed.push(label);
        let tip = format!("{name}: {percent:.1} % after {steps:.0} steps");
        svg.dot("mark", dot, 4.5, &tip);
    }
    svg.finish("accuracy against steps")
}

/// The place of a name, in pixels.
struct Label {
    left: f64,
    width: f64,
    middle: f64,
}

impl Label {
    const HEIGHT: f64 = 13.0;

    /// The place nearest to `dot` that covers no dot and no name placed before.
    fn beside(dot: (f64, f64), name: &str, dots: &[(f64, f64)], placed: &[Self]) -> Self {
        // Letters of the page's 12 px font are 6.5 px wide on average.
        let width = 6.5 * name.chars().count() as f64;
        let places = [0.0, 0.5, -0.5, 1.0, -1.0, 1.5, -1.5, 2.0, -2.0, 3.0, -3.0];
        let places = places.iter().flat_map(|lines| {
            [8.0, -8.0 - width].map(|aside| Self {
                left: dot.0 + aside,
                width,
                middle: dot.1 + lines * Self::HEIGHT,
            })
        });
        let is_free = |label: &Self| {
            let covers = |other: &(f64, f64)| {
                (label.left - 5.0..label.left + width + 5.0).contains(&other.0)
                    && (other.1 - label.middle).abs() < 0.5 * Self::HEIGHT + 4.0
            };
            let overlaps = |other: &Self| {
                label.left < other.left + other.width
                    && other.left < label.left + width
                    && (label.middle - other.middle).abs() < Self::HEIGHT
            };
            label.left > 0.0 && !dots.iter().any(covers) && !placed.iter().any(overlaps)
        };
        let mut places = places.collect::<Vec<_>>();
        let free = places.iter().position(is_free).unwrap_or_default();
        places.swap_remove(free)
    }
}

/// Accuracy in training against the steps of all stages, a line per run. A dot at the end shows the
/// row's mean accuracy on `set`. `None` for a method that records no such accuracy.
pub(super) fn curve(row: &Row, set: &str) -> Option<String> {
    let stages = row
        .runs
        .iter()
        .flat_map(|(_, details)| &details.history.stages);
    if stages
        .into_iter()
        .all(|stage| stage.curve("accuracy").is_empty())
    {
        return None;
    }
    let longest = row
        .runs
        .iter()
        .map(|run| run.0.steps)
        .max()
        .unwrap_or(1)
        .max(1);
    let x = Scale::linear((0.0, longest as f64), (38.0, 244.0));
    let y = Scale::linear((20.0, 100.0), (146.0, 40.0));
    let mut svg = Svg::new(260.0, 181.0);
    svg.text("name", (0.0, 12.0), Anchor::Start, &row.title);
    axes(&mut svg, (&x, "steps"), (&y, "accuracy, %"), (3, 4));
    for (number, (_, details)) in row.runs.iter().enumerate() {
        let mut before = 0.0;
        for stage in &details.history.stages {
            let point = |(step, share): (f64, f64)| (x.at(before + step), y.at(100.0 * share));
            for (class, column) in [("train", "accuracy"), ("valid", "validation_accuracy")] {
                let points: Vec<_> = stage.curve(column).into_iter().map(point).collect();
                svg.path(class, &thinned(&points));
            }
            let end = before + stage.steps() as f64;
            // Draw the end of a stage once per panel.
            if number == 0 && end < longest as f64 {
                svg.line("stage", (x.at(end), 146.0), (x.at(end), 40.0));
            }
            before = end;
        }
    }
    let percents: Vec<f64> = tables::evaluations(row, set)
        .iter()
        .map(|e| 100.0 * e.accuracy)
        .collect();
    if !percents.is_empty() {
        let reached = mean(&percents);
        let tip = format!("{}: {reached:.1} % on fresh objects", row.title);
        svg.dot(
            "mark",
            (x.at(longest as f64), y.at(reached.max(20.0))),
            4.5,
            &tip,
        );
    }
    Some(svg.finish(&format!("accuracy of {} in training", row.title)))
}

/// Thins points to a few hundred, because no more can be distinguished.
fn thinned(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let every = points.len().div_ceil(300).max(1);
    let last = points.last().filter(|_| points.len() % every != 1);
    points.iter().step_by(every).chain(last).copied().collect()
}

/// A figure of a stage: its name, its axis, the factor of its columns, and the columns with their
/// style classes.
type Picture = (
    &'static str,
    &'static str,
    f64,
    &'static [(&'static str, &'static str)],
);

/// The figures of each stage on a run's page.
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

/// Figures of the metrics of one run's stages, against the steps of each stage.
pub(super) fn stages(history: &History) -> Vec<String> {
    let mut pictures = Vec::new();
    for stage in &history.stages {
        for (name, axis, factor, columns) in PICTURES {
            let scaled = |(step, value): (f64, f64)| (step, factor * value);
            let curves: Vec<(&str, Vec<(f64, f64)>)> = columns
                .iter()
                .map(|(column, class)| {
                    let curve = stage.curve(column).into_iter().map(scaled).collect();
                    (*class, curve)
                })
                .collect();
            let values = curves
                .iter()
                .flat_map(|(_, curve)| curve)
                .map(|point| point.1);
            let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
                (low.min(v), high.max(v))
            });
            if low > high {
                continue;
            }
            let room = (0.05 * (high - low)).max(0.02 * high.abs()).max(1e-3);
            let x = Scale::linear((0.0, (stage.steps() as f64).max(1.0)), (48.0, 244.0));
            let y = Scale::linear((low - room, high + room), (146.0, 40.0));
            let mut svg = Svg::new(260.0, 181.0);
            let title = format!("{}: {name}", stage.name);
            svg.text("name", (0.0, 12.0), Anchor::Start, &title);
            axes(&mut svg, (&x, "steps"), (&y, axis), (3, 4));
            for (class, curve) in curves {
                let points: Vec<_> = curve.iter().map(|v| (x.at(v.0), y.at(v.1))).collect();
                svg.path(class, &thinned(&points));
            }
            pictures.push(svg.finish(&title));
        }
    }
    pictures
}

/// A confusion matrix. A darker cell holds a larger share of its row's samples.
pub(super) fn confusion(counts: &[Vec<f64>], title: &str) -> String {
    let (left, top, cell) = (40.0, 48.0, 40.0);
    let levels = counts.len();
    let size = cell * levels as f64;
    let mut svg = Svg::new(left + size + 4.0, top + size + 4.0);
    svg.text("name", (left, 14.0), Anchor::Start, title);
    svg.text("tick", (left - 6.0, top - 6.0), Anchor::End, "truth");
    let middle = left + 0.5 * size;
    svg.text("tick", (middle, top - 20.0), Anchor::Middle, "verdict");
    for (truth, row) in counts.iter().enumerate() {
        let samples: f64 = row.iter().sum();
        let y = top + cell * truth as f64;
        let middle = y + 0.5 * cell + 4.0;
        svg.text(
            "tick",
            (left - 6.0, middle),
            Anchor::End,
            &(truth + 1).to_string(),
        );
        for (said, &count) in row.iter().enumerate() {
            let share = count / samples.max(1.0);
            let x = left + cell * said as f64;
            if truth == 0 {
                let name = (said + 1).to_string();
                svg.text("tick", (x + 0.5 * cell, top - 6.0), Anchor::Middle, &name);
            }
            svg.rectangle("cell", (x, y), (cell - 1.0, cell - 1.0), 0.06 + 0.6 * share);
            let text = format!("{count:.0}");
            svg.text("count", (x + 0.5 * cell, middle), Anchor::Middle, &text);
        }
    }
    svg.finish(&format!("confusion matrix, {title}"))
}

/// Accuracy against confidence, bin by bin. On the diagonal, confidence equals accuracy. Larger
/// dots hold more samples.
pub(super) fn reliability(bins: &[Bin], title: &str) -> String {
    let x = Scale::linear((0.0, 100.0), (38.0, 190.0));
    let y = Scale::linear((0.0, 100.0), (192.0, 40.0));
    let mut svg = Svg::new(206.0, 226.0);
    svg.text("name", (0.0, 12.0), Anchor::Start, title);
    axes(&mut svg, (&x, "confidence, %"), (&y, "right, %"), (4, 4));
    svg.line(
        "diagonal",
        (x.at(0.0), y.at(0.0)),
        (x.at(100.0), y.at(100.0)),
    );
    let total: u64 = bins.iter().map(|bin| bin.samples).sum();
    let full: Vec<&Bin> = bins.iter().filter(|bin| bin.samples > 0).collect();
    let at = |bin: &Bin| {
        let samples = bin.samples as f64;
        (
            100.0 * bin.confidence / samples,
            100.0 * bin.right as f64 / samples,
        )
    };
    let points: Vec<(f64, f64)> = full
        .iter()
        .map(|bin| (x.at(at(bin).0), y.at(at(bin).1)))
        .collect();
    for (bin, point) in full.iter().zip(points) {
        let share = bin.samples as f64 / total as f64;
        let (confidence, right) = at(bin);
        let tip = format!(
            "{} samples: confidence {confidence:.0} %, right {right:.0} %",
            bin.samples
        );
        svg.dot("mark", point, 2.0 + 6.0 * share.sqrt(), &tip);
    }
    svg.finish(&format!("calibration of {title}"))
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

/// Accuracy under every assignment of roles, a dot each. The ring marks the paper's assignment.
pub(super) fn swaps(groups: &[Vec<&SwapEntry>]) -> String {
    let percent = |swap: &SwapEntry| 100.0 * swap.test.accuracy;
    let least = groups
        .iter()
        .flatten()
        .map(|swap| percent(swap))
        .fold(100.0, f64::min);
    let (left, top, line) = (240.0, 24.0, 30.0);
    let bottom = top + line * groups.len() as f64;
    let x = Scale::linear(((least / 5.0).floor() * 5.0 - 2.0, 101.0), (left, 700.0));
    let y = Scale::linear((0.0, 1.0), (bottom, top));
    let mut svg = Svg::new(720.0, bottom + 34.0).of_class("rows");
    axes(&mut svg, (&x, "accuracy, %"), (&y, ""), (8, 0));
    for (number, group) in groups.iter().enumerate() {
        let at = top + line * (number as f64 + 0.5);
        let name = format!(
            "{}, {} labels",
            group[0].method,
            digits::thousands(group[0].labels as u64)
        );
        svg.text("label", (left - 8.0, at + 4.0), Anchor::End, &name);
        for swap in group {
            let levels = (1..)
                .zip(swap.swapped_levels)
                .filter(|(_, swapped)| *swapped);
            let levels: Vec<String> = levels
                .map(|(level, _): (u8, _)| level.to_string())
                .collect();
            let tip = match levels.as_slice() {
                [] => format!(
                    "as in the paper, seed {}: {:.1} %",
                    swap.seed,
                    percent(swap)
                ),
                levels => format!(
                    "levels {} swapped, seed {}: {:.1} %",
                    levels.join(", "),
                    swap.seed,
                    percent(swap)
                ),
            };
            svg.dot("mark faint", (x.at(percent(swap)), at), 4.5, &tip);
            if swap.swapped_levels == [false; 4] {
                svg.dot("ring", (x.at(percent(swap)), at), 7.0, &tip);
            }
        }
    }
    svg.finish("accuracy under swapped materials")
}
