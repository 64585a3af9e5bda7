//! A tactile array, which turns the pressure under its cover into taxel forces, and those into
//! counts.
//!
//! A [`Design`] is what sensors of one make have in common. A [`Sensor`] is one instance, whose
//! gains, activation thresholds and dead taxels are drawn once. Below its activation threshold the
//! layers of a film do not touch, and a taxel reads exactly 0. Arrays without such a threshold have
//! noise on every taxel, around the counts at which it rests.

mod design;
mod grid;

use serde::{Deserialize, Serialize};

pub(super) use self::design::{BROAD_PITCHES_MM, Design};
pub(super) use self::grid::Grid;
use crate::random::Stream;
use hardnessd_core::frame::{Array, Frame, RawFrame};
use hardnessd_core::press::{Settings, Thresholds};
use hardnessd_core::tare;

/// The array of a sequence.
pub(super) const ARRAY: Array = Array::JX255N;
/// The largest count of the simulated JX255N, which has 8 bits.
const FULL_SCALE_COUNTS: u16 = 255;
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
    pub(super) grid: Grid,
    /// The gain of each taxel; 0 for a dead one.
    gain: Vec<f32>,
    threshold_n: Vec<f32>,
    /// The counts at which taxels rest, and what a tare took them for. Empty for a film, which rests at 0.
    rest_counts: Vec<f32>,
    baseline: Vec<f32>,
    /// What its user takes a count for.
    pub(super) newtons_per_count: f32,
}

/// A user raises the contact threshold above this many standard deviations of the noise: else the
/// noise of a tare's frames would count as a touch.
const QUIET_SIGMAS: f32 = 6.5;

impl Sensor {
    /// Draws a sensor of a design.
    pub(super) fn draw(design: Design, stream: &Stream) -> Self {
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
        let gain = (0..count).map(|k| {
            let alive = dead.uniform() >= design.dead_share;
            let gain = taxels[k] * of_rows[k / cols] * of_columns[k % cols];
            if alive { gain.max(0.0) as f32 } else { 0.0 }
        });
        let gain = gain.collect();
        let mut draws = stream.child(4);
        let (median_n, bound_n) = (design.threshold_median_n, design.threshold_bound_n);
        let sigma = (bound_n / median_n).ln() / 3.0;
        let mut threshold = || (median_n * (sigma * draws.normal()).exp()).min(bound_n) as f32;
        let threshold_n = (0..count).map(|_| threshold()).collect();
        let rest_counts = design.rest.map_or_else(Vec::new, |rest| {
            let mut draws = stream.child(5);
            let mut taxel = || rest.counts + rest.spread * draws.normal();
            (0..count).map(|_| taxel().max(0.0) as f32).collect()
        });
        let mut sensor = Self {
            newtons_per_count: design.count_n,
            grid: Grid::new(&design),
            design,
            gain,
            threshold_n,
            rest_counts,
            baseline: Vec::new(),
        };
        sensor.tare(&mut stream.child(6));
        sensor
    }

    /// Takes the mean of some frames without load as the baseline, as the daemon does.
    fn tare(&mut self, noise: &mut Stream) {
        if self.rest_counts.is_empty() {
            return;
        }
        let unloaded = vec![0.0; self.grid.array.taxels()];
        let frames = tare::Settings::default().tare_frames;
        let mut sums = vec![0.0; unloaded.len()];
        for _ in 0..frames {
            let raw = self.read(&unloaded, 1.0, noise);
            for (sum, &counts) in sums.iter_mut().zip(&raw.counts) {
                *sum += counts;
            }
        }
        self.baseline = sums.iter().map(|sum| sum / frames as f32).collect();
    }

    /// Draws the factor common to all taxels in one press.
    pub(super) fn press_gain(&self, stream: &mut Stream) -> f32 {
        (1.0 + self.design.spread.press * stream.normal()).max(0.3) as f32
    }

    /// The daemon's thresholds for this array: the default ones, with a contact threshold above the
    /// noise of a restless array.
    pub(super) fn thresholds(&self) -> Thresholds {
        let noise_counts = (self.design.noise_n as f32 / self.design.count_n).powi(2) + 1.0 / 12.0;
        let noise_n = noise_counts.sqrt() * self.newtons_per_count;
        let usual_n = self.grid.pitch.contact_threshold_n();
        let settings = Settings {
            contact_threshold_n: (self.design.rest).map(|_| usual_n.max(QUIET_SIGMAS * noise_n)),
            ..Settings::default()
        };
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
        let mut resting = self.rest_counts.clone();
        noise.add_noise(&mut resting, design.noise_n as f32 / design.count_n);
        for (k, counts) in raw.counts.iter_mut().enumerate() {
            let (row, column) = array.position(k);
            let own = forces_n[k];
            let neighbours = [
                (row > 0).then(|| k - array.cols),
                (row + 1 < array.rows).then_some(k + array.cols),
                (column > 0).then(|| k - 1),
                (column + 1 < array.cols).then_some(k + 1),
            ];
            let near: f32 = neighbours.into_iter().flatten().map(|k| forces_n[k]).sum();
            // Force through the cover can close a taxel. Crosstalk along the lines cannot, and an
            // open taxel reads nothing. Otherwise 25 N on one point would draw a cross.
            let pressed = own + design.crosstalk_neighbour * near;
            let is_closed = match design.rest {
                Some(_) => pressed > 0.0,
                None => pressed > self.threshold_n[k],
            };
            if !is_closed {
                *counts = resting.get(k).map_or(0.0, |&read| design.counts(read));
                continue;
            }
            let line = rows[row] + columns[column] - 2.0 * own;
            let felt = design.response.of(pressed + design.crosstalk_line * line);
            let ratio = 1.0 + (design.noise_ratio * noise.normal()) as f32;
            let read = felt * self.gain[k] * press_gain * ratio;
            *counts = if let Some(&resting) = resting.get(k) {
                design.counts(resting + read / design.count_n)
            } else {
                let noise_n = match self.gain[k] > 0.0 {
                    true => (design.noise_n * noise.normal()) as f32,
                    false => 0.0,
                };
                let counts = design.counts((read + noise_n) / design.count_n);
                match counts < design.least_counts {
                    true => 0.0,
                    false => counts,
                }
            };
        }
        raw
    }

    /// The frame after the tare as presses and models get it: the contact and its margin.
    pub(super) fn felt(&self, raw: &RawFrame) -> Frame {
        self.tared(raw).felt(self.thresholds().contact_threshold_n)
    }

    /// The frame after the tare, in newtons with their sign.
    fn tared(&self, raw: &RawFrame) -> Frame {
        let newtons = raw.counts.iter().enumerate().map(|(k, &counts)| {
            let above = counts - self.baseline.get(k).copied().unwrap_or(0.0);
            above * self.newtons_per_count
        });
        Frame {
            array: raw.array,
            newtons: newtons.collect(),
        }
    }
}

/// The film under each taxel.
#[derive(Debug, Clone)]
pub(super) struct Film(Vec<Taxel>);

/// The state of the film under a taxel.
#[derive(Debug, Clone, Default)]
struct Taxel {
    crept: [f32; 2],
    /// The delayed force, and the greatest one since the taxel was touched.
    delayed_n: f32,
    greatest_n: f32,
}

impl Film {
    /// A film at rest.
    pub(super) fn new(design: &Design) -> Self {
        Self(vec![Taxel::default(); design.array.taxels()])
    }

    /// Advances by `time_s` under `forces_n` and returns the forces with delay, hysteresis and
    /// creep. Creep and hysteresis multiply the load, so an unloaded taxel reads nothing, however
    /// long it was loaded.
    pub(super) fn advance(&mut self, design: &Design, forces_n: &[f32], time_s: f64) -> Vec<f32> {
        let creep = design.creep;
        let step = creep.map(|(_, tau)| -(-(time_s as f32) / tau).exp_m1());
        let follow = -(-(time_s as f32) / design.lag_s).exp_m1();
        let read = self.0.iter_mut().zip(forces_n).map(|(taxel, &force)| {
            let mut force = force;
            if design.lag_s > 0.0 {
                taxel.delayed_n += follow * (force - taxel.delayed_n);
                if taxel.delayed_n < NOTHING_N {
                    taxel.delayed_n = 0.0;
                }
                force = taxel.delayed_n;
            }
            let is_loaded = force > 0.0;
            let mut factor = 1.0;
            for ((crept, step), (ratio, _)) in taxel.crept.iter_mut().zip(step).zip(creep) {
                *crept += step * (f32::from(u8::from(is_loaded)) - *crept);
                factor += ratio * *crept;
            }
            taxel.greatest_n = if is_loaded {
                taxel.greatest_n.max(force)
            } else {
                0.0
            };
            if force < taxel.greatest_n {
                factor *= 1.0 + design.hysteresis * (1.0 - force / taxel.greatest_n);
            }
            force * factor
        });
        read.collect()
    }
}

#[cfg(test)]
mod tests;
