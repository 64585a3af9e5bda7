//! The methods of the table, as recipes over the same parts.

use anyhow::{Context as _, ensure};
use burn::tensor::Device;

use super::dataset::Dataset;
use super::export::{self, Recogniser};
use super::features::{self, Baseline};
use super::fit::{self, Task};
use super::hrn;
use super::metrics::Evaluation;
use super::run::{Description, Run};
use crate::frame::Frame;
use crate::simulator::Split;

/// A row of the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Method {
    /// HRN from random weights on all labelled samples: 10,000 in the paper.
    Hrn100,
    /// Logistic regression on hand-made features of a frame.
    Features,
}

impl Method {
    /// Its name in commands, files and tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Hrn100 => "hrn100",
            Self::Features => "features",
        }
    }
}

/// Runs a method to its model and evaluation in the run's directory; takes up whatever is there.
/// Gives the evaluation on the test split, if the data has one.
///
/// # Errors
///
/// If the data has no labelled training samples, or the directory cannot be read or written.
pub fn train(
    method: Method,
    dataset: &Dataset,
    description: &Description,
    run: &Run,
    device: &Device,
) -> anyhow::Result<Option<Evaluation>> {
    let labelled = dataset.labelled(Split::Train)?;
    let labelled = match description.labels {
        Some(labels) => {
            let least = super::dataset::levels().len() * dataset.sources.len();
            ensure!(
                (least..=labelled.len()).contains(&labels),
                "{labels} labels asked for: the data has {}, and one of each level and file is \
                 needed",
                labelled.len()
            );
            dataset.choose_labelled(&labelled, labels, description.seed)
        }
        None => labelled,
    };
    match method {
        Method::Hrn100 => supervised(dataset, &labelled, description, run, device),
        Method::Features => baseline(dataset, &labelled, description, run),
    }
}

/// HRN from random weights.
fn supervised(
    dataset: &Dataset,
    labelled: &[usize],
    description: &Description,
    run: &Run,
    device: &Device,
) -> anyhow::Result<Option<Evaluation>> {
    let settings = &description.settings;
    let (train, validation) =
        dataset.hold_out(labelled, settings.validation.share, description.seed);
    let levels = super::dataset::levels().len();
    let task = Task {
        stage: "hrn",
        dataset,
        train: &train,
        validation: &validation,
        levels,
        settings,
        seed: description.seed,
        device,
    };
    let trained = fit::fit(&task, hrn::initial(levels, description.seed, device), run)?;
    let (graph, raw_logits) =
        hrn::graph(&trained.weights, &trained.statistics, settings.full_scale_n);
    let recogniser = Recogniser {
        graph,
        raw_logits,
        temperature: trained.temperature,
    };
    let probabilities = |frames: &[&Frame]| {
        let logits = trained.logits(frames.iter().copied(), settings.full_scale_n, device);
        Ok(fit::probabilities(&logits, trained.temperature, device))
    };
    export::finish(
        run,
        description,
        dataset,
        &train,
        &recogniser,
        probabilities,
    )
}

/// Logistic regression on features.
fn baseline(
    dataset: &Dataset,
    labelled: &[usize],
    description: &Description,
    run: &Run,
) -> anyhow::Result<Option<Evaluation>> {
    let frames = labelled.iter().map(|&index| &dataset.samples[index].frame);
    let rows = features::features(frames).context("features")?;
    let level_of: Vec<usize> = labelled
        .iter()
        .map(|&index| usize::from(dataset.samples[index].level) - 1)
        .collect();
    let baseline = Baseline::fit(&rows, &level_of, super::dataset::levels().len());
    let (graph, raw_logits) = baseline.graph();
    let recogniser = Recogniser {
        graph,
        raw_logits,
        temperature: 1.0,
    };
    let probabilities = |frames: &[&Frame]| {
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
