//! Errors in a robot's reports about its arm while a network learns whole presses.

use serde::{Deserialize, Serialize};

use super::bounds::{SettingsError, check};

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
        }
    }
}

impl ArmReports {
    /// Returns an error if a value lies outside its range.
    pub(super) fn check(&self) -> Result<(), SettingsError> {
        let check = |key, found: f64, fits, expected| check("reports.", key, found, fits, expected);
        let shares = [
            ("unknown", self.unknown),
            ("unknown_arm", self.unknown_arm),
            ("exact", self.exact),
            ("early", self.early),
            ("slower", self.slower),
        ];
        for (key, share) in shares {
            check(key, share, (0.0..=1.0).contains(&share), "0 to 1")?;
        }
        let fits = (0.0..=0.5).contains(&self.position);
        check("position", self.position, fits, "0 to 0.5")?;
        check("arm", self.arm, (0.0..=0.9).contains(&self.arm), "0 to 0.9")?;
        let frames = self.clock_frames;
        check(
            "clock_frames",
            frames,
            (0.0..=5.0).contains(&frames),
            "0 to 5",
        )
    }
}
