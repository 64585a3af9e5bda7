//! The method `frame`: the network that judges a frame and gives its Shore hardness.

use anyhow::Context as _;
use burn::tensor::Device;

use crate::data::dataset::{self, Dataset};
use crate::learn::frame::{self, Task, Trained};
use crate::learn::temperature;
use crate::model::evaluated::Evaluated;
use crate::model::export::{self, Recogniser};
use crate::net::frame as network;
use crate::net::frames::Features;
use crate::run::{Description, Run};
use crate::stages;
use hardnessd_core::verdict::ModelFrame;

/// The samples of a run, by their use.
#[derive(Debug)]
pub struct Samples<'a> {
    /// The data set that the indices below refer to.
    pub dataset: &'a Dataset,
    /// Labelled samples to learn from.
    pub train: &'a [usize],
    /// Labelled samples of held-out objects; may be empty.
    pub held_out: &'a [usize],
}

impl Samples<'_> {
    /// Whether a training sample has a measured Shore hardness.
    fn has_shore(&self) -> bool {
        let has_shore = |&index: &usize| self.dataset.samples[index].shore.is_some();
        self.train.iter().any(has_shore)
    }
}

/// Trains, and writes the model and its evaluation to the run's directory. A resumed run continues from
/// the files there.
///
/// # Errors
///
/// Fails if the training diverges, or the directory cannot be read or written.
pub fn train(
    samples: &Samples,
    description: &Description,
    run: &Run,
    device: &Device,
) -> anyhow::Result<Option<Evaluated>> {
    let levels = dataset::levels().len();
    let settings = &description.settings;
    let task = Task {
        stage: "frame",
        dataset: samples.dataset,
        train: samples.train,
        held_out: samples.held_out,
        levels,
        settings: &settings.training,
        seed: description.seed,
        device,
    };
    let trained = frame::fit(&task, run)?;
    let missing = trained.calibration.missing_interval();
    if !samples.has_shore() {
        hardnessd_core::stderr_line!(
            "no labelled training press has a measured Shore hardness: the model does not give Shore hardness"
        );
    } else if let Some(missing) = missing {
        hardnessd_core::stderr_line!("{missing}");
    }
    finish(samples, &trained, description, run, device)
}

/// Writes the model, its evaluation and a picture of its mistakes.
fn finish(
    samples: &Samples,
    trained: &Trained,
    description: &Description,
    run: &Run,
    device: &Device,
) -> anyhow::Result<Option<Evaluated>> {
    let levels = dataset::levels().len();
    let plan = Features::new().context("features")?;
    let calibration = trained.calibration;
    let probabilities = |frames: &[&ModelFrame]| {
        let frames: Vec<ModelFrame> = frames.iter().copied().copied().collect();
        let judged = trained.judge(&frames, &plan, levels, device)?;
        let logits: Vec<Vec<f32>> = judged.into_iter().map(|(logits, _)| logits).collect();
        Ok(temperature::probabilities(
            &logits,
            calibration.temperature,
            device,
        ))
    };
    let (kind, shown) = if samples.held_out.is_empty() {
        ("training", samples.train)
    } else {
        ("held-out", samples.held_out)
    };
    let frames: Vec<&ModelFrame> = shown
        .iter()
        .map(|&index| &samples.dataset.samples[index].frame)
        .collect();
    let rows: Vec<Vec<f32>> = probabilities(&frames)?;
    stages::draw_mistakes(run, samples.dataset, (kind, shown), &rows)?;
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
        shore: samples.has_shore().then_some(shore),
        temperature: calibration.temperature,
    };
    export::finish(
        run,
        description,
        samples.dataset,
        samples.train,
        &recogniser,
        probabilities,
    )
}
