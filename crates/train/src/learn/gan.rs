//! Generator and discriminator: USTGAN, the STGANs, SGAN and IGAN.
//!
//! In: real frames, the game (see [`crate::net::losses`]) and the initial weights of both
//! sides. Out: both sides' trained weights. USTGAN and an STGAN differ only in their frames and
//! starting weights. SGAN and IGAN also use labelled frames, and their discriminator becomes the
//! recogniser.

#[cfg(test)]
mod tests;

use burn::tensor::{Device, Tensor};

use super::hrn::Hrn;
use super::learner::Learner;
use super::{Batch, Learning, Origin, Outputs, Question, Recogniser, Side, Taken};
use crate::data::presses::Presses;
use crate::net::generator;
use crate::net::hrn;
use crate::net::image::PixelScale;
use crate::net::losses::{self, Game, Judged};
use crate::net::network::{self, FEATURES, Normalisation, Weights, numbers};
use crate::net::sensed::Sensor;
use crate::run::checkpoint;
use crate::settings::{GanSettings, Training};
use hardnessd_core::verdict::ModelFrame;
use hardnessd_simulator::random::Stream;

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
    /// The name of the stage.
    pub stage: &'static str,
    /// The classes that the discriminator distinguishes, and the losses.
    pub game: Game,
    /// The presses that the indices below refer to.
    pub presses: &'a Presses,
    /// Real samples, used without their levels.
    pub real: &'a [usize],
    /// Samples whose levels the discriminator learns; empty where the game has no levels.
    pub labelled: &'a [usize],
    /// The number of hardness levels.
    pub levels: usize,
    /// The first weights of generator and discriminator.
    pub initial: [Weights; 2],
    /// The scale from newtons to images.
    pub scale: PixelScale,
    /// The sensor that measured the real frames.
    pub sensor: Sensor,
    /// Settings of the training.
    pub settings: &'a GanSettings,
    /// Seed of the noise and of the order of the samples.
    pub seed: u64,
    /// The device that computes.
    pub device: &'a Device,
}

/// The settings of a step.
#[derive(Debug, Clone)]
pub struct Rules {
    /// The classes that the discriminator distinguishes, and the losses.
    pub game: Game,
    /// Lambda of Eq. (7).
    pub sigma_penalty: f64,
    /// Learning rate.
    pub rate: f64,
    /// The sensor applied to generated images before the discriminator judges them. `None` applies
    /// no sensor.
    pub sensing: Option<(Sensor, PixelScale)>,
}

/// The discriminator's inputs in a step, besides generated images.
#[derive(Debug)]
pub struct Images {
    /// Real images `[batch, 1, 28, 28]`.
    pub real: Tensor<4>,
    /// Labelled images `[batch, 1, 28, 28]` and their targets `[batch, L]`.
    pub labelled: Option<(Tensor<4>, Tensor<2>)>,
}

/// Takes a step of the discriminator, then one of the generator. Returns the losses of both.
pub fn step(
    generator: &mut Learner,
    discriminator: &mut Learner,
    batch: &Images,
    eta: Tensor<2>,
    rules: &Rules,
) -> (f64, f64) {
    // The generator does not change while the discriminator takes its step, so both steps use the
    // same images. To the discriminator they are constants.
    let making = generator.weights.tracked();
    let mut images = generator::images(&making, eta, &mut Normalisation::Batch);
    if let Some((sensor, scale)) = rules.sensing {
        images = sensor.images(images, scale);
    }
    let judging = discriminator.weights.tracked();
    let constant = images.clone().inner();
    let loss = discriminator_loss(rules.game, &judging, batch, constant);
    discriminator.step(&judging, &mut loss.backward(), rules.rate);

    let fooled = generator_loss(rules.game, &discriminator.weights, batch, images);
    let sum = fooled.add(penalty(&making, rules.sigma_penalty));
    generator.step(&making, &mut sum.backward(), rules.rate);
    let [loss, sum] = [loss, sum].map(|loss| f64::from(numbers(&loss)[0]));
    (loss, sum)
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

fn discriminator_loss(
    game: Game,
    discriminator: &Weights,
    batch: &Images,
    generated: Tensor<4>,
) -> Tensor<1> {
    let labelled = batch.labelled.as_ref().map(|(images, targets)| {
        let judged = judge(discriminator, images.clone());
        (judged.logits, targets.clone())
    });
    let real = judge(discriminator, batch.real.clone());
    let generated = judge(discriminator, generated);
    losses::discriminator(game, real, generated, labelled)
}

/// The generator's loss without [`penalty`].
fn generator_loss(
    game: Game,
    discriminator: &Weights,
    batch: &Images,
    generated: Tensor<4>,
) -> Tensor<1> {
    let generated = judge(discriminator, generated);
    let real = || judge(discriminator, batch.real.clone());
    losses::generator(game, real, generated)
}

/// Lambda times Eq. (7)'s penalty on the mixture's sigma.
fn penalty(generator: &Weights, lambda: f64) -> Tensor<1> {
    losses::sigma_penalty(generator.tensor::<2>("mixture.sigma")).mul_scalar(lambda)
}

/// The sensor that measured the frames of these presses.
pub fn sensor(presses: &Presses, places: &[usize]) -> Sensor {
    let frames: Vec<ModelFrame> = places.iter().map(|&press| presses.frame(press)).collect();
    Sensor::of(&frames.iter().collect::<Vec<_>>())
}

impl Gan<'_> {
    fn stream(&self, name: &str) -> Stream {
        Stream::new(self.seed, &format!("{} {name}", self.stage))
    }

    fn images(&self, places: &[usize]) -> Tensor<4> {
        let frames: Vec<_> = places
            .iter()
            .map(|&press| self.presses.frame(press))
            .collect();
        self.scale.images(frames.iter(), self.device)
    }

    /// The images of step `step`. The labelled samples are fewer than the real ones, so they repeat
    /// in passes of their own.
    fn batch(&self, real: &[usize], step: u64) -> Images {
        let batches = self.labelled.len().div_ceil(self.settings.batch) as u64;
        let labelled = (batches > 0).then(|| {
            let mut order = self.labelled.to_vec();
            let stream = self.stream("labelled order");
            { stream.child(step / batches) }.shuffle(&mut order);
            let mut parts = order.chunks(self.settings.batch);
            let places = parts
                .nth((step % batches) as usize)
                .expect("the step modulo the batches is one of them");
            let levels = self.presses.of(places).map(|press| press.level);
            let targets = hrn::targets(levels, self.levels, self.device);
            (self.images(places), targets)
        });
        Images {
            real: self.images(real),
            labelled,
        }
    }

    /// What `ask` gets from the discriminator as a recogniser of the levels. The statistics of its layers are
    /// those of all real frames that it has seen, in batches of the same size and without augmentation, as in its
    /// training.
    fn as_recogniser<T>(&self, weights: &[Weights], ask: impl FnOnce(&Hrn, &[Weights]) -> T) -> T {
        let recogniser = hrn::of_levels(&weights[1], self.levels, self.device);
        let seen = [self.real, self.labelled].concat();
        let settings = Training {
            batch: self.settings.batch,
            ..Training::default()
        };
        let hrn = Hrn {
            stage: self.stage,
            presses: self.presses,
            is_generated: false,
            train: &seen,
            held_out: &[],
            initial: Weights::default(),
            levels: self.levels,
            scale: self.scale,
            settings: &settings,
            validated_every_epochs: 1,
            seed: self.seed,
            device: self.device,
        };
        ask(&hrn, &[recogniser])
    }
}

impl Learning for Gan<'_> {
    fn stage(&self) -> &'static str {
        self.stage
    }

    fn origin(&self) -> Origin<'_> {
        let GanSettings {
            batch,
            epochs,
            averaging,
            checkpoint_every_epochs,
            optimiser,
            ..
        } = *self.settings;
        let [generator, discriminator] = &self.initial;
        let hash = checkpoint::Origin::new(self.stage, &(self.settings, self.scale), self.seed)
            .presses(self.presses, self.real)
            .presses(self.presses, self.labelled)
            .weights(generator)
            .weights(discriminator)
            .finish();
        let side = |prefix, weights: &Weights, averaging| Side {
            prefix,
            weights: weights.clone(),
            averaging,
        };
        Origin {
            hash,
            is_generated: false,
            sides: vec![
                side("generator ", generator, 0.0),
                side("discriminator ", discriminator, averaging),
            ],
            samples: self.real.to_vec(),
            held_out: &[],
            batch,
            epochs,
            optimiser,
            checkpoint_every_epochs,
            validated_every_epochs: 1,
            seed: self.seed,
        }
    }

    fn step(&self, sides: &mut [Learner], batch: Batch) -> anyhow::Result<Taken> {
        let images = self.batch(batch.samples, batch.step);
        let rules = Rules {
            game: self.game,
            sigma_penalty: self.settings.sigma_penalty,
            rate: batch.rate,
            sensing: Some((self.sensor, self.scale)),
        };
        let mut stream = self.stream("noise").child(batch.step);
        let eta = generator::noise(self.settings.samples_a_component, &mut stream, self.device);
        let [generator, discriminator] = sides else {
            unreachable!("a GAN has two sides");
        };
        let (loss, of_generator) = step(generator, discriminator, &images, eta, &rules);
        Ok(Taken {
            loss,
            generator_loss: Some(of_generator),
            right: None,
        })
    }

    fn judge(
        &self,
        weights: &[Weights],
        questions: &[Question],
        vary: Option<&mut Stream>,
    ) -> Vec<Vec<f32>> {
        self.as_recogniser(weights, |hrn, weights| hrn.judge(weights, questions, vary))
    }

    fn outputs(&self) -> Outputs {
        Outputs::Levels
    }

    fn graph(&self, weights: &[Weights]) -> Recogniser {
        self.as_recogniser(weights, |hrn, weights| hrn.graph(weights))
    }
}
