//! The presets: every key of `[sensor.frame]`, before the configuration overrides some.
//!
//! `docs/your-array.md` says where each preset comes from.

use super::checksum::{Checksum, ChecksumOver};
use super::settings::{Cell, FooterBytes, HexBytes, LengthField, Packets, Preset, Settings};
use super::text::FrameEnd;
use crate::frame::Array;

/// The way to find counts in bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// Frames of one length.
    Fixed,
    /// Text.
    Text(FrameEnd),
    /// Packed zeros.
    ZeroRun,
}

/// The keys of a layout. Only frames of [`Kind::Fixed`] have more than rows and columns.
#[derive(Debug)]
pub(super) struct Keys {
    pub(super) kind: Kind,
    pub(super) sync: Vec<u8>,
    pub(super) length: LengthField,
    pub(super) header_bytes: usize,
    pub(super) cell: Cell,
    pub(super) footer_bytes: FooterBytes,
    pub(super) checksum: Checksum,
    pub(super) checksum_over: ChecksumOver,
    pub(super) tail: Vec<u8>,
    /// Whether a cell never holds the tail, which has one byte.
    pub(super) tail_not_in_cells: bool,
    pub(super) packets: Option<Packets>,
    pub(super) rows: usize,
    pub(super) cols: usize,
}

/// Cells of one byte, and no more.
const PLAIN: Keys = Keys {
    kind: Kind::Fixed,
    sync: Vec::new(),
    length: LengthField::None,
    header_bytes: 0,
    cell: Cell::U8,
    footer_bytes: FooterBytes::Each(0),
    checksum: Checksum::None,
    checksum_over: ChecksumOver::All,
    tail: Vec::new(),
    tail_not_in_cells: false,
    packets: None,
    rows: Array::JX255N.rows,
    cols: Array::JX255N.cols,
};

impl Keys {
    fn of(preset: Preset) -> Self {
        match preset {
            Preset::Jx255n => Self {
                sync: vec![0xBB, 0xAA],
                length: LengthField::U16le,
                checksum: Checksum::Crc16Modbus,
                ..PLAIN
            },
            Preset::Jx255nU16 => Self {
                cell: Cell::U16le,
                ..Self::of(Preset::Jx255n)
            },
            Preset::Jq => Self {
                sync: vec![0xAA, 0x55, 0x03, 0x99],
                ..PLAIN
            },
            Preset::JqTail => Self {
                tail: vec![0xAA, 0x55, 0x03, 0x99],
                ..PLAIN
            },
            Preset::JqU16 => Self {
                cell: Cell::U16le,
                tail: vec![0xAA, 0, 0x55, 0, 0x03, 0, 0x99, 0],
                ..PLAIN
            },
            Preset::JqGlove => Self {
                // The packet's number, and the kind of glove.
                header_bytes: 2,
                footer_bytes: FooterBytes::Of(vec![0, 16]),
                packets: Some(Packets {
                    count: 2,
                    number_at: 0,
                    first: 1,
                }),
                rows: 16,
                cols: 16,
                ..Self::of(Preset::Jq)
            },
            Preset::FfTail => Self {
                tail: vec![0xFF],
                tail_not_in_cells: true,
                ..PLAIN
            },
            Preset::Flexitac => Self {
                sync: vec![0xAA, 0x55],
                rows: 16,
                cols: 32,
                ..PLAIN
            },
            Preset::M1616 => Self {
                sync: vec![0xAA, 0xAB, 0xAC],
                cell: Cell::U16be,
                footer_bytes: FooterBytes::Each(4),
                rows: 16,
                cols: 16,
                ..PLAIN
            },
            Preset::Ascii => Self {
                kind: Kind::Text(FrameEnd::LineWithoutDigit),
                ..PLAIN
            },
            Preset::Csv => Self {
                kind: Kind::Text(FrameEnd::Line),
                ..PLAIN
            },
            Preset::ZeroRun => Self {
                kind: Kind::ZeroRun,
                ..PLAIN
            },
        }
    }

    /// The keys of the preset with the overrides of `settings`.
    pub(super) fn with(settings: &Settings) -> Self {
        let preset = Self::of(settings.preset);
        let bytes = |given: &Option<HexBytes>| given.clone().map(|bytes| bytes.0);
        // Only in a frame of cells of one byte and the tail is a tail the end of a frame wherever it
        // is.
        let has_other_parts = settings.sync.is_some()
            || settings.header_bytes.is_some()
            || settings.cell.is_some()
            || settings.footer_bytes.is_some()
            || settings.checksum.is_some()
            || settings.tail.is_some();
        Self {
            kind: preset.kind,
            sync: bytes(&settings.sync).unwrap_or(preset.sync),
            length: settings.length.unwrap_or(preset.length),
            header_bytes: settings.header_bytes.unwrap_or(preset.header_bytes),
            cell: settings.cell.unwrap_or(preset.cell),
            footer_bytes: settings.footer_bytes.clone().unwrap_or(preset.footer_bytes),
            checksum: settings.checksum.unwrap_or(preset.checksum),
            checksum_over: settings.checksum_over.unwrap_or(preset.checksum_over),
            tail: bytes(&settings.tail).unwrap_or(preset.tail),
            tail_not_in_cells: preset.tail_not_in_cells && !has_other_parts,
            packets: settings.packets.or(preset.packets),
            rows: settings.rows.unwrap_or(preset.rows),
            cols: settings.cols.unwrap_or(preset.cols),
        }
    }
}
