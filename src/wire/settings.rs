//! The `[sensor.frame]` table, and the ways in which it can be wrong.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::checksum::Checksum;

/// Ready-made layouts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// `BB AA`, payload length u16 LE, cells u8, CRC-16/Modbus.
    #[default]
    Jx255n,
    /// The same with u16 LE cells.
    Jx255nU16,
    /// `AA 55 03 99`, cells u8.
    Jq,
    /// Cells u8, `AA 55 03 99`.
    JqTail,
    /// Cells u16 LE, `AA 00 55 00 03 00 99 00`.
    JqU16,
    /// Cells 0..254, `FF`.
    FfTail,
    /// Rows of decimals; a blank line ends the frame.
    Ascii,
    /// 1..254 a value, `00 n` a run of zeros, `FF` ends.
    ZeroRun,
}

impl fmt::Display for Preset {
    /// Its name in a configuration.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        self.serialize(f)
    }
}

/// The `[sensor.frame]` table: a preset, and what overrides it.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// What the other keys override.
    pub preset: Preset,
    /// First bytes of a frame, in hex.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sync: Option<HexBytes>,
    /// Last bytes of a frame, in hex.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tail: Option<HexBytes>,
    /// Field after `sync` holding the bytes of the cells.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub length: Option<LengthField>,
    /// How a taxel is written.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cell: Option<Cell>,
    /// Bits of a cell that carry the count; applied first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mask: Option<u16>,
    /// Whether the count is `mask` minus the cell.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub invert: Option<bool>,
    /// Over all bytes before it, little-endian.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub checksum: Option<Checksum>,
    /// Rows of the array, 1 to 28.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rows: Option<usize>,
    /// Columns of the array, 1 to 28.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cols: Option<usize>,
    /// In which order the taxels are sent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub order: Option<Order>,
}

/// Bytes written as hex pairs, such as `BB AA`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct HexBytes(pub Vec<u8>);

/// Text that is no [`HexBytes`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("found {0:?}, expected pairs of hex digits such as \"BB AA\"")]
pub struct HexError(String);

impl TryFrom<String> for HexBytes {
    type Error = HexError;

    fn try_from(text: String) -> Result<Self, HexError> {
        let digits: String = text.chars().filter(|c| !c.is_whitespace()).collect();
        let bytes = hex::decode(digits).map(Self);
        bytes.map_err(|_| HexError(text))
    }
}

impl From<HexBytes> for String {
    fn from(bytes: HexBytes) -> Self {
        bytes
            .0
            .iter()
            .map(|b| format!("{b:02X}"))
            .collect::<Vec<_>>()
            .join(" ")
    }
}

/// The length field, in bytes of the cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LengthField {
    /// No field.
    None,
    /// One byte.
    U8,
    /// Two bytes, low first.
    U16le,
    /// Two bytes, high first.
    U16be,
}

/// How a taxel is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Cell {
    /// One byte.
    U8,
    /// Two bytes, low first.
    U16le,
    /// Two bytes, high first.
    U16be,
}

/// In which order taxels are sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Order {
    /// Row by row.
    RowMajor,
    /// Column by column.
    ColumnMajor,
    /// Row by row, every second row from its end.
    Serpentine,
}

/// Why a `[sensor.frame]` cannot be used. Each names its key.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LayoutError {
    /// Array larger than a frame, or empty.
    #[error("{key}: found {found}, expected 1 to {max}")]
    Size {
        /// `rows` or `cols`.
        key: &'static str,
        /// The value that was given.
        found: usize,
        /// Side of a frame.
        max: usize,
    },
    /// Neither `sync` nor `tail`.
    #[error("sync: found neither sync nor tail, expected at least one to find frames by")]
    Unmarked,
    /// A length field with nothing to find it by.
    #[error("length: found a length field without sync, expected sync before it")]
    LengthWithoutSync,
    /// The cells are too many for the length field.
    #[error("length: found {found} payload bytes, expected at most {max} for this field")]
    LengthField {
        /// Bytes of the cells.
        found: usize,
        /// Largest value of the field.
        max: usize,
    },
    /// The mask has bits that the cell has not.
    #[error("mask: found {found}, expected 1 to {max} for this cell")]
    Mask {
        /// The value that was given.
        found: u16,
        /// All ones of the cell.
        max: u16,
    },
    /// A key that this preset fixes.
    #[error("{key}: found a value, expected none: preset {preset} fixes it")]
    Fixed {
        /// The key.
        key: &'static str,
        /// The preset.
        preset: Preset,
    },
}
