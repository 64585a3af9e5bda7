//! A sensor, a model and a recorded press.
#![allow(
    clippy::unwrap_used,
    clippy::missing_panics_doc,
    reason = "this is test code, which clippy does not know as such"
)]

pub mod noisy_array;

use std::sync::{Arc, LazyLock};
use std::time::Duration;

use serde_json::Value;

use crate::frame::{Array, RawFrame, Stamp};
use crate::motion::Point;
use crate::pipeline::{Clock, Input, Pipeline};
use crate::recording::{About, Entry, Labels, RecordedSensor, State, Writer};
use crate::sensor::{Description, Sensor};
use crate::tare::Gains;
use crate::verdict::{BUILT_IN_HRN, Model};

/// The built-in model.
pub fn hrn() -> Arc<Model> {
    static HRN: LazyLock<Arc<Model>> =
        LazyLock::new(|| Arc::new(Model::load(BUILT_IN_HRN).unwrap()));
    Arc::clone(&HRN)
}

/// A JX255N called "forearm", changed by a closure.
pub fn sensor_of(change: impl FnOnce(&mut Description)) -> Sensor {
    let mut described = Description::default();
    described.sensor.name = "forearm".to_owned();
    change(&mut described);
    Sensor::new(described).unwrap()
}

/// A sensor with a gain for each taxel and a baseline that follows drift.
pub fn sensor() -> Sensor {
    sensor_of(|described| {
        let gains = (1..=Array::JX255N.cols).map(|n| n as f32 / 14.3).collect();
        described.sensor.calibration.gains = Some(Gains::Taxels(vec![gains; Array::JX255N.rows]));
        described.sensor.calibration.auto_tare = true;
    })
}

/// The moment `ms` milliseconds after the first.
pub fn at(ms: u64) -> Stamp {
    let mono = Duration::from_millis(1_000_000 + ms) + Duration::from_nanos(7);
    // The calendar is set back in the middle, which must not change any duration.
    let step_s = if ms > 8_000 { -3_600 } else { 0 };
    let wall = jiff::Timestamp::new(1_790_000_000 + step_s, 123_456_789).unwrap();
    Stamp {
        mono,
        wall: wall.checked_add(Duration::from_millis(ms)).unwrap(),
    }
}

/// A recording that begins just before a press, and its sensor. The press loads in four frames, one
/// every 200 ms, and holds for one. An arm at 5 mm/s sends positions if `sends`, all of them before
/// the recording begins.
pub fn of_a_press(
    change: impl FnOnce(&mut Description),
    context: Option<Value>,
    sends: bool,
) -> (Vec<u8>, Sensor) {
    of_a_labelled_press(&labels(), change, context, sends)
}

/// Like [`of_a_press`], with these labels of the recording.
pub fn of_a_labelled_press(
    labels: &Labels,
    change: impl FnOnce(&mut Description),
    context: Option<Value>,
    sends: bool,
) -> (Vec<u8>, Sensor) {
    let (sensor, hrn) = (sensor_of(change), hrn());
    let about = about(labels, RecordedSensor::new(&sensor, &hrn));
    let mut writer = Writer::new(Vec::new(), &about).unwrap();
    let mut pipeline = Pipeline::new(sensor.clone(), hrn, Clock::Arrival);
    let bytes = |counts: u16| {
        let mut raw = RawFrame::default();
        raw.counts[400..409].fill(counts.into());
        let mut bytes = Vec::new();
        sensor.layout().encode(&raw, &mut bytes);
        bytes
    };
    let tare_frames = u64::from(sensor.calibration().tare_frames);
    for frame in 0..=tare_frames {
        let input = Input::Bytes(bytes(0));
        pipeline.take(input, at(200 * frame)).unwrap();
    }
    let begin_ms = 200 * (tare_frames + 1);
    if sends {
        let point = |step: u64| Point {
            at_ns: i64::try_from(at(begin_ms - 200 + 50 * step).mono.as_nanos()).unwrap(),
            mm: 0.25 * step as f64,
        };
        let points: Vec<Point> = (0..40).map(point).collect();
        let input = Input::Motion(points);
        pipeline.take(input, at(begin_ms)).unwrap();
    }
    let came = at(begin_ms);
    pipeline.take(Input::Context(context), came).unwrap();
    let state = State::of(&pipeline, labels).unwrap();
    writer
        .entry(0, came, &Entry::State(Box::new(state)))
        .unwrap();
    for (frame, counts) in (0..).zip([20, 40, 60, 80, 80, 0, 0]) {
        let input = Input::Bytes(bytes(counts));
        let came = at(begin_ms + 200 * frame);
        writer.entry(0, came, &Entry::Input(input)).unwrap();
    }
    (writer.finish().unwrap(), sensor)
}

/// What begins a recording of a sensor.
pub fn about(labels: &Labels, sensor: RecordedSensor) -> About {
    About {
        robot: "arm-7".to_owned(),
        run: "r".to_owned(),
        boot_id: "b".to_owned(),
        reason: None,
        labels: labels.clone(),
        sensors: vec![sensor],
    }
}

/// Labels of a recording.
pub fn labels() -> Labels {
    Labels::from([("level".to_owned(), "2".to_owned())])
}
