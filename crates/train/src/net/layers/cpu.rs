//! The operations of `layers` on slices of numbers, for burn's CPU backend.

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use burn::backend::ops::FloatTensorOps;
use burn::tensor::TensorData;
use rayon::prelude::*;

use super::{Geometry, Layers};

/// The numbers of a tensor in row-major order, whatever its strides.
struct Contiguous(FlexTensor);

impl Contiguous {
    fn of(tensor: FlexTensor) -> Self {
        if tensor.as_slice::<f32>().is_some() {
            Self(tensor)
        } else {
            Self(tensor.to_contiguous())
        }
    }

    fn numbers(&self) -> &[f32] {
        self.0
            .as_slice()
            .expect("contiguous, and all our tensors are of f32")
    }
}

fn tensor<const D: usize>(values: Vec<f32>, shape: [usize; D]) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape))
}

impl Layers for Flex {
    fn product(kernels: FlexTensor, patches: FlexTensor) -> FlexTensor {
        Flex::float_matmul(kernels, patches)
    }

    fn patches(x: FlexTensor, geometry: Geometry) -> FlexTensor {
        let x = Contiguous::of(x);
        let image = x.numbers().len() / geometry.channels;
        let batch = image / (geometry.size * geometry.size);
        let row = geometry.small() * geometry.small() * batch;
        let taps = geometry.kernel * geometry.kernel;
        let mut values = vec![0.0; geometry.taps() * row];
        let rows = values.par_chunks_exact_mut(row).enumerate();
        rows.for_each(|(index, patches)| {
            let image = &x.numbers()[index / taps * image..][..image];
            let runs = geometry.runs(index % taps, batch);
            for (run, patch) in runs.zip(patches.chunks_exact_mut(batch)) {
                let Some(run) = run else { continue };
                patch.copy_from_slice(&image[run..run + batch]);
            }
        });
        tensor(values, [geometry.taps(), row])
    }

    fn from_patches(patches: FlexTensor, geometry: Geometry, batch: usize) -> FlexTensor {
        let patches = Contiguous::of(patches);
        let Geometry { channels, size, .. } = geometry;
        let of_channel = patches.numbers().len() / channels;
        let taps = geometry.kernel * geometry.kernel;
        let mut values = vec![0.0; channels * size * size * batch];
        let images = values.par_chunks_exact_mut(size * size * batch);
        images
            .zip(patches.numbers().par_chunks_exact(of_channel))
            .for_each(|(image, patches)| {
                let runs = (0..taps).flat_map(|tap| geometry.runs(tap, batch));
                for (run, patch) in runs.zip(patches.chunks_exact(batch)) {
                    let Some(run) = run else { continue };
                    for (sum, value) in image[run..run + batch].iter_mut().zip(patch) {
                        *sum += value;
                    }
                }
            });
        tensor(values, [channels, size, size, batch])
    }

    fn normalised(
        x: FlexTensor,
        gamma: FlexTensor,
        beta: FlexTensor,
        epsilon: f32,
        slope: f32,
    ) -> FlexTensor {
        Rows::new(x, gamma, beta, epsilon, slope).forward()
    }

    fn leaky_relu(x: FlexTensor, slope: f32) -> FlexTensor {
        leaky(x.clone(), x, slope)
    }
}

/// `values`, times `slope` where `x` is below 0, and times the mean of 1 and `slope` where `x`
/// is 0.
pub(super) fn leaky(values: FlexTensor, x: FlexTensor, slope: f32) -> FlexTensor {
    let shape = values.layout().shape().clone();
    let (values, x) = (Contiguous::of(values), Contiguous::of(x));
    let half = (1.0 - slope) / 2.0;
    let factor = |x: f32| {
        let sign = f32::from(x > 0.0) - f32::from(x < 0.0);
        sign * half + (1.0 - half)
    };
    let numbers = values.numbers().par_iter().zip(x.numbers());
    let scaled = numbers.with_min_len(NUMBERS).map(|(y, &x)| y * factor(x));
    FlexTensor::from_data(TensorData::new(scaled.collect::<Vec<f32>>(), shape))
}

/// With fewer numbers, another thread does not pay.
const NUMBERS: usize = 1 << 14;

/// The input of batch normalisation, with a row per channel.
pub(super) struct Rows {
    x: Contiguous,
    gamma: Contiguous,
    beta: Contiguous,
    epsilon: f32,
    slope: f32,
}

/// `y = leaky(scale (x - mean) + beta)` of one row.
#[derive(Clone, Copy)]
struct Row {
    mean: f32,
    /// `1 / sqrt(variance + epsilon)`
    rate: f32,
    gamma: f32,
    beta: f32,
}

impl Rows {
    pub(super) fn new(
        x: FlexTensor,
        gamma: FlexTensor,
        beta: FlexTensor,
        epsilon: f32,
        slope: f32,
    ) -> Self {
        let [x, gamma, beta] = [x, gamma, beta].map(Contiguous::of);
        Self {
            x,
            gamma,
            beta,
            epsilon,
            slope,
        }
    }

    fn shape(&self) -> [usize; 2] {
        let channels = self.gamma.numbers().len();
        [channels, self.x.numbers().len() / channels]
    }

    /// Every row of `x` with its constants.
    fn rows(&self) -> impl IndexedParallelIterator<Item = (&[f32], Row)> {
        let parameters = (self.gamma.numbers().par_iter()).zip(self.beta.numbers());
        let rows = self.x.numbers().par_chunks_exact(self.shape()[1]);
        rows.zip(parameters).map(|(x, (&gamma, &beta))| {
            let count = x.len() as f32;
            let mean = sum(x, |x| x) / count;
            let variance = sum(x, |x| (x - mean) * (x - mean)) / count;
            let rate = 1.0 / (variance + self.epsilon).sqrt();
            let row = Row {
                mean,
                rate,
                gamma,
                beta,
            };
            (x, row)
        })
    }

    fn forward(&self) -> FlexTensor {
        let [channels, count] = self.shape();
        let mut values = vec![0.0; channels * count];
        values
            .par_chunks_exact_mut(count)
            .zip(self.rows())
            .for_each(|(values, (x, row))| {
                let (scale, slope) = (row.gamma * row.rate, self.slope);
                for (y, x) in values.iter_mut().zip(x) {
                    let z = scale * (x - row.mean) + row.beta;
                    *y = z.max(slope * z);
                }
            });
        tensor(values, [channels, count])
    }

    /// Gradients of x, gamma and beta from that of y. With `u = (x - mean) rate` and `g` the
    /// gradient before the LeakyReLU, `dx = gamma rate (g - mean(g) - u mean(g u))`.
    pub(super) fn backward(&self, gradient: FlexTensor) -> [FlexTensor; 3] {
        let gradient = Contiguous::of(gradient);
        let [channels, count] = self.shape();
        let mut of_x = vec![0.0; channels * count];
        let (of_gamma, of_beta) = of_x
            .par_chunks_exact_mut(count)
            .zip(gradient.numbers().par_chunks_exact(count))
            .zip(self.rows())
            .map(|((of_x, gradient), (x, row))| {
                let (scale, slope) = (row.gamma * row.rate, self.slope);
                // `of_x` first holds the gradient before the LeakyReLU, and then the gradient of x.
                for ((before, x), gradient) in of_x.iter_mut().zip(x).zip(gradient) {
                    let z = scale * (x - row.mean) + row.beta;
                    *before = gradient * if z > 0.0 { 1.0 } else { slope };
                }
                let total = sum(of_x, |g| g);
                let product = row.rate * sum_of_products(of_x, x, row.mean);
                let (mean, share) = (total / count as f32, product / count as f32);
                for (g, x) in of_x.iter_mut().zip(x) {
                    *g = scale * (*g - mean - (x - row.mean) * row.rate * share);
                }
                (product, total)
            })
            .unzip();
        [
            tensor(of_x, [channels, count]),
            tensor(of_gamma, [channels]),
            tensor(of_beta, [channels]),
        ]
    }
}

/// Numbers added side by side: enough for the widest registers, and a fixed order of summing.
const LANES: usize = 16;

fn sum(values: &[f32], term: impl Fn(f32) -> f32) -> f32 {
    let mut lanes = [0.0_f32; LANES];
    let parts = values.chunks_exact(LANES);
    let rest: f32 = parts.remainder().iter().map(|&value| term(value)).sum();
    for part in parts {
        for (lane, &value) in lanes.iter_mut().zip(part) {
            *lane += term(value);
        }
    }
    lanes.iter().sum::<f32>() + rest
}

/// `sum g (x - mean)`
fn sum_of_products(g: &[f32], x: &[f32], mean: f32) -> f32 {
    let mut lanes = [0.0_f32; LANES];
    let (g_parts, x_parts) = (g.chunks_exact(LANES), x.chunks_exact(LANES));
    let rest = g_parts.remainder().iter().zip(x_parts.remainder());
    let rest: f32 = rest.map(|(g, x)| g * (x - mean)).sum();
    for (g, x) in g_parts.zip(x_parts) {
        for (lane, (g, x)) in lanes.iter_mut().zip(g.iter().zip(x)) {
            *lane += g * (x - mean);
        }
    }
    lanes.iter().sum::<f32>() + rest
}
