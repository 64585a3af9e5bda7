//! The `[sensor.frame]` table and its errors.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::checksum::{Checksum, ChecksumOver};
use crate::range::OutOfRange;

/// Ready-made layouts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// `BB AA`, payload length u16 LE, cells u8, CRC-16/Modbus.
    #[default]
    Jx255n,
    /// Like `Jx255n`, with u16 LE cells.
    Jx255nU16,
    /// `AA 55 03 99`, cells u8.
    Jq,
    /// Cells u8, `AA 55 03 99`.
    JqTail,
    /// Cells u16 LE, `AA 00 55 00 03 00 99 00`.
    JqU16,
    /// Cells 0..254, `FF`.
    FfTail,
    /// Rows of decimals; a line without a digit, such as a blank one, ends the frame.
    Ascii,
    /// 1..254 is a value, `00 n` is a run of n zeros, `FF` ends the frame.
    ZeroRun,
    /// `AA 55`, 16x32 cells u8.
    Flexitac,
    /// Two packets: `AA 55 03 99`, packet number, type, 128 cells u8; 16 more bytes end the second.
    JqGlove,
    /// `AA AB AC`, 16x16 cells u16 BE, four more bytes.
    M1616,
    /// All decimals of a frame on one line.
    Csv,
}

impl fmt::Display for Preset {
    /// Writes the preset's name in a configuration.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        self.serialize(f)
    }
}

/// The `[sensor.frame]` table: a preset and its overrides.
///
/// # Example
///
/// A sensor of 16x16 taxels sends the frames of `jq`, with a checksum.
///
/// ```
/// use hardnessd_core::wire::{Checksum, Layout, Settings};
///
/// let table = "preset = 'jq'\nchecksum = 'sum8'\nrows = 16\ncols = 16\n";
/// let settings: Settings = toml::from_str(table)?;
/// assert_eq!(settings.checksum, Some(Checksum::Sum8));
/// // Four bytes of sync, 256 cells, one byte of checksum.
/// assert_eq!(Layout::new(&settings)?.max_frame_bytes(), 261);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// The preset that the other keys override.
    pub preset: Preset,
    /// The first bytes of a frame, in hex.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sync: Option<HexBytes>,
    /// The last bytes of a frame, in hex.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tail: Option<HexBytes>,
    /// The field after `sync` that holds the number of bytes of the cells.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub length: Option<LengthField>,
    /// The number of bytes that are skipped before the cells.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub header_bytes: Option<usize>,
    /// How a taxel is written.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cell: Option<Cell>,
    /// The bits of a cell that carry the count. The mask is applied first.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mask: Option<u16>,
    /// Whether the count is `mask` minus the cell.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub invert: Option<bool>,
    /// The number of bytes that are skipped after the cells.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub footer_bytes: Option<FooterBytes>,
    /// The checksum.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub checksum: Option<Checksum>,
    /// The bytes that the checksum covers.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub checksum_over: Option<ChecksumOver>,
    /// The number of rows of the array, 1 to 64.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rows: Option<usize>,
    /// The number of columns of the array, 1 to 64.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cols: Option<usize>,
    /// The order in which the taxels are sent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub order: Option<Order>,
    /// Bytes that ask the sensor for a frame, in hex. They are sent again and again.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub request: Option<HexBytes>,
    /// The time from one request to the next, in milliseconds. The default is the frame period.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub request_ms: Option<u32>,
    /// Bytes that are sent once after each opening of the port, in hex.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub start: Option<HexBytes>,
    /// The packets of a frame, if a frame is sent in several.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub packets: Option<Packets>,
}

/// The number of bytes that are skipped after the cells.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "expected a number of bytes, or a list with a number for each packet"
)]
pub enum FooterBytes {
    /// The same number in each packet.
    Each(usize),
    /// A number for each packet.
    Of(Vec<usize>),
}

/// The `[sensor.frame.packets]` table: a frame that is sent in several packets. Each packet has the
/// parts of a frame, and an equal share of the cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Packets {
    /// The number of packets of a frame.
    pub count: usize,
    /// The byte that holds the packet's number, counted from 0 in the header bytes.
    #[serde(default)]
    pub number_at: usize,
    /// The number of the first packet. The others follow in steps of one.
    #[serde(default = "one")]
    pub first: u8,
}

fn one() -> u8 {
    1
}

/// Bytes written as hex pairs, such as `BB AA`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct HexBytes(pub Vec<u8>);

/// The error of a text that is not pairs of hex digits.
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

/// The length field. It holds the number of bytes of the cells.
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

/// The order in which taxels are sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Order {
    /// Row by row.
    RowMajor,
    /// Column by column.
    ColumnMajor,
    /// Row by row, with every second row from its end.
    Serpentine,
}

/// The reason why a `[sensor.frame]` table is unusable. Each message names its key.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LayoutError {
    /// A number is out of its range.
    #[error(transparent)]
    Range(#[from] OutOfRange),
    /// The layout has neither `sync` nor `tail`.
    #[error("sync: found neither sync nor tail, expected at least one to find frames by")]
    Unmarked,
    /// The layout has a length field, but no sync to find it by.
    #[error("length: found a length field without sync, expected sync before it")]
    LengthWithoutSync,
    /// The frames of the preset have no such part.
    #[error("{key}: found a value, expected none: frames of preset {preset} have no such part")]
    Unused {
        /// The key.
        key: &'static str,
        /// The preset.
        preset: Preset,
    },
    /// The packets cannot be found, because they have no `sync`.
    #[error("packets: found no sync, expected the one that each packet begins with")]
    PacketsWithoutSync,
}
