//! The layers' arithmetic on a CPU: convolution as one matrix product, and normalisation in one
//! pass.
//!
//! Images are kept as `[channels, rows columns batch]`. With the batch innermost, gathering the
//! patches under a kernel copies whole runs of `batch` numbers. The product of the kernels
//! `[outputs, inputs k k]` with these patches `[inputs k k, rows' columns' batch]` is already the
//! next layer's image, and a channel's statistics are those of a row. With burn's own
//! convolution and the system's allocator an HRN step takes more than twice as long as with these
//! (`benches/train_step.rs`, 2026-11-21).
//!
//! `patches` and `from_patches` are each other's adjoint, so the transposed convolution is the
//! same two steps in the other order, and so are all gradients.

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::flex::FlexTensor;
use burn::backend::ops::FloatTensorOps;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, backend_extension};
use burn::tensor::ops::{ConvOptions, ConvTransposeOptions};
use burn::tensor::{DType, Device, Tensor, TensorData, activation, module};
use rayon::prelude::*;

/// Stride of every convolution here.
pub const STRIDE: usize = 2;

/// A convolution: square images and kernels, stride 2, TF's SAME padding.
#[derive(Debug, Clone, Copy)]
pub struct Convolution {
    /// Prefix of the names of its weights.
    pub name: &'static str,
    /// Channels of the larger image.
    pub inputs: usize,
    /// Channels of the smaller image.
    pub outputs: usize,
    /// Rows and columns of the larger image.
    pub size: usize,
    /// Rows and columns of the kernel.
    pub kernel: usize,
    /// Zeros before and after, in rows as in columns.
    pub padding: (usize, usize),
    /// Whether batch normalisation follows.
    pub normalised: bool,
}

impl Convolution {
    /// Rows and columns of the smaller image.
    pub fn small(&self) -> usize {
        (self.size + self.padding.0 + self.padding.1 - self.kernel) / STRIDE + 1
    }

    /// Rows of the patches: `inputs kernel kernel`.
    fn taps(&self) -> usize {
        self.inputs * self.kernel * self.kernel
    }

    /// The row or column of the larger image under tap `tap` of patch `place`. `None` in the
    /// padding.
    fn under(&self, place: usize, tap: usize) -> Option<usize> {
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

/// Images `[outputs, small small batch]` of `x` `[inputs, size size batch]` under `kernels`
/// `[outputs, inputs, k, k]`, plus `bias` `[outputs, 1]`.
pub fn convolution(
    x: Tensor<2>,
    kernels: Tensor<4>,
    bias: Tensor<2>,
    layer: Convolution,
) -> Tensor<2> {
    if is_ours(&x) {
        let kernels = kernels.reshape([layer.outputs, layer.taps()]);
        return ours(Operation::Convolution(layer), x, kernels, bias);
    }
    let size = layer.size;
    let batch = x.dims()[1] / (size * size);
    let x = x.reshape([layer.inputs, size, size, batch]);
    let options = ConvOptions::new_with_padding([STRIDE; 2], [layer.padding; 2], [1; 2], 1);
    let sums = module::conv2d(x.permute([3, 0, 1, 2]), kernels, None, options);
    let places = layer.small() * layer.small() * batch;
    let sums = sums.permute([1, 2, 3, 0]).reshape([layer.outputs, places]);
    sums.add(bias)
}

/// The adjoint of [`convolution`]: images `[inputs, size size batch]` of `x`
/// `[outputs, small small batch]`, plus `bias` `[inputs, 1]`. Its usual name is transposed convolution.
pub fn transposed_convolution(
    x: Tensor<2>,
    kernels: Tensor<4>,
    bias: Tensor<2>,
    layer: Convolution,
) -> Tensor<2> {
    if is_ours(&x) {
        let kernels = kernels.reshape([layer.outputs, layer.taps()]);
        return ours(Operation::Transposed(layer), x, kernels, bias);
    }
    let (size, small, before) = (layer.size, layer.small(), layer.padding.0);
    let batch = x.dims()[1] / (small * small);
    // burn crops as much after as before. A row that is then missing lies past the last patch and
    // is 0. Rows that are too many are cut off.
    let full = (small - 1) * STRIDE + layer.kernel;
    let missing = (size + before).saturating_sub(full);
    let options =
        ConvTransposeOptions::new([STRIDE; 2], [before; 2], [missing + before; 2], [1; 2], 1);
    let x = x.reshape([layer.outputs, small, small, batch]);
    let images = module::conv_transpose2d(x.permute([3, 0, 1, 2]), kernels, None, options);
    let images = images.slice([0..batch, 0..layer.inputs, 0..size, 0..size]);
    let images = images.permute([1, 2, 3, 0]);
    let images = images.reshape([layer.inputs, size * size * batch]);
    images.add(bias)
}

/// Batch normalisation of the rows of `x` `[channels, numbers]`, then LeakyReLU; ReLU with
/// `slope` 0.
///
/// `y = leaky(gamma (x - mean) / sqrt(variance + epsilon) + beta)`, with each row's own mean and
/// biased variance. Gamma and beta are `[channels, 1]`.
pub fn normalised(
    x: Tensor<2>,
    gamma: Tensor<2>,
    beta: Tensor<2>,
    epsilon: f32,
    slope: f32,
) -> Tensor<2> {
    if is_ours(&x) {
        return ours(Operation::Normalisation { epsilon, slope }, x, gamma, beta);
    }
    let (variance, mean) = x.clone().var_mean_bias(1);
    let unit = x.sub(mean).div(variance.add_scalar(epsilon).sqrt());
    activation::leaky_relu(unit.mul(gamma).add(beta), f64::from(slope))
}

/// LeakyReLU, as a product with a constant where a gradient is wanted: burn's own computes the gradient with
/// `mask_where`, which took 17 % of a step. The gradient at 0 is the mean of both slopes.
pub fn leaky_relu<const D: usize>(x: Tensor<D>, slope: f32) -> Tensor<D> {
    if !x.is_autodiff() {
        return activation::leaky_relu(x, f64::from(slope));
    }
    let half = (1.0 - slope) / 2.0;
    let sign = x.clone().detach().sign();
    x.mul(sign.mul_scalar(half).add_scalar(1.0 - half))
}

/// An operation that burn lacks: on images x, a matrix or a column a, and a column b.
#[derive(Debug, Clone, Copy)]
enum Operation {
    /// x is the larger image, a has the kernels, b is the bias.
    Convolution(Convolution),
    /// x is the smaller image, a has the kernels, b is the bias.
    Transposed(Convolution),
    /// a is gamma, b is beta.
    Normalisation { epsilon: f32, slope: f32 },
}

fn ours(operation: Operation, x: Tensor<2>, a: Tensor<2>, b: Tensor<2>) -> Tensor<2> {
    let [x, a, b] = [x, a, b].map(Tensor::into_dispatch);
    Tensor::from_dispatch(<Dispatch as Layers>::layer(operation, x, a, b))
}

/// The operations, for burn's dispatch.
#[backend_extension(Autodiff, Flex)]
trait Layers: Backend {
    fn layer(
        operation: Operation,
        x: FloatTensor<Self>,
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
    ) -> FloatTensor<Self>;
}

impl Layers for Flex {
    fn layer(operation: Operation, x: FlexTensor, a: FlexTensor, b: FlexTensor) -> FlexTensor {
        operation.output(operation.kept([x, a, b]))
    }
}

impl<C: CheckpointStrategy> Layers for Autodiff<Flex, C> {
    fn layer(
        operation: Operation,
        x: FloatTensor<Self>,
        a: FloatTensor<Self>,
        b: FloatTensor<Self>,
    ) -> FloatTensor<Self> {
        let [(x, of_x), (a, of_a), (b, of_b)] = [x, a, b].map(FloatTensor::<Self>::into_parts);
        let kept = operation.kept([x, a, b]);
        let output = operation.output(kept.clone());
        let step = Step.prepare::<C>([of_x, of_a, of_b]);
        match step.compute_bound().stateful() {
            OpsKind::Tracked(step) => step.finish((operation, kept), output),
            OpsKind::UnTracked(step) => step.finish(output),
        }
    }
}

/// The way back of an operation.
#[derive(Debug)]
struct Step;

impl Backward<Flex, 3> for Step {
    type State = (Operation, [FlexTensor; 3]);

    fn backward(
        self,
        ops: Ops<Self::State, 3>,
        gradients: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let gradient = gradients.consume::<Flex>(&ops.node);
        let wanted = ops.parents.each_ref().map(Option::is_some);
        let (operation, kept) = ops.state;
        let found = operation.gradients(kept, gradient, wanted);
        for (parent, gradient) in ops.parents.into_iter().zip(found) {
            if let (Some(parent), Some(gradient)) = (parent, gradient) {
                gradients.register::<Flex>(parent.id, gradient);
            }
        }
    }
}

impl Operation {
    /// What output and gradients are computed from: the inputs, of a convolution with the patches in the place
    /// of the image.
    fn kept(self, [x, a, b]: [FlexTensor; 3]) -> [FlexTensor; 3] {
        match self {
            Self::Convolution(layer) => [patches(x, layer), a, b],
            Self::Transposed(_) => [x, a, b],
            Self::Normalisation { .. } => [x, a, b].map(contiguous),
        }
    }

    fn output(self, [x, a, b]: [FlexTensor; 3]) -> FlexTensor {
        match self {
            Self::Convolution(_) => Flex::float_add(Flex::float_matmul(a, x), b),
            Self::Transposed(layer) => {
                let products = Flex::float_matmul(Flex::float_transpose(a), x);
                Flex::float_add(from_patches(products, layer), b)
            }
            Self::Normalisation { epsilon, slope } => normalised_rows(&[x, a, b], epsilon, slope),
        }
    }

    /// The gradients of the inputs that are wanted, from that of the output.
    fn gradients(
        self,
        [x, a, b]: [FlexTensor; 3],
        gradient: FlexTensor,
        wanted: [bool; 3],
    ) -> [Option<FlexTensor>; 3] {
        let of_bias = |of: &FlexTensor| wanted[2].then(|| Flex::float_sum_dim(of.clone(), 1));
        match self {
            Self::Convolution(layer) => {
                let of_b = of_bias(&gradient);
                let of_a = wanted[1].then(|| of_kernels(x, gradient.clone()));
                let products = || Flex::float_matmul(Flex::float_transpose(a), gradient);
                let of_x = wanted[0].then(|| from_patches(products(), layer));
                [of_x, of_a, of_b]
            }
            Self::Transposed(layer) => {
                let of_b = of_bias(&gradient);
                let patches = patches(gradient, layer);
                let of_a = wanted[1].then(|| of_kernels(patches.clone(), x));
                let of_x = wanted[0].then(|| Flex::float_matmul(a, patches));
                [of_x, of_a, of_b]
            }
            Self::Normalisation { epsilon, slope } => {
                gradients_of_rows(&[x, a, b], gradient, epsilon, slope).map(Some)
            }
        }
    }
}

/// The kernels' gradient: the product of patches and the transposed `small` image, transposed. burn's product
/// of image and transposed patches would first copy the many patches into another order, on one thread. Here
/// only the image is copied, which is smaller.
fn of_kernels(patches: FlexTensor, small: FlexTensor) -> FlexTensor {
    Flex::float_transpose(Flex::float_matmul(patches, Flex::float_transpose(small)))
}

/// The same tensor with its numbers in row-major order, whatever its strides.
fn contiguous(tensor: FlexTensor) -> FlexTensor {
    match tensor.as_slice::<f32>() {
        Some(_) => tensor,
        None => tensor.to_contiguous(),
    }
}

fn numbers(tensor: &FlexTensor) -> &[f32] {
    tensor
        .as_slice()
        .expect("contiguous, and all our tensors are of f32")
}

fn tensor(values: Vec<f32>, rows: usize) -> FlexTensor {
    let columns = values.len() / rows;
    FlexTensor::from_data(TensorData::new(values, [rows, columns]))
}

/// The numbers under the kernel at each of its places: `[inputs k k, small small batch]`.
fn patches(x: FlexTensor, layer: Convolution) -> FlexTensor {
    let x = contiguous(x);
    let image = numbers(&x).len() / layer.inputs;
    let batch = image / (layer.size * layer.size);
    let row = layer.small() * layer.small() * batch;
    let taps = layer.kernel * layer.kernel;
    let mut values = vec![0.0; layer.taps() * row];
    let rows = values.par_chunks_exact_mut(row).enumerate();
    rows.for_each(|(index, patches)| {
        let image = &numbers(&x)[index / taps * image..][..image];
        let runs = layer.runs(index % taps, batch);
        for (run, patch) in runs.zip(patches.chunks_exact_mut(batch)) {
            let Some(run) = run else { continue };
            patch.copy_from_slice(&image[run..run + batch]);
        }
    });
    tensor(values, layer.taps())
}

/// The adjoint of [`patches`]: adds every number at the place it would have come from.
fn from_patches(patches: FlexTensor, layer: Convolution) -> FlexTensor {
    let patches = contiguous(patches);
    let of_channel = numbers(&patches).len() / layer.inputs;
    let taps = layer.kernel * layer.kernel;
    let batch = of_channel / (taps * layer.small() * layer.small());
    let image = layer.size * layer.size * batch;
    let mut values = vec![0.0; layer.inputs * image];
    let patches = numbers(&patches).par_chunks_exact(of_channel);
    let channels = values.par_chunks_exact_mut(image).zip(patches);
    channels.for_each(|(image, patches)| {
        let runs = (0..taps).flat_map(|tap| layer.runs(tap, batch));
        for (run, patch) in runs.zip(patches.chunks_exact(batch)) {
            let Some(run) = run else { continue };
            for (sum, value) in image[run..run + batch].iter_mut().zip(patch) {
                *sum += value;
            }
        }
    });
    tensor(values, layer.inputs)
}

/// `y = leaky(scale (x - mean) + beta)` of one row.
struct Row {
    mean: f32,
    /// `1 / sqrt(variance + epsilon)`
    rate: f32,
    /// gamma times the rate.
    scale: f32,
    beta: f32,
}

/// Every row of x with its constants.
fn rows(
    [x, gamma, beta]: &[FlexTensor; 3],
    epsilon: f32,
) -> impl IndexedParallelIterator<Item = (&[f32], Row)> {
    let parameters = (numbers(gamma).par_iter()).zip(numbers(beta));
    let rows = numbers(x).par_chunks_exact(numbers(x).len() / numbers(gamma).len());
    rows.zip(parameters).map(move |(x, (gamma, &beta))| {
        let count = x.len() as f32;
        let mean = sum(x, x, |x, _| x) / count;
        let variance = sum(x, x, |x, y| (x - mean) * (y - mean)) / count;
        let rate = 1.0 / (variance + epsilon).sqrt();
        let scale = gamma * rate;
        let row = Row {
            mean,
            rate,
            scale,
            beta,
        };
        (x, row)
    })
}

fn normalised_rows(inputs: &[FlexTensor; 3], epsilon: f32, slope: f32) -> FlexTensor {
    let [channels, count] = [numbers(&inputs[1]).len(), numbers(&inputs[0]).len()];
    let mut values = vec![0.0; count];
    let of_channel = values.par_chunks_exact_mut(count / channels);
    of_channel
        .zip(rows(inputs, epsilon))
        .for_each(|(values, (x, row))| {
            for (y, x) in values.iter_mut().zip(x) {
                let z = row.scale * (x - row.mean) + row.beta;
                *y = z.max(slope * z);
            }
        });
    tensor(values, channels)
}

/// Gradients of x, gamma and beta from that of y. With `u = (x - mean) rate` and `g` the
/// gradient before the LeakyReLU, `dx = gamma rate (g - mean(g) - u mean(g u))`.
fn gradients_of_rows(
    inputs: &[FlexTensor; 3],
    gradient: FlexTensor,
    epsilon: f32,
    slope: f32,
) -> [FlexTensor; 3] {
    let gradient = contiguous(gradient);
    let channels = numbers(&inputs[1]).len();
    let count = numbers(&gradient).len() / channels;
    let mut of_x = vec![0.0; channels * count];
    let (of_gamma, of_beta) = of_x
        .par_chunks_exact_mut(count)
        .zip(numbers(&gradient).par_chunks_exact(count))
        .zip(rows(inputs, epsilon))
        .map(|((of_x, gradient), (x, row))| {
            // `of_x` first holds the gradient before the LeakyReLU, and then the gradient of x.
            for ((before, x), gradient) in of_x.iter_mut().zip(x).zip(gradient) {
                let z = row.scale * (x - row.mean) + row.beta;
                *before = gradient * if z > 0.0 { 1.0 } else { slope };
            }
            let total = sum(of_x, x, |g, _| g);
            let product = row.rate * sum(of_x, x, |g, x| g * (x - row.mean));
            let (mean, share) = (total / count as f32, product / count as f32);
            for (g, x) in of_x.iter_mut().zip(x) {
                *g = row.scale * (*g - mean - (x - row.mean) * row.rate * share);
            }
            (product, total)
        })
        .unzip();
    [of_x, of_gamma, of_beta].map(|values| tensor(values, channels))
}

/// Numbers added side by side: enough for the widest registers, and a fixed order of summing.
const LANES: usize = 16;

/// The sum of the terms of two rows.
fn sum(a: &[f32], b: &[f32], term: impl Fn(f32, f32) -> f32) -> f32 {
    let mut lanes = [0.0_f32; LANES];
    let (a_parts, b_parts) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let rest = a_parts.remainder().iter().zip(b_parts.remainder());
    let rest: f32 = rest.map(|(&a, &b)| term(a, b)).sum();
    for (a, b) in a_parts.zip(b_parts) {
        for (lane, (&a, &b)) in lanes.iter_mut().zip(a.iter().zip(b)) {
            *lane += term(a, b);
        }
    }
    lanes.iter().sum::<f32>() + rest
}

#[cfg(test)]
mod tests;
