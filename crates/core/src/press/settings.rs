//! The thresholds that begin and end a press.

use crate::frame::{Array, Pitch};
use crate::range::{OutOfRange, above_0, from_to};

/// The largest number of a key, which is beyond any press.
const LARGEST: f64 = 1e6;

crate::settings! {
    /// The `[press]` table. A key that is `None` depends on the size of a taxel: see [`Thresholds`].
    ///
    /// # Example
    ///
    /// ```
    /// use hardnessd_core::frame::{Array, Pitch};
    /// use hardnessd_core::press::Settings;
    ///
    /// let settings = Settings { max_seconds: 5.0, ..Settings::default() };
    /// let thresholds = settings.check(Array::JX255N, Pitch::square(7.0))?;
    /// assert_eq!(thresholds.contact_threshold_n, 0.28);
    ///
    /// let settings = Settings { begin_area_taxels: Some(3), end_area_taxels: Some(4), ..Settings::default() };
    /// let error = settings.check(Array::JX255N, Pitch::JX255N).unwrap_err();
    /// assert_eq!(error.to_string(), "end_area_taxels: found 4, expected 1 to 3");
    /// # Ok::<(), hardnessd_core::range::OutOfRange>(())
    /// ```
    pub struct Settings {
        /// A taxel is in contact at or above this force.
        pub contact_threshold_n: Option<f32>, in above_0(LARGEST);
        /// A press begins with the first frame of at least this contact area.
        pub begin_area_taxels: Option<u32>;
        /// Frames below this contact area release the press.
        pub end_area_taxels: Option<u32>;
        /// The number of such frames in a row that releases it.
        pub end_frames: u32 = 2, in from_to((1.0, LARGEST), "");
        /// A press with fewer frames in contact gets no verdict.
        pub min_frames: u64 = 2, in from_to((1.0, LARGEST), "");
        /// A press that is held for this long ends.
        pub max_seconds: f64 = 30.0, in above_0(LARGEST);
        /// How long the contact must have settled for an early verdict.
        pub early_settle_s: f64 = 0.3, in from_to((0.0, LARGEST), "");
        /// The least total force for an early verdict.
        pub early_min_force_n: f64 = 1.0, in from_to((0.0, LARGEST), "");
    }
}

impl Settings {
    /// Checks every value. Returns the thresholds for an array of taxels `pitch` apart.
    ///
    /// # Errors
    ///
    /// Returns an error if a value is out of its range, an area is 0 or above the number of taxels, or
    /// the end area is above the begin area.
    pub fn check(&self, array: Array, pitch: Pitch) -> Result<Thresholds, OutOfRange> {
        self.check_ranges()?;
        let thresholds = self.thresholds(array, pitch);
        let (begin, end) = (thresholds.begin_area_taxels, thresholds.end_area_taxels);
        from_to((1.0, array.taxels() as f64), "").check("begin_area_taxels", &begin)?;
        from_to((1.0, begin.into()), "").check("end_area_taxels", &end)?;
        Ok(thresholds)
    }

    /// The unchecked thresholds for an array of taxels `pitch` apart.
    fn thresholds(&self, array: Array, pitch: Pitch) -> Thresholds {
        let taxel = pitch.area_mm2() / Pitch::JX255N.area_mm2();
        // A finer array sees the same contact with more taxels. A coarser one keeps the number: a
        // single taxel may be noise.
        let finer = (1.0 / taxel).max(1.0);
        let most = array.taxels() as u32;
        let area = |given: Option<u32>, usual: f64, most: u32| {
            given.unwrap_or_else(|| ((usual * finer).round() as u32).min(most))
        };
        let begin_area_taxels = area(self.begin_area_taxels, 3.0, most);
        let usual_n = pitch.contact_threshold_n();
        Thresholds {
            contact_threshold_n: self.contact_threshold_n.unwrap_or(usual_n),
            begin_area_taxels,
            end_area_taxels: area(self.end_area_taxels, 1.0, begin_area_taxels),
            settings: self.clone(),
        }
    }
}

/// Checked [`Settings`], with those that depend on the taxels of one sensor. By default they are those of the
/// JX255N.
#[derive(Debug, Clone, PartialEq)]
pub struct Thresholds {
    /// A taxel is in contact at or above this force.
    pub contact_threshold_n: f32,
    /// A press begins with the first frame of at least this contact area.
    pub begin_area_taxels: u32,
    /// Frames below this contact area release the press.
    pub end_area_taxels: u32,
    /// The settings that mean the same on every array.
    pub settings: Settings,
}

impl Default for Thresholds {
    fn default() -> Self {
        Settings::default().thresholds(Array::JX255N, Pitch::JX255N)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thresholds_mean_the_same_pressure_and_area_on_every_array() {
        let array = Array { rows: 64, cols: 64 };
        for (pitch, threshold_n, begin, end) in [
            (Pitch::JX255N, 0.07, 3, 1),
            (Pitch::square(1.75), 0.0175, 12, 4),
            (Pitch::square(1.5), 0.012_857, 16, 5),
            (Pitch::square(7.0), 0.28, 3, 1),
            (
                Pitch {
                    rows_mm: 7.0,
                    cols_mm: 1.75,
                },
                0.07,
                3,
                1,
            ),
        ] {
            let found = Settings::default().check(array, pitch).unwrap();
            assert!(
                (found.contact_threshold_n - threshold_n).abs() < 1e-6,
                "{found:?}"
            );
            assert_eq!(
                (found.begin_area_taxels, found.end_area_taxels),
                (begin, end)
            );
        }
        // A press can begin on an array of two taxels.
        let two = Settings::default().check(Array { rows: 1, cols: 2 }, Pitch::JX255N);
        assert_eq!(two.unwrap().begin_area_taxels, 2);
    }
}
