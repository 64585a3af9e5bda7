//! The ways in which a board may write its taxels.
//!
//! In: bytes. Out: numbers.

use hardnessd_core::wire::Cell;

/// All types of cells. One that is signed follows the one that is not.
pub(crate) const CELLS: [Cell; 10] = [
    Cell::U8,
    Cell::I8,
    Cell::U16le,
    Cell::I16le,
    Cell::U16be,
    Cell::I16be,
    Cell::I32le,
    Cell::I32be,
    Cell::F32le,
    Cell::F32be,
];

/// The numbers in some bytes. What no sensor sends is not a number.
pub(crate) fn numbers(cell: Cell, bytes: &[u8]) -> Vec<f32> {
    let bytes = bytes.chunks_exact(cell.bytes());
    bytes.map(|bytes| number(cell, bytes)).collect()
}

/// The number in as many bytes as a cell has.
pub(crate) fn number(cell: Cell, bytes: &[u8]) -> f32 {
    let number = cell.read(bytes);
    let is_sent = match cell {
        // Converters of taxels have at most 24 bits, and so many an f32 holds too.
        Cell::I32le | Cell::I32be => number.abs() < (1 << 24) as f32,
        // Newtons, volts, counts and their like are neither much smaller nor much larger.
        Cell::F32le | Cell::F32be => number == 0.0 || (1e-9..1e9).contains(&number.abs()),
        _ => true,
    };
    if is_sent { number } else { f32::NAN }
}

pub(crate) fn is_float(cell: Cell) -> bool {
    matches!(cell, Cell::F32le | Cell::F32be)
}

/// Whether it differs from the type before it only for numbers below 0.
pub(crate) fn is_signed(cell: Cell) -> bool {
    matches!(cell, Cell::I8 | Cell::I16le | Cell::I16be)
}

/// The type of as many bytes with a sign.
pub(crate) fn signed(cell: Cell) -> Option<Cell> {
    match cell {
        Cell::U8 | Cell::I8 => Some(Cell::I8),
        Cell::U16le | Cell::I16le => Some(Cell::I16le),
        Cell::U16be | Cell::I16be => Some(Cell::I16be),
        _ => None,
    }
}

/// How many bits it takes to say that a board has it: the rarer, the more.
pub(crate) fn name_bits(cell: Cell) -> f64 {
    match cell {
        Cell::U8 | Cell::U16le | Cell::U16be => 1.0,
        Cell::I8 | Cell::I16le | Cell::I16be => 7.0,
        Cell::I32le | Cell::I32be | Cell::F32le | Cell::F32be => 4.0,
    }
}
