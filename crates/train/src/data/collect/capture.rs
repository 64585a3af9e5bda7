//! The presses in one recording, and what its labels say of them.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

use serde_json::{Map, Value, json};

use super::part::{Part, Presses};
use super::selection::{Judged, Selection, grid_mm};
use super::{Problem, Settings};
use crate::data::courses::{Courses, Press};
use crate::data::dataset::{self, COLLECTOR, Sample, file::SHORE};
use hardnessd_core::frame::Stamp;
use hardnessd_core::motion::Track;
use hardnessd_core::pipeline::{Clock, Pipeline};
use hardnessd_core::recording::{Entry, FileKind, Found, Labels, Playback, Reader, RecordedSensor};
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::{Hrn, sha256_hex};

/// The material of presses over time whose recording does not name one.
const NO_MATERIAL: &str = "unknown";

/// The presses of `bytes`, the content of `path`.
///
/// # Errors
///
/// Returns an error if the recording is damaged, describes an impossible sensor or sensors of
/// different pitches, has no press that was judged, or lacks a label that is needed.
pub(super) fn part(path: &Path, bytes: &[u8], settings: &Settings) -> Result<Part, Problem> {
    let Pressed {
        judged,
        labels,
        pitch_mm,
    } = Pressed::of(bytes, &settings.sensor, &settings.hrn)?;
    let (given, sequences) = (settings.labelling, settings.sequences);
    let level = level(&labels, given.level)?;
    let shore = shore(&labels)?;
    let number = match given.object {
        None => number(&labels, "object", "a number")?,
        given => given,
    };
    let object = number.unwrap_or_default();
    let material = labels.get("material").cloned();
    let material = material.or_else(|| sequences.then(|| NO_MATERIAL.to_owned()));
    let count = judged.len();
    let presses = if sequences {
        let mut courses = Courses::default();
        for judged in judged.iter().filter(|press| press.is_whole()) {
            let press = Press {
                level,
                object,
                material: 0,
                split: given.split,
                shore: shore.unwrap_or(f32::NAN),
                force_n: judged.force_n,
                arm_n_per_mm: judged.arm_n_per_mm,
                sensor: 0,
                reference: None,
                best: judged.best as u32,
            };
            let moments = judged.moments.iter();
            courses.push(
                press,
                moments.map(|moment| (moment.time_s, moment.approach_mm, &moment.frame)),
            );
        }
        Presses::Courses(courses)
    } else {
        let sample = |judged: Judged| Sample {
            frame: judged.frame,
            level,
            object: Some(object),
            material: material.as_ref().map(|_| 0),
            force_n: Some(judged.force_n),
            split: given.split,
            shore,
            source: 0,
        };
        Presses::Frames(judged.into_iter().map(sample).collect())
    };
    let mut capture = json!({
        "name": path.file_name().unwrap_or_default().to_string_lossy(),
        "sha256": sha256_hex(bytes),
        "level": level,
        "object": object,
        "presses": presses.len(),
        "split": given.split.name(),
        "labels": labels,
    });
    let mut new_objects = BTreeSet::new();
    if FileKind::of(bytes) == FileKind::Raw {
        capture["raw"] = Value::Bool(true);
    }
    if number.is_none() {
        capture["new_object"] = Value::Bool(true);
        new_objects.insert(object);
    }
    Ok(Part {
        path: path.to_owned(),
        is_recording: true,
        pitch_mm,
        materials: material.into_iter().collect(),
        captures: vec![capture],
        new_objects,
        generators: vec![format!("{COLLECTOR} {}", env!("CARGO_PKG_VERSION"))],
        partial: count - presses.len(),
        presses,
        meta: Map::new(),
    })
}

/// The label `key` as a number, if there is one.
fn number(
    labels: &Labels,
    key: &'static str,
    expected: &'static str,
) -> Result<Option<u32>, Problem> {
    let Some(label) = labels.get(key) else {
        return Ok(None);
    };
    let wrong = |_| Problem::Label {
        key,
        found: format!("{label:?}"),
        expected,
    };
    label.parse().map(Some).map_err(wrong)
}

fn shore(labels: &Labels) -> Result<Option<f32>, Problem> {
    let Some(label) = labels.get("shore") else {
        return Ok(None);
    };
    let shore = label.parse().ok().filter(|shore| SHORE.contains(shore));
    let wrong = || Problem::Label {
        key: "shore",
        found: format!("{label:?}"),
        expected: "a number from 0 to 100",
    };
    shore.ok_or_else(wrong).map(Some)
}

fn level(labels: &Labels, given: Option<u8>) -> Result<u8, Problem> {
    const EXPECTED: &str = "a level from 0 (unlabelled) to 4";
    if let Some(level) = given {
        return Ok(level);
    }
    let level = number(labels, "level", EXPECTED)?.ok_or(Problem::NoLevel)?;
    let known = u8::try_from(level).ok();
    let known = known.filter(|level| usize::from(*level) <= dataset::levels().len());
    known.ok_or_else(|| Problem::Label {
        key: "level",
        found: level.to_string(),
        expected: EXPECTED,
    })
}

/// What is in a recording: its presses, labels and pitch.
struct Pressed {
    judged: Vec<Judged>,
    labels: Labels,
    pitch_mm: f64,
}

impl Pressed {
    /// Finds the presses. `sensor` is the sensor of a recording that does not describe its own, and
    /// `hrn` judges the presses.
    fn of(bytes: &[u8], sensor: &Sensor, hrn: &Arc<Hrn>) -> Result<Self, Problem> {
        let mut selection = Selection::default();
        let (labels, pitch_mm) = if FileKind::of(bytes) == FileKind::Recording {
            play(bytes, hrn, &mut selection)?
        } else {
            let mut pipeline = Pipeline::new(sensor.clone(), hrn.clone(), Clock::FrameRate);
            selection.describe(sensor.name(), sensor.description());
            let none = Track::default();
            selection.take(pipeline.push(bytes, NOT_LOOKED_AT), NOT_LOOKED_AT, &none);
            selection.take(pipeline.end_of_recording(None), NOT_LOOKED_AT, &none);
            (Labels::new(), grid_mm(sensor))
        };
        if selection.presses.is_empty() {
            return Err(Problem::NoPress);
        }
        Ok(Self {
            judged: selection.presses,
            labels,
            pitch_mm,
        })
    }
}

/// The time given to a pipeline whose clock is the frame rate.
const NOT_LOOKED_AT: Stamp = Stamp {
    mono: std::time::Duration::ZERO,
    wall: jiff::Timestamp::UNIX_EPOCH,
};

fn play(bytes: &[u8], hrn: &Arc<Hrn>, selection: &mut Selection) -> Result<(Labels, f64), Problem> {
    let mut playback = Playback::new(hrn.clone());
    let (mut pitch_mm, none) = (None, Track::default());
    for found in Reader::new(bytes) {
        let found = found.map_err(Problem::Recording)?;
        if let Some(described) = sensor_of(&found) {
            selection.describe(&found.sensor, &described.description);
            // A wrong description is an error of the playback.
            if let Ok(sensor) = described.check() {
                let found = grid_mm(&sensor);
                let expected = *pitch_mm.get_or_insert(found);
                if found != expected {
                    return Err(Problem::Pitches { found, expected });
                }
            }
        }
        let (at, sensor) = (found.at, found.sensor.clone());
        let events = playback.feed(found);
        let events = events.map_err(Problem::Sensor)?;
        selection.take(events, at, playback.track(&sensor).unwrap_or(&none));
    }
    // A press that is still under way gets no verdict.
    selection.take(playback.end(), NOT_LOOKED_AT, &none);
    // A recording without a sensor has no press either, so this pitch is never used.
    Ok((playback.labels(), pitch_mm.unwrap_or(dataset::PITCH_MM)))
}

/// The sensor that an entry describes.
fn sensor_of(found: &Found) -> Option<&RecordedSensor> {
    match &found.entry {
        Entry::State(state) => Some(&state.sensor),
        Entry::Settings(sensor) => Some(sensor),
        Entry::Input(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use hardnessd_core::test_support::{hrn, of_a_press};

    /// The approach at each frame of the press of a recording, and the stiffness of the arm.
    fn approach((bytes, sensor): &(Vec<u8>, Sensor)) -> (Vec<Option<f32>>, f32) {
        let pressed = Pressed::of(bytes, sensor, &hrn()).unwrap();
        let [press] = &pressed.judged[..] else {
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
