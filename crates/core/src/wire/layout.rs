//! A checked layout: where the parts of a frame are.

use super::cells::{Cells, MOST_EXACT};
use super::fixed::Fixed;
use super::scan::{Context, Scan};
use super::settings::{Cell, Settings};
use super::text::{self, Lines};
use crate::frame::{Array, RawFrame};
use crate::range::{OutOfRange, check, from_to};
use crate::wording::is_plain;

/// The way to find counts in bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Form {
    Fixed(Box<Fixed>),
    /// What comes before each frame. Empty if nothing does.
    Text(Vec<u8>),
}

/// A checked layout.
///
/// # Example
///
/// A layout writes a frame as the sensor would, and knows the size of the array.
///
/// ```
/// use hardnessd_core::frame::{Array, RawFrame};
/// use hardnessd_core::range::OutOfRange;
/// use hardnessd_core::wire::{Layout, Settings};
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
/// # Ok::<(), OutOfRange>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Layout {
    form: Form,
    cells: Cells,
    full_scale: Option<f32>,
}

impl Layout {
    /// Checks `settings` and works out where every taxel is.
    ///
    /// # Errors
    ///
    /// Returns an error that names the key: a side outside 1..=64, a length field that cannot hold the
    /// payload, packets that do not fit, a mask wider than the cell, or a part that frames of the preset
    /// do not have.
    pub fn new(settings: &Settings) -> Result<Self, OutOfRange> {
        let keys = settings.in_force()?;
        keys.check_ranges()?;
        check(
            "request_ms",
            format_args!("a value"),
            keys.request_ms.is_none() || keys.request.is_some(),
            "none without request",
        )?;
        let array = Array {
            rows: keys.rows.unwrap_or(Array::JX255N.rows),
            cols: keys.cols.unwrap_or(Array::JX255N.cols),
        };
        let (order, invert) = (
            keys.order.unwrap_or_default(),
            keys.invert.unwrap_or_default(),
        );
        // The range of a cell, if it is known.
        let (form, range) = if settings.preset().is_text() {
            let heading = keys.heading.as_deref().unwrap_or_default();
            check(
                "heading",
                heading,
                heading.len() <= MOST_HEADING_BYTES && is_plain(&heading.replace('\t', " ")),
                "at most 64 bytes without hidden characters",
            )?;
            (Form::Text(heading.as_bytes().to_vec()), None)
        } else {
            let fixed = Box::new(Fixed::new(&keys, array)?);
            (Form::Fixed(fixed), keys.cell.unwrap_or_default().range())
        };
        let all_bits = keys.cell.and_then(Cell::bits);
        if let Some(mask) = keys.mask {
            // Of a larger number of a text, the last bits are rounded.
            let bits = match form {
                Form::Text(_) => Some(MOST_EXACT),
                Form::Fixed(_) => all_bits,
            };
            let bits = bits.ok_or_else(|| {
                let expected = "none for cells with a sign, of 32 bits or of floats";
                OutOfRange::new("mask", mask, expected)
            })?;
            from_to((1.0, bits.into()), "for this cell").check("mask", &mask)?;
        }
        // All bits need no mask, unless the count is the mask minus the cell.
        let mask = keys.mask.filter(|_| invert || keys.mask != all_bits);
        let full_scale = match (mask, range) {
            (Some(mask), _) => Some(mask as f32),
            (None, Some((least, _))) if invert => Some(0.0 - least),
            (None, range) => range.map(|(_, most)| most),
        };
        Ok(Self {
            form,
            cells: Cells::new(array, order, mask, invert),
            full_scale,
        })
    }

    /// The array that this layout carries.
    pub fn array(&self) -> Array {
        self.cells.array
    }

    /// The count at which a taxel reads full scale, if the layout has one.
    pub fn full_scale(&self) -> Option<f32> {
        self.full_scale
    }

    /// The number of bytes in a frame. If frames vary, of the longest usual one.
    pub fn max_frame_bytes(&self) -> usize {
        self.least_and_most_bytes().1
    }

    /// The number of bytes in a frame. If frames vary, of the shortest one.
    pub fn min_frame_bytes(&self) -> usize {
        self.least_and_most_bytes().0
    }

    fn least_and_most_bytes(&self) -> (usize, usize) {
        match &self.form {
            Form::Fixed(fixed) => fixed.least_and_most_bytes(),
            Form::Text(_) => text::usual_bytes(&self.cells),
        }
    }

    /// The most bytes that may yet become a frame.
    pub fn most_pending_bytes(&self) -> usize {
        match &self.form {
            Form::Fixed(fixed) => fixed.most_pending_bytes(),
            Form::Text(_) => text::most_bytes(&self.cells) + 1,
        }
    }

    /// Appends `frame` as the sensor would send it. Counts beyond a cell's largest value are
    /// clipped to it. Skipped bytes are zeros.
    pub fn encode(&self, frame: &RawFrame, out: &mut Vec<u8>) {
        let cells = self.cells.of(frame);
        match &self.form {
            Form::Fixed(fixed) => fixed.encode(cells, out),
            Form::Text(heading) => text::encode(heading, cells, out),
        }
    }

    /// Looks for a frame at the beginning of `bytes`. `lines` is what earlier calls found in them.
    pub(super) fn scan(&self, bytes: &[u8], context: Context, lines: &mut Lines) -> Scan {
        match &self.form {
            Form::Fixed(fixed) => fixed.scan(&self.cells, bytes, context),
            Form::Text(heading) => text::scan(heading, &self.cells, bytes, context, lines),
        }
    }

    /// Whether the first byte of a stream counts as the beginning of a frame.
    pub(super) fn begins_in_sync(&self) -> bool {
        matches!(&self.form, Form::Fixed(fixed) if fixed.begins_in_sync())
    }

    /// Whether the decoder stays in sync when it skips bytes. In text each line may begin a frame.
    pub(super) fn stays_in_sync(&self) -> bool {
        match &self.form {
            Form::Fixed(fixed) => fixed.stays_in_sync(),
            Form::Text(_) => true,
        }
    }

    /// Whether a frame begins after a pause.
    pub(super) fn is_in_sync_after_pause(&self) -> bool {
        matches!(&self.form, Form::Fixed(fixed) if fixed.is_bare())
    }
}

/// The longest heading.
const MOST_HEADING_BYTES: usize = 64;
