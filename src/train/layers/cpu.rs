//! The operations of `layers` on slices of numbers, for burn's CPU backend.

use burn::backend::Flex;
use burn::backend::flex::FlexTensor;
use burn::tensor::TensorData;

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
    fn patches(x: FlexTensor, geometry: Geometry) -> FlexTensor {
        let x = Contiguous::of(x);
        let x = x.numbers();
        let batch = x.len() / (geometry.channels * geometry.size * geometry.size);
        let places = geometry.small() * geometry.small();
        let mut values = Vec::with_capacity(geometry.taps() * places * batch);
        for run in geometry.runs(batch) {
            match run {
                Some(image) => values.extend_from_slice(&x[image..image + batch]),
                None => values.resize(values.len() + batch, 0.0),
            }
        }
        tensor(values, [geometry.taps(), places * batch])
    }

    fn from_patches(patches: FlexTensor, geometry: Geometry, batch: usize) -> FlexTensor {
        let patches = Contiguous::of(patches);
        let patches = patches.numbers();
        let Geometry { channels, size, .. } = geometry;
        let mut values = vec![0.0; channels * size * size * batch];
        for (run, patch) in geometry.runs(batch).zip(patches.chunks_exact(batch)) {
            let Some(image) = run else { continue };
            let sums = &mut values[image..image + batch];
            for (sum, value) in sums.iter_mut().zip(patch) {
                *sum += value;
            }
        }
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
}

/// What batch normalisation works on: a row a channel.
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
    fn rows(&self) -> impl Iterator<Item = (&[f32], Row)> {
        let parameters = self.gamma.numbers().iter().zip(self.beta.numbers());
        let rows = self.x.numbers().chunks_exact(self.shape()[1]);
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
        let mut values = Vec::with_capacity(self.x.numbers().len());
        for (x, row) in self.rows() {
            let (scale, slope) = (row.gamma * row.rate, self.slope);
            values.extend(x.iter().map(|x| {
                let z = scale * (x - row.mean) + row.beta;
                z.max(slope * z)
            }));
        }
        tensor(values, self.shape())
    }

    /// Gradients of x, gamma and beta from that of y. With `u = (x - mean) rate` and `g` the
    /// gradient before the LeakyReLU, `dx = gamma rate (g - mean(g) - u mean(g u))`.
    pub(super) fn backward(&self, gradient: FlexTensor) -> [FlexTensor; 3] {
        let gradient = Contiguous::of(gradient);
        let [channels, count] = self.shape();
        let mut of_x = Vec::with_capacity(channels * count);
        let (mut of_gamma, mut of_beta) = (Vec::new(), Vec::new());
        let mut before = vec![0.0; count];
        for ((x, row), gradient) in self.rows().zip(gradient.numbers().chunks_exact(count)) {
            let (scale, slope) = (row.gamma * row.rate, self.slope);
            for ((before, x), gradient) in before.iter_mut().zip(x).zip(gradient) {
                let z = scale * (x - row.mean) + row.beta;
                *before = gradient * if z > 0.0 { 1.0 } else { slope };
            }
            let total = sum(&before, |g| g);
            let product = row.rate * sum_of_products(&before, x, row.mean);
            let (mean, share) = (total / count as f32, product / count as f32);
            of_x.extend(
                before
                    .iter()
                    .zip(x)
                    .map(|(g, x)| scale * (g - mean - (x - row.mean) * row.rate * share)),
            );
            of_gamma.push(product);
            of_beta.push(total);
        }
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
