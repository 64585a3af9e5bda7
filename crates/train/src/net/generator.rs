//! The generator G of a DeLiGAN and the mixture that its noise is drawn from.
//!
//! In: standard normal noise. Out: images in [-1, 1] as the discriminator sees real frames, or
//! frames in newtons. 65,569 parameters and the mixture's 3,000, all in one list, because the
//! mixture is trained by the generator's optimiser.

use burn::tensor::{Device, Tensor, TensorData};

use crate::net::image::PixelScale;
use crate::net::layers::{Convolution, transposed_convolution};
use crate::net::network::{
    FEATURES, Normalisation, Statistics, TRUNK, Weights, add_convolution, batch_norm, column,
    numbers,
};
use crate::net::sensed::Sensor;
use hardnessd_core::press;
use hardnessd_core::verdict::{COLS, ModelFrame, ROWS, TAXELS};
use hardnessd_simulator::random::Stream;

/// n: noise values per image (paper, "Training of STGAN and USTGAN").
pub const NOISE: usize = 30;
/// K: components of the mixture, all of weight 1/K (same section).
pub const COMPONENTS: usize = 50;
/// sigma before training (same section). DeLiGAN's code has 0.2.
const INITIAL_SIGMA: f32 = 0.15;
/// The first layer starts at U(-0.316, 0.316), of variance 1/30: one over its inputs (DeLiGAN's
/// code).
const INITIAL_LIMIT: f64 = 0.316;
/// Batch normalisation's epsilon in the generator (DeLiGAN's code).
const BATCH_NORM_EPSILON: f32 = 1e-5;
/// Rows and columns of the first image.
const FIRST_SIDE: usize = 4;
/// The number of batches of generated samples over which statistics are taken.
const STATISTICS_BATCHES: u64 = 20;
/// Samples of each component per pass without gradients.
const GENERATED_AT_ONCE: usize = 5;
/// Generated samples of each component per step: as many in all as the paper's batch of real ones.
pub const SAMPLES_A_COMPONENT: usize = 2;
/// The number of rounds in which frames that are not presses are drawn again.
const DRAWN_AGAIN: usize = 8;

/// The transposed convolutions, 4 -> 7 -> 14 -> 28: those of the trunk, backwards. Each has the prefix of
/// the names of its weights, and the convolution whose adjoint it is.
const LAYERS: [(&str, Convolution); 3] = [
    ("deconv1", TRUNK[2]),
    ("deconv2", TRUNK[1]),
    ("deconv3", TRUNK[0]),
];

/// Initial weights, the mixture's included; each layer draws from its own sub-stream.
pub fn initial(seed: u64, device: &Device) -> Weights {
    const { assert!(ROWS == COLS, "images are square") };
    let stream = Stream::new(seed, "generator weights");
    let uniform = |index: u64, count: usize, limit: f64| -> Vec<f32> {
        let mut stream = stream.child(index);
        let values = (0..count).map(|_| stream.range(-limit, limit) as f32);
        values.collect()
    };
    let mut weights = Weights::new(device);
    let width = FEATURES * FIRST_SIDE * FIRST_SIDE;
    let matrix = uniform(0, NOISE * width, INITIAL_LIMIT);
    weights.add_dense("linear", [NOISE, width], matrix);
    weights.add("linear.gamma", &[width], vec![1.0; width]);
    weights.add("linear.beta", &[width], vec![0.0; width]);
    for ((name, layer), index) in LAYERS.into_iter().zip(1..) {
        let mut stream = stream.child(index);
        add_convolution(&mut weights, name, layer, layer.inputs, &mut stream);
    }
    let dims = [COMPONENTS, NOISE];
    let count = COMPONENTS * NOISE;
    // mu ~ U(-1, 1), sigma = 0.15.
    let mu = uniform(LAYERS.len() as u64 + 1, count, 1.0);
    weights.add("mixture.mu", &dims, mu);
    weights.add("mixture.sigma", &dims, vec![INITIAL_SIGMA; count]);
    weights
}

/// eta ~ N(0, 1) for `samples` of each component: `[samples x 50, 30]`. Row r is of component
/// r mod 50, so every batch has the same number of each (all weights of Eq. 1 are 1/K).
pub fn noise(samples: usize, stream: &mut Stream, device: &Device) -> Tensor<2> {
    let rows = samples * COMPONENTS;
    let values = (0..rows * NOISE).map(|_| stream.normal() as f32).collect();
    Tensor::from_data(TensorData::new(values, [rows, NOISE]), device)
}

/// Images `[batch, 1, 28, 28]` in [-1, 1] of the noise `eta` `[batch, 30]`.
pub fn images(weights: &Weights, eta: Tensor<2>, normalisation: &mut Normalisation) -> Tensor<4> {
    let [batch, _] = eta.dims();
    // Eq. (2): z^k = mu^k + sigma^k eta
    let of_component = |name| {
        let one = weights.tensor::<2>(name).reshape([1, COMPONENTS, NOISE]);
        let each = one.expand([batch / COMPONENTS, COMPONENTS, NOISE]);
        each.reshape([batch, NOISE])
    };
    let z = of_component("mixture.mu").add(of_component("mixture.sigma").mul(eta));

    let relu = (BATCH_NORM_EPSILON, 0.0);
    // [1024, batch]
    let matrix = weights.tensor::<2>("linear.matrix").transpose();
    let bias = column(weights, "linear", "bias");
    let x = matrix.matmul(z.transpose()).add(bias);
    let x = batch_norm(weights, "linear", x, relu, normalisation);
    // [64, 4 4 batch]
    let mut x = x.reshape([FEATURES, FIRST_SIDE * FIRST_SIDE * batch]);
    for (name, layer) in LAYERS {
        let kernels = weights.tensor(&format!("{name}.kernel"));
        let bias = column(weights, name, "bias");
        x = transposed_convolution(x, kernels, bias, layer);
        if layer.normalised {
            x = batch_norm(weights, name, x, relu, normalisation);
        }
    }
    // [1, 28 28 batch] -> [batch, 1, 28, 28]
    let x = x.tanh().reshape([1, ROWS, COLS, batch]);
    x.permute([3, 0, 1, 2])
}

/// Mean and variance of each normalised layer over generated samples, in batches as in training.
/// They are computed anew from the current weights (see [`crate::net::network`]).
fn statistics(weights: &Weights, seed: u64) -> Statistics {
    let stream = Stream::new(seed, "statistics of generated samples");
    let mut statistics = Statistics::default();
    for batch in 0..STATISTICS_BATCHES {
        let mut stream = stream.child(batch);
        let eta = noise(SAMPLES_A_COMPONENT, &mut stream, &weights.device);
        let mut normalisation = Normalisation::Collect(&mut statistics);
        images(weights, eta, &mut normalisation);
    }
    statistics
}

/// Exactly `samples_a_component` frames of every component, as the sensor would give them; frame r is of
/// component r mod 50.
///
/// A frame that is not a press is drawn again, because recorded samples are all presses. A
/// component that still has too few after eight rounds keeps whatever it makes.
pub fn generate(
    weights: &Weights,
    (scale, sensor): (PixelScale, Sensor),
    samples_a_component: usize,
    (seed, stream): (u64, &mut Stream),
) -> Vec<ModelFrame> {
    let statistics = statistics(weights, seed);
    let mut of_component: Vec<Vec<ModelFrame>> = vec![Vec::new(); COMPONENTS];
    for round in 0..=DRAWN_AGAIN {
        let fewest = of_component.iter().map(Vec::len).min();
        let mut left = samples_a_component - fewest.unwrap_or_default();
        while left > 0 {
            let samples = left.min(GENERATED_AT_ONCE);
            let eta = noise(samples, stream, &weights.device);
            let images = images(weights, eta, &mut Normalisation::Fixed(&statistics));
            let frames = frames(&images, scale, sensor).into_iter().enumerate();
            for (place, frame) in frames {
                let own = &mut of_component[place % COMPONENTS];
                let is_taken = round == DRAWN_AGAIN || is_press(&frame);
                if own.len() < samples_a_component && is_taken {
                    own.push(frame);
                }
            }
            left -= samples;
        }
    }
    (0..samples_a_component)
        .flat_map(|sample| of_component.iter().map(move |own| own[sample]))
        .collect()
}

/// Whether a press would begin with the frame, by the default settings.
fn is_press(frame: &ModelFrame) -> bool {
    let settings = press::Thresholds::default();
    frame.contact_area_taxels(settings.contact_threshold_n) >= settings.begin_area_taxels
}

/// Images `[batch, 1, 28, 28]` in [-1, 1] as the frames that the sensor would give.
fn frames(images: &Tensor<4>, scale: PixelScale, sensor: Sensor) -> Vec<ModelFrame> {
    let frame = |values: &[f32]| {
        let mut frame = ModelFrame::default();
        for (newtons, value) in frame.newtons.iter_mut().zip(values) {
            *newtons = sensor.newtons(scale.newtons(*value));
        }
        frame
    };
    numbers(images).chunks(TAXELS).map(frame).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCALE: PixelScale = PixelScale {
        full_scale_n: 10.2,
        log_above_n: 0.0,
    };

    fn generated(weights: &Weights, samples: usize) -> Vec<ModelFrame> {
        let mut stream = Stream::new(1, "generated");
        let reading = (SCALE, Sensor::of(&[]));
        generate(weights, reading, samples, (1, &mut stream))
    }

    fn change(weights: &mut Weights, name: &str, with: fn(Tensor<1>) -> Tensor<1>) {
        let weight = weights.entries.iter_mut().find(|w| w.name == name).unwrap();
        weight.values = with(weight.values.clone());
    }

    #[test]
    fn the_network_has_the_papers_number_of_parameters() {
        let weights = initial(1, &Device::flex());
        let count = |mixture: bool| -> usize {
            let of = |name: &str| name.starts_with("mixture.") == mixture;
            let entries = weights.entries.iter().filter(|weight| of(&weight.name));
            entries
                .map(|weight| weight.dims.iter().product::<usize>())
                .sum()
        };
        assert_eq!((count(false), count(true)), (65_569, 3_000));
    }

    #[test]
    fn generated_frames_are_equally_many_of_each_component() {
        // The components are far apart and without spread, so each gives one picture for any eta.
        let mut weights = initial(1, &Device::flex());
        change(&mut weights, "mixture.sigma", |sigma| sigma.zeros_like());
        let frames = generated(&weights, 20);
        assert_eq!(frames.len(), 20 * COMPONENTS);
        for component in 0..COMPONENTS {
            for sample in 1..20 {
                let frame = &frames[sample * COMPONENTS + component];
                let distance = |other: &ModelFrame| -> f32 {
                    let pairs = frame.newtons.iter().zip(&other.newtons);
                    pairs.map(|(a, b)| (a - b).abs()).sum()
                };
                assert!(distance(&frames[component]) < 1e-2, "component {component}");
                let next = &frames[(component + 1) % COMPONENTS];
                assert!(distance(next) > 1.0, "component {component} and the next");
            }
        }
    }

    #[test]
    fn frames_that_are_not_presses_are_drawn_again() {
        // The images are dark, and not every draw has enough light taxels for a press.
        let device = Device::flex();
        let mut weights = initial(1, &device);
        let own = &mut weights;
        change(own, "mixture.sigma", |sigma| sigma.ones_like());
        change(own, "deconv3.kernel", |kernel| kernel.mul_scalar(3.0));
        change(own, "deconv3.bias", |bias| bias.sub_scalar(3.4));
        let statistics = statistics(&weights, 1);
        let eta = noise(4, &mut Stream::new(1, "drawn"), &device);
        let once = images(&weights, eta, &mut Normalisation::Fixed(&statistics));
        let once = frames(&once, SCALE, Sensor::of(&[]));
        let presses = |frames: &[ModelFrame]| frames.iter().filter(|frame| is_press(frame)).count();
        let drawn = generated(&weights, 4);
        let (before, after) = (presses(&once), presses(&drawn));
        assert_eq!((once.len(), drawn.len()), (4 * COMPONENTS, 4 * COMPONENTS));
        assert!((100..195).contains(&before), "{before}");
        assert_eq!(after, drawn.len());
    }
}
