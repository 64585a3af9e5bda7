//! A press becomes the event of its verdict.
//!
//! In: the presses of one sensor, the positions of the arm, and what is so at each verdict.
//! Out: [`Hardness`] events. A judge decides when a press is judged early, what the model is given of
//! it, and what is said beside the model's own words. It knows nothing of bytes and ports.

mod approach;
mod objects;
mod own;

use std::sync::Arc;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::Value;

pub use self::approach::EndedPress;
use self::approach::{PressWithApproach, approach_speed_mm_s};
use self::objects::{Objects, object_of};
pub use self::own::{OwnPresses, owner};
use crate::event::{Advice, Hardness, LinkState, Note, Phase, Rejection};
use crate::motion::Track;
use crate::press::{ContactFrame, FrameAt, SoFar};
use crate::sensor::Sensor;
use crate::verdict::{COURSE_FRAMES, Format, Knowledge, Model, ModelError, References, Resampling};

/// The number of frames in contact that an early verdict on the course needs.
const FIRST_LOOK: u64 = 3;
/// The course is judged again when the press has grown by its frames divided by this number, at
/// least by one frame. A verdict at each of a thousand frames would cost more than it is worth.
const LOOK_SHARE: u64 = 8;

/// Of a sensor of which nothing is known, presses of less force, N, name no level: on a real array of
/// another make, the verdicts that were sure and wrong were of such presses.
const LEAST_UNKNOWN_N: f64 = 5.0;
/// A verdict of this confidence needs no further press, and a fourth press of an object adds little.
const ENOUGH: f32 = 0.7;
const MOST_PRESSES: u64 = 4;

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
    sensor: Arc<Sensor>,
    /// The model.
    pub(crate) hrn: Arc<Model>,
    /// The positions of the arm.
    pub(crate) track: Track,
    /// The controller's context.
    pub(crate) context: Option<Value>,
    /// What a later judge needs of this one between two presses.
    pub(crate) kept: Kept,
    /// The speed of the approach when the press under way began.
    speed_mm_s: Option<f64>,
    /// The number of frames in contact at which the press under way may be judged next. `None` once its
    /// early verdict has come.
    next_look: Option<u64>,
    /// The missing verdicts that are not fetched yet.
    pub(crate) unjudged: Vec<Unjudged>,
    /// The presses that ended and are not fetched yet, if they are kept.
    pub(crate) ended: Option<Vec<EndedPress>>,
}

/// What a judge keeps from one press to the next. A recording holds it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Kept {
    objects: Objects,
    pub(crate) own: OwnPresses,
}

impl Kept {
    /// Whether a judge can work with it. A recording may hold anything.
    pub(crate) fn is_usable(&self) -> bool {
        self.objects.is_usable()
    }
}

/// What a judge must know of the moment of a verdict.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Moment {
    /// The state of the link.
    pub(crate) state: LinkState,
    /// Whether the times of frames are those of their arrival.
    pub(crate) is_live: bool,
    /// When the bytes came that made the verdict possible.
    pub(crate) arrival: Duration,
}

impl Judge {
    /// A judge that has seen no press.
    pub(crate) fn new(sensor: Arc<Sensor>, hrn: Arc<Model>) -> Self {
        Self {
            sensor,
            hrn,
            track: Track::default(),
            context: None,
            kept: Kept::default(),
            speed_mm_s: None,
            next_look: None,
            unjudged: Vec::new(),
            ended: None,
        }
    }

    /// This judge, if it continues after another one.
    pub(crate) fn after(self, kept: Kept, track: Track, context: Option<Value>) -> Self {
        let mut judge = Self {
            kept,
            track,
            context,
            ..self
        };
        judge.take_own(judge.kept.own.clone());
        judge
    }

    /// Takes over own presses of the sensor that an earlier judge collected. Those of another model are
    /// left out, and the older ones of too many.
    pub(crate) fn take_own(&mut self, own: OwnPresses) {
        let most = self.sensor.description().sensor.own_presses as usize;
        self.kept.own = own.of_model(&self.hrn, most);
    }

    /// What a judge with `hrn` can take over from this one.
    pub(crate) fn kept_for(&self, hrn: &Model) -> Kept {
        let is_same = hrn.sha256() == self.hrn.sha256()
            && hrn.known_references() == self.hrn.known_references();
        // Another model errs in other ways, and so does one that knows the sensor better.
        let mut kept = match is_same {
            true => self.kept.clone(),
            false => Kept::default(),
        };
        // The probabilities of objects are those of levels.
        if hrn.card().levels != self.hrn.card().levels {
            kept.objects = Objects::default();
        }
        kept
    }

    /// A press begins.
    pub(crate) fn begin(&mut self) {
        self.speed_mm_s = approach_speed_mm_s(self.context.as_ref(), self.sensor.arm());
        self.next_look = Some(FIRST_LOOK);
    }

    /// The press goes on. Its early verdict, if it comes now: of a model of frames once the contact has
    /// settled, and of a model of the course once it is sure enough. A model of parts has none: the parts of
    /// half a press are not those of a press.
    pub(crate) fn early(&mut self, press: &SoFar, now: Moment) -> Option<Hardness> {
        let next_look = self.next_look?;
        match self.hrn.format() {
            Format::Frame if press.is_settled => {
                self.next_look = None;
                let known = self.known(press, Phase::Early);
                self.judge(press, Phase::Early, &known, now)
            }
            Format::Course { .. } if press.frames >= next_look => {
                let frames = press.frames;
                self.next_look = Some(frames + (frames / LOOK_SHARE).max(1));
                let known = self.known(press, Phase::Early);
                let described = self.sensor.description();
                let early_confidence = described.model.early_confidence;
                let is_enough = known.frames.len() as u64 >= FIRST_LOOK
                    && known.best().force_n >= described.press.early_min_force_n;
                let verdict = is_enough.then(|| self.judge(press, Phase::Early, &known, now))??;
                // A press has one early verdict at most, so none is spent on a rejection. A later look may
                // give a level.
                let is_sure = verdict.confidence >= early_confidence && verdict.rejected.is_none();
                if is_sure {
                    self.next_look = None;
                }
                is_sure.then_some(verdict)
            }
            Format::Frame | Format::Course { .. } | Format::Parts => None,
        }
    }

    /// The press has ended.
    pub(crate) fn end(&mut self, press: &SoFar, now: Moment) -> Option<Hardness> {
        let known = self.known(press, Phase::Final);
        if let Some(ended) = &mut self.ended {
            ended.push(known.ended(press.press, COURSE_FRAMES.1, &self.sensor));
        }
        let verdict = self.judge(press, Phase::Final, &known, now);
        let delay_ms = self.sensor.arm().delay_ms;
        self.track.judged(press.last().stamp.mono, delay_ms);
        verdict
    }

    /// The press up to now, with its approach as it is known.
    fn known<'a>(&self, press: &'a SoFar, phase: Phase) -> PressWithApproach<'a> {
        let delay_ms = self.sensor.arm().delay_ms;
        PressWithApproach::new(press, phase, &self.track, delay_ms, self.speed_mm_s)
    }

    /// The verdict on a press up to now. It is missing if the model fails: a model that fails on its own check
    /// frames was refused at loading.
    fn judge(
        &mut self,
        press: &SoFar,
        phase: Phase,
        known: &PressWithApproach<'_>,
        now: Moment,
    ) -> Option<Hardness> {
        let verdict = self.try_judge(press, phase, known, now);
        verdict
            .map_err(|error| self.failed(press.press, phase, error))
            .ok()
    }

    fn failed(&mut self, press: u64, phase: Phase, error: ModelError) {
        self.unjudged.push(Unjudged {
            sensor: self.sensor.name().to_owned(),
            press,
            phase,
            error,
        });
    }

    fn try_judge(
        &mut self,
        press: &SoFar,
        phase: Phase,
        known: &PressWithApproach<'_>,
        now: Moment,
    ) -> Result<Hardness, ModelError> {
        let hrn = Arc::clone(&self.hrn);
        let (card, sensor) = (hrn.card(), Arc::clone(&self.sensor));
        let described = sensor.description();
        let is_of_course = matches!(hrn.format(), Format::Course { .. });
        let peak = match is_of_course {
            true => known.best(),
            false => &press.peak,
        };
        let press = press.press;
        let pitch = sensor.calibration().pitch_mm;
        let resampling = Resampling::new(&peak.frame, pitch, card.pitch_mm.into());
        let name = object_of(self.context.as_ref());
        let pressed = self.kept.own.next(name.clone(), known, &sensor);
        let in_a_row = pressed.in_a_row;
        let is_felt = peak.force_n >= described.model.min_force_n;
        let (verdict, references) = match hrn.format() {
            Format::Course { most_frames } => {
                let ended = known.ended(press, most_frames, &sensor);
                let course = ended.course(card.pitch_mm.into());
                let references = hrn.references_with(&self.kept.own.references());
                let judged = hrn.judge_beside(&course, &references);
                // The press is kept even if its verdict is missing, and its verdict stays if the press cannot
                // be kept.
                if phase == Phase::Final && is_felt && pressed.is_new() {
                    let most = described.sensor.own_presses as usize;
                    if let Err(error) = self.kept.own.keep(&hrn, &course, most) {
                        self.failed(press, phase, error);
                    }
                }
                (judged, references)
            }
            format => {
                card.check_array(peak.frame.array)?;
                let taxels = match (format, card.grid) {
                    (Format::Parts, _) => known.ended(press, COURSE_FRAMES.1, &sensor).parts(),
                    (_, Some(_)) => peak.frame.newtons.to_vec(),
                    (_, None) => resampling.apply(&peak.frame).newtons.to_vec(),
                };
                (hrn.judge_taxels(&taxels), References::NONE)
            }
        };
        if phase == Phase::Final && is_felt {
            self.kept.own.last = Some(pressed);
        }
        let verdict = verdict?;
        let is_unknown = hrn.most_references() > 0 && references.knowledge() == Knowledge::None;
        let notes = self.notes(peak, &resampling, is_unknown);
        let needs_force = is_unknown && peak.force_n < LEAST_UNKNOWN_N;
        let is_light = !is_felt || needs_force;
        let objects = &mut self.kept.objects;
        let object = name.and_then(|name| {
            // A press that names no level because it was light says nothing of its object either.
            let mut object = match is_light {
                true => objects.without(&name, &verdict)?,
                false => objects.with(&name, &verdict),
            };
            if phase == Phase::Final && !is_light {
                objects.add(&name, &verdict);
            }
            object.shore = object.shore.map(|shore| hrn.within(shore, object.level));
            Some(object)
        });
        let presses = object
            .as_ref()
            .map_or(in_a_row.into(), |object| object.presses);

        let advice = advice(needs_force, verdict.confidence, presses);
        let rejected = if is_light {
            Some(Rejection::LowForce)
        } else if verdict.confidence < described.model.min_confidence {
            Some(Rejection::LowConfidence)
        } else if verdict.levels.as_ref().is_some_and(|set| set.len() > 1) {
            Some(Rejection::Ambiguous)
        } else {
            None
        };
        let level = rejected.is_none().then_some(verdict.level);
        let mut levels = card.levels.iter();
        let label = levels.find(|known| Some(known.level) == level);
        // A model of frames finds the Shore hardness apart from the level.
        let shore = verdict.shore;
        let shore = shore.map(|shore| hrn.within(shore, verdict.level));
        let FrameAt { frame, stamp } = peak.moment;
        Ok(Hardness {
            seq: None,
            sensor: sensor.name().to_owned(),
            time: stamp.wall,
            press,
            phase,
            level,
            label: label.map(|level| level.label.clone()),
            rejected,
            notes,
            references: references.kinds(),
            advice,
            probabilities: verdict.probabilities,
            confidence: verdict.confidence,
            frame,
            contact_area_taxels: peak.contact_area_taxels,
            contact_area_mm2: f64::from(peak.contact_area_taxels) * pitch.area_mm2(),
            force_n: peak.force_n,
            model: hrn.sha256()[..12].to_owned(),
            state: now.state,
            context: self.context.clone(),
            mono_ns: now.is_live.then_some(stamp.mono.as_nanos() as u64),
            age_at_publish_ms: None,
            latency_us: None,
            shore,
            levels: verdict.levels,
            course: is_of_course.then_some(known.source),
            stiffness_n_per_mm: known.stiffness_n_per_mm(sensor.arm().stiffness_n_per_mm),
            object,
            arrival: now.arrival,
        })
    }

    /// `is_unknown`: whether the model could know this sensor, and does not.
    fn notes(&self, peak: &ContactFrame, resampling: &Resampling, is_unknown: bool) -> Vec<Note> {
        let card = self.hrn.card();
        let range = &card.range;
        // The range of areas is in taxels of the model's grid.
        let area = if resampling.is_resampled {
            resampling
                .apply(&peak.frame)
                .contact_area_taxels(card.contact_threshold_n())
        } else {
            peak.contact_area_taxels
        };
        let [least_n, most_n] = range.force_n.map(f64::from);
        let [least_taxels, most_taxels] = range.contact_area_taxels;
        let is_trained = (least_n..=most_n).contains(&peak.force_n)
            && (least_taxels..=most_taxels).contains(&area)
            && card.holds(self.sensor.calibration().pitch_mm);
        let is_resampled = resampling.is_resampled && card.grid.is_none();
        let are_ignored = self.hrn.known_references().are_ignored();
        [
            (Note::AtEdge, peak.at_edge),
            (Note::Saturated, peak.saturated),
            (Note::OutsideTraining, !is_trained),
            (Note::Resampled, is_resampled),
            (Note::NotIdentified, is_unknown),
            (Note::ReferencesIgnored, are_ignored),
        ]
        .into_iter()
        .filter_map(|(note, applies)| applies.then_some(note))
        .collect()
    }
}

/// What the robot may do to know more. `needs_force`: whether the press is too light for a sensor that the model does not
/// know. `presses` is how often the robot has pressed this object.
fn advice(needs_force: bool, confidence: f32, presses: u64) -> Option<Advice> {
    if needs_force {
        Some(Advice::PressHarder)
    } else if confidence < ENOUGH && presses < MOST_PRESSES {
        Some(Advice::PressAgain)
    } else {
        None
    }
}
