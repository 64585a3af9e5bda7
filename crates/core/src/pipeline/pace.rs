//! How many frames of a sensor are taken: at most twice as many as its configuration says.
//!
//! A sensor that sends more takes time from the others, fills the log and makes subscribers lose
//! events of the others. After a pause, the frames that waited come all at once. So frames are counted
//! against the time that they took.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::allowance::Allowance;

/// Frames are taken at up to this many times the configured rate.
const MOST: u32 = 2;
/// As many frames may come at once as the highest rate has in this time: those of a stall of twice this
/// time.
const AT_ONCE: Duration = Duration::from_secs(5);
/// So long after the last dropped frame, the sensor is no longer said to be too fast.
const SAID_FOR: Duration = Duration::from_secs(10);

/// The frames of one sensor, against the time.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Pace {
    allowance: Allowance,
    /// The number of dropped frames since the start.
    pub(super) dropped: u64,
    /// When the last frame was dropped, if the sensor is still said to be too fast.
    last_dropped: Option<Duration>,
    /// When bytes were skipped last, if that is still said.
    last_skipped: Option<Duration>,
}

impl Pace {
    /// Whether a frame that came at `at` is taken. A dropped frame is counted.
    pub(super) fn takes(&mut self, at: Duration, period: Duration) -> bool {
        if !self.allowance.allows(at, period / MOST, AT_ONCE) {
            self.dropped += 1;
            self.last_dropped = Some(at);
            return false;
        }
        for last in [&mut self.last_dropped, &mut self.last_skipped] {
            *last = last.filter(|&last| at.saturating_sub(last) < SAID_FOR);
        }
        true
    }

    /// Bytes of the port were skipped at `at`.
    pub(super) fn skipped(&mut self, at: Duration) {
        self.last_skipped = Some(at);
    }

    /// Why frames are missing, if some were dropped or bytes were skipped within the last seconds.
    pub(super) fn reason(&self, frame_rate_hz: f64) -> Option<String> {
        let most_hz = f64::from(MOST) * frame_rate_hz;
        let dropped = |_| format!("frames above {most_hz} Hz are dropped");
        let skipped = |_| "more bytes come than are read: some are skipped".to_owned();
        let dropped = self.last_dropped.map(dropped);
        dropped.or_else(|| self.last_skipped.map(skipped))
    }
}
