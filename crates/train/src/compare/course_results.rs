//! The results of `hrn-train compare --course`, and their tables.

use serde::{Deserialize, Serialize};

use super::so_far::{self, SoFar};
use super::table::Table;
use super::tables;
use crate::judge::metrics::{Bin, Estimate, Evaluation, ObjectCount};

/// A row of the tables: a control or model, and its results on each set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CourseRow {
    /// A control's name, or the model's file.
    pub name: String,
    /// The results on each set, in the order of the plan.
    pub sets: Vec<OnSet>,
}

/// The results on one set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OnSet {
    /// The set's file, without folder and suffix.
    pub set: String,
    /// The evaluation of the levels.
    pub levels: Evaluation,
    /// The bins of the calibration error.
    pub calibration: Vec<Bin>,
    /// Share of presses whose level is off by more than one.
    pub beyond_neighbour: f64,
    /// Root mean square error of the Shore hardness, in Shore OO; null without a Shore hardness.
    pub shore_rmse: Option<f64>,
    /// The 95 % interval of the accuracy, by a bootstrap over the geometries where all materials are
    /// pressed alike, otherwise over the objects. Null if it cannot be computed.
    pub interval: Option<[f64; 2]>,
    /// Presses judged correctly, by object.
    pub objects: Vec<ObjectCount>,
    /// Accuracy minus that of the first model on the same presses, with its 95 % interval of the same
    /// kind; null for the first model.
    pub less_first: Option<Estimate>,
    /// The evaluation of verdicts before the end of presses; null except for models of format 2.
    pub so_far: Option<SoFar>,
}

/// What the intervals are drawn over.
const CLUSTERS: &str = "by shape where all materials are pressed alike, otherwise by object";

/// The number of [`tables`] that have all rows. The others are each of one row and set.
pub(super) const OVERVIEW: usize = 4;

/// The tables of all rows, then those of verdicts before the end of a press.
pub(super) fn tables(rows: &[CourseRow]) -> Vec<Table> {
    let sets: Vec<&str> = rows[0].sets.iter().map(|on| on.set.as_str()).collect();
    let of = |title: &str, note: &str, cell: &dyn Fn(&OnSet) -> String| Table {
        title: title.to_owned(),
        note: note.to_owned(),
        head: std::iter::once("judged by")
            .chain(sets.iter().copied())
            .map(str::to_owned)
            .collect(),
        rows: rows
            .iter()
            .map(|row| {
                let cells = row.sets.iter().map(cell);
                std::iter::once(row.name.clone()).chain(cells).collect()
            })
            .collect(),
    };
    let percent = |share: f64| format!("{:.1}", 100.0 * share);
    let mut all = vec![
        of(
            "Accuracy",
            &format!(
                "Per cent of the presses whose level is right, with a 95 % interval {CLUSTERS}."
            ),
            &|on| {
                let interval = tables::interval_text(on.interval);
                format!("{} ({interval})", percent(on.levels.accuracy))
            },
        ),
        of(
            "Compared with the first model",
            &format!(
                "Accuracy minus that of the first model on the same presses, in points, with a 95 % interval \
                 {CLUSTERS}."
            ),
            &|on| {
                on.less_first
                    .map_or("-".to_owned(), tables::difference_text)
            },
        ),
        of(
            "Beyond the neighbour",
            "Per cent of the presses whose level is off by more than one.",
            &|on| percent(on.beyond_neighbour),
        ),
        of(
            "Shore hardness",
            "Root of the mean squared error, Shore OO.",
            &|on| {
                on.shore_rmse
                    .map_or("-".to_owned(), |rmse| format!("{rmse:.1}"))
            },
        ),
    ];
    debug_assert_eq!(all.len(), OVERVIEW);
    for row in rows {
        for on in &row.sets {
            if let Some(so_far) = &on.so_far {
                all.extend(so_far::tables(&row.name, &on.set, so_far));
            }
        }
    }
    all
}
