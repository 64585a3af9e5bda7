//! A world of sensors: presses on many sensors, each of a design of its own, with presses of rigid
//! pieces that show what each sensor reads.
//!
//! The cover and the arm belong to a contact, which is costly to solve. So a number of covers is
//! drawn, objects are pressed on each, and several electronics read each of these presses: a
//! sensor is one electronics under one cover. Train and test sensors share nothing.

use super::{ARM_N_PER_MM, LabelledCourse, Plan, Reading, Work};
use crate::material::Split;
use crate::press::{Bench, Cover};
use crate::random::{Stream, log_even};
use crate::rigid;
use crate::sensor::{Design, Sensor};
use crate::settings::{BroadSensors, CourseSettings, SensorDesigns};
use crate::solved::SolvedPress;
use crate::subject::{Labels, Subject, Unit, units};
use hardnessd_core::verdict::Piece;

/// Presses of each rigid piece on each sensor.
const REFERENCES: u32 = 5;
/// Their forces, N: log-uniform, one in each fifth of this range.
const REFERENCE_N: [f64; 2] = [3.0, 25.0];
/// Radius of the rigid ball of a cover, and width of its rigid flat piece, mm.
const BALL_MM: [f64; 2] = [5.0, 20.0];
const FLAT_MM: [f64; 2] = [10.0, 50.0];
/// The covers: Young's modulus in MPa, and thickness.
const COVER_MPA: [f64; 2] = [0.1, 20.0];
const COVER_MM: [f64; 2] = [0.5, 8.0];
/// The factor on the newtons of the sensors whose users state wrong ones, and how many these are.
const WRONG: [f64; 2] = [0.5, 2.0];
const WRONG_SHARE: f64 = 0.5;
/// The most by which the reported stiffness of a sensor's arm is off, relatively.
const ARM_ERROR: f64 = 0.15;

impl CourseSettings {
    /// The names that a press's `material` indexes.
    pub fn material_names(&self) -> Vec<&'static str> {
        let mut names = crate::material_names(self.objects.materials);
        names.extend(self.sensors.map(|_| "rigid"));
        names
    }
}

/// The work that makes the presses on each cover; see [`super::courses()`].
pub(super) fn courses<'a>(
    settings: &'a CourseSettings,
    sensors: &'a BroadSensors,
) -> Vec<Work<'a>> {
    let of = &settings.objects;
    let train = (0..sensors.covers.min(of.objects)).map(|n| (Split::Train, sensors.covers, n));
    let test = 0..sensors.test_covers.min(of.test_objects);
    let test = test.map(|n| (Split::Test, sensors.test_covers, n));
    let cover = |((split, count, number), index)| -> Work {
        Box::new(move || {
            let units = units(of);
            let mut station = Station::draw(settings, sensors, (split, number), index);
            let mut made = station.references(units.len() as u32);
            let is_on = |unit: &Unit| unit.split == split && unit.number % count == number;
            for unit in units.into_iter().filter(is_on) {
                made.extend(station.object(unit));
            }
            made
        })
    };
    train.chain(test).zip(0..).map(cover).collect()
}

/// One cover on its arm, with the electronics under it.
struct Station<'a> {
    settings: &'a CourseSettings,
    split: Split,
    /// Number of the cover over both splits.
    index: u32,
    draws: Stream,
    bench: Bench,
    arm_n_per_mm: f64,
    ball_mm: f64,
    flat_mm: f64,
    electronics: Vec<Electronics>,
}

/// What reads the presses on a cover.
struct Electronics {
    number: u32,
    sensor: Sensor,
    period_s: f64,
    arm_factor: f64,
}

impl Electronics {
    /// A press of this plan as these electronics and the robot give it. Each electronics have noise of their own.
    fn course(
        &self,
        plan: &Plan,
        solved: &SolvedPress,
        noise: &Stream,
        labels: Labels,
    ) -> Option<LabelledCourse> {
        let mut noise = noise.child(self.number.into());
        let reading = Reading {
            period_s: self.period_s,
            phase: noise.uniform(),
        };
        let press = plan.read(&self.sensor, solved, reading, &mut noise, labels)?;
        Some(LabelledCourse {
            sensor: self.number,
            arm_n_per_mm: (plan.arm.n_per_mm * self.arm_factor) as f32,
            ..press
        })
    }
}

impl<'a> Station<'a> {
    fn draw(
        settings: &'a CourseSettings,
        sensors: &BroadSensors,
        (split, number): (Split, u32),
        index: u32,
    ) -> Self {
        let name = match split {
            Split::Train => "train covers",
            Split::Test => "test covers",
        };
        let draws = Stream::new(settings.objects.seed, name).child(number.into());
        let mut own = draws.child(0);
        let is_broad = sensors.designs == SensorDesigns::Broad;
        // Drawn for every design, so that what is drawn after it does not depend on the design.
        let drawn = Cover {
            young_mpa: log_even(COVER_MPA, &mut own),
            thickness_mm: log_even(COVER_MM, &mut own),
        };
        let cover = if is_broad { drawn } else { Cover::default() };
        let arm_n_per_mm = log_even(ARM_N_PER_MM, &mut own);
        let mut bench = Bench::under(cover);
        let weights = rigid::weights(&mut bench);
        let electronics = |k: u32| {
            let draws = draws.child(1).child(k.into());
            let design = match sensors.designs {
                SensorDesigns::Broad => Design::broad(cover.thickness_mm, &mut draws.child(0)),
                SensorDesigns::Jx255n => Design::jx255n(settings.objects.profile),
            };
            let mut sensor = Sensor::draw(design, &draws.child(1));
            sensor.calibrate(&weights);
            let mut own = draws.child(2);
            let wrong = log_even(WRONG, &mut own);
            if own.uniform() < WRONG_SHARE && is_broad {
                sensor.newtons_per_count *= wrong as f32;
            }
            Electronics {
                number: index * sensors.electronics + k,
                sensor,
                period_s: 1.0 / log_even(settings.frame_rate_hz, &mut own),
                arm_factor: 1.0 + own.range(-ARM_ERROR, ARM_ERROR),
            }
        };
        Self {
            settings,
            split,
            index,
            arm_n_per_mm,
            ball_mm: log_even(BALL_MM, &mut own),
            flat_mm: log_even(FLAT_MM, &mut own),
            electronics: (0..sensors.electronics).map(electronics).collect(),
            draws,
            bench,
        }
    }

    fn plan(&self, stream: &mut Stream) -> Plan {
        Plan::draw(self.settings, [self.arm_n_per_mm; 2], stream)
    }

    /// The presses of the rigid pieces. `objects` is the number of the data set's other objects.
    fn references(&mut self, objects: u32) -> Vec<Option<LabelledCourse>> {
        let (width_mm, radius_mm) = (self.flat_mm as f32, self.ball_mm as f32);
        let pieces = [Piece::Flat { width_mm }, Piece::Ball { radius_mm }];
        let mut made = Vec::new();
        for (piece, reference) in (0_u32..).zip(pieces) {
            let labels = Labels {
                level: 0,
                object: objects + 2 * self.index + piece,
                material: self.settings.material_names().len() as u8 - 1,
                split: self.split,
                shore: f32::NAN,
            };
            for press in 0..REFERENCES {
                let draws = self.draws.child(2);
                let draws = draws.child((piece * REFERENCES + press).into());
                let mut own = draws.child(0);
                let plan = self.plan(&mut own);
                let part = (f64::from(press) + own.uniform()) / f64::from(REFERENCES);
                let [least, most] = REFERENCE_N;
                let force_n = least * (most / least).powf(part);
                let specimen = rigid::specimen(&rigid::face(reference), &mut draws.child(1));
                let (arm, hold_s) = (plan.arm, plan.hold_s);
                let solved = SolvedPress::new(&mut self.bench, &specimen, arm, force_n, hold_s);
                made.extend(self.electronics.iter().map(|electronics| {
                    let press = electronics.course(&plan, &solved, &draws.child(2), labels)?;
                    Some(LabelledCourse {
                        reference: Some(reference),
                        ..press
                    })
                }));
            }
        }
        made
    }

    /// The presses of one object. A press that only some of the electronics see is in the data set
    /// for these.
    fn object(&mut self, unit: Unit) -> Vec<Option<LabelledCourse>> {
        let subject = Subject::draw(&self.settings.objects, unit, self.settings.flat_share());
        let mut made = Vec::new();
        for press in 0..u64::from(self.settings.objects.presses) {
            let plan = self.plan(&mut subject.geometry.child(3).child(press));
            let electronics = &self.electronics;
            let read = subject.pressed(&mut self.bench, &plan, press, |solved, noise| {
                let of = electronics.iter();
                let read = of.map(|of| of.course(&plan, solved, noise, subject.labels()));
                Some(read.collect::<Vec<_>>())
            });
            made.extend(read.unwrap_or_else(|| vec![None; electronics.len()]));
        }
        made
    }
}

#[cfg(test)]
mod tests;
