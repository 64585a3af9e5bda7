//! Notices a sensor that sends frames at another rate than its configuration says.
//!
//! In: the moments at which frames arrive. Out: the rate, once, if it differs much. A wrong rate makes the
//! sensor stale too early or too late, and the time of a press wrong for a model of whole presses.

use std::time::Duration;

/// The number of frames over which a rate is measured.
const FRAMES: u32 = 64;
/// A longer pause is no part of the rate: some sensors send nothing while nothing touches them.
const PAUSE: Duration = Duration::from_secs(1);
/// Rates that differ by this factor or more are different.
const FACTOR: f64 = 1.5;

/// The frame rate of one sensor, as it is measured.
#[derive(Debug, Default)]
pub(super) struct FrameRate {
    last: Option<Duration>,
    frames: u32,
    span: Duration,
    is_reported: bool,
}

impl FrameRate {
    /// Takes in `frames` frames that arrived at `now`. Returns the measured rate in frames/s if it is
    /// not `configured_hz`, the first time only.
    pub(super) fn differs(
        &mut self,
        frames: u32,
        now: Duration,
        configured_hz: f64,
    ) -> Option<f64> {
        if self.is_reported || frames == 0 {
            return None;
        }
        let pause = self.last.replace(now).map(|last| now.saturating_sub(last));
        match pause {
            Some(pause) if pause <= PAUSE => {
                self.frames += frames;
                self.span += pause;
            }
            _ => {}
        }
        if self.frames < FRAMES {
            return None;
        }
        let measured_hz = f64::from(self.frames) / self.span.as_secs_f64();
        (self.frames, self.span) = (0, Duration::ZERO);
        let ratio = measured_hz / configured_hz;
        self.is_reported = !(1.0 / FACTOR..FACTOR).contains(&ratio);
        self.is_reported.then_some(measured_hz)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The rates that are reported while 500 frames come at `real_hz`, `at_once` at a time, with a pause of
    /// 5 s after every 20.
    fn reported(real_hz: f64, at_once: u32, configured_hz: f64) -> Vec<f64> {
        let mut frame_rate = FrameRate::default();
        let mut now = Duration::ZERO;
        let chunks = (0..500 / at_once).filter_map(|number| {
            now += Duration::from_secs_f64(f64::from(at_once) / real_hz);
            if number % 20 == 0 {
                now += Duration::from_secs(5);
            }
            frame_rate.differs(at_once, now, configured_hz)
        });
        chunks.collect()
    }

    #[test]
    fn another_rate_is_told_once_and_a_pause_is_no_rate() {
        for (real_hz, at_once) in [(5.0, 1), (20.0, 1), (20.0, 4), (100.0, 1), (100.0, 2)] {
            assert!(reported(real_hz, at_once, real_hz).is_empty(), "{real_hz}");
            assert!(
                reported(real_hz, at_once, 1.3 * real_hz).is_empty(),
                "{real_hz}"
            );
            for configured_hz in [0.5 * real_hz, 4.0 * real_hz] {
                let reported = reported(real_hz, at_once, configured_hz);
                assert_eq!(reported.len(), 1, "{real_hz} for {configured_hz}");
                assert!((reported[0] / real_hz - 1.0).abs() < 0.01, "{reported:?}");
            }
        }
    }
}
