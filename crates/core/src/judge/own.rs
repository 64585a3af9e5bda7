//! The last presses of a sensor, of objects of which nobody said anything, as references of the sensor.
//!
//! In: presses that ended, each with what the model estimates without them. Out: [`References`] of
//! Shore 0 to 100. They show the model what this sensor reads of everyday objects, so they help only
//! where the objects differ.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::approach::PressWithApproach;
use crate::press::ContactFrame;
use crate::sensor::Sensor;
use crate::verdict::{
    Model, ModelError, Piece, Reference, References, TimeSeries, are_unlike, sha256_hex,
};

/// At most so many presses in a row are kept of one object.
const MOST_IN_A_ROW: u32 = 2;
/// Without names, presses are of one object if they follow each other within this time and lie no
/// further apart.
const SAME_WITHIN: Duration = Duration::from_secs(1);
const SAME_WITHIN_MM: f64 = 7.0;

/// The own presses of a sensor.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct OwnPresses {
    /// SHA-256 of the model that computed them.
    model: String,
    /// The last press comes last.
    presses: Vec<OwnPress>,
    /// The press before, kept or not.
    pub(super) last: Option<PressedAt>,
}

/// A press as the model takes it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct OwnPress {
    reference: Reference,
    /// The estimated Shore hardness, without own presses.
    shore: f32,
}

/// When and where a press was.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct PressedAt {
    /// The name of its object.
    object: Option<String>,
    /// When it began and ended, by CLOCK_MONOTONIC.
    times: [Duration; 2],
    /// The centre of its best frame, in mm from the first taxel.
    centre_mm: [f64; 2],
    /// How many presses of its object it makes in a row.
    pub(super) in_a_row: u32,
}

impl PressedAt {
    /// Whether the press says something that those in a row before it did not say.
    pub(super) fn is_new(&self) -> bool {
        self.in_a_row <= MOST_IN_A_ROW
    }
}

impl OwnPresses {
    /// When and where the next press is.
    pub(super) fn next(
        &self,
        object: Option<String>,
        press: &PressWithApproach<'_>,
        sensor: &Sensor,
    ) -> PressedAt {
        let moment = |frame: &ContactFrame| frame.moment.stamp.mono;
        let times = [press.frames[0], press.frames[press.frames.len() - 1]].map(moment);
        let pitch = sensor.calibration().pitch_mm;
        let (row, col) = press.best().frame.centre();
        let centre_mm = [row * pitch.rows_mm, col * pitch.cols_mm];
        let is_same = |before: &PressedAt| match (&before.object, &object) {
            (Some(before), Some(now)) => before == now,
            (None, None) => {
                let [rows, cols] = [0, 1].map(|k| centre_mm[k] - before.centre_mm[k]);
                times[0].saturating_sub(before.times[1]) <= SAME_WITHIN
                    && rows.hypot(cols) <= SAME_WITHIN_MM
            }
            _ => false,
        };
        let before = self.last.as_ref().filter(|before| is_same(before));
        let in_a_row = before.map_or(1, |before| before.in_a_row.saturating_add(1));
        PressedAt {
            object,
            times,
            centre_mm,
            in_a_row,
        }
    }

    /// The references of presses of objects that are all different, if they may be used.
    ///
    /// # Errors
    ///
    /// Returns the errors of [`Model::judge_taxels`].
    pub fn references_of(
        hrn: &Model,
        courses: &[TimeSeries],
        most: usize,
    ) -> Result<References, ModelError> {
        let mut own = Self::default();
        for course in courses {
            own.keep(hrn, course, most)?;
        }
        Ok(own.references())
    }

    /// Keeps a press that ended. At most `most` are kept.
    pub(super) fn keep(
        &mut self,
        hrn: &Model,
        course: &TimeSeries,
        most: usize,
    ) -> Result<(), ModelError> {
        let most = most.min(hrn.most_references());
        if most == 0 {
            return Ok(());
        }
        let Some(shore) = hrn.judge_course(course)?.shore else {
            return Ok(());
        };
        let reference = hrn.reference(course, Piece::UNKNOWN)?;
        if self.model != hrn.sha256() {
            self.presses.clear();
            self.model = hrn.sha256().to_owned();
        }
        let shore = shore.value;
        self.presses.push(OwnPress { reference, shore });
        self.keep_last(most);
        Ok(())
    }

    fn keep_last(&mut self, most: usize) {
        let many = self.presses.len().saturating_sub(most);
        self.presses.drain(..many);
    }

    /// The presses as references, if they may be used.
    pub(super) fn references(&self) -> References {
        let shores: Vec<f32> = self.presses.iter().map(|press| press.shore).collect();
        if !are_unlike(&shores) {
            return References::NONE;
        }
        let presses = self.presses.iter().map(|press| press.reference.clone());
        References::of(presses.collect())
    }

    /// The number of presses.
    pub fn count(&self) -> usize {
        self.presses.len()
    }

    /// The last presses, at most `most`, if this model computed them. A recording or a file may hold anything.
    pub(super) fn of_model(mut self, hrn: &Model, most: usize) -> Self {
        let mut presses = self.presses.iter();
        let is_usable = self.model == hrn.sha256()
            && presses.len() <= hrn.most_references()
            && presses.all(|press| press.shore.is_finite() && hrn.takes_own(&press.reference));
        if !is_usable {
            self.presses.clear();
        }
        self.keep_last(most);
        self
    }

    /// The presses without where and when the last one was, which another start cannot compare with.
    #[must_use]
    pub fn for_another_start(mut self) -> Self {
        self.last = None;
        self
    }
}

/// What own presses belong to: the model that computed them, and the array, its calibration and its arm.
pub fn owner(sensor: &Sensor, hrn: &Model) -> String {
    let described = sensor.description();
    let of = (
        hrn.sha256(),
        hrn.known_references(),
        sensor.layout().array(),
        &described.sensor.calibration,
        &described.sensor.arm,
    );
    let text = serde_json::to_vec(&of).expect("numbers and strings always serialise");
    sha256_hex(&text)
}
