//! Generator and discriminator: USTGAN, the STGANs, SGAN and IGAN.
//!
//! In: real frames, the game (see [`crate::net::losses`]) and the initial weights of both
//! sides. Out: both sides' trained weights. USTGAN and an STGAN differ only in their frames and
//! starting weights. SGAN and IGAN also use labelled frames, and their discriminator becomes the
//! recogniser.

use burn::tensor::{Device, Tensor};

use super::hrn::{Frames, Hrn};
use super::learner::Learner;
use super::{Learning, Plan, Question, Taken};
use crate::data::presses::Presses;
use crate::net::generator;
use crate::net::graph::Graph;
use crate::net::hrn;
use crate::net::image::PixelScale;
use crate::net::losses::{self, Game, Judged};
use crate::net::network::{self, FEATURES, Normalisation, Weights, numbers};
use crate::net::sensed::Sensor;
use crate::settings::{Augmentation, Training};
use hardnessd_core::verdict::ModelFrame;
use hardnessd_simulator::random::Stream;

/// Lambda of Eq. (7), which weighs the penalty's mean over all of sigma.
const SIGMA_PENALTY: f64 = 0.1;

/// Generator and discriminator before training, in this order. The game determines the discriminator's
/// head.
pub fn initial(game: Game, levels: usize, seed: u64, device: &Device) -> [Weights; 2] {
    let stream = Stream::new(seed, "discriminator weights");
    let mut discriminator = Weights::default();
    network::add_trunk(&mut discriminator, &stream, device);
    let dims = [FEATURES, game.outputs(levels)];
    network::add_head(&mut discriminator, dims, &stream, device);
    [generator::initial(seed, device), discriminator]
}

/// A GAN, and what it learns from.
#[derive(Debug)]
pub struct Gan<'a> {
    /// The stage.
    pub on: Frames<'a>,
    /// The classes that the discriminator distinguishes, and the losses.
    pub game: Game,
    /// Real samples, used without their levels.
    pub real: &'a [usize],
    /// Samples whose levels the discriminator learns; empty where the game has no levels.
    pub labelled: &'a [usize],
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

/// The sensor that measured the frames of these presses.
pub fn sensor(presses: &Presses, places: &[usize]) -> Sensor {
    let frames: Vec<ModelFrame> = places.iter().map(|&press| presses.frame(press)).collect();
    Sensor::of(&frames.iter().collect::<Vec<_>>())
}

impl Gan<'_> {
    /// The labelled samples of step `step`. They are fewer than the real ones, so they repeat in passes of
    /// their own.
    fn labelled(&self, step: u64) -> Option<(Tensor<4>, Tensor<2>)> {
        let batch = self.on.training.batch;
        let batches = self.labelled.len().div_ceil(batch) as u64;
        let pass = step.checked_div(batches)?;
        let mut order = self.labelled.to_vec();
        { self.on.stream("labelled order").child(pass) }.shuffle(&mut order);
        let places = order.chunks(batch).nth((step % batches) as usize)?;
        Some((self.on.images(places), self.on.targets(places)))
    }

    /// The discriminator as a recogniser of the levels. The statistics of its layers are those of all real
    /// frames that it has seen, in batches of the same size and without augmentation, as in its training.
    fn recogniser(&self, weights: &[Weights]) -> (Hrn<'_>, [Weights; 1]) {
        let hrn = Hrn {
            on: self.on,
            augmentation: Augmentation::default(),
            train: [self.real, self.labelled].concat(),
            held_out: &[],
            initial: Weights::default(),
        };
        let levels = hrn::of_levels(&weights[1], self.on.levels, self.on.device);
        (hrn, [levels])
    }
}

impl Learning for Gan<'_> {
    fn stage(&self) -> &'static str {
        self.on.stage
    }

    fn plan(&self) -> Plan {
        let [generator, discriminator] = self.initial.clone();
        let training = self.on.training;
        // The average is of the discriminator alone.
        let of_generator = Training {
            averaging: 0.0,
            ..training
        };
        Plan {
            sides: vec![
                Learner::fresh(generator, of_generator),
                Learner::fresh(discriminator, training),
            ],
            samples: self.real.to_vec(),
            held_out: Vec::new(),
            batch: training.batch,
            training,
            seed: self.on.seed,
        }
    }

    fn step(&self, sides: &mut [Learner], samples: &[usize], step: u64, rate: f64) -> Taken {
        let mut stream = self.on.stream("noise").child(step);
        let batch = Batch {
            real: self.on.images(samples),
            labelled: self.labelled(step),
            eta: generator::noise(generator::SAMPLES_A_COMPONENT, &mut stream, self.on.device),
            sensing: Some((self.sensor, self.on.scale)),
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
        let (hrn, weights) = self.recogniser(weights);
        hrn.judge(&weights, questions, vary)
    }

    fn graph(&self, weights: &[Weights]) -> Graph {
        let (hrn, weights) = self.recogniser(weights);
        hrn.graph(&weights)
    }
}
