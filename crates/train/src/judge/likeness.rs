//! The likeness of generated frames to real ones, which the losses of a GAN do not show.
//!
//! In: frames. Out: the spread of their taxels beside that of real ones, which shows a collapse,
//! and a distance between their hand-made features, which shows whether they are of the right
//! size, force and roughness.

use crate::judge::features::{self, Moments};
use crate::net::image::PixelScale;
use hardnessd_core::verdict::{ModelFrame, TAXELS};

/// A comparison of generated frames with real ones.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Likeness {
    /// Standard deviation over the generated frames, averaged over the taxels, in units of the
    /// image (half the full scale).
    pub pixel_std: f64,
    /// `pixel_std` of the real frames.
    pub pixel_std_real: f64,
    /// `pixel_std` of the generated frames of one component, averaged over the components. A
    /// mixture whose sigma shrinks ends with one frame per component, which `pixel_std` hides.
    pub pixel_std_component: f64,
    /// Distance between the features of generated and real frames, each in units of its deviation
    /// among the real ones: the energy distance `2 E|X-Y| - E|X-X'| - E|Y-Y'|` over `2 E|X-Y|`.
    /// About 0 for frames of the same kind, and 1 for two different points.
    pub feature_distance: f64,
}

/// The real frames of a comparison.
#[derive(Debug)]
pub struct Reference {
    moments: Moments,
    /// Standardised features, a row per frame.
    rows: Vec<Vec<f64>>,
    pixel_std: f64,
    scale: PixelScale,
}

impl Reference {
    /// Takes `frames` as the real ones.
    ///
    /// # Errors
    ///
    /// Returns an error if the features cannot be computed.
    pub fn of(frames: &[&ModelFrame], scale: PixelScale) -> anyhow::Result<Self> {
        let rows = features::features(frames.iter().copied())?;
        let moments = Moments::of(&rows);
        Ok(Self {
            rows: rows.iter().map(|row| moments.standardised(row)).collect(),
            moments,
            pixel_std: pixel_std(frames.iter().copied(), scale),
            scale,
        })
    }

    /// Compares generated `frames`, of which frame r is of component r mod `components`.
    ///
    /// # Errors
    ///
    /// Returns an error if the features cannot be computed.
    pub fn compare(&self, frames: &[ModelFrame], components: usize) -> anyhow::Result<Likeness> {
        let rows = features::features(frames.iter())?;
        let rows: Vec<Vec<f64>> = rows
            .iter()
            .map(|row| self.moments.standardised(row))
            .collect();
        let across = 2.0 * mean_distance(&self.rows, &rows);
        let within = mean_distance_within(&self.rows) + mean_distance_within(&rows);
        let of_component = |first: usize| {
            let frames = frames.iter().skip(first).step_by(components);
            pixel_std(frames, self.scale)
        };
        let within_components = (0..components).map(of_component).sum::<f64>();
        Ok(Likeness {
            pixel_std: pixel_std(frames.iter(), self.scale),
            pixel_std_real: self.pixel_std,
            pixel_std_component: within_components / components as f64,
            feature_distance: if across > 0.0 {
                (across - within) / across
            } else {
                0.0
            },
        })
    }
}

fn distance(x: &[f64], y: &[f64]) -> f64 {
    let squares = x.iter().zip(y).map(|(x, y)| (x - y).powi(2));
    squares.sum::<f64>().sqrt()
}

fn mean_distance(left: &[Vec<f64>], right: &[Vec<f64>]) -> f64 {
    let of_one = |x: &Vec<f64>| right.iter().map(|y| distance(x, y)).sum::<f64>();
    left.iter().map(of_one).sum::<f64>() / (left.len() * right.len()) as f64
}

/// Mean distance over pairs of different rows.
fn mean_distance_within(rows: &[Vec<f64>]) -> f64 {
    let n = rows.len() as f64;
    mean_distance(rows, rows) * n / (n - 1.0).max(1.0)
}

fn pixel_std<'a>(frames: impl ExactSizeIterator<Item = &'a ModelFrame>, scale: PixelScale) -> f64 {
    let n = frames.len() as f64;
    let mut sums = vec![(0.0_f64, 0.0_f64); TAXELS];
    for frame in frames {
        for ((sum, squares), newtons) in sums.iter_mut().zip(frame.newtons) {
            let value = f64::from(scale.pixel(newtons));
            *sum += value;
            *squares += value * value;
        }
    }
    let deviation = |(sum, squares): &(f64, f64)| {
        let mean = sum / n;
        (squares / n - mean * mean).max(0.0).sqrt()
    };
    sums.iter().map(deviation).sum::<f64>() / TAXELS as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::dataset::laid;
    use hardnessd_simulator::{DatasetSettings, dataset};

    const SCALE: PixelScale = PixelScale {
        full_scale_n: 10.2,
        log_above_n: 0.0,
    };

    fn frames(seed: u64, level: u8) -> Vec<ModelFrame> {
        let settings = DatasetSettings {
            seed,
            objects: 8,
            test_objects: 0,
            presses: 10,
            ..DatasetSettings::default()
        };
        dataset(&settings, 1, |_| ())
            .into_iter()
            .filter(|sample| sample.level == level)
            .map(|sample| laid(&sample.frame))
            .collect()
    }

    #[test]
    fn frames_of_the_same_kind_are_near_and_others_far() {
        let real = frames(1, 4);
        let reference = Reference::of(&real.iter().collect::<Vec<_>>(), SCALE).unwrap();
        let same = reference.compare(&frames(2, 4), 1).unwrap();
        let hard = reference.compare(&frames(1, 1), 1).unwrap();
        assert!(same.feature_distance < 0.05, "{same:?}");
        assert!(hard.feature_distance > 0.2, "{hard:?}");
        let spread = same.pixel_std / same.pixel_std_real;
        assert!((spread - 1.0).abs() < 0.4, "{same:?}");
    }

    #[test]
    fn a_collapse_shows_in_the_taxels_deviation() {
        let real = frames(1, 4);
        let reference = Reference::of(&real.iter().collect::<Vec<_>>(), SCALE).unwrap();
        let likeness = reference.compare(&[real[0]; 20], 1).unwrap();
        assert!(likeness.pixel_std < 1e-6, "{likeness:?}");
        assert!(likeness.feature_distance > 0.3, "{likeness:?}");
        // The 20 frames are five components, each of which gives one frame only.
        let components: Vec<ModelFrame> = (0..20).map(|n| real[10 * (n % 5) + 9]).collect();
        let likeness = reference.compare(&components, 5).unwrap();
        assert!(likeness.pixel_std > 1e-4, "{likeness:?}");
        assert!(likeness.pixel_std_component < 1e-6, "{likeness:?}");
    }
}
