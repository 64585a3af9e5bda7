//! The cells of a frame: how a number on the wire becomes a taxel's count, and where its taxel is.

use super::settings::Order;
use crate::frame::{Array, RawFrame};

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Cells {
    pub(super) array: Array,
    pub(super) mask: u16,
    pub(super) invert: bool,
    /// The largest number that a cell can hold.
    pub(super) largest: u16,
    /// The place in the frame for each position on the wire.
    places: Vec<u16>,
}

impl Cells {
    pub(super) fn new(array: Array, order: Order, mask: u16, invert: bool, largest: u16) -> Self {
        Self {
            array,
            mask,
            invert,
            largest,
            places: places(array, order),
        }
    }

    /// The number of cells.
    pub(super) fn count(&self) -> usize {
        self.places.len()
    }

    /// The frame of all cells of all `parts`, which are in the order of the wire.
    pub(super) fn frame<P>(&self, parts: impl IntoIterator<Item = P>) -> RawFrame
    where
        P: IntoIterator<Item = u16>,
    {
        let mut frame = RawFrame::zero(self.array);
        let mut places = self.places.iter();
        for part in parts {
            for (cell, &place) in part.into_iter().zip(&mut places) {
                let masked = cell & self.mask;
                frame.counts[usize::from(place)] = if self.invert {
                    self.mask - masked
                } else {
                    masked
                };
            }
        }
        frame
    }

    /// The cells of `frame` in the order of the wire.
    pub(super) fn of(&self, frame: &RawFrame) -> impl Iterator<Item = u16> {
        self.places.iter().map(|&place| {
            let count = frame.counts[usize::from(place)].min(self.mask);
            let cell = if self.invert {
                self.mask - count
            } else {
                count
            };
            cell.min(self.largest)
        })
    }
}

fn places(array: Array, order: Order) -> Vec<u16> {
    let Array { rows, cols } = array;
    (0..rows * cols)
        .map(|index| {
            let (row, col) = match order {
                Order::RowMajor => (index / cols, index % cols),
                Order::ColumnMajor => (index % rows, index / rows),
                Order::Serpentine if (index / cols).is_multiple_of(2) => {
                    (index / cols, index % cols)
                }
                Order::Serpentine => (index / cols, cols - 1 - index % cols),
            };
            u16::try_from(array.place(row, col)).expect("a frame has at most 4096 places")
        })
        .collect()
}
