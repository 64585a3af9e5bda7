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
        let mut add = |part: &str, dims: &[usize], values: Vec<f32>| {
            weights.add(&format!("{name}.{part}"), dims, values, device);
        };
        let dims = [outputs, inputs, kernel, kernel];
        let values = truncated_normal(dims.iter().product(), &mut stream.child(index));
        add("kernel", &dims, values);
        if layer.normalised {
            add("gamma", &[outputs], vec![1.0; outputs]);
            add("beta", &[outputs], vec![0.0; outputs]);
        }
        add("bias", &[outputs], vec![0.0; outputs]);
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

    fn collect(&mut self, index: usize, mean: Tensor<1>, variance: Tensor<1>) {
        if index == 0 {
            self.batches += 1;
        }
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
        let vector = |name: &str| weights.tensor::<1>(&part(name));
        let geometry = layer.geometry(x.dims()[1]);
        let (outputs, small) = (layer.outputs, geometry.small());
        let taps = layer.inputs * layer.kernel * layer.kernel;
        let kernels = weights.tensor::<4>(&part("kernel"));
        let sums = convolution(x, kernels.reshape([outputs, taps]), geometry)
            .reshape([outputs, small * small * batch])
            .add(vector("bias").reshape([outputs, 1]));
        let rows = if layer.normalised {
            let (gamma, beta) = (vector("gamma"), vector("beta"));
            let leaky = (BATCH_NORM_EPSILON, LEAKY_SLOPE);
            normalised_index += 1;
            batch_norm(
                sums,
                gamma,
                beta,
                leaky,
                normalised_index - 1,
                normalisation,
            )
        } else {
            leaky_relu(sums, LEAKY_SLOPE)
        };
        x = rows.reshape([outputs, small, small, batch]);
    }
    let [_, rows, columns, _] = x.dims();
    let x = x.reshape([FEATURES, rows * columns, batch]);
    let greatest = x.clone().max_dim(1).reshape([FEATURES, batch]).transpose();
    if !takes_means(weights) {
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

/// Passes `x` `[rows, inputs]` through the layer `name`.
pub fn dense(weights: &Weights, name: &str, x: Tensor<2>) -> Tensor<2> {
    let bias = weights.tensor::<1>(&format!("{name}.bias"));
    let outputs = bias.dims()[0];
    let matrix = weights.tensor::<2>(&format!("{name}.matrix"));
    x.matmul(matrix).add(bias.reshape([1, outputs]))
}
