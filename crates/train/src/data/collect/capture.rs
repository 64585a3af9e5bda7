//! The presses in one recording, and what its labels say of them.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::CollectError;
use super::selection::{Judged, Selection};
use crate::data::dataset::{self, file::SHORE};
use hardnessd_core::frame::Stamp;
use hardnessd_core::motion::Track;
use hardnessd_core::pipeline::{Clock, Pipeline};
use hardnessd_core::recording::{Entry, FileKind, Found, Labels, Playback, Reader};
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::Hrn;

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
        let shore = label.parse().ok().filter(|shore| SHORE.contains(shore));
        let wrong = || CollectError::Label {
            path: self.path.clone(),
            key: "shore",
            found: format!("{label:?}"),
            expected: "a number from 0 to 100",
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
            let none = Track::default();
            selection.take(pipeline.push(bytes, NOT_LOOKED_AT), NOT_LOOKED_AT, &none);
            selection.take(pipeline.end_of_recording(None), NOT_LOOKED_AT, &none);
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
    let (mut pitch_mm, none) = (None, Track::default());
    for found in Reader::new(bytes) {
        let found = found.map_err(|source| CollectError::Recording {
            path: path.to_owned(),
            source,
        })?;
        if let Some(found) = pitch_of(&found) {
            let expected = *pitch_mm.get_or_insert(found);
            check_pitch(path, found, expected, path)?;
        }
        let (at, sensor) = (found.at, found.sensor.clone());
        selection.note(&found);
        let events = playback.feed(found);
        let events = events.map_err(|source| CollectError::Sensor {
            path: path.to_owned(),
            source,
        })?;
        selection.take(events, at, playback.track(&sensor).unwrap_or(&none));
    }
    // A press that is still under way gets no verdict.
    selection.take(playback.end(), NOT_LOOKED_AT, &none);
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

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use hardnessd_core::test_support::{hrn, of_a_press};

    /// The approach at each frame of the press of a recording, and the stiffness of the arm.
    fn approach((bytes, sensor): &(Vec<u8>, Sensor)) -> (Vec<Option<f32>>, f32) {
        let presses = Presses::of(bytes, Path::new("a.mcap"), sensor, &hrn()).unwrap();
        let [press] = &presses.judged[..] else {
            panic!("one press");
        };
        let rounded = press.moments.iter().map(|moment| {
            let mm = moment.approach_mm?;
            Some((mm * 1e3).round() / 1e3)
        });
        (rounded.collect(), press.arm_n_per_mm)
    }

    #[test]
    fn positions_from_before_the_recording_are_those_of_its_state() {
        let recording = of_a_press(|d| d.arm.stiffness_n_per_mm = Some(10.0), None, true);
        let (found, arm_n_per_mm) = approach(&recording);
        assert_eq!(found, [0.0, 1.0, 2.0, 3.0, 4.0].map(Some));
        assert_eq!(arm_n_per_mm, 10.0);
    }

    #[test]
    fn without_positions_the_approach_is_that_of_the_speed() {
        let check = |configured, context, sends, expected: [f32; 5]| {
            let recording = of_a_press(|d| d.arm.speed_mm_s = configured, context, sends);
            assert_eq!(approach(&recording).0, expected.map(Some));
        };
        let context = Some(json!({"speed_mm_s": 10.0}));
        // The arm stops when loading ends, with the fourth frame.
        check(Some(5.0), None, false, [0.0, 1.0, 2.0, 3.0, 3.0]);
        check(Some(5.0), context.clone(), false, [0.0, 2.0, 4.0, 6.0, 6.0]);
        check(None, context.clone(), false, [0.0, 2.0, 4.0, 6.0, 6.0]);
        // Where there are positions, the speed does not count.
        check(Some(9.0), context, true, [0.0, 1.0, 2.0, 3.0, 4.0]);

        let recording = of_a_press(|d| d.arm.stiffness_n_per_mm = Some(10.0), None, false);
        assert_eq!(approach(&recording), (vec![None; 5], 0.0));
    }
}
