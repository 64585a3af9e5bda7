//! Compares gradients of a whole step with finite differences.

use super::*;
use burn::tensor::{DType, FloatDType, TensorData};
use hardnessd_core::verdict::{COLS, ROWS};

const GAMES: [Game; 3] = [Game::RealOrFake, Game::FakeLevel, Game::FeatureMatching];
const LEVELS: usize = 4;

fn device() -> Device {
    Device::flex()
}

/// Converts to double precision, so that differences of the loss over a small step are exact
/// enough.
fn double<const D: usize>(tensor: &Tensor<D>) -> Tensor<D> {
    tensor.clone().cast(FloatDType::F64)
}

fn in_double(weights: &Weights) -> Weights {
    let mut weights = weights.clone();
    for weight in &mut weights.entries {
        weight.values = double(&weight.values);
    }
    weights
}

fn doubles<const D: usize>(tensor: &Tensor<D>) -> Vec<f64> {
    assert_eq!(tensor.dtype(), DType::F64);
    tensor.to_data().try_to_vec::<f64>().unwrap()
}

/// One step's inputs, with weights as after some training, because the initial weights are so small
/// that hardly anything reaches the logits.
struct Case {
    gan: [Weights; 2],
    batch: Images,
    eta: Tensor<2>,
}

fn case(game: Game) -> Case {
    let mut stream = Stream::new(8, "images");
    let mut random = |dims: [usize; 4]| -> Tensor<4> {
        let values: Vec<f32> = (0..dims.iter().product())
            .map(|_| (stream.uniform() * 2.0 - 1.0) as f32)
            .collect();
        Tensor::from_data(TensorData::new(values, dims), &device())
    };
    let real = random([7, 1, ROWS, COLS]);
    let images = random([5, 1, ROWS, COLS]);
    let targets = hrn::targets([1, 2, 3, 4, 2].into_iter(), LEVELS, &device());
    let mut gan = initial(game, LEVELS, 3, &device());
    for weights in &mut gan {
        for (weight, number) in weights.entries.iter_mut().zip(0..) {
            let mut stream = Stream::new(9, &weight.name).child(number);
            let noise: Vec<f32> = (0..weight.dims.iter().product())
                .map(|_| 0.1 * stream.normal() as f32)
                .collect();
            let length = noise.len();
            let noise = Tensor::from_data(TensorData::new(noise, [length]), &device());
            weight.values = weight.values.clone().add(noise);
        }
    }
    Case {
        gan,
        batch: Images {
            real,
            labelled: (game != Game::RealOrFake).then_some((images, targets)),
        },
        eta: generator::noise(1, &mut stream, &device()),
    }
}

impl Case {
    fn in_double(&self) -> Self {
        Self {
            gan: self.gan.each_ref().map(in_double),
            batch: Images {
                real: double(&self.batch.real),
                labelled: self
                    .batch
                    .labelled
                    .as_ref()
                    .map(|(images, targets)| (double(images), double(targets))),
            },
            eta: double(&self.eta),
        }
    }

    fn discriminator_loss(&self, game: Game, discriminator: &Weights) -> Tensor<1> {
        let images = generator::images(&self.gan[0], self.eta.clone(), &mut Normalisation::Batch);
        discriminator_loss(game, discriminator, &self.batch, images)
    }

    fn generator_loss(&self, game: Game, generator: &Weights) -> Tensor<1> {
        let images = generator::images(generator, self.eta.clone(), &mut Normalisation::Batch);
        generator_loss(game, &self.gan[1], &self.batch, images).add(penalty(generator, 0.1))
    }
}

/// Compares the gradients of `loss` in single precision with finite differences of `exact`, the
/// same loss in double precision, along the gradient of each weight.
fn check(
    weights: &Weights,
    loss: impl Fn(&Weights) -> Tensor<1>,
    exact: impl Fn(&Weights) -> Tensor<1>,
) {
    let tracked = weights.tracked();
    let gradients = loss(&tracked).backward();
    let exact_weights = in_double(weights);
    let gradient_of = |index: usize| {
        let values = &tracked.entries[index].values;
        let gradient = values.grad(&gradients);
        gradient.unwrap_or_else(|| panic!("no gradient: {}", weights.entries[index].name))
    };
    let size = |gradient: &Tensor<1>| -> f64 {
        let squares = numbers(gradient).into_iter().map(|g| f64::from(g).powi(2));
        squares.sum::<f64>().sqrt()
    };
    for (index, weight) in weights.entries.iter().enumerate() {
        let gradient = gradient_of(index);
        let size = size(&gradient);
        // Batch normalisation subtracts the mean and so cancels the bias before it.
        let cancelled = [
            "conv2.bias",
            "conv3.bias",
            "linear.bias",
            "deconv1.bias",
            "deconv2.bias",
        ];
        if cancelled.contains(&weight.name.as_str()) {
            assert!(size < 1e-5, "{}: {size}", weight.name);
            continue;
        }
        assert!(size > 1e-7, "{}: {size}", weight.name);
        let direction = double(&gradient).div_scalar(size);
        let at = |step: f64| {
            let mut moved = exact_weights.clone();
            let values = &mut moved.entries[index].values;
            *values = values.clone().add(direction.clone().mul_scalar(step));
            doubles(&exact(&moved))[0]
        };
        // The step is small enough to cross no kink of the leaky ReLU or of the pool.
        let step = 1e-6;
        let numeric = (at(step) - at(-step)) / (2.0 * step);
        assert!(
            (numeric - size).abs() < 1e-3 * size,
            "{}: {size} by backpropagation, {numeric} by differences",
            weight.name
        );
    }
}

#[test]
fn gradients_of_a_whole_step_agree_with_finite_differences() {
    for game in GAMES {
        let case = case(game);
        let exact = case.in_double();
        check(
            &case.gan[1],
            |weights| case.discriminator_loss(game, weights),
            |weights| exact.discriminator_loss(game, weights),
        );
        check(
            &case.gan[0],
            |weights| case.generator_loss(game, weights),
            |weights| exact.generator_loss(game, weights),
        );
    }
}
