//! The state of one sensor: its link, its last frame, its curves, its presses and its verdicts.

use std::collections::VecDeque;
use std::time::Duration;

use serde_json::Value;

use super::{plain, text};
use crate::tools::answer::{Answer, items, with_shore};
use crate::tools::readable::number;
use crate::tools::score::Score;
use hardnessd_core::frame::{Array, MOST_SIDE};
use hardnessd_core::sensor::LATE_PERIODS;

/// How far back the curves go.
pub(in crate::tools::watch) const WINDOW: Duration = Duration::from_secs(30);

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
    pub(in crate::tools::watch) press: Option<Press>,
    /// The verdicts, the newest press first.
    pub(in crate::tools::watch) verdicts: VecDeque<Verdict>,
    /// What is being pressed, and how many verdicts are right.
    pub(in crate::tools::watch) score: Score,
    /// The context of the last press.
    pub(super) context: Value,
}

/// The state of a link, as the daemon reports it.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::tools::watch) struct Status {
    pub(super) state: String,
    pub(super) reason: Option<String>,
    pub(super) detail: Option<String>,
    pub(in crate::tools::watch) frames: u64,
    pub(in crate::tools::watch) frames_damaged: u64,
    pub(in crate::tools::watch) frames_dropped: u64,
    pub(in crate::tools::watch) bytes_skipped: u64,
    pub(in crate::tools::watch) frame_rate_hz: Option<f64>,
}

/// The last frame.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::tools::watch) struct Frame {
    pub(in crate::tools::watch) at: Duration,
    /// `[rows, cols]`, newtons a taxel.
    newtons: Vec<f32>,
    /// `None` until the sensor has a zero.
    pub(in crate::tools::watch) force_n: Option<f32>,
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
    pub(in crate::tools::watch) is_early: bool,
    /// Such as `63 +- 6 OO, firm`.
    pub(in crate::tools::watch) answer: String,
    /// Whether the answer must not look like a sure level.
    pub(in crate::tools::watch) is_weak: bool,
    pub(in crate::tools::watch) probabilities: Vec<f64>,
    pub(in crate::tools::watch) force_n: f64,
    /// The advice, and the notes.
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
                    detail: event["detail"].as_str().map(plain),
                    frames: number(event, "frames"),
                    frames_damaged: number(event, "frames_damaged"),
                    frames_dropped: number(event, "frames_dropped"),
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
                self.press = Some(press);
                self.context = event["context"].clone();
            }
            "hardness" => self.judge(event, at, labels),
            "frame" => self.show(event, at),
            _ => {}
        }
    }

    fn judge(&mut self, event: &Value, at: Duration, labels: &[String]) {
        let Answer {
            text: answer,
            is_weak,
        } = Answer::of(event, labels);
        let advice = event["advice"].as_str();
        let notes = items(event, "notes").filter_map(Value::as_str);
        let verdict = Verdict {
            at,
            press: number(event, "press"),
            is_early: event["phase"] == "early",
            answer: plain(&with_shore(&answer, event)),
            is_weak,
            probabilities: items(event, "probabilities")
                .filter_map(Value::as_f64)
                .collect(),
            force_n: event["force_n"].as_f64().unwrap_or_default(),
            notes: advice
                .into_iter()
                .chain(notes)
                .map(|note| plain(note).replace('_', " "))
                .collect(),
        };
        self.score.take(event);
        self.verdicts.push_front(verdict);
        self.verdicts.truncate(VERDICTS);
    }

    fn show(&mut self, event: &Value, at: Duration) {
        let newtons: Vec<f32> = items(event, "newtons")
            .filter_map(Value::as_f64)
            .map(|newtons| newtons as f32)
            .collect();
        if newtons.len() != self.rows * self.cols {
            return;
        }
        let force_n = event["force_n"].as_f64().map(|force_n| force_n as f32);
        let contact_area_taxels =
            u32::try_from(number(event, "contact_area_taxels")).unwrap_or_default();
        self.frame = Some(Frame {
            at,
            newtons,
            force_n,
            contact_area_taxels,
        });
        let Some(force_n) = force_n else { return };
        let load = Load {
            at,
            force_n,
            contact_area_taxels,
        };
        while self
            .trace
            .front()
            .is_some_and(|first| first.at + WINDOW < at)
        {
            self.trace.pop_front();
        }
        self.trace.push_back(load);
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

    /// The greatest force on a taxel in the last frame, in newtons.
    pub(in crate::tools::watch) fn highest_n(&self) -> f32 {
        let newtons = self.frame.iter().flat_map(|frame| &frame.newtons);
        newtons.copied().fold(0.0, f32::max)
    }
}
