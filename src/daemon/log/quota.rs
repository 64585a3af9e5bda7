//! How many lines the log gets about one sensor, or of another cause outside: fewer than 50 in a minute.

use std::time::Duration;

use hardnessd_core::allowance::Allowance;

/// The time that a line takes up: 40 lines a minute. That is a press every 1.5 s.
const LINE: Duration = Duration::from_millis(1500);
/// Eight lines may come at once.
const AT_ONCE: Duration = Duration::from_millis(7 * 1500);
/// How often the number of missing lines is logged.
const REPORT_EVERY: Duration = Duration::from_secs(60);

/// The lines of one cause in the log.
#[derive(Debug, Default)]
pub(super) struct LineQuota {
    allowance: Allowance,
    /// The number of lines that were left out and not reported yet, and when the first one was.
    left_out: Option<(u64, Duration)>,
}

impl LineQuota {
    /// Whether a line may be written. If so, returns how many were left out before and are to be reported.
    pub(super) fn allows(&mut self, now: Duration) -> Option<u64> {
        if !self.allowance.allows(now, LINE, AT_ONCE) {
            self.left_out.get_or_insert((0, now)).0 += 1;
            return None;
        }
        let is_due =
            |left_out: &mut (u64, Duration)| now.saturating_sub(left_out.1) >= REPORT_EVERY;
        Some(self.left_out.take_if(is_due).map_or(0, |(lines, _)| lines))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sensor_has_fewer_than_50_lines_in_any_minute() {
        let mut quota = LineQuota::default();
        let moments = (0..300_000).step_by(10);
        let is_written = |ms: &u64| quota.allows(Duration::from_millis(*ms)).is_some();
        let written: Vec<u64> = moments.filter(is_written).collect();
        for begin in &written {
            let minute = *begin..begin + 60_000;
            let lines = written.iter().filter(|at| minute.contains(at)).count();
            // One more may report those that were left out.
            assert!(lines + 1 < 50, "{lines} from {begin} ms on");
        }
        assert!(written.len() > 200);
    }
}
