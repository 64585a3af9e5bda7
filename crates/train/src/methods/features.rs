//! The method `features`: logistic regression on hand-made features of a frame.

use std::time::Instant;

use anyhow::Context as _;

use crate::data::dataset::{self, Dataset};
use crate::judge::baseline::Baseline;
use crate::judge::features;
use crate::model::evaluated::Evaluated;
use crate::model::export::{self, Recogniser};
use crate::run::history::Row;
use crate::run::{Description, Run};
use crate::stages;
use hardnessd_core::verdict::ModelFrame;

/// Fits the regression and writes the model and its evaluation to the run's directory.
///
/// # Errors
///
/// Fails if features cannot be computed, or the directory cannot be written.
pub fn train(
    dataset: &Dataset,
    labelled: &[usize],
    description: &Description,
    run: &Run,
) -> anyhow::Result<Option<Evaluated>> {
    let begun = Instant::now();
    let frames = labelled.iter().map(|&index| &dataset.samples[index].frame);
    let rows = features::features(frames).context("features")?;
    let level_of: Vec<usize> = labelled
        .iter()
        .map(|&index| usize::from(dataset.samples[index].level) - 1)
        .collect();
    let baseline = Baseline::fit(&rows, &level_of, dataset::levels().len());
    run.metrics.open("features", 0)?.add(&Row {
        step: baseline.steps.into(),
        epoch: baseline.steps,
        loss: baseline.loss,
        learning_rate: 1.0,
        accuracy: None,
        validation: None,
        seconds: begun.elapsed().as_secs_f64(),
        adversarial: None,
    })?;
    let judged: Vec<Vec<f32>> = rows.iter().map(|row| baseline.probabilities(row)).collect();
    stages::draw_mistakes(run, dataset, ("training", labelled), &judged)?;
    let (graph, raw_logits) = baseline.graph();
    let recogniser = Recogniser {
        graph,
        raw_logits,
        shore: None,
        temperature: 1.0,
    };
    let probabilities = |frames: &[&ModelFrame]| {
        let rows = features::features(frames.iter().copied())?;
        Ok(rows.iter().map(|row| baseline.probabilities(row)).collect())
    };
    export::finish(
        run,
        description,
        dataset,
        labelled,
        &recogniser,
        probabilities,
    )
}
