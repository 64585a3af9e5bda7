//! The presses that were judged, with all their frames, from the daemon's own events.

use std::collections::BTreeMap;
use std::time::Duration;

use serde_json::Value;

use hardnessd_core::event::{Event, Hardness, Phase, PressState};
use hardnessd_core::frame::{Array, Frame, Stamp};
use hardnessd_core::judge::{approach_by_speed, approach_speed_mm_s, is_informative};
use hardnessd_core::motion::Track;
use hardnessd_core::press::thinned;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::verdict::{COLS, COURSE_FRAMES, ModelFrame, ROWS, Resampling};

use crate::data::source::{MOST_LEVELS, PITCH_MM};

/// A press that was judged.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Judged {
    /// The sensor's name.
    pub(super) sensor: String,
    /// Total force of the chosen frame.
    pub(super) force_n: f32,
    /// The press's frames in contact, thinned, each with the seconds since the press began and the approach since
    /// then, where it is known.
    pub(super) moments: Vec<(f32, Option<f32>, ModelFrame)>,
    /// Index of the chosen frame in `moments`.
    pub(super) best: usize,
    /// Stiffness of the arm. 0 if the stiffness or the approach is unknown.
    pub(super) arm_n_per_mm: f32,
    /// The number of the press.
    pub(super) press: u64,
    /// The whole array before the touch, with what the tare takes off.
    pub(super) unloaded: Vec<f32>,
    /// The level and the name of the object, if the context of the press says them.
    pub(super) level: Option<u8>,
    pub(super) object: Option<String>,
}

/// The presses found so far, and what is held of each sensor to find more.
#[derive(Debug, Default)]
pub(super) struct Selection {
    held: BTreeMap<String, Held>,
    pub(super) presses: Vec<Judged>,
}

/// The frames and the press of one sensor.
#[derive(Debug)]
struct Held {
    /// The frames of the press under way. Without a press, the newest frame.
    frames: BTreeMap<u64, Shown>,
    is_pressed: bool,
    /// Numbers of the first and the last frame of the press.
    began: u64,
    last: u64,
    /// The speed of the approach when the press under way began, if it is known.
    speed_mm_s: Option<f64>,
    /// The last frame before the first tare, and the two last ones between presses.
    untared: Vec<f32>,
    at_rest: [Vec<f32>; 2],
    sensor: Sensor,
}

/// A frame, as a model gets it.
#[derive(Debug)]
struct Shown {
    mono: Duration,
    area: u32,
    frame: Frame,
}

impl Selection {
    /// Takes a sensor as it is from now on.
    pub(super) fn describe(&mut self, sensor: &Sensor) {
        match self.held.get_mut(sensor.name()) {
            Some(held) => held.sensor = sensor.clone(),
            None => {
                let held = Held {
                    frames: BTreeMap::new(),
                    is_pressed: false,
                    began: 0,
                    last: 0,
                    speed_mm_s: None,
                    untared: Vec::new(),
                    at_rest: [Vec::new(), Vec::new()],
                    sensor: sensor.clone(),
                };
                self.held.insert(sensor.name().to_owned(), held);
            }
        }
    }

    /// Takes the events of the input that arrived at `at`. `track` has the positions of the arm, as
    /// the pipeline of these events knows them.
    pub(super) fn take(&mut self, events: Vec<Event>, at: Stamp, track: &Track) {
        for event in events {
            let Some(held) = self.held.get_mut(event.sensor()) else {
                continue;
            };
            match event {
                Event::Frame(frame) => {
                    if !held.is_pressed {
                        held.frames.clear();
                    }
                    let array = Array {
                        rows: frame.rows,
                        cols: frame.cols,
                    };
                    if !frame.tared {
                        held.untared = frame.newtons.clone();
                    } else if !held.is_pressed {
                        let [before, newest] = &mut held.at_rest;
                        *before = std::mem::replace(newest, frame.newtons.clone());
                    }
                    let newtons = frame.newtons.into();
                    let threshold_n = held.sensor.thresholds().contact_threshold_n;
                    let shown = Shown {
                        mono: at.mono_of(frame.time),
                        area: frame.contact_area_taxels,
                        frame: Frame { array, newtons }.felt(threshold_n),
                    };
                    held.frames.insert(frame.frame, shown);
                }
                // The press's first frame came just before this event.
                Event::Press(press) => {
                    held.is_pressed = press.state == PressState::Begin;
                    match press.state {
                        PressState::Begin => {
                            held.began = press.frame;
                            let (context, arm) = (press.context.as_ref(), held.sensor.arm());
                            held.speed_mm_s = approach_speed_mm_s(context, arm);
                        }
                        PressState::End | PressState::Aborted => held.last = press.frame,
                    }
                }
                Event::Hardness(verdict) if verdict.phase == Phase::Final => {
                    self.presses.extend(held.judged(&verdict, track));
                }
                Event::Hardness(_) | Event::Status(_) => {}
            }
        }
    }
}

impl Held {
    /// The array before the touch. The newest frame between presses is the one that began the press.
    fn unloaded(&self) -> Vec<f32> {
        let [at_rest, touched] = &self.at_rest;
        let of = |newtons: &[f32], place: usize| newtons.get(place).copied().unwrap_or(0.0);
        let whole = |place| of(at_rest, place) + of(&self.untared, place);
        (0..touched.len()).map(whole).collect()
    }

    /// The press that has just ended. A playback begins at rest, so all its frames are there.
    fn judged(&self, verdict: &Hardness, track: &Track) -> Option<Judged> {
        let least = self.sensor.thresholds().end_area_taxels;
        let pressed = self.frames.range(self.began..=self.last.max(self.began));
        let pressed: Vec<(u64, &Shown)> = pressed
            .filter(|(_, shown)| shown.area >= least)
            .map(|(&number, shown)| (number, shown))
            .collect();
        let mut numbers = pressed.iter().map(|&(number, _)| number);
        let best = numbers.position(|number| number == verdict.frame)?;
        let pitch = self.sensor.calibration().pitch_mm;
        let resampling = Resampling::new(&pressed[best].1.frame, pitch, grid_mm(&self.sensor));
        let times: Vec<Duration> = pressed.iter().map(|(_, shown)| shown.mono).collect();
        let arm = self.sensor.arm();
        let (begin, end) = (times[0], times[times.len() - 1]);
        // The approach is what the daemon would give a model: from positions, or else from the speed.
        let way = if track.has_recent(end, arm.delay_ms) {
            track.approach(begin, &times, arm.delay_ms)
        } else {
            self.speed_mm_s.map(|speed_mm_s| {
                let shown = pressed.iter().map(|(_, shown)| shown.frame.force_n());
                let forces_n: Vec<f64> = shown.collect();
                approach_by_speed(speed_mm_s, &times, &forces_n)
            })
        };
        let way = way.filter(|way| is_informative(way, best));
        let is_known = way.is_some();
        let way = way.unwrap_or_else(|| vec![None; times.len()]);
        let kept = thinned(pressed.len(), best, COURSE_FRAMES.1);
        let mut before_s = -1.0_f32;
        let moments = kept.iter().map(|&place| {
            // Two frames may have arrived at the same moment, but times in a file must ascend.
            let time_s = times[place].saturating_sub(begin).as_secs_f32();
            before_s = time_s.max(before_s.next_up());
            let frame = resampling.apply(&pressed[place].1.frame);
            (before_s, way[place].map(|mm| mm as f32), frame)
        });
        let said = |key| verdict.context.as_ref()?.get(key);
        let is_level = |level: &u8| (1..=MOST_LEVELS).contains(&usize::from(*level));
        let level = |number| u8::try_from(number).ok().filter(is_level);
        Some(Judged {
            sensor: verdict.sensor.clone(),
            force_n: verdict.force_n as f32,
            moments: moments.collect(),
            best: kept.iter().position(|&place| place == best)?,
            arm_n_per_mm: match is_known {
                true => arm.stiffness_n_per_mm.unwrap_or(0.0) as f32,
                false => 0.0,
            },
            press: verdict.press,
            unloaded: self.unloaded(),
            level: said("level").and_then(Value::as_u64).and_then(level),
            object: said("object").and_then(Value::as_str).map(str::to_owned),
        })
    }
}

/// The array of a sensor whose frames a data set has as they are.
pub(super) fn grid(sensor: &Sensor) -> Option<Array> {
    let array = sensor.layout().array();
    let pitch = sensor.calibration().pitch_mm;
    let is_kept = array.rows <= ROWS && array.cols <= COLS && pitch.rows_mm == pitch.cols_mm;
    is_kept.then_some(array)
}

/// The distance between the taxels of the grid on which a data set holds the frames of `sensor`. An
/// array that fits into a data set is kept as it is.
pub(super) fn grid_mm(sensor: &Sensor) -> f64 {
    match grid(sensor) {
        Some(_) => sensor.calibration().pitch_mm.rows_mm,
        None => PITCH_MM,
    }
}
