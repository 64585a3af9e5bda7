//! Minibatch discrimination, an option of DeLiGAN's discriminator: how close a sample's features
//! are to those of the rest of its batch, which tells a generator that makes one frame again and
//! again from real samples (Salimans 2016, section 3.2).
//!
//! In: features of a batch. Out: the same and a number a kernel beside. The recogniser never has
//! it: it couples the samples of a batch.

use burn::tensor::{Device, Tensor};

use crate::random::Stream;
use crate::train::network::{FEATURES, Weights};

/// Numbers it adds to the features, as DeLiGAN's code.
const KERNELS: usize = 64;
/// Numbers of a kernel (ditto).
const NUMBERS: usize = 5;
/// Standard deviation of the matrix before training (ditto).
const INITIAL_DEVIATION: f64 = 0.05;
/// Prefix of its weights' names.
pub(in crate::train) const PREFIX: &str = "minibatch.";

/// Adds its initial weights; the head after it takes the width that is given back.
pub(super) fn add(weights: &mut Weights, stream: &Stream, device: &Device) -> usize {
    let mut stream = stream.child(u64::from(u32::MAX));
    let columns = KERNELS * NUMBERS;
    let matrix = (0..FEATURES * columns)
        .map(|_| (stream.normal() * INITIAL_DEVIATION) as f32)
        .collect();
    let name = |part: &str| format!("{PREFIX}{part}");
    weights.add(&name("matrix"), &[FEATURES, columns], matrix, device);
    weights.add(&name("log_scale"), &[columns], vec![0.0; columns], device);
    FEATURES + KERNELS
}

/// Features `[batch, 64]` to `[batch, 128]`, if `weights` have it; else as they are.
pub(super) fn beside(weights: &Weights, features: Tensor<2>) -> Tensor<2> {
    if !weights.has(&format!("{PREFIX}matrix")) {
        return features;
    }
    let [batch, _] = features.dims();
    let columns = KERNELS * NUMBERS;
    let matrix = weights.tensor::<2>(&format!("{PREFIX}matrix"));
    let log_scale = weights.tensor::<1>(&format!("{PREFIX}log_scale"));
    // Every column has the length that its scale says.
    let length = matrix.clone().mul(matrix.clone()).sum_dim(0).sqrt();
    let scale = log_scale.reshape([1, columns]).exp().div(length);
    let rows = features.clone().matmul(matrix.mul(scale)).transpose();
    // c[k, i, j] = exp(-|M_ik - M_jk|), an L1 distance over a kernel's numbers
    let distance = rows
        .clone()
        .reshape([columns, batch, 1])
        .sub(rows.reshape([columns, 1, batch]))
        .abs()
        .reshape([KERNELS, NUMBERS, batch * batch])
        .sum_dim(1)
        .reshape([KERNELS, batch, batch]);
    let closeness = distance.neg().exp();
    // Over its sum, as DeLiGAN's code has it and Salimans' has not.
    let total = closeness.clone().sum().reshape([1, 1]);
    let of_sample = closeness.sum_dim(2).reshape([KERNELS, batch]).transpose();
    Tensor::cat(vec![features, of_sample.div(total)], 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::network::numbers;
    use burn::tensor::TensorData;

    #[test]
    fn closeness_is_that_of_the_formula() {
        let device = Device::flex();
        let mut weights = Weights::default();
        assert_eq!(add(&mut weights, &Stream::new(1, "test"), &device), 128);
        // With the head's 128 + 1, 20,864 more than the 32,001 without.
        assert_eq!(weights.count() + 64, 52_865 - 32_001);
        let scale = weights.entries.last_mut().unwrap();
        scale.values = scale.values.clone().add_scalar(0.7);

        let batch = 3;
        let mut stream = Stream::new(2, "features");
        let features: Vec<f64> = (0..batch * FEATURES).map(|_| stream.normal()).collect();
        let values: Vec<f32> = features.iter().map(|value| *value as f32).collect();
        let tensor = Tensor::from_data(TensorData::new(values, [batch, FEATURES]), &device);
        let found = numbers(&beside(&weights, tensor));

        let matrix = weights.numbers("minibatch.matrix");
        let columns = KERNELS * NUMBERS;
        let at = |row: usize, column: usize| f64::from(matrix[row * columns + column]);
        let product = |sample: usize, column: usize| -> f64 {
            let length = (0..FEATURES)
                .map(|row| at(row, column).powi(2))
                .sum::<f64>();
            let sum = (0..FEATURES).map(|row| features[sample * FEATURES + row] * at(row, column));
            sum.sum::<f64>() * 0.7_f64.exp() / length.sqrt()
        };
        let closeness = |kernel: usize, one: usize, other: usize| -> f64 {
            let numbers = kernel * NUMBERS..(kernel + 1) * NUMBERS;
            let apart = numbers.map(|column| (product(one, column) - product(other, column)).abs());
            (-apart.sum::<f64>()).exp()
        };
        let of_sample = |kernel: usize, one: usize| -> f64 {
            (0..batch).map(|other| closeness(kernel, one, other)).sum()
        };
        let kernels = || (0..KERNELS).flat_map(|kernel| (0..batch).map(move |one| (kernel, one)));
        let total: f64 = kernels().map(|(kernel, one)| of_sample(kernel, one)).sum();
        for (kernel, one) in kernels() {
            let found = f64::from(found[one * (FEATURES + KERNELS) + FEATURES + kernel]);
            let expected = of_sample(kernel, one) / total;
            assert!((found - expected).abs() < 1e-6, "{found} {expected}");
        }
        assert_eq!(f64::from(found[5]), f64::from(features[5] as f32));
    }

    #[test]
    fn weights_without_it_leave_features_alone() {
        let features = Tensor::<2>::ones([4, FEATURES], &Device::flex());
        assert_eq!(beside(&Weights::default(), features).dims(), [4, FEATURES]);
    }
}
