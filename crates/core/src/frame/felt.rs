//! What a press and a model get of a frame.
//!
//! In: a frame in newtons. Out: the frame with 0 wherever nothing is felt. After tare, noise is as
//! often negative as positive, so the sum of the taxels that are left is the force, whatever the
//! noise. A sum over the whole array would have the noise of taxels that nothing touches.

use super::{Array, Frame};

/// How many taxels around the contact belong to what is felt, to every side. A cover spreads a
/// force beyond the taxels that reach the contact threshold.
pub const MARGIN_TAXELS: usize = 2;

impl Frame {
    /// The frame as presses and models get it: the taxels in contact, at or above `threshold_n`, and
    /// the [`MARGIN_TAXELS`] around them keep their newtons, with the sign. The others are 0. The
    /// force of the contact is [`Frame::force_n`] of this frame.
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
