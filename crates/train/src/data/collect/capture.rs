//! The presses in one recording, and what its labels say of them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use serde_json::{Map, Value, json};

use super::part::Part;
use super::selection::{self, Judged, Selection, grid_mm};
use super::{Problem, Settings};
use crate::data::presses::file::SHORE;
use crate::data::presses::{Layout, Press, Presses};
use crate::data::source::{COLLECTOR, MOST_LEVELS, PITCH_MM};
use hardnessd_core::frame::{Array, Stamp};
use hardnessd_core::motion::Track;
use hardnessd_core::pipeline::{Clock, Input, Pipeline};
use hardnessd_core::recording::{Entry, FileKind, Found, Labels, Playback, Reader, RecordedSensor};
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::{Borders, Hrn, Level, sha256_hex};
use hardnessd_simulator::Reference;

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
        grid,
    } = Pressed::of(bytes, &settings.sensor, &settings.hrn)?;
    let (given, layout) = (settings.labelling, settings.layout);
    let reference = reference(&labels, layout)?;
    // What was said of a press while it was made counts more than what was said of the recording.
    let by_press = reference.is_none() && given.level.is_none();
    let is_said = by_press && judged.iter().any(|press| press.level.is_some());
    let level = match reference {
        Some(_) => 0,
        None => match level(&labels, given.level, &settings.levels) {
            Err(Problem::NoLevel) if is_said => 0,
            level => level?,
        },
    };
    let shore = shore(&labels)?.filter(|_| reference.is_none());
    let number = match given.object {
        None => number(&labels, "object", "a number")?,
        given => given,
    };
    let object = number.unwrap_or_default();
    let material = labels.get("material").cloned();
    let of_over_time = (layout == Layout::OverTime).then(|| NO_MATERIAL.to_owned());
    let material = material.or(of_over_time);
    let count = judged.len();
    let sensors: BTreeSet<String> = judged.iter().map(|press| press.sensor.clone()).collect();
    let sensors: Vec<Option<String>> = sensors.into_iter().map(Some).collect();
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let mut presses = Presses::default();
    // How many presses each object has, and at which level.
    let mut counts = BTreeMap::<(u32, u8), usize>::new();
    for judged in judged {
        let level = judged.level.filter(|_| by_press).unwrap_or(level);
        let named = judged.object.as_deref();
        let named = named.filter(|_| given.object.is_none() && reference.is_none());
        let object = named.map_or(object, number_of);
        *counts.entry((object, level)).or_default() +=
            usize::from(layout == Layout::Frames || judged.is_whole());
        let sensor = sensors
            .iter()
            .position(|name| name.as_ref() == Some(&judged.sensor));
        let press = Press {
            level,
            object: Some(object),
            material: material.as_ref().map(|_| 0),
            force_n: Some(judged.force_n),
            split: given.split,
            shore,
            arm_n_per_mm: judged.arm_n_per_mm,
            sensor: sensor.unwrap_or_default() as u32,
            reference,
            name: Some(format!("{name} press {}", judged.press)),
            unloaded: Some(judged.unloaded.clone()),
            ..Press::default()
        };
        match layout {
            Layout::Frames => presses.push(press, [(0.0, None, judged.frame)].into_iter()),
            Layout::OverTime if judged.is_whole() => {
                let press = Press {
                    best: judged.best,
                    ..press
                };
                let moments = judged.moments.into_iter();
                presses.push(press, moments.map(|m| (m.time_s, m.approach_mm, m.frame)));
            }
            Layout::OverTime => {}
        }
    }
    let mut new_objects = BTreeSet::new();
    let mut captures = Vec::new();
    for ((own, level), count) in counts {
        let mut capture = json!({
            "name": name,
            "sha256": sha256_hex(bytes),
            "level": level,
            "object": own,
            "presses": count,
            "split": given.split.name(),
            "labels": labels,
        });
        if FileKind::of(bytes) == FileKind::Raw {
            capture["raw"] = Value::Bool(true);
        }
        if number.is_none() && own == object {
            capture["new_object"] = Value::Bool(true);
            new_objects.insert(object);
        }
        captures.push(capture);
    }
    Ok(Part {
        path: path.to_owned(),
        is_recording: true,
        pitch_mm,
        grid,
        materials: material.into_iter().collect(),
        sensors,
        captures,
        new_objects,
        generators: vec![format!("{COLLECTOR} {}", env!("CARGO_PKG_VERSION"))],
        partial: count - presses.all.len(),
        presses,
        meta: Map::new(),
    })
}

/// The number of an object that only has a name: the same in every recording.
fn number_of(name: &str) -> u32 {
    let hash = sha256_hex(name.as_bytes());
    let number = u32::from_str_radix(&hash[..8], 16).expect("a hash is hexadecimal");
    // A half of the numbers is left to objects without a name.
    number >> 1
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

/// The rigid piece that the label `reference` names, as `identify` does.
fn reference(labels: &Labels, layout: Layout) -> Result<Option<Reference>, Problem> {
    let Some(label) = labels.get("reference") else {
        return Ok(None);
    };
    let wrong = |expected| Problem::Label {
        key: "reference",
        found: format!("{label:?}"),
        expected,
    };
    if layout == Layout::Frames {
        return Err(wrong(
            "none: collect presses of rigid pieces with --sequences",
        ));
    }
    let (form, mm) = label.split_once(':').unwrap_or_default();
    let mm: Option<f32> = mm.parse().ok().filter(|mm| (0.1..=1000.0).contains(mm));
    match (form, mm) {
        ("flat", Some(width_mm)) => Ok(Some(Reference::Flat { width_mm })),
        ("ball", Some(radius_mm)) => Ok(Some(Reference::Ball { radius_mm })),
        _ => Err(wrong("flat:MM or ball:MM with 0.1 to 1000 mm")),
    }
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

/// The level that the label `level` numbers or names, or else that of the label `shore`.
fn level(labels: &Labels, given: Option<u8>, levels: &[Level]) -> Result<u8, Problem> {
    if let Some(level) = given {
        return Ok(level);
    }
    let Some(label) = labels.get("level") else {
        let shore = shore(labels)?.zip(Borders::of(levels).ok());
        let (shore, borders) = shore.ok_or(Problem::NoLevel)?;
        return Ok(levels[borders.place_of(shore)].level);
    };
    let named = levels.iter().find(|level| is_named(level, label));
    let numbered = label.parse().ok();
    let numbered = numbered.filter(|level| usize::from(*level) <= MOST_LEVELS);
    let level = named.map(|level| level.level).or(numbered);
    level.ok_or_else(|| Problem::Label {
        key: "level",
        found: format!("{label:?}"),
        expected: "the name of a level, or a number from 0 (unlabelled) to 16",
    })
}

/// Whether a label names the level.
pub(super) fn is_named(level: &Level, label: &str) -> bool {
    level.label.eq_ignore_ascii_case(label)
}

/// The labels of a recording. Raw bytes and data sets have none.
pub(super) fn labels(bytes: &[u8]) -> Labels {
    if FileKind::of(bytes) != FileKind::Recording {
        return Labels::new();
    }
    // Each part of a recording begins with a state, which has the labels.
    let states = Reader::new(bytes).map_while(Result::ok);
    let mut labels = states.filter_map(|found| match found.entry {
        Entry::State(state) => Some(state.labels),
        _ => None,
    });
    labels.next().unwrap_or_default()
}

/// What is in a recording: its presses, labels and pitch.
struct Pressed {
    judged: Vec<Judged>,
    labels: Labels,
    pitch_mm: f64,
    /// The one array of its sensors, if the frames are as they are.
    grid: Option<Array>,
}

impl Pressed {
    /// Finds the presses. `sensor` is the sensor of a recording that does not describe its own, and
    /// `hrn` judges the presses.
    fn of(bytes: &[u8], sensor: &Sensor, hrn: &Arc<Hrn>) -> Result<Self, Problem> {
        let mut selection = Selection::default();
        let (labels, pitch_mm, grid) = if FileKind::of(bytes) == FileKind::Recording {
            play(bytes, hrn, &mut selection)?
        } else {
            let mut pipeline = Pipeline::new(sensor.clone(), hrn.clone(), Clock::FrameRate);
            selection.describe(sensor.name(), sensor.description());
            let none = Track::default();
            let events = pipeline.take(Input::Bytes(bytes.to_vec()), NOT_LOOKED_AT);
            selection.take(events.unwrap_or_default(), NOT_LOOKED_AT, &none);
            selection.take(pipeline.end_of_recording(None), NOT_LOOKED_AT, &none);
            (Labels::new(), grid_mm(sensor), selection::grid(sensor))
        };
        if selection.presses.is_empty() {
            return Err(Problem::NoPress);
        }
        Ok(Self {
            judged: selection.presses,
            labels,
            pitch_mm,
            grid,
        })
    }
}

/// The time given to a pipeline whose clock is the frame rate.
const NOT_LOOKED_AT: Stamp = Stamp {
    mono: std::time::Duration::ZERO,
    wall: jiff::Timestamp::UNIX_EPOCH,
};

type Played = (Labels, f64, Option<Array>);

fn play(bytes: &[u8], hrn: &Arc<Hrn>, selection: &mut Selection) -> Result<Played, Problem> {
    let mut playback = Playback::new(hrn.clone());
    let (mut pitch_mm, none) = (None, Track::default());
    let mut grids = Vec::new();
    for found in Reader::new(bytes) {
        let found = found.map_err(Problem::Recording)?;
        if let Some(described) = sensor_of(&found) {
            selection.describe(&found.sensor, &described.description);
            // A wrong description is an error of the playback.
            if let Ok(sensor) = described.check() {
                grids.push(selection::grid(&sensor));
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
    for note in playback.left_out() {
        hardnessd_core::stderr_line!("warning: {note}");
    }
    // A press that is still under way gets no verdict.
    selection.take(playback.end(), NOT_LOOKED_AT, &none);
    // A recording without a sensor has no press either, so this pitch is never used.
    grids.dedup();
    let grid = if let [grid] = grids[..] { grid } else { None };
    Ok((playback.labels(), pitch_mm.unwrap_or(PITCH_MM), grid))
}

/// The sensor that an entry describes.
fn sensor_of(found: &Found) -> Option<&RecordedSensor> {
    match &found.entry {
        Entry::State(state) => Some(&state.sensor),
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
        let recording = of_a_press(|d| d.sensor.arm.stiffness_n_per_mm = Some(10.0), None, true);
        let (found, arm_n_per_mm) = approach(&recording);
        assert_eq!(found, [0.0, 1.0, 2.0, 3.0, 4.0].map(Some));
        assert_eq!(arm_n_per_mm, 10.0);
    }

    #[test]
    fn what_the_context_of_a_press_says_counts_more_than_the_labels() {
        let truth = |context: Value| {
            let (bytes, sensor) = of_a_press(|_| {}, Some(context), false);
            let press = Pressed::of(&bytes, &sensor, &hrn())
                .unwrap()
                .judged
                .remove(0);
            (press.level, press.object)
        };
        let cup = json!({"sensor": "forearm", "level": 3, "object": "cup"});
        assert_eq!(truth(cup), (Some(3), Some("cup".to_owned())));
        assert_eq!(truth(json!({"level": 99, "object": 7})), (None, None));
        assert_ne!(number_of("cup"), number_of("mug"));
    }

    #[test]
    fn without_positions_the_approach_is_that_of_the_speed() {
        let check = |configured, context, sends, expected: [f32; 5]| {
            let recording = of_a_press(|d| d.sensor.arm.speed_mm_s = configured, context, sends);
            assert_eq!(approach(&recording).0, expected.map(Some));
        };
        let context = Some(json!({"speed_mm_s": 10.0}));
        // The arm stops when loading ends, with the fourth frame.
        check(Some(5.0), None, false, [0.0, 1.0, 2.0, 3.0, 3.0]);
        check(Some(5.0), context.clone(), false, [0.0, 2.0, 4.0, 6.0, 6.0]);
        check(None, context.clone(), false, [0.0, 2.0, 4.0, 6.0, 6.0]);
        // Where there are positions, the speed does not count.
        check(Some(9.0), context, true, [0.0, 1.0, 2.0, 3.0, 4.0]);

        let recording = of_a_press(
            |d| d.sensor.arm.stiffness_n_per_mm = Some(10.0),
            None,
            false,
        );
        assert_eq!(approach(&recording), (vec![None; 5], 0.0));
    }
}
