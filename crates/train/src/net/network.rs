//! The convolutional trunk that discriminator and recogniser share, and how weights are kept.
//!
//! Weights are a list of named f32 vectors with their shapes, and a network is a function of
//! them: an optimiser, a checkpoint and the inheritance USTGAN -> STGAN -> HRN then need to know
//! nothing about layers. Batch normalisation keeps no running statistics: with decay 0.9 they
//! scored .475 where statistics taken over the training set scored .843 with the same weights
//! (`results/method.md`), so [`Normalisation`] says where the statistics come from, and they
//! are taken anew before every evaluation and export.

use burn::tensor::{Device, Tensor, TensorData};

use crate::net::layers::{Geometry, convolution, leaky_relu, normalised};
use hardnessd_core::verdict::{COLS, ROWS};
use hardnessd_simulator::random::Stream;

/// Batch normalisation's epsilon in the discriminator. It must lie far below the variances that it
/// is added to, or the layer normalises nothing. With weights of N(0, 0.02) these variances begin
/// at 4e-7 before the second layer of a network of newtons. `the_layers_begin_with_unit_variance`
/// measures them.
pub(super) const BATCH_NORM_EPSILON: f32 = 1e-8;
/// Slope of LeakyReLU below 0.
pub const LEAKY_SLOPE: f32 = 0.2;
/// Standard deviation of initial weights, which are normal and cut at two deviations.
const INITIAL_DEVIATION: f64 = 0.02;
/// The number of features after a global pool: one per channel.
pub const FEATURES: usize = 64;

/// One of the trunk's convolutions: square kernel, stride 2, TF's SAME padding.
#[derive(Debug, Clone, Copy)]
pub struct Convolution {
    /// Prefix of the names of its weights.
    pub name: &'static str,
    /// Input channels.
    pub inputs: usize,
    /// Output channels.
    pub outputs: usize,
    /// Rows and columns of the kernel.
    pub kernel: usize,
    /// Zeros before and after, in rows as in columns.
    pub padding: (usize, usize),
    /// Whether batch normalisation follows.
    pub normalised: bool,
}

impl Convolution {
    /// The geometry of the convolution on images of `size` rows and columns.
    pub fn geometry(&self, size: usize) -> Geometry {
        Geometry {
            channels: self.inputs,
            size,
            kernel: self.kernel,
            padding: self.padding,
        }
    }
}

/// 28 -> 14 -> 7 -> 4, then a global pool to [`FEATURES`], or to twice as many.
pub const TRUNK: [Convolution; 3] = [
    Convolution {
        name: "conv1",
        inputs: 1,
        outputs: 16,
        kernel: 5,
        padding: (1, 2),
        normalised: false,
    },
    Convolution {
        name: "conv2",
        inputs: 16,
        outputs: 32,
        kernel: 5,
        padding: (1, 2),
        normalised: true,
    },
    Convolution {
        name: "conv3",
        inputs: 32,
        outputs: FEATURES,
        kernel: 3,
        padding: (1, 1),
        normalised: true,
    },
];

/// One named weight.
#[derive(Debug, Clone)]
pub struct Weight {
    /// The name, such as `conv2.kernel`.
    pub name: String,
    /// Lengths of the axes.
    pub dims: Vec<usize>,
    /// The numbers, row-major.
    pub values: Tensor<1>,
}

/// The weights of a network, in a fixed order.
#[derive(Debug, Clone, Default)]
pub struct Weights {
    /// The weights, in the order in which they were added.
    pub entries: Vec<Weight>,
}

impl Weights {
    /// Adds a weight from numbers.
    pub fn add(&mut self, name: &str, dims: &[usize], values: Vec<f32>, device: &Device) {
        let length = values.len();
        debug_assert_eq!(dims.iter().product::<usize>(), length, "{name}");
        self.entries.push(Weight {
            name: name.to_owned(),
            dims: dims.to_vec(),
            values: Tensor::from_data(TensorData::new(values, [length]), device),
        });
    }

    /// The weight called `name`, in its own shape.
    ///
    /// # Panics
    ///
    /// Panics if there is none, or it has another number of axes. Networks name their weights
    /// themselves.
    pub fn tensor<const D: usize>(&self, name: &str) -> Tensor<D> {
        let weight = self.entry(name);
        let dims: [usize; D] = weight
            .dims
            .as_slice()
            .try_into()
            .expect("a network knows its weights' axes");
        weight.values.clone().reshape(dims)
    }

    /// The weight called `name`, row-major.
    pub fn values(&self, name: &str) -> Tensor<1> {
        self.entry(name).values.clone()
    }

    /// The weight called `name` as numbers, row-major.
    pub fn numbers(&self, name: &str) -> Vec<f32> {
        numbers(&self.entry(name).values)
    }

    /// The numbers of the weight called `name`, if there is one.
    pub fn find(&self, name: &str) -> Option<Vec<f32>> {
        let found = self.entries.iter().find(|weight| weight.name == name);
        found.map(|weight| numbers(&weight.values))
    }

    /// Lengths of the axes of the weight called `name`.
    pub fn dims(&self, name: &str) -> &[usize] {
        &self.entry(name).dims
    }

    fn entry(&self, name: &str) -> &Weight {
        self.entries
            .iter()
            .find(|weight| weight.name == name)
            .expect("a network asks for weights that it made")
    }

    /// The same weights as leaves of an autodiff graph.
    #[must_use]
    pub fn tracked(&self) -> Self {
        let track = |weight: &Weight| Weight {
            values: weight.values.clone().autodiff().require_grad(),
            ..weight.clone()
        };
        Self {
            entries: self.entries.iter().map(track).collect(),
        }
    }

    /// The weights with every gamma, beta and bias moved. In an untrained network they are 1 and 0,
    /// which hides an omission.
    #[cfg(test)]
    pub(super) fn moved(mut self, seed: u64, device: &Device) -> Self {
        for weight in &mut self.entries {
            if weight.dims.len() == 1 {
                let mut stream = Stream::new(seed, &weight.name);
                let moved = numbers(&weight.values)
                    .iter()
                    .map(|value| value + 0.3 * stream.normal() as f32)
                    .collect();
                let length = weight.dims[0];
                weight.values = Tensor::from_data(TensorData::new(moved, [length]), device);
            }
        }
        self
    }

    /// The number of parameters in all weights.
    #[cfg(test)]
    pub(super) fn count(&self) -> usize {
        self.entries
            .iter()
            .map(|weight| weight.dims.iter().product::<usize>())
            .sum()
    }
}

/// A tensor as numbers, row-major.
pub fn numbers<const D: usize>(tensor: &Tensor<D>) -> Vec<f32> {
    tensor
        .to_data()
        .try_to_vec::<f32>()
        .expect("all our tensors are of f32")
}

/// `count` values of N(0, 0.02) cut at two deviations, as DeLiGAN's code starts its layers.
pub fn truncated_normal(count: usize, stream: &mut Stream) -> Vec<f32> {
    let draw = |stream: &mut Stream| loop {
        let value = stream.normal();
        if value.abs() <= 2.0 {
            return (value * INITIAL_DEVIATION) as f32;
        }
    };
    (0..count).map(|_| draw(stream)).collect()
}

/// Adds the trunk's initial weights. Each layer draws from its own sub-stream.
pub fn add_trunk(weights: &mut Weights, stream: &Stream, device: &Device) {
    for (layer, index) in TRUNK.iter().zip(0..) {
        let Convolution {
            name,
            inputs,
            outputs,
            kernel,
            ..
        } = *layer;
        let dims = [outputs, inputs, kernel, kernel];
        let values = truncated_normal(dims.iter().product(), &mut stream.child(index));
        weights.add(&format!("{name}.kernel"), &dims, values, device);
        if layer.normalised {
            weights.add(
                &format!("{name}.gamma"),
                &[outputs],
                vec![1.0; outputs],
                device,
            );
            weights.add(
                &format!("{name}.beta"),
                &[outputs],
                vec![0.0; outputs],
                device,
            );
        }
        weights.add(
            &format!("{name}.bias"),
            &[outputs],
            vec![0.0; outputs],
            device,
        );
    }
}

/// Adds the linear layer after the trunk, of `[features, outputs]`: L outputs for a recogniser, those
/// of its game for a discriminator.
pub fn add_head(weights: &mut Weights, dims: [usize; 2], stream: &Stream, device: &Device) {
    let [features, outputs] = dims;
    let values = truncated_normal(features * outputs, &mut stream.child(TRUNK.len() as u64));
    weights.add("head.matrix", &dims, values, device);
    weights.add("head.bias", &[outputs], vec![0.0; outputs], device);
}

/// Mean and variance of every normalised layer's inputs, `[channels]` each.
#[derive(Debug, Clone, Default)]
pub struct Statistics {
    layers: Vec<(Tensor<1>, Tensor<1>)>,
    batches: usize,
}

impl Statistics {
    /// Mean and biased variance of normalised layer `index`, averaged over the batches seen.
    pub fn layer(&self, index: usize) -> (Tensor<1>, Tensor<1>) {
        let (mean, variance) = self.layers[index].clone();
        let batches = self.batches as f32;
        (mean.div_scalar(batches), variance.div_scalar(batches))
    }

    /// Counts a batch whose layers were all collected.
    pub(super) fn batch_collected(&mut self) {
        self.batches += 1;
    }

    fn collect(&mut self, index: usize, mean: Tensor<1>, variance: Tensor<1>) {
        match self.layers.get_mut(index) {
            None => self.layers.push((mean, variance)),
            Some(sums) => {
                sums.0 = sums.0.clone().add(mean);
                sums.1 = sums.1.clone().add(variance);
            }
        }
    }
}

/// The source of mean and variance for batch normalisation.
#[derive(Debug)]
pub enum Normalisation<'a> {
    /// From the batch itself, for training.
    Batch,
    /// From the batch itself, and adds them to the statistics. Used once over the training set,
    /// before evaluation.
    Collect(&'a mut Statistics),
    /// From the collected statistics, for evaluation.
    Fixed(&'a Statistics),
}

/// Whether the head of `weights` takes each channel's mean beside its greatest value. A head of
/// twice as many features does.
pub fn takes_means(weights: &Weights) -> bool {
    weights.dims("head.matrix")[0] == 2 * FEATURES
}

/// The trunk: images `[batch, 1, 28, 28]` in [-1, 1], background -1, to features. These are the
/// greatest value of each channel, `[batch, 64]`, or with the means after them, `[batch, 128]`.
pub fn trunk(weights: &Weights, images: Tensor<4>, normalisation: &mut Normalisation) -> Tensor<2> {
    let batch = images.dims()[0];
    debug_assert_eq!(images.dims(), [batch, 1, ROWS, COLS]);
    // The convolution pads with 0. Raised by 1 the background is 0 too, so that padding looks
    // like untouched sensor and not like a frame of half the full scale around every image.
    // [batch, 1, 28, 28] -> [1, 28, 28, batch]
    let mut x = images.add_scalar(1.0).permute([1, 2, 3, 0]);
    let mut normalised_index = 0;
    for layer in &TRUNK {
        let part = |part: &str| format!("{}.{part}", layer.name);
        let sums = sums(weights, layer, x);
        let rows = if layer.normalised {
            let gamma = weights.tensor::<1>(&part("gamma"));
            let beta = weights.tensor::<1>(&part("beta"));
            normalised_index += 1;
            batch_norm(
                sums,
                gamma,
                beta,
                (BATCH_NORM_EPSILON, LEAKY_SLOPE),
                normalised_index - 1,
                normalisation,
            )
        } else {
            leaky_relu(sums, LEAKY_SLOPE)
        };
        x = as_images(rows, batch);
    }
    if let Normalisation::Collect(statistics) = normalisation {
        statistics.batch_collected();
    }
    pooled(x, takes_means(weights))
}

/// A layer's convolution with its bias: `x` `[inputs, size, size, batch]` to `[outputs, numbers]`.
pub(super) fn sums(weights: &Weights, layer: &Convolution, x: Tensor<4>) -> Tensor<2> {
    let geometry = layer.geometry(x.dims()[1]);
    let numbers = geometry.small() * geometry.small() * x.dims()[3];
    let taps = layer.inputs * layer.kernel * layer.kernel;
    let kernels = weights.tensor::<4>(&format!("{}.kernel", layer.name));
    let bias = weights.tensor::<1>(&format!("{}.bias", layer.name));
    convolution(x, kernels.reshape([layer.outputs, taps]), geometry)
        .reshape([layer.outputs, numbers])
        .add(bias.reshape([layer.outputs, 1]))
}

/// `[outputs, numbers]` as `[outputs, size, size, batch]`.
pub(super) fn as_images(rows: Tensor<2>, batch: usize) -> Tensor<4> {
    let [outputs, numbers] = rows.dims();
    let size = (numbers / batch).isqrt();
    rows.reshape([outputs, size, size, batch])
}

/// Pools the last layer's images `[64, 4, 4, batch]` to each channel's greatest value,
/// `[batch, 64]`, or with the means after them, `[batch, 128]`.
pub(super) fn pooled(x: Tensor<4>, with_means: bool) -> Tensor<2> {
    let [_, rows, columns, batch] = x.dims();
    let x = x.reshape([FEATURES, rows * columns, batch]);
    let greatest = x.clone().max_dim(1).reshape([FEATURES, batch]).transpose();
    if !with_means {
        return greatest;
    }
    let means = x.mean_dim(1).reshape([FEATURES, batch]).transpose();
    Tensor::cat(vec![greatest, means], 1)
}

/// Batch normalisation of `x` `[channels, numbers]` by channel, then LeakyReLU of `slope`;
/// `index` counts the network's normalised layers.
pub(super) fn batch_norm(
    x: Tensor<2>,
    gamma: Tensor<1>,
    beta: Tensor<1>,
    (epsilon, slope): (f32, f32),
    index: usize,
    normalisation: &mut Normalisation,
) -> Tensor<2> {
    let channels = x.dims()[0];
    match normalisation {
        Normalisation::Fixed(statistics) => {
            let (mean, variance) = statistics.layer(index);
            let along = [channels, 1];
            let scale = gamma.div(variance.add_scalar(epsilon).sqrt());
            let centred = x.sub(mean.reshape(along));
            leaky_relu(
                centred.mul(scale.reshape(along)).add(beta.reshape(along)),
                slope,
            )
        }
        Normalisation::Batch => normalised(x, gamma, beta, epsilon, slope),
        Normalisation::Collect(statistics) => {
            let (variance, mean) = x.clone().inner().var_mean_bias(1);
            statistics.collect(
                index,
                mean.reshape([channels]),
                variance.reshape([channels]),
            );
            normalised(x, gamma, beta, epsilon, slope)
        }
    }
}

/// The linear layer after the trunk: features `[batch, features]` to `[batch, outputs]`.
pub fn head(weights: &Weights, features: Tensor<2>) -> Tensor<2> {
    dense(weights, "head", features)
}

/// Passes `x` `[rows, inputs]` through the layer `name`.
pub(super) fn dense(weights: &Weights, name: &str, x: Tensor<2>) -> Tensor<2> {
    let bias = weights.tensor::<1>(&format!("{name}.bias"));
    let (inputs, outputs) = (x.dims()[1], bias.dims()[0]);
    let matrix = weights
        .values(&format!("{name}.matrix"))
        .reshape([inputs, outputs]);
    x.matmul(matrix).add(bias.reshape([1, outputs]))
}
