//! Continues to train an exported HRN on a few presses of another sensor.
//!
//! In: the network of a model file, and samples. Out: the network whose weights lie part of the way
//! to what the samples teach, with statistics over these samples.

use crate::learn::epochs::LEARNT_SHARE;
use crate::learn::fit::{self, Task, Trained};
use crate::learn::force::{self, Label};
use crate::net::hrn::ExportedHrn;
use crate::run::Run;

/// The factor of the forces that the labels of the training samples make most probable. The task's
/// scale does not count.
///
/// # Errors
///
/// Fails as [`force::factor`] does; judging samples with HRN adds no error of its own.
pub fn force_factor(start: &ExportedHrn, task: &Task) -> anyhow::Result<f32> {
    let samples = || task.train.iter().map(|&index| &task.dataset.samples[index]);
    let levels = samples().map(|sample| sample.level);
    let labels: Vec<Label> = levels
        .zip(task.dataset.object_numbers(task.train))
        .collect();
    let known = Trained {
        weights: start.weights.clone(),
        statistics: start.statistics.clone(),
        temperature: start.temperature,
    };
    force::factor(&labels, start.temperature, task.device, |factor| {
        let scale = start.scale.of_newtons_times(factor);
        Ok(known.logits(samples().map(|sample| &sample.frame), scale, task.device))
    })
}

/// Trains from the start's weights. Without held-out objects its temperature stays.
///
/// # Errors
///
/// Fails if the run's directory cannot be read or written, or the training diverges.
pub fn fit(task: &Task, start: &ExportedHrn, run: &Run) -> anyhow::Result<Trained> {
    let learnt = fit::fit(task, start.weights.clone(), run)?;
    let weights = learnt.weights.between(&start.weights, LEARNT_SHARE);
    let mut trained = task.finished(weights, task.settings.epochs)?;
    trained.temperature = task
        .fitted_temperature(&trained)
        .unwrap_or(start.temperature);
    Ok(trained)
}
