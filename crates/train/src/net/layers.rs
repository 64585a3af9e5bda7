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

mod cpu;

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind, unary};
use burn::backend::flex::FlexTensor;
use burn::backend::ops::FloatTensorOps;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, backend_extension};
use burn::tensor::ops::{ConvOptions, ConvTransposeOptions};
use burn::tensor::{DType, Device, Tensor, activation, module};

use cpu::Rows;

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

/// The matrix product. It differs from burn's own only in the kernels' gradient, which is the
/// product of patches and transposed gradient, transposed. burn's product of gradient and
/// transposed patches would first copy the many patches into another order, on one thread. Here
/// only the gradient is copied, which is smaller.
#[derive(Debug)]
struct ProductStep;

impl Backward<Flex, 2> for ProductStep {
    type State = [FlexTensor; 2];

    fn backward(
        self,
        ops: Ops<Self::State, 2>,
        gradients: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let gradient = gradients.consume::<Flex>(&ops.node);
        let [kernels, patches] = ops.state;
        let [of_kernels, of_patches] = ops.parents;
        if let Some(parent) = of_kernels {
            let transposed = Flex::float_transpose(gradient.clone());
            let product = Flex::float_matmul(patches, transposed);
            gradients.register::<Flex>(parent.id, Flex::float_transpose(product));
        }
        if let Some(parent) = of_patches {
            let product = Flex::float_matmul(Flex::float_transpose(kernels), gradient);
            gradients.register::<Flex>(parent.id, product);
        }
    }
}

#[derive(Debug)]
struct PatchesStep;

impl Backward<Flex, 1> for PatchesStep {
    type State = (Geometry, usize);

    fn backward(
        self,
        ops: Ops<Self::State, 1>,
        gradients: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let (geometry, batch) = ops.state;
        unary::<Flex, _>(ops.parents, ops.node, gradients, |gradient| {
            Flex::from_patches(gradient, geometry, batch)
        });
    }
}

#[derive(Debug)]
struct FromPatchesStep;

impl Backward<Flex, 1> for FromPatchesStep {
    type State = Geometry;

    fn backward(
        self,
        ops: Ops<Self::State, 1>,
        gradients: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        unary::<Flex, _>(ops.parents, ops.node, gradients, |gradient| {
            Flex::patches(gradient, ops.state)
        });
    }
}

#[derive(Debug)]
struct NormalisedStep;

impl Backward<Flex, 3> for NormalisedStep {
    /// x, gamma and beta; epsilon and slope.
    type State = ([FlexTensor; 3], [f32; 2]);

    fn backward(
        self,
        ops: Ops<Self::State, 3>,
        gradients: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let gradient = gradients.consume::<Flex>(&ops.node);
        let ([x, gamma, beta], [epsilon, slope]) = ops.state;
        let all = Rows::new(x, gamma, beta, epsilon, slope).backward(gradient);
        for (parent, gradient) in ops.parents.into_iter().zip(all) {
            if let Some(parent) = parent {
                gradients.register::<Flex>(parent.id, gradient);
            }
        }
    }
}

#[derive(Debug)]
struct LeakyReluStep;

impl Backward<Flex, 1> for LeakyReluStep {
    type State = (FlexTensor, f32);

    fn backward(
        self,
        ops: Ops<Self::State, 1>,
        gradients: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let (x, slope) = ops.state;
        unary::<Flex, _>(ops.parents, ops.node, gradients, |gradient| {
            cpu::leaky(gradient, x, slope)
        });
    }
}

impl<C: CheckpointStrategy> Layers for Autodiff<Flex, C> {
    fn product(kernels: FloatTensor<Self>, patches: FloatTensor<Self>) -> FloatTensor<Self> {
        let (kernels, kernels_node) = kernels.into_parts();
        let (patches, patches_node) = patches.into_parts();
        let state = [kernels.clone(), patches.clone()];
        let output = Flex::product(kernels, patches);
        let prepared = ProductStep.prepare::<C>([kernels_node, patches_node]);
        match prepared.compute_bound().stateful() {
            OpsKind::Tracked(step) => step.finish(state, output),
            OpsKind::UnTracked(step) => step.finish(output),
        }
    }

    fn patches(x: FloatTensor<Self>, geometry: Geometry) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        let batch = x.layout().shape()[3];
        let output = Flex::patches(x, geometry);
        match PatchesStep.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(step) => step.finish((geometry, batch), output),
            OpsKind::UnTracked(step) => step.finish(output),
        }
    }

    fn from_patches(
        patches: FloatTensor<Self>,
        geometry: Geometry,
        batch: usize,
    ) -> FloatTensor<Self> {
        let (patches, node) = patches.into_parts();
        let output = Flex::from_patches(patches, geometry, batch);
        let prepared = FromPatchesStep.prepare::<C>([node]);
        match prepared.compute_bound().stateful() {
            OpsKind::Tracked(step) => step.finish(geometry, output),
            OpsKind::UnTracked(step) => step.finish(output),
        }
    }

    fn normalised(
        x: FloatTensor<Self>,
        gamma: FloatTensor<Self>,
        beta: FloatTensor<Self>,
        epsilon: f32,
        slope: f32,
    ) -> FloatTensor<Self> {
        let (x, x_node) = x.into_parts();
        let (gamma, gamma_node) = gamma.into_parts();
        let (beta, beta_node) = beta.into_parts();
        let state = ([x.clone(), gamma.clone(), beta.clone()], [epsilon, slope]);
        let output = Flex::normalised(x, gamma, beta, epsilon, slope);
        let prepared = NormalisedStep.prepare::<C>([x_node, gamma_node, beta_node]);
        match prepared.compute_bound().stateful() {
            OpsKind::Tracked(step) => step.finish(state, output),
            OpsKind::UnTracked(step) => step.finish(output),
        }
    }

    fn leaky_relu(x: FloatTensor<Self>, slope: f32) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        let output = Flex::leaky_relu(x.clone(), slope);
        match LeakyReluStep
            .prepare::<C>([node])
            .compute_bound()
            .stateful()
        {
            OpsKind::Tracked(step) => step.finish((x, slope), output),
            OpsKind::UnTracked(step) => step.finish(output),
        }
    }
}

#[cfg(test)]
mod tests;
