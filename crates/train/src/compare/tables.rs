//! The paper's Tables 2 and 3 beside our results, in Markdown.
//!
//! In: the entries of `results.json`. Out: `tables.md`. Intervals and pictures are made by the programs in
//! `results/`.

use std::collections::BTreeSet;

use serde::Deserialize;

use crate::judge::metrics;
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

/// The figures of a run on one set that the tables show.
#[derive(Debug, Clone, Deserialize)]
struct Figures {
    accuracy: f64,
    category_accuracy: Vec<Option<f64>>,
    confusion: Vec<Vec<u64>>,
    kappa: Option<f64>,
    kappa_quadratic: Option<f64>,
}

/// A test set: what of an entry it is.
type Set = fn(&Entry) -> Option<&Figures>;

const PAPER_SPLIT: Set = |entry| entry.paper_split.as_ref();
const FRESH: Set = |entry| entry.fresh.as_ref();
const MATCHED: Set = |entry| entry.matched.as_ref();

/// The runs of one method with the same number of labels, under all seeds.
struct Row<'a> {
    title: String,
    runs: Vec<&'a Entry>,
}

/// The content of `tables.md`.
pub fn markdown(entries: &[Entry]) -> String {
    let rows = rows(entries);
    let profiles: BTreeSet<&str> = entries.iter().map(|entry| entry.profile.as_str()).collect();
    let profiles = profiles.into_iter().collect::<Vec<_>>().join(", ");
    let mut text = format!(
        "# Comparison\n\nMade by hrn-train compare, profile {profiles}. Simulated data, unless you gave your own. ± is \
         the standard deviation over seeds; `results/intervals.py` computes intervals over seeds and objects.\n"
    );
    for table in [accuracies(&rows), kappas(&rows), confusions(&rows)] {
        text += &table.markdown();
    }
    text
}

fn rows(entries: &[Entry]) -> Vec<Row<'_>> {
    let mut rows: Vec<Row> = Vec::new();
    for entry in entries {
        let same = |row: &&mut Row| {
            (&row.runs[0].method, row.runs[0].labels) == (&entry.method, entry.labels)
        };
        match rows.iter_mut().find(same) {
            Some(row) => row.runs.push(entry),
            None => rows.push(Row {
                title: String::new(),
                runs: vec![entry],
            }),
        }
    }
    for row in &mut rows {
        let Entry { method, labels, .. } = row.runs[0];
        row.title.clone_from(method);
        let of_method = entries.iter().filter(|entry| entry.method == *method);
        let numbers: BTreeSet<usize> = of_method.map(|entry| entry.labels).collect();
        if numbers.len() > 1 {
            row.title += &format!(", {} labels", thousands(*labels));
        }
    }
    rows
}

impl<'a> Row<'a> {
    fn figures(&self, set: Set) -> Vec<&'a Figures> {
        self.runs.iter().filter_map(|entry| set(entry)).collect()
    }

    fn paper(&self) -> Option<&'static paper::Row> {
        paper::row(&self.runs[0].method)
    }

    /// The mean over the seeds; a dash without any.
    fn mean(&self, set: Set, value: impl Fn(&Figures) -> Option<f64>, decimals: usize) -> String {
        let values: Vec<f64> = self.figures(set).into_iter().filter_map(value).collect();
        match values.is_empty() {
            true => "-".to_owned(),
            false => rounded(mean(&values), decimals),
        }
    }

    /// The same with the standard deviation, if there are several seeds.
    fn spread(&self, set: Set, value: impl Fn(&Figures) -> Option<f64>, decimals: usize) -> String {
        let values: Vec<f64> = self.figures(set).into_iter().filter_map(&value).collect();
        let mean = self.mean(set, value, decimals);
        match deviation(&values) {
            Some(deviation) => format!("{mean} ± {deviation:.decimals$}"),
            None => mean,
        }
    }
}

/// A table of text.
struct Table {
    title: &'static str,
    note: &'static str,
    head: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Table {
    fn new(title: &'static str, note: &'static str, head: &[&str]) -> Self {
        Self {
            title,
            note,
            head: head.iter().map(|&name| name.to_owned()).collect(),
            rows: Vec::new(),
        }
    }

    fn markdown(&self) -> String {
        let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
        let rule: Vec<String> = (0..self.head.len())
            .map(|column| if column == 0 { "---" } else { "---:" }.to_owned())
            .collect();
        let rows: String = self.rows.iter().map(|row| line(row)).collect();
        let (head, rule) = (line(&self.head), line(&rule));
        format!("\n## {}\n\n{}\n\n{head}{rule}{rows}", self.title, self.note)
    }
}

/// Table 2, with the paper's figures in brackets.
fn accuracies(rows: &[Row]) -> Table {
    let levels = levels(rows);
    let of_levels: Vec<String> = (1..=levels).map(|level| format!("level {level}")).collect();
    let mut head = vec!["method", "labels"];
    head.extend(of_levels.iter().map(String::as_str));
    head.push("overall");
    let note = "Category accuracies and overall accuracy in per cent on the data set's own test \
                split, of the paper's size; in brackets the paper's.";
    let mut table = Table::new("Table 2: accuracy", note, &head);
    for row in rows {
        let paper = row.paper();
        let mut cells = vec![row.title.clone(), thousands(row.runs[0].labels)];
        for level in 0..levels {
            let percent =
                |figures: &Figures| Some(100.0 * (*figures.category_accuracy.get(level)?)?);
            let there = paper.and_then(|paper| paper.category_accuracy_percent.get(level).copied());
            cells.push(beside(row.mean(PAPER_SPLIT, percent, 1), there, 1));
        }
        let here = row.spread(PAPER_SPLIT, |figures| Some(100.0 * figures.accuracy), 1);
        cells.push(beside(here, paper.map(|paper| paper.accuracy_percent), 1));
        table.rows.push(cells);
    }
    table
}

/// Table 3's kappas, with the paper's in brackets.
fn kappas(rows: &[Row]) -> Table {
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
        let paper = row.paper();
        let quadratic = paper.and_then(|paper| metrics::kappa_quadratic(&paper.counts()));
        let mut cells = vec![row.title.clone()];
        let known = [paper.map(|paper| paper.kappa), quadratic];
        for (set, [kappa, quadratic]) in [
            (PAPER_SPLIT, known),
            (FRESH, [None; 2]),
            (MATCHED, [None; 2]),
        ] {
            let here = row.spread(set, |figures| figures.kappa, 4);
            cells.push(beside(here, kappa, 4));
            let here = row.spread(set, |figures| figures.kappa_quadratic, 4);
            cells.push(beside(here, quadratic, 4));
        }
        table.rows.push(cells);
    }
    table
}

/// Table 3's confusion matrices as counts, with the paper's to the right.
fn confusions(rows: &[Row]) -> Table {
    let levels = levels(rows);
    let numbers: Vec<String> = (1..=levels).map(|level| level.to_string()).collect();
    let mut head = vec!["method", "truth"];
    head.extend(numbers.iter().map(String::as_str));
    head.extend(["paper: 1", "2", "3", "4"]);
    let note = "Samples of the test split, mean over seeds; the paper's are of 250 a level. Rows \
                are the truth, columns are the verdicts.";
    let mut table = Table::new("Table 3: confusion", note, &head);
    for row in rows {
        let all = row.figures(PAPER_SPLIT);
        for truth in 0..if all.is_empty() { 0 } else { levels } {
            let title = if truth == 0 { row.title.as_str() } else { "" };
            let mut cells = vec![title.to_owned(), format!("level {}", truth + 1)];
            cells.extend((0..levels).map(|said| {
                let counts = all
                    .iter()
                    .map(|figures| figures.confusion[truth][said] as f64);
                number(mean(&counts.collect::<Vec<_>>()))
            }));
            let paper = row.paper().and_then(|paper| paper.confusion.get(truth));
            cells.extend((0..4).map(|said| match paper {
                Some(counts) => counts[said].to_string(),
                None => "-".to_owned(),
            }));
            table.rows.push(cells);
        }
    }
    table
}

/// The number of levels of the test split.
fn levels(rows: &[Row]) -> usize {
    let all = rows.iter().flat_map(|row| row.figures(PAPER_SPLIT));
    all.map(|figures| figures.confusion.len())
        .max()
        .unwrap_or(4)
}

fn beside(here: String, there: Option<f64>, decimals: usize) -> String {
    match there {
        Some(there) => format!("{here} ({there:.decimals$})"),
        None => here,
    }
}

/// The mean; 0 without values.
fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// The standard deviation of a sample; `None` for fewer than two values.
fn deviation(values: &[f64]) -> Option<f64> {
    let mean = mean(values);
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (values.len() - 1) as f64).sqrt())
}

/// A number with one decimal, or none for an integer.
fn number(value: f64) -> String {
    rounded(value, if value.fract() == 0.0 { 0 } else { 1 })
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
pub fn thousands(value: usize) -> String {
    let digits = value.to_string();
    let mut text = String::new();
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_readable() {
        assert_eq!(thousands(93_000), "93,000");
        assert_eq!(thousands(7), "7");
        assert_eq!((number(12.0), number(12.25)), ("12".into(), "12.2".into()));
        for (value, expected) in [(-4e-5, "0.0000"), (-6e-5, "-0.0001"), (4e-5, "0.0000")] {
            assert_eq!(rounded(value, 4), expected);
        }
        assert_eq!(deviation(&[1.0, 3.0]), Some(2.0_f64.sqrt()));
        assert_eq!(deviation(&[1.0]), None);
    }
}
