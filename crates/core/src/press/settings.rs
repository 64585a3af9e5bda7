//! The thresholds that begin and end a press.

use serde::{Deserialize, Serialize};

use crate::frame::TAXELS;
use crate::wording::as_written;

/// The `[press]` table.
///
/// # Example
///
/// ```
/// use hardnessd_core::press::Settings;
///
/// let settings = Settings { max_seconds: 5.0, ..Settings::default() };
/// assert!(settings.check().is_ok());
///
/// let settings = Settings { begin_area_taxels: 3, end_area_taxels: 4, ..Settings::default() };
/// let error = settings.check().unwrap_err();
/// assert_eq!(error.to_string(), "end_area_taxels: found 4, expected 1 to 3");
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// A taxel is in contact at or above this force.
    pub contact_threshold_n: f32,
    /// A press begins with the first frame of at least this contact area.
    pub begin_area_taxels: u32,
    /// Frames below this contact area release the press.
    pub end_area_taxels: u32,
    /// The number of such frames in a row that releases it.
    pub end_frames: u32,
    /// A press with fewer frames in contact gets no verdict.
    pub min_frames: u64,
    /// A press that is held for this long ends.
    pub max_seconds: f64,
    /// How long the contact must have settled for an early verdict.
    pub early_settle_s: f64,
    /// The least total force for an early verdict.
    pub early_min_force_n: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            contact_threshold_n: 0.07,
            begin_area_taxels: 3,
            end_area_taxels: 1,
            end_frames: 2,
            min_frames: 2,
            max_seconds: 30.0,
            early_settle_s: 0.3,
            early_min_force_n: 1.0,
        }
    }
}

/// An unusable value of [`Settings`].
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SettingsError {
    /// The value is not positive, or too large.
    #[error("{key}: found {found:?}, expected a number above 0 and at most {max}")]
    NotPositive {
        /// The key of the value.
        key: &'static str,
        /// The configured value.
        found: f64,
        /// The largest allowed value.
        max: f64,
    },
    /// The value is negative or too large.
    #[error("{key}: found {found:?}, expected 0 or more and at most {max}")]
    Negative {
        /// The key of the value.
        key: &'static str,
        /// The configured value.
        found: f64,
        /// The largest allowed value.
        max: f64,
    },
    /// The count is out of its range.
    #[error("{key}: found {found}, expected {least} to {most}")]
    Count {
        /// The key of the value.
        key: &'static str,
        /// The configured value.
        found: u64,
        /// The smallest allowed value.
        least: u64,
        /// The largest allowed value.
        most: u64,
    },
}

/// The longest duration and the largest force that settings may have.
const LARGEST: f64 = 1e6;

impl Settings {
    /// Checks every value.
    ///
    /// # Errors
    ///
    /// Returns an error if a force or duration is not finite or out of range, an area is 0 or above
    /// 784, the end area is above the begin area, or a count of frames is 0.
    pub fn check(&self) -> Result<(), SettingsError> {
        for (key, found) in [
            ("contact_threshold_n", as_written(self.contact_threshold_n)),
            ("max_seconds", self.max_seconds),
        ] {
            if !(found > 0.0 && found <= LARGEST) {
                return Err(SettingsError::NotPositive {
                    key,
                    found,
                    max: LARGEST,
                });
            }
        }
        for (key, found) in [
            ("early_settle_s", self.early_settle_s),
            ("early_min_force_n", self.early_min_force_n),
        ] {
            if !(0.0..=LARGEST).contains(&found) {
                return Err(SettingsError::Negative {
                    key,
                    found,
                    max: LARGEST,
                });
            }
        }
        for (key, found, most) in [
            (
                "begin_area_taxels",
                u64::from(self.begin_area_taxels),
                TAXELS as u64,
            ),
            (
                "end_area_taxels",
                u64::from(self.end_area_taxels),
                self.begin_area_taxels.into(),
            ),
            (
                "end_frames",
                u64::from(self.end_frames),
                u64::from(u32::MAX),
            ),
            ("min_frames", self.min_frames, u64::MAX),
        ] {
            if !(1..=most).contains(&found) {
                return Err(SettingsError::Count {
                    key,
                    found,
                    least: 1,
                    most,
                });
            }
        }
        Ok(())
    }
}
