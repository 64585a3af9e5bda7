//! A run's `metrics.csv`, written with a row per epoch.
//!
//! All stages have the same columns. A cell is empty if the stage does not have the value.

use std::fs::File;
use std::io::Write as _;
use std::path::Path;

use anyhow::Context as _;

use super::checkpoint::Checkpoint;
use super::disk::{read_if_there, write_whole};

/// The columns of the file.
const COLUMNS: &str = "stage,step,epoch,loss,learning_rate,accuracy,validation_loss,validation_accuracy,\
                       generator_loss,seconds";

/// `metrics.csv`, open for one stage.
#[derive(Debug)]
pub struct Metrics {
    file: File,
    stage: String,
}

/// What a step says of itself, or an epoch as the mean of its steps.
#[derive(Debug, Clone, Copy, Default)]
pub struct Taken {
    /// The training loss; in a GAN's stage, that of the discriminator.
    pub loss: f64,
    /// The loss of a GAN's generator.
    pub generator_loss: Option<f64>,
    /// The share of the samples judged rightly, each before the step that learnt from it. Only a recogniser's
    /// stage has it.
    pub accuracy: Option<f64>,
}

impl Taken {
    /// Adds the figures of a step that is this share of an epoch.
    pub fn add(&mut self, step: &Self, share: f64) {
        let sum = |sum: Option<f64>, x: Option<f64>| Some(sum.unwrap_or(0.0) + share * x?);
        self.loss += share * step.loss;
        self.generator_loss = sum(self.generator_loss, step.generator_loss);
        self.accuracy = sum(self.accuracy, step.accuracy);
    }
}

impl Metrics {
    /// Opens the file and cuts off the rows of `stage` after `step`, because a resumed run writes them
    /// again, and a row that a full disk broke off.
    ///
    /// # Errors
    ///
    /// Returns the errors of reading and writing.
    pub fn open(path: &Path, stage: &str, step: u64) -> anyhow::Result<Self> {
        let context = || path.display().to_string();
        let before = read_if_there(path)?.unwrap_or_default();
        let before = String::from_utf8(before).with_context(context)?;
        let is_kept = |row: &&str| {
            let cells: Vec<&str> = row.split(',').collect();
            let is_whole = cells.len() == COLUMNS.split(',').count();
            is_whole && (cells[0] != stage || cells[1].parse::<u64>().is_ok_and(|of| of <= step))
        };
        let rows = before.lines().skip(1).filter(is_kept);
        let rows = [COLUMNS].into_iter().chain(rows);
        let text: String = rows.flat_map(|row| [row, "\n"]).collect();
        write_whole(path, text.as_bytes())?;
        let file = File::options().append(true).open(path);
        Ok(Self {
            file: file.with_context(context)?,
            stage: stage.to_owned(),
        })
    }

    /// Adds the row of an epoch, with the learning rate of its last step, and with loss and accuracy on the
    /// held-out objects if they were judged.
    ///
    /// # Errors
    ///
    /// Returns the errors of writing.
    pub fn add(
        &mut self,
        done: &Checkpoint,
        rate: f64,
        mean: &Taken,
        validation: Option<(f64, f64)>,
    ) -> anyhow::Result<()> {
        let (validation_loss, validation_accuracy) = validation.unzip();
        let optional = |x: Option<f64>| x.map_or_else(String::new, |x| format!("{x:.6}"));
        let cells = [
            self.stage.clone(),
            done.step.to_string(),
            done.epoch.to_string(),
            optional(Some(mean.loss)),
            rate.to_string(),
            optional(mean.accuracy),
            optional(validation_loss),
            optional(validation_accuracy),
            optional(mean.generator_loss),
            format!("{:.1}", done.seconds),
        ];
        // One write per row, so that a killed process leaves whole rows.
        let row = cells.join(",") + "\n";
        self.file.write_all(row.as_bytes()).context("metrics.csv")
    }
}
