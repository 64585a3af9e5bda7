//! The settings of the arm that presses.

use serde::{Deserialize, Serialize};

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

/// An unusable value of [`Settings`].
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{key}: found {found:?}, expected {least} to {most} {unit}")]
pub struct SettingsError {
    key: &'static str,
    found: f64,
    least: f64,
    most: f64,
    unit: &'static str,
}

impl Settings {
    /// Checks every value.
    ///
    /// # Errors
    ///
    /// Returns an error if a stiffness, speed or delay is out of its range.
    pub fn check(&self) -> Result<(), SettingsError> {
        for (key, found, (least, most), unit) in [
            (
                "stiffness_n_per_mm",
                self.stiffness_n_per_mm,
                STIFFNESSES_N_PER_MM,
                "N/mm",
            ),
            ("speed_mm_s", self.speed_mm_s, SPEEDS_MM_S, "mm/s"),
            ("delay_ms", Some(self.delay_ms), DELAYS_MS, "ms"),
        ] {
            if let Some(found) = found
                && !(least..=most).contains(&found)
            {
                return Err(SettingsError {
                    key,
                    found,
                    least,
                    most,
                    unit,
                });
            }
        }
        Ok(())
    }
}
