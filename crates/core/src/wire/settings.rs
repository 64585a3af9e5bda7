//! The `[sensor.frame]` table and its errors.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::checksum::{Checksum, ChecksumOver};
use crate::frame::MOST_SIDE;
use crate::range::{Range, from_to};

/// Ready-made layouts. `presets.toml` has their keys.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// Cells of one byte, and nothing else.
    None,
    /// `BB AA`, payload length u16 LE, cells u8, CRC-16/Modbus.
    Jx255n,
    /// Like `Jx255n`, with u16 LE cells.
    Jx255nU16,
    /// `AA 55 03 99`, cells u8.
    Jq,
    /// Cells u8, `AA 55 03 99`.
    JqTail,
    /// Cells u16 LE, `AA 00 55 00 03 00 99 00`.
    JqU16,
    /// `AA 55`, 16x32 cells u8.
    Flexitac,
    /// Two packets: `AA 55 03 99`, packet number, type, 128 cells u8; 16 more bytes end the second.
    JqGlove,
    /// `AA AB AC`, 16x16 cells u16 BE, four more bytes.
    M1616,
    /// Text: all numbers of a frame on one line, or a line for each row and then one without a digit.
    Csv,
}

impl fmt::Display for Preset {
    /// Writes the preset's name in a configuration.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        self.serialize(f)
    }
}

crate::settings! {
    /// The `[sensor.frame]` table: a preset and its overrides. A key that neither has is the plain one:
    /// no such part, or the default of its type.
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
    pub struct Settings {
        /// The preset that the other keys override. [`Settings::preset`] has the default.
        pub preset: Option<Preset>;
        /// The first bytes of a frame, in hex.
        pub sync: Option<HexBytes>;
        /// The last bytes of a frame, in hex.
        pub tail: Option<HexBytes>;
        /// The field after `sync` that holds the number of bytes of the cells.
        pub length: Option<LengthField>;
        /// The number of bytes that are skipped before the cells.
        pub header_bytes: Option<usize>, in SKIPPED_BYTES;
        /// How a taxel is written.
        pub cell: Option<Cell>;
        /// The number of bytes from one cell to the next. The default is that of a cell: nothing is
        /// between them.
        pub stride_bytes: Option<usize>, in from_to((1.0, 8192.0), "");
        /// The bits of a cell that carry the count, of cells that are whole numbers without a sign. The
        /// mask is applied first.
        pub mask: Option<u32>;
        /// Whether the count is `mask` minus the cell, or minus the cell where there is no mask.
        pub invert: Option<bool>;
        /// The number of bytes that are skipped after the last cell.
        pub footer_bytes: Option<usize>, in SKIPPED_BYTES;
        /// The checksum.
        pub checksum: Option<Checksum>;
        /// The bytes that the checksum covers.
        pub checksum_over: Option<ChecksumOver>;
        /// The number of rows of the array. The plain number is that of the JX255N.
        pub rows: Option<usize>, in SIDES;
        /// The number of columns of the array.
        pub cols: Option<usize>, in SIDES;
        /// How the bytes of a frame are packed.
        pub framing: Option<Framing>;
        /// The text before a frame of text, such as `Sensor 2`.
        pub heading: Option<String>;
        /// The order in which the taxels are sent.
        pub order: Option<Order>;
        /// Bytes that ask the sensor for a frame, in hex. They are sent again and again.
        pub request: Option<HexBytes>;
        /// The time from one request to the next. The default is the frame period.
        pub request_ms: Option<u32>, in from_to((1.0, 3_600_000.0), "milliseconds");
        /// Bytes that are sent once after each opening of the port, in hex.
        pub start: Option<HexBytes>;
        /// The packets of a frame, if a frame is sent in several.
        pub packets: Option<Packets>;
    }
}

/// The sides of an array.
const SIDES: Range = from_to((1.0, MOST_SIDE as f64), "");

/// The bytes that a layout can skip before or after the cells: as many as the cells of a large array,
/// which a board may send beside the one that is read.
const SKIPPED_BYTES: Range = from_to((0.0, 8192.0), "");

/// The `[sensor.frame.packets]` table: a frame that is sent in several packets. Each packet has the
/// parts of a frame but the footer bytes, which are in the last one, and an equal share of the cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Packets {
    /// The number of packets of a frame.
    pub count: usize,
    /// Where the packet's number is, counted in bytes from 0 in the header bytes. It may be the number
    /// of a row, of a taxel or of the first cell.
    #[serde(default)]
    pub number_at: usize,
    /// How the number is written: as a cell.
    #[serde(default)]
    pub number: Cell,
    /// The number of the first packet.
    #[serde(default = "one")]
    pub first: u16,
    /// By how much the number grows from packet to packet.
    #[serde(default = "one")]
    pub step: u16,
}

fn one() -> u16 {
    1
}

/// How the bytes of a frame are packed, so that the end of a frame is a byte of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Framing {
    /// They are sent as they are.
    #[default]
    None,
    /// SLIP (RFC 1055): `C0` ends a frame.
    Slip,
    /// Consistent Overhead Byte Stuffing (Cheshire and Baker, 1999): `00` ends a frame.
    Cobs,
}

/// Bytes written as hex pairs, such as `BB AA`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct HexBytes(pub Vec<u8>);

impl TryFrom<String> for HexBytes {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        let digits: String = text.chars().filter(|c| !c.is_whitespace()).collect();
        let bytes = hex::decode(digits).map(Self);
        bytes.map_err(|_| format!("found {text:?}, expected pairs of hex digits such as \"BB AA\""))
    }
}

impl From<HexBytes> for String {
    fn from(bytes: HexBytes) -> Self {
        let pairs = bytes.0.iter().map(|byte| format!("{byte:02X}"));
        pairs.collect::<Vec<_>>().join(" ")
    }
}

/// The length field. It holds the number of bytes of the cells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LengthField {
    /// No field.
    #[default]
    None,
    /// One byte.
    U8,
    /// Two bytes, low first.
    U16le,
    /// Two bytes, high first.
    U16be,
}

/// How a taxel is written: a number of so many bits, without a sign (`U`), with one (`I`) or as a float
/// (`F`), low byte first (`le`) or high byte first (`be`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[allow(missing_docs, reason = "the names say all")]
pub enum Cell {
    I8,
    #[default]
    U8,
    I16le,
    I16be,
    U16le,
    U16be,
    I32le,
    I32be,
    F32le,
    F32be,
}

/// The order in which taxels are sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Order {
    /// Row by row.
    #[default]
    RowMajor,
    /// Column by column.
    ColumnMajor,
    /// Row by row, with every second row from its end.
    Serpentine,
}
