//! The wire: how a sensor writes a frame as bytes, and how frames are found in bytes.
//!
//! In: [`Settings`] (a preset with its overrides) and bytes as they came. Out: [`RawFrame`]s and
//! [`Damage`]. A [`Layout`] says where the parts of a frame are. A [`Decoder`] finds frames by it.
//! Nothing here reads a port, waits or asks the time.
//!
//! A frame of a free layout is `sync, length, header bytes, cells, footer bytes, checksum, tail`, or
//! several packets of these parts. Each part but the cells is optional. The vendor of the JX255N publishes no protocol: these layouts are those of
//! comparable film arrays.
//!
//! The files below are in reading order. Each uses only those above it.
//!
//! [`RawFrame`]: crate::frame::RawFrame

mod checksum;
mod settings;
mod cells;
mod scan;
mod text;
mod preset;
mod fixed;
mod layout;
mod decoder;

pub use self::checksum::{Checksum, ChecksumOver};
pub use self::decoder::{Decoded, Decoder, Place, TELNET, is_telnet};
pub use self::layout::Layout;
pub use self::scan::Damage;
pub use self::settings::{Cell, Framing, HexBytes, LengthField, Order, Packets, Preset, Settings};
pub use self::text::is_separator;
