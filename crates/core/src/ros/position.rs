//! The position of an arm, from a robot with ROS.
//!
//! In: the bytes of a message. Out: the position. ROS defines the message; DDS needs only its name.

use jiff::Timestamp;
use serde::Deserialize;

use super::{Header, Topic};

/// The position of the arm, from the robot. The configuration names the topic. It is never recorded, so its
/// definition is not needed.
pub const POSITION: Topic = Topic {
    name: "",
    schema: "geometry_msgs/msg/PointStamped",
    definition: "",
};

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

impl PointStamped {
    /// The moment of the position, and its millimetres along z. `None` if the stamp is not a valid
    /// time.
    pub fn position(&self) -> Option<(Timestamp, f64)> {
        Some((self.header.time()?, self.point.z * 1e3))
    }
}
