//! A tactile array, which turns the pressure under its cover into taxel forces, and those into
//! counts.
//!
//! A [`Design`] is what sensors of one make have in common. A [`Sensor`] is one instance, whose
//! gains, activation thresholds and dead taxels are drawn once. There is no noise without load:
//! below its activation threshold a taxel's layers do not touch, and the taxel reads exactly 0, as
//! film arrays do.

mod design;
mod grid;

use std::sync::Arc;

use serde::{Deserialize, Serialize};

pub(super) use self::design::Design;
pub(super) use self::grid::Grid;
use crate::random::Stream;
use hardnessd_core::frame::{Array, Frame, RawFrame};
use hardnessd_core::press::{Settings, Thresholds};

/// The array of a sequence.
pub(super) const ARRAY: Array = Array::JX255N;
/// The largest count of the simulated JX255N, which has 8 bits.
pub const FULL_SCALE_COUNTS: u16 = 255;
/// A force on a taxel that is no longer felt, N. The film's delay alone would never end a press.
const NOTHING_N: f32 = 1e-4;

/// The spread between the taxels of a sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SensorProfile {
    /// The spread after a taxel-wise calibration.
    Clean,
    /// The spread measured on a public film array.
    Raw,
}

/// One instance of a sensor.
#[derive(Debug, Clone)]
pub(super) struct Sensor {
    pub(super) design: Design,
    pub(super) grid: Arc<Grid>,
    gain: Vec<f32>,
    threshold_n: Vec<f32>,
    /// What its user takes a count for.
    pub(super) newtons_per_count: f32,
}

impl Sensor {
    /// Draws a JX255N.
    pub(super) fn new(profile: SensorProfile, stream: &Stream) -> Self {
        Self::of(Design::jx255n(profile), Grid::jx255n(), stream)
    }

    /// Draws a sensor of a design.
    pub(super) fn draw(design: Design, stream: &Stream) -> Self {
        let grid = Arc::new(Grid::new(&design));
        Self::of(design, grid, stream)
    }

    fn of(design: Design, grid: Arc<Grid>, stream: &Stream) -> Self {
        let Array { rows, cols } = design.array;
        let count = design.array.taxels();
        let spread = design.spread;
        let lines = |sd: f64, name: u64, count: usize| -> Vec<f64> {
            let mut stream = stream.child(name);
            (0..count).map(|_| 1.0 + sd * stream.normal()).collect()
        };
        let taxels = lines(spread.taxel, 0, count);
        let of_rows = lines(spread.row, 1, rows);
        let of_columns = lines(spread.column, 2, cols);
        let mut dead = stream.child(3);
        let gain = (0..count)
            .map(|k| {
                let alive = dead.uniform() >= design.dead_share;
                let gain = taxels[k] * of_rows[k / cols] * of_columns[k % cols];
                if alive { gain.max(0.0) as f32 } else { 0.0 }
            })
            .collect();
        let mut draws = stream.child(4);
        let (median_n, bound_n) = (design.threshold_median_n, design.threshold_bound_n);
        let sigma = (bound_n / median_n).ln() / 3.0;
        let threshold_n = (0..count)
            .map(|_| (median_n * (sigma * draws.normal()).exp()).min(bound_n) as f32)
            .collect();
        Self {
            newtons_per_count: design.count_n,
            design,
            grid,
            gain,
            threshold_n,
        }
    }

    /// The gain of each taxel; 0 for a dead one.
    pub(super) fn gains(&self) -> &[f32] {
        &self.gain
    }

    /// Draws the factor common to all taxels in one press.
    pub(super) fn press_gain(&self, stream: &mut Stream) -> f32 {
        (1.0 + self.design.spread.press * stream.normal()).max(0.3) as f32
    }

    /// The daemon's default thresholds for this array.
    pub(super) fn thresholds(&self) -> Thresholds {
        let settings = Settings::default();
        settings
            .check(self.grid.array, self.grid.pitch)
            .expect("the default settings fit every array")
    }

    /// Converts taxel forces in newtons, as the film gives them, into counts.
    pub(super) fn read(&self, forces_n: &[f32], press_gain: f32, noise: &mut Stream) -> RawFrame {
        let design = &self.design;
        let array = design.array;
        let mut rows = vec![0.0_f32; array.rows];
        let mut columns = vec![0.0_f32; array.cols];
        for (k, &force) in forces_n.iter().enumerate() {
            rows[k / array.cols] += force;
            columns[k % array.cols] += force;
        }
        let mut raw = RawFrame::zero(array);
        for (k, counts) in raw.counts.iter_mut().enumerate() {
            let (row, column) = array.position(k);
            let own = forces_n[k];
            let mut near = 0.0;
            if row > 0 {
                near += forces_n[k - array.cols];
            }
            if row + 1 < array.rows {
                near += forces_n[k + array.cols];
            }
            if column > 0 {
                near += forces_n[k - 1];
            }
            if column + 1 < array.cols {
                near += forces_n[k + 1];
            }
            // Force through the cover can close a taxel. Crosstalk along the lines cannot, and an
            // open taxel reads nothing. Otherwise 25 N on one point would draw a cross.
            let pressed = own + design.crosstalk_neighbour * near;
            if pressed <= self.threshold_n[k] {
                continue;
            }
            let line = rows[row] + columns[column] - 2.0 * own;
            let felt = design.response.of(pressed + design.crosstalk_line * line);
            let ratio = 1.0 + (design.noise_ratio * noise.normal()) as f32;
            let read = felt * self.gain[k] * press_gain * ratio
                + if self.gain[k] > 0.0 {
                    (design.noise_n * noise.normal()) as f32
                } else {
                    0.0
                };
            let rounded = (read / design.count_n)
                .round()
                .clamp(0.0, f32::from(design.full_scale_counts));
            *counts = if rounded < design.least_counts {
                0
            } else {
                rounded as u16
            };
        }
        raw
    }

    /// The frame after a tare with baseline 0.
    pub(super) fn tared(&self, raw: &RawFrame) -> Frame {
        let newtons = raw.counts.iter();
        Frame {
            array: raw.array,
            newtons: newtons
                .map(|&counts| f32::from(counts) * self.newtons_per_count)
                .collect(),
        }
    }
}

/// The state of the film under each taxel.
#[derive(Debug, Clone)]
pub(super) struct Film {
    crept: Vec<[f32; 2]>,
    /// The delayed forces, and the greatest of them since a taxel was touched.
    delayed_n: Vec<f32>,
    greatest_n: Vec<f32>,
}

impl Film {
    /// A film at rest.
    pub(super) fn new(design: &Design) -> Self {
        let taxels = design.array.taxels();
        Self {
            crept: vec![[0.0; 2]; taxels],
            delayed_n: vec![0.0; taxels],
            greatest_n: vec![0.0; taxels],
        }
    }

    /// Advances by `time_s` under `forces_n` and returns the forces with delay, hysteresis and
    /// creep. Creep and hysteresis multiply the load, so an unloaded taxel reads nothing, however
    /// long it was loaded.
    pub(super) fn advance(&mut self, design: &Design, forces_n: &[f32], time_s: f64) -> Vec<f32> {
        let creep = design.creep;
        let step = creep.map(|(_, tau)| -(-(time_s as f32) / tau).exp_m1());
        let follow = -(-(time_s as f32) / design.lag_s).exp_m1();
        let mut read = vec![0.0; forces_n.len()];
        for (k, (read, &force)) in read.iter_mut().zip(forces_n).enumerate() {
            let mut force = force;
            if design.lag_s > 0.0 {
                let delayed = &mut self.delayed_n[k];
                *delayed += follow * (force - *delayed);
                if *delayed < NOTHING_N {
                    *delayed = 0.0;
                }
                force = *delayed;
            }
            let goal = if force > 0.0 { 1.0 } else { 0.0 };
            let mut factor = 1.0;
            for ((crept, step), (ratio, _)) in self.crept[k].iter_mut().zip(step).zip(creep) {
                *crept += step * (goal - *crept);
                factor += ratio * *crept;
            }
            let greatest = &mut self.greatest_n[k];
            *greatest = if force > 0.0 {
                greatest.max(force)
            } else {
                0.0
            };
            if force < *greatest {
                factor *= 1.0 + design.hysteresis * (1.0 - force / *greatest);
            }
            *read = force * factor;
        }
        read
    }
}

#[cfg(test)]
mod tests;
