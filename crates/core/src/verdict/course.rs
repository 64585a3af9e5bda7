//! The course of a press: its frames with their times, the approach and the arm's stiffness, and the same
//! as text for `hrn.check`.

use serde::{Deserialize, Serialize};

use super::grid::{ModelFrame, TAXELS};
use crate::frame::sparse;

/// The fewest and the most frames that a model of courses may take.
pub const COURSE_FRAMES: (usize, usize) = (3, 48);

/// One moment of a press, with its frame: on the model's grid, in the sensor's own, or as features.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Moment<F = ModelFrame> {
    /// The seconds since the frame that began the press.
    pub time_s: f32,
    /// How far the arm went since the frame that began the press. `None` if it is unknown.
    pub approach_mm: Option<f32>,
    /// The frame.
    pub frame: F,
}

impl<F> Moment<F> {
    /// The moment with what `change` makes of its frame.
    pub fn map<G>(&self, change: impl FnOnce(&F) -> G) -> Moment<G> {
        Moment {
            time_s: self.time_s,
            approach_mm: self.approach_mm,
            frame: change(&self.frame),
        }
    }
}

/// A press over time.
///
/// # Example
///
/// The built-in model judges a whole press, here one of two frames.
///
/// ```
/// use hardnessd_core::verdict::{BUILT_IN, Model, ModelFrame, Moment, TimeSeries};
///
/// let moment = |time_s, approach_mm, newtons| {
///     let mut frame = ModelFrame::default();
///     frame.newtons[400..404].fill(newtons);
///     Moment { time_s, approach_mm: Some(approach_mm), frame }
/// };
/// let course = TimeSeries {
///     moments: vec![moment(0.0, 0.0, 0.2), moment(0.1, 0.5, 2.0)],
///     arm_n_per_mm: 10.0,
/// };
/// let verdict = Model::load(BUILT_IN)?.judge_course(&course)?;
/// let shore = verdict.shore.unwrap();
/// assert!(shore.low <= shore.value && shore.value <= shore.high);
/// # Ok::<(), hardnessd_core::verdict::ModelError>(())
/// ```
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(into = "Written", try_from = "Written")]
pub struct TimeSeries {
    /// The frames in contact, from the one that began the press, ascending in time.
    pub moments: Vec<Moment>,
    /// The stiffness of the arm. 0 if it is unknown.
    pub arm_n_per_mm: f32,
}

/// The median of the times between two frames.
pub(super) fn period_s(times: impl Iterator<Item = f32> + Clone) -> Option<f32> {
    let next = times.clone().skip(1);
    let mut periods: Vec<f32> = times.zip(next).map(|(time, next)| next - time).collect();
    periods.sort_unstable_by(f32::total_cmp);
    periods.get(periods.len() / 2).copied()
}

/// A press in the file: a list for each input, and each frame as [`sparse`] text.
#[derive(Serialize, Deserialize)]
pub(super) struct Written {
    time_s: Vec<f32>,
    /// The approach at each frame. Null if it is unknown.
    approach_mm: Vec<Option<f32>>,
    arm_n_per_mm: f32,
    frames: Vec<String>,
}

impl From<TimeSeries> for Written {
    fn from(course: TimeSeries) -> Self {
        let moments = course.moments.iter();
        Self {
            time_s: moments.clone().map(|moment| moment.time_s).collect(),
            approach_mm: moments.clone().map(|moment| moment.approach_mm).collect(),
            arm_n_per_mm: course.arm_n_per_mm,
            frames: moments.map(|m| sparse::write(&m.frame.newtons)).collect(),
        }
    }
}

impl TryFrom<Written> for TimeSeries {
    type Error = String;

    fn try_from(written: Written) -> Result<Self, String> {
        let (times, positions) = (written.time_s.len(), written.approach_mm.len());
        let (frames, most) = (written.frames.len(), COURSE_FRAMES.1);
        if times != frames || positions != frames || !(1..=most).contains(&frames) {
            return Err(format!(
                "{times} times, {positions} positions and {frames} frames in a press: as many of each, 1 to {most}"
            ));
        }
        let rows = written.time_s.iter().zip(&written.approach_mm);
        let moment = |((&time_s, &approach_mm), frame): ((&f32, _), &String)| {
            let newtons = sparse::read(frame, TAXELS);
            let newtons = newtons.map_err(|error| format!("a frame of a press: {error}"))?;
            let newtons = newtons.try_into().expect("as many as were asked for");
            Ok::<_, String>(Moment {
                time_s,
                approach_mm,
                frame: ModelFrame { newtons },
            })
        };
        let moments = rows.zip(&written.frames).map(moment);
        Ok(Self {
            moments: moments.collect::<Result<_, _>>()?,
            arm_n_per_mm: written.arm_n_per_mm,
        })
    }
}
