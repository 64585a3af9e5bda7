//! Hertz's law fitted to a press: the physical control of `hrn-train compare --course`.
//!
//! In: force and approach over a press. Out: a modulus and a radius.

use crate::data::dataset::PITCH_MM;
use crate::learn::course::Press;
use hardnessd_core::verdict::features::{area, force_n};

/// The length of a row of [`row`].
pub const HERTZ_FEATURES: usize = 3;
/// Added before a logarithm to keep it finite: MPa.
const LITTLE_MPA: f32 = 1e-3;
/// The law is not fitted below this share of the greatest force, because the contact is then only a
/// few taxels.
const LEAST_SHARE: f32 = 0.1;

/// Hertz's law `F = 4/3 E* R^(1/2) d^(3/2)` fitted to a press's loading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hertz {
    /// Reduced modulus of object and cover, MPa.
    pub young_mpa: f32,
    /// Radius of the object, mm.
    pub radius_mm: f32,
}

impl Press {
    fn force_n(&self, place: usize) -> f32 {
        force_n(&self.moments[place].frame)
    }

    /// The frame of the greatest force.
    fn top(&self) -> usize {
        let force = |&place: &usize| self.force_n(place);
        (0..self.moments.len())
            .max_by(|a, b| force(a).total_cmp(&force(b)).then(b.cmp(a)))
            .unwrap_or(0)
    }

    /// The indentation of object and cover in a frame: the approach minus the arm's deflection.
    fn indentation_mm(&self, place: usize) -> Option<f32> {
        let approach_mm = self.moments[place].approach_mm?;
        (self.arm_n_per_mm > 0.0).then(|| approach_mm - self.force_n(place) / self.arm_n_per_mm)
    }

    /// Fits `F^(2/3)`, which is linear in the indentation, by least squares. The radius follows
    /// from the contact area `pi R d` at the greatest force. `None` where the approach or the arm's
    /// stiffness is unknown, or the force does not rise with the indentation.
    pub fn hertz(&self) -> Option<Hertz> {
        let top = self.top();
        let least = LEAST_SHARE * self.force_n(top);
        let mut points = Vec::new();
        for frame in (0..=top).filter(|&frame| self.force_n(frame) >= least) {
            let force = self.force_n(frame).powf(2.0 / 3.0);
            points.push((self.indentation_mm(frame)?, force));
        }
        let n = points.len() as f32;
        let mean_mm = points.iter().map(|point| point.0).sum::<f32>() / n;
        let mean = points.iter().map(|point| point.1).sum::<f32>() / n;
        let spread: f32 = points.iter().map(|point| (point.0 - mean_mm).powi(2)).sum();
        let both: f32 = points
            .iter()
            .map(|(mm, force)| (mm - mean_mm) * (force - mean))
            .sum();
        let slope = both / spread;
        if !(slope.is_finite() && slope > 0.0) {
            return None;
        }
        let depth_mm = self.force_n(top).powf(2.0 / 3.0) / slope;
        let area_mm2 = area(&self.moments[top].frame) * (PITCH_MM * PITCH_MM) as f32;
        let radius_mm = area_mm2 / (std::f32::consts::PI * depth_mm);
        Some(Hertz {
            young_mpa: 0.75 * slope.powf(1.5) / radius_mm.sqrt(),
            radius_mm,
        })
    }
}

/// The control's row: whether there is a fit, and the logarithms of its modulus and radius.
pub fn row(press: &Press) -> [f32; HERTZ_FEATURES] {
    press.hertz().map_or([0.0; HERTZ_FEATURES], |hertz| {
        [
            1.0,
            (hertz.young_mpa + LITTLE_MPA).ln(),
            hertz.radius_mm.clamp(0.1, 1e4).ln(),
        ]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::verdict::features::{Moment, frame_of};

    /// A ball of `radius_mm` on an elastic half space, on an arm of 10 N/mm, with its contact area.
    fn press(young_mpa: f32, radius_mm: f32) -> Press {
        let moment = |step: u8| {
            let depth_mm = 0.1 * f32::from(step);
            let force_n = 4.0 / 3.0 * young_mpa * radius_mm.sqrt() * depth_mm.powf(1.5);
            let taxels = std::f32::consts::PI * radius_mm * depth_mm / (3.5 * 3.5);
            Moment {
                frame: frame_of(taxels, force_n),
                time_s: 0.05 * f32::from(step),
                approach_mm: Some(depth_mm + force_n / 10.0),
            }
        };
        Press {
            moments: (1..=20).map(moment).collect(),
            arm_n_per_mm: 10.0,
            level: 1,
            shore: None,
            object: 0,
            sensor: 0,
            piece: None,
        }
    }

    #[test]
    fn hertz_finds_modulus_and_radius_of_his_own_law() {
        for (young_mpa, radius_mm) in [(0.05, 10.0), (0.5, 40.0), (2.0, 20.0)] {
            let found = press(young_mpa, radius_mm).hertz().unwrap();
            assert!(
                (found.young_mpa / young_mpa - 1.0).abs() < 1e-3,
                "{found:?}"
            );
            assert!(
                (found.radius_mm / radius_mm - 1.0).abs() < 1e-3,
                "{found:?}"
            );
        }
    }

    #[test]
    fn without_an_approach_there_is_no_fit() {
        let mut press = press(0.5, 20.0);
        let moments = press.moments.iter_mut();
        moments.for_each(|moment| moment.approach_mm = None);
        assert_eq!(row(&press), [0.0; HERTZ_FEATURES]);
    }
}
