//! The presses in one recording, and what its labels say of them.

use std::sync::Arc;

use anyhow::{Context as _, ensure};
use hardnessd_core::exit::USAGE;
use hardnessd_core::frame::{Array, Stamp};
use hardnessd_core::motion::Track;
use hardnessd_core::pipeline::{Clock, Input, Pipeline};
use hardnessd_core::recording::{Entry, FileKind, Labels, Playback, Reader};
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::{Borders, Hrn, sha256_hex};
use hardnessd_simulator::Reference;

use super::selection::{self, Judged, Selection, grid_mm};
use super::{NO_MATERIAL, Settings};
use crate::data::presses::Layout;
use crate::data::presses::file::SHORE;
use crate::data::source::{MOST_LEVELS, PITCH_MM};
use crate::exit::coded;

/// What options and labels say of all presses of a recording.
pub(super) struct Said<'a> {
    pub(super) level: u8,
    /// Whether what was said of a press while it was made counts more than the level here.
    pub(super) by_press: bool,
    pub(super) object: Option<u32>,
    pub(super) shore: Option<f32>,
    pub(super) material: &'a str,
    pub(super) reference: Option<Reference>,
}

impl<'a> Said<'a> {
    /// What `settings` and labels say. `is_said`: something was said of the level of a press while it was made.
    pub(super) fn of(
        labels: &'a Labels,
        settings: &Settings,
        is_said: bool,
    ) -> anyhow::Result<Self> {
        let expected = "flat:MM or ball:MM with 0.1 to 1000 mm";
        let reference = label(labels, "reference", expected, reference)?;
        ensure!(
            reference.is_none() || settings.layout == Layout::OverTime,
            "label reference: collect presses of rigid pieces with --sequences"
        );
        let shore = |text: &str| text.parse().ok().filter(|shore| SHORE.contains(shore));
        let shore = label(labels, "shore", "a number from 0 to 100", shore)?;
        let expected =
            "the name of a level, or a number from 0 (unlabelled) to 16: --level gives another one";
        let level = match (reference, settings.level) {
            (Some(_), _) => Some(0),
            (None, Some(given)) => Some(given),
            (None, None) => label(labels, "level", expected, |text| level(text, settings))?,
        };
        let of_shore = || {
            let borders = Borders::of(&settings.levels).ok()?;
            Some(settings.levels[borders.place_of(shore?)].level)
        };
        let level = level.or_else(of_shore).or_else(|| is_said.then_some(0));
        let no_level = || {
            coded(
                USAGE,
                "the recording has no label `level`: give its level with --level",
            )
        };
        let expected = "a number: --object gives another one";
        Ok(Self {
            level: level.ok_or_else(no_level)?,
            by_press: reference.is_none() && settings.level.is_none(),
            object: match settings.object {
                None => label(labels, "object", expected, |text| text.parse().ok())?,
                given => given,
            },
            shore: shore.filter(|_| reference.is_none()),
            material: labels.get("material").map_or(NO_MATERIAL, String::as_str),
            reference,
        })
    }
}

/// A label as `read` reads it, if there is one.
fn label<T>(
    labels: &Labels,
    key: &str,
    expected: &str,
    read: impl Fn(&str) -> Option<T>,
) -> anyhow::Result<Option<T>> {
    let Some(text) = labels.get(key) else {
        return Ok(None);
    };
    let read =
        read(text).with_context(|| format!("label {key}: found {text:?}, expected {expected}"));
    read.map(Some)
}

/// The rigid piece that a label names, as `identify` does.
fn reference(label: &str) -> Option<Reference> {
    let (form, mm) = label.split_once(':')?;
    let mm: Option<f32> = mm.parse().ok().filter(|mm| (0.1..=1000.0).contains(mm));
    match (form, mm?) {
        ("flat", width_mm) => Some(Reference::Flat { width_mm }),
        ("ball", radius_mm) => Some(Reference::Ball { radius_mm }),
        _ => None,
    }
}

/// The level that a label names or numbers.
fn level(label: &str, settings: &Settings) -> Option<u8> {
    let mut levels = settings.levels.iter();
    let named = levels.find(|level| level.label.eq_ignore_ascii_case(label));
    let numbered = label.parse().ok();
    let numbered = numbered.filter(|level| usize::from(*level) <= MOST_LEVELS);
    named.map(|level| level.level).or(numbered)
}

/// The number of an object that only has a name: the same in every recording.
pub(super) fn object_of(name: &str) -> u32 {
    let hash = sha256_hex(name.as_bytes());
    let number = u32::from_str_radix(&hash[..8], 16).expect("a hash is hexadecimal");
    // A half of the numbers is left to objects without a name.
    number >> 1
}

/// The labels of a recording. Raw bytes have none.
pub(super) fn labels(bytes: &[u8]) -> Labels {
    if FileKind::of(bytes) != FileKind::Recording {
        return Labels::new();
    }
    // Each part of a recording begins with a state, which has the labels.
    let states = Reader::new(bytes).map_while(Result::ok);
    let mut labels = states.filter_map(|found| match found.entry {
        Entry::State(state) => Some(state.labels),
        Entry::Input(_) => None,
    });
    labels.next().unwrap_or_default()
}

/// A recording has no press.
#[derive(Debug, thiserror::Error)]
#[error(
    "no press found: was the sensor pressed, and is this its layout? `hardnessd replay` shows what is in a recording"
)]
pub(super) struct NoPress;

/// What is in a recording: its presses, labels and pitch.
pub(super) struct Pressed {
    pub(super) judged: Vec<Judged>,
    pub(super) labels: Labels,
    pub(super) pitch_mm: f64,
    /// The one array of its sensors, if the frames are as they are.
    pub(super) grid: Option<Array>,
}

impl Pressed {
    /// Finds the presses. `sensor` is the sensor of a recording that does not describe its own, and
    /// `hrn` judges the presses.
    pub(super) fn of(bytes: &[u8], sensor: &Sensor, hrn: &Arc<Hrn>) -> anyhow::Result<Self> {
        let mut selection = Selection::default();
        let mut sensors = Vec::new();
        let labels = if FileKind::of(bytes) == FileKind::Recording {
            play(bytes, hrn, &mut selection, &mut sensors)?
        } else {
            let mut pipeline = Pipeline::new(sensor.clone(), hrn.clone(), Clock::FrameRate);
            selection.describe(sensor);
            sensors.push(sensor.clone());
            let none = Track::default();
            let events = pipeline.take(Input::Bytes(bytes.to_vec()), NOT_LOOKED_AT);
            selection.take(events.unwrap_or_default(), NOT_LOOKED_AT, &none);
            selection.take(pipeline.end_of_recording(None), NOT_LOOKED_AT, &none);
            Labels::new()
        };
        if selection.presses.is_empty() {
            return Err(NoPress.into());
        }
        // A recording with a press has a sensor.
        let expected = sensors.first().map_or(PITCH_MM, grid_mm);
        for found in sensors.iter().map(grid_mm) {
            ensure!(
                found == expected,
                "taxel pitch: found {found} mm, expected {expected} mm, that of its first sensor"
            );
        }
        let mut grids: Vec<_> = sensors.iter().map(selection::grid).collect();
        grids.dedup();
        Ok(Self {
            judged: selection.presses,
            labels,
            pitch_mm: expected,
            grid: if let [grid] = grids[..] { grid } else { None },
        })
    }
}

/// The time given to a pipeline whose clock is the frame rate.
const NOT_LOOKED_AT: Stamp = Stamp {
    mono: std::time::Duration::ZERO,
    wall: jiff::Timestamp::UNIX_EPOCH,
};

/// Plays a recording, and gives its labels. `sensors` gets the sensors that it describes.
fn play(
    bytes: &[u8],
    hrn: &Arc<Hrn>,
    selection: &mut Selection,
    sensors: &mut Vec<Sensor>,
) -> anyhow::Result<Labels> {
    let (mut playback, none) = (Playback::new(hrn.clone()), Track::default());
    for found in Reader::new(bytes) {
        let found = found?;
        // A wrong description is an error of the playback.
        if let Entry::State(state) = &found.entry
            && let Ok(sensor) = state.sensor.check()
        {
            selection.describe(&sensor);
            sensors.push(sensor);
        }
        let (at, sensor) = (found.at, found.sensor.clone());
        let events = playback.feed(found)?;
        selection.take(events, at, playback.track(&sensor).unwrap_or(&none));
    }
    for note in playback.left_out() {
        hardnessd_core::stderr_line!("warning: {note}");
    }
    ensure!(
        !sensors.is_empty(),
        "found no state of a sensor, expected a recording of hardnessd"
    );
    // A press that is still under way gets no verdict.
    selection.take(playback.end(), NOT_LOOKED_AT, &none);
    Ok(playback.labels())
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;
    use hardnessd_core::test_support::{hrn, of_a_press};

    /// The approach at each frame of the press of a recording, and the stiffness of the arm.
    fn approach((bytes, sensor): &(Vec<u8>, Sensor)) -> (Vec<Option<f32>>, f32) {
        let pressed = Pressed::of(bytes, sensor, &hrn()).unwrap();
        let [press] = &pressed.judged[..] else {
            panic!("one press");
        };
        let rounded = press
            .moments
            .iter()
            .map(|(_, mm, _)| Some(((*mm)? * 1e3).round() / 1e3));
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
        assert_ne!(object_of("cup"), object_of("mug"));
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
