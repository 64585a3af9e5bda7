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
    #[serde(default)]
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

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Duration = Duration::from_millis(20);

    /// The number of frames taken of those that come at `rate_hz` for `seconds`, after `start`.
    fn taken(pace: &mut Pace, start: Duration, rate_hz: u32, seconds: u32) -> u32 {
        let at = |number| start + Duration::from_secs(1) * number / rate_hz;
        let frames = (0..rate_hz * seconds).filter(|&number| pace.takes(at(number), PERIOD));
        frames.count() as u32
    }

    #[test]
    fn a_sensor_at_its_rate_or_twice_loses_nothing_and_a_flood_gets_twice_the_rate() {
        let start = Duration::from_secs(1_000);
        for rate_hz in [1, 50, 100] {
            let mut pace = Pace::default();
            assert_eq!(taken(&mut pace, start, rate_hz, 60), rate_hz * 60);
            assert_eq!((pace.dropped, pace.reason(50.0)), (0, None));
        }
        let mut pace = Pace::default();
        let most = taken(&mut pace, start, 5_000, 60);
        // What may come at once is extra.
        assert!((6_500..6_505).contains(&most), "{most}");
        assert_eq!(pace.dropped, 300_000 - u64::from(most));
        let reason = "frames above 100 Hz are dropped".to_owned();
        assert_eq!(pace.reason(50.0), Some(reason.clone()));
        // It is said for a while.
        let end = start + Duration::from_secs(60);
        taken(&mut pace, end, 50, 9);
        assert_eq!(pace.reason(50.0), Some(reason));
        taken(&mut pace, end + Duration::from_secs(9), 50, 2);
        assert_eq!(pace.reason(50.0), None);
    }

    #[test]
    fn all_frames_of_a_stall_are_taken_at_once() {
        let start = Duration::from_secs(1_000);
        let mut pace = Pace::default();
        assert_eq!(taken(&mut pace, start, 50, 60), 3_000);
        let after = start + Duration::from_secs(70);
        assert!((0..10 * 50).all(|_| pace.takes(after, PERIOD)));
    }
}
