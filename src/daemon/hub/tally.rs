//! How many presses and verdicts a sensor had since the start, for the metrics.

use std::collections::BTreeMap;

use hardnessd_core::event::{Event, Phase, PressState, Rejection};

/// Counts of one sensor.
#[derive(Debug, Clone, Default)]
pub(crate) struct Counts {
    pub(crate) begun: u64,
    pub(crate) ended: u64,
    pub(crate) aborted: u64,
    pub(crate) early: Verdicts,
    pub(crate) finals: Verdicts,
}

/// Verdicts of one phase.
#[derive(Debug, Clone, Default)]
pub(crate) struct Verdicts {
    pub(crate) levels: BTreeMap<u8, u64>,
    pub(crate) low_confidence: u64,
    pub(crate) low_force: u64,
    pub(crate) ambiguous: u64,
}

impl Counts {
    /// Counts an event of this sensor.
    pub(super) fn count(&mut self, event: &Event) {
        match event {
            Event::Status(_) | Event::Frame(_) => {}
            Event::Press(press) => match press.state {
                PressState::Begin => self.begun += 1,
                PressState::End => self.ended += 1,
                PressState::Aborted => self.aborted += 1,
            },
            Event::Hardness(verdict) => {
                let verdicts = match verdict.phase {
                    Phase::Early => &mut self.early,
                    Phase::Final => &mut self.finals,
                };
                match verdict.rejected {
                    Some(Rejection::LowConfidence) => verdicts.low_confidence += 1,
                    Some(Rejection::LowForce) => verdicts.low_force += 1,
                    Some(Rejection::Ambiguous) => verdicts.ambiguous += 1,
                    None => {
                        if let Some(level) = verdict.level {
                            *verdicts.levels.entry(level).or_default() += 1;
                        }
                    }
                }
            }
        }
    }
}
