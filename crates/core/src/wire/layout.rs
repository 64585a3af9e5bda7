//! A checked layout: where the parts of a frame are.

use super::cells::Cells;
use super::checksum::Checksum;
use super::scan::{Context, Scan};
use super::settings::{Cell, HexBytes, LayoutError, LengthField, Order, Preset, Settings};
use super::{fixed, text, zero_run};
use crate::frame::{Array, MOST_SIDE, RawFrame};

/// The way to find counts in bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Framing {
    Fixed(fixed::Fixed),
    Text,
    ZeroRun,
}

/// A checked layout.
///
/// # Example
///
/// A layout writes a frame as the sensor would, and knows the size of the array.
///
/// ```
/// use hardnessd_core::frame::{Array, RawFrame};
/// use hardnessd_core::wire::{Layout, LayoutError, Settings};
///
/// let settings = Settings { rows: Some(10), ..Settings::default() };
/// let layout = Layout::new(&settings)?;
/// assert_eq!(layout.array(), Array { rows: 10, cols: 28 });
/// let mut bytes = Vec::new();
/// layout.encode(&RawFrame::zero(layout.array()), &mut bytes);
/// assert_eq!(bytes.len(), layout.max_frame_bytes());
///
/// let settings = Settings { rows: Some(65), ..Settings::default() };
/// assert!(matches!(Layout::new(&settings), Err(LayoutError::Size { key: "rows", .. })));
/// # Ok::<(), LayoutError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layout {
    framing: Framing,
    cells: Cells,
    full_scale: Option<u16>,
}

impl Layout {
    /// Checks `settings` and works out where every taxel is.
    ///
    /// # Errors
    ///
    /// Returns a [`LayoutError`] that names the key: a side outside 1..=64, no mark to find frames
    /// by, a length field that cannot hold the payload, a mask wider than the cell, or a key that a
    /// preset fixes.
    pub fn new(settings: &Settings) -> Result<Self, LayoutError> {
        let rows = settings.rows.unwrap_or(Array::JX255N.rows);
        let cols = settings.cols.unwrap_or(Array::JX255N.cols);
        for (key, found) in [("rows", rows), ("cols", cols)] {
            if !(1..=MOST_SIDE).contains(&found) {
                let max = MOST_SIDE;
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
            cells: Cells::new(array, order, mask, invert, largest_cell),
            full_scale: is_known.then_some(if invert { mask } else { largest_cell }),
        })
    }

    /// The array that this layout carries.
    pub fn array(&self) -> Array {
        self.cells.array
    }

    /// The count at which a taxel reads full scale, if the layout has one.
    pub fn full_scale(&self) -> Option<u16> {
        self.full_scale
    }

    /// The number of bytes in a frame. If frames vary, of the longest one.
    pub fn max_frame_bytes(&self) -> usize {
        let cells = self.cells.count();
        match &self.framing {
            Framing::Fixed(fixed) => fixed.frame_bytes(cells),
            Framing::Text => text::max_frame_bytes(&self.cells),
            Framing::ZeroRun => zero_run::max_frame_bytes(cells),
        }
    }

    /// The number of bytes in a frame. If frames vary, of the shortest one.
    pub fn min_frame_bytes(&self) -> usize {
        let cells = self.cells.count();
        match &self.framing {
            Framing::Fixed(fixed) => fixed.frame_bytes(cells),
            Framing::Text => text::min_frame_bytes(self.cells.array),
            Framing::ZeroRun => zero_run::min_frame_bytes(cells),
        }
    }

    /// Appends `frame` as the sensor would send it. Counts beyond a cell's largest value are
    /// clipped to it.
    pub fn encode(&self, frame: &RawFrame, out: &mut Vec<u8>) {
        let cells = self.cells.of(frame);
        match &self.framing {
            Framing::Fixed(fixed) => fixed.encode(cells, self.cells.count(), out),
            Framing::Text => text::encode(cells, self.cells.array.cols, out),
            Framing::ZeroRun => zero_run::encode(cells, out),
        }
    }

    /// Looks for a frame at the beginning of `bytes`.
    pub(super) fn scan(&self, bytes: &[u8], context: Context) -> Scan {
        match &self.framing {
            Framing::Fixed(fixed) => fixed.scan(&self.cells, bytes, context),
            Framing::Text => text::scan(&self.cells, bytes, context),
            Framing::ZeroRun => zero_run::scan(&self.cells, bytes, context),
        }
    }

    /// Whether the first byte of a stream counts as the beginning of a frame. Only with a sync can
    /// the decoder see whether it is one.
    pub(super) fn begins_locked(&self) -> bool {
        matches!(&self.framing, Framing::Fixed(fixed) if fixed.has_sync())
    }

    /// Whether the next frame begins where a dropped candidate ended. This holds for text and for
    /// runs, whose candidates end with the mark of a frame's end.
    pub(super) fn ends_with_dropped(&self) -> bool {
        matches!(&self.framing, Framing::Text | Framing::ZeroRun)
    }
}

/// The framing of a preset with its overrides, the value of a cell with all ones, and the largest
/// cell value if it is known.
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

/// The header or tail of the JQ arrays.
const JQ_MARK: [u8; 4] = [0xAA, 0x55, 0x03, 0x99];

/// Refuses overrides of `ff-tail`, `ascii` and `zero-run`, whose marks and cells belong together.
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
