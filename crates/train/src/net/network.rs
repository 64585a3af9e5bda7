//! The convolutional trunk that discriminator and recogniser share, and how weights are kept.
//!
//! Weights are a list of named f32 vectors with their shapes, and a network is a function of
//! them: an optimiser, a checkpoint and the inheritance USTGAN -> STGAN -> HRN then need to know
//! nothing about layers. Batch normalisation keeps no running statistics: with decay 0.9 they
//! scored .475 where statistics taken over the training set scored .843 with the same weights
//! (`results/method.md`), so [`Normalisation`] says where the statistics come from, and they
//! are taken anew before every evaluation and export.

use std::collections::BTreeMap;

use burn::tensor::{Device, Tensor, TensorData};

use crate::net::layers::{Convolution, convolution, leaky_relu, normalised};
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

/// 28 -> 14 -> 7 -> 4, then a global pool to [`FEATURES`], or to twice as many.
pub const TRUNK: [Convolution; 3] = [
    Convolution {
        name: "conv1",
        inputs: 1,
        outputs: 16,
        size: ROWS,
        kernel: 5,
        padding: (1, 2),
        normalised: false,
    },
    Convolution {
        name: "conv2",
        inputs: 16,
        outputs: 32,
        size: 14,
        kernel: 5,
        padding: (1, 2),
        normalised: true,
    },
    Convolution {
        name: "conv3",
        inputs: 32,
        outputs: FEATURES,
        size: 7,
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
#[derive(Debug, Clone)]
pub struct Weights {
    /// The weights, in the order in which they were added.
    pub entries: Vec<Weight>,
    /// The device that they are on.
    pub device: Device,
}

impl Weights {
    /// No weights on this device.
    pub fn new(device: &Device) -> Self {
        Self {
            entries: Vec::new(),
            device: device.clone(),
        }
    }

    /// Adds a weight from numbers.
    pub fn add(&mut self, name: &str, dims: &[usize], values: Vec<f32>) {
        let length = values.len();
        debug_assert_eq!(dims.iter().product::<usize>(), length, "{name}");
        self.entries.push(Weight {
            name: name.to_owned(),
            dims: dims.to_vec(),
            values: Tensor::from_data(TensorData::new(values, [length]), &self.device),
        });
    }

    /// Adds a layer for [`dense`], of `[inputs, outputs]`, with a bias of 0.
    pub fn add_dense(&mut self, name: &str, dims: [usize; 2], matrix: Vec<f32>) {
        self.add(&format!("{name}.matrix"), &dims, matrix);
        self.add(&format!("{name}.bias"), &dims[1..], vec![0.0; dims[1]]);
    }

    /// The weight called `name`, in its own shape.
    ///
    /// # Panics
    ///
    /// Panics if there is none, or it has another number of axes. Networks name their weights
    /// themselves.
    pub fn tensor<const D: usize>(&self, name: &str) -> Tensor<D> {
        let weight = self.entry(name);
        let dims = <[usize; D]>::try_from(weight.dims.as_slice());
        let dims = dims.expect("a network knows its weights' axes");
        weight.values.clone().reshape(dims)
    }

    /// The weight called `name` as numbers, row-major.
    pub fn numbers(&self, name: &str) -> Vec<f32> {
        numbers(&self.entry(name).values)
    }

    /// Lengths of the axes of the weight called `name`.
    pub fn dims(&self, name: &str) -> &[usize] {
        &self.entry(name).dims
    }

    fn entry(&self, name: &str) -> &Weight {
        let named = self.entries.iter().find(|weight| weight.name == name);
        named.expect("a network asks for weights that it made")
    }

    /// The same weights with other numbers.
    #[must_use]
    pub fn each(&self, of: impl Fn(Tensor<1>) -> Tensor<1>) -> Self {
        let of = |weight: &Weight| Weight {
            values: of(weight.values.clone()),
            ..weight.clone()
        };
        Self {
            entries: self.entries.iter().map(of).collect(),
            device: self.device.clone(),
        }
    }

    /// The same weights as leaves of an autodiff graph.
    #[must_use]
    pub fn tracked(&self) -> Self {
        self.each(|values| values.autodiff().require_grad())
    }
}

/// A tensor as numbers, row-major.
pub fn numbers<const D: usize>(tensor: &Tensor<D>) -> Vec<f32> {
    let numbers = tensor.to_data().try_to_vec::<f32>();
    numbers.expect("all our tensors are of f32")
}

/// Levels 1..=L as rows with a 1 at the level: `[batch, L]`.
pub fn targets(
    levels_of: impl ExactSizeIterator<Item = u8>,
    levels: usize,
    device: &Device,
) -> Tensor<2> {
    let batch = levels_of.len();
    let mut values = vec![0.0_f32; batch * levels];
    for (row, level) in levels_of.enumerate() {
        values[row * levels + usize::from(level) - 1] = 1.0;
    }
    Tensor::from_data(TensorData::new(values, [batch, levels]), device)
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

/// Adds the initial weights of a convolution, or of its adjoint, to `channels`.
pub(super) fn add_convolution(
    weights: &mut Weights,
    name: &str,
    layer: Convolution,
    channels: usize,
    stream: &mut Stream,
) {
    let mut add = |part: &str, dims: &[usize], values: Vec<f32>| {
        weights.add(&format!("{name}.{part}"), dims, values);
    };
    let dims = [layer.outputs, layer.inputs, layer.kernel, layer.kernel];
    let values = truncated_normal(dims.iter().product(), stream);
    add("kernel", &dims, values);
    add("bias", &[channels], vec![0.0; channels]);
    if layer.normalised {
        add("gamma", &[channels], vec![1.0; channels]);
        add("beta", &[channels], vec![0.0; channels]);
    }
}

/// Adds the trunk's initial weights. Each layer draws from its own sub-stream.
pub fn add_trunk(weights: &mut Weights, stream: &Stream) {
    for (layer, index) in TRUNK.into_iter().zip(0..) {
        let stream = &mut stream.child(index);
        add_convolution(weights, layer.name, layer, layer.outputs, stream);
    }
}

/// Adds the linear layer after the trunk, of `[features, outputs]`: L outputs for a recogniser, those
/// of its game for a discriminator.
pub fn add_head(weights: &mut Weights, dims: [usize; 2], stream: &Stream) {
    let mut stream = stream.child(TRUNK.len() as u64);
    let matrix = truncated_normal(dims[0] * dims[1], &mut stream);
    weights.add_dense("head", dims, matrix);
}

/// Mean and variance of every normalised layer's inputs, `[channels]` each: sums over batches, and the number of
/// these.
#[derive(Debug, Clone, Default)]
pub struct Statistics(BTreeMap<String, ([Tensor<1>; 2], usize)>);

impl Statistics {
    /// Mean and biased variance of the layer `name`, averaged over the batches seen.
    pub fn layer(&self, name: &str) -> [Tensor<1>; 2] {
        let (sums, batches) = &self.0[name];
        sums.clone().map(|sum| sum.div_scalar(*batches as f32))
    }

    fn collect(&mut self, name: &str, batch: &[Tensor<1>; 2]) {
        let none = || (batch.each_ref().map(Tensor::zeros_like), 0);
        let (sums, batches) = self.0.entry(name.to_owned()).or_insert_with(none);
        for (sum, of_batch) in sums.iter_mut().zip(batch) {
            *sum = sum.clone().add(of_batch.clone());
        }
        *batches += 1;
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
    let x = images.add_scalar(1.0).permute([1, 2, 3, 0]);
    let mut x = x.reshape([1, ROWS * COLS * batch]);
    for layer in TRUNK {
        let kernels = weights.tensor(&format!("{}.kernel", layer.name));
        let bias = column(weights, layer.name, "bias");
        let sums = convolution(x, kernels, bias, layer);
        x = match layer.normalised {
            true => {
                let leaky = (BATCH_NORM_EPSILON, LEAKY_SLOPE);
                batch_norm(weights, layer.name, sums, leaky, normalisation)
            }
            false => leaky_relu(sums, LEAKY_SLOPE),
        };
    }
    let places = x.dims()[1] / batch;
    let x = x.reshape([FEATURES, places, batch]);
    let greatest = x.clone().max_dim(1).reshape([FEATURES, batch]).transpose();
    if !takes_means(weights) {
        return greatest;
    }
    let means = x.mean_dim(1).reshape([FEATURES, batch]).transpose();
    Tensor::cat(vec![greatest, means], 1)
}

/// A vector of the layer `name`, for rows of channels.
pub(super) fn column(weights: &Weights, name: &str, part: &str) -> Tensor<2> {
    let values = weights.tensor::<1>(&format!("{name}.{part}"));
    let channels = values.dims()[0];
    values.reshape([channels, 1])
}

/// Batch normalisation of `x` `[channels, numbers]` by channel in the layer `name`, then LeakyReLU of `slope`.
pub(super) fn batch_norm(
    weights: &Weights,
    name: &str,
    x: Tensor<2>,
    (epsilon, slope): (f32, f32),
    normalisation: &mut Normalisation,
) -> Tensor<2> {
    let along = [x.dims()[0], 1];
    let [gamma, beta] = ["gamma", "beta"].map(|part| column(weights, name, part));
    if let Normalisation::Fixed(statistics) = normalisation {
        let [mean, variance] = statistics.layer(name).map(|values| values.reshape(along));
        let scale = gamma.div(variance.add_scalar(epsilon).sqrt());
        return leaky_relu(x.sub(mean).mul(scale).add(beta), slope);
    }
    if let Normalisation::Collect(statistics) = normalisation {
        let (variance, mean) = x.clone().inner().var_mean_bias(1);
        let batch = [mean, variance].map(|values| values.reshape([along[0]]));
        statistics.collect(name, &batch);
    }
    normalised(x, gamma, beta, epsilon, slope)
}

/// Passes `x` `[rows, inputs]` through the layer `name`.
pub fn dense(weights: &Weights, name: &str, x: Tensor<2>) -> Tensor<2> {
    let bias = weights.tensor::<1>(&format!("{name}.bias"));
    let outputs = bias.dims()[0];
    let matrix = weights.tensor::<2>(&format!("{name}.matrix"));
    x.matmul(matrix).add(bias.reshape([1, outputs]))
}
