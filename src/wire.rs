//! The wire: how a sensor lays a frame out in bytes, and back.
//!
//! In: [`Settings`], a preset with its overrides, and bytes as they came. Out: [`RawFrame`]s and
//! [`Damage`]. A [`Layout`] says where things stand, a [`Decoder`] finds frames by it. Nothing
//! here reads a port, waits or asks the time.
//!
//! A frame of a free layout is `sync, length, cells, checksum, tail`, each part optional but the
//! cells; at least `sync` or `tail` must stand. The vendor of the JX255N publishes no protocol:
//! these layouts are those of comparable film arrays.

mod checksum;
mod decoder;
mod fixed;
mod settings;
mod text;
mod zero_run;

pub use self::checksum::Checksum;
pub use self::decoder::{Damage, Decoded, Decoder, Memory};
pub use self::settings::{Cell, HexBytes, LengthField, Order, Preset, Settings};
use crate::frame::{Array, RawFrame};

/// Why a `[sensor.frame]` cannot be used. Each names its key.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum LayoutError {
    /// Array larger than a frame, or empty.
    #[error("{key}: found {found}, expected 1 to {max}")]
    Size {
        /// `rows` or `cols`.
        key: &'static str,
        /// As given.
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
        /// As given.
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

/// How counts are found in bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Framing {
    Fixed(fixed::Fixed),
    Text,
    ZeroRun,
}

/// A checked layout.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layout {
    framing: Framing,
    array: Array,
    mask: u16,
    invert: bool,
    /// What a cell can hold.
    largest_cell: u16,
    full_scale: Option<u16>,
    /// Wire position of a taxel -> its place in the frame.
    places: Vec<u16>,
}

impl Layout {
    /// Checks `settings` and works out where every taxel stands.
    ///
    /// # Errors
    ///
    /// [`LayoutError`] naming the key: a side outside 1..=28, no mark to find frames by, a length
    /// field that cannot hold the payload, a mask wider than the cell, or a key that a preset
    /// fixes.
    pub fn new(settings: &Settings) -> Result<Self, LayoutError> {
        let rows = settings.rows.unwrap_or(crate::frame::ROWS);
        let cols = settings.cols.unwrap_or(crate::frame::COLS);
        for (key, found, max) in [
            ("rows", rows, crate::frame::ROWS),
            ("cols", cols, crate::frame::COLS),
        ] {
            if !(1..=max).contains(&found) {
                return Err(LayoutError::Size { key, found, max });
            }
        }
        let array = Array { rows, cols };
        let (framing, all_ones, largest) = framing(settings, rows * cols)?;
        let mask = settings.mask.unwrap_or(all_ones);
        if mask == 0 || mask > all_ones {
            return Err(LayoutError::Mask {
                found: mask,
                max: all_ones,
            });
        }
        let order = settings.order.unwrap_or(Order::RowMajor);
        let invert = settings.invert.unwrap_or(false);
        let largest_cell = largest.unwrap_or(all_ones).min(mask);
        let is_known = largest.is_some() || settings.mask.is_some();
        Ok(Self {
            framing,
            array,
            mask,
            invert,
            largest_cell,
            full_scale: is_known.then_some(if invert { mask } else { largest_cell }),
            places: places(array, order),
        })
    }

    /// The array this layout carries.
    pub fn array(&self) -> Array {
        self.array
    }

    /// The count at which a taxel reads full scale, where the layout has one.
    pub fn full_scale(&self) -> Option<u16> {
        self.full_scale
    }

    /// Bytes of a frame; of the longest one where frames vary.
    pub fn max_frame_bytes(&self) -> usize {
        let cells = self.places.len();
        match &self.framing {
            Framing::Fixed(fixed) => fixed.frame_bytes(cells),
            Framing::Text => text::max_frame_bytes(self.array, self.mask),
            Framing::ZeroRun => zero_run::max_frame_bytes(cells),
        }
    }

    /// Bytes of a frame; of the shortest one where frames vary.
    pub fn min_frame_bytes(&self) -> usize {
        let cells = self.places.len();
        match &self.framing {
            Framing::Fixed(fixed) => fixed.frame_bytes(cells),
            Framing::Text => text::min_frame_bytes(self.array),
            Framing::ZeroRun => zero_run::min_frame_bytes(cells),
        }
    }

    /// Appends `frame` as the sensor would send it. Counts beyond what a cell can hold are
    /// clipped to its largest value; taxels outside the array are left out.
    pub fn encode(&self, frame: &RawFrame, out: &mut Vec<u8>) {
        let cells = self.places.iter().map(|&place| {
            let count = frame.counts[usize::from(place)].min(self.mask);
            let cell = if self.invert {
                self.mask - count
            } else {
                count
            };
            cell.min(self.largest_cell)
        });
        match &self.framing {
            Framing::Fixed(fixed) => fixed.encode(cells, self.places.len(), out),
            Framing::Text => text::encode(cells, self.array.cols, out),
            Framing::ZeroRun => zero_run::encode(cells, out),
        }
    }

    /// Puts the `index`-th cell on the wire where it belongs.
    fn place(&self, frame: &mut RawFrame, index: usize, cell: u16) {
        let masked = cell & self.mask;
        frame.counts[usize::from(self.places[index])] = if self.invert {
            self.mask - masked
        } else {
            masked
        };
    }
}

/// The framing of a preset with its overrides, the largest cell and the full scale.
fn framing(settings: &Settings, cells: usize) -> Result<(Framing, u16, Option<u16>), LayoutError> {
    let hex = |bytes: &[u8]| bytes.to_vec();
    let (sync, tail, length, cell, checksum) = match settings.preset {
        Preset::Jx255n => (
            hex(&[0xBB, 0xAA]),
            hex(&[]),
            LengthField::U16le,
            Cell::U8,
            Checksum::Crc16Modbus,
        ),
        Preset::Jx255nU16 => (
            hex(&[0xBB, 0xAA]),
            hex(&[]),
            LengthField::U16le,
            Cell::U16le,
            Checksum::Crc16Modbus,
        ),
        Preset::Jq => (
            hex(&JQ_MARK),
            hex(&[]),
            LengthField::None,
            Cell::U8,
            Checksum::None,
        ),
        Preset::JqTail => (
            hex(&[]),
            hex(&JQ_MARK),
            LengthField::None,
            Cell::U8,
            Checksum::None,
        ),
        Preset::JqU16 => (
            hex(&[]),
            JQ_MARK.iter().flat_map(|&byte| [byte, 0]).collect(),
            LengthField::None,
            Cell::U16le,
            Checksum::None,
        ),
        Preset::FfTail => (
            hex(&[]),
            hex(&[0xFF]),
            LengthField::None,
            Cell::U8,
            Checksum::None,
        ),
        Preset::Ascii => {
            only_preset(settings)?;
            return Ok((Framing::Text, u16::MAX, None));
        }
        Preset::ZeroRun => {
            only_preset(settings)?;
            return Ok((Framing::ZeroRun, 0xFF, Some(0xFE)));
        }
    };
    let closed = settings.preset == Preset::FfTail;
    if closed {
        only_preset(settings)?;
    }
    let owned = |given: &Option<HexBytes>, preset| given.clone().map_or(preset, |bytes| bytes.0);
    let fixed = fixed::Fixed::new(
        fixed::Parts {
            sync: owned(&settings.sync, sync),
            tail: owned(&settings.tail, tail),
            length: settings.length.unwrap_or(length),
            cell: settings.cell.unwrap_or(cell),
            checksum: settings.checksum.unwrap_or(checksum),
            tail_not_in_cells: closed,
        },
        cells,
    )?;
    let all_ones = fixed.largest_cell();
    let full_scale = if closed { 0xFE } else { all_ones };
    Ok((Framing::Fixed(fixed), all_ones, Some(full_scale)))
}

/// Header and tail of the JQ arrays.
const JQ_MARK: [u8; 4] = [0xAA, 0x55, 0x03, 0x99];

/// `ff-tail`, `ascii` and `zero-run` exist as presets only: their marks and cells go together.
fn only_preset(settings: &Settings) -> Result<(), LayoutError> {
    let given = [
        ("sync", settings.sync.is_some()),
        ("tail", settings.tail.is_some()),
        ("length", settings.length.is_some()),
        ("cell", settings.cell.is_some()),
        ("checksum", settings.checksum.is_some()),
    ];
    match given.into_iter().find(|&(_, is_given)| is_given) {
        Some((key, _)) => Err(LayoutError::Fixed {
            key,
            preset: settings.preset,
        }),
        None => Ok(()),
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
            u16::try_from(array.place(row, col)).expect("a frame has 784 places")
        })
        .collect()
}
