//! An array with noise, for tests: 16x32 taxels of 12 bits, each of which rests at a count of its own.

use std::f64::consts::TAU;

use super::sensor_of;
use crate::frame::{Array, RawFrame};
use crate::sensor::Sensor;
use crate::wire::Cell;

/// The array.
pub const ARRAY: Array = Array { rows: 16, cols: 32 };
/// The force of one count, in newtons. 4095 counts are 5.3 N.
pub const COUNT_N: f64 = 0.0013;
/// The greatest count.
const MOST_COUNTS: u32 = 4095;

/// The array's electronics.
#[derive(Debug)]
pub struct NoisyArray {
    /// The count of each taxel without load and noise.
    rest: Vec<f64>,
    /// The standard deviation of the noise.
    noise_counts: f64,
    random: u64,
}

impl NoisyArray {
    /// An array whose taxels rest anywhere from 0 to `most_rest` counts.
    pub fn new(seed: u64, most_rest: f64, noise_counts: f64) -> Self {
        let mut array = Self {
            rest: Vec::new(),
            noise_counts,
            random: seed,
        };
        array.rest = (0..ARRAY.taxels())
            .map(|_| most_rest * array.uniform())
            .collect();
        array
    }

    /// The next frame, with this force on each taxel. The converter gives whole counts from 0 on.
    pub fn read(&mut self, newtons: &[f64]) -> RawFrame {
        let mut raw = RawFrame::zero(ARRAY);
        for (place, newtons) in newtons.iter().enumerate() {
            let noise = self.noise_counts * self.normal();
            let counts = self.rest[place] + newtons / COUNT_N + noise;
            raw.counts[place] = counts.round().clamp(0.0, f64::from(MOST_COUNTS)) as f32;
        }
        raw
    }

    /// Uniform from 0 to 1, by splitmix64.
    fn uniform(&mut self) -> f64 {
        self.random = self.random.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut bits = self.random;
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((bits ^ (bits >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Standard normal, by Box and Muller.
    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (TAU * self.uniform()).cos()
    }
}

/// The sensor of such an array, as a configuration with this scale describes it.
pub fn noisy_sensor(newtons_per_count: f32) -> Sensor {
    sensor_of(|described| {
        let frame = &mut described.sensor.frame;
        (frame.rows, frame.cols) = (Some(ARRAY.rows), Some(ARRAY.cols));
        (frame.cell, frame.mask) = (Some(Cell::U16le), Some(MOST_COUNTS));
        described.sensor.calibration.newtons_per_count = newtons_per_count;
    })
}

/// The forces of a round foot of three taxels' radius that presses with `force_n`. A cover spreads a
/// little of it beyond the rim.
pub fn foot(force_n: f64) -> Vec<f64> {
    let share = |place: usize| {
        let (row, col) = ARRAY.position(place);
        let radius = (row as f64 - 7.4).hypot(col as f64 - 15.7);
        1.0 / (1.0 + ((radius - 3.0) / 0.4).exp())
    };
    let shares: Vec<f64> = (0..ARRAY.taxels()).map(share).collect();
    let sum: f64 = shares.iter().sum();
    shares.iter().map(|share| force_n * share / sum).collect()
}
