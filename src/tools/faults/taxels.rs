//! Faults of taxels: the frame is whole, and what its taxels read is wrong.

use super::times::Span;
use hardnessd_core::frame::RawFrame;
use hardnessd_simulator::{FULL_SCALE_COUNTS, NEWTONS_PER_COUNT};

/// A fault of some taxels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct OfTaxels {
    pub(super) span: Span,
    pub(super) region: Region,
    pub(super) change: Change,
}

/// A rectangle of taxels: the first and the last row, the first and the last column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Region {
    pub(super) rows: [usize; 2],
    pub(super) cols: [usize; 2],
}

/// What happens to a taxel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Change {
    /// It reads this.
    Stuck { counts: u16 },
    /// It reads more and more during the time of the fault, and no less after it.
    Drift { newtons_per_hour: f64 },
    /// It reads this much more.
    Contact { newtons: f64 },
}

impl OfTaxels {
    /// Changes the frame that is due at `time_s`.
    pub(super) fn strike(&self, time_s: f64, raw: &mut RawFrame) {
        let Span { from_s, to_s } = self.span;
        match self.change {
            Change::Stuck { counts } if self.span.has(time_s) => {
                self.region.each(raw, |count| *count = counts);
            }
            Change::Contact { newtons } if self.span.has(time_s) => self.add(newtons, raw),
            Change::Drift { newtons_per_hour } if time_s >= from_s => {
                let hours = (time_s.min(to_s) - from_s) / 3600.0;
                self.add(newtons_per_hour * hours, raw);
            }
            Change::Stuck { .. } | Change::Contact { .. } | Change::Drift { .. } => {}
        }
    }

    fn add(&self, newtons: f64, raw: &mut RawFrame) {
        let more = newtons / f64::from(NEWTONS_PER_COUNT);
        let most = f64::from(FULL_SCALE_COUNTS);
        self.region.each(raw, |count| {
            *count = (f64::from(*count) + more).round().clamp(0.0, most) as u16;
        });
    }
}

impl Region {
    fn each(&self, raw: &mut RawFrame, change: impl Fn(&mut u16)) {
        let [first, last] = self.cols;
        for row in self.rows[0]..=self.rows[1] {
            let places = raw.array.place(row, first)..=raw.array.place(row, last);
            raw.counts[places].iter_mut().for_each(&change);
        }
    }
}
