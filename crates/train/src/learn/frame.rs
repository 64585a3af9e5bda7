//! The training loop of the network that judges a frame, with Shore hardness.
//!
//! In: labelled frames, and labelled frames of held-out objects. Out: weights, and the calibration of
//! the verdicts.

use burn::tensor::{Device, Tensor};

use crate::data::augment;
use crate::data::dataset::Dataset;
use crate::learn::conformal::{Calibration, Judged};
use crate::learn::epochs::{self, Batch};
use crate::learn::learner::Learner;
use crate::net::frame;
use crate::net::frames::{FEATURES, Features};
use crate::net::hrn;
use crate::net::network::{Weights, numbers};
use crate::net::shore;
use crate::net::standard::Standard;
use crate::run::Run;
use crate::run::checkpoint::Origin;
use crate::run::progress::ensure_finite;
use crate::settings::Training;
use hardnessd_core::verdict::{ModelFrame, argmax};
use hardnessd_simulator::random::Stream;

/// How far the weights of levels with few samples are raised towards equal levels, unless the
/// settings say otherwise: 1, wholly. Evenly spread Shore hardness gives few samples of the narrow
/// levels, and a network that weighs samples alike hardly ever names those levels.
pub const LEVEL_BALANCE: f64 = 1.0;
/// Frames per pass without gradients.
const JUDGED_AT_ONCE: usize = 250;

/// The inputs of a training.
#[derive(Debug)]
pub struct Task<'a> {
    /// Name of the stage.
    pub stage: &'static str,
    /// The data set that the indices below refer to.
    pub dataset: &'a Dataset,
    /// Labelled samples to learn from.
    pub train: &'a [usize],
    /// Labelled samples of held-out objects; may be empty.
    pub held_out: &'a [usize],
    /// The number of hardness levels.
    pub levels: usize,
    /// Settings of the training.
    pub settings: &'a Training,
    /// The seed of everything random.
    pub seed: u64,
    /// The device that computes.
    pub device: &'a Device,
}

/// A trained network.
#[derive(Debug)]
pub struct Trained {
    /// Weights of all layers.
    pub weights: Weights,
    /// Mean and deviation of the features.
    pub standard: Standard,
    /// The calibration of the verdicts.
    pub calibration: Calibration,
}

impl Trained {
    /// Logits, before temperature, and Shore OO (value, low, high) of frames.
    ///
    /// # Errors
    ///
    /// Fails if features cannot be computed.
    pub fn judge(
        &self,
        frames: &[ModelFrame],
        plan: &Features,
        levels: usize,
        device: &Device,
    ) -> anyhow::Result<Vec<(Vec<f32>, [f32; 3])>> {
        let mut judged = Vec::with_capacity(frames.len());
        for part in frames.chunks(JUDGED_AT_ONCE) {
            let batch = frame::Batch::new(part, plan, &self.standard, device)?;
            let outputs = frame::outputs(&self.weights, &batch);
            judged.extend(shore::of_outputs(&outputs, levels, self.calibration.widths));
        }
        Ok(judged)
    }
}

/// Trains from random weights, or continues from the stage's last checkpoint in `run`.
///
/// # Errors
///
/// Fails if the run's directory cannot be read or written, its checkpoint is of another stage than
/// this, features cannot be computed, or the loss or a weight is no longer finite.
pub fn fit(task: &Task, run: &Run) -> anyhow::Result<Trained> {
    let plan = Features::new()?;
    let rows = plan.of(&task.frames(task.train))?;
    let standard = Standard::of(FEATURES, rows.chunks(FEATURES));
    let initial = frame::initial(task.levels, task.seed, task.device);
    let stage = epochs::Stage {
        name: task.stage,
        origin: Origin::new(task.stage, task.settings, task.seed)
            .samples(task.dataset, task.train)
            .samples(task.dataset, task.held_out)
            .numbers(task.shore())
            .numbers(standard.numbers())
            .weights(&initial)
            .finish(),
        generated: false,
        train: task.train,
        settings: task.settings,
        seed: task.seed,
    };
    let level_of = |&sample: &usize| task.dataset.samples[sample].level;
    let level_weights = hrn::level_weights(
        task.train.iter().map(level_of),
        task.levels,
        task.settings.level_balance.unwrap_or(LEVEL_BALANCE) as f32,
        task.device,
    );
    let weights = epochs::run(&stage, initial, run, task.device, None, |learner, batch| {
        task.step(learner, &plan, (&standard, &level_weights), batch)
    })?;
    let trained = Trained {
        calibration: task.calibration(&weights, &standard, &plan)?,
        weights,
        standard,
    };
    // Finite weights can still give a logit that is not. One frame is enough for this check.
    let first = trained.judge(
        &task.frames(&task.train[..1]),
        &plan,
        task.levels,
        task.device,
    )?;
    for &logit in first.iter().flat_map(|(logits, _)| logits) {
        ensure_finite(task.stage, task.settings.epochs, "logit", logit.into())?;
    }
    Ok(trained)
}

impl Task<'_> {
    /// The measured Shore hardness of the training samples; NaN where there is none.
    fn shore(&self) -> impl Iterator<Item = f32> {
        let samples = self
            .train
            .iter()
            .map(|&sample| &self.dataset.samples[sample]);
        samples.map(|sample| sample.shore.unwrap_or(f32::NAN))
    }

    fn stream(&self, name: &str) -> Stream {
        Stream::new(self.seed, &format!("{} {name}", self.stage))
    }

    fn frames(&self, samples: &[usize]) -> Vec<ModelFrame> {
        let frame = |&sample: &usize| self.dataset.samples[sample].frame;
        samples.iter().map(frame).collect()
    }

    /// The frames of `samples`, each augmented as the settings say.
    fn varied(&self, samples: &[usize], stream: &mut Stream) -> Vec<ModelFrame> {
        let vary = |frame| augment::vary(&frame, self.settings.augmentation, stream);
        self.frames(samples).into_iter().map(vary).collect()
    }

    /// Takes a step. Returns the batch's mean loss, and how many of its samples were judged
    /// correctly before the step.
    fn step(
        &self,
        learner: &mut Learner,
        plan: &Features,
        (standard, weights): (&Standard, &Tensor<2>),
        batch: Batch,
    ) -> anyhow::Result<(f64, f64)> {
        let of = |frames: &[ModelFrame]| frame::Batch::new(frames, plan, standard, self.device);
        let mut stream = self.stream("augmentation").child(batch.step);
        let images = of(&self.varied(batch.samples, &mut stream))?;
        let level_of = |&sample: &usize| self.dataset.samples[sample].level;
        let targets = hrn::targets(batch.samples.iter().map(level_of), self.levels, self.device)
            .mul(weights.clone());
        let shore_of = |&sample: &usize| self.dataset.samples[sample].shore;
        let measured: Vec<Option<f32>> = batch.samples.iter().map(shore_of).collect();

        let tracked = learner.weights.tracked();
        let outputs = frame::outputs(&tracked, &images);
        let (loss, judged) = shore::loss(outputs, targets, &measured);
        let mut gradients = loss.backward();
        learner.step(&tracked, &mut gradients, batch.rate);
        let right = batch.samples.iter().zip(judged.chunks(self.levels));
        let right =
            right.filter(|(sample, logits)| argmax(logits).0 + 1 == usize::from(level_of(sample)));
        Ok((f64::from(numbers(&loss)[0]), right.count() as f64))
    }

    /// Calibrates on the frames of held-out objects, augmented like the training frames.
    fn calibration(
        &self,
        weights: &Weights,
        standard: &Standard,
        plan: &Features,
    ) -> anyhow::Result<Calibration> {
        let trained = Trained {
            weights: weights.clone(),
            standard: standard.clone(),
            calibration: Calibration::NONE,
        };
        let mut stream = self.stream("calibration");
        let frames = self.varied(self.held_out, &mut stream);
        let judged = trained.judge(&frames, plan, self.levels, self.device)?;
        let samples = self
            .held_out
            .iter()
            .map(|&sample| &self.dataset.samples[sample]);
        let objects = self.dataset.object_numbers(self.held_out);
        let rows = samples.zip(objects).zip(judged);
        let judged: Vec<Judged> = rows
            .map(|((sample, object), (logits, stated))| Judged {
                object,
                level: usize::from(sample.level) - 1,
                shore: sample.shore,
                logits,
                stated,
            })
            .collect();
        Ok(Calibration::of(&judged, &mut stream, self.device))
    }
}
