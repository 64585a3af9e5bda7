//! A run's `metrics.csv`, written with a row per epoch, and read again for the run's cost.
//!
//! All stages have the same columns. A cell is empty if the stage does not have the value.

use std::fs::File;
use std::io::{ErrorKind, Write as _};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, ensure};

use super::disk::write_whole;

/// A run's `metrics.csv`.
#[derive(Debug)]
pub struct MetricsFile {
    path: PathBuf,
}

impl MetricsFile {
    /// The file of the run in a directory.
    pub fn of(run: &Path) -> Self {
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
    pub fn open(&self, stage: &str, step: u64) -> anyhow::Result<Metrics> {
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
            if cells[0] == stage {
                seconds_before = seconds(&cells).unwrap_or(seconds_before);
            }
        }
        write_whole(&self.path, text.as_bytes())?;
        let file = File::options().append(true).open(&self.path);
        Ok(Metrics {
            file: file.with_context(|| self.path.display().to_string())?,
            stage: stage.to_owned(),
            seconds_before,
        })
    }

    /// The text so far. Empty if the file does not exist yet.
    fn read(&self) -> anyhow::Result<String> {
        match std::fs::read_to_string(&self.path) {
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(String::new()),
            Err(error) => Err(error).with_context(|| self.path.display().to_string()),
            Ok(text) if text.is_empty() => Ok(text),
            Ok(text) => check_columns(&text, &self.path).map(|()| text),
        }
    }

    /// The steps and the seconds of all stages, over all restarts.
    ///
    /// # Errors
    ///
    /// Returns an error if the file exists but cannot be read.
    pub fn cost(&self) -> anyhow::Result<(u64, f64)> {
        let text = self.read()?;
        // The last row of each stage counts.
        let mut stages: Vec<(&str, u64, f64)> = Vec::new();
        for row in text.lines().skip(1) {
            let cells: Vec<&str> = row.split(',').collect();
            let step = cells.get(1).and_then(|cell| cell.parse().ok());
            let own = (cells[0], step.unwrap_or(0), seconds(&cells).unwrap_or(0.0));
            match stages.iter_mut().find(|stage| stage.0 == own.0) {
                Some(stage) => *stage = own,
                None => stages.push(own),
            }
        }
        let steps = stages.iter().map(|stage| stage.1).sum();
        Ok((steps, stages.iter().map(|stage| stage.2).sum()))
    }
}

fn seconds(cells: &[&str]) -> Option<f64> {
    cells.last()?.parse().ok()
}

/// `metrics.csv`, open for one stage.
#[derive(Debug)]
pub struct Metrics {
    file: File,
    stage: String,
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
    /// Loss and accuracy on the held-out objects, in epochs that judged them.
    pub validation: Option<(f64, f64)>,
    /// Mean loss of the generator.
    pub generator_loss: Option<f64>,
    /// Least, mean and greatest deviation sigma of the generator's mixture.
    pub sigma: Option<[f64; 3]>,
    /// Seconds since this process took up the stage. The file has the sum over processes. It does
    /// not include what a killed process did after its last checkpoint, which is done again.
    pub seconds: f64,
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
        let cells = row.cells(&self.stage).map(|(_, cell)| cell);
        // One write per row, so that a killed process leaves whole rows.
        self.file
            .write_all((cells.join(",") + "\n").as_bytes())
            .context("metrics.csv")
    }
}

impl Row {
    /// The columns and their cells.
    fn cells(&self, stage: &str) -> [(&'static str, String); 13] {
        let optional = |value: Option<f64>, digits: usize| {
            value.map_or_else(String::new, |value| format!("{value:.digits$}"))
        };
        let (loss, share) = self.validation.unzip();
        let sigma = |which: usize| optional(self.sigma.map(|sigma| sigma[which]), 5);
        [
            ("stage", stage.to_owned()),
            ("step", self.step.to_string()),
            ("epoch", self.epoch.to_string()),
            ("loss", optional(Some(self.loss), 6)),
            ("learning_rate", self.learning_rate.to_string()),
            ("accuracy", optional(self.accuracy, 4)),
            ("validation_loss", optional(loss, 6)),
            ("validation_accuracy", optional(share, 4)),
            ("generator_loss", optional(self.generator_loss, 6)),
            ("sigma_min", sigma(0)),
            ("sigma_mean", sigma(1)),
            ("sigma_max", sigma(2)),
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_runs_price_is_the_sum_over_its_stages() {
        let run = tempfile::tempdir().unwrap();
        let file = MetricsFile::of(run.path());
        assert_eq!(file.cost().unwrap(), (0, 0.0));
        for (stage, step, seconds) in [
            ("pretraining", 10, 2.0),
            ("pretraining", 20, 4.0),
            ("training", 5, 0.5),
            ("training", 10, 1.5),
        ] {
            let row = Row {
                step,
                seconds,
                ..Row::default()
            };
            let mut metrics = file.open(stage, step).unwrap();
            metrics.seconds_before = 0.0;
            metrics.add(&row).unwrap();
        }
        assert_eq!(file.cost().unwrap(), (30, 5.5));
    }
}
