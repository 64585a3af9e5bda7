//! The method `features`: logistic regression on hand-made features of a frame.

use std::time::Instant;

use anyhow::Context as _;

use crate::data::dataset;
use crate::judge::baseline::Baseline;
use crate::judge::features;
use crate::model::evaluated::Evaluated;
use crate::model::export::Recogniser;
use crate::run::history::Row;
use crate::stages::Stages;

/// Fits the regression and writes the model and its evaluation to the run's directory.
///
/// # Errors
///
/// Fails if features cannot be computed, or the directory cannot be written.
pub fn train(stages: &Stages) -> anyhow::Result<Option<Evaluated>> {
    let begun = Instant::now();
    let samples = stages
        .train
        .iter()
        .map(|&index| &stages.dataset.samples[index]);
    let frames = samples.clone().map(|sample| &sample.frame);
    let rows = features::features(frames).context("features")?;
    let level_of: Vec<usize> = samples
        .map(|sample| usize::from(sample.level) - 1)
        .collect();
    let baseline = Baseline::fit(&rows, &level_of, dataset::levels().len());
    stages.run.metrics.open("features", 0)?.add(&Row {
        step: baseline.steps.into(),
        epoch: baseline.steps,
        loss: baseline.loss,
        learning_rate: 1.0,
        accuracy: None,
        validation: None,
        seconds: begun.elapsed().as_secs_f64(),
        adversarial: None,
    })?;
    let (graph, raw_logits) = baseline.graph();
    let recogniser = Recogniser {
        graph,
        raw_logits,
        shore: None,
        temperature: 1.0,
    };
    stages.export(&recogniser, |frames| {
        let rows = features::features(frames.iter().copied())?;
        Ok(rows.iter().map(|row| baseline.probabilities(row)).collect())
    })
}
