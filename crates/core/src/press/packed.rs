//! The form of a press's frames in a recording. It is packed, because most taxels of them are 0.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::{ContactFrame, FrameAt, Marks};
use crate::frame::sparse::{self, SparseError};
use crate::frame::{Array, Frame, MOST_SIDE};

/// The form of a [`ContactFrame`] in a recording.
#[derive(Serialize, Deserialize)]
pub(super) struct Packed {
    moment: FrameAt,
    array: Array,
    /// The frame as [`sparse`] text.
    frame: String,
    marks: Marks,
    area: u32,
}

/// The reason why a [`Packed`] frame is none.
#[derive(Debug, thiserror::Error)]
pub(super) enum PackedError {
    #[error("found an array of {0}, expected at most {MOST_SIDE}x{MOST_SIDE}")]
    Array(Array),
    #[error(transparent)]
    Frame(#[from] SparseError),
}

impl From<ContactFrame> for Packed {
    fn from(held: ContactFrame) -> Self {
        Self {
            moment: held.moment,
            array: held.frame.array,
            frame: sparse::write(&held.frame.newtons),
            marks: held.marks,
            area: held.contact_area_taxels,
        }
    }
}

impl TryFrom<Packed> for ContactFrame {
    type Error = PackedError;

    fn try_from(packed: Packed) -> Result<Self, PackedError> {
        let array = packed.array;
        if array.rows.max(array.cols) > MOST_SIDE {
            return Err(PackedError::Array(array));
        }
        let newtons = sparse::read(&packed.frame, array.taxels())?.into();
        let frame = Frame { array, newtons };
        Ok(Self {
            moment: packed.moment,
            force_n: frame.force_n(),
            frame: Arc::new(frame),
            marks: packed.marks,
            contact_area_taxels: packed.area,
        })
    }
}
