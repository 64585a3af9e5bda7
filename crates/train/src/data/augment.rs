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
    let symmetry = match settings.symmetries {
        true => stream.below(SYMMETRIES),
        false => 0,
    };
    let reach = isize::from(settings.shift_taxels);
    let mut shift = || stream.below(2 * settings.shift_taxels as usize + 1) as isize - reach;
    let (rows, columns) = (shift(), shift());
    moved(frame, symmetry, rows, columns)
}

/// The image of `frame` under symmetry 0..8, of which 0 is the identity, moved down by `rows` and right by
/// `columns`.
fn moved(frame: &ModelFrame, symmetry: usize, rows: isize, columns: isize) -> ModelFrame {
    const { assert!(ROWS == COLS, "a transposed frame must fit") };
    let mut image = ModelFrame::default();
    for (place, newtons) in image.newtons.iter_mut().enumerate() {
        let row = (place / COLS).checked_add_signed(-rows);
        let column = (place % COLS).checked_add_signed(-columns);
        let (Some(r @ 0..ROWS), Some(c @ 0..COLS)) = (row, column) else {
            continue;
        };
        let (r, c) = if symmetry & 4 == 0 { (r, c) } else { (c, r) };
        let r = if symmetry & 1 == 0 { r } else { ROWS - 1 - r };
        let c = if symmetry & 2 == 0 { c } else { COLS - 1 - c };
        *newtons = frame.newtons[r * COLS + c];
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
        let images: Vec<ModelFrame> = (0..SYMMETRIES).map(|s| moved(&corner(), s, 0, 0)).collect();
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
        let image = moved(&corner(), 0, 3, -2);
        assert_eq!(image.newtons[4 * COLS], 1.0);
        assert_eq!(image.force_n(), 1.0);
        assert_eq!(moved(&corner(), 0, 0, -3).force_n(), 0.0);
    }
}
