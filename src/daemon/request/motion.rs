//! Positions of the arm that a controller reports: from a line of the control socket to points on
//! the clock of the frames.

use jiff::Timestamp;
use serde::Deserialize;

use hardnessd_core::frame::Stamp;
use hardnessd_core::motion::{FURTHEST_MM, HELD, Point};

/// The most points in a line.
const MOST_POINTS: usize = 256;
/// A point may be this far ahead of this machine's clock, because clocks of two machines differ a
/// little.
const AHEAD_NS: i128 = 1_000_000_000;

/// Positions of the arm of a sensor, as they were reported.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Positions {
    pub(crate) sensor: String,
    #[serde(rename = "at")]
    pub(crate) points: Vec<ReportedPoint>,
}

/// A point as it was reported: its time, and its millimetres.
pub(crate) type ReportedPoint = (ReportedTime, f64);

/// The time of a point, by one of two clocks.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(
    untagged,
    expecting = "expected nanoseconds of CLOCK_MONOTONIC, or an RFC 3339 time"
)]
pub(crate) enum ReportedTime {
    /// CLOCK_MONOTONIC of this machine, in nanoseconds.
    Mono(i64),
    /// The same from a language that writes large numbers as 1.2e15.
    Rounded(f64),
    /// Calendar time.
    Wall(Timestamp),
}

/// The points on CLOCK_MONOTONIC. `now` is the current time of both clocks.
///
/// # Errors
///
/// Fails if there are no points or more than [`MOST_POINTS`], or if a point is too far from zero,
/// more than [`AHEAD_NS`] ahead of `now`, or older than [`HELD`].
pub(crate) fn placed(reported: &[ReportedPoint], now: Stamp) -> Result<Vec<Point>, String> {
    if !(1..=MOST_POINTS).contains(&reported.len()) {
        let found = reported.len();
        return Err(format!(
            "motion.at: found {found} points, expected 1 to {MOST_POINTS}"
        ));
    }
    let mono_now = now.mono.as_nanos() as i128;
    let point = |(index, &(at, mm)): (usize, &ReportedPoint)| {
        if mm.is_nan() || mm.abs() > FURTHEST_MM {
            let expected = format!("expected at most {FURTHEST_MM} from zero");
            return Err(format!("motion.at[{index}]: found {mm:?} mm, {expected}"));
        }
        let away = match at {
            // The conversion ends at the bounds of `i64`, which are away from any moment.
            ReportedTime::Rounded(at) => i128::from(at as i64) - mono_now,
            ReportedTime::Mono(at) => i128::from(at) - mono_now,
            ReportedTime::Wall(at) => at.as_nanosecond() - now.wall.as_nanosecond(),
        };
        let is_near = (-(HELD.as_nanos() as i128)..=AHEAD_NS).contains(&away);
        match i64::try_from(mono_now + away) {
            Ok(at_ns) if is_near => Ok(Point { at_ns, mm }),
            _ => Err(format!(
                "motion.at[{index}]: found a moment {} s {}, expected one of the last {} s by this \
                 machine's CLOCK_MONOTONIC, or an RFC 3339 time",
                (away / 1_000_000).unsigned_abs() as f64 / 1e3,
                if away > 0 { "ahead" } else { "ago" },
                HELD.as_secs()
            )),
        }
    };
    reported.iter().enumerate().map(point).collect()
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use serde_json::{Value, json};

    use super::*;

    fn now() -> Stamp {
        Stamp {
            mono: Duration::from_secs(500),
            wall: "2026-11-21T10:00:00Z".parse().unwrap(),
        }
    }

    fn points(at: Value) -> Result<Vec<ReportedPoint>, String> {
        serde_json::from_value(at).map_err(|error| error.to_string())
    }

    fn place(at: Value) -> Result<Vec<(i64, f64)>, String> {
        let placed = placed(&points(at)?, now())?;
        Ok(placed.into_iter().map(Into::into).collect())
    }

    #[test]
    fn points_by_both_clocks_become_moments_of_this_machine() {
        let ns = 499_999_000_000_u64;
        let placed = place(json!([
            [ns, 3.5],
            [5e11, -1],
            ["2026-11-21T11:00:00.25+01:00", 4]
        ]));
        let expected = [(499_999_000_000, 3.5), (500_000_000_000, -1.0)];
        assert_eq!(placed.as_ref().unwrap()[..2], expected);
        assert_eq!(placed.unwrap()[2], (500_250_000_000, 4.0));
    }

    #[test]
    fn what_is_no_point_says_which_and_why() {
        let many = vec![json!([5e11, 2]); 257];
        let error = place(json!(many)).unwrap_err();
        assert!(error.starts_with("motion.at: found 257 points"), "{error}");
        // Points, and what is said of them.
        let cases = r#"
            "here" | invalid type: string "here", expected a sequence
            [] | motion.at: found 0 points
            [[7]] | invalid length 1, expected a tuple of size 2
            [[5e11, 1], ["soon", 1]] | expected nanoseconds of CLOCK_MONOTONIC, or an RFC 3339 time
            [[5e11, 1], [-7, 1]] | motion.at[1]: found a moment 500 s ago
            [[5e11, 1], [5e11, "1"]] | invalid type: string "1", expected f64
            [[5e11, 1], [5e11, 2e6]] | motion.at[1]: found 2000000.0 mm, expected at most 1000000
            [[5e11, 1], [501500000000, 1]] | motion.at[1]: found a moment 1.5 s ahead, expected one of the last 60 s by
            [["2030-01-01T00:00:00Z", 1]] | motion.at[0]: found a moment 98200800 s ahead
            [[18446744073709551615, 1]] | motion.at[0]: found a moment"#;
        for case in cases.trim().lines() {
            let (at, expected) = case.trim().split_once(" | ").unwrap();
            let at = serde_json::from_str(at).unwrap();
            let error = place(at).unwrap_err();
            assert!(error.starts_with(expected), "{error}\n{expected}");
        }
    }
}
