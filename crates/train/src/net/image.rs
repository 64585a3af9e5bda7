//! The scale from newtons to the image that a network sees, and back.

use burn::tensor::{Device, Tensor, TensorData};

use crate::net::graph::INPUT;
use hardnessd_core::verdict::{COLS, ModelFrame, ROWS, TAXELS};

/// One scale for all frames, because force carries hardness: 0 N is -1, the full scale is 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelScale {
    /// The force on a taxel, in newtons, that becomes 1.
    pub full_scale_n: f64,
    /// Above 0, the image is linear in log(1 + newtons / this value), so that light taxels differ
    /// as clearly as heavy ones. With 0, it is linear in newtons.
    pub log_above_n: f64,
}

impl PixelScale {
    /// The image's value for a taxel of `newtons`.
    pub fn pixel(self, newtons: f32) -> f32 {
        if self.log_above_n == 0.0 {
            return newtons * (2.0 / self.full_scale_n) as f32 - 1.0;
        }
        let part = (newtons * (1.0 / self.log_above_n) as f32).ln_1p();
        part * self.log_factor() - 1.0
    }

    /// The force on a taxel for a value of the image: the inverse of [`PixelScale::pixel`].
    pub fn newtons(self, pixel: f32) -> f32 {
        if self.log_above_n == 0.0 {
            return (pixel + 1.0) * (self.full_scale_n / 2.0) as f32;
        }
        ((pixel + 1.0) / self.log_factor()).exp_m1() * self.log_above_n as f32
    }

    /// The factor that makes log(1 + full scale / `log_above_n`) equal to 2.
    fn log_factor(self) -> f32 {
        (2.0 / (self.full_scale_n / self.log_above_n).ln_1p()) as f32
    }

    /// Frames as images `[batch, 1, 28, 28]` in [-1, 1].
    pub fn images<'a>(
        self,
        frames: impl ExactSizeIterator<Item = &'a ModelFrame>,
        device: &Device,
    ) -> Tensor<4> {
        let batch = frames.len();
        let mut values = Vec::with_capacity(batch * TAXELS);
        for frame in frames {
            // As the daemon does: noise may be below 0.
            values.extend(frame.newtons.map(|newtons| self.pixel(newtons.max(0.0))));
        }
        Tensor::from_data(TensorData::new(values, [batch, 1, ROWS, COLS]), device)
    }

    /// The formula from the input of newtons to the `image` raised by 1, so that the background is 0.
    pub fn formula(self) -> String {
        if self.log_above_n == 0.0 {
            return format!("image = Mul({INPUT}, {})", (2.0 / self.full_scale_n) as f32);
        }
        let (scale, factor) = ((1.0 / self.log_above_n) as f32, self.log_factor());
        format!("image = Mul(Log(Add(Mul({INPUT}, {scale}), 1)), {factor})")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_scales_put_the_ends_on_the_ends_and_come_back() {
        for log_above_n in [0.0, 0.1] {
            let scale = PixelScale {
                full_scale_n: 10.2,
                log_above_n,
            };
            assert_eq!(scale.pixel(0.0), -1.0);
            assert!((scale.pixel(10.2) - 1.0).abs() < 1e-6);
            for newtons in [0.04_f32, 0.2, 0.7, 5.0] {
                let back = scale.newtons(scale.pixel(newtons));
                assert!((back - newtons).abs() < 1e-5 * newtons.max(1.0), "{back}");
            }
            // Noise below 0 is no force, as in the daemon.
            let mut below = ModelFrame::default();
            below.newtons[5] = -0.3;
            let image = scale.images([below].iter(), &Device::default()).into_data();
            assert_eq!(image.try_to_vec::<f32>().unwrap(), [-1.0; TAXELS]);
        }
    }
}
