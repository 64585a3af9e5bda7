//! The paper's Tables 2 and 3 beside our results, in Markdown.
//!
//! In: the entries of `results.json`. Out: `tables.md`. Intervals and pictures are made by the programs in
//! `results/`.

use std::collections::BTreeSet;

use serde::Deserialize;

use crate::judge::metrics::{accuracy, category_accuracy, kappa, kappa_quadratic};
use crate::judge::paper;

/// A run, as `results.json` has it.
#[derive(Debug, Clone, Deserialize)]
pub struct Entry {
    method: String,
    labels: usize,
    profile: String,
    paper_split: Option<Figures>,
    fresh: Option<Figures>,
    matched: Option<Figures>,
}

/// The figures of a run on one set. The others follow from these.
#[derive(Debug, Clone, Deserialize)]
struct Figures {
    confusion: Vec<Vec<u64>>,
}

/// A figure that follows from a confusion matrix.
type Figure<'a> = &'a dyn Fn(&[Vec<u64>]) -> Option<f64>;

/// The confusion matrices of the runs of one method with the same number of labels, under all seeds.
struct Row<'a> {
    method: &'a str,
    labels: usize,
    title: String,
    /// On the test split, and on fresh objects in the paper's and in matched shapes.
    sets: [Vec<&'a [Vec<u64>]>; 3],
}

/// The content of `tables.md`.
pub fn markdown(entries: &[Entry]) -> String {
    let rows = rows(entries);
    let profiles: BTreeSet<&str> = entries.iter().map(|entry| entry.profile.as_str()).collect();
    let profiles = profiles.into_iter().collect::<Vec<_>>().join(", ");
    let levels = rows.iter().flat_map(|row| &row.sets[0]).map(|of| of.len());
    let levels = levels.max().unwrap_or(4);
    format!(
        "# Comparison\n\nMade by hrn-train compare, profile {profiles}. Simulated data, unless you gave your own. ± is \
         the standard deviation over seeds; `results/intervals.py` computes intervals over seeds and objects.\n{}{}{}",
        accuracies(&rows, levels),
        kappas(&rows),
        confusions(&rows, levels)
    )
}

fn rows(entries: &[Entry]) -> Vec<Row<'_>> {
    let mut rows: Vec<Row> = Vec::new();
    for entry in entries {
        let (method, labels) = (entry.method.as_str(), entry.labels);
        let same = |row: &Row| (row.method, row.labels) == (method, labels);
        let place = rows.iter().position(same).unwrap_or_else(|| {
            let of_method = entries.iter().filter(|other| other.method == method);
            let title = match of_method.clone().all(|other| other.labels == labels) {
                true => method.to_owned(),
                false => format!("{method}, {} labels", thousands(labels)),
            };
            rows.push(Row {
                method,
                labels,
                title,
                sets: Default::default(),
            });
            rows.len() - 1
        });
        let sets = [&entry.paper_split, &entry.fresh, &entry.matched];
        for (own, figures) in rows[place].sets.iter_mut().zip(sets) {
            own.extend(figures.iter().map(|figures| figures.confusion.as_slice()));
        }
    }
    rows
}

impl Row<'_> {
    /// What is shown of a figure over the seeds, or a dash, with the paper's behind it.
    fn cell(
        &self,
        set: usize,
        figure: Figure,
        decimals: usize,
        shown: fn(&[f64], usize) -> String,
    ) -> String {
        let values = self.sets[set].iter();
        let values: Vec<f64> = values.filter_map(|confusion| figure(confusion)).collect();
        let mut cell = match values.is_empty() {
            true => "-".to_owned(),
            false => shown(&values, decimals),
        };
        // The paper has results on its own test split only.
        let papers = paper::confusion(self.method).filter(|_| set == 0);
        if let Some(papers) = papers.and_then(|papers| figure(&papers)) {
            cell += &format!(" ({})", rounded(papers, decimals));
        }
        cell
    }
}

/// The mean.
fn mean_alone(values: &[f64], decimals: usize) -> String {
    rounded(mean(values), decimals)
}

/// The mean, and with several values the standard deviation of the sample.
fn spread(values: &[f64], decimals: usize) -> String {
    let mean = mean(values);
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    let deviation = (squares / (values.len() as f64 - 1.0)).sqrt();
    match values.len() {
        1 => mean_alone(values, decimals),
        _ => format!("{} ± {deviation:.decimals$}", rounded(mean, decimals)),
    }
}

/// A table with a title and a note. Its first column is text.
fn table(title: &str, note: &str, head: &str, rows: &[Vec<String>]) -> String {
    let rule = " | ---:".repeat(head.matches(" | ").count());
    let line = |cells: &Vec<String>| format!("| {} |\n", cells.join(" | "));
    let rows: String = rows.iter().map(line).collect();
    format!("\n## {title}\n\n{note}\n\n| {head} |\n| ---{rule} |\n{rows}")
}

/// Table 2, with the paper's figures in brackets.
fn accuracies(rows: &[Row], levels: usize) -> String {
    let note = "Category accuracies and overall accuracy in per cent on the data set's own test \
                split, of the paper's size; in brackets the paper's.";
    let of_levels = (1..=levels).map(|level| format!(" | level {level}"));
    let head = format!("method | labels{} | overall", of_levels.collect::<String>());
    let cells = |row: &Row| {
        let mut cells = vec![row.title.clone(), thousands(row.labels)];
        cells.extend((0..levels).map(|level| {
            let of = |counts: &[Vec<u64>]| Some(100.0 * (*category_accuracy(counts).get(level)?)?);
            row.cell(0, &of, 1, mean_alone)
        }));
        cells.push(row.cell(0, &|counts| Some(100.0 * accuracy(counts)), 1, spread));
        cells
    };
    let cells: Vec<_> = rows.iter().map(cells).collect();
    table("Table 2: accuracy", note, &head, &cells)
}

/// Table 3's kappas, with the paper's in brackets.
fn kappas(rows: &[Row]) -> String {
    let note = "Cohen's kappa on the counts, and the same with quadratic weights, because levels \
                are ordinal; in brackets what the paper's counts give.";
    let head = "method | test split: kappa | quadratic | fresh, paper's shapes: kappa | quadratic | \
                fresh, matched shapes: kappa | quadratic";
    let cells = |row: &Row| {
        let of_set = |set| {
            [
                row.cell(set, &kappa, 4, spread),
                row.cell(set, &kappa_quadratic, 4, spread),
            ]
        };
        let sets = (0..row.sets.len()).flat_map(of_set);
        [row.title.clone()].into_iter().chain(sets).collect()
    };
    let cells: Vec<_> = rows.iter().map(cells).collect();
    table("Table 3: kappa", note, head, &cells)
}

/// Table 3's confusion matrices as counts, with the paper's to the right.
fn confusions(rows: &[Row], levels: usize) -> String {
    let note = "Samples of the test split, mean over seeds; the paper's are of 250 a level. Rows \
                are the truth, columns are the verdicts.";
    let of_levels = (1..=levels).map(|level| format!(" | {level}"));
    let head = format!(
        "method | truth{} | paper: 1 | 2 | 3 | 4",
        of_levels.collect::<String>()
    );
    let mut all = Vec::new();
    for row in rows.iter().filter(|row| !row.sets[0].is_empty()) {
        let papers = paper::confusion(row.method);
        for truth in 0..levels {
            let title = if truth == 0 { row.title.as_str() } else { "" };
            let mut cells = vec![title.to_owned(), format!("level {}", truth + 1)];
            cells.extend((0..levels).map(|said| {
                let counts = row.sets[0].iter().map(|counts| counts[truth][said] as f64);
                let mean = mean(&counts.collect::<Vec<_>>());
                format!("{mean:.1}").trim_end_matches(".0").to_owned()
            }));
            let papers = papers.as_ref().and_then(|counts| counts.get(truth));
            cells.extend((0..4).map(|said| {
                papers.map_or_else(|| "-".to_owned(), |counts| counts[said].to_string())
            }));
            all.push(cells);
        }
    }
    table("Table 3: confusion", note, &head, &all)
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// A number with `decimals` decimals. A number that rounds to zero has no sign.
fn rounded(value: f64, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(zero) if zero.bytes().all(|byte| matches!(byte, b'0' | b'.')) => zero.to_owned(),
        _ => text,
    }
}

/// An integer with commas between thousands.
fn thousands(value: usize) -> String {
    match value {
        0..1000 => value.to_string(),
        _ => format!("{},{:03}", thousands(value / 1000), value % 1000),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_figure_that_rounds_to_zero_has_no_sign() {
        for (values, expected) in [
            (&[-4e-5][..], "0.0000"),
            (&[-6e-5], "-0.0001"),
            (&[4e-5], "0.0000"),
            (&[-1e-5, -1e-5], "0.0000 ± 0.0000"),
        ] {
            assert_eq!(spread(values, 4), expected);
        }
    }
}
