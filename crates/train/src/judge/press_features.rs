//! Hand-made features of a whole press, and Hertz's law fitted to it. They are the input of the
//! controls of `hrn-train compare --course`.
//!
//! In: the features of a press's frames, their times, the arm's approach. Out: a row of numbers per
//! press.

use crate::data::dataset::PITCH_MM;
use crate::net::course::PressMoment;
use crate::net::frames::FEATURES;

/// Shares of the greatest force at which area and indentation are read off while the force rises.
const SHARES: [f32; 3] = [0.25, 0.5, 0.75];
/// The length of a row of [`timed`].
const TIMED: usize = 5 + SHARES.len();
/// The length of a row of [`moved`].
const MOVED: usize = 4 + SHARES.len();
/// The length of a row of [`of_press`].
pub const PRESS_FEATURES: usize = FEATURES + TIMED + MOVED;
/// The length of a row of [`of_hertz`].
pub const HERTZ_FEATURES: usize = 3;
/// Added before a logarithm to keep it finite: mm, N, MPa.
const LITTLE_MM: f32 = 0.1;
const LITTLE_N: f32 = 0.05;
const LITTLE_MPA: f32 = 1e-3;
/// The law is not fitted below this share of the greatest force, because the contact is then only a
/// few taxels.
const LEAST_SHARE: f32 = 0.1;

/// The data of a press from which its features are computed.
#[derive(Debug, Clone, Copy)]
pub struct PressOf<'a> {
    /// Features of each frame (`net::frames`), `[frames, FEATURES]`.
    pub frames: &'a [f32],
    /// Time, approach and force of each frame.
    pub moments: &'a [PressMoment],
    /// Stiffness of the arm. 0 if unknown.
    pub arm_n_per_mm: f32,
}

/// Hertz's law `F = 4/3 E* R^(1/2) d^(3/2)` fitted to a press's loading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hertz {
    /// Reduced modulus of object and cover, MPa.
    pub young_mpa: f32,
    /// Radius of the object, mm.
    pub radius_mm: f32,
}

impl PressOf<'_> {
    /// Number of taxels in contact in a frame.
    fn area(&self, frame: usize) -> f32 {
        self.frames[frame * FEATURES].exp() - 1.0
    }

    /// The frame of the greatest force.
    fn top(&self) -> usize {
        let force = |&frame: &usize| self.moments[frame].force_n;
        (0..self.moments.len())
            .max_by(|a, b| force(a).total_cmp(&force(b)).then(b.cmp(a)))
            .unwrap_or(0)
    }

    /// The frame of the greatest area. Of equal areas, the one of the greater force.
    fn best(&self) -> usize {
        let key = |&frame: &usize| (self.area(frame), self.moments[frame].force_n);
        let before = |a: &usize, b: &usize| {
            let (a, b) = (key(a), key(b));
            a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1))
        };
        (0..self.moments.len()).max_by(before).unwrap_or(0)
    }

    /// The indentation of object and cover in a frame: the approach minus the arm's deflection.
    fn indentation_mm(&self, frame: usize) -> Option<f32> {
        let PressMoment {
            approach_mm,
            force_n,
            ..
        } = self.moments[frame];
        (self.arm_n_per_mm > 0.0).then_some(approach_mm? - force_n / self.arm_n_per_mm)
    }

    /// `value` when the rising force passed `share` of the greatest force, interpolated between the
    /// frames before and after.
    fn at_share(&self, share: f32, value: impl Fn(usize) -> Option<f32>) -> Option<f32> {
        let top = self.top();
        let wanted = share * self.moments[top].force_n;
        let after = (0..=top).find(|&frame| self.moments[frame].force_n >= wanted)?;
        let Some(before) = after.checked_sub(1) else {
            return value(after);
        };
        let force = |frame: usize| self.moments[frame].force_n;
        let part = (wanted - force(before)) / (force(after) - force(before));
        let (low, high) = (value(before)?, value(after)?);
        Some(low + part * (high - low))
    }

    /// Fits `F^(2/3)`, which is linear in the indentation, by least squares. The radius follows
    /// from the contact area `pi R d` at the greatest force. `None` where the approach or the arm's
    /// stiffness is unknown, or the force does not rise with the indentation.
    pub fn hertz(&self) -> Option<Hertz> {
        let top = self.top();
        let least = LEAST_SHARE * self.moments[top].force_n;
        let mut points = Vec::new();
        for frame in (0..=top).filter(|&frame| self.moments[frame].force_n >= least) {
            let force = self.moments[frame].force_n.powf(2.0 / 3.0);
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
        let depth_mm = self.moments[top].force_n.powf(2.0 / 3.0) / slope;
        let area_mm2 = self.area(top) * (PITCH_MM * PITCH_MM) as f32;
        let radius_mm = area_mm2 / (std::f32::consts::PI * depth_mm);
        Some(Hertz {
            young_mpa: 0.75 * slope.powf(1.5) / radius_mm.sqrt(),
            radius_mm,
        })
    }
}

/// Features of the forces and areas over time, without the arm.
fn timed(press: &PressOf) -> [f32; TIMED] {
    let top = press.top();
    let force_n = press.moments[top].force_n;
    let time_s = |frame: usize| press.moments[frame].time_s;
    let still = press
        .moments
        .iter()
        .rposition(|moment| moment.force_n >= 0.5 * force_n);
    let still = still.unwrap_or(top);
    let after = |seconds: f32| {
        let late = (top..=still).find(|&frame| time_s(frame) >= time_s(top) + seconds);
        (press.moments[late.unwrap_or(still)].force_n + LITTLE_N) / (force_n + LITTLE_N)
    };
    let mut row = [
        (force_n + LITTLE_N).ln(),
        (time_s(top) + 0.05).ln(),
        (time_s(still) - time_s(top) + 0.05).ln(),
        after(0.2),
        after(1.0),
        0.0,
        0.0,
        0.0,
    ];
    for (share, value) in SHARES.into_iter().zip(&mut row[5..]) {
        let area = press.at_share(share, |frame| Some(press.area(frame)));
        *value = (area.unwrap_or(0.0) + 1.0).ln();
    }
    row
}

/// Features from the arm's approach. Zeros where the approach or the stiffness is unknown.
fn moved(press: &PressOf) -> [f32; MOVED] {
    let mut row = [0.0; MOVED];
    let Some(depth_mm) = press.indentation_mm(press.top()) else {
        return row;
    };
    let logarithm = |mm: f32| (mm.max(0.0) + LITTLE_MM).ln();
    row[0] = 1.0;
    row[1] = logarithm(depth_mm);
    if let Some(hertz) = press.hertz() {
        row[2] = (hertz.young_mpa + LITTLE_MPA).ln();
        row[3] = hertz.radius_mm.clamp(0.1, 1e4).ln();
    }
    for (share, value) in SHARES.into_iter().zip(&mut row[4..]) {
        *value = press
            .at_share(share, |frame| press.indentation_mm(frame))
            .map_or(0.0, logarithm);
    }
    row
}

/// A press's row for logistic regression, [`PRESS_FEATURES`] numbers: its best frame's features,
/// forces and areas over time, and, where the approach is known, the indentations and Hertz's fit.
pub fn of_press(press: &PressOf) -> Vec<f32> {
    let best = &press.frames[press.best() * FEATURES..][..FEATURES];
    best.iter()
        .copied()
        .chain(timed(press))
        .chain(moved(press))
        .collect()
}

/// The physical control's row, [`HERTZ_FEATURES`] numbers: whether there is a fit, and the
/// logarithms of its modulus and radius.
pub fn of_hertz(press: &PressOf) -> Vec<f32> {
    press.hertz().map_or_else(
        || vec![0.0; HERTZ_FEATURES],
        |hertz| {
            vec![
                1.0,
                (hertz.young_mpa + LITTLE_MPA).ln(),
                hertz.radius_mm.clamp(0.1, 1e4).ln(),
            ]
        },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ball of `radius_mm` on an elastic half space, on an arm of 10 N/mm, with its contact area.
    fn press(young_mpa: f32, radius_mm: f32) -> (Vec<f32>, Vec<PressMoment>) {
        let (mut frames, mut moments) = (Vec::new(), Vec::new());
        for step in 1..=20_u8 {
            let depth_mm = 0.1 * f32::from(step);
            let force_n = 4.0 / 3.0 * young_mpa * radius_mm.sqrt() * depth_mm.powf(1.5);
            let taxels = std::f32::consts::PI * radius_mm * depth_mm / (3.5 * 3.5);
            frames.push((taxels + 1.0).ln());
            frames.extend([0.0; FEATURES - 1]);
            moments.push(PressMoment {
                time_s: 0.05 * f32::from(step),
                approach_mm: Some(depth_mm + force_n / 10.0),
                force_n,
            });
        }
        (frames, moments)
    }

    #[test]
    fn hertz_finds_modulus_and_radius_of_his_own_law() {
        for (young_mpa, radius_mm) in [(0.05, 10.0), (0.5, 40.0), (2.0, 20.0)] {
            let (frames, moments) = press(young_mpa, radius_mm);
            let press = PressOf {
                frames: &frames,
                moments: &moments,
                arm_n_per_mm: 10.0,
            };
            let found = press.hertz().unwrap();
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
    fn what_is_not_known_is_0() {
        let (frames, mut moments) = press(0.5, 20.0);
        moments
            .iter_mut()
            .for_each(|moment| moment.approach_mm = None);
        let press = PressOf {
            frames: &frames,
            moments: &moments,
            arm_n_per_mm: 10.0,
        };
        assert_eq!(of_hertz(&press), [0.0; HERTZ_FEATURES]);
        let row = of_press(&press);
        assert_eq!(row.len(), PRESS_FEATURES);
        assert_eq!(row[FEATURES + TIMED..], [0.0; MOVED]);
        assert!(
            row[FEATURES..FEATURES + TIMED]
                .iter()
                .all(|x| x.is_finite())
        );
    }
}
