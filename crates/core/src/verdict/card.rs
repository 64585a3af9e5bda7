//! What a model file says of itself: its levels, ranges, metrics and checks (`docs/formats.md`).

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::course::TimeSeries;
use super::error::ModelError;
use super::probabilities::argmax;
use super::references::{Knowledge, ReferencePress};
use super::shore::{Level, Shore};
use crate::frame::{Array, Pitch};

/// The range of forces and areas in training. A verdict on a press outside it has the note
/// `outside_training`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Range {
    /// The least and the greatest total force of a training frame, in newtons.
    pub force_n: [f32; 2],
    /// The least and the greatest contact area of a training frame, in taxels.
    pub contact_area_taxels: [u32; 2],
    /// The least and the greatest distance between the taxels of the training sensors, in mm.
    /// `None` means that of the model's grid.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pitch_mm: Option<[f32; 2]>,
}

/// The description of a model in its file: the `hrn.*` metadata.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Card {
    /// `hrn.format`: "1" or "3".
    pub format: String,
    /// `hrn.levels`: levels 1 to L in order.
    pub levels: Vec<Level>,
    /// `hrn.pitch_mm`: the distance between taxels in the training data.
    pub pitch_mm: f32,
    /// `hrn.method`: the method of training, such as `hrn100`.
    pub method: String,
    /// `hrn.data`: name, seed and hash of the training data, as the file has it.
    pub data: String,
    /// `hrn.metrics`: the trainer's measurements.
    pub metrics: serde_json::Value,
    /// `hrn.validation`: the data of the validation, such as `simulated data only`.
    pub validation: String,
    /// `hrn.range`: the forces and areas in training.
    pub range: Range,
    /// `hrn.grid`: the array whose frames the model takes as they are. `None` for the model's own grid.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub grid: Option<Array>,
    /// `hrn.conformal`: only a file of format 3 may have it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub conformal: Option<Conformal>,
}

impl Card {
    /// Refuses a sensor of another array than that of a model with a grid of its own.
    ///
    /// # Errors
    ///
    /// Returns an error for such a sensor.
    pub fn check_array(&self, found: Array) -> Result<(), ModelError> {
        match self.grid {
            Some(expected) if expected != found => Err(ModelError::new(format!(
                "the model takes frames of {expected} taxels as they are, and the sensor has {found}: use the \
                 model of this sensor, or none"
            ))),
            _ => Ok(()),
        }
    }

    /// A taxel of the model's grid is in contact at or above this force.
    pub fn contact_threshold_n(&self) -> f32 {
        Pitch::square(f64::from(self.pitch_mm)).contact_threshold_n()
    }

    /// Whether the model was trained on sensors of this pitch. Taxels that are finer than the
    /// model's add up to what the model's would read, so only coarser ones are foreign to a model
    /// that knows one pitch. A model with a grid of its own takes them as they are.
    pub fn holds(&self, pitch: Pitch) -> bool {
        let finest = self.grid.map_or(0.0, |_| self.pitch_mm);
        let [least, most] = self.range.pitch_mm.unwrap_or([finest, self.pitch_mm]);
        let known = f64::from(least) * 0.98..=f64::from(most) * 1.02;
        known.contains(&pitch.rows_mm) && known.contains(&pitch.cols_mm)
    }
}

/// `hrn.conformal`: what a model promises of its sets of levels and of its intervals.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Conformal {
    /// A set misses the true level in at most this share of presses.
    pub alpha: f32,
    /// The threshold of a set, where `contexts` has none.
    pub threshold: f32,
    /// The limits for each knowledge of a sensor.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub contexts: BTreeMap<Knowledge, Limits>,
}

/// The limits with which a model keeps its promises.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limits {
    /// The set holds every level of at least this probability, and the most likely one.
    pub threshold: f32,
    /// The share of the distribution below the interval of the Shore hardness, and above it.
    pub tail: f32,
}

/// The share of a distribution below its 90 % interval, and above it.
pub const TAIL: f32 = 0.05;

impl Conformal {
    /// The limits for a knowledge of the sensor.
    pub fn limits(&self, knowledge: Knowledge) -> Limits {
        let limits = self.contexts.get(&knowledge).copied();
        limits.unwrap_or(Limits {
            threshold: self.threshold,
            tail: TAIL,
        })
    }
}

impl Limits {
    /// The levels of the set, ascending. Of many levels none may reach the threshold: without one that is likelier than all
    /// others together, the set then holds the likeliest ones, up to a probability of 1 - `alpha`.
    ///
    /// # Example
    ///
    /// ```
    /// use hardnessd_core::verdict::Limits;
    ///
    /// let set = |threshold, shares: &[f32]| Limits { threshold, tail: 0.05 }.set(shares, 0.1);
    /// assert_eq!(set(0.2, &[0.5, 0.2, 0.1, 0.2]), [1, 2, 4]);
    /// assert_eq!(set(0.9, &[0.3, 0.6, 0.1]), [2]);
    /// assert_eq!(set(0.9, &[0.25, 0.45, 0.25, 0.05]), [1, 2, 3]);
    /// assert_eq!(set(0.0, &[1.0, 0.0]), [1, 2]);
    /// ```
    pub fn set(self, probabilities: &[f32], alpha: f32) -> Vec<u8> {
        let (_, best) = argmax(probabilities);
        let mut falling: Vec<(u8, f32)> = (1..).zip(probabilities.iter().copied()).collect();
        falling.sort_by(|one, other| other.1.total_cmp(&one.1));
        let is_unclear = best < self.threshold.min(0.5);
        let mut before = 0.0;
        falling.retain(|&(_, p)| {
            let is_first = before == 0.0;
            let is_needed = is_unclear && before < 1.0 - alpha;
            before += p;
            is_first || is_needed || p >= self.threshold
        });
        let mut levels: Vec<u8> = falling.into_iter().map(|(level, _)| level).collect();
        levels.sort_unstable();
        levels
    }
}

/// The checks in a model file: inputs, and the trainer's outputs for them.
#[derive(Debug, Clone, PartialEq)]
pub enum Checks {
    /// The check frames of format 1.
    Frames(Check),
    /// The check presses of format 3.
    Courses(CourseCheck),
}

impl Checks {
    /// The number of check frames or check presses.
    pub fn count(&self) -> usize {
        match self {
            Self::Frames(check) => check.frames.len(),
            Self::Courses(check) => check.presses.len(),
        }
    }

    /// What the trainer computed for each check: the probabilities, and perhaps the Shore hardness.
    pub(super) fn expected(&self) -> Vec<(&[f32], Option<Shore>)> {
        match self {
            Self::Frames(check) => {
                let rows = check.probabilities.iter();
                rows.map(|row| (&row[..], None)).collect()
            }
            Self::Courses(check) => {
                let presses = check.presses.iter();
                presses
                    .map(|press| (&press.probabilities[..], press.shore))
                    .collect()
            }
        }
    }
}

/// `hrn.check` of format 1: frames and the probabilities that the trainer computed for them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Check {
    /// The frames: 784 newtons each, row-major, or as many as the input of a model with a grid of its
    /// own has. There are 8 frames, or two frames of each level.
    pub frames: Vec<Vec<f32>>,
    /// One row of L probabilities for each frame.
    pub probabilities: Vec<Vec<f32>>,
}

/// `hrn.check` of a model of courses: presses, and the outputs of the trainer's own software for
/// them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CourseCheck {
    /// The presses: 8, or two of each level.
    pub presses: Vec<CheckedCourse>,
    /// The references of a model of format 3.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub references: Vec<ReferencePress>,
}

/// A press of [`CourseCheck`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CheckedCourse {
    /// The course of the press.
    #[serde(flatten)]
    pub course: TimeSeries,
    /// `[L]`: the trainer's probabilities.
    pub probabilities: Vec<f32>,
    /// The trainer's Shore hardness: value, low and high. `None` for a model that gives none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shore: Option<Shore>,
    /// Whether the trainer judged the press with the references.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub identified: bool,
}

/// The input that a model judges.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Format 1: the frame of the largest contact area.
    Frame,
    /// Format 1 with a grid of its own: the press in [`PARTS`](super::parts::PARTS) parts of its time.
    Parts,
    /// Format 3: the course of a press.
    Course {
        /// The largest number of frames in a course.
        most_frames: usize,
    },
}
