use super::*;
use crate::net::network::{TRUNK, numbers};
use burn::tensor::{FloatDType, TensorData};
use hardnessd_simulator::random::Stream;

fn random<const D: usize>(shape: [usize; D], name: &str) -> Tensor<D> {
    let mut stream = Stream::new(11, name);
    let values: Vec<f32> = (0..shape.iter().product())
        .map(|_| stream.normal() as f32)
        .collect();
    Tensor::from_data(TensorData::new(values, shape), &Device::flex())
}

/// The trunk's three layers, whose adjoints are the generator's.
fn geometries() -> Vec<(Geometry, usize)> {
    let layers = TRUNK.iter().zip([28, 14, 7]);
    layers
        .map(|(layer, size)| (layer.geometry(size), layer.outputs))
        .collect()
}

/// The same tensor in double precision, for which burn's own operations run.
fn double<const D: usize>(tensor: &Tensor<D>) -> Tensor<D> {
    tensor.clone().cast(FloatDType::F64)
}

/// Checks `f` and its gradients in single precision against the same in double.
#[allow(clippy::needless_pass_by_value, reason = "reads as a call of f")]
fn check<const D: usize, const P: usize, const O: usize>(
    x: Tensor<D>,
    parameters: Tensor<P>,
    f: impl Fn(Tensor<D>, Tensor<P>) -> Tensor<O>,
) {
    assert!(is_ours(&x) && !is_ours(&double(&x)));
    let run = |x: Tensor<D>, parameters: Tensor<P>| {
        let (x, parameters) = (
            x.autodiff().require_grad(),
            parameters.autodiff().require_grad(),
        );
        let y = f(x.clone(), parameters.clone());
        let weight = random(y.dims(), "gradient").cast(y.dtype()).autodiff();
        let gradients = y.clone().mul(weight).sum().backward();
        let of_x = x.grad(&gradients).expect("a leaf");
        let of_parameters = parameters.grad(&gradients).expect("a leaf");
        (y.inner(), of_x, of_parameters)
    };
    let (y, of_x, of_parameters) = run(x.clone(), parameters.clone());
    let (exact, exact_of_x, exact_of_parameters) = run(double(&x), double(&parameters));
    assert_close(&y, &exact);
    assert_close(&of_x, &exact_of_x);
    assert_close(&of_parameters, &exact_of_parameters);
}

fn assert_close<const D: usize>(found: &Tensor<D>, exact: &Tensor<D>) {
    assert_eq!(found.dims(), exact.dims());
    let exact = numbers(&exact.clone().cast(FloatDType::F32));
    let largest = exact.iter().map(|value| value.abs()).fold(0.0, f32::max);
    for (found, exact) in numbers(found).iter().zip(&exact) {
        assert!((found - exact).abs() < 1e-5 * largest, "{found} {exact}");
    }
}

#[test]
fn convolutions_both_ways_are_burns_with_their_gradients() {
    let batch = 3;
    for (geometry, outputs) in geometries() {
        let Geometry {
            channels,
            size,
            kernel,
            ..
        } = geometry;
        let kernels = random([outputs, channels * kernel * kernel], "kernels");
        let x = random([channels, size, size, batch], "x");
        check(x, kernels.clone(), |x, k| convolution(x, k, geometry));
        let small = geometry.small();
        let y = random([outputs, small, small, batch], "y");
        check(y, kernels, |y, k| transposed_convolution(y, k, geometry));
    }
}

#[test]
fn normalisation_is_that_of_its_formula_with_its_gradients() {
    let (channels, count, epsilon) = (5, 83, 1e-3);
    let x = random([channels, count], "x")
        .mul_scalar(0.3)
        .add_scalar(2.0);
    for slope in [0.0, 0.2] {
        let other = random([2 * channels], "parameters");
        check(x.clone(), other, |x, parameters| {
            let gamma = parameters.clone().narrow(0, 0, channels);
            let beta = parameters.narrow(0, channels, channels);
            normalised(x, gamma, beta, epsilon, slope)
        });
    }
}
