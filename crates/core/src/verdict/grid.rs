//! The model's own grid, and how frames of other arrays are resampled onto it.
//!
//! In: what is felt of the [`Frame`]s of a press, in the sensor's grid. Out: [`ModelFrame`]s, in the
//! model's. Each taxel's force is shared out over the model's taxels by area, so the force stays the same.

use crate::frame::{self, Array, Frame, Pitch};

/// Rows of the model's input (paper, "Tactile sensor").
pub const ROWS: usize = 28;
/// Columns of the model's input.
pub const COLS: usize = 28;
/// Taxels in the model's input.
pub const TAXELS: usize = ROWS * COLS;

/// Two distances that differ by less than this share are the same.
const SAME_PITCH: f64 = 0.02;

/// A frame in newtons, on the model's grid.
///
/// # Example
///
/// ```
/// use hardnessd_core::verdict::ModelFrame;
///
/// let mut frame = ModelFrame::default();
/// frame.newtons[100..104].fill(0.5);
/// assert_eq!(frame.contact_area_taxels(0.07), 4);
/// assert_eq!(frame.force_n(), 2.0);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ModelFrame {
    /// `[ROWS, COLS]` flattened, row-major, in newtons a taxel; finite. Noise around a contact makes
    /// some of them negative.
    pub newtons: [f32; TAXELS],
}

impl Default for ModelFrame {
    fn default() -> Self {
        Self {
            newtons: [0.0; TAXELS],
        }
    }
}

impl ModelFrame {
    /// The contact area: the number of taxels at or above `threshold_n`.
    pub fn contact_area_taxels(&self, threshold_n: f32) -> u32 {
        frame::contact_area_taxels(&self.newtons, threshold_n)
    }

    /// The total force in newtons. It is summed in f64, so the order of taxels makes no difference.
    pub fn force_n(&self) -> f64 {
        frame::force_n(&self.newtons)
    }

    /// The newtons as the graph of a model gets them: none is below 0, so that a logarithm in the
    /// graph is finite.
    pub(super) fn pressed(&self) -> impl Iterator<Item = f32> {
        self.newtons.iter().map(|newtons| newtons.max(0.0))
    }
}

/// How the frames of one press are resampled onto the model's grid.
///
/// An array that is no longer than the grid lies in its middle, along each side. Of a longer array,
/// the grid covers the part around the contact. Between grids of the same pitch taxels move as they
/// are; otherwise each model taxel gets the share of a taxel's force by which it covers its area.
///
/// # Example
///
/// Four taxels of 1.75 mm are one of 3.5 mm.
///
/// ```
/// use hardnessd_core::frame::{Array, Frame, Pitch};
/// use hardnessd_core::verdict::Resampling;
///
/// let mut fine = Frame::zero(Array { rows: 56, cols: 56 });
/// for (row, col) in [(20, 30), (20, 31), (21, 30), (21, 31)] {
///     fine.newtons[fine.array.place(row, col)] = 0.5;
/// }
/// let resampling = Resampling::new(&fine, Pitch::square(1.75), 3.5);
/// let resampled = resampling.apply(&fine);
/// assert_eq!(resampled.newtons[10 * 28 + 15], 2.0);
/// assert_eq!(resampled.force_n(), 2.0);
/// ```
#[derive(Debug, Clone)]
pub struct Resampling {
    /// For each row of the array, the model's rows that it covers, and the share on each; likewise the columns.
    rows: Vec<Vec<(usize, f32)>>,
    cols: Vec<Vec<(usize, f32)>>,
    /// Whether taxels of another pitch are shared out.
    pub is_resampled: bool,
}

impl Resampling {
    /// The resampling of a press whose best frame is `best`, of taxels `pitch` apart, onto a grid of
    /// taxels `model_mm` apart.
    pub fn new(best: &Frame, pitch: Pitch, model_mm: f64) -> Self {
        let Array { rows, cols } = best.array;
        let (row, col) = best.centre();
        // Taxels of the same pitch move as they are.
        let [height, width] = [pitch.rows_mm, pitch.cols_mm].map(|mm| match mm / model_mm {
            length if (length - 1.0).abs() <= SAME_PITCH => 1.0,
            length => length,
        });
        Self {
            rows: shares(rows, height, ROWS, row),
            cols: shares(cols, width, COLS, col),
            is_resampled: (height, width) != (1.0, 1.0),
        }
    }

    /// The frame on the model's grid.
    pub fn apply(&self, frame: &Frame) -> ModelFrame {
        let mut resampled = ModelFrame::default();
        for (row, newtons) in frame.newtons.chunks_exact(frame.array.cols).enumerate() {
            for &(model_row, row_share) in &self.rows[row] {
                for (col, &newtons) in newtons.iter().enumerate() {
                    if newtons == 0.0 {
                        continue;
                    }
                    for &(model_col, col_share) in &self.cols[col] {
                        resampled.newtons[model_row * COLS + model_col] +=
                            newtons * row_share * col_share;
                    }
                }
            }
        }
        resampled
    }
}

/// How a side of `count` taxels, each as long as `length` model taxels, lies on a side of `grid` model
/// taxels. The contact's centre is at taxel `centre`.
fn shares(count: usize, length: f64, grid: usize, centre: f64) -> Vec<Vec<(usize, f32)>> {
    let whole = count as f64 * length;
    // The place of the array's border on the grid, negative if the array begins before it. It
    // is a whole number, so that taxels half or a third as long share no border.
    let free = grid as f64 - whole;
    let first = if free >= 0.0 {
        (free / 2.0).floor()
    } else {
        let around = (grid as f64 / 2.0 - (centre + 0.5) * length).round();
        around.clamp(free.floor(), 0.0)
    };
    let shares = |taxel: usize| {
        let from = first + taxel as f64 * length;
        let to = from + length;
        let first_cell = from.floor().max(0.0) as usize;
        let cells = first_cell..(to.ceil().max(0.0) as usize).min(grid);
        let share = |cell: usize| {
            let covered = to.min(cell as f64 + 1.0) - from.max(cell as f64);
            (cell, (covered / length) as f32)
        };
        // What is left of a border after rounding is no share.
        cells.map(share).filter(|&(_, s)| s > 1e-6).collect()
    };
    (0..count).map(shares).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A frame with one square contact.
    fn touched(array: Array, row: usize, col: usize, side: usize) -> Frame {
        let mut frame = Frame::zero(array);
        for r in row..(row + side).min(array.rows) {
            for c in col..(col + side).min(array.cols) {
                frame.newtons[array.place(r, c)] = 0.25;
            }
        }
        frame
    }

    #[test]
    fn a_small_array_lies_in_the_middle_and_a_large_one_around_the_contact() {
        let small = touched(Array { rows: 10, cols: 13 }, 0, 0, 1);
        let resampled = Resampling::new(&small, Pitch::JX255N, 3.5).apply(&small);
        assert_eq!(resampled.newtons[9 * COLS + 7], 0.25);

        // The middle of the contact is at row 42, column 60.5, too near the end to be in the middle.
        let large = touched(Array { rows: 64, cols: 64 }, 40, 59, 4);
        let resampled = Resampling::new(&large, Pitch::JX255N, 3.5).apply(&large);
        assert_eq!(resampled.force_n(), large.force_n());
        assert_eq!(resampled.newtons[12 * COLS + 59 - 36], 0.25);
        assert_eq!(resampled.newtons[12 * COLS + 59 - 37], 0.0);
    }

    proptest! {
        #[test]
        fn the_force_stays_the_same_whatever_the_pitch(
            rows in 1_usize..=64,
            cols in 1_usize..=64,
            row_share in 0.0..1.0_f64,
            col_share in 0.0..1.0_f64,
            mm in [1.0..12.0_f64, 1.0..12.0_f64],
        ) {
            let array = Array { rows, cols };
            let row = (row_share * rows as f64) as usize;
            let col = (col_share * cols as f64) as usize;
            let frame = touched(array, row, col, 2);
            let pitch = Pitch { rows_mm: mm[0], cols_mm: mm[1] };
            let resampling = Resampling::new(&frame, pitch, 3.5);
            let resampled = resampling.apply(&frame);
            prop_assert!((resampled.force_n() / frame.force_n() - 1.0).abs() < 1e-5);
        }
    }
}
