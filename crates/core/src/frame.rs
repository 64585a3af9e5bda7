//! One instant of the sensor: 28x28 taxels, row-major.
//!
//! A [`RawFrame`] is in counts, as the sensor sent them. A [`Frame`] is in newtons, after tare and
//! with dead taxels replaced. Only `tare` makes a [`Frame`] from a [`RawFrame`], so raw counts
//! cannot
//! reach the press tracker.

pub mod sparse;

use serde::{Deserialize, Serialize};

/// Rows of a frame, and of the network's input (paper, "Tactile sensor").
pub const ROWS: usize = 28;
/// Columns of a frame, and of the network's input.
pub const COLS: usize = 28;
/// Taxels in a frame.
pub const TAXELS: usize = ROWS * COLS;

/// A frame in sensor counts. Taxels outside a smaller array are 0.
///
/// # Example
///
/// ```
/// use hardnessd_core::frame::{Array, RawFrame};
///
/// let array = Array { rows: 10, cols: 12 };
/// let mut raw = RawFrame::default();
/// raw.counts[array.place(0, 0)] = 200;
/// assert_eq!(format!("{raw:?}"), "RawFrame { sum: 200, peak: Some(200) }");
/// ```
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct RawFrame {
    /// `[ROWS, COLS]` flattened, row-major, in counts.
    pub counts: [u16; TAXELS],
}

impl Default for RawFrame {
    fn default() -> Self {
        Self {
            counts: [0; TAXELS],
        }
    }
}

/// Prints the sum and the peak, because 784 numbers are unreadable in a log or a failed assertion.
impl std::fmt::Debug for RawFrame {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let sum: u32 = self.counts.iter().map(|&count| u32::from(count)).sum();
        let peak = self.counts.iter().max();
        f.debug_struct("RawFrame")
            .field("sum", &sum)
            .field("peak", &peak)
            .finish()
    }
}

/// A frame in newtons.
///
/// # Example
///
/// ```
/// use hardnessd_core::frame::{Frame, TAXELS};
///
/// let mut newtons = vec![0.0; TAXELS];
/// newtons[100..104].fill(0.5);
/// let frame = Frame::try_from(newtons)?;
/// assert_eq!(frame.contact_area_taxels(0.07), 4);
/// assert_eq!(frame.force_n(), 2.0);
///
/// assert!(Frame::try_from(vec![0.0; 100]).is_err());
/// # Ok::<(), hardnessd_core::frame::FrameError>(())
/// ```
#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Vec<f32>", into = "Vec<f32>")]
pub struct Frame {
    /// `[ROWS, COLS]` flattened, row-major, in newtons a taxel; finite and not negative.
    pub newtons: [f32; TAXELS],
}

impl Default for Frame {
    fn default() -> Self {
        Self {
            newtons: [0.0; TAXELS],
        }
    }
}

impl std::fmt::Debug for Frame {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let peak = self.newtons.iter().copied().fold(0.0, f32::max);
        f.debug_struct("Frame")
            .field("force_n", &self.force_n())
            .field("peak_n", &peak)
            .finish()
    }
}

impl From<Frame> for Vec<f32> {
    fn from(frame: Frame) -> Self {
        frame.newtons.to_vec()
    }
}

/// The reason why numbers are not a frame.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum FrameError {
    /// The force is negative or not finite.
    #[error("found {0} N at a taxel, expected 0 or more")]
    Newtons(f32),
    /// There are too many or too few taxels.
    #[error("found {0} taxels, expected {TAXELS}")]
    Length(usize),
}

impl TryFrom<Vec<f32>> for Frame {
    type Error = FrameError;

    fn try_from(newtons: Vec<f32>) -> Result<Self, FrameError> {
        if let Some(&found) = newtons.iter().find(|&&n| !n.is_finite() || n < 0.0) {
            return Err(FrameError::Newtons(found));
        }
        match newtons.try_into() {
            Ok(newtons) => Ok(Self { newtons }),
            Err(found) => Err(FrameError::Length(Vec::len(&found))),
        }
    }
}

/// Writes one value for each taxel as a list, for `#[serde(with)]`. Serde itself supports no arrays
/// of this length.
pub(crate) mod taxels {
    use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

    use super::TAXELS;

    pub(crate) fn serialize<T: Serialize, S: Serializer>(
        taxels: &[T; TAXELS],
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(taxels)
    }

    pub(crate) fn deserialize<'de, T: Deserialize<'de>, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<Box<[T; TAXELS]>, D::Error> {
        let taxels = Vec::deserialize(deserializer)?;
        let found = taxels.len();
        taxels
            .try_into()
            .map_err(|_| D::Error::invalid_length(found, &"784 taxels"))
    }
}

impl Frame {
    /// The contact area: the number of taxels at or above `threshold_n`.
    pub fn contact_area_taxels(&self, threshold_n: f32) -> u32 {
        self.newtons
            .iter()
            .map(|&n| u32::from(n >= threshold_n))
            .sum()
    }

    /// The frame with all forces times `factor`, which is finite and not negative.
    pub fn times(&self, factor: f32) -> Self {
        Self {
            newtons: self.newtons.map(|newtons| newtons * factor),
        }
    }

    /// The total force in newtons. It is summed in f64, so the order of taxels makes no difference.
    pub fn force_n(&self) -> f64 {
        self.newtons.iter().map(|&n| f64::from(n)).sum()
    }
}

/// The size of the sensor's own array. The array is centred in a frame: at offset floor((28 - n) /
/// 2).
///
/// # Example
///
/// ```
/// use hardnessd_core::frame::{Array, COLS};
///
/// let array = Array { rows: 10, cols: 12 };
/// let place = array.place(0, 0);
/// assert_eq!((place / COLS, place % COLS), (9, 8));
/// assert_eq!(array.position(place), Some((0, 0)));
/// assert_eq!(array.position(0), None);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Array {
    /// Rows of the array, 1 to [`ROWS`].
    pub rows: usize,
    /// Columns of the array, 1 to [`COLS`].
    pub cols: usize,
}

impl Array {
    /// The array that fills a frame.
    pub const FULL: Array = Array {
        rows: ROWS,
        cols: COLS,
    };

    /// The place in the frame of the array's own `row` and `col`.
    pub fn place(self, row: usize, col: usize) -> usize {
        (row + (ROWS - self.rows) / 2) * COLS + col + (COLS - self.cols) / 2
    }

    /// The array's own row and column of a place in the frame, or `None` outside the array.
    pub fn position(self, place: usize) -> Option<(usize, usize)> {
        let row = (place / COLS).checked_sub((ROWS - self.rows) / 2)?;
        let col = (place % COLS).checked_sub((COLS - self.cols) / 2)?;
        (row < self.rows && col < self.cols).then_some((row, col))
    }

    /// The places of the array, row-major.
    pub fn places(self) -> impl Iterator<Item = usize> {
        (0..self.rows * self.cols)
            .map(move |index| self.place(index / self.cols, index % self.cols))
    }
}

/// The arrival time on two clocks: one that never jumps, for durations, and the calendar, for
/// people.
///
/// # Example
///
/// Somebody sets the calendar back by an hour during a press of 1.5 s.
///
/// ```
/// use std::time::Duration;
///
/// use hardnessd_core::frame::Stamp;
///
/// let began = Stamp {
///     mono: Duration::from_secs(100),
///     wall: "2026-11-21T10:00:00Z".parse()?,
/// };
/// let ended = Stamp {
///     mono: Duration::from_millis(101_500),
///     wall: "2026-11-21T09:00:01.5Z".parse()?,
/// };
/// assert_eq!(ended.mono - began.mono, Duration::from_millis(1500));
/// assert!(ended.wall < began.wall);
/// # Ok::<(), jiff::Error>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Stamp {
    /// The time by CLOCK_MONOTONIC.
    pub mono: std::time::Duration,
    /// The time in UTC.
    pub wall: jiff::Timestamp,
}
