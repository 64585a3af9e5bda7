//! The press and hardness events of a pipeline.

use super::approach::PressWithApproach;
use super::objects::object_of;
use super::{Clock, Pipeline, Unjudged};
use crate::event::{self, Event, Hardness, Note, Phase, Press, PressState, Rejection};
use crate::frame::{Frame, RawFrame};
use crate::press::{Change, ContactFrame, End, FrameAt, Marks};
use crate::sensor::Description;
use crate::verdict::{COURSE_FRAMES, Format, Laying, ModelError, Verdict};

/// The number of frames in contact that an early verdict on the course needs.
pub const FIRST_LOOK: u64 = 3;
/// The course is judged again when the press has grown by its frames divided by this number, at
/// least by one frame. A verdict at each of a thousand frames would cost more than it is worth.
const LOOK_SHARE: u64 = 8;
/// The value of `next_look` once the early verdict has come.
const NO_LOOK: u64 = u64::MAX;

/// The number of frames in contact at which the course is judged again after `frames`.
pub fn look_after(frames: u64) -> u64 {
    frames + (frames / LOOK_SHARE).max(1)
}

/// What the event of a verdict says of the press beside the model's own words.
struct Beside {
    /// How the frames of the press lie on the model's grid.
    laying: Laying,
    /// Only for a model of the course.
    course: Option<event::ApproachSource>,
    stiffness_n_per_mm: Option<f64>,
    /// Whether the model was trained on presses like this one. Always so for a model of a frame.
    is_trained: bool,
}

impl Pipeline {
    /// Adds the events of a change.
    pub(super) fn publish(&mut self, change: Change, events: &mut Vec<Event>) {
        match change {
            Change::Begin { press, at } => {
                self.seen.speed_mm_s = self.speed_mm_s();
                self.seen.next_look = FIRST_LOOK;
                events.push(self.press(press, PressState::Begin, at, 1, None));
            }
            Change::Settled { press, peak } => {
                if self.hrn.format() == Format::Frame && self.seen.next_look != NO_LOOK {
                    self.seen.next_look = NO_LOOK;
                    let laying = self.laying(&peak);
                    let verdict = self.hrn.judge(&laying.lay(&peak.frame));
                    let beside = Beside {
                        laying,
                        course: None,
                        stiffness_n_per_mm: self.stiffness_so_far(),
                        is_trained: true,
                    };
                    events.extend(self.judged(press, Phase::Early, &peak, verdict, &beside));
                }
            }
            Change::End {
                press,
                last,
                frames,
                end,
            } => {
                let reason = match end {
                    End::Release => None,
                    End::Timeout => Some("timeout"),
                };
                let number = press.press();
                events.push(self.press(number, PressState::End, last, frames, reason));
                let known = self.known(&press, Phase::Final);
                events.extend(self.judge(number, Phase::Final, &known, press.peak()));
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
        at: FrameAt,
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

    /// Judges the press under way if a model of the course is due to judge it. Publishes the early
    /// verdict once its confidence is high enough.
    pub(super) fn look(&mut self, events: &mut Vec<Event>) {
        let is_due = |frames: &u64| *frames >= self.seen.next_look;
        let Some(frames) = self.tracker.frames().filter(is_due) else {
            return;
        };
        if self.hrn.format() == Format::Frame {
            return;
        }
        let Some(so_far) = self.tracker.so_far() else {
            return;
        };
        self.seen.next_look = look_after(frames);
        let known = self.known(&so_far, Phase::Early);
        if (known.frames.len() as u64) < FIRST_LOOK {
            return;
        }
        let peak = known.frames[known.best];
        if peak.force_n < self.sensor.description().press.early_min_force_n {
            return;
        }
        let Some(Event::Hardness(verdict)) = self.judge(so_far.press(), Phase::Early, &known, peak)
        else {
            return;
        };
        // A press has one early verdict at most, so none is spent on a rejection. A later look may
        // give a level.
        let is_sure = verdict.confidence >= self.sensor.description().early_confidence;
        if is_sure && verdict.rejected.is_none() {
            self.seen.next_look = NO_LOOK;
            events.push(Event::Hardness(verdict));
        }
    }

    /// The slope of force against indentation in the press under way. If the press timed out with
    /// this frame, only the final verdict has the slope.
    fn stiffness_so_far(&self) -> Option<f64> {
        let so_far = self.tracker.so_far()?;
        let known = self.known(&so_far, Phase::Early);
        known.stiffness_n_per_mm(self.sensor.description().arm.stiffness_n_per_mm)
    }

    /// The verdict on a press up to now. `peak` is its best frame.
    fn judge(
        &mut self,
        press: u64,
        phase: Phase,
        known: &PressWithApproach<'_>,
        peak: &ContactFrame,
    ) -> Option<Event> {
        let arm_n_per_mm = self.sensor.description().arm.stiffness_n_per_mm;
        let stiffness_n_per_mm = known.stiffness_n_per_mm(arm_n_per_mm);
        let laying = self.laying(peak);
        if phase == Phase::Final
            && let Some(courses) = &mut self.courses
        {
            courses.push(known.course(arm_n_per_mm, COURSE_FRAMES.1, &laying));
        }
        let (verdict, course, is_trained) = match self.hrn.format() {
            Format::Frame => (self.hrn.judge(&laying.lay(&peak.frame)), None, true),
            Format::Course { most_frames } => {
                let course = known.course(arm_n_per_mm, most_frames, &laying);
                let is_trained = self.hrn.card().range.holds(&course);
                (
                    self.hrn.judge_course(&course),
                    Some(known.rests_on),
                    is_trained,
                )
            }
        };
        let beside = Beside {
            laying,
            course,
            stiffness_n_per_mm,
            is_trained,
        };
        self.judged(press, phase, peak, verdict, &beside)
    }

    /// The event of a verdict. A model that fails on its own check frames was already refused at
    /// loading. If it fails on another frame, the press gets no verdict, and [`Self::unjudged`]
    /// returns the failure.
    fn judged(
        &mut self,
        press: u64,
        phase: Phase,
        peak: &ContactFrame,
        verdict: Result<Verdict, ModelError>,
        beside: &Beside,
    ) -> Option<Event> {
        let Description {
            min_confidence,
            min_force_n,
            calibration,
            ..
        } = self.sensor.description();
        let hrn = &self.hrn;
        let verdict = match verdict {
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
        let object = object_of(self.seen.context.as_ref()).map(|name| {
            let mut object = self.seen.objects.with(&name, &verdict);
            if phase == Phase::Final {
                self.seen.objects.add(&name, &verdict);
            }
            object.shore = object.shore.map(|shore| hrn.within(shore, object.level));
            object
        });
        let mut shore = verdict.shore;
        if hrn.format() == Format::Frame {
            // Such a model finds the Shore hardness apart from the level.
            shore = shore.map(|shore| hrn.within(shore, verdict.level));
        }
        let rejected = if peak.force_n < *min_force_n {
            Some(Rejection::LowForce)
        } else if verdict.confidence < *min_confidence {
            Some(Rejection::LowConfidence)
        } else if verdict.levels.as_ref().is_some_and(|set| set.len() > 1) {
            Some(Rejection::Ambiguous)
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
        let FrameAt { frame, stamp } = peak.moment;
        Some(Event::Hardness(Hardness {
            seq: None,
            sensor: self.sensor.name().to_owned(),
            time: stamp.wall,
            press,
            phase,
            level,
            label,
            rejected,
            notes: self.notes(peak, beside),
            references: hrn.known_references().kinds(),
            probabilities: verdict.probabilities,
            confidence: verdict.confidence,
            frame,
            contact_area_taxels: peak.contact_area_taxels,
            contact_area_mm2: f64::from(peak.contact_area_taxels) * calibration.pitch_mm.area_mm2(),
            force_n: peak.force_n,
            model: hrn.sha256()[..12].to_owned(),
            state: self.state().0,
            context: self.seen.context.clone(),
            mono_ns: (self.clock == Clock::Arrival).then_some(stamp.mono.as_nanos() as u64),
            age_at_publish_ms: None,
            latency_us: None,
            shore,
            levels: verdict.levels,
            course: beside.course,
            stiffness_n_per_mm: beside.stiffness_n_per_mm,
            object,
            arrival: self.arrival,
        }))
    }

    fn notes(&self, peak: &ContactFrame, beside: &Beside) -> Vec<Note> {
        let card = self.hrn.card();
        let range = &card.range;
        let laying = &beside.laying;
        // The range of areas is in taxels of the model's grid.
        let area = if laying.is_resampled() {
            laying
                .lay(&peak.frame)
                .contact_area_taxels(card.contact_threshold_n())
        } else {
            peak.contact_area_taxels
        };
        let is_unknown = self.hrn.most_references() > 0 && self.hrn.known_references().is_none();
        let [least_n, most_n] = range.force_n.map(f64::from);
        let [least_taxels, most_taxels] = range.contact_area_taxels;
        let trained = (least_n..=most_n).contains(&peak.force_n)
            && (least_taxels..=most_taxels).contains(&area)
            && card.holds(self.sensor.description().calibration.pitch_mm)
            && beside.is_trained;
        [
            (Note::AtEdge, peak.marks.at_edge),
            (Note::Saturated, peak.marks.saturated),
            (Note::OutsideTraining, !trained),
            (Note::Resampled, laying.is_resampled()),
            (Note::NotIdentified, is_unknown),
        ]
        .into_iter()
        .filter_map(|(note, applies)| applies.then_some(note))
        .collect()
    }

    /// The marks of a frame by the current settings.
    pub(super) fn marks(&self, raw: &RawFrame, frame: &Frame) -> Marks {
        let full_scale = self.sensor.layout().full_scale();
        Marks {
            at_edge: self.is_at_edge(frame),
            saturated: full_scale.is_some_and(|f| self.tare.is_saturated(raw, f)),
        }
    }

    fn is_at_edge(&self, frame: &Frame) -> bool {
        let array = self.sensor.layout().array();
        let threshold_n = self.sensor.thresholds().contact_threshold_n;
        frame.newtons.iter().enumerate().any(|(place, &newtons)| {
            let (row, col) = array.position(place);
            let is_edge = row == 0 || col == 0 || row + 1 == array.rows || col + 1 == array.cols;
            is_edge && newtons >= threshold_n
        })
    }

    /// How the frames of a press whose best frame is `peak` are laid onto the model's grid.
    fn laying(&self, peak: &ContactFrame) -> Laying {
        let pitch = self.sensor.description().calibration.pitch_mm;
        Laying::new(&peak.frame, pitch, f64::from(self.hrn.card().pitch_mm))
    }
}
