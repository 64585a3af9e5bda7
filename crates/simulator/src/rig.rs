//! A sensor on an arm that somebody else moves, with one object in front of it.
//!
//! In: positions of the arm, a short time apart. Out: the frame that the sensor reads now. The contact
//! at a position is that of a press at 5 mm/s which has come so far. So an object does not creep while
//! the arm stands, and keeps no dent.

use super::material::{Body, Material};
use super::motion::{Arm, Motion};
use super::press::Bench;
use super::sensor::{Design, Film, Sensor, SensorProfile};
use super::sequence::{SequenceSettings, presented};
use super::solved::{FeltPress, SolvedPress};
use crate::random::Stream;
use hardnessd_core::frame::RawFrame;

/// See the head of this file.
pub struct Rig {
    settings: SequenceSettings,
    root: Stream,
    sensor: Sensor,
    bench: Bench,
    object: Placed,
}

/// An object in front of the sensor, which has rested before.
struct Placed {
    press: FeltPress,
    motion: Motion,
    /// Where the arm is when the sensor touches the object.
    distance_mm: f64,
    touched: Touched,
    film: Film,
    /// The forces that the film gives now.
    felt_n: Vec<f32>,
    /// The noise of the frames, and the gain of the press.
    noise: Stream,
    gain: f32,
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
/// The greatest force on the sensor. An arm that goes on brings no more.
const MOST_N: f64 = 70.0;

impl Rig {
    /// The rig with the first object of these settings. Object k is of `materials[(k - 1) % n]`.
    ///
    /// # Panics
    ///
    /// Panics if there are no materials.
    pub fn new(settings: SequenceSettings) -> Self {
        let root = Stream::new(settings.seed, "rig");
        let sensor = Sensor::draw(Design::jx255n(SensorProfile::Clean), &root.child(0));
        let mut bench = Bench::default();
        Self {
            object: Placed::draw(&settings, &root, &mut bench, &sensor, 1),
            settings,
            root,
            sensor,
            bench,
        }
    }

    /// Puts another object in front of the sensor, which has rested. The same number is the same object,
    /// and the same noise.
    pub fn place(&mut self, object: u32) {
        let (settings, bench) = (&self.settings, &mut self.bench);
        self.object = Placed::draw(settings, &self.root, bench, &self.sensor, object);
    }

    /// Moves the arm to `position_mm`, in `time_s` since the last move. The object is 2 to 4 mm beyond
    /// 0.
    pub fn move_to(&mut self, position_mm: f64, time_s: f64) {
        let of = &mut self.object;
        let loading_s = of.motion.loading_s(position_mm - of.distance_mm);
        let (force_n, forces) = of.press.at(loading_s);
        let touched = &mut of.touched;
        if touched.force_n == 0.0 && force_n > 0.0 {
            of.gain = self.sensor.press_gain(&mut of.noise);
        }
        touched.force_n = force_n;
        touched.greatest_n = touched.greatest_n.max(force_n);
        of.felt_n = of.film.advance(&self.sensor.design, &forces, time_s);
    }

    /// What the sensor reads now.
    pub fn read(&mut self) -> RawFrame {
        let of = &mut self.object;
        self.sensor.read(&of.felt_n, of.gain, &mut of.noise)
    }

    /// The object in front of the sensor.
    pub fn touched(&self) -> Touched {
        self.object.touched
    }
}

impl Placed {
    fn draw(
        settings: &SequenceSettings,
        root: &Stream,
        bench: &mut Bench,
        sensor: &Sensor,
        object: u32,
    ) -> Self {
        let place = object.saturating_sub(1);
        let mut draws = root.child(1).child(u64::from(place));
        let material = settings.materials[place as usize % settings.materials.len()];
        let (Body { shore, .. }, specimen) = presented(Some(material), &mut draws);
        let press = SolvedPress::new(bench, &specimen, Arm::default(), MOST_N, 0.0);
        Self {
            press: press.felt(&sensor.grid),
            motion: press.motion,
            distance_mm: draws.range(DISTANCE_MM.0, DISTANCE_MM.1),
            touched: Touched {
                object,
                material,
                shore,
                force_n: 0.0,
                greatest_n: 0.0,
            },
            film: Film::new(&sensor.design),
            felt_n: vec![0.0; sensor.grid.array.taxels()],
            noise: root.child(2).child(u64::from(object)),
            gain: 1.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_move_at_5_mm_a_second_is_a_press_and_what_is_left_reads_nothing() {
        let mut rig = Rig::new(SequenceSettings {
            seed: 5,
            materials: vec![Material::SoftCandy],
            ..SequenceSettings::default()
        });
        let (_, specimen) = presented(Some(Material::SoftCandy), &mut rig.root.child(1).child(0));
        let press = SolvedPress::new(&mut Bench::default(), &specimen, Arm::default(), 12.0, 0.8);
        let felt = press.felt(&rig.sensor.grid);
        let (mut off_n, mut all_n) = (0.0, 0.0);
        for step in 1..=20 {
            let time_s = press.motion.load_s * f64::from(step) / 20.5;
            let approach_mm = press.motion.approach_mm(time_s);
            rig.move_to(rig.object.distance_mm + approach_mm, 0.02);
            let (expected_n, _) = felt.at(time_s);
            off_n += (rig.touched().force_n - expected_n).abs();
            all_n += expected_n;
        }
        assert!(off_n < 0.03 * all_n, "{off_n} of {all_n} N");
        rig.move_to(0.0, 0.02);
        assert_eq!(rig.read(), RawFrame::zero(rig.sensor.grid.array));
        rig.move_to(30.0, 0.02);
        let greatest_n = rig.touched().greatest_n;
        assert!((greatest_n - MOST_N).abs() < 0.5, "{greatest_n}");
        rig.place(1);
        rig.move_to(30.0, 0.02);
        assert_eq!(rig.touched().greatest_n, greatest_n, "the same object");
    }
}
