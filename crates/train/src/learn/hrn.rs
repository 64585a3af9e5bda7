//! The paper's recogniser: Eq. (9) minimised over labelled frames.

use burn::tensor::Tensor;

use super::learner::Learner;
use super::{Learning, Question, Stage, Taken, share_right};
use crate::data::augment;
use crate::net::graph::Graph;
use crate::net::hrn;
use crate::net::image::PixelScale;
use crate::net::network::{Normalisation, Statistics, Weights, numbers, targets};
use hardnessd_core::verdict::ModelFrame;
use hardnessd_simulator::random::Stream;

/// Frames per pass without gradients.
const JUDGED_AT_ONCE: usize = 250;

impl Stage<'_> {
    /// The scale from newtons to images.
    pub fn scale(&self) -> PixelScale {
        PixelScale {
            full_scale_n: self.settings.full_scale_n,
            log_above_n: self.settings.log_above_n,
        }
    }

    /// The frames of presses as images `[batch, 1, 28, 28]`.
    pub fn images(&self, presses: &[usize]) -> Tensor<4> {
        self.changed(presses, |frame| frame)
    }

    fn changed(
        &self,
        presses: &[usize],
        mut change: impl FnMut(ModelFrame) -> ModelFrame,
    ) -> Tensor<4> {
        let frame = |&press: &usize| change(self.presses.frame(press));
        let frames: Vec<ModelFrame> = presses.iter().map(frame).collect();
        self.scale().images(frames.iter(), &self.device)
    }

    /// The levels of labelled presses as targets `[batch, L]`.
    pub fn targets(&self, presses: &[usize]) -> Tensor<2> {
        let levels = self.presses.of(presses).map(|press| press.level);
        targets(levels, self.levels(), &self.device)
    }
}

/// HRN, which learns from labelled presses.
#[derive(Debug)]
pub struct Hrn<'a> {
    /// The stage.
    pub stage: Stage<'a>,
    /// The first weights.
    pub initial: Weights,
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
    /// Images of presses, each augmented.
    fn varied(&self, presses: &[usize], stream: &mut Stream) -> Tensor<4> {
        let vary =
            |frame: ModelFrame| augment::vary(&frame, self.stage.settings.augmentation, stream);
        self.stage.changed(presses, vary)
    }

    /// Statistics of the normalised layers over the training presses, augmented as the settings
    /// say, in batches of their size. A smaller remainder is left out.
    fn statistics(&self, weights: &Weights) -> Statistics {
        let mut statistics = Statistics::default();
        let mut order = self.stage.parts.train.clone();
        self.stage.stream("statistics").shuffle(&mut order);
        let batch = self.stage.training.batch.min(order.len());
        for (presses, number) in order.chunks_exact(batch).zip(0..) {
            // Training steps count from 0 and these batches from the maximum down, so none share a
            // sub-stream.
            let mut stream = self.stage.stream("augmentation").child(u64::MAX - number);
            let images = self.varied(presses, &mut stream);
            let mut normalisation = Normalisation::Collect(&mut statistics);
            hrn::logits(weights, images, &mut normalisation);
        }
        statistics
    }
}

impl Learning for Hrn<'_> {
    fn stage(&self) -> &Stage<'_> {
        &self.stage
    }

    fn sides(&self) -> Vec<Learner> {
        vec![Learner::fresh(self.initial.clone(), self.stage.training)]
    }

    fn step(&self, sides: &mut [Learner], samples: &[usize], step: u64, rate: f64) -> Taken {
        let mut stream = self.stage.stream("augmentation").child(step);
        let images = self.varied(samples, &mut stream);
        let targets = self.stage.targets(samples);
        let (loss, judged) = self::step(&mut sides[0], images, targets, rate);
        let levels = self.stage.presses.of(samples).map(|press| press.level);
        Taken {
            loss,
            accuracy: Some(share_right(levels, judged.chunks(self.stage.levels()))),
            ..Taken::default()
        }
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
            let images = match vary.as_deref_mut() {
                Some(stream) => self.varied(part, stream),
                None => self.stage.images(part),
            };
            let mut normalisation = Normalisation::Fixed(&statistics);
            let logits = hrn::logits(&weights[0], images, &mut normalisation);
            let logits = numbers(&logits);
            rows.extend(logits.chunks(self.stage.levels()).map(<[f32]>::to_vec));
        }
        rows
    }

    fn graph(&self, weights: &[Weights]) -> Graph {
        hrn::graph(
            &weights[0],
            &self.statistics(&weights[0]),
            self.stage.scale(),
        )
    }
}
