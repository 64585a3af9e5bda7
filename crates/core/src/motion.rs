//! The positions of a robot's arm, and how far the arm went during a press.
//!
//! In: [`Point`]s, and the moments of a press's frames. Out: how far the arm went since the press
//! began, or nothing if that is uncertain. This module never guesses: it interpolates between two
//! points, but never extrapolates. It reads no clock.

mod settings;

use std::collections::VecDeque;
use std::time::Duration;

use serde::{Deserialize, Serialize};

pub use self::settings::{SPEEDS_MM_S, Settings};

/// The position of the arm at one moment.
///
/// [`Track`] has an example.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(into = "(i64, f64)", from = "(i64, f64)")]
pub struct Point {
    /// The time by CLOCK_MONOTONIC, in nanoseconds. In a recording without times it counts from the
    /// first frame and may be negative.
    pub at_ns: i64,
    /// The position along the press's direction, which grows towards the object. Its zero is
    /// arbitrary.
    pub mm: f64,
}

impl From<Point> for (i64, f64) {
    fn from(point: Point) -> Self {
        (point.at_ns, point.mm)
    }
}

impl From<(i64, f64)> for Point {
    fn from((at_ns, mm): (i64, f64)) -> Self {
        Self { at_ns, mm }
    }
}

/// How long points are held after they arrive.
pub const HELD: Duration = Duration::from_secs(60);
/// The longest time between two points. In a longer gap, the position of the arm is unknown.
pub const LONGEST_GAP: Duration = Duration::from_millis(250);
/// The longest way between two points. If two points are further apart, one of them is wrong.
pub const LONGEST_JUMP_MM: f64 = 20.0;
/// The largest distance of a position from its zero.
pub const FURTHEST_MM: f64 = 1e6;
/// The most points that are held: a little over a minute at 1000 points a second.
const MOST_POINTS: usize = 1 << 16;

const HELD_NS: i64 = HELD.as_nanos() as i64;
const LONGEST_GAP_NS: i64 = LONGEST_GAP.as_nanos() as i64;

/// The error of a point that is not later than the point before it.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error(
    "found a step of {back_ms} ms back in time, expected points in order: the approach is unknown \
     for the press it falls in"
)]
pub struct StepBack {
    /// The index of the point.
    pub index: usize,
    /// How far the point goes back in time.
    pub back_ms: f64,
}

/// The positions of one sensor's arm in the last minute.
///
/// # Example
///
/// The arm moves at 5 mm/s, and a press begins at 2 s.
///
/// ```
/// use std::time::Duration;
///
/// use hardnessd_core::motion::{Point, Track};
///
/// let mut track = Track::default();
/// for step in 0..40 {
///     let at_ns = 1_000_000_000 + step * 100_000_000;
///     track.push(&[Point { at_ns, mm: 30.0 + 0.5 * step as f64 }])?;
/// }
/// let begin = Duration::from_secs(2);
/// let frames = [begin, Duration::from_millis(2250), Duration::from_secs(6)];
/// let no_delay = 0.0;
/// let approach = track.approach(begin, &frames[..2], no_delay);
/// assert_eq!(approach, Some(vec![Some(0.0), Some(1.25)]));
/// // The last position is of 4.9 s: a second later nobody knows where the arm is.
/// assert_eq!(track.approach(begin, &frames, no_delay), None);
/// # Ok::<(), hardnessd_core::motion::StepBack>(())
/// ```
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Track {
    /// The points, ascending in time.
    points: VecDeque<Point>,
    /// The number of points since the start.
    received: u64,
    /// The number of points that came after the verdict that they belong to.
    late: u64,
    /// The last moment of the last press that has a final verdict.
    judged_ns: Option<i64>,
}

impl Track {
    /// Takes in points from the robot. `points` are finite.
    ///
    /// # Errors
    ///
    /// Returns a [`StepBack`] for the first point that is not later than the point before it. All
    /// points are taken in nevertheless: after a clock was set back, points continue from there, and
    /// the earlier ones are forgotten.
    pub fn push(&mut self, points: &[Point]) -> Result<(), StepBack> {
        let mut first_back = None;
        for (index, &point) in points.iter().enumerate() {
            self.received += 1;
            self.late += u64::from(self.judged_ns.is_some_and(|judged| point.at_ns <= judged));
            if let Some(latest) = self.points.back().map(|point| point.at_ns)
                && point.at_ns <= latest
            {
                // Nobody knows which of both moments is right.
                self.points.clear();
                first_back.get_or_insert(StepBack {
                    index,
                    back_ms: (latest.saturating_sub(point.at_ns)) as f64 / 1e6,
                });
            }
            self.points.push_back(point);
            let oldest = point.at_ns.saturating_sub(HELD_NS);
            let is_old = |first: &Point| first.at_ns < oldest;
            while self.points.len() > MOST_POINTS || self.points.front().is_some_and(is_old) {
                self.points.pop_front();
            }
        }
        first_back.map_or(Ok(()), Err)
    }

    /// The number of points since the start, and the number of points that came too late.
    pub fn counts(&self) -> (u64, u64) {
        (self.received, self.late)
    }

    /// Whether the robot sends positions: whether there are any from the last minute before `now`.
    pub fn has_recent(&self, now: Duration, delay_ms: f64) -> bool {
        let oldest = of_arm(now, delay_ms).saturating_sub(HELD_NS);
        self.points.back().is_some_and(|p| p.at_ns >= oldest)
    }

    /// Remembers that a press whose last frame came at `last` has its final verdict. From now on, a
    /// position up to that moment counts as late.
    pub fn judged(&mut self, last: Duration, delay_ms: f64) {
        self.judged_ns = Some(of_arm(last, delay_ms));
    }

    /// How far the arm went from `begin` to each of `moments`, in mm. The moments are those of
    /// frames, and ascend. The arm's stamps are `delay_ms` earlier. A moment after the latest
    /// position has `None`.
    ///
    /// Returns `None` if there is a gap, a jump or a step back in time between `begin` and the
    /// last moment, or if the points do not cover `begin`.
    pub fn approach(
        &self,
        begin: Duration,
        moments: &[Duration],
        delay_ms: f64,
    ) -> Option<Vec<Option<f64>>> {
        let begin = of_arm(begin, delay_ms);
        let moments = moments.iter().map(|&moment| of_arm(moment, delay_ms));
        let last = moments.clone().next_back()?.max(begin);
        let first = self.points.partition_point(|p| p.at_ns <= begin);
        let first = first.checked_sub(1)?;
        let end = self.points.partition_point(|p| p.at_ns < last);
        let used = self.points.range(first..self.points.len().min(end + 1));
        let latest = used.clone().next_back()?.at_ns;
        let is_broken = used.clone().zip(used.clone().skip(1)).any(|(one, next)| {
            next.at_ns - one.at_ns > LONGEST_GAP_NS || (next.mm - one.mm).abs() > LONGEST_JUMP_MM
        });
        if latest < begin || last.saturating_sub(latest) > LONGEST_GAP_NS || is_broken {
            return None;
        }
        let zero = self.at(begin)?;
        Some(moments.map(|at| Some(self.at(at)? - zero)).collect())
    }

    /// How far the arm went since `begin`, by the points up to `now`. The answer lags behind `now`
    /// as positions do, by 250 ms at most. `None` if [`Self::approach`] has no answer.
    pub fn latest(&self, begin: Duration, now: Duration, delay_ms: f64) -> Option<f64> {
        let known = self.approach(begin, &[now], delay_ms)?;
        known[0].or_else(|| Some(self.points.back()?.mm - self.at(of_arm(begin, delay_ms))?))
    }

    /// The position of the arm at a point or between two points.
    fn at(&self, at_ns: i64) -> Option<f64> {
        let next = self.points.partition_point(|p| p.at_ns < at_ns);
        let next = self.points.get(next).map(|point| (next, point))?;
        if next.1.at_ns == at_ns {
            return Some(next.1.mm);
        }
        let before = self.points.get(next.0.checked_sub(1)?)?;
        let part = (at_ns - before.at_ns) as f64 / (next.1.at_ns - before.at_ns) as f64;
        Some(before.mm + part * (next.1.mm - before.mm))
    }

    /// The points that presses from `since` on need. A recording holds no more.
    #[must_use]
    pub fn since(&self, since: Duration) -> Vec<Point> {
        let since = of_arm(since, settings::DELAYS_MS.1);
        let first = self.points.partition_point(|p| p.at_ns <= since);
        // Keep the newest point, however old it is: it shows that the robot sends positions.
        let first = first
            .saturating_sub(1)
            .min(self.points.len().saturating_sub(1));
        self.points.range(first..).copied().collect()
    }
}

/// The furthest moment from zero. With it, the difference of two moments fits an i64.
const FURTHEST_NS: i64 = i64::MAX / 4;

impl Point {
    /// Whether the moment and the position are within their bounds.
    pub fn is_usable(&self) -> bool {
        (-FURTHEST_NS..=FURTHEST_NS).contains(&self.at_ns) && self.mm.abs() <= FURTHEST_MM
    }
}

/// The moment of a frame on the clock of the arm's stamps.
fn of_arm(frame: Duration, delay_ms: f64) -> i64 {
    let frame = i64::try_from(frame.as_nanos()).unwrap_or(FURTHEST_NS);
    frame.min(FURTHEST_NS) - (delay_ms * 1e6).round() as i64
}

#[cfg(test)]
mod tests;
