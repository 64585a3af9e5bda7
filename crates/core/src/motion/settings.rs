//! The settings of the arm that presses.

use crate::range::from_to;

crate::settings! {
    /// The `[sensor.arm]` table.
    pub struct Settings {
        /// The stiffness of everything behind the sensor's face. `None` if it is unknown.
        pub stiffness_n_per_mm: Option<f64>, in from_to((0.001, 100_000.0), "N/mm");
        /// The speed of a steady approach, if the robot sends no positions. `None` if it is unknown.
        pub speed_mm_s: Option<f64>, in from_to(SPEEDS_MM_S, "mm/s");
        /// How much earlier the arm's stamps are than the frames'.
        pub delay_ms: f64 = 0.0, in from_to(DELAYS_MS, "ms");
    }
}

/// The slowest and the fastest steady approach.
pub const SPEEDS_MM_S: (f64, f64) = (0.001, 1000.0);
/// The least and the greatest delay: a frame takes less than a second from the sensor to its last
/// byte.
pub(super) const DELAYS_MS: (f64, f64) = (-1000.0, 1000.0);
