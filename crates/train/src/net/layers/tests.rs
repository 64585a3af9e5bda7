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

/// The same tensor in double precision, for which burn's own operations run.
fn double<const D: usize>(tensor: &Tensor<D>) -> Tensor<D> {
    tensor.clone().cast(FloatDType::F64)
}

/// Checks `f` and its gradients in single precision against the same in double.
fn check<const A: usize>(
    x: &Tensor<2>,
    a: &Tensor<A>,
    channels: usize,
    f: impl Fn(Tensor<2>, Tensor<A>, Tensor<2>) -> Tensor<2>,
) {
    let b = random([channels, 1], "b");
    assert!(is_ours(x) && !is_ours(&double(x)));
    let run = |x: Tensor<2>, a: Tensor<A>, b: Tensor<2>| {
        let [x, b] = [x, b].map(|leaf| leaf.autodiff().require_grad());
        let a = a.autodiff().require_grad();
        let y = f(x.clone(), a.clone(), b.clone());
        let weight = random(y.dims(), "gradient").cast(y.dtype()).autodiff();
        let gradients = y.clone().mul(weight).sum().backward();
        let [of_x, of_b] = [x, b].map(|leaf| leaf.grad(&gradients).expect("a leaf"));
        ([y.inner(), of_x, of_b], a.grad(&gradients).expect("a leaf"))
    };
    let (found, of_a) = run(x.clone(), a.clone(), b.clone());
    let (exact, exact_of_a) = run(double(x), double(a), double(&b));
    assert_close(&of_a, &exact_of_a);
    for (found, exact) in found.iter().zip(&exact) {
        assert_close(found, exact);
    }
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
    for layer in TRUNK {
        let (inputs, outputs, small) = (layer.inputs, layer.outputs, layer.small());
        let kernels = random([outputs, inputs, layer.kernel, layer.kernel], "kernels");
        let x = random([inputs, layer.size * layer.size * batch], "x");
        check(&x, &kernels, outputs, |x, k, b| convolution(x, k, b, layer));
        let y = random([outputs, small * small * batch], "y");
        check(&y, &kernels, inputs, |y, k, b| {
            transposed_convolution(y, k, b, layer)
        });
    }
}

#[test]
fn normalisation_is_that_of_its_formula_with_its_gradients() {
    let (channels, count, epsilon) = (5, 83, 1e-3);
    let x = random([channels, count], "x")
        .mul_scalar(0.3)
        .add_scalar(2.0);
    let gamma = random([channels, 1], "gamma");
    for slope in [0.0, 0.2] {
        check(&x, &gamma, channels, |x, gamma, beta| {
            normalised(x, gamma, beta, epsilon, slope)
        });
    }
}
