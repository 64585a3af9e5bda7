//! How many presses and verdicts a sensor had since the start, for the metrics.

use std::collections::BTreeMap;

use hardnessd_core::event::{Event, name};

/// The name of a metric, and the labels of one of its series.
pub(crate) type Series = (&'static str, Vec<(&'static str, String)>);

/// Counts of one sensor.
#[derive(Debug, Clone, Default)]
pub(crate) struct Counts(pub(crate) BTreeMap<Series, u64>);

impl Counts {
    /// Counts an event of this sensor.
    pub(super) fn count(&mut self, event: &Event) {
        let series = match event {
            Event::Status(_) | Event::Frame(_) => return,
            Event::Press(press) => ("presses", vec![("state", name(&press.state))]),
            Event::Hardness(verdict) => {
                let phase = ("phase", name(&verdict.phase));
                match (&verdict.rejected, verdict.level) {
                    (Some(reason), _) => {
                        ("verdicts_rejected", vec![phase, ("reason", name(reason))])
                    }
                    (None, Some(level)) => ("verdicts", vec![phase, ("level", level.to_string())]),
                    (None, None) => return,
                }
            }
        };
        *self.0.entry(series).or_default() += 1;
    }
}
