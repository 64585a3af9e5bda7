//! Augmentation that keeps the physics: the 8 symmetries of the square and integer shifts.
//!
//! There is no zoom, no shear, no intensity jitter and no normalisation by a frame's own maximum,
//! because hardness shows in the contact's width and force.

use crate::settings::Augmentation;
use hardnessd_core::verdict::{COLS, ModelFrame, ROWS};
use hardnessd_simulator::random::Stream;

/// Symmetries of the square: mirror rows, mirror columns, transpose.
const SYMMETRIES: usize = 8;

/// Draws one variant of `frame`.
pub fn vary(frame: &ModelFrame, settings: Augmentation, stream: &mut Stream) -> ModelFrame {
    let symmetry = if settings.symmetries {
        stream.below(SYMMETRIES)
    } else {
        0
    };
    let reach = isize::from(settings.shift_taxels);
    let mut shift = || stream.below(2 * settings.shift_taxels as usize + 1) as isize - reach;
    let (rows, columns) = (shift(), shift());
    shifted(&turned(frame, symmetry), rows, columns)
}

/// The image of `frame` under symmetry 0..8; 0 is the identity.
fn turned(frame: &ModelFrame, symmetry: usize) -> ModelFrame {
    const { assert!(ROWS == COLS, "a transposed frame must fit") };
    let mut image = ModelFrame::default();
    for row in 0..ROWS {
        for column in 0..COLS {
            let (r, c) = if symmetry & 4 == 0 {
                (row, column)
            } else {
                (column, row)
            };
            let r = if symmetry & 1 == 0 { r } else { ROWS - 1 - r };
            let c = if symmetry & 2 == 0 { c } else { COLS - 1 - c };
            image.newtons[row * COLS + column] = frame.newtons[r * COLS + c];
        }
    }
    image
}

/// `frame` moved down by `rows` and right by `columns`.
fn shifted(frame: &ModelFrame, rows: isize, columns: isize) -> ModelFrame {
    let mut image = ModelFrame::default();
    for row in 0..ROWS {
        for column in 0..COLS {
            let from = (
                row.checked_add_signed(-rows),
                column.checked_add_signed(-columns),
            );
            if let (Some(r @ 0..ROWS), Some(c @ 0..COLS)) = from {
                image.newtons[row * COLS + column] = frame.newtons[r * COLS + c];
            }
        }
    }
    image
}

#[cfg(test)]
mod tests {
    use super::*;

    fn corner() -> ModelFrame {
        let mut frame = ModelFrame::default();
        frame.newtons[COLS + 2] = 1.0; // row 1, column 2
        frame
    }

    #[test]
    fn the_symmetries_are_eight_different_ones_that_keep_force_and_area() {
        let images: Vec<ModelFrame> = (0..SYMMETRIES).map(|s| turned(&corner(), s)).collect();
        assert_eq!(images[0], corner());
        for (index, image) in images.iter().enumerate() {
            assert_eq!(image.force_n(), 1.0);
            assert!(
                images[..index].iter().all(|earlier| earlier != image),
                "symmetry {index}"
            );
        }
    }

    #[test]
    fn a_shift_brings_in_background_and_loses_what_leaves() {
        let moved = shifted(&corner(), 3, -2);
        assert_eq!(moved.newtons[4 * COLS], 1.0);
        assert_eq!(moved.force_n(), 1.0);
        assert_eq!(shifted(&corner(), 0, -3).force_n(), 0.0);
    }
}
