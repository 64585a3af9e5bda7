//! The ways in which a board may write its taxels.
//!
//! In: bytes. Out: numbers. A type of cells is one entry of [`TYPES`].

use hardnessd_core::wire::Cell;

/// How a number is written.
#[derive(Debug)]
pub(crate) struct Type {
    /// What it is called in a message.
    pub(crate) words: &'static str,
    pub(crate) bytes: usize,
    /// The number in as many bytes. What no sensor sends is not a number.
    pub(crate) read: fn(&[u8]) -> f32,
    pub(crate) is_float: bool,
    /// Whether it differs from the entry before it only for numbers below 0.
    pub(crate) is_signed: bool,
    /// How many bits it takes to say that a board has it: the rarer, the more.
    pub(crate) name_bits: f64,
    /// The daemon's name.
    pub(crate) cell: Cell,
}

const U8: Type = Type {
    words: "bytes",
    bytes: 1,
    read: |b| b[0].into(),
    is_float: false,
    is_signed: false,
    name_bits: 1.0,
    cell: Cell::U8,
};

/// All types. One that is signed follows the one that is not.
pub(crate) const TYPES: [Type; 10] = [
    U8,
    Type {
        words: "signed bytes",
        read: |b| (b[0] as i8).into(),
        is_signed: true,
        name_bits: 7.0,
        cell: Cell::I8,
        ..U8
    },
    Type {
        words: "16-bit numbers, low byte first",
        bytes: 2,
        read: |b| u16::from_le_bytes([b[0], b[1]]).into(),
        cell: Cell::U16le,
        ..U8
    },
    Type {
        words: "signed 16-bit numbers, low byte first",
        bytes: 2,
        read: |b| i16::from_le_bytes([b[0], b[1]]).into(),
        is_signed: true,
        name_bits: 7.0,
        cell: Cell::I16le,
        ..U8
    },
    Type {
        words: "16-bit numbers, high byte first",
        bytes: 2,
        read: |b| u16::from_be_bytes([b[0], b[1]]).into(),
        cell: Cell::U16be,
        ..U8
    },
    Type {
        words: "signed 16-bit numbers, high byte first",
        bytes: 2,
        read: |b| i16::from_be_bytes([b[0], b[1]]).into(),
        is_signed: true,
        name_bits: 7.0,
        cell: Cell::I16be,
        ..U8
    },
    Type {
        words: "32-bit numbers, low byte first",
        bytes: 4,
        read: |b| whole(i32::from_le_bytes([b[0], b[1], b[2], b[3]])),
        name_bits: 4.0,
        cell: Cell::I32le,
        ..U8
    },
    Type {
        words: "32-bit numbers, high byte first",
        bytes: 4,
        read: |b| whole(i32::from_be_bytes([b[0], b[1], b[2], b[3]])),
        name_bits: 4.0,
        cell: Cell::I32be,
        ..U8
    },
    Type {
        words: "32-bit floats, low byte first",
        bytes: 4,
        read: |b| real(f32::from_le_bytes([b[0], b[1], b[2], b[3]])),
        is_float: true,
        name_bits: 4.0,
        cell: Cell::F32le,
        ..U8
    },
    Type {
        words: "32-bit floats, high byte first",
        bytes: 4,
        read: |b| real(f32::from_be_bytes([b[0], b[1], b[2], b[3]])),
        is_float: true,
        name_bits: 4.0,
        cell: Cell::F32be,
        ..U8
    },
];

/// Converters of taxels have at most 24 bits, and so many an f32 holds too.
fn whole(number: i32) -> f32 {
    if number.unsigned_abs() < 1 << 24 {
        number as f32
    } else {
        f32::NAN
    }
}

/// Newtons, volts, counts and their like are neither much smaller nor much larger.
fn real(number: f32) -> f32 {
    if number == 0.0 || (1e-9..1e9).contains(&number.abs()) {
        number
    } else {
        f32::NAN
    }
}
