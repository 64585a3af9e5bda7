//! The method `frame`: the network that judges a frame and gives its Shore hardness.

use anyhow::Context as _;

use crate::data::dataset;
use crate::learn::frame::{self, Task, Trained};
use crate::learn::temperature;
use crate::model::evaluated::Evaluated;
use crate::model::export::Recogniser;
use crate::net::frame as network;
use crate::net::frames::Features;
use crate::stages::Stages;
use hardnessd_core::verdict::ModelFrame;

/// Whether a training sample has a measured Shore hardness.
fn has_shore(stages: &Stages) -> bool {
    let has_shore = |&index: &usize| stages.dataset.samples[index].shore.is_some();
    stages.train.iter().any(has_shore)
}

/// Trains, and writes the model and its evaluation to the run's directory. A resumed run continues from
/// the files there.
///
/// # Errors
///
/// Fails if the training diverges, or the directory cannot be read or written.
pub fn train(stages: &Stages) -> anyhow::Result<Option<Evaluated>> {
    let levels = dataset::levels().len();
    let task = Task {
        stage: "frame",
        dataset: stages.dataset,
        train: stages.train,
        held_out: stages.validation,
        levels,
        settings: &stages.description.settings.training,
        seed: stages.description.seed,
        device: stages.device,
    };
    let trained = frame::fit(&task, stages.run)?;
    let missing = trained.calibration.missing_interval();
    if !has_shore(stages) {
        hardnessd_core::stderr_line!(
            "no labelled training press has a measured Shore hardness: the model does not give Shore hardness"
        );
    } else if let Some(missing) = missing {
        hardnessd_core::stderr_line!("{missing}");
    }
    finish(stages, &trained)
}

/// Writes the model, its evaluation and a picture of its mistakes.
fn finish(stages: &Stages, trained: &Trained) -> anyhow::Result<Option<Evaluated>> {
    let levels = dataset::levels().len();
    let plan = Features::new().context("features")?;
    let calibration = trained.calibration;
    let (graph, raw_logits, shore) = network::graph(
        &trained.weights,
        &trained.standard,
        levels,
        calibration.widths,
    );
    // Leave the Shore output out if no training sample has a measured hardness: the second head then
    // learnt nothing.
    let recogniser = Recogniser {
        graph,
        raw_logits,
        shore: has_shore(stages).then_some(shore),
        temperature: calibration.temperature,
    };
    stages.export(&recogniser, |frames| {
        let frames: Vec<ModelFrame> = frames.iter().copied().copied().collect();
        let judged = trained.judge(&frames, &plan, levels, stages.device)?;
        let logits: Vec<Vec<f32>> = judged.into_iter().map(|(logits, _)| logits).collect();
        Ok(temperature::probabilities(
            &logits,
            calibration.temperature,
            stages.device,
        ))
    })
}
