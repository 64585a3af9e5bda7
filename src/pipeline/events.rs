//! The press and hardness events of a pipeline.

use super::{Clock, Pipeline, Unjudged};
use crate::event::{Event, Hardness, Note, Phase, Press, PressState, Rejection};
use crate::frame::{Frame, RawFrame};
use crate::press::{Change, End, Marks, Moment, Peak};
use crate::sensor::Description;

impl Pipeline {
    /// Adds the events of a change.
    pub(super) fn publish(&mut self, change: Change, events: &mut Vec<Event>) {
        match change {
            Change::Begin { press, at } => {
                events.push(self.press(press, PressState::Begin, at, 1, None));
            }
            Change::Settled { press, peak } => {
                events.extend(self.judge(press, Phase::Early, &peak));
            }
            Change::End {
                press,
                last,
                frames,
                end,
                peak,
                course: _,
            } => {
                let reason = match end {
                    End::Release => None,
                    End::Timeout => Some("timeout"),
                };
                events.push(self.press(press, PressState::End, last, frames, reason));
                events.extend(self.judge(press, Phase::Final, &peak));
                let delay_ms = self.sensor.description().arm.delay_ms;
                self.track.judged(last.stamp.mono, delay_ms);
            }
            Change::Aborted {
                press,
                last,
                frames,
                reason,
            } => {
                let reason = Some(reason.reason());
                events.push(self.press(press, PressState::Aborted, last, frames, reason));
            }
        }
    }

    fn press(
        &self,
        press: u64,
        state: PressState,
        at: Moment,
        frames: u64,
        reason: Option<&'static str>,
    ) -> Event {
        Event::Press(Press {
            seq: None,
            sensor: self.sensor.name().to_owned(),
            time: at.stamp.wall,
            press,
            state,
            frame: at.frame,
            reason,
            frames,
            context: self.seen.context.clone(),
        })
    }

    /// The verdict on a press. A model that fails on its own check frames was refused when it was
    /// loaded. If it fails on another frame, the press gets no verdict, and [`Self::unjudged`] gives
    /// the failure.
    fn judge(&mut self, press: u64, phase: Phase, peak: &Peak) -> Option<Event> {
        let Description {
            min_confidence,
            min_force_n,
            calibration,
            ..
        } = self.sensor.description();
        let hrn = &self.hrn;
        let verdict = match hrn.judge(&peak.frame) {
            Ok(verdict) => verdict,
            Err(error) => {
                self.unjudged.push(Unjudged {
                    sensor: self.sensor.name().to_owned(),
                    press,
                    phase,
                    error,
                });
                return None;
            }
        };
        let rejected = if peak.force_n < *min_force_n {
            Some(Rejection::LowForce)
        } else if verdict.confidence < *min_confidence {
            Some(Rejection::LowConfidence)
        } else {
            None
        };
        let level = rejected.is_none().then_some(verdict.level);
        let label = level.and_then(|level| {
            let known = hrn
                .card()
                .levels
                .iter()
                .find(|known| known.level == level)?;
            Some(known.label.clone())
        });
        let pitch_mm = calibration.pitch_mm;
        let Moment { frame, stamp } = peak.moment;
        Some(Event::Hardness(Hardness {
            seq: None,
            sensor: self.sensor.name().to_owned(),
            time: stamp.wall,
            press,
            phase,
            level,
            label,
            rejected,
            notes: self.notes(peak),
            probabilities: verdict.probabilities,
            confidence: verdict.confidence,
            frame,
            contact_area_taxels: peak.contact_area_taxels,
            contact_area_mm2: f64::from(peak.contact_area_taxels) * pitch_mm * pitch_mm,
            force_n: peak.force_n,
            model: hrn.sha256()[..12].to_owned(),
            state: self.state().0,
            context: self.seen.context.clone(),
            mono_ns: (self.clock == Clock::Arrival).then_some(stamp.mono.as_nanos() as u64),
            age_at_publish_ms: None,
            latency_us: None,
            arrival: self.arrival,
        }))
    }

    fn notes(&self, peak: &Peak) -> Vec<Note> {
        let range = &self.hrn.card().range;
        let [least_n, most_n] = range.force_n.map(f64::from);
        let [least_taxels, most_taxels] = range.contact_area_taxels;
        let trained = (least_n..=most_n).contains(&peak.force_n)
            && (least_taxels..=most_taxels).contains(&peak.contact_area_taxels);
        [
            (Note::AtEdge, peak.marks.at_edge),
            (Note::Saturated, peak.marks.saturated),
            (Note::OutsideTraining, !trained),
        ]
        .into_iter()
        .filter_map(|(note, applies)| applies.then_some(note))
        .collect()
    }

    /// What is known of a frame by the settings that are in force now.
    pub(super) fn marks(&self, raw: &RawFrame, frame: &Frame) -> Marks {
        let full_scale = self.sensor.layout().full_scale();
        Marks {
            at_edge: self.is_at_edge(frame),
            saturated: full_scale.is_some_and(|f| self.tare.is_saturated(raw, f)),
        }
    }

    fn is_at_edge(&self, frame: &Frame) -> bool {
        let array = self.sensor.layout().array();
        let threshold_n = self.sensor.description().press.contact_threshold_n;
        array.places().any(|place| {
            frame.newtons[place] >= threshold_n
                && array.position(place).is_some_and(|(row, col)| {
                    row == 0 || col == 0 || row + 1 == array.rows || col + 1 == array.cols
                })
        })
    }
}
