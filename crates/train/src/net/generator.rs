//! The generator G of a DeLiGAN and the mixture that its noise is drawn from.
//!
//! In: standard normal noise. Out: images in [-1, 1] as the discriminator sees real frames, or
//! frames in newtons. 65,569 parameters and the mixture's 3,000, all in one list, because the
//! mixture is trained by the generator's optimiser.

use burn::tensor::{Device, Tensor, TensorData};

use crate::net::image::PixelScale;
use crate::net::layers::transposed_convolution;
use crate::net::network::{
    Convolution, FEATURES, Normalisation, Statistics, TRUNK, Weights, batch_norm, numbers,
    truncated_normal,
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
/// The number of rounds in which frames that are not presses are drawn again.
const DRAWN_AGAIN: usize = 8;

/// The transposed convolutions, 4 -> 7 -> 14 -> 28: those of the trunk, backwards. Each has the prefix of
/// the names of its weights, the convolution whose adjoint it is, and the rows and columns of its output.
const LAYERS: [(&str, &Convolution, usize); 3] = [
    ("deconv1", &TRUNK[2], 7),
    ("deconv2", &TRUNK[1], 14),
    ("deconv3", &TRUNK[0], ROWS),
];

/// Initial weights, the mixture's included; each layer draws from its own sub-stream.
pub fn initial(seed: u64, device: &Device) -> Weights {
    const { assert!(ROWS == COLS, "images are square") };
    let stream = Stream::new(seed, "generator weights");
    let uniform = |index: u64, count: usize, limit: f64| -> Vec<f32> {
        let mut stream = stream.child(index);
        (0..count)
            .map(|_| stream.range(-limit, limit) as f32)
            .collect()
    };
    let mut weights = Weights::default();
    let width = FEATURES * FIRST_SIDE * FIRST_SIDE;
    let matrix = uniform(0, NOISE * width, INITIAL_LIMIT);
    weights.add("linear.matrix", &[NOISE, width], matrix, device);
    weights.add("linear.bias", &[width], vec![0.0; width], device);
    weights.add("linear.gamma", &[width], vec![1.0; width], device);
    weights.add("linear.beta", &[width], vec![0.0; width], device);
    for ((name, layer, _), index) in LAYERS.into_iter().zip(1..) {
        let (inputs, outputs, kernel) = (layer.outputs, layer.inputs, layer.kernel);
        let mut add = |part: &str, dims: &[usize], values: Vec<f32>| {
            weights.add(&format!("{name}.{part}"), dims, values, device);
        };
        let dims = [inputs, outputs, kernel, kernel];
        let values = truncated_normal(dims.iter().product(), &mut stream.child(index));
        add("kernel", &dims, values);
        add("bias", &[outputs], vec![0.0; outputs]);
        if layer.normalised {
            add("gamma", &[outputs], vec![1.0; outputs]);
            add("beta", &[outputs], vec![0.0; outputs]);
        }
    }
    let dims = [COMPONENTS, NOISE];
    let count = COMPONENTS * NOISE;
    // mu ~ U(-1, 1), sigma = 0.15.
    let mu = uniform(LAYERS.len() as u64 + 1, count, 1.0);
    weights.add("mixture.mu", &dims, mu, device);
    weights.add("mixture.sigma", &dims, vec![INITIAL_SIGMA; count], device);
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
        weights
            .tensor::<2>(name)
            .reshape([1, COMPONENTS, NOISE])
            .expand([batch / COMPONENTS, COMPONENTS, NOISE])
            .reshape([batch, NOISE])
    };
    let z = of_component("mixture.mu").add(of_component("mixture.sigma").mul(eta));

    let vector = |name: &str| weights.tensor::<1>(name);
    let column = |name: &str| {
        let values = vector(name);
        let rows = values.dims()[0];
        values.reshape([rows, 1])
    };
    let relu = (BATCH_NORM_EPSILON, 0.0);
    // [1024, batch]
    let x = weights
        .tensor::<2>("linear.matrix")
        .transpose()
        .matmul(z.transpose())
        .add(column("linear.bias"));
    let (gamma, beta) = (vector("linear.gamma"), vector("linear.beta"));
    // [64, 4, 4, batch]
    let mut x = batch_norm(x, gamma, beta, relu, 0, normalisation)
        .reshape([FEATURES, FIRST_SIDE, FIRST_SIDE, batch]);
    for ((name, layer, side), index) in LAYERS.into_iter().zip(1..) {
        let part = |part: &str| format!("{name}.{part}");
        let (inputs, outputs, kernel) = (layer.outputs, layer.inputs, layer.kernel);
        let kernels = weights
            .tensor::<4>(&part("kernel"))
            .reshape([inputs, outputs * kernel * kernel]);
        let mut rows = transposed_convolution(x, kernels, layer.geometry(side))
            .reshape([outputs, side * side * batch])
            .add(column(&part("bias")));
        if layer.normalised {
            let (gamma, beta) = (vector(&part("gamma")), vector(&part("beta")));
            rows = batch_norm(rows, gamma, beta, relu, index, normalisation);
        }
        x = rows.reshape([outputs, side, side, batch]);
    }
    // [1, 28, 28, batch] -> [batch, 1, 28, 28]
    x.tanh().permute([3, 0, 1, 2])
}

/// Mean and variance of each normalised layer over generated samples, in batches as in training.
/// They are computed anew from the current weights (see [`crate::net::network`]).
pub fn statistics(
    weights: &Weights,
    samples_a_component: usize,
    seed: u64,
    device: &Device,
) -> Statistics {
    let stream = Stream::new(seed, "statistics of generated samples");
    let mut statistics = Statistics::default();
    for batch in 0..STATISTICS_BATCHES {
        let eta = noise(samples_a_component, &mut stream.child(batch), device);
        let mut normalisation = Normalisation::Collect(&mut statistics);
        images(weights, eta, &mut normalisation);
    }
    statistics
}

/// The weights, statistics and scales with which [`generate`] makes frames.
#[derive(Debug)]
pub struct Making<'a> {
    /// The generator's weights.
    pub weights: &'a Weights,
    /// Statistics of its normalised layers.
    pub statistics: &'a Statistics,
    /// The scale from images to newtons.
    pub scale: PixelScale,
    /// The sensor that turns a force into a reading.
    pub sensor: Sensor,
    /// The device to compute on.
    pub device: &'a Device,
}

/// Exactly `samples_a_component` frames of every component; frame r is of component r mod 50.
///
/// A frame that is not a press is drawn again, because recorded samples are all presses. A
/// component that still has too few after eight rounds keeps whatever it makes.
pub fn generate(
    making: &Making,
    samples_a_component: usize,
    stream: &mut Stream,
) -> Vec<ModelFrame> {
    let mut of_component: Vec<Vec<ModelFrame>> = vec![Vec::new(); COMPONENTS];
    for round in 0..=DRAWN_AGAIN {
        let missing = of_component
            .iter()
            .map(|own| samples_a_component - own.len());
        let mut left = missing.max().unwrap_or_default();
        while left > 0 {
            let samples = left.min(GENERATED_AT_ONCE);
            let eta = noise(samples, stream, making.device);
            let images = images(
                making.weights,
                eta,
                &mut Normalisation::Fixed(making.statistics),
            );
            for (place, frame) in frames(&images, making.scale, making.sensor)
                .into_iter()
                .enumerate()
            {
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
pub fn frames(images: &Tensor<4>, scale: PixelScale, sensor: Sensor) -> Vec<ModelFrame> {
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
    use crate::settings::Generation;

    fn device() -> Device {
        Device::flex()
    }

    fn making<'a>(
        weights: &'a Weights,
        statistics: &'a Statistics,
        device: &'a Device,
    ) -> Making<'a> {
        Making {
            weights,
            statistics,
            scale: PixelScale {
                full_scale_n: 10.2,
                log_above_n: 0.0,
            },
            sensor: Sensor::of(&[]),
            device,
        }
    }

    #[test]
    fn the_network_has_the_papers_number_of_parameters() {
        let weights = initial(1, &device());
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
        let mut weights = initial(1, &device());
        let sigma = weights
            .entries
            .iter_mut()
            .find(|w| w.name == "mixture.sigma");
        let sigma = &mut sigma.unwrap().values;
        *sigma = sigma.zeros_like();
        let statistics = statistics(&weights, 2, 1, &device());
        let mut stream = Stream::new(1, "generated");
        let samples = Generation::default().samples_a_component as usize;
        let device = device();
        let making = making(&weights, &statistics, &device);
        let frames = generate(&making, samples, &mut stream);
        // Thirty for each of the paper's 375 labelled samples per level.
        assert_eq!((samples, frames.len()), (225, 30 * 375));
        for component in 0..COMPONENTS {
            for sample in 1..samples {
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
    fn the_layers_begin_with_unit_variance() {
        let weights = initial(1, &device());
        let statistics = statistics(&weights, 2, 1, &device());
        for layer in 0..LAYERS.len() {
            let (_, variance) = statistics.layer(layer);
            let variances = numbers(&variance);
            let normalised = variances.iter().map(|v| v / (v + BATCH_NORM_EPSILON));
            let mean = normalised.sum::<f32>() / variances.len() as f32;
            assert!(mean > 0.9, "layer {layer}: {mean} of {variances:?}");
        }
    }

    #[test]
    fn frames_that_are_not_presses_are_drawn_again() {
        // The images are dark, and not every draw has enough light taxels for a press.
        let mut weights = initial(1, &device());
        let mut change = |name: &str, with: fn(Tensor<1>) -> Tensor<1>| {
            let weight = weights.entries.iter_mut().find(|w| w.name == name).unwrap();
            weight.values = with(weight.values.clone());
        };
        change("mixture.sigma", |sigma| sigma.ones_like());
        change("deconv3.kernel", |kernel| kernel.mul_scalar(3.0));
        change("deconv3.bias", |bias| bias.sub_scalar(3.4));
        let statistics = statistics(&weights, 2, 1, &device());
        let device = device();
        let making = making(&weights, &statistics, &device);
        let eta = noise(4, &mut Stream::new(1, "drawn"), &device);
        let mut fixed = Normalisation::Fixed(&statistics);
        let once = frames(
            &images(&weights, eta, &mut fixed),
            making.scale,
            making.sensor,
        );
        let presses = |frames: &[ModelFrame]| frames.iter().filter(|frame| is_press(frame)).count();
        let drawn = generate(&making, 4, &mut Stream::new(1, "drawn"));
        let (before, after) = (presses(&once), presses(&drawn));
        assert_eq!((once.len(), drawn.len()), (4 * COMPONENTS, 4 * COMPONENTS));
        assert!((100..195).contains(&before), "{before}");
        assert_eq!(after, drawn.len());
    }

    #[test]
    fn statistics_fixed_give_what_training_saw() {
        let weights = initial(2, &device());
        let eta = noise(2, &mut Stream::new(3, "noise"), &device());
        let mut statistics = Statistics::default();
        let mut collect = Normalisation::Collect(&mut statistics);
        let in_batch = numbers(&images(&weights, eta.clone(), &mut collect));
        let fixed = numbers(&images(
            &weights,
            eta,
            &mut Normalisation::Fixed(&statistics),
        ));
        let pairs = in_batch.iter().zip(&fixed);
        let largest = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(largest < 1e-4, "{largest}");
    }
}
