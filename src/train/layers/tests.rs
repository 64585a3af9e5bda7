use super::*;
use crate::random::Stream;
use crate::train::network::{TRUNK, numbers};
use burn::tensor::ops::ConvOptions;
use burn::tensor::{Device, activation, module};

fn random<const D: usize>(shape: [usize; D], name: &str) -> Tensor<D> {
    let mut stream = Stream::new(11, name);
    let values: Vec<f32> = (0..shape.iter().product())
        .map(|_| stream.normal() as f32)
        .collect();
    Tensor::from_data(TensorData::new(values, shape), &Device::flex())
}

fn largest_difference<const D: usize>(left: &Tensor<D>, right: &Tensor<D>) -> f32 {
    assert_eq!(left.dims(), right.dims());
    let (left, right) = (numbers(left), numbers(right));
    let differences = left.iter().zip(&right).map(|(l, r)| (l - r).abs());
    differences.fold(0.0, f32::max)
}

fn dot<const D: usize>(left: &Tensor<D>, right: &Tensor<D>) -> f64 {
    let (left, right) = (numbers(left), numbers(right));
    let products = left.iter().zip(&right).map(|(l, r)| f64::from(l * r));
    products.sum()
}

/// The trunk's three layers, whose adjoints are the generator's.
fn geometries() -> Vec<(Geometry, usize)> {
    let layers = TRUNK.iter().zip([28, 14, 7]);
    layers
        .map(|(layer, size)| (layer.geometry(size), layer.outputs))
        .collect()
}

#[test]
fn convolution_is_burns_in_another_order() {
    let batch = 3;
    for (geometry, outputs) in geometries() {
        let Geometry {
            channels,
            size,
            kernel,
            padding,
        } = geometry;
        let x = random([channels, size, size, batch], "x")
            .autodiff()
            .require_grad();
        let kernels = random([outputs, channels, kernel, kernel], "kernels");
        let kernels = kernels.autodiff().require_grad();
        let taps = channels * kernel * kernel;
        let ours = convolution(
            x.clone(),
            kernels.clone().reshape([outputs, taps]),
            geometry,
        );
        let options = ConvOptions::new_with_padding([STRIDE; 2], [padding; 2], [1, 1], 1);
        let burns = module::conv2d(
            x.clone().permute([3, 0, 1, 2]),
            kernels.clone(),
            None,
            options,
        )
        .permute([1, 2, 3, 0]);
        assert!(largest_difference(&ours, &burns) < 1e-3, "{geometry:?}");

        let weight = random(ours.dims(), "gradient").autodiff();
        let (ours, burns) = (
            ours.mul(weight.clone()).sum().backward(),
            burns.mul(weight).sum().backward(),
        );
        let of = |leaf: &Tensor<4>, gradients| leaf.grad(gradients).expect("a leaf");
        for leaf in [&x, &kernels] {
            let difference = largest_difference(&of(leaf, &ours), &of(leaf, &burns));
            assert!(difference < 2e-3, "{geometry:?}: {difference}");
        }
    }
}

#[test]
fn transposed_convolution_is_the_adjoint_of_convolution() {
    let batch = 5;
    for (geometry, outputs) in geometries() {
        let Geometry {
            channels,
            size,
            kernel,
            ..
        } = geometry;
        let small = geometry.small();
        let x = random([channels, size, size, batch], "x");
        let y = random([outputs, small, small, batch], "y");
        let kernels = random([outputs, channels * kernel * kernel], "kernels");
        let forth = convolution(x.clone(), kernels.clone(), geometry);
        let there = dot(&forth, &y);
        let back = dot(&x, &transposed_convolution(y.clone(), kernels, geometry));
        let scale = (dot(&forth, &forth) * dot(&y, &y)).sqrt();
        assert!((there - back).abs() < 1e-6 * scale, "{there} {back}");
    }
}

#[test]
fn normalisation_is_that_of_its_formula_with_its_gradients() {
    let (channels, count, epsilon) = (5, 83, 1e-3);
    for slope in [0.0, 0.2] {
        let leaf = |tensor: Tensor<2>| tensor.autodiff().require_grad();
        let x = leaf(
            random([channels, count], "x")
                .mul_scalar(0.3)
                .add_scalar(2.0),
        );
        let gamma = random([channels], "gamma").autodiff().require_grad();
        let beta = random([channels], "beta").autodiff().require_grad();
        let ours = normalised(x.clone(), gamma.clone(), beta.clone(), epsilon, slope);

        let (variance, mean) = x.clone().var_mean_bias(1);
        let unit = x.clone().sub(mean).div(variance.add_scalar(epsilon).sqrt());
        let along = [channels, 1];
        let plain = unit
            .mul(gamma.clone().reshape(along))
            .add(beta.clone().reshape(along));
        let plain = activation::leaky_relu(plain, f64::from(slope));
        assert!(largest_difference(&ours, &plain) < 1e-5);

        let weight = random([channels, count], "gradient").autodiff();
        let ours = ours.mul(weight.clone()).sum().backward();
        let plain = plain.mul(weight).sum().backward();
        let of_x = |gradients| x.grad(gradients).expect("a leaf");
        assert!(largest_difference(&of_x(&ours), &of_x(&plain)) < 1e-3);
        for leaf in [&gamma, &beta] {
            let of = |gradients| leaf.grad(gradients).expect("a leaf");
            assert!(largest_difference(&of(&ours), &of(&plain)) < 1e-3);
        }
    }
}
