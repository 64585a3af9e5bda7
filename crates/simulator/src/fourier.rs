//! Free-space convolution with an even kernel on a square window, by real 2-D FFTs.
//!
//! The window is zero-padded to twice its width, so nothing wraps around. Fields are f32, because
//! the contact solver stops at 1e-3, four orders above the error of f32 FFTs.

use std::sync::Arc;

use realfft::{ComplexToReal, RealFftPlanner, RealToComplex, num_complex::Complex32};
use rustfft::{Fft, FftPlanner};

/// Plans and buffers for one window width.
pub(super) struct Convolver {
    /// Width of the window in cells.
    pub(super) width: usize,
    forward: Arc<dyn RealToComplex<f32>>,
    inverse: Arc<dyn ComplexToReal<f32>>,
    column_forward: Arc<dyn Fft<f32>>,
    column_inverse: Arc<dyn Fft<f32>>,
    /// `[2 * width]`: one padded row.
    real: Vec<f32>,
    /// `[2 * width, width + 1]`: the rows' half spectra.
    rows: Vec<Complex32>,
    /// `[width + 1, 2 * width]`: the half spectra transposed, so that columns are contiguous.
    columns: Vec<Complex32>,
    scratch: Vec<Complex32>,
}

impl Convolver {
    /// Plans for windows of `width` x `width` cells.
    pub(super) fn new(width: usize) -> Self {
        let padded = 2 * width;
        let mut real_planner = RealFftPlanner::<f32>::new();
        let mut planner = FftPlanner::<f32>::new();
        let forward = real_planner.plan_fft_forward(padded);
        let inverse = real_planner.plan_fft_inverse(padded);
        let column_forward = planner.plan_fft_forward(padded);
        let column_inverse = planner.plan_fft_inverse(padded);
        let scratch = [
            forward.get_scratch_len(),
            inverse.get_scratch_len(),
            column_forward.get_inplace_scratch_len(),
            column_inverse.get_inplace_scratch_len(),
        ];
        let zero = Complex32::new(0.0, 0.0);
        Self {
            width,
            forward,
            inverse,
            column_forward,
            column_inverse,
            real: vec![0.0; padded],
            rows: vec![zero; padded * (width + 1)],
            columns: vec![zero; padded * (width + 1)],
            scratch: vec![zero; scratch.into_iter().max().unwrap_or(0)],
        }
    }

    /// The spectrum `[width + 1, 2 * width]` of a kernel that is even in both offsets. `kernel`
    /// gives it at offsets of 0 to `width` cells. The spectrum is real, because the kernel is even,
    /// and includes the inverse transform's factor 1/N.
    pub(super) fn spectrum(&mut self, kernel: impl Fn(usize, usize) -> f64) -> Vec<f32> {
        let (width, padded, bins) = (self.width, 2 * self.width, self.width + 1);
        for i in 0..=width {
            for j in 0..=width {
                let value = kernel(i, j) as f32;
                self.real[j] = value;
                self.real[(padded - j) % padded] = value;
            }
            self.forward_row(i);
            if i > 0 && i < width {
                self.rows
                    .copy_within(i * bins..(i + 1) * bins, (padded - i) * bins);
            }
        }
        let shape = (padded, bins);
        transpose(&self.rows, &mut self.columns, shape, (bins, padded));
        self.column_forward
            .process_with_scratch(&mut self.columns, &mut self.scratch);
        let scale = 1.0 / (padded * padded) as f32;
        self.columns.iter().map(|value| value.re * scale).collect()
    }

    /// `output = kernel * input`, both `[width, width]`, the kernel given by its spectrum.
    pub(super) fn convolve(&mut self, spectrum: &[f32], input: &[f32], output: &mut [f32]) {
        let (width, padded, bins) = (self.width, 2 * self.width, self.width + 1);
        for (i, row) in input.chunks_exact(width).enumerate() {
            if row.iter().all(|&value| value == 0.0) {
                self.rows[i * bins..(i + 1) * bins].fill(Complex32::new(0.0, 0.0));
                continue;
            }
            self.real[..width].copy_from_slice(row);
            self.real[width..].fill(0.0);
            self.forward_row(i);
        }
        transpose(&self.rows, &mut self.columns, (width, bins), (bins, padded));
        for column in self.columns.chunks_exact_mut(padded) {
            column[width..].fill(Complex32::new(0.0, 0.0));
        }
        self.column_forward
            .process_with_scratch(&mut self.columns, &mut self.scratch);
        for (value, &factor) in self.columns.iter_mut().zip(spectrum) {
            value.re *= factor;
            value.im *= factor;
        }
        self.column_inverse
            .process_with_scratch(&mut self.columns, &mut self.scratch);
        transpose(&self.columns, &mut self.rows, (bins, padded), (width, bins));
        for (i, row) in output.chunks_exact_mut(width).enumerate() {
            let half = &mut self.rows[i * bins..(i + 1) * bins];
            // Rounding leaves a trace of imaginary part where a real signal has none, and
            // realfft rejects it.
            half[0].im = 0.0;
            half[width].im = 0.0;
            self.inverse
                .process_with_scratch(half, &mut self.real, &mut self.scratch)
                .expect("the buffers have the plan's lengths");
            row.copy_from_slice(&self.real[..width]);
        }
    }

    fn forward_row(&mut self, i: usize) {
        let bins = self.width + 1;
        let half = &mut self.rows[i * bins..(i + 1) * bins];
        self.forward
            .process_with_scratch(&mut self.real, half, &mut self.scratch)
            .expect("the buffers have the plan's lengths");
    }
}

/// `to[j, i] = from[i, j]` over the part that both hold. Shapes are (rows, columns). The copy goes
/// in tiles, so that both sides stay in the cache.
fn transpose(
    from: &[Complex32],
    to: &mut [Complex32],
    shape: (usize, usize),
    into: (usize, usize),
) {
    const TILE: usize = 8;
    let (rows, columns) = (shape.0.min(into.1), shape.1.min(into.0));
    for i0 in (0..rows).step_by(TILE) {
        for j0 in (0..columns).step_by(TILE) {
            for j in j0..(j0 + TILE).min(columns) {
                for i in i0..(i0 + TILE).min(rows) {
                    to[j * into.1 + i] = from[i * shape.1 + j];
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Stream;

    #[test]
    fn convolution_equals_the_double_sum_in_free_space() {
        let width = 24;
        let kernel = |i: usize, j: usize| 1.0 / (1.0 + (i * i + 2 * j * j) as f64);
        let mut convolver = Convolver::new(width);
        let spectrum = convolver.spectrum(kernel);
        let mut random = Stream::new(1, "convolution");
        let input: Vec<f32> = (0..width * width)
            .map(|_| random.uniform() as f32)
            .collect();
        let mut output = vec![0.0; width * width];
        convolver.convolve(&spectrum, &input, &mut output);
        for (i, j) in [(0, 0), (5, 17), (23, 23), (12, 0)] {
            let expected: f64 = (0..width * width)
                .map(|k| {
                    f64::from(input[k]) * kernel((k / width).abs_diff(i), (k % width).abs_diff(j))
                })
                .sum();
            let seen = f64::from(output[i * width + j]);
            assert!(
                (seen - expected).abs() < 1e-5 * expected,
                "({i}, {j}): {seen}, {expected}"
            );
        }
    }
}
