//! The arm's motion, and its position at any time of a press.

/// The arm that presses.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Arm {
    /// Stiffness of everything behind the sensor.
    pub(super) n_per_mm: f64,
    pub(super) speed_mm_s: f64,
}

/// Stiffness of the arm in a sequence.
pub const ARM_N_PER_MM: f64 = 10.0;

impl Default for Arm {
    /// The stiffness is an assumption, the speed is the paper's.
    fn default() -> Self {
        Self {
            n_per_mm: ARM_N_PER_MM,
            speed_mm_s: 5.0,
        }
    }
}

/// The arm's motion in one press: it approaches at a steady speed, holds its position and
/// withdraws.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Motion {
    /// How far the arm goes beyond the touch.
    pub(super) top_mm: f64,
    /// The time from the touch to the end of the approach.
    pub(super) load_s: f64,
    pub(super) hold_s: f64,
    pub(super) speed_mm_s: f64,
}

/// The arm's distance from the object before and after a press. At 5 mm/s, this distance there and
/// back takes less time than the rest between two presses.
const CLEARANCE_MM: f64 = 2.0;

impl Motion {
    /// The arm's position `time_s` after the touch (negative before it), in mm along the press's
    /// direction, 0 at the touch. This is what a robot knows of its hand. The finger tip is less
    /// deep, by the force over the arm's stiffness.
    pub fn approach_mm(&self, time_s: f64) -> f64 {
        let loading = self.top_mm + self.speed_mm_s * (time_s - self.load_s);
        let withdrawing = self.top_mm - self.speed_mm_s * (time_s - self.load_s - self.hold_s);
        loading.min(self.top_mm).min(withdrawing).max(-CLEARANCE_MM)
    }
}

/// The arm's motion in a sequence of presses, around the last press and the next.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Approach {
    /// The time of the last press's touch, and the arm's motion in that press.
    pub(super) last: Option<(f64, Motion)>,
    /// The time of the next press's touch.
    pub(super) next_s: Option<f64>,
}

impl Approach {
    /// The arm's position `time_s` after the sequence's first frame, in mm as in
    /// [`Motion::approach_mm`]. Any time near this value's frame is valid, because a robot sends
    /// its positions at times of its own.
    pub fn mm(&self, time_s: f64) -> f64 {
        let last = self.last.map_or(-CLEARANCE_MM, |(touch_s, motion)| {
            motion.approach_mm(time_s - touch_s)
        });
        let next = self.next_s.map_or(-CLEARANCE_MM, |touch_s| {
            (Arm::default().speed_mm_s * (time_s - touch_s)).min(0.0)
        });
        last.max(next)
    }
}
