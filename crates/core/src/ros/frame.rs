//! The messages made from one frame.
//!
//! In: a frame event. Out: the frame as an image, as a grid that has a size in space, and as two
//! numbers for plots.

use jiff::Timestamp;
use serde::Serialize;
use serde_json::json;

use super::{Blob, Header, Time, Topic, named, to_cdr};
use crate::event::FrameEvent;
use crate::frame::Pitch;

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

/// The frame as a grid in space, for the 3D views of Foxglove and Lichtblick.
pub const GRID: Topic = Topic {
    name: "grid",
    schema: "foxglove_msgs/msg/Grid",
    definition: "\
builtin_interfaces/Time timestamp
string frame_id
geometry_msgs/Pose pose
uint32 column_count
foxglove_msgs/Vector2 cell_size
uint32 row_stride
uint32 cell_stride
foxglove_msgs/PackedElementField[] fields
uint8[] data
================================================================================
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
================================================================================
MSG: foxglove_msgs/Vector2
float64 x
float64 y
================================================================================
MSG: foxglove_msgs/PackedElementField
string name
uint32 offset
uint8 type
",
};

#[derive(Debug, Serialize)]
pub(super) struct ImageMessage {
    pub(super) header: Header,
    pub(super) height: u32,
    pub(super) width: u32,
    pub(super) encoding: &'static str,
    pub(super) is_bigendian: u8,
    pub(super) step: u32,
    pub(super) data: Blob,
}

#[derive(Debug, Serialize)]
struct GridMessage<'a> {
    timestamp: Time,
    frame_id: &'a str,
    pose: Pose,
    column_count: u32,
    cell_size: Vector2,
    row_stride: u32,
    cell_stride: u32,
    fields: Vec<Field>,
    data: Blob,
}

#[derive(Debug, Serialize)]
struct Pose {
    /// x, y, z.
    position: [f64; 3],
    /// x, y, z, w.
    orientation: [f64; 4],
}

#[derive(Debug, Serialize)]
struct Vector2 {
    x: f64,
    y: f64,
}

#[derive(Debug, Serialize)]
struct Field {
    name: &'static str,
    offset: u32,
    kind: u8,
}

/// `PackedElementField`'s number for an f32.
const FLOAT32: u8 = 7;

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
pub fn contact(frame: &FrameEvent) -> (Topic, Timestamp, Vec<u8>) {
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

/// The frame as a grid in metres around the sensor's middle. Its y axis points up, so the frame's
/// last row comes first.
pub(super) fn grid(frame: &FrameEvent, pitch: Pitch) -> (Topic, Timestamp, Vec<u8>) {
    let cell_size = Vector2 {
        x: pitch.cols_mm / 1e3,
        y: pitch.rows_mm / 1e3,
    };
    let rows = frame.newtons.chunks(frame.cols).rev();
    let bytes: Vec<u8> = rows.flatten().flat_map(|n| n.to_le_bytes()).collect();
    let corner = |taxels: usize, size_m: f64| -0.5 * taxels as f64 * size_m;
    let message = GridMessage {
        timestamp: Time::new(frame.time),
        frame_id: &frame.sensor,
        pose: Pose {
            position: [
                corner(frame.cols, cell_size.x),
                corner(frame.rows, cell_size.y),
                0.0,
            ],
            orientation: [0.0, 0.0, 0.0, 1.0],
        },
        column_count: frame.cols as u32,
        cell_size,
        row_stride: frame.cols as u32 * NEWTONS_BYTES,
        cell_stride: NEWTONS_BYTES,
        fields: vec![Field {
            name: "newtons",
            offset: 0,
            kind: FLOAT32,
        }],
        data: Blob::from(bytes),
    };
    (GRID, frame.time, to_cdr(&message))
}
