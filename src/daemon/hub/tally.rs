//! How many presses and verdicts a sensor had since the start, for the metrics.

use std::collections::BTreeMap;

use hardnessd_core::event::{Event, name};

/// Counts of one sensor, by the labels of the metrics.
#[derive(Debug, Clone, Default)]
pub(crate) struct Counts {
    /// By state.
    pub(crate) presses: BTreeMap<String, u64>,
    /// By phase and level.
    pub(crate) verdicts: BTreeMap<[String; 2], u64>,
    /// By phase and reason.
    pub(crate) rejected: BTreeMap<[String; 2], u64>,
}

impl Counts {
    /// Counts an event of this sensor.
    pub(super) fn count(&mut self, event: &Event) {
        match event {
            Event::Status(_) | Event::Frame(_) => {}
            Event::Press(press) => *self.presses.entry(name(&press.state)).or_default() += 1,
            Event::Hardness(verdict) => {
                let phase = name(&verdict.phase);
                if let Some(reason) = &verdict.rejected {
                    *self.rejected.entry([phase, name(reason)]).or_default() += 1;
                } else if let Some(level) = verdict.level {
                    let labels = [phase, level.to_string()];
                    *self.verdicts.entry(labels).or_default() += 1;
                }
            }
        }
    }
}
