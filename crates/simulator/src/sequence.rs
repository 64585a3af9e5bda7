//! A sequence of presses as a sensor would send it: raw frames at a steady rate.
//!
//! Frames come out one at a time, but a press is computed as a whole when its first frame is due
//! (0.05 to 0.5 s of work). To play a sequence in real time, run it some frames ahead.

use std::collections::VecDeque;

use super::broad;
use super::dataset::HIGHEST_FORCE_N;
use super::material::Material;
use super::motion::{Approach, Arm, Motion};
use super::object::{self, POSTURES, Pose, Shapes};
use super::press::{Bench, Specimen, draw_patch};
use super::rigid;
use super::sensor::{ARRAY, Design, Film, Sensor, SensorProfile};
use super::solved::SolvedPress;
use super::subject::harder_and_harder;
use super::tracked::one_press;
use crate::random::Stream;
use hardnessd_core::frame::RawFrame;
use hardnessd_core::verdict::Piece;

/// The settings of a sequence: what to press, how often and how hard.
#[derive(Debug, Clone, PartialEq)]
pub struct SequenceSettings {
    /// The seed of everything random.
    pub seed: u64,
    /// Frames per second.
    pub frame_rate_hz: f64,
    /// Press k is of `materials[(k - 1) % n]`, each time on another object.
    pub materials: Vec<Material>,
    /// Whether every second round is of random materials, each press of another one.
    pub has_random: bool,
    /// Greatest forces of the presses, used in turn. If empty, they are drawn from 5 to 25 N.
    pub forces_n: Vec<f32>,
    /// The number of presses; `None` for an endless sequence.
    pub presses: Option<u32>,
    /// The rigid piece to press in place of the objects.
    pub piece: Option<Piece>,
}

impl Default for SequenceSettings {
    /// The four test materials in an endless sequence, at the paper's 5 frames/s.
    fn default() -> Self {
        Self {
            seed: 0,
            frame_rate_hz: 5.0,
            materials: Material::ALL[4..].to_vec(),
            has_random: false,
            forces_n: Vec::new(),
            presses: None,
            piece: None,
        }
    }
}

impl SequenceSettings {
    /// The stream. It has a name of its own, so that a sequence shares no object and no sensor with a data set.
    fn root(&self) -> Stream {
        Stream::new(self.seed, "sequence")
    }

    /// The stream that press `number`, from 1, is drawn from.
    fn draws(&self, number: u32) -> Stream {
        self.root().child(1).child((number - 1).into())
    }

    /// The material of press `number`, from 1; `None` for a random one.
    fn material(&self, number: u32) -> Option<Material> {
        let (before, round) = (number as usize - 1, self.materials.len());
        let is_random = self.has_random && before / round % 2 == 1;
        (!is_random).then(|| self.materials[before % round])
    }

    /// What press `number`, from 1, presses.
    pub fn pressed(&self, number: u32) -> Pressed {
        let material = self.material(number);
        let body = broad::body_of(material, &mut self.draws(number).child(3));
        let random = || broad::LAWS[usize::from(body.material) - Material::ALL.len()];
        Pressed {
            name: match material {
                Some(material) => material.name().to_owned(),
                None => random().replace("broad", "random"),
            },
            shore: body.shore,
            level: body.level,
        }
    }
}

/// The object of a press.
#[derive(Debug, Clone, PartialEq)]
pub struct Pressed {
    /// The name of the material, or `random-` and its law.
    pub name: String,
    /// What a durometer reads, in Shore OO.
    pub shore: f64,
    /// The hardness level, 1 to 4.
    pub level: u8,
}

/// One frame, with the state of the press.
#[derive(Debug, Clone, PartialEq)]
pub struct SequenceFrame {
    /// The frame that the sensor sends.
    pub raw: RawFrame,
    /// Number of the press, from 1, which includes the rest after it. 0 before the first press.
    pub press: u32,
    /// Whether the object is being touched.
    pub loaded: bool,
    /// The arm's motion around this frame.
    pub approach: Approach,
}

/// An iterator over the frames of a sequence; see [`SequenceSettings`].
///
/// The sequence begins with at least 2 s and ten frames without load, so that tare has its frames
/// at any rate. Each press is held for at least three frames. The rest after it is at least 1 s and five
/// frames. A press too light to begin one (3 taxels) is made anew with more force, so that a press tracker sees `presses` presses.
pub struct Sequence {
    settings: SequenceSettings,
    sensor: Sensor,
    bench: Bench,
    film: Film,
    ready: VecDeque<SequenceFrame>,
    /// The number of presses made so far.
    made: u32,
    /// The number of frames made so far. Frame n is taken at n / frame rate.
    frames: u64,
    /// Time at which the rest after the last press ends, s.
    free_s: f64,
    /// The time of the last press's touch, and the arm's motion in that press.
    last: Option<(f64, Motion)>,
}

/// Least rest before the first press, in s and in frames.
const FIRST_REST: (f64, f64) = (2.0, 10.0);
/// Least rest after a press, in s and in frames.
const REST: (f64, f64) = (1.0, 5.0);
/// The least number of frames that a press is held.
const HOLD_FRAMES: f64 = 3.0;
/// Greatest delay of a press, s. Each press gets a random delay, so that presses are not in step
/// with the frames.
const DELAY_S: f64 = 0.25;

impl Sequence {
    /// The sequence that follows from `settings`.
    ///
    /// # Panics
    ///
    /// Panics if the frame rate is not a positive finite number.
    pub fn new(settings: SequenceSettings) -> Self {
        let rate = settings.frame_rate_hz;
        assert!(
            rate.is_finite() && rate > 0.0,
            "frame rate {rate} is not a positive number"
        );
        let design = Design::jx255n(SensorProfile::Clean);
        let sensor = Sensor::draw(design, &settings.root().child(0));
        Self {
            free_s: FIRST_REST.0.max(FIRST_REST.1 / rate),
            settings,
            bench: Bench::default(),
            film: Film::new(&sensor.design),
            sensor,
            ready: VecDeque::new(),
            made: 0,
            frames: 0,
            last: None,
        }
    }

    /// The touch time of the next press, and the stream that the press is drawn from, after its
    /// first draw, the delay.
    fn next_draws(&self) -> (f64, Stream) {
        let mut draws = self.settings.draws(self.made + 1);
        let delay_s = draws.range(0.0, DELAY_S);
        (self.free_s + delay_s, draws)
    }

    fn is_done(&self) -> bool {
        let presses = self.settings.presses;
        presses.is_some_and(|presses| self.made >= presses)
    }

    /// Makes a frame without load. A rest may be long, so its frames are made one at a time.
    fn rest(&mut self) -> SequenceFrame {
        let approach = Approach {
            last: self.last,
            next_s: (!self.is_done()).then(|| self.next_draws().0),
        };
        let unloaded = vec![0.0; ARRAY.taxels()];
        let period_s = 1.0 / self.settings.frame_rate_hz;
        (self.film).advance(&self.sensor.design, &unloaded, period_s);
        self.frames += 1;
        SequenceFrame {
            raw: RawFrame::zero(ARRAY),
            press: self.made,
            loaded: false,
            approach,
        }
    }

    /// Makes the next press.
    fn press(&mut self) {
        let (touch_s, mut draws) = self.next_draws();
        self.made += 1;
        let material = self.settings.material(self.made);
        let drawn = draws.range(5.0, HIGHEST_FORCE_N);
        let in_turn = (self.made as usize - 1).checked_rem(self.settings.forces_n.len());
        let force_n = in_turn.map_or(drawn, |place| self.settings.forces_n[place].into());
        let specimen = match self.settings.piece {
            Some(piece) => rigid::specimen(&rigid::face(piece), &mut draws.child(2)),
            None => presented(material, &mut draws),
        };
        let rate = self.settings.frame_rate_hz;
        let rest_s = REST.0.max(REST.1 / rate);
        let hold_s = draws.range(0.8, 1.5).max(HOLD_FRAMES / rate);
        let before = self.film.clone();
        for (attempt, force_n) in (1..).zip(harder_and_harder(force_n)) {
            let bench = &mut self.bench;
            let solved = SolvedPress::new(bench, &specimen, Arm::default(), force_n, hold_s);
            self.last = Some((touch_s, solved.motion));
            self.film.clone_from(&before);
            self.play(&solved, touch_s, &mut draws.child(4).child(attempt));
            self.free_s = touch_s + solved.duration_s() + rest_s;
            let felt = self.ready.iter().map(|frame| self.sensor.felt(&frame.raw));
            let felt: Vec<_> = felt.collect();
            if one_press(&felt, &self.sensor.thresholds(), 1.0 / rate).is_some() {
                break;
            }
        }
        self.frames += self.ready.len() as u64;
    }

    /// Makes the frames from now until the end of a press.
    fn play(&mut self, solved: &SolvedPress, touch_s: f64, noise: &mut Stream) {
        let period_s = 1.0 / self.settings.frame_rate_hz;
        let gain = self.sensor.press_gain(noise);
        let felt = solved.felt(&self.sensor.grid);
        let times = (self.frames..).map(|number| number as f64 * period_s - touch_s);
        self.ready.clear();
        for time_s in times.take_while(|&time_s| time_s < solved.duration_s()) {
            let forces = felt.at(time_s);
            let crept = self.film.advance(&self.sensor.design, &forces, period_s);
            self.ready.push_back(SequenceFrame {
                raw: self.sensor.read(&crept, gain, noise),
                press: self.made,
                loaded: time_s > 0.0,
                approach: Approach {
                    last: self.last,
                    next_s: None,
                },
            });
        }
    }
}

/// Draws an object of the material, or of a random one, and one of its faces in a pose.
fn presented(material: Option<Material>, draws: &mut Stream) -> Specimen {
    let body = broad::body_of(material, &mut draws.child(3));
    let object = object::draw(Shapes::Matched, body.level, &mut draws.child(0));
    let face = object[draws.below(POSTURES)];
    let patch = draw_patch(&body.substance.texture, face.roughness, &mut draws.child(1));
    let pose = Pose::draw(&face, &mut draws.child(2));
    Specimen::new(body.substance, body.young_mpa, &face, &pose, &patch)
}

impl Iterator for Sequence {
    type Item = SequenceFrame;

    fn next(&mut self) -> Option<SequenceFrame> {
        if self.ready.is_empty() {
            if self.frames as f64 / self.settings.frame_rate_hz <= self.free_s {
                return Some(self.rest());
            }
            if !self.is_done() {
                self.press();
            }
        }
        self.ready.pop_front()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The frames of a sequence in which a tracker sees each press once, after enough rest.
    fn check(settings: &SequenceSettings) -> Vec<SequenceFrame> {
        let rate = settings.frame_rate_hz;
        let sequence = Sequence::new(settings.clone());
        let sensor = sequence.sensor.clone();
        let frames: Vec<SequenceFrame> = sequence.collect();
        let first = frames.iter().position(|frame| frame.loaded).unwrap();
        assert!(first as f64 >= 10.0_f64.max(2.0 * rate), "{first} frames");
        for press in 1..=settings.presses.unwrap() {
            let own = frames.iter().filter(|frame| frame.press == press);
            let felt: Vec<_> = own.clone().map(|frame| sensor.felt(&frame.raw)).collect();
            let seen = one_press(&felt, &sensor.thresholds(), 1.0 / rate);
            let held = seen.expect("one press").contact.len();
            // The presses are far shorter than 30 s, after which the daemon ends a press.
            assert!((held as f64) < 15.0 * rate, "{held} frames");
            let rest = own.clone().filter(|frame| !frame.loaded).count() as f64;
            assert!(rest >= 5.0_f64.max(0.9 * rate), "{press} rests {rest}");
        }
        let is_free = |frame: &SequenceFrame| frame.raw == RawFrame::default();
        assert!(frames.iter().all(|frame| frame.loaded || is_free(frame)));
        frames
    }

    #[test]
    fn a_tracker_sees_every_press_once() {
        for (seed, frame_rate_hz) in [(1, 5.0), (2, 20.0), (3, 100.0), (4, 0.5), (5, 1.5)] {
            check(&SequenceSettings {
                seed,
                frame_rate_hz,
                materials: Material::ALL.to_vec(),
                presses: Some(8),
                ..SequenceSettings::default()
            });
        }
    }

    #[test]
    fn a_press_too_light_is_made_anew_with_more_force() {
        check(&SequenceSettings {
            seed: 4,
            materials: vec![Material::Sponge, Material::Wood, Material::YogaMat],
            forces_n: vec![0.3],
            presses: Some(3),
            ..SequenceSettings::default()
        });
    }

    #[test]
    fn every_second_round_is_of_random_materials_whose_hardness_is_known() {
        let settings = SequenceSettings {
            seed: 8,
            has_random: true,
            presses: Some(8),
            ..SequenceSettings::default()
        };
        let pressed: Vec<Pressed> = (1..=8).map(|press| settings.pressed(press)).collect();
        for (one, material) in pressed.iter().zip(&settings.materials) {
            assert_eq!((&*one.name, one.level), (material.name(), material.level()));
        }
        for one in &pressed[4..] {
            assert!(one.name.starts_with("random-"), "{one:?}");
            assert_eq!(one.level, crate::level_of(one.shore));
        }
        check(&settings);
    }
}
