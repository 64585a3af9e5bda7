//! How many events of each kind have been published since the start, for the metrics.

use std::collections::BTreeMap;

use hardnessd_core::event::{Event, Phase, PressState, Rejection};

/// Counts over all sensors of a run.
#[derive(Debug, Clone, Default)]
pub(crate) struct Tally {
    /// The counts of each sensor, by the sensor's name. A sensor that has published nothing is
    /// missing.
    pub(crate) sensors: BTreeMap<String, Counts>,
    /// The number of `gap` lines sent.
    pub(crate) gaps: u64,
    /// The number of events dropped because a subscriber's queue was full.
    pub(crate) dropped: u64,
}

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

impl Tally {
    pub(super) fn count(&mut self, event: &Event) {
        let counts = self.sensors.entry(event.sensor().to_owned()).or_default();
        match event {
            Event::Status(_) | Event::Frame(_) => {}
            Event::Press(press) => match press.state {
                PressState::Begin => counts.begun += 1,
                PressState::End => counts.ended += 1,
                PressState::Aborted => counts.aborted += 1,
            },
            Event::Hardness(verdict) => {
                let verdicts = match verdict.phase {
                    Phase::Early => &mut counts.early,
                    Phase::Final => &mut counts.finals,
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
