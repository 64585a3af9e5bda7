//! The force and the contact area of a sensor in the last two minutes, for views that open later.

use std::collections::VecDeque;

use jiff::{SignedDuration, Timestamp};
use serde_json::{Value, json};

use hardnessd_core::event::{FrameEvent, round_3};

/// How far back a history goes.
const SPAN: SignedDuration = SignedDuration::from_secs(120);

/// Of the frames within this time, the one with the most force is kept.
const STEP_MS: i64 = 100;

/// One sensor's history, the oldest point first.
#[derive(Debug, Default, Clone)]
pub(crate) struct History(VecDeque<Point>);

#[derive(Debug, Clone, Copy)]
struct Point {
    at: Timestamp,
    force_n: f32,
    contact_area_taxels: u32,
}

impl Point {
    fn step(&self) -> i64 {
        self.at.as_millisecond().div_euclid(STEP_MS)
    }
}

impl History {
    /// Adds a frame. A frame before the first tare has no force.
    pub(super) fn add(&mut self, frame: &FrameEvent) {
        let Some(force_n) = frame.force_n else { return };
        let point = Point {
            at: frame.time,
            force_n: force_n as f32,
            contact_area_taxels: frame.contact_area_taxels,
        };
        match self.0.back_mut() {
            Some(last) if last.step() == point.step() => {
                if point.force_n >= last.force_n {
                    *last = point;
                }
                return;
            }
            // The clock was set back.
            Some(last) if last.at > point.at => self.0.clear(),
            _ => {}
        }
        let is_old = |first: &Point| point.at.duration_since(first.at) > SPAN;
        while self.0.front().is_some_and(is_old) {
            self.0.pop_front();
        }
        self.0.push_back(point);
    }

    /// The history as JSON. A point has its age at `time` in seconds, newtons and taxels.
    pub(crate) fn json(&self, sensor: &str) -> Value {
        let newest = self.0.back().map(|point| point.at);
        let point = |point: &Point| {
            let age = newest.unwrap_or(point.at).duration_since(point.at);
            json!([
                round_3(age.as_secs_f64()),
                round_3(point.force_n.into()),
                point.contact_area_taxels
            ])
        };
        json!({
            "type": "history",
            "sensor": sensor,
            "time": newest.map(|time| format!("{time:.6}")),
            "points": self.0.iter().map(point).collect::<Vec<_>>(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(ms: i64, newtons: f32) -> FrameEvent {
        FrameEvent {
            sensor: "forearm".to_owned(),
            time: Timestamp::from_millisecond(1_700_000_000_000 + ms).unwrap(),
            frame: 0,
            rows: 1,
            cols: 2,
            newtons: vec![newtons, 1.0],
            contact_area_taxels: newtons as u32,
            force_n: Some(f64::from(newtons) + 1.0),
            tared: true,
            approach_mm: None,
        }
    }

    fn points(history: &History) -> Value {
        history.json("forearm")["points"].clone()
    }

    #[test]
    fn the_most_force_of_each_step_is_kept_for_two_minutes() {
        let mut history = History::default();
        assert_eq!(points(&history), json!([]));
        for (ms, newtons) in [(0, 2.0), (40, 5.0), (80, 3.0), (210, 4.0)] {
            history.add(&frame(ms, newtons));
        }
        assert_eq!(points(&history), json!([[0.17, 6.0, 5], [0.0, 5.0, 4]]));
        history.add(&frame(120_100, 1.0));
        assert_eq!(points(&history), json!([[119.89, 5.0, 4], [0.0, 2.0, 1]]));
        history.add(&frame(60_000, 7.0));
        assert_eq!(points(&history), json!([[0.0, 8.0, 7]]));
    }
}
