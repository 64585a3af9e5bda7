//! The state of one sensor: its link, its last frame, its curves, its presses and its verdicts.

use std::collections::VecDeque;
use std::time::Duration;

use serde_json::Value;

use super::{plain, text};
use crate::tools::answer::{Answer, items};
use crate::tools::readable::number;
use hardnessd_core::frame::{Array, MOST_SIDE};
use hardnessd_core::sensor::LATE_PERIODS;

/// How far back the curves go.
pub(in crate::tools::watch) const WINDOW: Duration = Duration::from_secs(30);

/// The most frames of a press whose approach is kept: 30 s at 1000 frames/s.
const MOST_WAY: usize = 30_000;

/// The number of verdicts kept for a sensor: more than a tall terminal shows.
const VERDICTS: usize = 100;

/// One sensor.
#[derive(Debug, Default)]
pub(in crate::tools::watch) struct Sensor {
    pub(in crate::tools::watch) name: String,
    pub(in crate::tools::watch) rows: usize,
    pub(in crate::tools::watch) cols: usize,
    pub(in crate::tools::watch) status: Option<Status>,
    /// The sensor's last frame.
    pub(in crate::tools::watch) frame: Option<Frame>,
    trace: VecDeque<Load>,
    /// Approach in mm and force in newtons of the frames of the present or last press, where the
    /// approach is known.
    way: Vec<(f32, f32)>,
    /// Whether the last point of `way` is of the newest frame.
    is_way_current: bool,
    pub(in crate::tools::watch) press: Option<Press>,
    /// The verdicts, the newest press first.
    pub(in crate::tools::watch) verdicts: VecDeque<Verdict>,
}

/// The state of a link, as the daemon reports it.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::tools::watch) struct Status {
    pub(super) state: String,
    pub(super) reason: Option<String>,
    pub(in crate::tools::watch) frames: u64,
    pub(in crate::tools::watch) frames_damaged: u64,
    pub(in crate::tools::watch) bytes_skipped: u64,
    pub(in crate::tools::watch) frame_rate_hz: Option<f64>,
}

/// The last frame.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::tools::watch) struct Frame {
    pub(in crate::tools::watch) at: Duration,
    /// `[rows, cols]`, newtons a taxel.
    newtons: Vec<f32>,
    pub(in crate::tools::watch) force_n: f32,
    pub(in crate::tools::watch) contact_area_taxels: u32,
}

/// A point of the curves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::tools::watch) struct Load {
    at: Duration,
    pub(in crate::tools::watch) force_n: f32,
    pub(in crate::tools::watch) contact_area_taxels: u32,
}

/// The last press.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::tools::watch) struct Press {
    pub(in crate::tools::watch) at: Duration,
    pub(in crate::tools::watch) number: u64,
    pub(in crate::tools::watch) state: String,
    pub(in crate::tools::watch) reason: Option<String>,
}

/// A verdict.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::tools::watch) struct Verdict {
    pub(in crate::tools::watch) at: Duration,
    pub(in crate::tools::watch) press: u64,
    pub(in crate::tools::watch) phase: String,
    pub(in crate::tools::watch) answer: String,
    /// Whether the answer must not look like a sure level.
    pub(in crate::tools::watch) is_weak: bool,
    pub(in crate::tools::watch) probabilities: Vec<f64>,
    pub(in crate::tools::watch) force_n: f64,
    /// The Shore hardness and its interval.
    pub(in crate::tools::watch) shore: Option<[f64; 3]>,
    pub(in crate::tools::watch) notes: Vec<String>,
}

impl Sensor {
    pub(super) fn new(card: &Value) -> Self {
        let size = |key| {
            let size = card[key]
                .as_u64()
                .and_then(|size| usize::try_from(size).ok());
            size.unwrap_or(1).clamp(1, MOST_SIDE)
        };
        Self {
            name: text(card, "name"),
            rows: size("rows"),
            cols: size("cols"),
            ..Self::default()
        }
    }

    /// Takes in an event. `labels` are those of the model's levels.
    pub(super) fn take_event(
        &mut self,
        kind: &str,
        event: &Value,
        at: Duration,
        labels: &[String],
    ) {
        match kind {
            "status" => {
                self.status = Some(Status {
                    state: text(event, "state"),
                    reason: event["reason"].as_str().map(plain),
                    frames: number(event, "frames"),
                    frames_damaged: number(event, "frames_damaged"),
                    bytes_skipped: number(event, "bytes_skipped"),
                    frame_rate_hz: event["frame_rate_hz"].as_f64(),
                });
            }
            "press" => {
                let press = Press {
                    at,
                    number: number(event, "press"),
                    state: text(event, "state"),
                    reason: event["reason"].as_str().map(plain),
                };
                if press.state == "begin" {
                    // The newest frame is the first one of this press. Its approach is often
                    // unknown, because the position after it has not come yet. All points are then
                    // of the press before.
                    let first = usize::from(self.is_way_current);
                    self.way.drain(..self.way.len().saturating_sub(first));
                }
                // The daemon may send past events after present ones.
                let is_older = |known: &Press| (known.number, known.at) > (press.number, press.at);
                if !self.press.as_ref().is_some_and(is_older) {
                    self.press = Some(press);
                }
            }
            "hardness" => self.judge(event, at, labels),
            "frame" => self.show(event, at),
            "history" => self.recall(event, at),
            _ => {}
        }
    }

    fn judge(&mut self, event: &Value, at: Duration, labels: &[String]) {
        let Answer {
            text: answer,
            is_weak,
        } = Answer::of(event, labels);
        let shore = |key| event["shore"][key].as_f64();
        let shore = shore("value").zip(shore("low")).zip(shore("high"));
        let verdict = Verdict {
            at,
            press: number(event, "press"),
            phase: text(event, "phase"),
            answer: plain(&answer),
            is_weak,
            probabilities: items(event, "probabilities")
                .filter_map(Value::as_f64)
                .collect(),
            force_n: event["force_n"].as_f64().unwrap_or_default(),
            shore: shore.map(|((value, low), high)| [value, low, high]),
            notes: items(event, "notes")
                .filter_map(Value::as_str)
                .map(|note| plain(note).replace('_', " "))
                .collect(),
        };
        // The newest press comes first, its final verdict before its early one. A repeated verdict
        // may be known already.
        let order = |one: &Verdict| (one.press, one.phase == "final");
        let place = self
            .verdicts
            .partition_point(|known| order(known) > order(&verdict));
        let is_known = |known: &Verdict| order(known) == order(&verdict);
        if !self.verdicts.get(place).is_some_and(is_known) {
            self.verdicts.insert(place, verdict);
            self.verdicts.truncate(VERDICTS);
        }
    }

    /// Puts the curves of earlier frames before those that are known. The newest of them is of `at`.
    fn recall(&mut self, event: &Value, at: Duration) {
        let first = self.trace.front().map_or(Duration::MAX, |load| load.at);
        let load = |point: &Value| {
            let age = Duration::try_from_secs_f64(point[0].as_f64()?).ok()?;
            Some(Load {
                at: at.checked_sub(age)?,
                force_n: point[1].as_f64()? as f32,
                contact_area_taxels: u32::try_from(point[2].as_u64()?).ok()?,
            })
        };
        let past = items(event, "points").filter_map(load);
        let past: Vec<Load> = past.filter(|load| load.at < first).collect();
        for load in past.into_iter().rev() {
            self.trace.push_front(load);
        }
    }

    fn show(&mut self, event: &Value, at: Duration) {
        let newtons: Vec<f32> = items(event, "newtons")
            .filter_map(Value::as_f64)
            .map(|newtons| newtons as f32)
            .collect();
        if newtons.len() != self.rows * self.cols {
            return;
        }
        let load = Load {
            at,
            force_n: newtons.iter().sum(),
            contact_area_taxels: u32::try_from(number(event, "contact_area_taxels"))
                .unwrap_or_default(),
        };
        while self
            .trace
            .front()
            .is_some_and(|first| first.at + WINDOW < at)
        {
            self.trace.pop_front();
        }
        self.trace.push_back(load);
        let mm = event["approach_mm"].as_f64();
        let mm = mm.filter(|_| self.way.len() < MOST_WAY);
        self.way.extend(mm.map(|mm| (mm as f32, load.force_n)));
        self.is_way_current = mm.is_some();
        self.frame = Some(Frame {
            at,
            newtons,
            force_n: load.force_n,
            contact_area_taxels: load.contact_area_taxels,
        });
    }

    /// Newtons of the taxel at a row and column in the last frame.
    pub(in crate::tools::watch) fn newtons(&self, row: usize, col: usize) -> Option<f32> {
        let (rows, cols) = (self.rows, self.cols);
        let frame = self.frame.as_ref()?;
        (row < rows && col < cols).then(|| frame.newtons[Array { rows, cols }.place(row, col)])
    }

    /// The greatest `value` in each of `spans` equal spans up to `now`. `None` where no frame was
    /// current.
    pub(in crate::tools::watch) fn curve(
        &self,
        now: Duration,
        spans: usize,
        value: impl Fn(&Load) -> f32,
    ) -> Vec<Option<f32>> {
        let span = WINDOW.as_secs_f64() / spans.max(1) as f64;
        let begin = now.as_secs_f64() - WINDOW.as_secs_f64();
        let rate_hz = self.status.as_ref().and_then(|status| status.frame_rate_hz);
        let mut curve = vec![None; spans];
        let mut held: Vec<Option<f32>> = vec![None; spans];
        for load in &self.trace {
            let place = (load.at.as_secs_f64() - begin) / span;
            if place >= 0.0 && (place as usize) < spans {
                let cell: &mut Option<f32> = &mut curve[place as usize];
                *cell = Some(cell.map_or(value(load), |most| most.max(value(load))));
            }
            // The value also holds for the following spans while the frame is current.
            let current = rate_hz.map_or(0.0, |hz| LATE_PERIODS / hz / span);
            let first = place.max(0.0) as usize;
            let last = (place + current).max(0.0) as usize;
            for cell in held.iter_mut().take(last).skip(first) {
                *cell = Some(value(load));
            }
        }
        let filled = curve.into_iter().zip(held);
        filled.map(|(own, held)| own.or(held)).collect()
    }

    /// The greatest force in each of `parts` equal parts of the arm's way in the present or last
    /// press, and how far the arm went in mm. `None` if the approach is unknown.
    pub(in crate::tools::watch) fn way(&self, parts: usize) -> Option<(Vec<Option<f32>>, f32)> {
        let far = self.way.iter().map(|&(mm, _)| mm).fold(0.0, f32::max);
        if self.way.len() < 2 || far <= 0.0 || parts == 0 {
            return None;
        }
        let mut forces = vec![None; parts];
        for &(mm, force) in &self.way {
            let part = (mm.max(0.0) / far * parts as f32) as usize;
            let known: &mut Option<f32> = &mut forces[part.min(parts - 1)];
            *known = Some(known.map_or(force, |most| most.max(force)));
        }
        // A slow sensor leaves parts without a frame. Such a part repeats the force of the part
        // before it.
        let mut before = None;
        for force in &mut forces {
            *force = force.or(before);
            before = *force;
        }
        Some((forces, far))
    }

    /// The greatest force on a taxel in the last frame, in newtons.
    pub(in crate::tools::watch) fn highest_n(&self) -> f32 {
        let newtons = self.frame.iter().flat_map(|frame| &frame.newtons);
        newtons.copied().fold(0.0, f32::max)
    }
}
