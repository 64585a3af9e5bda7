//! What a robot may tell of its arm while a network learns whole presses.

use serde::{Deserialize, Serialize};

use super::bounds::{SettingsError, check};

/// Errors of what the arm tells, drawn for each press: a network that was only ever told the truth believes
/// everything. And how else a press may differ from that of the data.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Told {
    /// Share of presses of which nothing is known of the arm.
    pub unknown: f64,
    /// Share of the others of which the stiffness is not known.
    pub unknown_arm: f64,
    /// Share of the others that are told without an error.
    pub exact: f64,
    /// Positions are off by up to this part.
    pub position: f64,
    /// The stiffness is off by up to this part.
    pub arm: f64,
    /// The moments are off by up to so many frames.
    pub clock_frames: f64,
    /// Share of presses that are judged before their end.
    pub early: f64,
    /// Share of presses that a slower sensor sees: every second to eighth frame of them.
    pub slower: f64,
}

impl Default for Told {
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

impl Told {
    /// A robot that always moves alike and tells nothing: time then stands for the way.
    pub const ONE_ROBOT: Self = Self {
        unknown: 1.0,
        unknown_arm: 0.0,
        exact: 1.0,
        position: 0.0,
        arm: 0.0,
        clock_frames: 0.0,
        early: 0.25,
        slower: 0.0,
    };

    /// Refuses what lies outside its range.
    pub(super) fn check(&self) -> Result<(), SettingsError> {
        let check = |key, found: f64, fits, expected| check("told.", key, found, fits, expected);
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
