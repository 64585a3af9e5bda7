//! The text of the tables' cells, which summarises a row's runs.

use std::collections::BTreeMap;

use crate::compare::digits::rounded;
use crate::compare::results::{Details, Entry, Row, SwapEntry};
use crate::compare::sets::{self, FRESH, MATCHED, PAPER_SPLIT};
use crate::data::dataset::LabelChoice;
use crate::judge::metrics::{self, Estimate, Evaluation, ObjectCount};
use crate::judge::paper;

/// The method that the other methods are compared with.
const REFERENCE: &str = "ours";

/// The method that every network must surpass.
const FEATURES: &str = "features";

/// The mean confusion matrix of some evaluations.
pub(super) fn mean_confusion(evaluations: &[&Evaluation]) -> Vec<Vec<f64>> {
    let levels = evaluations.first().map_or(0, |first| first.confusion.len());
    let cell = |truth: usize, judged: usize| {
        let counts = evaluations
            .iter()
            .map(|e| e.confusion[truth][judged] as f64);
        mean(&counts.collect::<Vec<_>>())
    };
    (0..levels)
        .map(|truth| (0..levels).map(|judged| cell(truth, judged)).collect())
        .collect()
}

/// The runs with swapped materials, grouped by method and number of labels.
pub(super) fn swap_groups(swaps: &[SwapEntry]) -> Vec<Vec<&SwapEntry>> {
    let mut groups: Vec<Vec<&SwapEntry>> = Vec::new();
    for swap in swaps {
        let same = |group: &&mut Vec<&SwapEntry>| {
            (&group[0].method, group[0].labels) == (&swap.method, swap.labels)
        };
        match groups.iter_mut().find(same) {
            Some(group) => group.push(swap),
            None => groups.push(vec![swap]),
        }
    }
    groups
}

/// The paper's figures for the method of a row, if it has any.
pub(super) fn paper_row(row: &Row) -> Option<&'static paper::Row> {
    paper::row(&row.runs[0].0.method)
}

/// The evaluations of a row's runs on a set, where it was measured.
pub(super) fn evaluations<'a>(row: &Row<'a>, set: &str) -> Vec<&'a Evaluation> {
    let of_entry = |(entry, _): &(&'a Entry, _)| match set {
        PAPER_SPLIT => entry.paper_split.as_ref(),
        FRESH => Some(&entry.fresh),
        MATCHED => Some(&entry.matched),
        shift => entry.shifts.get(shift),
    };
    row.runs.iter().filter_map(of_entry).collect()
}

/// The counts by object of a row's runs on a set, with the runs' seeds.
fn objects<'a>(row: &Row<'a>, set: &str) -> Vec<(u64, &'a [ObjectCount])> {
    let of_run = |&(entry, details): &(&'a Entry, &'a Details)| {
        let objects = details.worth.sets.get(set)?.objects.as_deref()?;
        Some((entry.seed, objects))
    };
    row.runs.iter().filter_map(of_run).collect()
}

/// A row's accuracy over its seeds.
pub(super) fn accuracy(row: &Row, set: &str) -> Option<Estimate> {
    let objects = objects(row, set);
    let seeds: Vec<&[ObjectCount]> = objects.into_iter().map(|(_, objects)| objects).collect();
    metrics::accuracy_by_object(&seeds, sets::clusters(set))
}

pub(super) fn interval(row: &Row, set: &str) -> String {
    interval_text(accuracy(row, set).and_then(|estimate| estimate.interval))
}

/// An interval in per cent, or a dash if there is none.
pub fn interval_text(interval: Option<[f64; 2]>) -> String {
    interval.map_or("-".to_owned(), |[low, high]| {
        format!("{:.1} to {:.1}", 100.0 * low, 100.0 * high)
    })
}

/// The row that the others are compared with. If the method has several numbers of labels, its own number
/// comes first.
pub fn reference<'a, 'b>(rows: &'a [Row<'b>]) -> Option<&'a Row<'b>> {
    rows.iter().find(|row| {
        let entry = row.runs[0].0;
        entry.method == REFERENCE && entry.label_choice == LabelChoice::Object
    })
}

/// The difference from the reference's accuracy, paired with its runs of the same seeds.
pub(super) fn minus_reference(row: &Row, rows: &[Row], set: &str) -> String {
    let Some(reference) = reference(rows) else {
        return "-".to_owned();
    };
    if std::ptr::eq(row, reference) {
        return String::new();
    }
    let (own, others) = (objects(row, set), objects(reference, set));
    let pair = |&(seed, own): &(u64, _)| {
        let other = others.iter().find(|(other, _)| *other == seed)?;
        Some((own, other.1))
    };
    let pairs: Vec<(&[ObjectCount], &[ObjectCount])> = own.iter().filter_map(pair).collect();
    metrics::difference_by_object(&pairs, sets::clusters(set))
        .map_or("-".to_owned(), difference_text)
}

/// The mean value of every assignment over its seeds.
pub(super) fn by_assignment(
    values: impl IntoIterator<Item = ([bool; 4], f64)>,
) -> BTreeMap<[bool; 4], f64> {
    let mut found: BTreeMap<[bool; 4], Vec<f64>> = BTreeMap::new();
    for (assignment, value) in values {
        found.entry(assignment).or_default().push(value);
    }
    let means = found.into_iter().map(|(key, values)| (key, mean(&values)));
    means.collect()
}

/// A method's accuracy minus that of `features` over the assignments, seeds and labels that both
/// have: the mean, and the least and greatest assignment, in points.
pub(super) fn minus_features(group: &[&SwapEntry], swaps: &[SwapEntry]) -> String {
    if group[0].method == FEATURES {
        return String::new();
    }
    let key = |swap: &SwapEntry| (swap.seed, swap.labels, swap.swapped_levels);
    let of_features = |own: &&SwapEntry| {
        let mut others = swaps.iter().filter(|swap| swap.method == FEATURES);
        let other = others.find(|swap| key(swap) == key(own))?;
        let points = 100.0 * (own.test.accuracy - other.test.accuracy);
        Some((own.swapped_levels, points))
    };
    let points = by_assignment(group.iter().filter_map(of_features));
    let points: Vec<f64> = points.into_values().collect();
    if points.is_empty() {
        return "-".to_owned();
    }
    let (low, high) = (least(&points), most(&points));
    format!("{:+.1} ({low:+.1} to {high:+.1})", mean(&points))
}

/// A difference and its interval, in points.
pub fn difference_text(difference: Estimate) -> String {
    let points = |share: f64| match rounded(100.0 * share, 1) {
        text if text == "0.0" || text.starts_with('-') => text,
        more => format!("+{more}"),
    };
    let mean = points(difference.mean);
    match difference.interval {
        Some([low, high]) => format!("{mean} ({} to {})", points(low), points(high)),
        None => format!("{mean} (-)"),
    }
}

pub(super) fn percent_of(evaluation: &Evaluation, level: usize) -> Option<f64> {
    Some(100.0 * (*evaluation.category_accuracy.get(level)?)?)
}

pub(super) fn of_entries(row: &Row, value: impl Fn(&Entry) -> f64) -> Vec<f64> {
    row.runs.iter().map(|(entry, _)| value(entry)).collect()
}

/// The mean over the seeds, with the standard deviation if there are several.
pub(super) fn with_spread(
    row: &Row,
    set: &str,
    value: impl Fn(&Evaluation) -> Option<f64>,
    decimals: usize,
) -> String {
    let values: Vec<f64> = evaluations(row, set)
        .into_iter()
        .filter_map(&value)
        .collect();
    let mean = mean_over_seeds(row, set, value, decimals);
    match deviation(&values) {
        Some(deviation) => format!("{mean} ± {deviation:.decimals$}"),
        None => mean,
    }
}

pub(super) fn mean_over_seeds(
    row: &Row,
    set: &str,
    value: impl Fn(&Evaluation) -> Option<f64>,
    decimals: usize,
) -> String {
    let values: Vec<f64> = evaluations(row, set)
        .into_iter()
        .filter_map(value)
        .collect();
    if values.is_empty() {
        return "-".to_owned();
    }
    rounded(mean(&values), decimals)
}

/// The mean calibration error in per cent before the temperature, where one was fitted.
pub(super) fn before_temperature(row: &Row, set: &str) -> String {
    let measured =
        |(_, details): &(&Entry, &Details)| details.worth.sets.get(set)?.ece_before_temperature;
    let before: Vec<f64> = row.runs.iter().filter_map(measured).collect();
    if before.is_empty() {
        return "-".to_owned();
    }
    rounded(100.0 * mean(&before), 1)
}

pub(super) fn beside(here: String, there: Option<f64>, decimals: usize) -> String {
    match there {
        Some(there) => format!("{here} ({there:.decimals$})"),
        None => here,
    }
}

/// The mean; 0 without values.
pub(super) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// The least value; infinity without values.
pub(super) fn least(values: &[f64]) -> f64 {
    values.iter().copied().fold(f64::INFINITY, f64::min)
}

/// The greatest value; minus infinity without values.
pub(super) fn most(values: &[f64]) -> f64 {
    values.iter().copied().fold(f64::NEG_INFINITY, f64::max)
}

/// The standard deviation of a sample; `None` for fewer than two values.
pub(super) fn deviation(values: &[f64]) -> Option<f64> {
    let mean = mean(values);
    let squares: f64 = values.iter().map(|value| (value - mean).powi(2)).sum();
    (values.len() > 1).then(|| (squares / (values.len() - 1) as f64).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interval_that_is_none_is_a_dash() {
        assert_eq!(interval_text(Some([0.5, 0.625])), "50.0 to 62.5");
        assert_eq!(interval_text(None), "-");
        let text = |interval| {
            difference_text(Estimate {
                mean: 0.02,
                interval,
            })
        };
        assert_eq!(text(Some([-0.01, 0.05])), "+2.0 (-1.0 to +5.0)");
        assert_eq!(text(None), "+2.0 (-)");
        assert_eq!(text(Some([-4e-4, 4e-4])), "+2.0 (0.0 to 0.0)");
    }

    #[test]
    fn one_value_has_no_deviation() {
        assert_eq!(deviation(&[1.0, 3.0]), Some(2.0_f64.sqrt()));
        assert_eq!(deviation(&[1.0]), None);
    }
}
