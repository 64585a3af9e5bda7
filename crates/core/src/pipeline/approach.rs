//! The course of a press: its frames, and how far the arm went at each.

use std::time::Duration;

use super::Pipeline;
use crate::event::{self, Phase};
use crate::motion::{self, SPEEDS_MM_S};
use crate::press::{ContactFrame, SoFar, thinned};
use crate::verdict::{self, Laying};

/// Loading ends at the first frame that has this share of the greatest force. A steady approach may
/// end there.
const LOADED_SHARE: f64 = 0.95;
/// After loading, an arm that moves at a steady speed holds its position until the force falls below
/// this share of the greatest force. Creep takes the force down by less. Of the shares from 0.5 to
/// 0.9, this one gave the most right verdicts on presses that only served to choose.
const HELD_SHARE: f64 = 0.8;
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
    pub(super) best: usize,
    /// The approach at each frame where it is known.
    approach_mm: Vec<Option<f64>>,
    /// The source of the approach.
    pub(super) rests_on: event::ApproachSource,
}

impl<'a> PressWithApproach<'a> {
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
            self.rests_on = event::ApproachSource::None;
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
            rests_on: self.rests_on,
        }
    }

    /// The course for a model of `most` frames.
    pub(super) fn course(
        &self,
        arm_n_per_mm: Option<f64>,
        most: usize,
        laying: &Laying,
    ) -> verdict::Course {
        let begin = self.frames[0].moment.stamp.mono;
        let moment = |place: usize| {
            let frame = self.frames[place];
            let since = frame.moment.stamp.mono.saturating_sub(begin);
            verdict::CourseMoment {
                time_s: since.as_secs_f32(),
                approach_mm: self.approach_mm[place].map(|mm| mm as f32),
                frame: laying.lay(&frame.frame),
            }
        };
        let places = thinned(self.frames.len(), self.best, most);
        let is_known = self.rests_on != event::ApproachSource::None;
        verdict::Course {
            moments: places.into_iter().map(moment).collect(),
            arm_n_per_mm: arm_n_per_mm.filter(|_| is_known).unwrap_or(0.0) as f32,
        }
    }

    /// The slope of force against indentation at the end of loading, in N/mm, by least squares.
    pub(super) fn stiffness_n_per_mm(&self, arm_n_per_mm: Option<f64>) -> Option<f64> {
        let arm_n_per_mm = arm_n_per_mm?;
        let loaded = loaded(&self.forces_n());
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

/// The place of the last frame of loading among the frames with these forces.
fn loaded(forces_n: &[f64]) -> usize {
    let greatest = forces_n.iter().copied().fold(0.0, f64::max);
    let enough = LOADED_SHARE * greatest;
    let mut forces = forces_n.iter();
    forces.position(|&force| force >= enough).unwrap_or(0)
}

/// The place of the last frame of the hold, which follows loading.
fn held(forces_n: &[f64]) -> usize {
    let greatest = forces_n.iter().copied().fold(0.0, f64::max);
    let mut forces = forces_n.iter();
    let first = forces.position(|&force| force == greatest).unwrap_or(0);
    let falls = |&place: &usize| forces_n[place] < HELD_SHARE * greatest;
    let fallen = (first..forces_n.len()).find(falls);
    fallen.unwrap_or(forces_n.len()) - 1
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
    let (begin, stop) = (moments[0], moments[loaded(forces_n)]);
    let held = held(forces_n);
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
    let count = points.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / count;
    let (x, y) = (mean(|p| p.0), mean(|p| p.1));
    let sum = |of: &dyn Fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>();
    let squares = sum(&|p| (p.0 - x).powi(2));
    let slope = sum(&|p| (p.0 - x) * (p.1 - y)) / squares;
    let is_spread = points.len() > 1 && (squares / count).sqrt() >= LEAST_SPREAD_MM;
    (is_spread && slope.is_finite() && slope > 0.0).then_some(slope)
}

impl Pipeline {
    /// The course of a press up to now.
    pub(super) fn known<'a>(&self, so_far: &'a SoFar, phase: Phase) -> PressWithApproach<'a> {
        let (frames, best) = so_far.until(Duration::MAX);
        let mut known = PressWithApproach {
            approach_mm: vec![None; frames.len()],
            frames,
            best,
            rests_on: event::ApproachSource::None,
        };
        let moments = known.moments();
        let (begin, last) = (moments[0], moments[moments.len() - 1]);
        let delay_ms = self.sensor.description().arm.delay_ms;
        if self.track.has_recent(last, delay_ms) {
            if let Some(approach_mm) = self.track.approach(begin, &moments, delay_ms) {
                known.approach_mm = approach_mm;
                known.rests_on = event::ApproachSource::Positions;
            }
            // The latest positions may still be on their way. The final verdict does not wait for
            // them.
            return match phase {
                Phase::Early => known.cut(so_far),
                Phase::Final => known.or_nothing(),
            };
        }
        if let Some(speed_mm_s) = self.seen.speed_mm_s {
            known.approach_mm = approach_by_speed(speed_mm_s, &moments, &known.forces_n());
            known.rests_on = event::ApproachSource::Speed;
        }
        known.or_nothing()
    }

    /// The speed of a steady approach, as it is known now.
    pub(super) fn speed_mm_s(&self) -> Option<f64> {
        let arm = &self.sensor.description().arm;
        approach_speed_mm_s(self.seen.context.as_ref(), arm)
    }
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
