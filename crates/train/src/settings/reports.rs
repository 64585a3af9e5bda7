//! Errors in a robot's reports about its arm while a network learns whole presses.

use serde::{Deserialize, Serialize};

/// Errors in the reports about the arm, and other changes to a press, drawn anew for each press. A
/// network that has only learnt from correct reports trusts every report.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ArmReports {
    /// Share of the presses for which nothing is known about the arm.
    pub unknown: f64,
    /// Share of the other presses for which the stiffness is unknown.
    pub unknown_arm: f64,
    /// Share of the other presses whose reports have no error.
    pub exact: f64,
    /// The largest relative error of the positions.
    pub position: f64,
    /// The largest relative error of the stiffness.
    pub arm: f64,
    /// The largest error of the moments, in frames.
    pub clock_frames: f64,
    /// Share of the presses that are judged before their end.
    pub early: f64,
    /// Share of the presses that a slower sensor sees, with only every second to eighth frame.
    pub slower: f64,
    /// Share of the presses that take half to sixteen times as long.
    pub stretched: f64,
}

impl Default for ArmReports {
    fn default() -> Self {
        Self {
            unknown: 0.3,
            unknown_arm: 0.1,
            exact: 0.5,
            position: 0.1,
            arm: 0.3,
            clock_frames: 1.0,
            early: 0.25,
            slower: 0.3,
            stretched: 0.3,
        }
    }
}
