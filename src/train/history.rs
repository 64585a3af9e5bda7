//! What a run's `metrics.csv` tells: how each of its stages went, and the run's price.
//!
//! Columns are found by their names, so that a stage may have others than its neighbours; a cell
//! that is no number is a column the stage does not have.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::Path;

use anyhow::Context as _;

/// The stages of a run, in the order they ran.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct History {
    /// Each once.
    pub stages: Vec<Stage>,
}

/// A stage of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Stage {
    /// Such as `ustgan`.
    pub name: String,
    /// Its rows: column to value.
    pub rows: Vec<BTreeMap<String, f64>>,
}

impl History {
    /// Reads a run's `metrics.csv`; a run without one has no stages.
    ///
    /// # Errors
    ///
    /// If the file is there and cannot be read.
    pub fn read(run: &Path) -> anyhow::Result<Self> {
        let path = run.join("metrics.csv");
        match std::fs::read_to_string(&path) {
            Ok(text) => Ok(Self::parse(&text)),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(error).with_context(|| path.display().to_string()),
        }
    }

    fn parse(text: &str) -> Self {
        let mut lines = text.lines();
        let columns: Vec<&str> = lines.next().unwrap_or_default().split(',').collect();
        let mut stages: Vec<Stage> = Vec::new();
        for line in lines {
            let cells: Vec<&str> = line.split(',').collect();
            let numbers = columns.iter().zip(&cells).filter_map(|(column, cell)| {
                let number = cell.parse().ok()?;
                Some(((*column).to_owned(), number))
            });
            let row = numbers.collect();
            match stages.iter_mut().find(|stage| stage.name == cells[0]) {
                Some(stage) => stage.rows.push(row),
                None => stages.push(Stage {
                    name: cells[0].to_owned(),
                    rows: vec![row],
                }),
            }
        }
        Self { stages }
    }

    /// Steps of all stages.
    pub fn steps(&self) -> u64 {
        self.stages
            .iter()
            .map(|stage| stage.last("step") as u64)
            .sum()
    }

    /// Seconds of all stages, over restarts.
    pub fn seconds(&self) -> f64 {
        self.stages.iter().map(Stage::seconds).sum()
    }
}

impl Stage {
    /// Steps done.
    pub fn steps(&self) -> u64 {
        self.last("step") as u64
    }

    /// Seconds taken, over restarts.
    pub fn seconds(&self) -> f64 {
        self.last("seconds")
    }

    /// A column's last value; 0 if it has none.
    fn last(&self, column: &str) -> f64 {
        let values = self.rows.iter().rev().filter_map(|row| row.get(column));
        values.copied().next().unwrap_or(0.0)
    }

    /// A column against the steps, where it has values.
    pub fn curve(&self, column: &str) -> Vec<(f64, f64)> {
        let point = |row: &BTreeMap<String, f64>| Some((*row.get("step")?, *row.get(column)?));
        self.rows.iter().filter_map(point).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_runs_price_is_the_sum_over_its_stages() {
        let text = "stage,step,epoch,loss,validation_accuracy,seconds\n\
                    pretraining,10,1,1.5,,2.0\n\
                    training,5,1,1.0,,0.5\n\
                    training,10,2,0.5,0.75,1.5\n\
                    pretraining,20,2,1.25,,4.0\n";
        let history = History::parse(text);
        assert_eq!((history.steps(), history.seconds()), (30, 5.5));
        assert_eq!(
            history.stages[1].curve("validation_accuracy"),
            [(10.0, 0.75)]
        );
        assert_eq!(history.stages[0].curve("loss"), [(10.0, 1.5), (20.0, 1.25)]);
    }
}
