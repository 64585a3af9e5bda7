//! One instant of the sensor: the taxels of its array, row-major.
//!
//! A [`RawFrame`] is in counts, as the sensor sent them. A [`Frame`] is in newtons, after tare and
//! with dead taxels replaced. Only `tare` makes a [`Frame`] from a [`RawFrame`], so raw counts
//! cannot reach the press tracker.

pub mod sparse;

use std::time::Duration;

use serde::{Deserialize, Serialize};

/// The most rows, and the most columns, of an array.
pub const MOST_SIDE: usize = 64;

/// The size of a sensor's array.
///
/// # Example
///
/// ```
/// use hardnessd_core::frame::Array;
///
/// let array = Array { rows: 10, cols: 12 };
/// let place = array.place(1, 2);
/// assert_eq!(place, 14);
/// assert_eq!(array.position(place), (1, 2));
/// assert_eq!(array.taxels(), 120);
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Array {
    /// Rows of the array, 1 to [`MOST_SIDE`].
    pub rows: usize,
    /// Columns of the array, 1 to [`MOST_SIDE`].
    pub cols: usize,
}

impl Array {
    /// The array of the JX255N (paper, "Tactile sensor").
    pub const JX255N: Array = Array { rows: 28, cols: 28 };

    /// The number of taxels.
    pub const fn taxels(self) -> usize {
        self.rows * self.cols
    }

    /// The place in a frame of `row` and `col`.
    pub fn place(self, row: usize, col: usize) -> usize {
        row * self.cols + col
    }

    /// The row and the column of a place in a frame.
    pub fn position(self, place: usize) -> (usize, usize) {
        (place / self.cols, place % self.cols)
    }
}

/// The distances between the centres of neighbouring taxels, in mm: from row to row, and from
/// column to column. A configuration gives one number if both are equal.
///
/// # Example
///
/// ```
/// use hardnessd_core::frame::Pitch;
///
/// let pitch: Pitch = serde_json::from_str("[7.0, 3.5]")?;
/// assert_eq!(pitch.area_mm2(), 24.5);
/// assert_eq!(serde_json::to_string(&Pitch::square(3.5))?, "3.5");
/// # Ok::<(), serde_json::Error>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(into = "Written", from = "Written")]
pub struct Pitch {
    /// The distance from row to row.
    pub rows_mm: f64,
    /// The distance from column to column.
    pub cols_mm: f64,
}

/// A pitch as it is written.
#[derive(Serialize, Deserialize)]
#[serde(untagged, expecting = "expected a number, or [rows, columns]")]
enum Written {
    Square(f64),
    Both([f64; 2]),
}

impl From<Pitch> for Written {
    fn from(Pitch { rows_mm, cols_mm }: Pitch) -> Self {
        if rows_mm == cols_mm {
            Self::Square(rows_mm)
        } else {
            Self::Both([rows_mm, cols_mm])
        }
    }
}

impl From<Written> for Pitch {
    fn from(written: Written) -> Self {
        match written {
            Written::Square(mm) => Self::square(mm),
            Written::Both([rows_mm, cols_mm]) => Self { rows_mm, cols_mm },
        }
    }
}

impl std::fmt::Display for Pitch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { rows_mm, cols_mm } = self;
        if rows_mm == cols_mm {
            write!(f, "{rows_mm:?}")
        } else {
            write!(f, "[{rows_mm:?}, {cols_mm:?}]")
        }
    }
}

impl Pitch {
    /// The pitch of the JX255N (paper, "Tactile sensor").
    pub const JX255N: Pitch = Pitch::square(3.5);

    /// The same distance both ways.
    pub const fn square(mm: f64) -> Self {
        Self {
            rows_mm: mm,
            cols_mm: mm,
        }
    }

    /// The area of a taxel with its share of the gaps.
    pub fn area_mm2(self) -> f64 {
        self.rows_mm * self.cols_mm
    }

    /// A taxel is in contact at or above this force, unless the settings give another. The
    /// threshold means a pressure, so it grows with the area of a taxel.
    pub fn contact_threshold_n(self) -> f32 {
        (0.07 * self.area_mm2() / Self::JX255N.area_mm2()) as f32
    }
}

/// A frame in sensor counts.
///
/// # Example
///
/// ```
/// use hardnessd_core::frame::{Array, RawFrame};
///
/// let array = Array { rows: 10, cols: 12 };
/// let mut raw = RawFrame::zero(array);
/// raw.counts[array.place(1, 0)] = 200.0;
/// assert_eq!(raw.counts[12], 200.0);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct RawFrame {
    /// The size of the array.
    pub array: Array,
    /// A count for each taxel, row-major: a finite number, which a sensor may write as a whole number,
    /// with a sign, or as a float.
    pub counts: Box<[f32]>,
}

impl RawFrame {
    /// A frame of zeros.
    pub fn zero(array: Array) -> Self {
        Self {
            array,
            counts: vec![0.0; array.taxels()].into(),
        }
    }
}

impl Default for RawFrame {
    /// A frame of zeros of the JX255N.
    fn default() -> Self {
        Self::zero(Array::JX255N)
    }
}

impl std::fmt::Display for Array {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}x{}", self.rows, self.cols)
    }
}

/// A frame in newtons.
///
/// # Example
///
/// ```
/// use hardnessd_core::frame::{Array, Frame};
///
/// let mut frame = Frame::zero(Array { rows: 12, cols: 32 });
/// frame.newtons[100..104].fill(0.5);
/// assert_eq!(frame.contact_area_taxels(0.07), 4);
/// assert_eq!(frame.force_n(), 2.0);
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// The size of the array.
    pub array: Array,
    /// The force on each taxel, row-major, in newtons; finite. Noise makes some of an unloaded
    /// sensor's taxels negative.
    pub newtons: Box<[f32]>,
}

impl Default for Frame {
    /// A frame of zeros of the JX255N.
    fn default() -> Self {
        Self::zero(Array::JX255N)
    }
}

/// How many taxels around the contact belong to what is felt, to every side. A cover spreads a
/// force beyond the taxels that reach the contact threshold.
pub const MARGIN_TAXELS: usize = 2;

impl Frame {
    /// A frame without contact.
    pub fn zero(array: Array) -> Self {
        Self {
            array,
            newtons: vec![0.0; array.taxels()].into(),
        }
    }

    /// The contact area: the number of taxels at or above `threshold_n`.
    pub fn contact_area_taxels(&self, threshold_n: f32) -> u32 {
        contact_area_taxels(&self.newtons, threshold_n)
    }

    /// The sum of all taxels in newtons. It is summed in f64, so the order of taxels makes no
    /// difference. The force of a contact is that of [`Frame::felt`].
    pub fn force_n(&self) -> f64 {
        force_n(&self.newtons)
    }

    /// The centre of the force, as a row and a column. The middle of the array if there is no force.
    pub fn centre(&self) -> (f64, f64) {
        let force_n = self.force_n();
        let Array { rows, cols } = self.array;
        let last = [(rows - 1) as f64, (cols - 1) as f64];
        if force_n <= 0.0 {
            return (last[0] / 2.0, last[1] / 2.0);
        }
        let (mut row_sum, mut col_sum) = (0.0, 0.0);
        for (place, &newtons) in self.newtons.iter().enumerate() {
            let (row, col) = self.array.position(place);
            row_sum += f64::from(newtons) * row as f64;
            col_sum += f64::from(newtons) * col as f64;
        }
        // Negative forces may pull the sums beyond the array.
        let within = |sum: f64, last: f64| (sum / force_n).clamp(0.0, last);
        (within(row_sum, last[0]), within(col_sum, last[1]))
    }

    /// The frame as presses and models get it: the taxels in contact, at or above `threshold_n`, and
    /// the [`MARGIN_TAXELS`] around them keep their newtons, with the sign. The others are 0. The
    /// force of the contact is [`Frame::force_n`] of this frame: after tare, noise is as often negative as positive,
    /// so the sum of the taxels that are left is the force, whatever the noise.
    ///
    /// # Example
    ///
    /// ```
    /// use hardnessd_core::frame::{Array, Frame};
    ///
    /// let array = Array { rows: 12, cols: 32 };
    /// let mut frame = Frame::zero(array);
    /// frame.newtons.fill(-0.01);
    /// frame.newtons[array.place(5, 9)] = 1.0;
    /// let felt = frame.felt(0.07);
    /// assert_eq!(felt.newtons[array.place(7, 11)], -0.01);
    /// assert_eq!(felt.newtons[array.place(8, 9)], 0.0);
    /// assert!((felt.force_n() - (1.0 - 24.0 * 0.01)).abs() < 1e-6);
    /// ```
    pub fn felt(&self, threshold_n: f32) -> Frame {
        let Array { rows, cols } = self.array;
        let mut felt = Self::zero(self.array);
        for (row, newtons) in self.newtons.chunks_exact(cols).enumerate() {
            let contact = newtons
                .iter()
                .enumerate()
                .filter(|(_, n)| **n >= threshold_n);
            let mut done = 0;
            for (col, _) in contact {
                // Neighbours in contact share most of their margin: copy each taxel once.
                let first = col.saturating_sub(MARGIN_TAXELS).max(done);
                done = (col + MARGIN_TAXELS + 1).min(cols);
                for near in row.saturating_sub(MARGIN_TAXELS)..(row + MARGIN_TAXELS + 1).min(rows) {
                    let taxels = near * cols + first..near * cols + done;
                    felt.newtons[taxels.clone()].copy_from_slice(&self.newtons[taxels]);
                }
            }
        }
        felt
    }
}

/// The number of taxels at or above `threshold_n`.
pub(crate) fn contact_area_taxels(newtons: &[f32], threshold_n: f32) -> u32 {
    newtons.iter().map(|&n| u32::from(n >= threshold_n)).sum()
}

/// The sum of forces, in f64.
pub(crate) fn force_n(newtons: &[f32]) -> f64 {
    newtons.iter().map(|&n| f64::from(n)).sum()
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
    pub mono: Duration,
    /// The time in UTC.
    pub wall: jiff::Timestamp,
}

impl Stamp {
    /// The moment before the first frame of bytes without times.
    pub const EPOCH: Self = Self {
        mono: Duration::ZERO,
        wall: jiff::Timestamp::UNIX_EPOCH,
    };

    /// The time by CLOCK_MONOTONIC of an event at `time`, if UTC was not set between both.
    pub fn mono_of(self, time: jiff::Timestamp) -> Duration {
        let ago = self.wall.as_nanosecond() - time.as_nanosecond();
        let mono = self.mono.as_nanos() as i128 - ago;
        Duration::from_nanos(u64::try_from(mono).unwrap_or(0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The definition, taxel by taxel.
    fn expected(frame: &Frame, threshold_n: f32) -> Frame {
        let mut felt = Frame::zero(frame.array);
        let contact = |place: &usize| frame.newtons[*place] >= threshold_n;
        let contact: Vec<_> = (0..frame.array.taxels())
            .filter(contact)
            .map(|place| frame.array.position(place))
            .collect();
        for place in 0..frame.array.taxels() {
            let (row, col) = frame.array.position(place);
            let is_near =
                |&(r, c): &(usize, usize)| r.abs_diff(row).max(c.abs_diff(col)) <= MARGIN_TAXELS;
            if contact.iter().any(is_near) {
                felt.newtons[place] = frame.newtons[place];
            }
        }
        felt
    }

    #[test]
    fn what_is_felt_is_the_contact_and_its_margin() {
        for (rows, cols) in [(1, 1), (1, 7), (7, 1), (3, 4), (28, 28), (16, 32)] {
            for step in [1, 2, 3, 7, 29, 64, 500] {
                let mut frame = Frame::zero(Array { rows, cols });
                for (place, newtons) in frame.newtons.iter_mut().enumerate() {
                    let noise = [-0.02, 0.03, -0.01, 0.06][place % 4];
                    *newtons = if place % step == step / 2 {
                        0.07
                    } else {
                        noise
                    };
                }
                assert_eq!(
                    frame.felt(0.07),
                    expected(&frame, 0.07),
                    "{rows}x{cols} {step}"
                );
            }
        }
    }
}
