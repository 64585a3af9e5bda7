//! Generator and discriminator: USTGAN, the STGANs, SGAN and IGAN.
//!
//! In: real frames, the game (see [`crate::net::losses`]) and the initial weights of both
//! sides. Out: both sides' trained weights. USTGAN and an STGAN differ only in their frames and
//! starting weights. SGAN and IGAN also use labelled frames, and their discriminator becomes the
//! recogniser.

use std::slice;

use burn::tensor::{Device, Tensor};

use super::hrn::Hrn;
use super::learner::Learner;
use super::{Learning, Question, Stage, Taken};
use crate::data::split::Parts;
use crate::net::generator;
use crate::net::graph::Graph;
use crate::net::hrn;
use crate::net::image::PixelScale;
use crate::net::losses::{self, Game, Judged};
use crate::net::network::{self, FEATURES, Normalisation, Weights, numbers};
use crate::net::sensed::Sensor;
use crate::settings::{Augmentation, Settings, Training};
use hardnessd_core::verdict::ModelFrame;
use hardnessd_simulator::random::Stream;

/// Lambda of Eq. (7), which weighs the penalty's mean over all of sigma.
const SIGMA_PENALTY: f64 = 0.1;

/// Generator and discriminator before training, in this order. The game determines the discriminator's
/// head.
pub fn initial(game: Game, levels: usize, seed: u64, device: &Device) -> [Weights; 2] {
    let stream = Stream::new(seed, "discriminator weights");
    let mut discriminator = Weights::new(device);
    network::add_trunk(&mut discriminator, &stream);
    let dims = [FEATURES, game.outputs(levels)];
    network::add_head(&mut discriminator, dims, &stream);
    [generator::initial(seed, device), discriminator]
}

/// A GAN. Its real samples are the stage's unlabelled presses. The labelled ones, whose levels the discriminator learns,
/// are none where the game has no levels.
#[derive(Debug)]
pub struct Gan<'a> {
    /// The stage.
    pub stage: Stage<'a>,
    /// The classes that the discriminator distinguishes, and the losses.
    pub game: Game,
    /// The first weights of generator and discriminator.
    pub initial: [Weights; 2],
    /// The sensor that measured the real frames.
    pub sensor: Sensor,
}

/// The inputs of a step.
#[derive(Debug, Clone)]
pub struct Batch {
    /// Real images `[batch, 1, 28, 28]`.
    pub real: Tensor<4>,
    /// Labelled images `[batch, 1, 28, 28]` and their targets `[batch, L]`.
    pub labelled: Option<(Tensor<4>, Tensor<2>)>,
    /// The generator's noise.
    pub eta: Tensor<2>,
    /// The sensor applied to generated images before the discriminator judges them. `None` applies
    /// no sensor.
    pub sensing: Option<(Sensor, PixelScale)>,
}

/// Takes a step of the discriminator, then one of the generator. Returns the losses of both.
pub fn step(sides: &mut [Learner], game: Game, batch: &Batch, rate: f64) -> [f64; 2] {
    let [generator, discriminator] = sides else {
        unreachable!("a GAN has two sides");
    };
    // The generator does not change while the discriminator takes its step, so both steps use the
    // same images. To the discriminator they are constants.
    let making = generator.weights.tracked();
    let mut images = generator::images(&making, batch.eta.clone(), &mut Normalisation::Batch);
    if let Some((sensor, scale)) = batch.sensing {
        images = sensor.images(images, scale);
    }
    let judging = discriminator.weights.tracked();
    let labelled = batch.labelled.as_ref().map(|(images, targets)| {
        let judged = judge(&judging, images.clone());
        (judged.logits, targets.clone())
    });
    let real = judge(&judging, batch.real.clone());
    let generated = judge(&judging, images.clone().inner());
    let loss = losses::discriminator(game, real, generated, labelled);
    discriminator.step(&judging, &mut loss.backward(), rate);

    let generated = judge(&discriminator.weights, images);
    let real = || judge(&discriminator.weights, batch.real.clone());
    let penalty = losses::sigma_penalty(making.tensor("mixture.sigma")).mul_scalar(SIGMA_PENALTY);
    let sum = losses::generator(game, real, generated).add(penalty);
    generator.step(&making, &mut sum.backward(), rate);
    [loss, sum].map(|loss| f64::from(numbers(&loss)[0]))
}

/// Judges one batch. Each batch passes through the discriminator alone and is normalised by its own
/// statistics: in a mixed batch, the statistics would reveal the share of real frames.
fn judge(discriminator: &Weights, images: Tensor<4>) -> Judged {
    let features = network::trunk(discriminator, images, &mut Normalisation::Batch);
    Judged {
        logits: network::dense(discriminator, "head", features.clone()),
        features,
    }
}

impl<'a> Gan<'a> {
    /// A GAN that begins with these weights.
    pub fn new(stage: Stage<'a>, game: Game, initial: [Weights; 2]) -> Self {
        let real = stage.parts.unlabelled.iter();
        let frames: Vec<ModelFrame> = real.map(|&press| stage.presses.frame(press)).collect();
        Self {
            sensor: Sensor::of(&frames.iter().collect::<Vec<_>>()),
            stage,
            game,
            initial,
        }
    }

    /// The labelled samples of step `step`. They are fewer than the real ones, so they repeat in passes of
    /// their own.
    fn labelled(&self, step: u64) -> Option<(Tensor<4>, Tensor<2>)> {
        let batch = self.stage.training.batch;
        let labelled = &self.stage.parts.train;
        let batches = labelled.len().div_ceil(batch) as u64;
        let pass = step.checked_div(batches)?;
        let mut order = labelled.clone();
        { self.stage.stream("labelled order").child(pass) }.shuffle(&mut order);
        let places = order.chunks(batch).nth((step % batches) as usize)?;
        Some((self.stage.images(places), self.stage.targets(places)))
    }

    /// The discriminator as a recogniser of the levels. The statistics of its layers are those of all real
    /// frames that it has seen, in batches of the same size and without augmentation, as in its training.
    fn recogniser(&self, weights: &[Weights]) -> Hrn<'_> {
        let Parts {
            unlabelled, train, ..
        } = &self.stage.parts;
        let stage = Stage {
            parts: Parts::labelled([&unlabelled[..], train].concat()),
            settings: Settings {
                augmentation: Augmentation::default(),
                ..self.stage.settings
            },
            ..self.stage.clone()
        };
        Hrn {
            initial: hrn::of_levels(&weights[1], stage.levels()),
            stage,
        }
    }
}

impl Learning for Gan<'_> {
    fn stage(&self) -> &Stage<'_> {
        &self.stage
    }

    fn sides(&self) -> Vec<Learner> {
        let [generator, discriminator] = self.initial.clone();
        // The average is of the discriminator alone.
        let of_generator = Training {
            averaging: 0.0,
            ..self.stage.training
        };
        vec![
            Learner::fresh(generator, of_generator),
            Learner::fresh(discriminator, self.stage.training),
        ]
    }

    fn samples(&self) -> Vec<usize> {
        self.stage.parts.unlabelled.clone()
    }

    fn step(&self, sides: &mut [Learner], samples: &[usize], step: u64, rate: f64) -> Taken {
        let mut stream = self.stage.stream("noise").child(step);
        let batch = Batch {
            real: self.stage.images(samples),
            labelled: self.labelled(step),
            eta: generator::noise(
                generator::SAMPLES_A_COMPONENT,
                &mut stream,
                &self.stage.device,
            ),
            sensing: Some((self.sensor, self.stage.scale())),
        };
        let [loss, of_generator] = self::step(sides, self.game, &batch, rate);
        Taken {
            loss,
            generator_loss: Some(of_generator),
            accuracy: None,
        }
    }

    fn judge(
        &self,
        weights: &[Weights],
        questions: &[Question],
        vary: Option<&mut Stream>,
    ) -> Vec<Vec<f32>> {
        let hrn = self.recogniser(weights);
        hrn.judge(slice::from_ref(&hrn.initial), questions, vary)
    }

    fn graph(&self, weights: &[Weights]) -> Graph {
        let hrn = self.recogniser(weights);
        hrn.graph(slice::from_ref(&hrn.initial))
    }
}
