//! The settings of the arm that presses.

use serde::{Deserialize, Serialize};

use crate::range::{OutOfRange, within};

/// The `[sensor.arm]` table.
///
/// # Example
///
/// ```
/// use hardnessd_core::motion::Settings;
///
/// let settings = Settings { stiffness_n_per_mm: Some(12.0), ..Settings::default() };
/// assert!(settings.check().is_ok());
///
/// let settings = Settings { speed_mm_s: Some(0.0), ..Settings::default() };
/// let error = settings.check().unwrap_err();
/// assert_eq!(error.to_string(), "speed_mm_s: found 0.0, expected 0.001 to 1000 mm/s");
/// ```
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// The stiffness of everything behind the sensor's face. `None` if it is unknown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stiffness_n_per_mm: Option<f64>,
    /// The speed of a steady approach, if the robot sends no positions. `None` if it is unknown.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub speed_mm_s: Option<f64>,
    /// How much earlier the arm's stamps are than the frames'.
    pub delay_ms: f64,
}

/// The slowest and the fastest steady approach.
pub const SPEEDS_MM_S: (f64, f64) = (0.001, 1000.0);
/// The softest and the stiffest arm.
const STIFFNESSES_N_PER_MM: (f64, f64) = (0.001, 100_000.0);
/// The least and the greatest delay: a frame takes less than a second from the sensor to its last
/// byte.
pub(super) const DELAYS_MS: (f64, f64) = (-1000.0, 1000.0);

impl Settings {
    /// Checks every value.
    ///
    /// # Errors
    ///
    /// Returns an error if a stiffness, speed or delay is out of its range.
    pub fn check(&self) -> Result<(), OutOfRange> {
        if let Some(stiffness) = self.stiffness_n_per_mm {
            within(
                "stiffness_n_per_mm",
                stiffness,
                STIFFNESSES_N_PER_MM,
                "N/mm",
            )?;
        }
        if let Some(speed) = self.speed_mm_s {
            within("speed_mm_s", speed, SPEEDS_MM_S, "mm/s")?;
        }
        within("delay_ms", self.delay_ms, DELAYS_MS, "ms")
    }
}
