//! How many lines of one sensor the log gets, or of all that is no sensor: fewer than 50 in a minute.

use std::time::Duration;

use crate::daemon::log;
use hardnessd_core::allowance::Allowance;

/// The time that a line takes up: 40 lines a minute. That is a press every 1.5 s.
const LINE: Duration = Duration::from_millis(1500);
/// Eight lines may come at once.
const AT_ONCE: Duration = Duration::from_millis(7 * 1500);
/// How often the number of missing lines is logged.
const REPORT_EVERY: Duration = Duration::from_secs(60);

/// The lines of one sensor in the log.
#[derive(Debug, Default)]
pub(in crate::daemon) struct LineQuota {
    allowance: Allowance,
    /// The number of lines that were left out and not reported yet, and when the first one was.
    left_out: Option<(u64, Duration)>,
}

impl LineQuota {
    /// Writes a line of `sensor`, unless there were too many. A line that is only for the level `debug`
    /// does not count.
    pub(in crate::daemon) fn write(
        &mut self,
        sensor: &str,
        now: Duration,
        is_routine: bool,
        line: impl FnOnce(),
    ) {
        if is_routine {
            line();
            return;
        }
        if !self.allowance.allows(now, LINE, AT_ONCE) {
            self.left_out.get_or_insert((0, now)).0 += 1;
            return;
        }
        if let Some((lines, since)) = self.left_out
            && now.saturating_sub(since) >= REPORT_EVERY
        {
            self.left_out = None;
            log::left_out(sensor, lines);
        }
        line();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sensor_has_fewer_than_50_lines_in_any_minute() {
        let mut quota = LineQuota::default();
        let mut written: Vec<u64> = Vec::new();
        for ms in (0..300_000).step_by(10) {
            let line = || written.push(ms);
            quota.write("forearm", Duration::from_millis(ms), false, line);
        }
        for begin in &written {
            let minute = *begin..begin + 60_000;
            let lines = written.iter().filter(|at| minute.contains(at)).count();
            // One more may report those that were left out.
            assert!(lines + 1 < 50, "{lines} from {begin} ms on");
        }
        assert!(written.len() > 200);
    }
}
