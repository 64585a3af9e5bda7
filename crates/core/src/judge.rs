//! A press becomes the event of its verdict.
//!
//! In: the presses of one sensor, the positions of the arm, and the [`Circumstances`] of the moment.
//! Out: [`Hardness`] events. A judge decides when a press is judged early, what the model is given of
//! it, and what is said beside the model's own words. It knows nothing of bytes and ports.

mod approach;
mod objects;
mod own;

use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use self::approach::PressWithApproach;
pub use self::approach::{approach_by_speed, approach_speed_mm_s, is_informative};
use self::objects::{Objects, object_of};
use self::own::PressedAt;
pub use self::own::{OwnPresses, owner};
use crate::event::{Advice, ApproachSource, Hardness, LinkState, Note, Phase, Rejection};
use crate::motion::Track;
use crate::press::{ContactFrame, FrameAt, SoFar};
use crate::sensor::Sensor;
use crate::verdict::{
    COURSE_FRAMES, Format, Hrn, ModelError, ReferenceKinds, Resampling, TimeSeries, Verdict,
};

/// The number of frames in contact that an early verdict on the course needs.
pub const FIRST_LOOK: u64 = 3;
/// The course is judged again when the press has grown by its frames divided by this number, at
/// least by one frame. A verdict at each of a thousand frames would cost more than it is worth.
const LOOK_SHARE: u64 = 8;

/// Of a sensor of which nothing is known, presses of less force, N, name no level: on a real array of
/// another make, the verdicts that were sure and wrong were of such presses.
const LEAST_UNKNOWN_N: f64 = 5.0;
/// A verdict of this confidence needs no further press, and a fourth press of an object adds little.
const ENOUGH: f32 = 0.7;
const MOST_PRESSES: u64 = 4;

/// The number of frames in contact at which the course is judged again after `frames`.
pub fn look_after(frames: u64) -> u64 {
    frames + (frames / LOOK_SHARE).max(1)
}

/// A verdict that is missing because the model failed.
#[derive(Debug)]
pub struct Unjudged {
    /// The sensor's name.
    pub sensor: String,
    /// The press's number.
    pub press: u64,
    /// The phase of the verdict.
    pub phase: Phase,
    /// The model's error.
    pub error: ModelError,
}

/// The judge of one sensor's presses.
#[derive(Debug)]
pub struct Judge {
    hrn: Arc<Hrn>,
    /// The positions of the arm.
    pub(crate) track: Track,
    kept: Kept,
    /// The speed of the approach when the press under way began.
    speed_mm_s: Option<f64>,
    /// The number of frames in contact at which the press under way is judged next. `None` once its
    /// early verdict has come.
    next_look: Option<u64>,
    /// The missing verdicts that are not fetched yet.
    pub(crate) unjudged: Vec<Unjudged>,
    /// The courses of presses that ended and are not fetched yet, if they are kept.
    pub(crate) courses: Option<Vec<TimeSeries>>,
}

/// What a judge keeps from one press to the next. A recording holds it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Kept {
    objects: Objects,
    own: OwnPresses,
}

impl Kept {
    /// Whether a judge can work with it. A recording may hold anything.
    pub(crate) fn is_usable(&self) -> bool {
        self.objects.is_usable()
    }

    /// Forgets the sensor's own presses.
    pub(crate) fn forget_own(&mut self) {
        self.own = OwnPresses::default();
    }

    /// The sensor's own presses.
    pub fn own(&self) -> &OwnPresses {
        &self.own
    }
}

/// What a judge must know of the moment of a verdict.
#[derive(Debug, Clone, Copy)]
pub struct Circumstances<'a> {
    /// The sensor.
    pub sensor: &'a Sensor,
    /// The controller's context.
    pub context: Option<&'a Value>,
    /// The state of the link.
    pub state: LinkState,
    /// Whether the times of frames are those of their arrival.
    pub is_live: bool,
    /// When the bytes came that made the verdict possible.
    pub arrival: Duration,
}

/// What is said of a press beside the model's own words.
struct Beside {
    /// How the frames of the press lie on the model's grid.
    resampling: Resampling,
    /// The source of the approach. Only for a model of the course.
    source: Option<ApproachSource>,
    stiffness_n_per_mm: Option<f64>,
    /// Whether the model was trained on presses like this one. Always so for a model of a frame.
    is_trained: bool,
    /// The references that the model had.
    references: ReferenceKinds,
    /// How many presses of its object the press makes in a row.
    in_a_row: u32,
}

impl Judge {
    /// A judge that has seen no press.
    pub fn new(hrn: Arc<Hrn>) -> Self {
        Self::with(hrn, Kept::default(), Track::default())
    }

    /// A judge that continues with what another one kept. It leaves out own presses of another model.
    pub fn with(hrn: Arc<Hrn>, mut kept: Kept, track: Track) -> Self {
        kept.own = kept.own.of_model(&hrn);
        Self {
            hrn,
            track,
            kept,
            speed_mm_s: None,
            next_look: None,
            unjudged: Vec::new(),
            courses: None,
        }
    }

    /// The model.
    pub fn hrn(&self) -> &Arc<Hrn> {
        &self.hrn
    }

    /// Takes over own presses of the sensor that an earlier judge collected. Those of another model are
    /// left out.
    pub fn take_own(&mut self, own: OwnPresses) {
        self.kept.own = own.of_model(&self.hrn);
    }

    /// What a later judge needs of this one between two presses.
    pub fn kept(&self) -> &Kept {
        &self.kept
    }

    /// What a judge with `hrn` can take over from this one.
    pub(crate) fn kept_for(&self, hrn: &Hrn) -> Kept {
        let is_same = hrn.sha256() == self.hrn.sha256()
            && hrn.known_references() == self.hrn.known_references();
        // Another model errs in other ways, and so does one that knows the sensor better.
        match is_same {
            true => self.kept.clone(),
            false => Kept::default(),
        }
    }

    /// A press begins.
    pub fn begin(&mut self, now: Circumstances<'_>) {
        let arm = now.sensor.arm();
        self.speed_mm_s = approach_speed_mm_s(now.context, arm);
        self.next_look = Some(FIRST_LOOK);
    }

    /// The contact has settled. A model of frames gives its early verdict now. A model of parts has none:
    /// the parts of half a press are not those of a press.
    pub fn settled(&mut self, press: &SoFar, now: Circumstances<'_>) -> Option<Hardness> {
        if self.hrn.format() != Format::Frame {
            return None;
        }
        self.next_look.take()?;
        let known = self.known(press, Phase::Early, now.sensor);
        self.judge(press, Phase::Early, &known, now)
    }

    /// The press goes on, with `frames` frames in contact. A model of the course gives its early
    /// verdict when it is sure enough.
    pub fn look(&mut self, press: &SoFar, frames: u64, now: Circumstances<'_>) -> Option<Hardness> {
        let is_of_course = matches!(self.hrn.format(), Format::Course { .. });
        if !is_of_course || frames < self.next_look? {
            return None;
        }
        self.next_look = Some(look_after(frames));
        let known = self.known(press, Phase::Early, now.sensor);
        let described = now.sensor.description();
        let is_enough = known.frames.len() as u64 >= FIRST_LOOK
            && known.best().force_n >= described.press.early_min_force_n;
        let verdict = is_enough.then(|| self.judge(press, Phase::Early, &known, now))??;
        // A press has one early verdict at most, so none is spent on a rejection. A later look may
        // give a level.
        let is_sure = verdict.confidence >= described.model.early_confidence;
        if !is_sure || verdict.rejected.is_some() {
            return None;
        }
        self.next_look = None;
        Some(verdict)
    }

    /// The press has ended, with `last` as its last frame in contact.
    pub fn end(
        &mut self,
        press: &SoFar,
        last: FrameAt,
        now: Circumstances<'_>,
    ) -> Option<Hardness> {
        let known = self.known(press, Phase::Final, now.sensor);
        if let Some(courses) = &mut self.courses {
            let resampling = resampling(&self.hrn, press.peak(), now.sensor);
            let arm_n_per_mm = now.sensor.arm().stiffness_n_per_mm;
            courses.push(known.course(arm_n_per_mm, COURSE_FRAMES.1, &resampling));
        }
        let verdict = self.judge(press, Phase::Final, &known, now);
        let delay_ms = now.sensor.arm().delay_ms;
        self.track.judged(last.stamp.mono, delay_ms);
        verdict
    }

    /// Remembers a press that ended, and keeps it as one of the sensor's own if it was felt well.
    fn keep_own(
        &mut self,
        pressed: PressedAt,
        course: &TimeSeries,
        peak: &ContactFrame,
        now: Circumstances<'_>,
    ) -> Result<(), ModelError> {
        let described = now.sensor.description();
        if peak.force_n < described.model.min_force_n || peak.marks.saturated {
            return Ok(());
        }
        let most = described.sensor.own_presses as usize;
        self.kept.own.add(pressed, &self.hrn, course, most)
    }

    /// When and where a press was up to now.
    fn pressed_at(&self, known: &PressWithApproach<'_>, now: Circumstances<'_>) -> PressedAt {
        let pitch = now.sensor.calibration().pitch_mm;
        let (row, col) = known.best().frame.centre();
        let moment = |frame: &ContactFrame| frame.moment.stamp.mono;
        let last = known.frames.len() - 1;
        self.kept.own.next(
            object_of(now.context),
            [known.frames[0], known.frames[last]].map(moment),
            [row * pitch.rows_mm, col * pitch.cols_mm],
        )
    }

    /// The press up to now, with its approach as it is known.
    fn known<'a>(&self, press: &'a SoFar, phase: Phase, sensor: &Sensor) -> PressWithApproach<'a> {
        let delay_ms = sensor.arm().delay_ms;
        PressWithApproach::new(press, phase, &self.track, delay_ms, self.speed_mm_s)
    }

    /// The verdict on a press up to now.
    fn judge(
        &mut self,
        press: &SoFar,
        phase: Phase,
        known: &PressWithApproach<'_>,
        now: Circumstances<'_>,
    ) -> Option<Hardness> {
        let arm_n_per_mm = now.sensor.arm().stiffness_n_per_mm;
        let peak = match self.hrn.format() {
            Format::Frame | Format::Parts => press.peak(),
            Format::Course { .. } => known.best(),
        };
        let resampling = resampling(&self.hrn, peak, now.sensor);
        let alone = |verdict: Verdict| (verdict, ReferenceKinds::NONE);
        let mut course = None;
        let (verdict, source, is_trained) = match self.hrn.format() {
            Format::Frame | Format::Parts => {
                let card = self.hrn.card();
                let taxels = match (self.hrn.format(), card.grid) {
                    (Format::Parts, _) => known.parts(),
                    (_, Some(_)) => peak.frame.newtons.to_vec(),
                    (_, None) => resampling.apply(&peak.frame).newtons.to_vec(),
                };
                let checked = card.check_array(peak.frame.array);
                let judged = checked.and_then(|()| self.hrn.judge_taxels(&taxels));
                (judged.map(alone), None, true)
            }
            Format::Course { most_frames } => {
                let course = course.insert(known.course(arm_n_per_mm, most_frames, &resampling));
                let is_trained = self.hrn.card().range.holds(course);
                let own = self.kept.own.references(&self.hrn);
                let judged = self.hrn.judge_course_with(course, &own);
                (judged, Some(known.source), is_trained)
            }
        };
        let pressed = self.pressed_at(known, now);
        let event = verdict.map(|(verdict, references)| {
            let beside = Beside {
                resampling,
                source,
                stiffness_n_per_mm: known.stiffness_n_per_mm(arm_n_per_mm),
                is_trained,
                references,
                in_a_row: pressed.in_a_row,
            };
            self.event(press.press(), phase, peak, verdict, &beside, now)
        });
        let kept = match course.filter(|_| phase == Phase::Final) {
            Some(course) => self.keep_own(pressed, &course, peak, now),
            None => Ok(()),
        };
        // A model that fails on its own check frames was refused at loading.
        let mut note = |error| {
            self.unjudged.push(Unjudged {
                sensor: now.sensor.name().to_owned(),
                press: press.press(),
                phase,
                error,
            });
        };
        kept.unwrap_or_else(&mut note);
        event.map_err(note).ok()
    }

    /// The event of a verdict.
    fn event(
        &mut self,
        press: u64,
        phase: Phase,
        peak: &ContactFrame,
        verdict: Verdict,
        beside: &Beside,
        now: Circumstances<'_>,
    ) -> Hardness {
        let described = now.sensor.description();
        let hrn = &self.hrn;
        let object = object_of(now.context).map(|name| {
            let mut object = self.kept.objects.with(&name, &verdict);
            if phase == Phase::Final {
                self.kept.objects.add(&name, &verdict);
            }
            object.shore = object.shore.map(|shore| hrn.within(shore, object.level));
            object
        });
        let mut shore = verdict.shore;
        if hrn.format() == Format::Frame {
            // Such a model finds the Shore hardness apart from the level.
            shore = shore.map(|shore| hrn.within(shore, verdict.level));
        }
        let presses = object
            .as_ref()
            .map_or(beside.in_a_row.into(), |object| object.presses);
        let advice = self.advice(peak, &verdict, beside.references, presses);
        let rejected =
            if peak.force_n < described.model.min_force_n || advice == Some(Advice::PressHarder) {
                Some(Rejection::LowForce)
            } else if verdict.confidence < described.model.min_confidence {
                Some(Rejection::LowConfidence)
            } else if verdict.levels.as_ref().is_some_and(|set| set.len() > 1) {
                Some(Rejection::Ambiguous)
            } else {
                None
            };
        let level = rejected.is_none().then_some(verdict.level);
        let label = level.and_then(|level| {
            let mut levels = hrn.card().levels.iter();
            let known = levels.find(|known| known.level == level)?;
            Some(known.label.clone())
        });
        let FrameAt { frame, stamp } = peak.moment;
        let taxel_mm2 = described.sensor.calibration.pitch_mm.area_mm2();
        Hardness {
            seq: None,
            sensor: now.sensor.name().to_owned(),
            time: stamp.wall,
            press,
            phase,
            level,
            label,
            rejected,
            notes: self.notes(peak, beside, now.sensor),
            references: beside.references,
            advice,
            probabilities: verdict.probabilities,
            confidence: verdict.confidence,
            frame,
            contact_area_taxels: peak.contact_area_taxels,
            contact_area_mm2: f64::from(peak.contact_area_taxels) * taxel_mm2,
            force_n: peak.force_n,
            model: hrn.sha256()[..12].to_owned(),
            state: now.state,
            context: now.context.cloned(),
            mono_ns: now.is_live.then_some(stamp.mono.as_nanos() as u64),
            age_at_publish_ms: None,
            latency_us: None,
            shore,
            levels: verdict.levels,
            course: beside.source,
            stiffness_n_per_mm: beside.stiffness_n_per_mm,
            object,
            arrival: now.arrival,
        }
    }

    /// What the robot may do to know more. `presses` is how often it has pressed this object.
    fn advice(
        &self,
        peak: &ContactFrame,
        verdict: &Verdict,
        references: ReferenceKinds,
        presses: u64,
    ) -> Option<Advice> {
        let is_unknown = self.hrn.most_references() > 0 && references == ReferenceKinds::NONE;
        if is_unknown && peak.force_n < LEAST_UNKNOWN_N {
            Some(Advice::PressHarder)
        } else if verdict.confidence < ENOUGH && presses < MOST_PRESSES {
            Some(Advice::PressAgain)
        } else {
            None
        }
    }

    fn notes(&self, peak: &ContactFrame, beside: &Beside, sensor: &Sensor) -> Vec<Note> {
        let card = self.hrn.card();
        let range = &card.range;
        let resampling = &beside.resampling;
        // The range of areas is in taxels of the model's grid.
        let area = if resampling.is_resampled() {
            resampling
                .apply(&peak.frame)
                .contact_area_taxels(card.contact_threshold_n())
        } else {
            peak.contact_area_taxels
        };
        let is_known = beside.references != ReferenceKinds::NONE;
        let is_unknown = self.hrn.most_references() > 0 && !is_known;
        let [least_n, most_n] = range.force_n.map(f64::from);
        let [least_taxels, most_taxels] = range.contact_area_taxels;
        let trained = (least_n..=most_n).contains(&peak.force_n)
            && (least_taxels..=most_taxels).contains(&area)
            && card.holds(sensor.calibration().pitch_mm)
            && beside.is_trained;
        [
            (Note::AtEdge, peak.marks.at_edge),
            (Note::Saturated, peak.marks.saturated),
            (Note::OutsideTraining, !trained),
            (
                Note::Resampled,
                resampling.is_resampled() && card.grid.is_none(),
            ),
            (Note::NotIdentified, is_unknown),
            (
                Note::ReferencesIgnored,
                self.hrn.known_references().are_ignored(),
            ),
        ]
        .into_iter()
        .filter_map(|(note, applies)| applies.then_some(note))
        .collect()
    }
}

/// How the frames of a press whose best frame is `peak` are resampled onto the model's grid.
fn resampling(hrn: &Hrn, peak: &ContactFrame, sensor: &Sensor) -> Resampling {
    let pitch = sensor.calibration().pitch_mm;
    Resampling::new(&peak.frame, pitch, f64::from(hrn.card().pitch_mm))
}
