//! The roughness of a face, as a Gaussian self-affine surface.

use realfft::num_complex::Complex32;
use rustfft::FftPlanner;

use super::substance::Texture;
use crate::CELL_MM;
use crate::random::Stream;

/// Width of a patch in cells. A patch is periodic, and wider than the sensor (98 mm), so that a
/// press does not meet the same bump twice.
const WIDTH: usize = 128;

/// A periodic patch of roughness.
#[derive(Debug, Clone)]
pub(super) struct Patch {
    heights_mm: Vec<f32>,
}

impl Patch {
    /// A patch with the roughness of `texture` and `rms_factor` times its rms.
    ///
    /// The power spectrum falls as `q^-2(1+H)` between the longest and the shortest wavelength. It
    /// is constant above the longest wavelength and 0 below the shortest.
    pub(super) fn new(texture: &Texture, rms_factor: f64, stream: &mut Stream) -> Self {
        let half = WIDTH / 2;
        let unit = 1.0 / (WIDTH as f64 * CELL_MM);
        let (low, high) = (1.0 / texture.longest_mm, 1.0 / texture.shortest_mm);
        let stretch = texture.anisotropy.sqrt();
        let mut spectrum = vec![Complex32::new(0.0, 0.0); WIDTH * WIDTH];
        let mut power = 0.0;
        for i in 0..WIDTH {
            for j in 0..WIDTH {
                let signed = |k: usize| k as f64 - if k < half { 0.0 } else { WIDTH as f64 };
                // Waves are longer along x, so a wave number along x counts as a higher one.
                let q = (signed(j) * unit * stretch).hypot(signed(i) * unit / stretch);
                if q == 0.0 || q > high {
                    continue;
                }
                let amplitude = (q.max(low) / low).powf(-(1.0 + texture.hurst));
                power += amplitude * amplitude;
                // The surface is the real part of the transform of independent complex amplitudes.
                // Half the power is lost with the imaginary part.
                let mut draw = || (amplitude * stream.normal()) as f32;
                spectrum[i * WIDTH + j] = Complex32::new(draw(), draw());
            }
        }
        let plan = FftPlanner::new().plan_fft_inverse(WIDTH);
        plan.process(&mut spectrum);
        let across = |k: usize| k % WIDTH * WIDTH + k / WIDTH;
        let cells = 0..WIDTH * WIDTH;
        let mut turned: Vec<Complex32> = cells.clone().map(|k| spectrum[across(k)]).collect();
        plan.process(&mut turned);
        let scale = (1e-3 * texture.rms_um * rms_factor / power.sqrt()) as f32;
        // `turned` is transposed, with x as its row. Put y first again.
        let heights_mm = cells.map(|k| scale * turned[across(k)].re);
        Self {
            heights_mm: heights_mm.collect(),
        }
    }

    /// Height in mm at (`x`, `y`) mm, by Catmull-Rom splines. Linear interpolation would remove a
    /// third of the shortest waves.
    pub(super) fn height_mm(&self, x_mm: f64, y_mm: f64) -> f32 {
        let locate = |at: f64| {
            let cell = at / CELL_MM;
            let below = cell.floor();
            let part = (cell - below) as f32;
            let (p2, p3) = (part * part, part * part * part);
            let weights = [
                0.5 * (2.0 * p2 - p3 - part),
                0.5 * (3.0 * p3 - 5.0 * p2 + 2.0),
                0.5 * (4.0 * p2 - 3.0 * p3 + part),
                0.5 * (p3 - p2),
            ];
            let first = (below as i64 - 1).rem_euclid(WIDTH as i64);
            (first as usize, weights)
        };
        let (column, across) = locate(x_mm);
        let (row, down) = locate(y_mm);
        let mut sum = 0.0;
        for (i, &weight) in down.iter().enumerate() {
            let line = &self.heights_mm[(row + i) % WIDTH * WIDTH..][..WIDTH];
            let mut part = 0.0;
            for (j, &across) in across.iter().enumerate() {
                part += across * line[(column + j) % WIDTH];
            }
            sum += weight * part;
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::super::material::Material;
    use super::*;
    use crate::tests::near;

    #[test]
    fn rms_height_and_grain_are_those_of_the_table() {
        for (material, seeds) in [(Material::Wood, 8_u64), (Material::Sponge, 4)] {
            let texture = material.properties().substance.texture;
            let (mut square, mut along, mut across) = (0.0, 0.0, 0.0);
            for seed in 0..seeds {
                let patch = Patch::new(&texture, 1.0, &mut Stream::new(seed, "texture"));
                for k in 0..4000 {
                    let (x, y) = (f64::from(k % 80) * 1.31, f64::from(k / 80) * 1.77);
                    let h = f64::from(patch.height_mm(x, y));
                    square += h * h;
                    along += (f64::from(patch.height_mm(x + 0.5, y)) - h).powi(2);
                    across += (f64::from(patch.height_mm(x, y + 0.5)) - h).powi(2);
                }
            }
            let rms_um = 1e3 * (square / (4000.0 * seeds as f64)).sqrt();
            near(rms_um, texture.rms_um, 0.1, material.name());
            // Slopes across the grain are steeper by the anisotropy.
            let grain = (across / along).sqrt();
            near(grain, texture.anisotropy, 0.2, material.name());
        }
    }
}
