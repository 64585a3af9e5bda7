//! The frames of a press, and how far the arm went at each.

use std::time::Duration;

use crate::event::{ApproachSource, Phase};
use crate::line::Sums;
use crate::motion::{self, SPEEDS_MM_S, Track};
use crate::press::{ContactFrame, Phases, SoFar, thinned};
use crate::verdict::parts::parts;
use crate::verdict::{self, COURSE_FRAMES, Resampling};

/// The slope is fitted from this share of loading's last force on, so that it is the slope of the
/// deepest part.
const END_SHARE: f64 = 0.5;
/// The slope is fitted to at least this many frames, if there are that many.
const END_FRAMES: usize = 3;
/// If indentations have a smaller spread (their standard deviation, mm), their slope would be
/// noise.
const LEAST_SPREAD_MM: f64 = 0.005;

/// A press, with the approach at each of its frames.
pub(super) struct PressWithApproach<'a> {
    pub(super) frames: Vec<&'a ContactFrame>,
    /// The place of the best frame.
    best: usize,
    /// The approach at each frame where it is known.
    approach_mm: Vec<Option<f64>>,
    /// The source of the approach.
    pub(super) source: ApproachSource,
}

impl<'a> PressWithApproach<'a> {
    /// A press up to now. The arm sends positions, which `track` holds, or moves at `speed_mm_s`.
    pub(super) fn new(
        press: &'a SoFar,
        phase: Phase,
        track: &Track,
        delay_ms: f64,
        speed_mm_s: Option<f64>,
    ) -> Self {
        let (frames, best) = press.until(Duration::MAX);
        let mut known = Self {
            approach_mm: vec![None; frames.len()],
            frames,
            best,
            source: ApproachSource::None,
        };
        let moments = known.moments();
        let (begin, last) = (moments[0], moments[moments.len() - 1]);
        if track.has_recent(last, delay_ms) {
            if let Some(approach_mm) = track.approach(begin, &moments, delay_ms) {
                known.approach_mm = approach_mm;
                known.source = ApproachSource::Positions;
            }
            // The latest positions may still be on their way. The final verdict does not wait for
            // them.
            return match phase {
                Phase::Early => known.cut(press),
                Phase::Final => known.or_nothing(),
            };
        }
        if let Some(speed_mm_s) = speed_mm_s {
            known.approach_mm = approach_by_speed(speed_mm_s, &moments, &known.forces_n());
            known.source = ApproachSource::Speed;
        }
        known.or_nothing()
    }

    /// The best frame.
    pub(super) fn best(&self) -> &'a ContactFrame {
        self.frames[self.best]
    }

    fn moments(&self) -> Vec<Duration> {
        let moments = self.frames.iter().map(|frame| frame.moment.stamp.mono);
        moments.collect()
    }

    fn forces_n(&self) -> Vec<f64> {
        self.frames.iter().map(|frame| frame.force_n).collect()
    }

    /// Forgets an approach that says nothing.
    fn or_nothing(mut self) -> Self {
        if !is_informative(&self.approach_mm, self.best) {
            self.approach_mm.fill(None);
            self.source = ApproachSource::None;
        }
        self
    }

    /// Leaves out the frames after the last one whose approach is known.
    fn cut(self, so_far: &'a SoFar) -> Self {
        let Some(last) = self.approach_mm.iter().rposition(Option::is_some) else {
            return self;
        };
        let (frames, best) = so_far.until(self.frames[last].moment.stamp.mono);
        let mut approach_mm = self.approach_mm;
        approach_mm.truncate(frames.len());
        Self {
            frames,
            best,
            approach_mm,
            source: self.source,
        }
    }

    /// The course for a model of `most` frames.
    pub(super) fn course(
        &self,
        arm_n_per_mm: Option<f64>,
        most: usize,
        resampling: &Resampling,
    ) -> verdict::TimeSeries {
        let begin = self.frames[0].moment.stamp.mono;
        let moment = |place: usize| {
            let frame = self.frames[place];
            let since = frame.moment.stamp.mono.saturating_sub(begin);
            verdict::Sample {
                time_s: since.as_secs_f32(),
                approach_mm: self.approach_mm[place].map(|mm| mm as f32),
                frame: resampling.apply(&frame.frame),
            }
        };
        let places = thinned(self.frames.len(), self.best, most);
        let is_known = self.source != ApproachSource::None;
        verdict::TimeSeries {
            moments: places.into_iter().map(moment).collect(),
            arm_n_per_mm: arm_n_per_mm.filter(|_| is_known).unwrap_or(0.0) as f32,
        }
    }

    /// The press on the array's own grid, for a model of parts: of the frames that a model of courses
    /// would get.
    pub(super) fn parts(&self) -> Vec<f32> {
        let begin = self.frames[0].moment.stamp.mono;
        let places = thinned(self.frames.len(), self.best, COURSE_FRAMES.1);
        let moment = |place: usize| {
            let frame = self.frames[place];
            let since = frame.moment.stamp.mono.saturating_sub(begin);
            (since.as_secs_f32(), &frame.frame.newtons[..])
        };
        parts(&places.into_iter().map(moment).collect::<Vec<_>>())
    }

    /// The slope of force against indentation at the end of loading, in N/mm, by least squares.
    pub(super) fn stiffness_n_per_mm(&self, arm_n_per_mm: Option<f64>) -> Option<f64> {
        let arm_n_per_mm = arm_n_per_mm?;
        let Phases { loaded, .. } = Phases::of(&self.forces_n());
        let enough = END_SHARE * self.frames[loaded].force_n;
        let steep = self.frames[..=loaded]
            .iter()
            .rposition(|f| f.force_n < enough);
        let first = steep.map_or(0, |below| below + 1);
        let first = first.min((loaded + 1).saturating_sub(END_FRAMES));
        let end = (first..=loaded).filter_map(|place| {
            let force_n = self.frames[place].force_n;
            let indentation_mm = self.approach_mm[place]? - force_n / arm_n_per_mm;
            Some((indentation_mm, force_n))
        });
        slope(&end.collect::<Vec<_>>())
    }
}

/// Whether an approach is known at two frames up to the best one, or up to the second frame if the
/// first is the best. It is 0 at the first frame, so it says nothing if it is known there alone.
pub fn is_informative(approach_mm: &[Option<f64>], best: usize) -> bool {
    let places = best.max(1) + 1;
    approach_mm.iter().take(places).flatten().count() >= 2
}

/// The approach at each frame of a press by an arm that moves at a steady speed and then holds its
/// position. The frames came at `moments` and have these forces; there must be at least one.
pub fn approach_by_speed(
    speed_mm_s: f64,
    moments: &[Duration],
    forces_n: &[f64],
) -> Vec<Option<f64>> {
    let Phases { loaded, held, .. } = Phases::of(forces_n);
    let (begin, stop) = (moments[0], moments[loaded]);
    let approach = |(place, moment): (usize, &Duration)| {
        let moved = (*moment).min(stop).saturating_sub(begin);
        (place <= held).then_some(speed_mm_s * moved.as_secs_f64())
    };
    moments.iter().enumerate().map(approach).collect()
}

/// The speed of a steady approach: from the controller's context, or else from the configuration.
pub fn approach_speed_mm_s(
    context: Option<&serde_json::Value>,
    arm: &motion::Settings,
) -> Option<f64> {
    let stated = context.and_then(|context| context.get("speed_mm_s")?.as_f64());
    let (least, most) = SPEEDS_MM_S;
    stated
        .or(arm.speed_mm_s)
        .filter(|speed| (least..=most).contains(speed))
}

/// The slope of the least-squares line through the points. `None` if they hardly differ in x, or if
/// the line does not rise.
fn slope(points: &[(f64, f64)]) -> Option<f64> {
    let Sums { count, xx, xy, .. } = Sums::of(points);
    let slope = xy / xx;
    let is_spread = points.len() > 1 && (xx / count).sqrt() >= LEAST_SPREAD_MM;
    (is_spread && slope.is_finite() && slope > 0.0).then_some(slope)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slope_is_that_of_the_line_or_none() {
        let points = [(0.0, 1.0), (0.1, 1.5), (0.2, 2.0)];
        assert!((slope(&points).unwrap() - 5.0).abs() < 1e-9);
        for points in [
            &points[..1],
            &[],
            &[(0.0, 1.0), (0.004, 1.5)],
            &[(0.0, 2.0), (0.1, 1.0)],
        ] {
            assert_eq!(slope(points), None, "{points:?}");
        }
    }
}
