//! The frames of a press, and how far the arm went at each.

use std::sync::Arc;
use std::time::Duration;

use crate::event::{ApproachSource, Phase};
use crate::frame::{Frame, Pitch};
use crate::line::Sums;
use crate::motion::{self, SPEEDS_MM_S, Track};
use crate::press::{ContactFrame, Phases, SoFar, thinned};
use crate::sensor::Sensor;
use crate::verdict::parts::parts;
use crate::verdict::{Moment, Resampling, TimeSeries};

/// The slope is fitted from this share of loading's last force on, so that it is the slope of the
/// deepest part.
const END_SHARE: f64 = 0.5;
/// The slope is fitted to at least this many frames, if there are that many.
const END_FRAMES: usize = 3;
/// If indentations have a smaller spread (their standard deviation, mm), their slope would be
/// noise.
const LEAST_SPREAD_MM: f64 = 0.005;

/// A press that ended, with as many of its frames as a model takes.
#[derive(Debug)]
pub struct EndedPress {
    /// The sensor's name.
    pub sensor: String,
    /// The press's number.
    pub press: u64,
    /// Its frames in the sensor's grid.
    pub moments: Vec<Moment<Arc<Frame>>>,
    /// The place of the best frame among them.
    pub best: usize,
    /// Stiffness of the arm. 0 if it or the approach is unknown.
    pub arm_n_per_mm: f32,
    /// The distances between the sensor's taxels.
    pitch: Pitch,
}

impl EndedPress {
    /// The press on a model's grid, with taxels `grid_mm` apart.
    pub fn course(&self, grid_mm: f64) -> TimeSeries {
        let best = &self.moments[self.best].frame;
        let resampling = Resampling::new(best, self.pitch, grid_mm);
        let moments = self.moments.iter();
        let moments = moments.map(|moment| moment.map(|frame| resampling.apply(frame)));
        TimeSeries {
            moments: moments.collect(),
            arm_n_per_mm: self.arm_n_per_mm,
        }
    }

    /// The press on the array's own grid, for a model of parts.
    pub fn parts(&self) -> Vec<f32> {
        let moments = self.moments.iter();
        let moments = moments.map(|moment| (moment.time_s, &moment.frame.newtons[..]));
        parts(&moments.collect::<Vec<_>>())
    }
}

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
        let mut frames = press.spread();
        let moments: Vec<Duration> = frames.iter().map(|f| f.moment.stamp.mono).collect();
        let (begin, last) = (moments[0], moments[moments.len() - 1]);
        let sends = track.has_recent(last, delay_ms);
        let known = if sends {
            track.approach(begin, &moments, delay_ms)
        } else {
            let forces_n = forces_n(&frames);
            speed_mm_s.map(|speed_mm_s| approach_by_speed(speed_mm_s, &moments, &forces_n))
        };
        let mut approach_mm = known.unwrap_or_default();
        // The latest positions may still be on their way. An early verdict leaves out the frames after the
        // last one whose approach is known. The final verdict does not wait.
        let last_known = approach_mm.iter().rposition(Option::is_some);
        let may_wait = sends && phase == Phase::Early;
        if let (Some(last_known), true) = (last_known, may_wait) {
            frames.truncate(last_known + 1);
        }
        let best = press.best_of(&frames);
        let is_known = match may_wait {
            true => !approach_mm.is_empty(),
            false => is_informative(&approach_mm, best),
        };
        if !is_known {
            approach_mm.clear();
        }
        approach_mm.resize(frames.len(), None);
        Self {
            best,
            approach_mm,
            frames,
            source: match (is_known, sends) {
                (false, _) => ApproachSource::None,
                (true, true) => ApproachSource::Positions,
                (true, false) => ApproachSource::Speed,
            },
        }
    }

    /// The best frame.
    pub(super) fn best(&self) -> &'a ContactFrame {
        self.frames[self.best]
    }

    /// The press with at most `most` of its frames.
    pub(super) fn ended(&self, press: u64, most: usize, sensor: &Sensor) -> EndedPress {
        let places = thinned(self.frames.len(), self.best, most);
        let begin = self.frames[0].moment.stamp.mono;
        let moment = |&place: &usize| {
            let ContactFrame { moment, frame, .. } = self.frames[place];
            Moment {
                time_s: moment.stamp.mono.saturating_sub(begin).as_secs_f32(),
                approach_mm: self.approach_mm[place].map(|mm| mm as f32),
                frame: Arc::clone(frame),
            }
        };
        let is_known = self.source != ApproachSource::None;
        let arm_n_per_mm = sensor.arm().stiffness_n_per_mm.filter(|_| is_known);
        EndedPress {
            sensor: sensor.name().to_owned(),
            press,
            moments: places.iter().map(moment).collect(),
            best: places.partition_point(|&place| place < self.best),
            arm_n_per_mm: arm_n_per_mm.unwrap_or(0.0) as f32,
            pitch: sensor.calibration().pitch_mm,
        }
    }

    /// The slope of force against indentation at the end of loading, in N/mm, by least squares.
    pub(super) fn stiffness_n_per_mm(&self, arm_n_per_mm: Option<f64>) -> Option<f64> {
        let arm_n_per_mm = arm_n_per_mm?;
        let Phases { loaded, .. } = Phases::of(&forces_n(&self.frames));
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

fn forces_n(frames: &[&ContactFrame]) -> Vec<f64> {
    frames.iter().map(|frame| frame.force_n).collect()
}

/// Whether an approach is known at two frames up to the best one, or up to the second frame if the
/// first is the best. It is 0 at the first frame, so it says nothing if it is known there alone.
fn is_informative(approach_mm: &[Option<f64>], best: usize) -> bool {
    let places = best.max(1) + 1;
    approach_mm.iter().take(places).flatten().count() >= 2
}

/// The approach at each frame of a press by an arm that moves at a steady speed and then holds its
/// position. The frames came at `moments` and have these forces; there must be at least one.
fn approach_by_speed(speed_mm_s: f64, moments: &[Duration], forces_n: &[f64]) -> Vec<Option<f64>> {
    let Phases { loaded, held, .. } = Phases::of(forces_n);
    let (begin, stop) = (moments[0], moments[loaded]);
    let approach = |(place, moment): (usize, &Duration)| {
        let moved = (*moment).min(stop).saturating_sub(begin);
        (place <= held).then_some(speed_mm_s * moved.as_secs_f64())
    };
    moments.iter().enumerate().map(approach).collect()
}

/// The speed of a steady approach: from the controller's context, or else from the configuration.
pub(super) fn approach_speed_mm_s(
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
