//! The messages made from one frame.
//!
//! In: a frame event. Out: the frame as an image, and as two numbers for plots.

use jiff::Timestamp;
use serde::Serialize;
use serde_json::json;

use super::{Blob, Header, Topic, named, to_cdr};
use crate::event::FrameEvent;

/// The frame as an image, in newtons.
pub const FRAME: Topic = Topic {
    name: "frame",
    schema: "sensor_msgs/msg/Image",
    definition: "\
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
",
};

/// Force and contact area of the frame.
pub const CONTACT: Topic = Topic {
    name: "contact",
    schema: "tactile_interfaces/msg/Contact",
    definition: include_str!("../../../../clients/ros2/tactile_interfaces/msg/Contact.msg"),
};

#[derive(Debug, Serialize)]
struct ImageMessage {
    header: Header,
    height: u32,
    width: u32,
    encoding: &'static str,
    is_bigendian: u8,
    step: u32,
    data: Blob,
}

/// Bytes of a taxel in newtons.
const NEWTONS_BYTES: u32 = size_of::<f32>() as u32;

/// The frame in newtons (`32FC1`), row 0 at the top.
pub(super) fn image(frame: &FrameEvent) -> (Topic, Timestamp, Vec<u8>) {
    let bytes: Vec<u8> = frame.newtons.iter().flat_map(|n| n.to_le_bytes()).collect();
    let message = ImageMessage {
        header: Header::new(frame.time, &frame.sensor),
        height: frame.rows as u32,
        width: frame.cols as u32,
        encoding: "32FC1",
        is_bigendian: 0,
        step: frame.cols as u32 * NEWTONS_BYTES,
        data: Blob::from(bytes),
    };
    (FRAME, frame.time, to_cdr(&message))
}

/// The force of the contact and its area.
pub(super) fn contact(frame: &FrameEvent) -> (Topic, Timestamp, Vec<u8>) {
    // Without the forces of the taxels, which are most of an event.
    let event = json!({
        "frame": frame.frame,
        "force_n": frame.force_n,
        "contact_area_taxels": frame.contact_area_taxels,
        "approach_mm": frame.approach_mm,
        "tared": frame.tared,
    });
    named(CONTACT, frame.time, &frame.sensor, &event)
}
