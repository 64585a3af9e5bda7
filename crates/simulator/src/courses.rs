//! A data set of whole presses: frames over time, with the arm's motion as the robot reports it.
//!
//! Objects, materials and sensors are those of [`super::dataset`]. Speed, stiffness of the arm,
//! frame rate and hold are drawn anew for each press. Test presses of the same number are made alike
//! in every material, as for single frames.

mod world;

use super::dataset::HIGHEST_FORCE_N;
use super::motion::Arm;
use super::object::{POSTURES, Pose, Shapes};
use super::press::{Bench, Specimen};
use super::sensor::{Film, Sensor};
use super::settings::{CourseSettings, SensorDesigns};
use super::solved::SolvedPress;
use super::subject::{Labels, Subject, harder_and_harder, units};
use super::tracked::{Seen, begins_press, one_press};
use crate::random::{Stream, log_even};
use hardnessd_core::frame::{Frame, Pitch};
use hardnessd_core::press::thinned;
use hardnessd_core::verdict::{COURSE_FRAMES, Piece, Resampling};

impl CourseSettings {
    /// The share of the objects that have flat faces whatever the shapes. The paper's shapes tell the
    /// level, and flat ones are flat.
    pub(super) fn flat_share(&self) -> f64 {
        match self.objects.shapes {
            Shapes::Matched | Shapes::Wide => 1.0 / 3.0,
            Shapes::Flat | Shapes::Paper => 0.0,
        }
    }
}

/// The greatest force on sensors of many designs, N.
const BROAD_FORCE_N: f64 = 40.0;
/// Speed of the arm in mm/s, log-uniform.
const SPEED_MM_S: [f64; 2] = [2.0, 20.0];
/// Stiffness of the arm in N/mm, log-uniform.
const ARM_N_PER_MM: [f64; 2] = [3.0, 30.0];
/// The time that the arm holds its position, s, uniform.
const HOLD_S: [f64; 2] = [0.2, 1.5];
/// The number of frames kept before the frame that begins the press.
const BEFORE: usize = 2;

/// One press over time, with its labels.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelledCourse {
    /// The kept frames, ascending in time.
    pub moments: Vec<Sample>,
    /// Index of the frame that a model of one frame judges.
    pub best: usize,
    /// The arm's stiffness as reported.
    pub arm_n_per_mm: f32,
    /// Greatest force on the sensor.
    pub force_n: f32,
    /// Number of the sensor, unique in the data set. 0 if the sensors have no numbers.
    pub sensor: u32,
    /// The rigid piece that was pressed.
    pub reference: Option<Piece>,
    /// The labels.
    pub labels: Labels,
}

/// One frame of a press.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// Millinewtons after a tare, as a model gets them, on a grid of taxels 3.5 mm apart.
    pub millinewtons: Box<[i16]>,
    /// Time since the frame that began the press; negative before it.
    pub time_s: f32,
    /// How far the arm went since the begin.
    pub approach_mm: f32,
}

/// How far an arm that stops by position goes beyond the touch, log-uniform.
const TRAVEL_MM: [f64; 2] = [1.0, 10.0];
/// The least force of an arm that stops by position.
const LEAST_FORCE_N: f64 = 0.3;
/// The longest press. A tracker ends a press after this time.
const LONGEST_S: f64 = 30.0;
/// The least number of frames that a press is held, so that a slow sensor sees it.
const HOLD_FRAMES: f64 = 3.0;

/// The plan of one press, the same in every material.
pub(super) struct Plan {
    posture: usize,
    pose: Stream,
    /// The force at which the arm stops, or the distance beyond the touch.
    force_n: f64,
    travel_mm: Option<f64>,
    /// Where an arm that stops by position stops at the latest.
    highest_force_n: f64,
    pub(super) arm: Arm,
    pub(super) hold_s: f64,
    pub(super) reading: Reading,
}

/// How a press is read.
#[derive(Clone, Copy)]
pub(super) struct Reading {
    pub(super) period_s: f64,
    /// Offset between the frames and the touch, as a part of a period.
    pub(super) phase: f64,
}

impl Plan {
    /// Draws the plan of a press by an arm whose stiffness is in this range.
    pub(super) fn draw(
        settings: &CourseSettings,
        arm_n_per_mm: [f64; 2],
        stream: &mut Stream,
    ) -> Self {
        let posture = stream.below(POSTURES);
        let lowest = f64::from(settings.objects.lowest_force_n);
        // Many sensors meet great forces, too, but most presses are gentle.
        let designs = settings.sensors.map(|sensors| sensors.designs);
        let is_broad = designs == Some(SensorDesigns::Broad);
        let highest = match is_broad {
            true => BROAD_FORCE_N,
            false => HIGHEST_FORCE_N,
        };
        let force = |stream: &mut Stream| {
            let part = stream.uniform();
            lowest + (highest - lowest) * if is_broad { part * part } else { part }
        };
        let force_n = force(stream);
        let highest_force_n = match is_broad {
            true => force_n.max(force(&mut stream.child(1))),
            false => highest,
        };
        let travel_mm = log_even(TRAVEL_MM, stream);
        let stops_by_force = stream.uniform() < 0.5;
        let arm = Arm {
            n_per_mm: log_even(arm_n_per_mm, stream),
            speed_mm_s: log_even(SPEED_MM_S, stream),
        };
        let [least, most] = HOLD_S;
        let period_s = 1.0 / log_even(settings.frame_rate_hz, stream);
        // A seed's presses stay what they were when four numbers were drawn here for a robot's errors.
        for _ in 0..4 {
            stream.next_u64();
        }
        Self {
            posture,
            pose: stream.child(0),
            force_n,
            travel_mm: (!stops_by_force).then_some(travel_mm),
            highest_force_n,
            arm,
            hold_s: stream.range(least, most).max(HOLD_FRAMES * period_s),
            reading: Reading {
                period_s,
                phase: stream.uniform(),
            },
        }
    }
}

/// Makes the presses of an object, or of a cover if each sensor is another one. It may run on any thread. A press
/// is `None` if no sensor sees it, however hard it is made, or if it lasts too long.
type Work<'a> = Box<dyn FnOnce() -> Vec<Option<LabelledCourse>> + Send + 'a>;

/// The work that makes the data set, in the order of [`super::dataset`].
pub fn courses(settings: &CourseSettings) -> Vec<Work<'_>> {
    if let Some(sensors) = &settings.sensors {
        return world::courses(settings, sensors);
    }
    let of = &settings.objects;
    let object = |unit| -> Work {
        Box::new(move || {
            let mut bench = Bench::default();
            let subject = Subject::draw(of, unit, settings.flat_share());
            let pressed = |press| {
                let mut paired = subject.geometry.child(3).child(press);
                let plan = Plan::draw(settings, ARM_N_PER_MM, &mut paired);
                subject.pressed(&mut bench, &plan, press, |solved, noise| {
                    let labels = subject.labels();
                    plan.read(&subject.sensor, solved, plan.reading, noise, labels)
                })
            };
            (0..u64::from(of.presses)).map(pressed).collect()
        })
    };
    units(of).into_iter().map(object).collect()
}

impl Subject {
    /// Makes press number `press`, harder each time until the object's sensor feels it and `read` gives
    /// something. `None` if that never happens, or the press lasts too long.
    pub(super) fn pressed<T>(
        &self,
        bench: &mut Bench,
        plan: &Plan,
        press: u64,
        read: impl Fn(&SolvedPress, &mut Stream) -> Option<T>,
    ) -> Option<T> {
        let face = self.face(plan.posture);
        let specimen = self.specimen(&face, &Pose::draw(&face.0, &mut plan.pose.clone()));
        let noise = self.draws.child(4).child(press);
        let force_n = plan.travel_mm.map_or(plan.force_n, |travel_mm| {
            bench.force_at(&specimen, plan.arm, travel_mm, plan.highest_force_n)
        });
        for (attempt, force_n) in (0..).zip(harder_and_harder(force_n)) {
            let mut noise = noise.child(attempt);
            // One solve shows whether the press is worth the forty solves of a course.
            let ramp_s = force_n / plan.arm.n_per_mm / plan.arm.speed_mm_s;
            let (window, pressure, _) = bench.press(&specimen, force_n, ramp_s, 0.0);
            let forces = self.sensor.grid.taxel_forces(&pressure, window);
            let raw = self.sensor.read(&forces, 1.0, &mut noise);
            if !begins_press(&self.sensor.felt(&raw)) {
                continue;
            }
            let solved = SolvedPress::new(bench, &specimen, plan.arm, force_n, plan.hold_s);
            // A material that flows faster than the arm follows never bears the force, and its
            // press would last minutes.
            if solved.duration_s() > LONGEST_S {
                return None;
            }
            let read = read(&solved, &mut noise);
            if read.is_some() {
                return read;
            }
        }
        None
    }
}

impl Plan {
    /// A press of this plan as a sensor reads it. `None` unless the daemon sees one press in it.
    pub(super) fn read(
        &self,
        sensor: &Sensor,
        solved: &SolvedPress,
        Reading { period_s, phase }: Reading,
        noise: &mut Stream,
        labels: Labels,
    ) -> Option<LabelledCourse> {
        // The frames from a few before the touch to the release, with their times after the touch.
        let gain = sensor.press_gain(noise);
        let felt = solved.felt(&sensor.grid);
        let mut film = Film::new(&sensor.design);
        let first_s = -(BEFORE as f64 + phase) * period_s;
        let last_s = solved.duration_s() + sensor.design.settled_s();
        let (times, frames): (Vec<f64>, Vec<Frame>) = (0_u32..)
            .map(|number| first_s + f64::from(number) * period_s)
            .take_while(|&time_s| time_s < last_s)
            .map(|time_s| {
                let film_n = film.advance(&sensor.design, &felt.at(time_s), period_s);
                (time_s, sensor.felt(&sensor.read(&film_n, gain, noise)))
            })
            .unzip();
        let Seen { contact, best } = one_press(&frames, &sensor.thresholds(), period_s)?;
        let begin = contact[0];
        let of_contact = contact.binary_search(&best);
        let of_contact = of_contact.expect("the best frame is in contact");
        let thin = thinned(contact.len(), of_contact, COURSE_FRAMES.1);
        let thin = thin.into_iter().map(|place| contact[place]);
        let places = (begin.saturating_sub(BEFORE)..begin).chain(thin);
        let places: Vec<usize> = places.collect();
        let resampling = Resampling::new(&frames[best], sensor.grid.pitch, Pitch::JX255N.rows_mm);
        let approach_mm = |place: usize| solved.motion.approach_mm(times[place]);
        let moment = |&place: &usize| Sample {
            millinewtons: millinewtons(&resampling.apply(&frames[place]).newtons),
            time_s: (times[place] - times[begin]) as f32,
            approach_mm: (approach_mm(place) - approach_mm(begin)) as f32,
        };
        Some(LabelledCourse {
            moments: places.iter().map(moment).collect(),
            best: places
                .binary_search(&best)
                .expect("thinning keeps the best frame"),
            arm_n_per_mm: self.arm.n_per_mm as f32,
            force_n: solved.force_n as f32,
            sensor: 0,
            reference: None,
            labels,
        })
    }
}

/// Newtons as a data set holds them. An i16 holds up to 32 N on a taxel.
fn millinewtons(newtons: &[f32]) -> Box<[i16]> {
    let rounded = |newtons: &f32| (newtons / 1e-3).round() as i16;
    newtons.iter().map(rounded).collect()
}

impl Bench {
    /// The force at which an arm has gone `travel_mm` beyond the touch, at most `most_n`.
    fn force_at(&mut self, specimen: &Specimen, arm: Arm, travel_mm: f64, most_n: f64) -> f64 {
        let ramp_s = travel_mm / arm.speed_mm_s;
        let mut travel = |force_n: f64| {
            let approach_mm = self.press(specimen, force_n, ramp_s, 0.0).2.approach_mm;
            approach_mm + force_n / arm.n_per_mm
        };
        // Use the secant method on ln F against ln z, where the contact is nearly a power law.
        // Start from above.
        let mut forces = [most_n, 0.3 * most_n];
        let first = (travel(forces[0]) / travel_mm).ln();
        if first <= 0.0 {
            return most_n;
        }
        let mut off = [first, (travel(forces[1]) / travel_mm).ln()];
        for _ in 0..4 {
            let slope = (off[1] - off[0]) / (forces[1] / forces[0]).ln();
            let next = forces[1] * (-off[1] / slope.max(0.2)).clamp(-2.0, 2.0).exp();
            forces = [forces[1], next.clamp(LEAST_FORCE_N, most_n)];
            if (forces[1] / forces[0]).ln().abs() < 0.02 {
                break;
            }
            off = [off[1], (travel(forces[1]) / travel_mm).ln()];
        }
        forces[1]
    }
}

#[cfg(test)]
mod tests;
