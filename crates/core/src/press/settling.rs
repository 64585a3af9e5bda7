//! The check whether a contact has settled, so that an early verdict may come.

use std::collections::VecDeque;
use std::time::Duration;

use super::{ContactFrame, Settings};

/// The latest frames whose area and force are all near the largest ones so far.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Settling {
    near: VecDeque<Load>,
    most_area: u32,
    most_force_n: f64,
}

/// The contact of one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Load {
    at: Duration,
    contact_area_taxels: u32,
    force_n: f64,
}

impl Settling {
    /// Adds a frame. Returns true if area and force have stayed near their largest values so far,
    /// over at least `early_settle_s` and [`SETTLED_FRAMES`] frames, and the force is enough for a
    /// verdict.
    pub(super) fn push(&mut self, frame: &ContactFrame, settings: &Settings) -> bool {
        let load = Load {
            at: frame.moment.stamp.mono,
            contact_area_taxels: frame.contact_area_taxels,
            force_n: frame.force_n,
        };
        self.most_area = self.most_area.max(load.contact_area_taxels);
        self.most_force_n = self.most_force_n.max(load.force_n);
        self.near.push_back(load);
        let (most_area, most_force_n) = (self.most_area, self.most_force_n);
        let is_near = |load: &Load| {
            let area_gap = f64::from(most_area - load.contact_area_taxels);
            area_gap <= (SETTLED_SHARE * f64::from(most_area)).max(1.0)
                && most_force_n - load.force_n <= SETTLED_SHARE * most_force_n
        };
        // The largest values only grow, so a frame that is too far below them stays too far.
        if let Some(last_far) = self.near.iter().rposition(|load| !is_near(load)) {
            self.near.drain(..=last_far);
        }
        let settle = Duration::from_secs_f64(settings.early_settle_s);
        let covers = |first: &Load| load.at.saturating_sub(first.at) >= settle;
        while self.near.len() > SETTLED_FRAMES && self.near.get(1).is_some_and(covers) {
            self.near.pop_front();
        }
        load.force_n >= settings.early_min_force_n
            && self.near.len() >= SETTLED_FRAMES
            && self.near.front().is_some_and(covers)
    }
}

/// An early verdict needs this many settled frames.
const SETTLED_FRAMES: usize = 3;
/// The share by which a settled frame's area and force may be below the largest ones so far.
const SETTLED_SHARE: f64 = 0.05;
