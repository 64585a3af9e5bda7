//! The settings that turn counts into newtons.

use std::fmt;
use std::path::PathBuf;

use serde::de::value::SeqAccessDeserializer;
use serde::de::{Error as _, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};

use crate::frame::Array;
use crate::wording::as_written;

/// Force of one count of the JX255N: 8 bits are 10.2 N.
pub const NEWTONS_PER_COUNT: f32 = 0.04;
/// Distance of its taxel centres (paper, "Tactile sensor").
pub const PITCH_MM: f64 = 3.5;

/// The `[sensor.calibration]` table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Force of one count.
    pub newtons_per_count: f32,
    /// Force grows with this power of the counts.
    pub exponent: f32,
    /// By what each taxel's newtons are multiplied; `None`: 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gains: Option<Gains>,
    /// Distance of taxel centres.
    pub pitch_mm: f64,
    /// Frames averaged at start; 0: no tare.
    pub tare_frames: u32,
    /// How far above the array's median a taxel may rest.
    pub tare_max_n: f32,
    /// The baseline follows slow drift while nothing touches the sensor.
    pub auto_tare: bool,
    /// `[[row, col], ...]` in the sensor's own rows and columns.
    #[serde(deserialize_with = "pairs")]
    pub dead_taxels: Vec<[usize; 2]>,
}

/// By what each taxel's newtons are multiplied.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Gains {
    /// In a numpy file that a configuration names. Whoever reads the configuration reads it too, and a
    /// sensor never has it.
    File(PathBuf),
    /// `[rows][cols]`, in the sensor's own rows and columns. Recordings hold these.
    Taxels(Vec<Vec<f32>>),
}

impl<'de> Deserialize<'de> for Gains {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Either;

        impl<'de> Visitor<'de> for Either {
            type Value = Gains;

            fn expecting(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
                out.write_str("the path of an .npy file")
            }

            fn visit_str<E>(self, path: &str) -> Result<Gains, E> {
                Ok(Gains::File(path.into()))
            }

            fn visit_seq<A: SeqAccess<'de>>(self, rows: A) -> Result<Gains, A::Error> {
                Vec::deserialize(SeqAccessDeserializer::new(rows)).map(Gains::Taxels)
            }
        }

        deserializer.deserialize_any(Either)
    }
}

/// Reads lists of exactly two. The TOML parser would silently drop the rest of a longer list.
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
            pitch_mm: PITCH_MM,
            tare_frames: 5,
            tare_max_n: 0.5,
            auto_tare: false,
            dead_taxels: Vec::new(),
        }
    }
}

/// A value of [`Settings`] that cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SettingsError {
    /// A quantity that must be positive, and not so large that no film has it.
    #[error("{key}: found {found:?}, expected a number above 0 and at most {max}")]
    NotPositive {
        /// The key of the value.
        key: &'static str,
        /// The value that was given.
        found: f64,
        /// Largest allowed.
        max: f64,
    },
    /// A power that no film has.
    #[error("exponent: found {found:?}, expected {least} to {most}", least = EXPONENTS.0, most = EXPONENTS.1)]
    Exponent {
        /// The value that was given.
        found: f64,
    },
    /// Gains that nobody has read.
    #[error("gains: found the path of a file, expected its numbers")]
    GainsUnread,
    /// Gains of another array.
    #[error("gains: found {rows} rows of {found_cols}, expected {} of {}", array.rows, array.cols)]
    GainsShape {
        /// Rows that were given.
        rows: usize,
        /// Columns of the first row that does not fit, or of the first.
        found_cols: usize,
        /// The array.
        array: Array,
    },
    /// A gain that no taxel has.
    #[error(
        "gains: found {found:?} at [{row}, {col}], expected {least} to {most}",
        least = GAINS.0,
        most = GAINS.1
    )]
    Gain {
        /// The value that was given.
        found: f32,
        /// Its row.
        row: usize,
        /// Its column.
        col: usize,
    },
    /// More frames than a sum of counts can hold.
    #[error("tare_frames: found {found}, expected 0 to {max}")]
    TareFrames {
        /// The value that was given.
        found: u32,
        /// Largest.
        max: u32,
    },
    /// A dead taxel outside the array.
    #[error(
        "dead_taxels: found [{row}, {col}], expected a row below {} and a column below {}",
        array.rows,
        array.cols
    )]
    DeadTaxel {
        /// The value that was given.
        row: usize,
        /// The value that was given.
        col: usize,
        /// The array.
        array: Array,
    },
}

/// What every sum and product of a frame stays finite with, and far beyond any film: a count of the
/// JX255N is 0.04 N, its taxels are 3.5 mm apart, and 1 MN rests on no taxel.
const MOST_NEWTONS_PER_COUNT: f64 = 1e3;
const MOST_PITCH_MM: f64 = 1e3;
/// Least and greatest power. 65535 counts to the power of 4 are 1.8e19, which a frame's sum still holds.
pub const EXPONENTS: (f64, f64) = (0.25, 4.0);
/// Least and greatest gain. A taxel that reads a thousandth of the others is dead.
pub const GAINS: (f32, f32) = (0.001, 1000.0);
const MOST_TARE_N: f64 = 1e6;

/// 65535 counts x 65536 frames stay below 2^32.
pub(super) const MOST_TARE_FRAMES: u32 = 65_536;

impl Settings {
    /// Checks the values against the sensor's array.
    ///
    /// # Errors
    ///
    /// If `newtons_per_count`, `pitch_mm` or `tare_max_n` is not above 0 or is beyond any film,
    /// `exponent` is out of its range, `gains` are of another array or out of theirs, `tare_frames` is above 65,536, or a dead taxel lies outside `array`.
    pub fn check(&self, array: Array) -> Result<(), SettingsError> {
        for (key, found, max) in [
            (
                "newtons_per_count",
                as_written(self.newtons_per_count),
                MOST_NEWTONS_PER_COUNT,
            ),
            ("pitch_mm", self.pitch_mm, MOST_PITCH_MM),
            ("tare_max_n", as_written(self.tare_max_n), MOST_TARE_N),
        ] {
            if !(found > 0.0 && found <= max) {
                return Err(SettingsError::NotPositive { key, found, max });
            }
        }
        let exponent = as_written(self.exponent);
        if !(EXPONENTS.0..=EXPONENTS.1).contains(&exponent) {
            return Err(SettingsError::Exponent { found: exponent });
        }
        if let Some(gains) = &self.gains {
            check_gains(gains, array)?;
        }
        if self.tare_frames > MOST_TARE_FRAMES {
            return Err(SettingsError::TareFrames {
                found: self.tare_frames,
                max: MOST_TARE_FRAMES,
            });
        }
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
