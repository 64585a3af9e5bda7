//! The state of one sensor: its link, its last frame, its curves, its presses and its verdicts.

use std::collections::VecDeque;
use std::time::Duration;

use serde_json::Value;

use crate::tools::answer::items;
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
    /// The last status. Null before the first one.
    pub(in crate::tools::watch) status: Value,
    /// The sensor's last frame.
    pub(in crate::tools::watch) frame: Option<Frame>,
    trace: VecDeque<Load>,
    /// The last event of a press, and its moment.
    pub(in crate::tools::watch) press: Option<(Duration, Value)>,
    /// The verdicts and their moments, the newest first.
    pub(in crate::tools::watch) verdicts: VecDeque<(Duration, Value)>,
    /// What is being pressed, and how many verdicts are right.
    pub(in crate::tools::watch) score: Score,
    /// The context of the last press.
    pub(super) context: Value,
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

impl Sensor {
    pub(super) fn new(card: &Value) -> Self {
        let size = |key| {
            let size = card[key].as_u64().map_or(1, |size| size as usize);
            size.clamp(1, MOST_SIDE)
        };
        Self {
            name: card["name"].as_str().unwrap_or_default().to_owned(),
            rows: size("rows"),
            cols: size("cols"),
            ..Self::default()
        }
    }

    /// Takes in an event.
    pub(super) fn take_event(&mut self, event: Value, at: Duration) {
        match event["type"].as_str() {
            Some("status") => self.status = event,
            Some("press") => {
                self.context = event["context"].clone();
                self.press = Some((at, event));
            }
            Some("hardness") => {
                self.score.take(&event);
                self.verdicts.push_front((at, event));
                self.verdicts.truncate(VERDICTS);
            }
            Some("frame") => self.show(&event, at),
            _ => {}
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
        self.trace.retain(|one| one.at + WINDOW >= at);
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
        let rate_hz = self.status["frame_rate_hz"].as_f64();
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
