//! The settings that turn counts into newtons.

use std::path::PathBuf;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

use crate::frame::{Array, Pitch};
use crate::range::{OutOfRange, positive, within};
use crate::wording::as_written;

/// The force of one count of the JX255N: 8 bits are 10.2 N.
pub const NEWTONS_PER_COUNT: f32 = 0.04;

/// The `[sensor.calibration]` table.
///
/// # Example
///
/// One taxel of four reads twice the force of the others, and one is dead.
///
/// ```
/// use hardnessd_core::frame::Array;
/// use hardnessd_core::tare::{Gains, Settings};
///
/// let settings = Settings {
///     gains: Some(Gains::Taxels(vec![vec![1.0, 0.5], vec![1.0, 1.0]])),
///     dead_taxels: vec![[1, 1]],
///     ..Settings::default()
/// };
/// assert!(settings.check(Array { rows: 2, cols: 2 }).is_ok());
/// let error = settings.check(Array::JX255N).unwrap_err();
/// assert_eq!(error.to_string(), "gains: found 2 rows of 2, expected 28 of 28");
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// The force of one count, in newtons.
    pub newtons_per_count: f32,
    /// The power of the counts with which force grows.
    pub exponent: f32,
    /// The factor of each taxel's newtons. `None` means 1 for all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gains: Option<Gains>,
    /// The distance between taxel centres: a number, or `[rows, columns]`.
    pub pitch_mm: Pitch,
    /// The number of frames that are averaged at start. With 0 there is no tare.
    pub tare_frames: u32,
    /// How far above the array's median an unloaded taxel may read.
    pub tare_max_n: f32,
    /// Whether the baseline follows slow drift while nothing touches the sensor.
    pub auto_tare: bool,
    /// The dead taxels: `[[row, col], ...]` in the sensor's own rows and columns.
    #[serde(deserialize_with = "pairs")]
    pub dead_taxels: Vec<[usize; 2]>,
}

/// The factor of each taxel's newtons.
///
/// [`Settings`] has an example.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "expected the path of an .npy file")]
pub enum Gains {
    /// The path of a numpy file, as a configuration gives it. The reader of the configuration
    /// replaces the path by the numbers, so a sensor never holds a path.
    File(PathBuf),
    /// `[rows][cols]`, in the sensor's own rows and columns. Recordings hold these.
    Taxels(Vec<Vec<f32>>),
}

/// Reads lists of exactly two numbers. The TOML parser would silently drop the rest of a longer
/// list.
fn pairs<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<[usize; 2]>, D::Error> {
    let pair = |list: Vec<usize>| {
        let length = list.len();
        <[usize; 2]>::try_from(list)
            .map_err(|_| D::Error::invalid_length(length, &"an array of length 2"))
    };
    let lists = Vec::<Vec<usize>>::deserialize(deserializer)?;
    lists.into_iter().map(pair).collect()
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            newtons_per_count: NEWTONS_PER_COUNT,
            exponent: 1.0,
            gains: None,
            pitch_mm: Pitch::JX255N,
            tare_frames: 5,
            tare_max_n: 0.5,
            auto_tare: false,
            dead_taxels: Vec::new(),
        }
    }
}

/// An unusable value of [`Settings`].
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SettingsError {
    /// A number is out of its range.
    #[error(transparent)]
    Range(#[from] OutOfRange),
    /// The file of the gains has not been read.
    #[error("gains: found the path of a file, expected its numbers")]
    GainsUnread,
    /// The gains have the shape of another array.
    #[error("gains: found {rows} rows of {found_cols}, expected {} of {}", array.rows, array.cols)]
    GainsShape {
        /// The number of rows of the gains.
        rows: usize,
        /// The number of columns in the first row that does not fit, or in the first row.
        found_cols: usize,
        /// The array.
        array: Array,
    },
    /// The gain of a taxel is outside [`GAINS`].
    #[error(
        "gains: found {found:?} at [{row}, {col}], expected {least} to {most}",
        least = GAINS.0,
        most = GAINS.1
    )]
    Gain {
        /// The configured value.
        found: f32,
        /// The row of the taxel.
        row: usize,
        /// The column of the taxel.
        col: usize,
    },
    /// A dead taxel is outside the array.
    #[error(
        "dead_taxels: found [{row}, {col}], expected a row below {} and a column below {}",
        array.rows,
        array.cols
    )]
    DeadTaxel {
        /// The configured row.
        row: usize,
        /// The configured column.
        col: usize,
        /// The array.
        array: Array,
    },
}

/// With these limits, every sum and product of a frame stays finite. The limits are far beyond any
/// film: a count of the JX255N is 0.04 N, its taxels are 3.5 mm apart, and no taxel bears 1 MN.
const MOST_NEWTONS_PER_COUNT: f64 = 1e3;
const MOST_PITCH_MM: f64 = 1e3;
/// The least and the greatest exponent. 65535 counts to the power of 4 are 1.8e19, which the sum
/// over a frame can still hold.
pub const EXPONENTS: (f64, f64) = (0.25, 4.0);
/// The least and the greatest gain. A taxel that reads a thousandth of the others is dead.
pub const GAINS: (f32, f32) = (0.001, 1000.0);
const MOST_TARE_N: f64 = 1e6;

/// The most frames of a tare: 65535 counts x 65536 frames stay below 2^32.
pub(super) const MOST_TARE_FRAMES: u32 = 65_536;

impl Settings {
    /// Checks the values against the sensor's array.
    ///
    /// # Errors
    ///
    /// Returns an error if `newtons_per_count`, `pitch_mm` or `tare_max_n` is not above 0 or is
    /// beyond any film, if `exponent` is out of its range, if `gains` have another shape or are out
    /// of their range, if `tare_frames` is above 65,536, or if a dead taxel lies outside `array`.
    pub fn check(&self, array: Array) -> Result<(), SettingsError> {
        let newtons_per_count = as_written(self.newtons_per_count);
        positive(
            "newtons_per_count",
            newtons_per_count,
            MOST_NEWTONS_PER_COUNT,
        )?;
        positive("pitch_mm", self.pitch_mm.rows_mm, MOST_PITCH_MM)?;
        positive("pitch_mm", self.pitch_mm.cols_mm, MOST_PITCH_MM)?;
        positive("tare_max_n", as_written(self.tare_max_n), MOST_TARE_N)?;
        within("exponent", as_written(self.exponent), EXPONENTS, "")?;
        if let Some(gains) = &self.gains {
            check_gains(gains, array)?;
        }
        within("tare_frames", self.tare_frames, (0, MOST_TARE_FRAMES), "")?;
        match self
            .dead_taxels
            .iter()
            .find(|[row, col]| *row >= array.rows || *col >= array.cols)
        {
            Some(&[row, col]) => Err(SettingsError::DeadTaxel { row, col, array }),
            None => Ok(()),
        }
    }
}

fn check_gains(gains: &Gains, array: Array) -> Result<(), SettingsError> {
    let Gains::Taxels(rows) = gains else {
        return Err(SettingsError::GainsUnread);
    };
    let first = rows.first().map_or(0, Vec::len);
    let found_cols = rows.iter().map(Vec::len).find(|&cols| cols != array.cols);
    if rows.len() != array.rows || found_cols.is_some() {
        return Err(SettingsError::GainsShape {
            rows: rows.len(),
            found_cols: found_cols.unwrap_or(first),
            array,
        });
    }
    for (row, gains) in rows.iter().enumerate() {
        let is_none = |gain: &f32| !(GAINS.0..=GAINS.1).contains(gain);
        if let Some(col) = gains.iter().position(is_none) {
            let found = gains[col];
            return Err(SettingsError::Gain { found, row, col });
        }
    }
    Ok(())
}
