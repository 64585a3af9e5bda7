//! A checked layout: where the parts of a frame are.

use super::cells::Cells;
use super::preset::{Keys, Kind};
use super::scan::{Context, Scan};
use super::settings::{LayoutError, Order, Settings};
use super::text::FrameEnd;
use super::{fixed, zero_run};
use crate::frame::{Array, MOST_SIDE, RawFrame};
use crate::range::within;

/// The way to find counts in bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Framing {
    Fixed(fixed::Fixed),
    Text(FrameEnd),
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
/// let error = Layout::new(&settings).unwrap_err();
/// assert_eq!(error.to_string(), "rows: found 65, expected 1 to 64");
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
    /// by, a length field that cannot hold the payload, packets that do not fit, a mask wider than
    /// the cell, or a part that frames of the preset do not have.
    pub fn new(settings: &Settings) -> Result<Self, LayoutError> {
        let keys = Keys::with(settings);
        for (key, found) in [("rows", keys.rows), ("cols", keys.cols)] {
            within(key, found, (1, MOST_SIDE), "")?;
        }
        let array = Array {
            rows: keys.rows,
            cols: keys.cols,
        };
        if keys.kind != Kind::Fixed
            && let Some(key) = key_of_parts(settings)
        {
            return Err(LayoutError::Unused {
                key,
                preset: settings.preset,
            });
        }
        // The value of a cell with all ones, and the largest cell value if it is known.
        let (framing, all_ones, largest) = match keys.kind {
            Kind::Text(end) => (Framing::Text(end), u16::MAX, None),
            Kind::ZeroRun => (Framing::ZeroRun, 0xFF, Some(0xFE)),
            Kind::Fixed => {
                let fixed = fixed::Fixed::new(keys)?;
                let (all_ones, largest) = (fixed.all_ones(), fixed.largest_cell());
                (Framing::Fixed(fixed), all_ones, Some(largest))
            }
        };
        let mask = settings.mask.unwrap_or(all_ones);
        within("mask", mask, (1, all_ones), "for this cell")?;
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
        match &self.framing {
            Framing::Fixed(fixed) => fixed.frame_bytes(),
            Framing::Text(end) => end.max_frame_bytes(&self.cells),
            Framing::ZeroRun => zero_run::max_frame_bytes(self.cells.count()),
        }
    }

    /// The number of bytes in a frame. If frames vary, of the shortest one.
    pub fn min_frame_bytes(&self) -> usize {
        match &self.framing {
            Framing::Fixed(fixed) => fixed.frame_bytes(),
            Framing::Text(end) => end.min_frame_bytes(&self.cells),
            Framing::ZeroRun => zero_run::min_frame_bytes(self.cells.count()),
        }
    }

    /// Appends `frame` as the sensor would send it. Counts beyond a cell's largest value are
    /// clipped to it. Skipped bytes are zeros.
    pub fn encode(&self, frame: &RawFrame, out: &mut Vec<u8>) {
        let cells = self.cells.of(frame);
        match &self.framing {
            Framing::Fixed(fixed) => fixed.encode(cells, out),
            Framing::Text(end) => end.encode(cells, self.cells.array, out),
            Framing::ZeroRun => zero_run::encode(cells, out),
        }
    }

    /// Looks for a frame at the beginning of `bytes`.
    pub(super) fn scan(&self, bytes: &[u8], context: Context) -> Scan {
        match &self.framing {
            Framing::Fixed(fixed) => fixed.scan(&self.cells, bytes, context),
            Framing::Text(end) => end.scan(&self.cells, bytes, context),
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
        matches!(&self.framing, Framing::Text(_) | Framing::ZeroRun)
    }
}

/// The first key that is given of those that only frames of one length have.
fn key_of_parts(settings: &Settings) -> Option<&'static str> {
    let given = [
        ("sync", settings.sync.is_some()),
        ("tail", settings.tail.is_some()),
        ("length", settings.length.is_some()),
        ("header_bytes", settings.header_bytes.is_some()),
        ("cell", settings.cell.is_some()),
        ("footer_bytes", settings.footer_bytes.is_some()),
        ("checksum", settings.checksum.is_some()),
        ("checksum_over", settings.checksum_over.is_some()),
        ("packets", settings.packets.is_some()),
    ];
    let key = given.into_iter().find(|&(_, is_given)| is_given);
    key.map(|(key, _)| key)
}
