//! The paper's Tables 2 and 3 beside our results, and tables of further results.
//!
//! In: a comparison's results. Out: tables as rows of text, which `tables.md` and the report both
//! show.

mod cells;

use std::collections::BTreeSet;
use std::fmt::Write as _;

use super::digits::{number, thousands};
use super::table::Table;
use crate::compare::results::{Comparison, Row, SwapEntry, Worth};
use crate::compare::sets::{FRESH, MATCHED, PAPER_SPLIT, SHIFTS, WORLDS, clusters};
use crate::judge::metrics::{self, Evaluation};
use crate::run::history::{History, Stage};
use cells::{
    before_temperature, beside, by_assignment, deviation, evaluations, interval, least, mean,
    mean_confusion, mean_over_seeds, minus_features, minus_reference, most, of_entries, paper_row,
    percent_of, swap_groups, with_spread,
};

pub use cells::{difference_text, interval_text, reference};

/// The content of `tables.md`.
pub fn markdown(comparison: &Comparison) -> String {
    let mut text = format!("# Comparison\n\n{}\n", provenance(comparison));
    for table in all(comparison) {
        let _ = write!(text, "\n{}", table.section());
    }
    text
}

/// The origin of the figures, as lines of text.
pub fn provenance(comparison: &Comparison) -> String {
    let mut lines = Vec::new();
    if let (Some(entry), Some(details)) = (comparison.entries.first(), comparison.details.first()) {
        let seeds = comparison.entries.iter().map(|entry| entry.seed).max();
        let mut made_by = format!(
            "Made by hrn-train compare --profile {} --seeds {}",
            format!("{:?}", entry.profile).to_lowercase(),
            seeds.unwrap_or_default(),
        );
        let mut revisions: Vec<&str> = Vec::new();
        // The results can exist without their runs, which then add no revision.
        let all = comparison.details.iter();
        for revision in all.flat_map(|details| details.revisions.lines()) {
            if !revisions.contains(&revision) {
                revisions.push(revision);
                made_by += &format!(", {revision}");
            }
        }
        lines.push(made_by + ".");
        for source in details.description.iter().flat_map(|run| &run.data) {
            let seed = source
                .seed
                .map_or(String::new(), |seed| format!(" (seed {seed})"));
            lines.push(format!(
                "Learnt from {}{seed}, sha256 {}.",
                source.name, source.sha256
            ));
        }
    }
    lines.push(
        "Simulated data, unless you gave your own. Intervals are 95 %. Where all materials are pressed \
         alike (matched, wide, broad), they are by a bootstrap over the geometries, elsewhere over the \
         objects within each level. With several seeds, the variance over seeds is added, and the \
         interval is Student's. The interval of one seed does not cover how much another seed, or \
         another rounding, changes. ± is the standard deviation over seeds."
            .to_owned(),
    );
    lines.join("\n")
}

/// Every table, in the order to read them.
pub(super) fn all(comparison: &Comparison) -> Vec<Table> {
    let rows = comparison.rows();
    let mut tables = vec![headline(&rows), table_2(&rows)];
    tables.extend(fresh(&rows));
    tables.extend([table_3(&rows), confusions(&rows)]);
    tables.extend([
        calibration(&rows),
        shifts(&rows),
        worlds(&rows),
        price(&rows),
    ]);
    if !comparison.swaps.is_empty() {
        tables.push(swaps(&comparison.swaps));
    }
    tables
}

/// The summary table.
pub fn headline(rows: &[Row]) -> Table {
    let note = "20 fresh objects of each test material, shapes alike for all materials, so that \
                the shape does not show the hardness. \"Minus ours\": difference of accuracies on the \
                same frames under the same seeds. The last columns of accuracies are of other shapes \
                (wide) and random materials (broad). Seconds are those of one thread; stages \
                that a method shares with another are counted for both.";
    let accuracy = |row: &Row, set: &str| with_spread(row, set, |e| Some(100.0 * e.accuracy), 1);
    let mut head = vec![
        "method".to_owned(),
        "labels".to_owned(),
        "accuracy, %".to_owned(),
        "95 %".to_owned(),
        "minus ours, points".to_owned(),
    ];
    head.extend(WORLDS.map(|(set, _)| format!("{}, %", set.replace('_', " "))));
    head.extend(["kappa, quadratic", "steps", "seconds"].map(str::to_owned));
    let mut table = Table {
        head,
        ..Table::new("Summary", note, &[])
    };
    for row in rows {
        let mut cells = vec![
            row.title.clone(),
            thousands(row.runs[0].0.labels as u64),
            accuracy(row, MATCHED),
            interval(row, MATCHED),
            minus_reference(row, rows, MATCHED),
        ];
        cells.extend(WORLDS.map(|(set, _)| accuracy(row, set)));
        cells.extend([
            with_spread(row, MATCHED, |e| e.kappa_quadratic, 3),
            thousands(mean(&of_entries(row, |entry| entry.steps as f64)).round() as u64),
            thousands(mean(&of_entries(row, |entry| entry.seconds)).round() as u64),
        ]);
        table.rows.push(cells);
    }
    table
}

/// The columns of a method in tables of accuracies.
const ACCURACIES: [&str; 7] = [
    "level 1",
    "level 2",
    "level 3",
    "level 4",
    "overall",
    "95 %",
    "minus ours, points",
];

/// Table 2, with the paper's figures in brackets.
fn table_2(rows: &[Row]) -> Table {
    let note = "Category accuracies and overall accuracy in per cent on the data set's own test \
                split, of the paper's size; in brackets the paper's.";
    let head = [&["method", "labels"], &ACCURACIES[..]].concat();
    let mut table = Table::new("Table 2: accuracy", note, &head);
    for row in rows {
        let paper = paper_row(row);
        let mut cells = vec![row.title.clone(), thousands(row.runs[0].0.labels as u64)];
        for level in 0..4 {
            let here = mean_over_seeds(row, PAPER_SPLIT, |e| percent_of(e, level), 1);
            let there = paper.map(|paper| paper.category_accuracy_percent[level]);
            cells.push(beside(here, there, 1));
        }
        let here = with_spread(row, PAPER_SPLIT, |e| Some(100.0 * e.accuracy), 1);
        cells.push(beside(here, paper.map(|paper| paper.accuracy_percent), 1));
        cells.push(interval(row, PAPER_SPLIT));
        cells.push(minus_reference(row, rows, PAPER_SPLIT));
        table.rows.push(cells);
    }
    table
}

/// Accuracies on the fresh objects of `paper` and of `matched` shapes.
fn fresh(rows: &[Row]) -> [Table; 2] {
    [
        (FRESH, "Fresh objects, shapes as the paper's pictures"),
        (MATCHED, "Fresh objects, the same shapes for all materials"),
    ]
    .map(|(set, title)| accuracies(rows, set, title))
}

fn accuracies(rows: &[Row], set: &str, title: &str) -> Table {
    let note = "Accuracy in per cent on 20 objects of each test material.";
    let head = [&["method"], &ACCURACIES[..]].concat();
    let mut table = Table::new(title, note, &head);
    for row in rows {
        let mut cells = vec![row.title.clone()];
        cells.extend((0..4).map(|level| mean_over_seeds(row, set, |e| percent_of(e, level), 1)));
        cells.push(with_spread(row, set, |e| Some(100.0 * e.accuracy), 1));
        cells.push(interval(row, set));
        cells.push(minus_reference(row, rows, set));
        table.rows.push(cells);
    }
    table
}

/// Table 3's kappas, with the paper's in brackets.
fn table_3(rows: &[Row]) -> Table {
    let note = "Cohen's kappa on the counts, and the same with quadratic weights, because levels \
                are ordinal; in brackets what the paper's counts give.";
    let head = [
        "method",
        "test split: kappa",
        "quadratic",
        "fresh, paper's shapes: kappa",
        "quadratic",
        "fresh, matched shapes: kappa",
        "quadratic",
    ];
    let mut table = Table::new("Table 3: kappa", note, &head);
    for row in rows {
        let paper = paper_row(row);
        let quadratic = paper.and_then(|paper| metrics::kappa_quadratic(&paper.counts()));
        let mut cells = vec![row.title.clone()];
        for set in [PAPER_SPLIT, FRESH, MATCHED] {
            let known = set == PAPER_SPLIT;
            let there = |value: Option<f64>| value.filter(|_| known);
            let kappa = with_spread(row, set, |e| e.kappa, 4);
            cells.push(beside(kappa, there(paper.map(|paper| paper.kappa)), 4));
            let kappa = with_spread(row, set, |e| e.kappa_quadratic, 4);
            cells.push(beside(kappa, there(quadratic), 4));
        }
        table.rows.push(cells);
    }
    table
}

/// Table 3's confusion matrices as counts, with the paper's to the right.
fn confusions(rows: &[Row]) -> Table {
    let note = "Samples of the test split, mean over seeds; the paper's are of 250 a level. Rows \
                are the truth, columns are the verdicts.";
    let head = [
        "method", "truth", "1", "2", "3", "4", "paper: 1", "2", "3", "4",
    ];
    let mut table = Table::new("Table 3: confusion", note, &head);
    for row in rows {
        let counts = mean_confusion(&evaluations(row, PAPER_SPLIT));
        for (truth, counts) in counts.iter().enumerate() {
            let title = if truth == 0 {
                row.title.clone()
            } else {
                String::new()
            };
            let mut cells = vec![title, format!("level {}", truth + 1)];
            cells.extend(counts.iter().map(|&count| number(count, 1)));
            let paper = paper_row(row).map(|paper| paper.confusion[truth]);
            cells.extend((0..4).map(|judged| match paper {
                Some(counts) => counts[judged].to_string(),
                None => "-".to_owned(),
            }));
            table.rows.push(cells);
        }
    }
    table
}

/// Calibration errors and likelihoods of the models' probabilities.
fn calibration(rows: &[Row]) -> Table {
    let note = "Expected calibration error (ECE) in per cent (15 bins of the largest probability) and mean \
                negative log-likelihood in nats, on materials that no model has seen. \"Raw\": before the \
                temperature that methods with held-out objects fit on them.";
    let head = [
        "method",
        "test split: ECE, %",
        "NLL",
        "fresh, paper's shapes: ECE, %",
        "raw, %",
        "NLL",
        "fresh, matched shapes: ECE, %",
        "raw, %",
        "NLL",
    ];
    let mut table = Table::new("Calibration", note, &head);
    for row in rows {
        let mut cells = vec![row.title.clone()];
        for set in [PAPER_SPLIT, FRESH, MATCHED] {
            cells.push(with_spread(row, set, |e| Some(100.0 * e.ece), 1));
            if set != PAPER_SPLIT {
                cells.push(before_temperature(row, set));
            }
            cells.push(with_spread(row, set, |e| Some(e.nll), 3));
        }
        table.rows.push(cells);
    }
    table
}

/// Results on the same objects under other sensors.
fn shifts(rows: &[Row]) -> Table {
    let note = format!(
        "The fresh objects of the paper's shapes, pressed again on other sensors: accuracy and expected \
         calibration error (ECE) in per cent. {}.",
        described(&SHIFTS)
    );
    elsewhere(
        rows,
        ("Another sensor", &note),
        (FRESH, "as before"),
        &SHIFTS,
    )
}

/// Results on objects of other shapes and materials.
fn worlds(rows: &[Row]) -> Table {
    let note = format!(
        "Fresh objects of other shapes and materials: accuracy and expected calibration error (ECE) \
         in per cent. One frame fixes only the ratio of radius and modulus, so varying shapes lower the accuracy \
         of every method. {}.",
        described(&WORLDS)
    );
    let title = "Other shapes and materials";
    elsewhere(rows, (title, &note), (MATCHED, "matched shapes"), &WORLDS)
}

/// The sets with their descriptions, in one line.
fn described(sets: &[(&str, &str)]) -> String {
    let one = |(name, what): &(&str, &str)| format!("{}: {what}", name.replace('_', " "));
    sets.iter().map(one).collect::<Vec<_>>().join("; ")
}

/// Accuracy and calibration on a base set and on other sets.
fn elsewhere(
    rows: &[Row],
    (title, note): (&str, &str),
    (base, called): (&str, &str),
    others: &[(&str, &str)],
) -> Table {
    let mut head = vec![
        "method".to_owned(),
        format!("{called}: accuracy, %"),
        "ECE, %".to_owned(),
    ];
    for (name, _) in others {
        head.extend([
            format!("{}: accuracy, %", name.replace('_', " ")),
            "ECE, %".to_owned(),
        ]);
    }
    let mut table = Table {
        head,
        ..Table::new(title, note, &[])
    };
    for row in rows {
        let mut cells = vec![row.title.clone()];
        for set in std::iter::once(base).chain(others.iter().map(|(name, _)| *name)) {
            cells.push(with_spread(row, set, |e| Some(100.0 * e.accuracy), 1));
            cells.push(with_spread(row, set, |e| Some(100.0 * e.ece), 1));
        }
        table.rows.push(cells);
    }
    table
}

/// Labels, steps and seconds of each method, stage by stage.
fn price(rows: &[Row]) -> Table {
    let note = "Mean over seeds. A step is a batch of 100 of either network; one of a GAN costs \
                about six of HRN in seconds.";
    let head = [
        "method",
        "labels",
        "steps",
        "seconds",
        "steps of each stage",
    ];
    let mut table = Table::new("Price", note, &head);
    for row in rows {
        let histories = row.runs.iter().map(|(_, details)| &details.history);
        let all: Vec<&Stage> = histories.flat_map(|history| &history.stages).collect();
        let mut names: Vec<&str> = Vec::new();
        for stage in &all {
            if !names.contains(&stage.name.as_str()) {
                names.push(&stage.name);
            }
        }
        let mean_of = |name: &str| {
            let own = all.iter().filter(|stage| stage.name == name);
            mean(&own.map(|stage| stage.steps() as f64).collect::<Vec<_>>())
        };
        let stages: Vec<String> = names
            .into_iter()
            .map(|name| format!("{name} {}", thousands(mean_of(name).round() as u64)))
            .collect();
        table.rows.push(vec![
            row.title.clone(),
            thousands(row.runs[0].0.labels as u64),
            thousands(mean(&of_entries(row, |entry| entry.steps as f64)).round() as u64),
            thousands(mean(&of_entries(row, |entry| entry.seconds)).round() as u64),
            stages.join(", "),
        ]);
    }
    table
}

/// The table of a run's stages.
pub fn stages(history: &History) -> Table {
    let mut table = Table::new("Stages", "", &["stage", "steps", "seconds"]);
    for stage in &history.stages {
        table.rows.push(vec![
            stage.name.clone(),
            thousands(stage.steps()),
            number(stage.seconds(), 1),
        ]);
    }
    table
}

/// The table of one evaluation.
pub fn evaluation(evaluation: &Evaluation) -> Table {
    let mut table = Table::new("Evaluation", "", &["", "", ""]);
    let interval = evaluation.accuracy_interval_by_object;
    let optional = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.4}"));
    let rows = [
        ("samples", thousands(evaluation.n as u64), String::new()),
        (
            "accuracy, %",
            format!("{:.1}", 100.0 * evaluation.accuracy),
            interval_text(interval),
        ),
        ("kappa", optional(evaluation.kappa), String::new()),
        (
            "kappa, quadratic",
            optional(evaluation.kappa_quadratic),
            String::new(),
        ),
        (
            "calibration error, %",
            format!("{:.1}", 100.0 * evaluation.ece),
            String::new(),
        ),
        (
            "negative log-likelihood",
            format!("{:.4}", evaluation.nll),
            String::new(),
        ),
    ];
    table.rows = rows
        .map(|(name, value, more)| vec![name.to_owned(), value, more])
        .to_vec();
    table
}

/// The confusion matrix of one evaluation. Rows are the truth, columns are the verdicts.
pub fn confusion(evaluation: &Evaluation) -> Table {
    let mut table = Table::new(
        "Confusion",
        "Rows are the truth, columns are the verdicts.",
        &[],
    );
    table.head = vec!["truth".to_owned()];
    for (truth, counts) in (1..).zip(&evaluation.confusion) {
        table.head.push(truth.to_string());
        let mut cells = vec![format!("level {truth}")];
        cells.extend(counts.iter().map(ToString::to_string));
        table.rows.push(cells);
    }
    table
}

/// The table of a run's results on the test sets of a comparison.
pub fn sets(worth: &Worth) -> Table {
    let sets = described(&[&SHIFTS[..], &WORLDS[..]].concat());
    let note = format!(
        "Materials that the model has not learnt from, 20 objects of each. fresh: the paper's shapes; matched: \
         the same shapes for all materials; {sets}. One frame fixes only the ratio of radius and modulus, so \
         varying shapes lower the accuracy of every model."
    );
    let head = ["set", "accuracy, %", "95 %", "calibration error, %"];
    let mut table = Table::new("Other test sets", &note, &head);
    for (name, measured) in worth.sets.iter().filter(|(name, _)| *name != PAPER_SPLIT) {
        let evaluation = &measured.evaluation;
        let objects = measured.objects.as_deref();
        let estimate =
            objects.and_then(|objects| metrics::accuracy_by_object(&[objects], clusters(name)));
        table.rows.push(vec![
            name.replace('_', " "),
            number(100.0 * evaluation.accuracy, 1),
            interval_text(estimate.and_then(|estimate| estimate.interval)),
            number(100.0 * evaluation.ece, 1),
        ]);
    }
    table
}

/// The table of runs with swapped materials.
fn swaps(swaps: &[SwapEntry]) -> Table {
    let note = "The two materials of some levels in each other's roles, each time learnt anew and \
                judged on 20 objects of each material, in the paper's shapes: accuracy in per cent. Each \
                assignment counts with its mean over seeds. The choice of materials alone causes the \
                spread over the assignments. \"Minus features\": over the same assignments, seeds and \
                labels, least to most of the assignments.";
    let head = [
        "method",
        "labels",
        "seeds",
        "assignments",
        "as in the paper",
        "mean",
        "deviation",
        "least",
        "most",
        "minus features, points",
    ];
    let mut table = Table::new("Materials swapped", note, &head);
    for group in swap_groups(swaps) {
        let percent = |swap: &&SwapEntry| (swap.swapped_levels, 100.0 * swap.test.accuracy);
        let means = by_assignment(group.iter().map(percent));
        let percents: Vec<f64> = means.values().copied().collect();
        let seeds: BTreeSet<u64> = group.iter().map(|swap| swap.seed).collect();
        let unswapped = means.get(&[false; 4]);
        table.rows.push(vec![
            group[0].method.clone(),
            thousands(group[0].labels as u64),
            seeds.len().to_string(),
            percents.len().to_string(),
            unswapped.map_or("-".to_owned(), |&percent| number(percent, 1)),
            number(mean(&percents), 1),
            deviation(&percents).map_or("-".to_owned(), |sd| number(sd, 1)),
            number(least(&percents), 1),
            number(most(&percents), 1),
            minus_features(&group, swaps),
        ]);
    }
    table
}

#[cfg(test)]
mod tests;
