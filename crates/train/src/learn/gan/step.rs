//! One training step of the discriminator, then of the generator.
//!
//! In: both learners, real images, noise, the rules. Out: both losses. The step changes the weights
//! of both.

use burn::tensor::Tensor;

use crate::learn::learner::Learner;
use crate::net::generator;
use crate::net::image::PixelScale;
use crate::net::losses::{self, Game, Judged};
use crate::net::network::{self, Normalisation, Weights, numbers};
use crate::net::sensed::Sensor;

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
    // same images.
    let generated = Generated::of(generator, eta, rules.sensing);

    let (tracked, loss) = discrimination(discriminator, batch, &generated, rules);
    let mut gradients = loss.backward();
    discriminator.step(&tracked, &mut gradients, rules.rate);

    let fooled = generator_loss(rules.game, &discriminator.weights, batch, generated.images);
    let of_generator = learn(generator, &generated.tracked, fooled, rules);
    (number(&loss), of_generator)
}

/// Generated images, and the tracked weights that receive their gradients.
struct Generated {
    tracked: Weights,
    images: Tensor<4>,
}

impl Generated {
    fn of(generator: &Learner, eta: Tensor<2>, sensing: Option<(Sensor, PixelScale)>) -> Self {
        let tracked = generator.weights.tracked();
        let images = generator::images(&tracked, eta, &mut Normalisation::Batch);
        let images = match sensing {
            Some((sensor, scale)) => sensor.images(images, scale),
            None => images,
        };
        Self { tracked, images }
    }
}

/// The tracked weights of the discriminator and its loss. Generated images are constants here.
fn discrimination(
    discriminator: &Learner,
    batch: &Images,
    generated: &Generated,
    rules: &Rules,
) -> (Weights, Tensor<1>) {
    let tracked = discriminator.weights.tracked();
    let images = generated.images.clone().inner();
    let loss = discriminator_loss(rules.game, &tracked, batch, images);
    (tracked, loss)
}

/// Takes the generator's step on its loss plus the penalty on sigma, and returns this sum.
fn learn(generator: &mut Learner, tracked: &Weights, fooled: Tensor<1>, rules: &Rules) -> f64 {
    let loss = fooled.add(penalty(tracked, rules.sigma_penalty));
    let mut gradients = loss.backward();
    generator.step(tracked, &mut gradients, rules.rate);
    number(&loss)
}

fn number(loss: &Tensor<1>) -> f64 {
    f64::from(numbers(loss)[0])
}

/// Judges one batch. Each batch passes through the discriminator alone and is normalised by its own
/// statistics: in a mixed batch, the statistics would reveal the share of real frames.
pub(super) fn judge(discriminator: &Weights, images: Tensor<4>) -> Judged {
    let features = network::trunk(discriminator, images, &mut Normalisation::Batch);
    Judged {
        logits: network::head(discriminator, features.clone()),
        features,
    }
}

pub(super) fn discriminator_loss(
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
pub(super) fn generator_loss(
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
pub(super) fn penalty(generator: &Weights, lambda: f64) -> Tensor<1> {
    losses::sigma_penalty(generator.tensor::<2>("mixture.sigma")).mul_scalar(lambda)
}
