//! Messages for the usual tools of ROS: diagnostics, pictures, and the position of an arm.
//!
//! In: statuses, frames, and the bytes of a position. Out: messages for topics, and the position.
//! ROS defines these messages; DDS needs only their names.

use jiff::Timestamp;
use serde::{Deserialize, Serialize};

use super::frame::ImageMessage;
use super::{Blob, Header, Topic, to_cdr};
use crate::colour::viridis;
use crate::event::{FrameEvent, LinkState, Status, name};

/// The state of every sensor, for tools such as `rqt_robot_monitor`.
pub const DIAGNOSTICS: Topic = on_a_wire("diagnostics", "diagnostic_msgs/msg/DiagnosticArray");

/// A colour picture, which every viewer shows without settings.
pub const IMAGE: Topic = on_a_wire("image", "sensor_msgs/msg/Image");

/// The position of the arm, from the robot. The configuration names the topic.
pub const POSITION: Topic = on_a_wire("", "geometry_msgs/msg/PointStamped");

/// A topic that is never recorded, so its definition is not needed.
const fn on_a_wire(name: &'static str, schema: &'static str) -> Topic {
    Topic {
        name,
        schema,
        definition: "",
    }
}

#[derive(Debug, Serialize)]
struct DiagnosticArray {
    header: Header,
    status: Vec<DiagnosticStatus>,
}

#[derive(Debug, Serialize)]
struct DiagnosticStatus {
    level: u8,
    name: String,
    message: String,
    hardware_id: String,
    values: Vec<KeyValue>,
}

#[derive(Debug, Serialize)]
struct KeyValue {
    key: &'static str,
    value: String,
}

/// A `geometry_msgs/PointStamped`: a position of the arm.
#[derive(Debug, Deserialize)]
pub struct PointStamped {
    header: Header,
    point: Point,
}

#[derive(Debug, Deserialize)]
struct Point {
    #[expect(dead_code, reason = "it stands before z on the wire")]
    x: f64,
    #[expect(dead_code, reason = "it stands before z on the wire")]
    y: f64,
    z: f64,
}

/// The levels of `DiagnosticStatus`.
const OK: u8 = 0;
const WARN: u8 = 1;
const ERROR: u8 = 2;

/// The states of the sensors of `robot` at `time`.
pub fn diagnostics<'a>(
    time: Timestamp,
    robot: &str,
    statuses: impl Iterator<Item = &'a Status>,
) -> Vec<u8> {
    to_cdr(&DiagnosticArray {
        header: Header::new(time, ""),
        status: statuses.map(|status| diagnostic(robot, status)).collect(),
    })
}

fn diagnostic(robot: &str, status: &Status) -> DiagnosticStatus {
    let level = match status.state {
        LinkState::Live if status.reason.is_none() => OK,
        LinkState::Live | LinkState::Connecting => WARN,
        LinkState::Stale | LinkState::Lost => ERROR,
    };
    let state = name(&status.state);
    let rate = status.frame_rate_hz;
    let values = [
        ("state", state.clone()),
        ("frames", status.frames.to_string()),
        ("frames_damaged", status.frames_damaged.to_string()),
        ("frames_dropped", status.frames_dropped.to_string()),
        ("bytes_skipped", status.bytes_skipped.to_string()),
        (
            "frame_rate_hz",
            rate.map_or_else(String::new, |hz| format!("{hz:.3}")),
        ),
    ];
    DiagnosticStatus {
        level,
        name: format!("hardnessd: {}", status.sensor),
        message: match (&status.reason, &status.detail) {
            (Some(reason), Some(detail)) => format!("{reason}: {detail}"),
            (reason, _) => reason.clone().unwrap_or(state),
        },
        hardware_id: robot.to_owned(),
        values: values.map(|(key, value)| KeyValue { key, value }).into(),
    }
}

/// The frame as a colour picture. A taxel with `most_n` newtons is the brightest.
pub fn picture(frame: &FrameEvent, most_n: f32) -> Vec<u8> {
    let pixels = frame.newtons.iter().flat_map(|n| viridis(n / most_n));
    to_cdr(&ImageMessage {
        header: Header::new(frame.time, &frame.sensor),
        height: frame.rows as u32,
        width: frame.cols as u32,
        encoding: "rgb8",
        is_bigendian: 0,
        step: 3 * frame.cols as u32,
        data: Blob::from(pixels.collect::<Vec<u8>>()),
    })
}

impl PointStamped {
    /// The moment of the position, and its millimetres along z. `None` if the stamp is not a valid
    /// time.
    pub fn position(&self) -> Option<(Timestamp, f64)> {
        Some((self.header.time()?, self.point.z * 1e3))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sensor_that_is_not_live_is_no_good_news() {
        let status = |state, reason: Option<&str>| Status {
            seq: None,
            sensor: "forearm".to_owned(),
            time: Timestamp::UNIX_EPOCH,
            state,
            reason: reason.map(str::to_owned),
            detail: None,
            frames: 7,
            frames_damaged: 1,
            frames_dropped: 0,
            bytes_skipped: 2,
            frame_rate_hz: Some(20.0),
        };
        for (state, reason, level, message) in [
            (LinkState::Live, None, OK, "live"),
            (
                LinkState::Live,
                Some("tare: contact"),
                WARN,
                "tare: contact",
            ),
            (LinkState::Connecting, None, WARN, "connecting"),
            (LinkState::Stale, None, ERROR, "stale"),
            (LinkState::Lost, Some("unplugged"), ERROR, "unplugged"),
        ] {
            let found = diagnostic("arm-7", &status(state, reason));
            assert_eq!((found.level, found.message.as_str()), (level, message));
            assert_eq!(found.name, "hardnessd: forearm");
        }
    }
}
