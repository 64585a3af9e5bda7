//! The settings that turn counts into newtons.

use std::path::PathBuf;

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

use crate::frame::{Array, Pitch};
use crate::line::extent;
use crate::range::{OutOfRange, above_0, check, from_to};

/// The force of one count of the JX255N: 8 bits are 10.2 N.
pub const NEWTONS_PER_COUNT: f32 = 0.04;

crate::settings! {
    /// The `[sensor.calibration]` table. Its ranges are far beyond any film, and keep every sum and
    /// product of a frame finite.
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
    pub struct Settings {
        /// The force of one count, in newtons.
        pub newtons_per_count: f32 = NEWTONS_PER_COUNT, in above_0(1e3);
        /// The power of the counts with which force grows.
        pub exponent: f32 = 1.0, in from_to(EXPONENTS, "");
        /// The factor of each taxel's newtons. `None` means 1 for all.
        pub gains: Option<Gains>;
        /// The distance between taxel centres: a number, or `[rows, columns]`.
        pub pitch_mm: Pitch = Pitch::JX255N, in from_to((0.01, 1e3), "mm");
        /// The number of frames that are averaged at start. With 0 there is no tare.
        pub tare_frames: u32 = 5, in from_to((0.0, f64::from(MOST_TARE_FRAMES)), "");
        /// How far above the array's median an unloaded taxel may read. No taxel bears 1 MN.
        pub tare_max_n: f32 = 0.5, in above_0(1e6);
        /// Whether the baseline follows slow drift while nothing touches the sensor.
        pub auto_tare: bool = false;
        /// The dead taxels: `[[row, col], ...]` in the sensor's own rows and columns.
        #[serde(deserialize_with = "pairs")]
        pub dead_taxels: Vec<[usize; 2]> = Vec::new();
    }
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

impl Gains {
    /// The least and the greatest gain. `None` for the path of a file.
    pub fn extent(&self) -> Option<[f64; 2]> {
        match self {
            Self::File(_) => None,
            Self::Taxels(rows) => Some(extent(rows.iter().flatten().map(|&gain| gain.into()))),
        }
    }
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

/// The least and the greatest exponent. 65535 counts to the power of 4 are 1.8e19, which the sum
/// over a frame can still hold.
pub const EXPONENTS: (f64, f64) = (0.25, 4.0);
/// The least and the greatest gain. A taxel that reads a thousandth of the others is dead.
pub const GAINS: (f32, f32) = (0.001, 1000.0);

/// The most frames of a tare: 65535 counts x 65536 frames stay below 2^32.
pub(super) const MOST_TARE_FRAMES: u32 = 65_536;

impl Settings {
    /// Checks the values against the sensor's array.
    ///
    /// # Errors
    ///
    /// Returns an error if a value is out of its range, `gains` have another shape or are out of their
    /// range, or a dead taxel lies outside `array`.
    pub fn check(&self, array: Array) -> Result<(), OutOfRange> {
        self.check_ranges()?;
        if let Some(gains) = &self.gains {
            check_gains(gains, array)?;
        }
        let Array { rows, cols } = array;
        for taxel @ &[row, col] in &self.dead_taxels {
            let expected = format_args!("a row below {rows} and a column below {cols}");
            check("dead_taxels", taxel, row < rows && col < cols, expected)?;
        }
        Ok(())
    }
}

fn check_gains(gains: &Gains, array: Array) -> Result<(), OutOfRange> {
    let Gains::Taxels(rows) = gains else {
        let found = format_args!("the path of a file");
        return Err(OutOfRange::new("gains", found, "its numbers"));
    };
    // The width of the first wrong row, or else of all.
    let widths = rows.iter().map(Vec::len);
    let cols = widths.min_by_key(|&cols| cols == array.cols).unwrap_or(0);
    let found = format_args!("{} rows of {cols}", rows.len());
    let fits = rows.len() == array.rows && cols == array.cols;
    let expected = format_args!("{} of {}", array.rows, array.cols);
    check("gains", found, fits, expected)?;
    let (least, most) = GAINS;
    for (place, gain) in rows.iter().flatten().enumerate() {
        let (row, col) = array.position(place);
        let found = format_args!("{gain:?} at [{row}, {col}]");
        let expected = format_args!("{least} to {most}");
        check("gains", found, (least..=most).contains(gain), expected)?;
    }
    Ok(())
}
