//! The form of a press's frames in a recording. It is packed, because most taxels of them are 0.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::{ContactFrame, FrameAt, Marks};
use crate::frame::{Frame, sparse};

/// The form of a [`ContactFrame`] in a recording.
#[derive(Serialize, Deserialize)]
struct Packed {
    moment: FrameAt,
    #[serde(with = "sparse")]
    frame: Frame,
    marks: Marks,
    area: u32,
}

pub(super) fn serialize<S: Serializer>(
    frames: &[ContactFrame],
    serializer: S,
) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(frames.iter().map(|held| Packed {
        moment: held.moment,
        frame: held.frame,
        marks: held.marks,
        area: held.contact_area_taxels,
    }))
}

pub(super) fn deserialize<'de, D: Deserializer<'de>>(
    deserializer: D,
) -> Result<Vec<ContactFrame>, D::Error> {
    let packed: Vec<Packed> = Vec::deserialize(deserializer)?;
    let unpack = |packed: Packed| ContactFrame {
        moment: packed.moment,
        force_n: packed.frame.force_n(),
        frame: packed.frame,
        marks: packed.marks,
        contact_area_taxels: packed.area,
    };
    Ok(packed.into_iter().map(unpack).collect())
}
