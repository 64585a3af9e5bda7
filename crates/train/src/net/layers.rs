//! The layers' arithmetic on a CPU: convolution as one matrix product, and normalisation in one
//! pass.
//!
//! Images are kept as `[channels, rows, columns, batch]`. With the batch innermost, gathering the
//! patches under a kernel copies whole runs of `batch` numbers. The product of the kernels
//! `[outputs, inputs k k]` with these patches `[inputs k k, rows' columns' batch]` is already the
//! next layer's image, and a channel's statistics are those of a row. With burn's own
//! convolution and the system's allocator an HRN step takes more than twice as long as with these
//! (`benches/train_step.rs`, 2026-11-21).
//!
//! [`patches`] and [`from_patches`] are each other's adjoint, so the transposed convolution is the
//! same two steps in the other order, and so are all gradients.

use std::fmt::{self, Debug, Formatter};
use std::sync::Arc;

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, NodeGuard, Ops, OpsKind};
use burn::backend::flex::FlexTensor;
use burn::backend::ops::FloatTensorOps;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, backend_extension};
use burn::tensor::ops::{ConvOptions, ConvTransposeOptions};
use burn::tensor::{DType, Device, Tensor, TensorData, activation, module};
use rayon::prelude::*;

/// Stride of every convolution here.
pub const STRIDE: usize = 2;

/// The geometry of a convolution: square images and kernels, stride 2.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Geometry {
    /// Channels of the larger image.
    pub channels: usize,
    /// Rows and columns of the larger image.
    pub size: usize,
    /// Rows and columns of the kernel.
    pub kernel: usize,
    /// Zeros before and after, in rows as in columns.
    pub padding: (usize, usize),
}

impl Geometry {
    /// Rows and columns of the smaller image.
    pub fn small(self) -> usize {
        (self.size + self.padding.0 + self.padding.1 - self.kernel) / STRIDE + 1
    }

    /// Rows of the patches: `channels kernel kernel`.
    fn taps(self) -> usize {
        self.channels * self.kernel * self.kernel
    }

    /// The row or column of the larger image under tap `tap` of patch `place`. `None` in the
    /// padding.
    fn under(self, place: usize, tap: usize) -> Option<usize> {
        let index = (place * STRIDE + tap).checked_sub(self.padding.0)?;
        (index < self.size).then_some(index)
    }

    /// The position in an image of each run of `batch` numbers under `tap`, one of `kernel kernel`,
    /// place by place. `None` in the padding.
    fn runs(self, tap: usize, batch: usize) -> impl Iterator<Item = Option<usize>> {
        let small = self.small();
        (0..small * small).map(move |place| {
            let row = self.under(place / small, tap / self.kernel)?;
            let column = self.under(place % small, tap % self.kernel)?;
            Some((row * self.size + column) * batch)
        })
    }
}

/// Whether the operations below are made for `x`. Other devices, and the double precision that
/// tests compare with, use burn's own operations.
fn is_ours<const D: usize>(x: &Tensor<D>) -> bool {
    x.dtype() == DType::F32 && x.device().without_autodiff() == Device::flex()
}

/// Images `[outputs, small, small, batch]` of `x` `[inputs, size, size, batch]` under `kernels`
/// `[outputs, inputs k k]`.
pub fn convolution(x: Tensor<4>, kernels: Tensor<2>, geometry: Geometry) -> Tensor<4> {
    let (outputs, small, batch) = (kernels.dims()[0], geometry.small(), x.dims()[3]);
    let Geometry {
        channels,
        size,
        kernel,
        padding,
    } = geometry;
    debug_assert_eq!(x.dims(), [channels, size, size, batch]);
    if is_ours(&x) {
        let sums = <Dispatch as Layers>::product(
            kernels.into_dispatch(),
            patches(x, geometry).into_dispatch(),
        );
        return Tensor::<2>::from_dispatch(sums).reshape([outputs, small, small, batch]);
    }
    let options = ConvOptions::new_with_padding([STRIDE; 2], [padding; 2], [1; 2], 1);
    let kernels = kernels.reshape([outputs, channels, kernel, kernel]);
    module::conv2d(x.permute([3, 0, 1, 2]), kernels, None, options).permute([1, 2, 3, 0])
}

/// The adjoint of [`convolution`]: images `[inputs, size, size, batch]` of `x`
/// `[outputs, small, small, batch]`. Its usual name is transposed convolution.
pub fn transposed_convolution(x: Tensor<4>, kernels: Tensor<2>, geometry: Geometry) -> Tensor<4> {
    let [outputs, small, _, batch] = x.dims();
    let Geometry {
        channels,
        size,
        kernel,
        padding: (before, _),
    } = geometry;
    if is_ours(&x) {
        let products = kernels
            .transpose()
            .matmul(x.reshape([outputs, small * small * batch]));
        return from_patches(products, geometry, batch);
    }
    let kernels = kernels.reshape([outputs, channels, kernel, kernel]);
    // burn crops as much after as before. A row that is then missing lies past the last patch and
    // is 0. Rows that are too many are cut off.
    let full = (small - 1) * STRIDE + kernel;
    let missing = (size + before).saturating_sub(full);
    let options =
        ConvTransposeOptions::new([STRIDE; 2], [before; 2], [missing + before; 2], [1; 2], 1);
    module::conv_transpose2d(x.permute([3, 0, 1, 2]), kernels, None, options)
        .slice([0..batch, 0..channels, 0..size, 0..size])
        .permute([1, 2, 3, 0])
}

/// The numbers under the kernel at each of its places: `[inputs k k, small small batch]`.
pub fn patches(x: Tensor<4>, geometry: Geometry) -> Tensor<2> {
    Tensor::from_dispatch(<Dispatch as Layers>::patches(x.into_dispatch(), geometry))
}

/// The adjoint of [`patches`]: adds every number at the place it would have come from.
pub fn from_patches(patches: Tensor<2>, geometry: Geometry, batch: usize) -> Tensor<4> {
    let patches = patches.into_dispatch();
    Tensor::from_dispatch(<Dispatch as Layers>::from_patches(patches, geometry, batch))
}

/// Batch normalisation of the rows of `x` `[channels, numbers]`, then LeakyReLU; ReLU with
/// `slope` 0.
///
/// `y = leaky(gamma (x - mean) / sqrt(variance + epsilon) + beta)`, with each row's own mean and
/// biased variance.
pub fn normalised(
    x: Tensor<2>,
    gamma: Tensor<1>,
    beta: Tensor<1>,
    epsilon: f32,
    slope: f32,
) -> Tensor<2> {
    if is_ours(&x) {
        return Tensor::from_dispatch(<Dispatch as Layers>::normalised(
            x.into_dispatch(),
            gamma.into_dispatch(),
            beta.into_dispatch(),
            epsilon,
            slope,
        ));
    }
    let along = [x.dims()[0], 1];
    let (variance, mean) = x.clone().var_mean_bias(1);
    let unit = x.sub(mean).div(variance.add_scalar(epsilon).sqrt());
    let y = unit.mul(gamma.reshape(along)).add(beta.reshape(along));
    activation::leaky_relu(y, f64::from(slope))
}

/// LeakyReLU, whose gradient at 0 is the mean of both slopes. burn's own computes the gradient with
/// `mask_where`, which took 17 % of a step. Without a gradient there is nothing to gain.
pub fn leaky_relu<const D: usize>(x: Tensor<D>, slope: f32) -> Tensor<D> {
    if !is_ours(&x) || !x.is_autodiff() {
        return activation::leaky_relu(x, f64::from(slope));
    }
    Tensor::from_dispatch(<Dispatch as Layers>::leaky_relu(x.into_dispatch(), slope))
}

/// The operations that burn lacks, for its dispatch.
#[backend_extension(Autodiff, Flex)]
trait Layers: Backend {
    fn product(kernels: FloatTensor<Self>, patches: FloatTensor<Self>) -> FloatTensor<Self>;
    fn patches(x: FloatTensor<Self>, geometry: Geometry) -> FloatTensor<Self>;
    fn from_patches(
        patches: FloatTensor<Self>,
        geometry: Geometry,
        batch: usize,
    ) -> FloatTensor<Self>;
    fn normalised(
        x: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        epsilon: f32,
        slope: f32,
    ) -> FloatTensor<Self>;
    fn leaky_relu(x: FloatTensor<Self>, slope: f32) -> FloatTensor<Self>;
}

/// How the gradients of an operation's inputs follow from that of its output, and which of them are wanted.
#[derive(Clone)]
struct Adjoint<const N: usize>(Arc<Pull<N>>);

type Pull<const N: usize> = dyn Fn(FlexTensor, [bool; N]) -> [Option<FlexTensor>; N] + Send + Sync;

impl<const N: usize> Debug for Adjoint<N> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str("Adjoint")
    }
}

#[derive(Debug)]
struct Step;

impl<const N: usize> Backward<Flex, N> for Step {
    type State = Adjoint<N>;

    fn backward(
        self,
        ops: Ops<Self::State, N>,
        gradients: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let gradient = gradients.consume::<Flex>(&ops.node);
        let wanted = ops.parents.each_ref().map(Option::is_some);
        let found = (ops.state.0)(gradient, wanted);
        for (parent, gradient) in ops.parents.into_iter().zip(found) {
            if let (Some(parent), Some(gradient)) = (parent, gradient) {
                gradients.register::<Flex>(parent.id, gradient);
            }
        }
    }
}

/// The output of an operation on `nodes`, with its adjoint.
fn tracked<C: CheckpointStrategy, const N: usize>(
    nodes: [NodeGuard; N],
    output: FlexTensor,
    pull: impl Fn(FlexTensor, [bool; N]) -> [Option<FlexTensor>; N] + Send + Sync + 'static,
) -> FloatTensor<Autodiff<Flex, C>> {
    match Step.prepare::<C>(nodes).compute_bound().stateful() {
        OpsKind::Tracked(step) => step.finish(Adjoint(Arc::new(pull)), output),
        OpsKind::UnTracked(step) => step.finish(output),
    }
}

impl<C: CheckpointStrategy> Layers for Autodiff<Flex, C> {
    /// The matrix product. It differs from burn's own only in the kernels' gradient, which is the
    /// product of patches and transposed gradient, transposed. burn's product of gradient and
    /// transposed patches would first copy the many patches into another order, on one thread. Here
    /// only the gradient is copied, which is smaller.
    fn product(kernels: FloatTensor<Self>, patches: FloatTensor<Self>) -> FloatTensor<Self> {
        let (kernels, of_kernels) = kernels.into_parts();
        let (patches, of_patches) = patches.into_parts();
        let output = Flex::product(kernels.clone(), patches.clone());
        let nodes = [of_kernels, of_patches];
        tracked::<C, 2>(nodes, output, move |gradient, [of_kernels, of_patches]| {
            let of_kernels = of_kernels.then(|| {
                let transposed = Flex::float_transpose(gradient.clone());
                Flex::float_transpose(Flex::float_matmul(patches.clone(), transposed))
            });
            let transposed = || Flex::float_transpose(kernels.clone());
            let of_patches = of_patches.then(|| Flex::float_matmul(transposed(), gradient));
            [of_kernels, of_patches]
        })
    }

    fn patches(x: FloatTensor<Self>, geometry: Geometry) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        let batch = x.layout().shape()[3];
        let output = Flex::patches(x, geometry);
        tracked::<C, 1>([node], output, move |gradient, _| {
            [Some(Flex::from_patches(gradient, geometry, batch))]
        })
    }

    fn from_patches(
        patches: FloatTensor<Self>,
        geometry: Geometry,
        batch: usize,
    ) -> FloatTensor<Self> {
        let (patches, node) = patches.into_parts();
        let output = Flex::from_patches(patches, geometry, batch);
        tracked::<C, 1>([node], output, move |gradient, _| {
            [Some(Flex::patches(gradient, geometry))]
        })
    }

    fn normalised(
        x: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        epsilon: f32,
        slope: f32,
    ) -> FloatTensor<Self> {
        let (x, of_x) = x.into_parts();
        let (gamma, of_gamma) = gamma.into_parts();
        let (beta, of_beta) = beta.into_parts();
        let rows = Rows::new(x, gamma, beta, epsilon, slope);
        let output = rows.forward();
        tracked::<C, 3>([of_x, of_gamma, of_beta], output, move |gradient, _| {
            rows.backward(gradient).map(Some)
        })
    }

    fn leaky_relu(x: FloatTensor<Self>, slope: f32) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        let output = Flex::leaky_relu(x.clone(), slope);
        tracked::<C, 1>([node], output, move |gradient, _| {
            [Some(leaky(gradient, x.clone(), slope))]
        })
    }
}

/// The same tensor with its numbers in row-major order, whatever its strides.
fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.as_slice::<f32>().is_some() {
        tensor
    } else {
        tensor.to_contiguous()
    }
}

fn numbers(tensor: &FlexTensor) -> &[f32] {
    tensor
        .as_slice()
        .expect("contiguous, and all our tensors are of f32")
}

fn tensor<const D: usize>(values: Vec<f32>, shape: [usize; D]) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape))
}

impl Layers for Flex {
    fn product(kernels: FlexTensor, patches: FlexTensor) -> FlexTensor {
        Flex::float_matmul(kernels, patches)
    }

    fn patches(x: FlexTensor, geometry: Geometry) -> FlexTensor {
        let x = contiguous(x);
        let image = numbers(&x).len() / geometry.channels;
        let batch = image / (geometry.size * geometry.size);
        let row = geometry.small() * geometry.small() * batch;
        let taps = geometry.kernel * geometry.kernel;
        let mut values = vec![0.0; geometry.taps() * row];
        let rows = values.par_chunks_exact_mut(row).enumerate();
        rows.for_each(|(index, patches)| {
            let image = &numbers(&x)[index / taps * image..][..image];
            let runs = geometry.runs(index % taps, batch);
            for (run, patch) in runs.zip(patches.chunks_exact_mut(batch)) {
                let Some(run) = run else { continue };
                patch.copy_from_slice(&image[run..run + batch]);
            }
        });
        tensor(values, [geometry.taps(), row])
    }

    fn from_patches(patches: FlexTensor, geometry: Geometry, batch: usize) -> FlexTensor {
        let patches = contiguous(patches);
        let Geometry { channels, size, .. } = geometry;
        let of_channel = numbers(&patches).len() / channels;
        let taps = geometry.kernel * geometry.kernel;
        let mut values = vec![0.0; channels * size * size * batch];
        let images = values.par_chunks_exact_mut(size * size * batch);
        images
            .zip(numbers(&patches).par_chunks_exact(of_channel))
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
fn leaky(values: FlexTensor, x: FlexTensor, slope: f32) -> FlexTensor {
    let shape = values.layout().shape().clone();
    let (values, x) = (contiguous(values), contiguous(x));
    let half = (1.0 - slope) / 2.0;
    let factor = |x: f32| {
        let sign = f32::from(x > 0.0) - f32::from(x < 0.0);
        sign * half + (1.0 - half)
    };
    let numbers = numbers(&values).par_iter().zip(numbers(&x));
    let scaled = numbers.with_min_len(NUMBERS).map(|(y, &x)| y * factor(x));
    FlexTensor::from_data(TensorData::new(scaled.collect::<Vec<f32>>(), shape))
}

/// With fewer numbers, another thread does not pay.
const NUMBERS: usize = 1 << 14;

/// The input of batch normalisation, with a row per channel.
struct Rows {
    x: FlexTensor,
    gamma: FlexTensor,
    beta: FlexTensor,
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
    fn new(x: FlexTensor, gamma: FlexTensor, beta: FlexTensor, epsilon: f32, slope: f32) -> Self {
        let [x, gamma, beta] = [x, gamma, beta].map(contiguous);
        Self {
            x,
            gamma,
            beta,
            epsilon,
            slope,
        }
    }

    fn shape(&self) -> [usize; 2] {
        let channels = numbers(&self.gamma).len();
        [channels, numbers(&self.x).len() / channels]
    }

    /// Every row of `x` with its constants.
    fn rows(&self) -> impl IndexedParallelIterator<Item = (&[f32], Row)> {
        let parameters = (numbers(&self.gamma).par_iter()).zip(numbers(&self.beta));
        let rows = numbers(&self.x).par_chunks_exact(self.shape()[1]);
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
    fn backward(&self, gradient: FlexTensor) -> [FlexTensor; 3] {
        let gradient = contiguous(gradient);
        let [channels, count] = self.shape();
        let mut of_x = vec![0.0; channels * count];
        let (of_gamma, of_beta) = of_x
            .par_chunks_exact_mut(count)
            .zip(numbers(&gradient).par_chunks_exact(count))
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

#[cfg(test)]
mod tests;
