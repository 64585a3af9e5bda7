//! A sensor on an arm that somebody else moves, with one object in front of it.
//!
//! In: positions of the arm, a short time apart. Out: the frame that the sensor reads now. Each step
//! goes on from the creep and the dents that the steps before left in the object, also after the
//! sensor has left it.

use super::material::{Body, Material};
use super::motion::Arm;
use super::press::{Bench, Specimen};
use super::sensor::{Film, Sensor};
use super::sequence::{SequenceSettings, presented};
use super::solved::{Run, State};
use crate::random::Stream;
use hardnessd_core::frame::RawFrame;

/// See the head of this file.
pub struct Rig {
    settings: SequenceSettings,
    root: Stream,
    sensor: Sensor,
    film: Film,
    /// The forces that the film gives now.
    felt_n: Vec<f32>,
    bench: Bench,
    arm: Arm,
    object: Placed,
    /// The noise of the frames, and the gain of the press.
    noise: Stream,
    gain: f32,
}

/// An object in front of the sensor.
struct Placed {
    specimen: Specimen,
    at: State,
    /// Where the arm is when the sensor touches the object.
    distance_mm: f64,
    touched: Touched,
}

/// The object, and how it is touched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Touched {
    /// Number of the object, from 1.
    pub object: u32,
    /// Its material.
    pub material: Material,
    /// Its Shore hardness.
    pub shore: f64,
    /// The force on the sensor now.
    pub force_n: f64,
    /// The greatest force on this object so far.
    pub greatest_n: f64,
}

/// Where the surface of an object is when the arm is at 0.
const DISTANCE_MM: (f64, f64) = (2.0, 4.0);
/// The force for which the first window is chosen. It grows with the contact.
const FIRST_N: f64 = 2.0;

impl Rig {
    /// The rig with the first object of these settings. Object k is of `materials[(k - 1) % n]`.
    ///
    /// # Panics
    ///
    /// Panics if there are no materials.
    pub fn new(settings: SequenceSettings) -> Self {
        let root = Stream::new(settings.seed, "rig");
        let sensor = Sensor::new(settings.profile, &root.child(0));
        let mut bench = Bench::default();
        Self {
            object: Placed::draw(&settings, &root, &mut bench, 1),
            film: Film::new(&sensor.design),
            felt_n: vec![0.0; sensor.grid.array.taxels()],
            sensor,
            bench,
            arm: Arm::default(),
            noise: noise_of(&root, 1),
            gain: 1.0,
            settings,
            root,
        }
    }

    /// Puts another object in front of the sensor, which has rested. The same number is the same object,
    /// as new, and the same noise.
    pub fn place(&mut self, object: u32) {
        self.film = Film::new(&self.sensor.design);
        self.noise = noise_of(&self.root, object);
        self.object = Placed::draw(&self.settings, &self.root, &mut self.bench, object);
    }

    /// Moves the arm to `position_mm`, in `time_s` since the last move. The object is 2 to 4 mm beyond
    /// 0.
    pub fn move_to(&mut self, position_mm: f64, time_s: f64) {
        let Placed {
            specimen,
            at,
            distance_mm,
            touched,
        } = &mut self.object;
        let mut run = Run {
            bench: &mut self.bench,
            specimen,
            arm: self.arm,
            at,
        };
        run.move_to(position_mm - *distance_mm, time_s);
        if touched.force_n == 0.0 && at.force_n > 0.0 {
            self.gain = self.sensor.press_gain(&mut self.noise);
        }
        touched.force_n = at.force_n;
        touched.greatest_n = touched.greatest_n.max(at.force_n);
        let forces = self.sensor.grid.taxel_forces(&at.pressure, at.window);
        self.felt_n = self.film.advance(&self.sensor.design, &forces, time_s);
    }

    /// What the sensor reads now.
    pub fn read(&mut self) -> RawFrame {
        self.sensor.read(&self.felt_n, self.gain, &mut self.noise)
    }

    /// The object in front of the sensor.
    pub fn touched(&self) -> Touched {
        self.object.touched
    }
}

fn noise_of(root: &Stream, object: u32) -> Stream {
    root.child(2).child(u64::from(object))
}

impl Placed {
    fn draw(settings: &SequenceSettings, root: &Stream, bench: &mut Bench, object: u32) -> Self {
        let place = object.saturating_sub(1);
        let mut draws = root.child(1).child(u64::from(place));
        let material = settings.materials[place as usize % settings.materials.len()];
        let (Body { shore, .. }, specimen) = presented(Some(material), &mut draws);
        let window = bench.press(&specimen, FIRST_N, 1.0, 0.0).0;
        Self {
            at: State::new(&specimen, window),
            specimen,
            distance_mm: draws.range(DISTANCE_MM.0, DISTANCE_MM.1),
            touched: Touched {
                object,
                material,
                shore,
                force_n: 0.0,
                greatest_n: 0.0,
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::solved::SolvedPress;
    use super::*;

    fn rig(material: Material) -> Rig {
        Rig::new(SequenceSettings {
            seed: 5,
            materials: vec![material],
            ..SequenceSettings::default()
        })
    }

    const STEP_S: f64 = 0.02;

    #[test]
    fn a_move_at_a_steady_speed_is_the_press_that_is_solved_as_a_whole() {
        for material in Material::ALL {
            let mut rig = rig(material);
            let Placed {
                specimen,
                distance_mm,
                ..
            } = &rig.object;
            let (touch_mm, hold_s) = (*distance_mm, 0.8);
            let press = SolvedPress::new(&mut Bench::default(), specimen, rig.arm, 12.0, hold_s);
            let grid = &rig.sensor.grid;
            let felt = press.felt(grid);
            let steps = (press.duration_s() / STEP_S) as u32;
            let (mut off, mut sum) = (0.0, 0.0);
            let sum_n = |taxels: &[f32]| taxels.iter().map(|&n| f64::from(n)).sum::<f64>();
            let mut tops = [0.0_f64; 2];
            for step in 1..=steps {
                let time_s = f64::from(step) * STEP_S;
                rig.move_to(touch_mm + press.motion.approach_mm(time_s), STEP_S);
                let expected_n = sum_n(&felt.taxels_n(time_s));
                let at = &rig.object.at;
                let found_n = sum_n(&rig.sensor.grid.taxel_forces(&at.pressure, at.window));
                off += (found_n - expected_n).abs();
                sum += expected_n;
                tops = [tops[0].max(found_n), tops[1].max(expected_n)];
            }
            assert!(off < 0.01 * sum, "{material}: {} of the force", off / sum);
            assert!(
                (tops[0] / tops[1] - 1.0).abs() < 0.01,
                "{material}: {tops:?}"
            );
        }
    }

    #[test]
    fn an_object_that_is_left_reads_nothing_and_keeps_its_dent() {
        let mut rig = rig(Material::Plasticine);
        let greatest = |rig: &mut Rig| {
            let mut greatest_n = 0.0_f64;
            for step in 0..200_u32 {
                let up = f64::from(step.min(200 - step)) * 0.05;
                rig.move_to(up.min(5.5), STEP_S);
                greatest_n = greatest_n.max(rig.touched().force_n);
            }
            greatest_n
        };
        let first = greatest(&mut rig);
        assert_eq!(rig.read(), RawFrame::zero(rig.sensor.grid.array));
        let second = greatest(&mut rig);
        assert!(
            first > 2.0 && second < 0.98 * first,
            "{first} N, then {second} N"
        );
        assert_eq!(rig.touched().greatest_n, first);
        rig.place(1);
        assert_eq!(greatest(&mut rig), first, "the same object, as new");
    }
}
