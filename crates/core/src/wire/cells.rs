//! The cells of a frame: how a number on the wire becomes a taxel's count, and where its taxel is.

use super::settings::{Cell, Order};
use crate::frame::{Array, RawFrame};

/// The largest count, without its sign: as large as a whole number of 32 bits. A float beyond it is
/// damage.
const MOST_COUNT: f32 = 4_294_967_296.0;

/// The largest number of which every bit is there. Above it, a mask would take bits that were rounded.
pub(super) const MOST_EXACT: u32 = 0xFF_FFFF;

impl Cell {
    /// The number of bytes that the cell takes on the wire.
    pub fn bytes(self) -> usize {
        match self {
            Cell::I8 | Cell::U8 => 1,
            Cell::I16le | Cell::I16be | Cell::U16le | Cell::U16be => 2,
            Cell::I32le | Cell::I32be | Cell::F32le | Cell::F32be => 4,
        }
    }

    /// The least and the largest number that the cell can hold, of whole numbers.
    pub(super) fn range(self) -> Option<(f32, f32)> {
        match self {
            Cell::I8 => Some((i8::MIN.into(), i8::MAX.into())),
            Cell::U8 => Some((0.0, u8::MAX.into())),
            Cell::I16le | Cell::I16be => Some((i16::MIN.into(), i16::MAX.into())),
            Cell::U16le | Cell::U16be => Some((0.0, u16::MAX.into())),
            // Converters of taxels have at most 24 bits, so these numbers are exact.
            Cell::I32le | Cell::I32be => Some((i32::MIN as f32, i32::MAX as f32)),
            Cell::F32le | Cell::F32be => None,
        }
    }

    /// The bits that may carry the count, of whole numbers without a sign.
    pub(super) fn bits(self) -> Option<u32> {
        self.range()
            .filter(|&(least, _)| least == 0.0)
            .map(|(_, most)| most as u32)
    }

    /// The number in the first bytes of `b`.
    pub fn read(self, b: &[u8]) -> f32 {
        match self {
            Cell::I8 => f32::from(b[0].cast_signed()),
            Cell::U8 => f32::from(b[0]),
            Cell::I16le => f32::from(i16::from_le_bytes([b[0], b[1]])),
            Cell::I16be => f32::from(i16::from_be_bytes([b[0], b[1]])),
            Cell::U16le => f32::from(u16::from_le_bytes([b[0], b[1]])),
            Cell::U16be => f32::from(u16::from_be_bytes([b[0], b[1]])),
            Cell::I32le => i32::from_le_bytes([b[0], b[1], b[2], b[3]]) as f32,
            Cell::I32be => i32::from_be_bytes([b[0], b[1], b[2], b[3]]) as f32,
            Cell::F32le => f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
            Cell::F32be => f32::from_be_bytes([b[0], b[1], b[2], b[3]]),
        }
    }

    /// Writes the number to the first bytes of `b`. One beyond the range of the cell becomes the end of
    /// the range.
    pub(super) fn write(self, number: f32, b: &mut [u8]) {
        let whole = number.round();
        match self {
            Cell::I8 => b[0] = (whole as i8).cast_unsigned(),
            Cell::U8 => b[0] = whole as u8,
            Cell::I16le => b[..2].copy_from_slice(&(whole as i16).to_le_bytes()),
            Cell::I16be => b[..2].copy_from_slice(&(whole as i16).to_be_bytes()),
            Cell::U16le => b[..2].copy_from_slice(&(whole as u16).to_le_bytes()),
            Cell::U16be => b[..2].copy_from_slice(&(whole as u16).to_be_bytes()),
            Cell::I32le => b[..4].copy_from_slice(&(whole as i32).to_le_bytes()),
            Cell::I32be => b[..4].copy_from_slice(&(whole as i32).to_be_bytes()),
            Cell::F32le => b[..4].copy_from_slice(&number.to_le_bytes()),
            Cell::F32be => b[..4].copy_from_slice(&number.to_be_bytes()),
        }
    }
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Cells {
    pub(super) array: Array,
    /// The bits that carry the count, if not all do or the count is the mask minus the cell.
    pub(super) mask: Option<u32>,
    invert: bool,
    /// The place in the frame for each position on the wire.
    places: Vec<u16>,
}

impl Cells {
    pub(super) fn new(array: Array, order: Order, mask: Option<u32>, invert: bool) -> Self {
        Self {
            array,
            mask,
            invert,
            places: places(array, order),
        }
    }

    /// The number of cells.
    pub(super) fn count(&self) -> usize {
        self.places.len()
    }

    /// The frame of all cells, which are in the order of the wire. `None` if one of them is no number
    /// that a taxel has.
    pub(super) fn frame(&self, cells: impl IntoIterator<Item = f32>) -> Option<RawFrame> {
        let mut frame = RawFrame::zero(self.array);
        for (cell, &place) in cells.into_iter().zip(&self.places) {
            frame.counts[usize::from(place)] = self.of_cell(cell)?;
        }
        Some(frame)
    }

    fn of_cell(&self, cell: f32) -> Option<f32> {
        let Some(mask) = self.mask else {
            let is_count = cell.abs() <= MOST_COUNT;
            return is_count.then_some(if self.invert { 0.0 - cell } else { cell });
        };
        let is_whole = cell.fract() == 0.0 && (0.0..=MOST_EXACT as f32).contains(&cell);
        let masked = is_whole.then_some(cell as u32 & mask)?;
        Some(if self.invert { mask - masked } else { masked } as f32)
    }

    /// The cells of `frame` in the order of the wire.
    pub(super) fn of(&self, frame: &RawFrame) -> impl Iterator<Item = f32> {
        self.places.iter().map(|&place| {
            let count = frame.counts[usize::from(place)];
            match self.mask {
                Some(mask) => {
                    let count = (count.round() as u32).min(mask);
                    (if self.invert { mask - count } else { count }) as f32
                }
                None if self.invert => 0.0 - count,
                None => count,
            }
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
