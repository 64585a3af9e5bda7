//! The presses in one recording, and what its labels say of them.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::CollectError;
use super::selection::{Judged, Selection};
use crate::frame::Stamp;
use crate::pipeline::{Clock, Pipeline};
use crate::recording::{Entry, FileKind, Found, Labels, Playback, Reader};
use crate::sensor::Sensor;
use crate::train::data::dataset;
use crate::verdict::Hrn;

/// A capture without its frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Head {
    #[serde(skip)]
    pub(super) path: PathBuf,
    pub(super) sha256: String,
    pub(super) labels: Labels,
    /// Distance between the sensor's taxels.
    pub(super) pitch_mm: f64,
    /// The number of presses that were judged.
    pub(super) judged: usize,
    /// The number of presses for the data set: all, or those that are recorded from their begin.
    pub(super) presses: usize,
    /// The number of these whose approach is known.
    pub(super) known: usize,
    /// The number of frames of these presses.
    pub(super) frames: usize,
}

impl Head {
    /// The label `key` as a number, if there is one.
    pub(super) fn number(
        &self,
        key: &'static str,
        expected: &'static str,
    ) -> Result<Option<u32>, CollectError> {
        let Some(label) = self.labels.get(key) else {
            return Ok(None);
        };
        let wrong = |_| CollectError::Label {
            path: self.path.clone(),
            key,
            found: format!("{label:?}"),
            expected,
        };
        label.parse().map(Some).map_err(wrong)
    }

    pub(super) fn shore(&self) -> Result<Option<f32>, CollectError> {
        let Some(label) = self.labels.get("shore") else {
            return Ok(None);
        };
        let shore = label.parse().ok().filter(|shore: &f32| shore.is_finite());
        let wrong = || CollectError::Label {
            path: self.path.clone(),
            key: "shore",
            found: format!("{label:?}"),
            expected: "a number",
        };
        shore.ok_or_else(wrong).map(Some)
    }

    pub(super) fn level(&self, given: Option<u8>) -> Result<u8, CollectError> {
        const EXPECTED: &str = "a level from 0 (unlabelled) to 4";
        let level = match given {
            Some(level) => u32::from(level),
            None => self
                .number("level", EXPECTED)?
                .ok_or_else(|| CollectError::NoLevel {
                    path: self.path.clone(),
                })?,
        };
        let known = u8::try_from(level).ok();
        let known = known.filter(|level| usize::from(*level) <= dataset::levels().len());
        known.ok_or_else(|| CollectError::Label {
            path: self.path.clone(),
            key: "level",
            found: level.to_string(),
            expected: EXPECTED,
        })
    }
}

/// The presses of a capture, with its labels and its pitch.
pub(super) struct Presses {
    pub(super) labels: Labels,
    pub(super) pitch_mm: f64,
    pub(super) judged: Vec<Judged>,
}

impl Presses {
    /// Finds the presses in `bytes`, the content of `path`. `sensor` is the sensor of a capture
    /// that does not describe its own, and `hrn` judges the presses.
    ///
    /// # Errors
    ///
    /// Returns an error if the capture is damaged, describes an impossible sensor or sensors of
    /// different pitches, or has no press that was judged.
    pub(super) fn of(
        bytes: &[u8],
        path: &Path,
        sensor: &Sensor,
        hrn: &Arc<Hrn>,
    ) -> Result<Self, CollectError> {
        let mut selection = Selection::default();
        let (labels, pitch_mm) = if FileKind::of(bytes) == FileKind::Recording {
            play(bytes, hrn, path, &mut selection)?
        } else {
            let mut pipeline = Pipeline::new(sensor.clone(), hrn.clone(), Clock::FrameRate);
            selection.describe(sensor.name(), sensor.description());
            selection.take(pipeline.push(bytes, NOT_LOOKED_AT), NOT_LOOKED_AT);
            selection.take(pipeline.end_of_recording(None), NOT_LOOKED_AT);
            (Labels::new(), sensor.description().calibration.pitch_mm)
        };
        if selection.presses.is_empty() {
            let path = path.to_owned();
            return Err(CollectError::NoPress { path });
        }
        Ok(Self {
            labels,
            pitch_mm,
            judged: selection.presses,
        })
    }
}

/// The time given to a pipeline whose clock is the frame rate.
const NOT_LOOKED_AT: Stamp = Stamp {
    mono: std::time::Duration::ZERO,
    wall: jiff::Timestamp::UNIX_EPOCH,
};

fn play(
    bytes: &[u8],
    hrn: &Arc<Hrn>,
    path: &Path,
    selection: &mut Selection,
) -> Result<(Labels, f64), CollectError> {
    let mut playback = Playback::new(hrn.clone());
    let mut pitch_mm = None;
    for found in Reader::new(bytes) {
        let found = found.map_err(|source| CollectError::Recording {
            path: path.to_owned(),
            source,
        })?;
        if let Some(found) = pitch_of(&found) {
            let expected = *pitch_mm.get_or_insert(found);
            check_pitch(path, found, expected, path)?;
        }
        let at = found.at;
        selection.note(&found);
        let events = playback.feed(found);
        let events = events.map_err(|source| CollectError::Sensor {
            path: path.to_owned(),
            source,
        })?;
        selection.take(events, at);
    }
    // A press that is still under way gets no verdict.
    selection.take(playback.end(), NOT_LOOKED_AT);
    // A recording without a sensor has no press either, so this pitch is never used.
    Ok((playback.labels(), pitch_mm.unwrap_or(dataset::PITCH_MM)))
}

/// The taxel pitch of the sensor that an entry describes.
fn pitch_of(found: &Found) -> Option<f64> {
    match &found.entry {
        Entry::State(state) => Some(state.sensor.description.calibration.pitch_mm),
        Entry::Settings(sensor) => Some(sensor.description.calibration.pitch_mm),
        Entry::Input(_) => None,
    }
}

pub(super) fn check_pitch(
    path: &Path,
    found: f64,
    expected: f64,
    first: &Path,
) -> Result<(), CollectError> {
    if found == expected {
        return Ok(());
    }
    Err(CollectError::Pitch {
        path: path.to_owned(),
        found,
        expected,
        first: first.to_owned(),
    })
}
