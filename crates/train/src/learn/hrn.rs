//! The paper's recogniser: Eq. (9) minimised over labelled frames.

use burn::tensor::{Device, Tensor};

use super::learner::Learner;
use super::{Batch, Inputs, Learning, Origin, Outputs, Question, Recogniser, Side, Taken};
use crate::data::augment;
use crate::data::presses::Presses;
use crate::net::hrn;
use crate::net::image::PixelScale;
use crate::net::network::{Normalisation, Statistics, Weights, numbers};
use crate::run::checkpoint;
use crate::settings::Training;
use hardnessd_core::verdict::{ModelFrame, argmax};
use hardnessd_simulator::random::Stream;

/// Frames per pass without gradients.
const JUDGED_AT_ONCE: usize = 250;

/// HRN, and what it learns from.
#[derive(Debug)]
pub struct Hrn<'a> {
    /// The name of the stage.
    pub stage: &'static str,
    /// The presses that the indices below refer to.
    pub presses: &'a Presses,
    /// Whether a GAN generated them.
    pub is_generated: bool,
    /// Labelled presses to learn from.
    pub train: &'a [usize],
    /// Labelled presses of held-out objects; may be empty.
    pub held_out: &'a [usize],
    /// The first weights.
    pub initial: Weights,
    /// The number of hardness levels.
    pub levels: usize,
    /// The scale from newtons to images.
    pub scale: PixelScale,
    /// Settings of the training.
    pub settings: &'a Training,
    /// The number of epochs between two judgements of the held-out objects.
    pub validated_every_epochs: u32,
    /// Seed of the order of the samples and of their augmentation.
    pub seed: u64,
    /// The device that computes.
    pub device: &'a Device,
}

/// Takes a step of HRN on images `[batch, 1, 28, 28]` and targets `[batch, L]`. Returns the mean
/// loss and the logits before the step, row by row.
pub fn step(
    hrn: &mut Learner,
    images: Tensor<4>,
    targets: Tensor<2>,
    rate: f64,
) -> (f64, Vec<f32>) {
    let tracked = hrn.weights.tracked();
    let logits = hrn::logits(&tracked, images, &mut Normalisation::Batch);
    let judged = numbers(&logits);
    let loss = hrn::cross_entropy(logits, targets);
    let mut gradients = loss.backward();
    hrn.step(&tracked, &mut gradients, rate);
    (f64::from(numbers(&loss)[0]), judged)
}

impl Hrn<'_> {
    fn stream(&self, name: &str) -> Stream {
        Stream::new(self.seed, &format!("{} {name}", self.stage))
    }

    /// The frames of presses, each augmented as the settings say.
    fn varied(&self, presses: &[usize], stream: &mut Stream) -> Vec<ModelFrame> {
        let vary = |&press: &usize| {
            let frame = self.presses.frame(press);
            augment::vary(&frame, self.settings.augmentation, stream)
        };
        presses.iter().map(vary).collect()
    }

    /// Images of one batch, augmented for step `step`.
    fn images(&self, presses: &[usize], step: u64) -> Tensor<4> {
        let frames = self.varied(presses, &mut self.stream("augmentation").child(step));
        self.scale.images(frames.iter(), self.device)
    }

    /// Statistics of the normalised layers over the training presses, augmented as the settings
    /// say, in batches of their size. A smaller remainder is left out.
    fn statistics(&self, weights: &Weights) -> Statistics {
        let mut statistics = Statistics::default();
        let mut order = self.train.to_vec();
        self.stream("statistics").shuffle(&mut order);
        let batch = self.settings.batch.min(order.len());
        for (presses, number) in order.chunks_exact(batch).zip(0..) {
            // Training steps count from 0 and these batches from the maximum down, so none share a
            // sub-stream.
            let images = self.images(presses, u64::MAX - number);
            let mut normalisation = Normalisation::Collect(&mut statistics);
            hrn::logits(weights, images, &mut normalisation);
        }
        statistics
    }
}

impl Learning for Hrn<'_> {
    fn stage(&self) -> &'static str {
        self.stage
    }

    fn origin(&self) -> Origin<'_> {
        let Training {
            batch,
            epochs,
            optimiser,
            averaging,
            checkpoint_every_epochs,
            ..
        } = *self.settings;
        let hash = checkpoint::Origin::new(self.stage, &(self.settings, self.scale), self.seed)
            .presses(self.presses, self.train)
            .weights(&self.initial)
            .finish();
        Origin {
            hash,
            is_generated: self.is_generated,
            sides: vec![Side {
                prefix: "",
                weights: self.initial.clone(),
                averaging,
            }],
            samples: self.train.to_vec(),
            held_out: self.held_out,
            batch,
            epochs,
            optimiser,
            checkpoint_every_epochs,
            validated_every_epochs: self.validated_every_epochs,
            seed: self.seed,
        }
    }

    fn step(&self, sides: &mut [Learner], batch: Batch) -> anyhow::Result<Taken> {
        let images = self.images(batch.samples, batch.step);
        let levels = self.presses.of(batch.samples).map(|press| press.level);
        let targets = hrn::targets(levels.clone(), self.levels, self.device);
        let (loss, judged) = step(&mut sides[0], images, targets, batch.rate);
        let right = levels
            .zip(judged.chunks(self.levels))
            .filter(|(level, logits)| argmax(logits).0 + 1 == usize::from(*level))
            .count();
        Ok(Taken {
            loss,
            right: Some(right as f64),
            ..Taken::default()
        })
    }

    fn judge(
        &self,
        weights: &[Weights],
        questions: &[Question],
        mut vary: Option<&mut Stream>,
    ) -> Vec<Vec<f32>> {
        let statistics = self.statistics(&weights[0]);
        let presses: Vec<usize> = questions.iter().flat_map(|q| &q.presses).copied().collect();
        let mut rows = Vec::with_capacity(presses.len());
        for part in presses.chunks(JUDGED_AT_ONCE) {
            let frames: Vec<ModelFrame> = match vary.as_deref_mut() {
                Some(stream) => self.varied(part, stream),
                None => part
                    .iter()
                    .map(|&press| self.presses.frame(press))
                    .collect(),
            };
            let images = self.scale.images(frames.iter(), self.device);
            let mut normalisation = Normalisation::Fixed(&statistics);
            let logits = hrn::logits(&weights[0], images, &mut normalisation);
            rows.extend(numbers(&logits).chunks(self.levels).map(<[f32]>::to_vec));
        }
        rows
    }

    fn outputs(&self) -> Outputs {
        Outputs::Levels
    }

    fn graph(&self, weights: &[Weights]) -> Recogniser {
        let statistics = self.statistics(&weights[0]);
        let (graph, raw) = hrn::graph(&weights[0], &statistics, self.scale);
        Recogniser {
            graph,
            inputs: Inputs::Frame,
            raw,
        }
    }
}
