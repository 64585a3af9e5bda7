//! The whole simulated data set: objects, postures, forces, labels.
//!
//! The objects may be distributed over threads. Every number depends on the seed and on the object,
//! never on the thread.

use super::motion::Arm;
use super::object::{POSTURES, Pose};
use super::press::{Bench, Specimen};
use super::sensor::Film;
use super::settings::DatasetSettings;
use super::subject::{Labels, Subject, harder_and_harder, units};
use super::tracked::begins_press;
use crate::random::Stream;
use hardnessd_core::frame::Frame;

/// The sample of one press, with its labels.
#[derive(Debug, Clone, PartialEq)]
pub struct LabelledSample {
    /// The frame after an ideal tare, in newtons.
    pub frame: Frame,
    /// Force on the sensor.
    pub force_n: f32,
    /// The labels.
    pub labels: Labels,
}

pub(super) const HIGHEST_FORCE_N: f64 = 25.0;
const FORCES: usize = 8;
/// The number of presses of an object in each posture under each nominal force.
const ROUND: usize = POSTURES * FORCES;
const FORCE_JITTER: f64 = 0.08;

/// The work that makes the data set, one piece for each object, on any thread. The objects are in the order of
/// materials (as in [`super::Material::ALL`]) or of split and group, and their samples in that of posture and
/// press.
pub fn dataset(
    settings: &DatasetSettings,
) -> Vec<impl FnOnce() -> Vec<LabelledSample> + Send + '_> {
    let object = |unit| move || Subject::draw(settings, unit, 0.0).press_all(settings);
    units(settings).into_iter().map(object).collect()
}

impl Subject {
    /// Makes every press of the object. Postures are the outer loop, so that a face's texture and
    /// kernels serve all its presses.
    fn press_all(&self, settings: &DatasetSettings) -> Vec<LabelledSample> {
        let mut bench = Bench::default();
        let presses = press_numbers(settings.presses as usize);
        let mut samples = Vec::with_capacity(presses.len());
        for posture in 0..POSTURES {
            let face = self.face(posture);
            let of_posture = |press: &&usize| *press % POSTURES == posture;
            for &press in presses.iter().filter(of_posture) {
                let mut paired = self.geometry.child(1).child(press as u64);
                let pose = Pose::draw(&face.0, &mut paired);
                let nominal = nominal_force_n(settings.lowest_force_n, press / POSTURES % FORCES);
                let force_n = nominal * (1.0 + FORCE_JITTER * paired.normal()).clamp(0.7, 1.3);
                let hold_s = paired.range(0.8, 1.5);
                let specimen = self.specimen(&face, &pose);
                let mut noise = self.draws.child(2).child(press as u64);
                samples.push(self.press(&mut bench, &specimen, force_n, hold_s, &mut noise));
            }
        }
        samples
    }

    /// Makes one press, harder each time until it reaches the begin area.
    fn press(
        &self,
        bench: &mut Bench,
        specimen: &Specimen,
        force_n: f64,
        hold_s: f64,
        noise: &mut Stream,
    ) -> LabelledSample {
        let (arm, design) = (Arm::default(), &self.sensor.design);
        let gain = self.sensor.press_gain(noise);
        let mut last = None;
        for force_n in harder_and_harder(force_n) {
            let ramp_s = (force_n / arm.n_per_mm + TYPICAL_DEPTH_MM) / arm.speed_mm_s;
            let (window, pressure, _) = bench.press(specimen, force_n, ramp_s, hold_s);
            let forces = self.sensor.grid.taxel_forces(&pressure, window);
            let crept = Film::new(design).advance(design, &forces, hold_s + 0.5 * ramp_s);
            let frame = self.sensor.felt(&self.sensor.read(&crept, gain, noise));
            let is_felt = begins_press(&frame);
            last = Some(LabelledSample {
                frame,
                force_n: force_n as f32,
                labels: self.labels(),
            });
            if is_felt {
                break;
            }
        }
        last.expect("a press is tried")
    }
}

/// The numbers of an object's presses. Press n has posture n mod 6 and force n / 6 mod 8. Fewer
/// than 48 presses are some of these 48, and the counts of any two postures, or of any two forces,
/// differ by at most one.
fn press_numbers(count: usize) -> Vec<usize> {
    if count >= ROUND {
        return (0..count).collect();
    }
    // In steps of five, each of the eight forces comes once, and neighbours are far apart. After
    // half a round the forces shift by one, because each posture has met four forces by then and
    // would meet the same ones again. The first force is in the middle.
    let force = |place: usize| (FORCES / 2 + 5 * place + place / (ROUND / 2)) % FORCES;
    let number = |place: usize| place % POSTURES + POSTURES * force(place);
    let mut numbers: Vec<usize> = (0..count).map(number).collect();
    numbers.sort_unstable();
    numbers
}

/// Assumed indentation in the ramp of a sample. Sequences compute theirs.
const TYPICAL_DEPTH_MM: f64 = 2.0;

/// Force number `step` (0 to 7) of eight forces, evenly spaced from `lowest_n` to 25 N.
fn nominal_force_n(lowest_n: f32, step: usize) -> f64 {
    let lowest = f64::from(lowest_n);
    lowest + (HIGHEST_FORCE_N - lowest) * step as f64 / (FORCES - 1) as f64
}

#[cfg(test)]
mod tests {
    use super::super::material::{Material, Split};
    use super::super::object::Shapes;
    use super::*;

    fn small(shapes: Shapes) -> DatasetSettings {
        DatasetSettings {
            seed: 3,
            objects: 1,
            test_objects: 2,
            presses: 9,
            shapes,
            ..Default::default()
        }
    }

    #[test]
    fn few_presses_are_of_all_postures_and_forces() {
        // A whole round or more has all numbers in order.
        for count in [48, 49, 50, 100] {
            assert!(press_numbers(count).into_iter().eq(0..count), "{count}");
        }
        for count in 1..ROUND {
            let numbers = press_numbers(count);
            let times = |kinds: usize, of: fn(usize) -> usize| -> Vec<usize> {
                let count = |kind| numbers.iter().filter(|&&n| of(n) == kind).count();
                (0..kinds).map(count).collect()
            };
            let postures = times(POSTURES, |n| n % POSTURES);
            let forces = times(FORCES, |n| n / POSTURES);
            for times in [postures, forces] {
                assert_eq!(times.iter().sum::<usize>(), count);
                let (least, most) = (times.iter().min(), times.iter().max());
                assert!(most.unwrap() - least.unwrap() <= 1, "{count}: {times:?}");
            }
            assert!(numbers.is_sorted_by(|a, b| a < b), "{numbers:?}");
        }
    }

    #[test]
    fn samples_are_labelled_as_their_material_and_others_are_another_version() {
        // The sums are the newtons of all frames of each material. If they change on purpose,
        // change them and raise VERSION. Differences of a few counts may come from another machine.
        let settings = small(Shapes::Matched);
        let objects = dataset(&settings).into_iter();
        let samples: Vec<LabelledSample> = objects.flat_map(|make| make()).collect();
        let newtons = Material::ALL.map(|material| {
            let own = samples
                .iter()
                .filter(|s| s.labels.material == material.index());
            own.map(|sample| sample.frame.force_n()).sum::<f64>()
        });
        let expected = [
            139.48, 130.56, 126.36, 135.24, 259.08, 260.00, 259.52, 259.32,
        ];
        let alike = |(found, expected): (&f64, &f64)| (found / expected - 1.0).abs() < 5e-3;
        assert!(
            newtons.iter().zip(&expected).all(alike),
            "{newtons:.2?} of version {}",
            super::super::VERSION
        );
        assert_eq!(samples.len(), (4 + 4 * 2) * 9);
        for sample in &samples {
            let material = Material::ALL[usize::from(sample.labels.material)];
            assert_eq!(
                (sample.labels.level, sample.labels.split),
                (material.level(), material.split())
            );
            let shore = material.properties().shore;
            assert!((shore.low..=shore.high).contains(&f64::from(sample.labels.shore)));
            assert!(begins_press(&sample.frame));
        }
        let objects: std::collections::BTreeSet<u32> =
            samples.iter().map(|s| s.labels.object).collect();
        assert_eq!(objects.len(), 12);
    }

    #[test]
    fn all_eight_materials_can_be_for_test() {
        let settings = DatasetSettings {
            all_test: true,
            ..small(Shapes::Wide)
        };
        let all = units(&settings);
        assert_eq!(all.len(), 8 * 2);
        assert!(all.iter().all(|unit| unit.split == Split::Test));
    }
}
