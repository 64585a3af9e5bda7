//! The film array, which turns the pressure under its cover into taxel forces, and those into
//! counts.
//!
//! A [`Sensor`] is one instance, whose gains, activation thresholds and dead taxels are drawn once.
//! There is no noise without load: below its activation threshold a taxel's layers do not touch,
//! and the taxel reads exactly 0, as film arrays do.

use std::sync::OnceLock;

use serde::{Deserialize, Serialize};

use crate::random::Stream;
use hardnessd_core::frame::{Array, Pitch, RawFrame};
use hardnessd_core::tare::NEWTONS_PER_COUNT;

/// The simulated array.
pub(super) const ARRAY: Array = Array::JX255N;
/// Rows of the array.
const ROWS: usize = ARRAY.rows;
/// Columns of the array.
const COLS: usize = ARRAY.cols;
/// Taxels of the array.
pub(super) const TAXELS: usize = ARRAY.taxels();
/// The distance between taxels.
const PITCH_MM: f64 = Pitch::JX255N.rows_mm;

/// Cells along a taxel.
const CELLS_PER_TAXEL: usize = 4;
/// Width of a cell, mm.
pub(super) const CELL_MM: f64 = PITCH_MM / CELLS_PER_TAXEL as f64;
/// Width of the sensor in cells.
pub(super) const CELLS: usize = ROWS * CELLS_PER_TAXEL;

/// Width of a taxel's sensitive area, mm.
const ACTIVE_MM: f64 = 3.0;
/// Depth of the film under the cover's surface, mm.
const DEPTH_MM: f64 = 1.0;
/// Film creep, as share and time constant in s: 3 % with 0.4 s, and 4 % with 8 s.
const FILM_CREEP: [(f32, f32); 2] = [(0.03, 0.4), (0.04, 8.0)];
const CROSSTALK_NEIGHBOUR: f32 = 0.015;
const CROSSTALK_LINE: f32 = 0.004;
const NOISE_RATIO: f64 = 0.015;
const NOISE_N: f64 = 0.012;
const DEAD_SHARE: f64 = 0.003;
/// The largest count of the simulated sensor, which has 8 bits.
pub const FULL_SCALE_COUNTS: u16 = 255;
/// Median of the lognormal activation thresholds. Their +3 sigma is the paper's "minimum
/// discrimination" of 0.2 N, read as a bound that holds for every taxel.
const THRESHOLD_MEDIAN_N: f64 = 0.05;
const THRESHOLD_BOUND_N: f64 = 0.2;

/// The spread between the taxels of a sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SensorProfile {
    /// The spread after a taxel-wise calibration.
    Clean,
    /// The spread measured on a public film array.
    Raw,
}

impl std::str::FromStr for SensorProfile {
    type Err = UnknownProfile;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        match name {
            "clean" => Ok(SensorProfile::Clean),
            "raw" => Ok(SensorProfile::Raw),
            _ => Err(UnknownProfile(name.to_owned())),
        }
    }
}

/// A name that is not a sensor profile.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no sensor profile \"{0}\"; there are clean, raw")]
pub struct UnknownProfile(pub String);

/// Relative spreads of a profile, per taxel, row, column and press.
struct Spread {
    taxel: f64,
    row: f64,
    column: f64,
    press: f64,
}

impl SensorProfile {
    fn spread(self) -> Spread {
        match self {
            SensorProfile::Clean => Spread {
                taxel: 0.06,
                row: 0.03,
                column: 0.03,
                press: 0.0,
            },
            SensorProfile::Raw => Spread {
                taxel: 0.16,
                row: 0.03,
                column: 0.055,
                press: 0.10,
            },
        }
    }
}

/// One instance of a sensor.
#[derive(Debug, Clone)]
pub(super) struct Sensor {
    gain: Vec<f32>,
    threshold_n: Vec<f32>,
    press_spread: f64,
}

impl Sensor {
    /// Draws a sensor.
    pub(super) fn new(profile: SensorProfile, stream: &Stream) -> Self {
        let spread = profile.spread();
        let lines = |sd: f64, name: u64, count: usize| -> Vec<f64> {
            let mut stream = stream.child(name);
            (0..count).map(|_| 1.0 + sd * stream.normal()).collect()
        };
        let taxels = lines(spread.taxel, 0, TAXELS);
        let rows = lines(spread.row, 1, ROWS);
        let columns = lines(spread.column, 2, COLS);
        let mut dead = stream.child(3);
        let gain = (0..TAXELS)
            .map(|k| {
                let alive = dead.uniform() >= DEAD_SHARE;
                let gain = taxels[k] * rows[k / COLS] * columns[k % COLS];
                if alive { gain.max(0.0) as f32 } else { 0.0 }
            })
            .collect();
        let mut draws = stream.child(4);
        let sigma = (THRESHOLD_BOUND_N / THRESHOLD_MEDIAN_N).ln() / 3.0;
        let threshold_n = (0..TAXELS)
            .map(|_| {
                let drawn = THRESHOLD_MEDIAN_N * (sigma * draws.normal()).exp();
                drawn.min(THRESHOLD_BOUND_N) as f32
            })
            .collect();
        Self {
            gain,
            threshold_n,
            press_spread: spread.press,
        }
    }

    /// The gain of each taxel; 0 for a dead one.
    pub(super) fn gains(&self) -> &[f32] {
        &self.gain
    }

    /// Draws the factor common to all taxels in one press.
    pub(super) fn press_gain(&self, stream: &mut Stream) -> f32 {
        (1.0 + self.press_spread * stream.normal()).max(0.3) as f32
    }

    /// Converts taxel forces in newtons, with film creep, into counts.
    pub(super) fn read(
        &self,
        forces_n: &[f32; TAXELS],
        press_gain: f32,
        noise: &mut Stream,
    ) -> RawFrame {
        let mut rows = [0.0_f32; ROWS];
        let mut columns = [0.0_f32; COLS];
        for (k, &force) in forces_n.iter().enumerate() {
            rows[k / COLS] += force;
            columns[k % COLS] += force;
        }
        let mut raw = RawFrame::zero(ARRAY);
        for (k, counts) in raw.counts.iter_mut().enumerate() {
            let (row, column) = (k / COLS, k % COLS);
            let own = forces_n[k];
            let mut near = 0.0;
            if row > 0 {
                near += forces_n[k - COLS];
            }
            if row + 1 < ROWS {
                near += forces_n[k + COLS];
            }
            if column > 0 {
                near += forces_n[k - 1];
            }
            if column + 1 < COLS {
                near += forces_n[k + 1];
            }
            // Force through the cover can close a taxel. Crosstalk along the lines cannot, and an
            // open taxel reads nothing. Otherwise 25 N on one point would draw a cross.
            let pressed = own + CROSSTALK_NEIGHBOUR * near;
            if pressed <= self.threshold_n[k] {
                continue;
            }
            let line = rows[row] + columns[column] - 2.0 * own;
            let felt = pressed + CROSSTALK_LINE * line;
            let ratio = 1.0 + (NOISE_RATIO * noise.normal()) as f32;
            let read = felt * self.gain[k] * press_gain * ratio
                + if self.gain[k] > 0.0 {
                    (NOISE_N * noise.normal()) as f32
                } else {
                    0.0
                };
            let rounded = (read / NEWTONS_PER_COUNT)
                .round()
                .clamp(0.0, f32::from(FULL_SCALE_COUNTS));
            // A reading of one count becomes 0.
            *counts = if rounded < 2.0 { 0 } else { rounded as u16 };
        }
        raw
    }
}

/// The state of the film's creep under each taxel.
#[derive(Debug, Clone)]
pub(super) struct Film {
    crept: Vec<[f32; 2]>,
}

impl Film {
    /// A film at rest.
    pub(super) fn new() -> Self {
        Self {
            crept: vec![[0.0; 2]; TAXELS],
        }
    }

    /// Advances by `time_s` under `forces_n` and returns the forces with the film's creep. Creep
    /// multiplies the load, so an unloaded taxel reads nothing, however long it was loaded.
    pub(super) fn advance(&mut self, forces_n: &[f32; TAXELS], time_s: f64) -> [f32; TAXELS] {
        let step = FILM_CREEP.map(|(_, tau)| -(-(time_s as f32) / tau).exp_m1());
        let mut read = [0.0; TAXELS];
        for ((read, &force), crept) in read.iter_mut().zip(forces_n).zip(&mut self.crept) {
            let goal = if force > 0.0 { 1.0 } else { 0.0 };
            let mut factor = 1.0;
            for ((crept, step), (ratio, _)) in crept.iter_mut().zip(step).zip(FILM_CREEP) {
                *crept += step * (goal - *crept);
                factor += ratio * *crept;
            }
            *read = force * factor;
        }
        read
    }
}

/// The number of taxels on each side that feel a load.
const REACH: usize = 2;
const SPAN: usize = 2 * REACH + 1;

/// The taxel forces (N) from the pressure (MPa) on a window of cells. `corner` is the window's
/// first row and column in cells of the sensor. Force beyond the sensor's border is lost, as on a
/// real sensor.
pub(super) fn taxel_forces(
    pressure_mpa: &[f32],
    width: usize,
    corner: (usize, usize),
) -> [f32; TAXELS] {
    let table = spreading();
    let mut forces = [0.0_f32; TAXELS];
    let area = (CELL_MM * CELL_MM) as f32;
    for (k, &pressure) in pressure_mpa.iter().enumerate() {
        if pressure == 0.0 {
            continue;
        }
        let (i, j) = (corner.0 + k / width, corner.1 + k % width);
        let cell = i % CELLS_PER_TAXEL * CELLS_PER_TAXEL + j % CELLS_PER_TAXEL;
        let (row, column) = (i / CELLS_PER_TAXEL, j / CELLS_PER_TAXEL);
        for (n, &share) in table[cell].iter().enumerate() {
            let (row, column) = (row + n / SPAN, column + n % SPAN);
            if (REACH..ROWS + REACH).contains(&row) && (REACH..COLS + REACH).contains(&column) {
                forces[(row - REACH) * COLS + column - REACH] += pressure * area * share;
            }
        }
    }
    forces
}

/// The shares of a load on each cell of a taxel that the taxel and its neighbours feel.
///
/// Normal stress at depth z under a point load is `3 F z^3 / (2 pi (r^2 + z^2)^(5/2))`, whose
/// transform is `(1 + q z) exp(-q z)`. A taxel integrates its active square and is calibrated
/// under uniform pressure, so that over a taxel's cells the shares add up to 1 on average.
fn spreading() -> &'static [[f32; SPAN * SPAN]; CELLS_PER_TAXEL * CELLS_PER_TAXEL] {
    static TABLE: OnceLock<[[f32; SPAN * SPAN]; CELLS_PER_TAXEL * CELLS_PER_TAXEL]> =
        OnceLock::new();
    TABLE.get_or_init(|| {
        // The number of points along a taxel's active width and along a cell (midpoint rule).
        const FINE: usize = 12;
        const PARTS: usize = 3;
        let mut table = [[0.0_f32; SPAN * SPAN]; CELLS_PER_TAXEL * CELLS_PER_TAXEL];
        let mut sum = 0.0;
        let along = |cell: usize, part: usize| {
            (cell as f64 + (part as f64 + 0.5) / PARTS as f64) * CELL_MM - 0.5 * PITCH_MM
        };
        let active = |taxel: usize, point: usize| {
            (taxel as f64 - REACH as f64) * PITCH_MM
                + ((point as f64 + 0.5) / FINE as f64 - 0.5) * ACTIVE_MM
        };
        for (cell, shares) in table.iter_mut().enumerate() {
            for (n, share) in shares.iter_mut().enumerate() {
                let mut value = 0.0;
                for part in 0..PARTS * PARTS {
                    let y = along(cell / CELLS_PER_TAXEL, part / PARTS);
                    let x = along(cell % CELLS_PER_TAXEL, part % PARTS);
                    for point in 0..FINE * FINE {
                        let dy = active(n / SPAN, point / FINE) - y;
                        let dx = active(n % SPAN, point % FINE) - x;
                        let square = dx * dx + dy * dy + DEPTH_MM * DEPTH_MM;
                        value += DEPTH_MM.powi(3) / (square * square * square.sqrt());
                    }
                }
                *share = value as f32;
                sum += value;
            }
        }
        let scale = ((CELLS_PER_TAXEL * CELLS_PER_TAXEL) as f64 / sum) as f32;
        table.iter_mut().flatten().for_each(|share| *share *= scale);
        table
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn smooth_load() -> (Vec<f32>, f64) {
        let width = 48_usize;
        let pressure: Vec<f32> = (0..width * width)
            .map(|k: usize| {
                let r2 = (k / width).abs_diff(24).pow(2) + (k % width).abs_diff(21).pow(2);
                (1.0_f32 - r2 as f32 / 256.0).max(0.0).sqrt()
            })
            .collect();
        let force = pressure
            .iter()
            .map(|&p| f64::from(p) * CELL_MM * CELL_MM)
            .sum();
        (pressure, force)
    }

    /// A raw sensor without activation thresholds.
    fn without_thresholds(seed: u64) -> Sensor {
        let mut sensor = Sensor::new(SensorProfile::Raw, &Stream::new(seed, "sensor"));
        sensor.threshold_n.fill(0.0);
        sensor
    }

    #[test]
    fn taxel_forces_add_up_to_the_force() {
        let (pressure, force) = smooth_load();
        let taxels = taxel_forces(&pressure, 48, (30, 33));
        let sum: f64 = taxels.iter().map(|&f| f64::from(f)).sum();
        assert!((sum / force - 1.0).abs() < 2e-3, "{sum} N of {force} N");
    }

    #[test]
    fn readings_follow_the_force_within_the_sensors_spread() {
        let (pressure, force) = smooth_load();
        let taxels = taxel_forces(&pressure, 48, (30, 33)).map(|f| f * 0.1);
        let sensor = Sensor::new(SensorProfile::Clean, &Stream::new(5, "sensor"));
        let raw = sensor.read(&taxels, 1.0, &mut Stream::new(5, "noise"));
        let read: f64 = raw
            .counts
            .iter()
            .map(|&c| f64::from(c) * f64::from(NEWTONS_PER_COUNT))
            .sum();
        // Where a taxel is above its threshold, crosstalk adds up to 4 x 1.5 % + 54 x 0.4 %.
        assert!(
            (0.97..1.25).contains(&(read / (0.1 * force))),
            "{read} N of {} N",
            0.1 * force
        );
    }

    #[test]
    fn a_point_load_draws_no_cross() {
        let mut forces = [0.0; TAXELS];
        forces[14 * COLS + 14] = 25.0;
        let sensor = without_thresholds(6);
        let raw = sensor.read(&forces, 1.0, &mut Stream::new(6, "noise"));
        assert_eq!(
            raw.counts.iter().filter(|&&counts| counts > 0).count(),
            5,
            "itself and four"
        );
    }

    #[test]
    fn an_unloaded_sensor_reads_zero_even_after_long_load() {
        let mut film = Film::new();
        let mut forces = [3.0; TAXELS];
        for _ in 0..100 {
            film.advance(&forces, 0.1);
        }
        let crept = film.advance(&forces, 0.1)[0] / 3.0;
        assert!((1.05..1.07).contains(&crept), "film creep {crept}");
        forces = [0.0; TAXELS];
        let sensor = without_thresholds(1);
        let raw = sensor.read(
            &film.advance(&forces, 0.01),
            1.0,
            &mut Stream::new(2, "noise"),
        );
        assert_eq!(raw, RawFrame::zero(ARRAY));
    }

    #[test]
    fn every_taxel_feels_the_guaranteed_load_and_full_scale_is_8_bits() {
        let sensor = Sensor::new(SensorProfile::Clean, &Stream::new(9, "sensor"));
        let mut noise = Stream::new(9, "noise");
        let dead = sensor.gain.iter().filter(|&&gain| gain == 0.0).count();
        let felt = |raw: RawFrame| raw.counts.iter().filter(|&&c| c > 0).count();
        assert_eq!(
            felt(sensor.read(&[0.21; TAXELS], 1.0, &mut noise)),
            TAXELS - dead
        );
        assert!(felt(sensor.read(&[0.03; TAXELS], 1.0, &mut noise)) < TAXELS / 2);
        let most = sensor
            .read(&[100.0; TAXELS], 1.0, &mut noise)
            .counts
            .into_iter()
            .max();
        assert_eq!(most, Some(255));
    }
}
