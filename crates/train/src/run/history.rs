//! A run's `metrics.csv`, written with a row per epoch, and read again for each stage's course and
//! the run's cost.
//!
//! Columns are found by their names, so that stages may have different ones. A cell that is not a
//! number is a column that the stage does not have.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};

use super::disk::write_whole;
use crate::judge::likeness::Likeness;

/// A run's `metrics.csv`.
#[derive(Debug)]
pub struct MetricsFile {
    path: PathBuf,
}

impl MetricsFile {
    /// The file of the run in a directory.
    pub(super) fn of(run: &Path) -> Self {
        Self {
            path: run.join("metrics.csv"),
        }
    }

    /// Opens the file and cuts off the rows of `stage` after `step`, because a resumed run writes them
    /// again.
    ///
    /// # Errors
    ///
    /// Returns the errors of reading and writing, and an error if another version began the file
    /// with other columns.
    pub fn open(&self, stage: &'static str, step: u64) -> anyhow::Result<Metrics> {
        let before = self.read()?;
        let columns = columns();
        let mut seconds_before = 0.0;
        let mut text = columns.clone() + "\n";
        for row in before.lines().skip(1) {
            let cells: Vec<&str> = row.split(',').collect();
            let row_step = cells.get(1).and_then(|cell| cell.parse::<u64>().ok());
            let is_done = cells[0] != stage || row_step.is_some_and(|row_step| row_step <= step);
            // A full disk may have broken a row off.
            if !is_done || cells.len() != columns.split(',').count() {
                continue;
            }
            text.push_str(row);
            text.push('\n');
            let seconds = cells.last().and_then(|cell| cell.parse().ok());
            if let (true, Some(seconds)) = (cells[0] == stage, seconds) {
                seconds_before = seconds;
            }
        }
        write_whole(&self.path, text.as_bytes())?;
        let file = File::options().append(true).open(&self.path);
        Ok(Metrics {
            file: file.with_context(|| self.path.display().to_string())?,
            stage,
            seconds_before,
        })
    }

    /// Adds the rows of `stage` from the text of another run's file, because they are part of the
    /// cost of this run's model.
    pub(super) fn take(&self, stage: &str, text: &str) -> anyhow::Result<()> {
        let mut own = self.read()?;
        if own.is_empty() {
            own = columns() + "\n";
        }
        let of_stage = |row: &&str| row.split(',').next() == Some(stage);
        let own = own.lines().filter(|row| !of_stage(row));
        let rows: Vec<&str> = own.chain(text.lines().filter(of_stage)).collect();
        write_whole(&self.path, (rows.join("\n") + "\n").as_bytes())
    }

    /// The text so far. Empty if the file does not exist yet.
    pub(super) fn read(&self) -> anyhow::Result<String> {
        match std::fs::read_to_string(&self.path) {
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(String::new()),
            Err(error) => Err(error).with_context(|| self.path.display().to_string()),
            Ok(text) if text.is_empty() => Ok(text),
            Ok(text) => check_columns(&text, &self.path).map(|()| text),
        }
    }
}

/// `metrics.csv`, open for one stage.
#[derive(Debug)]
pub struct Metrics {
    file: File,
    stage: &'static str,
    /// Seconds that the stage had taken at the checkpoint from which it continues.
    seconds_before: f64,
}

/// One row of `metrics.csv`.
#[derive(Debug, Clone, Copy, Default)]
pub struct Row {
    /// Steps done.
    pub step: u64,
    /// Epochs done.
    pub epoch: u32,
    /// Mean training loss of the epoch; in a GAN's stage, that of the discriminator.
    pub loss: f64,
    /// Learning rate of the epoch's last step.
    pub learning_rate: f64,
    /// Share of the epoch's samples judged rightly, each before the step that learnt from it. Only
    /// a recogniser's stage has it.
    pub accuracy: Option<f64>,
    /// Loss and accuracy on the validation objects, in epochs that judged them.
    pub validation: Option<(f64, f64)>,
    /// Seconds since this process took up the stage. The file has the sum over processes. It does
    /// not include what a killed process did after its last checkpoint, which is done again.
    pub seconds: f64,
    /// The figures of a GAN's stage.
    pub adversarial: Option<Adversarial>,
}

/// The further figures in a GAN's row.
#[derive(Debug, Clone, Copy)]
pub struct Adversarial {
    /// Mean generator loss of the epoch.
    pub generator_loss: f64,
    /// Least, mean and greatest deviation sigma of the mixture.
    pub sigma: [f64; 3],
    /// The comparison of generated frames with real ones, in epochs that made it.
    pub likeness: Option<Likeness>,
}

impl Metrics {
    /// Adds a row.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing.
    pub fn add(&mut self, row: &Row) -> anyhow::Result<()> {
        let row = Row {
            seconds: self.seconds_before + row.seconds,
            ..*row
        };
        let cells = row.cells(self.stage).map(|(_, cell)| cell);
        // One write per row, so that a killed process leaves whole rows.
        self.file
            .write_all((cells.join(",") + "\n").as_bytes())
            .context("metrics.csv")
    }
}

impl Row {
    /// The columns and their cells. A cell is empty if the stage does not have the value.
    fn cells(&self, stage: &str) -> [(&'static str, String); 17] {
        let optional = |value: Option<f64>, digits: usize| {
            value.map_or_else(String::new, |value| format!("{value:.digits$}"))
        };
        let validation = self.validation;
        let adversarial = self.adversarial;
        let sigma = |which: usize| adversarial.map(|adversarial| adversarial.sigma[which]);
        let likeness = adversarial.and_then(|adversarial| adversarial.likeness);
        let of_likeness = |value: fn(&Likeness) -> f64| optional(likeness.as_ref().map(value), 5);
        [
            ("stage", stage.to_owned()),
            ("step", self.step.to_string()),
            ("epoch", self.epoch.to_string()),
            ("loss", optional(Some(self.loss), 6)),
            ("learning_rate", self.learning_rate.to_string()),
            ("accuracy", optional(self.accuracy, 4)),
            (
                "validation_loss",
                optional(validation.map(|(loss, _)| loss), 6),
            ),
            (
                "validation_accuracy",
                optional(validation.map(|(_, share)| share), 4),
            ),
            (
                "generator_loss",
                optional(adversarial.map(|adversarial| adversarial.generator_loss), 6),
            ),
            ("sigma_min", optional(sigma(0), 5)),
            ("sigma_mean", optional(sigma(1), 5)),
            ("sigma_max", optional(sigma(2), 5)),
            ("pixel_std", of_likeness(|likeness| likeness.pixel_std)),
            (
                "pixel_std_real",
                of_likeness(|likeness| likeness.pixel_std_real),
            ),
            (
                "pixel_std_component",
                of_likeness(|likeness| likeness.pixel_std_component),
            ),
            (
                "feature_distance",
                of_likeness(|likeness| likeness.feature_distance),
            ),
            ("seconds", optional(Some(self.seconds), 1)),
        ]
    }
}

/// The first line of `metrics.csv`.
fn columns() -> String {
    Row::default().cells("").map(|(column, _)| column).join(",")
}

/// Checks that an existing file has the columns of this version, because its rows and new ones would
/// otherwise mix different columns.
fn check_columns(text: &str, path: &Path) -> anyhow::Result<()> {
    let (found, expected) = (text.lines().next().unwrap_or_default(), columns());
    ensure!(
        found == expected,
        "{}:1: columns {found:?} of another version, expected {expected:?}: take a new directory",
        path.display()
    );
    Ok(())
}

/// The stages of a run, in the order they ran.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct History {
    /// The stages, each once.
    pub stages: Vec<Stage>,
}

/// A stage of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Stage {
    /// The stage's name, such as `ustgan`.
    pub name: String,
    /// The stage's rows, each a map from column to value.
    pub rows: Vec<BTreeMap<String, f64>>,
}

impl History {
    /// Reads a run's `metrics.csv`. A run without the file has no stages.
    ///
    /// # Errors
    ///
    /// Returns an error if the file exists but cannot be read.
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

    /// Seconds of all stages, summed over restarts.
    pub fn seconds(&self) -> f64 {
        self.stages.iter().map(Stage::seconds).sum()
    }
}

impl Stage {
    /// Steps done.
    pub fn steps(&self) -> u64 {
        self.last("step") as u64
    }

    /// Seconds taken, summed over restarts.
    pub fn seconds(&self) -> f64 {
        self.last("seconds")
    }

    /// A column's last value. 0 if it has none.
    fn last(&self, column: &str) -> f64 {
        let values = self.rows.iter().rev().filter_map(|row| row.get(column));
        values.copied().next().unwrap_or(0.0)
    }

    /// A column's values over the steps, where it has any.
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

    #[test]
    fn a_row_stands_under_its_columns() {
        let mut row = Row {
            step: 10,
            loss: 1.5,
            accuracy: Some(0.5),
            ..Row::default()
        };
        row.adversarial = Some(Adversarial {
            generator_loss: 0.25,
            sigma: [0.1, 0.2, 0.3],
            likeness: Some(Likeness {
                pixel_std: 1.0,
                pixel_std_real: 2.0,
                pixel_std_component: 3.0,
                feature_distance: 4.0,
            }),
        });
        let run = tempfile::tempdir().unwrap();
        let file = MetricsFile::of(run.path());
        file.open("ustgan", 0).unwrap().add(&row).unwrap();
        let history = History::parse(&file.read().unwrap());
        let stage = &history.stages[0];
        assert_eq!(stage.name, "ustgan");
        let expected = [
            ("step", 10.0),
            ("accuracy", 0.5),
            ("sigma_max", 0.3),
            ("pixel_std_component", 3.0),
            ("feature_distance", 4.0),
        ];
        for (column, value) in expected {
            assert_eq!(stage.rows[0].get(column), Some(&value), "{column}");
        }
    }

    #[test]
    fn columns_of_another_version_are_refused() {
        let path = Path::new("r/metrics.csv");
        assert!(check_columns(&columns(), path).is_ok());
        let error = check_columns("stage,step,seconds\n", path).unwrap_err();
        assert!(error.to_string().contains("r/metrics.csv:1"), "{error}");
    }
}
