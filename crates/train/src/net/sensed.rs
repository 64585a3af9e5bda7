//! The sensor's reading of a force: generated frames pass through it before anything judges them.
//!
//! A generator gives any force. The sensor gives multiples of a count, and nothing below a
//! threshold. A discriminator that sees this difference can recognise generated frames without
//! looking at the press.

use std::collections::BTreeSet;

use burn::tensor::{Tensor, TensorData};

use crate::net::image::PixelScale;
use crate::net::network::numbers;
use hardnessd_core::verdict::ModelFrame;

/// The number of frames, spread over all of them, from which the step is read.
const FRAMES: usize = 200;

/// Step, threshold and greatest force of a sensor, as seen in its own frames.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sensor {
    /// Newtons per count. 0 if the forces are not multiples of one step.
    step_n: f32,
    /// The least force above 0.
    threshold_n: f32,
    /// The greatest force.
    most_n: f32,
}

impl Sensor {
    /// Reads step, threshold and greatest force off the frames of a sensor.
    pub fn of(frames: &[&ModelFrame]) -> Self {
        let pressed = |of: &&ModelFrame| of.newtons.into_iter().filter(|newtons| *newtons > 0.0);
        let all = || frames.iter().flat_map(pressed);
        let (Some(threshold_n), Some(most_n)) = (all().reduce(f32::min), all().reduce(f32::max))
        else {
            return Self {
                step_n: 0.0,
                threshold_n: 0.0,
                most_n: f32::INFINITY,
            };
        };
        let every = frames.len().div_ceil(FRAMES);
        let values = frames.iter().step_by(every).flat_map(pressed);
        let values: BTreeSet<u32> = values.map(f32::to_bits).collect();
        // The bits of positive numbers have the same order as the numbers.
        let values: Vec<f32> = values.into_iter().map(f32::from_bits).collect();
        let apart = values.windows(2).map(|pair| pair[1] - pair[0]);
        let step_n = apart
            .filter(|step| *step > 1e-4 * most_n)
            .fold(threshold_n, f32::min);
        let is_multiple = |value: &f32| {
            let counts = value / step_n;
            (counts - counts.round()).abs() < 0.02
        };
        Self {
            step_n: match values.iter().all(is_multiple) {
                true => step_n,
                false => 0.0,
            },
            threshold_n,
            most_n,
        }
    }

    /// The sensor's reading of a force.
    pub fn newtons(self, newtons: f32) -> f32 {
        let counted = match self.step_n {
            0.0 => newtons,
            step_n => (newtons / step_n).round() * step_n,
        };
        // Half a step is tolerated, because multiples are not exact.
        if counted < self.threshold_n - 0.5 * self.step_n {
            0.0
        } else {
            counted.min(self.most_n)
        }
    }

    /// Generated images as the sensor would give them. Gradients pass unchanged (the
    /// straight-through estimate), because a step has no gradient of its own.
    pub fn images(self, images: Tensor<4>, scale: PixelScale) -> Tensor<4> {
        let dims = images.dims();
        let device = images.device();
        let given = images.clone().inner();
        let change = |pixel| scale.pixel(self.newtons(scale.newtons(pixel))) - pixel;
        let change: Vec<f32> = numbers(&given).into_iter().map(change).collect();
        let change = Tensor::<4>::from_data(TensorData::new(change, dims), &device.inner());
        images.add(Tensor::from_inner(change))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(newtons: &[f32]) -> ModelFrame {
        let mut frame = ModelFrame::default();
        frame.newtons[..newtons.len()].copy_from_slice(newtons);
        frame
    }

    #[test]
    fn steps_and_threshold_are_read_off_the_frames() {
        let step = 0.04_f32;
        let counted = frame(&[2.0, 3.0, 7.0, 100.0].map(|counts| counts * step));
        let sensor = Sensor::of(&[&counted]);
        for (force, given) in [(0.05, 0.0), (0.07, 0.08), (0.11, 0.12), (9.0, 4.0)] {
            let found = sensor.newtons(force);
            assert!((found - given).abs() < 1e-6, "{force}: {found}");
        }
        let any = frame(&[0.081, 0.1234, 0.77, 0.7701]);
        let sensor = Sensor::of(&[&any]);
        assert_eq!(sensor.newtons(0.5), 0.5);
        assert_eq!(sensor.newtons(0.04), 0.0);
    }

    #[test]
    fn soft_objects_at_the_beginning_do_not_limit_the_force() {
        let soft = frame(&[0.08, 0.12, 0.4]);
        let hard = frame(&[0.04, 0.4, 10.2]);
        let frames: Vec<&ModelFrame> = std::iter::repeat_n(&soft, 1000).chain([&hard]).collect();
        let sensor = Sensor::of(&frames);
        assert_eq!(sensor.newtons(8.0), 8.0);
        assert_eq!(sensor.newtons(20.0), 10.2);
        assert_eq!(sensor.newtons(0.04), 0.04);
    }

    #[test]
    fn an_empty_data_set_changes_nothing() {
        let sensor = Sensor::of(&[&ModelFrame::default()]);
        assert_eq!(sensor.newtons(0.3), 0.3);
    }
}
