//! The rigid pieces that a user presses on a sensor: weights, which calibrate it, and references,
//! which show what it reads of a known form.

use super::object::{Face, Pose};
use super::press::{Bench, Specimen, Window};
use super::sensor::{Film, Sensor};
use super::substance::{Creep, Law, Substance, Texture};
use super::texture::Patch;
use crate::random::Stream;
use hardnessd_core::verdict::Piece;

/// Width of the weights, mm.
const WEIGHT_MM: f64 = 20.0;
/// Standard deviation of the flat piece's tilt under an arm, degrees.
const TILT_DEG: f64 = 0.1;
/// Modulus of steel and of hard plastics alike, beside which every cover is soft, MPa.
const YOUNG_MPA: f64 = 3000.0;

/// The weights in N, from 0.2 to 2 kg, each put down in some places.
const WEIGHTS_N: [f64; 4] = [2.0, 5.0, 10.0, 20.0];
const PLACES: u64 = 3;
/// How long a weight lies before it is read, s.
const WEIGHT_S: f64 = 2.0;

/// The face of a piece that an arm presses.
///
/// # Panics
///
/// Panics if the piece is not a rigid one.
pub(super) fn face(piece: Piece) -> Face {
    match piece {
        Piece::Flat { width_mm } => Face::flat(0.5 * f64::from(width_mm), TILT_DEG),
        Piece::Ball { radius_mm } => Face::ball(radius_mm.into()),
        Piece::Shore { .. } => unreachable!("a rigid piece has a form"),
    }
}

/// A face of a rigid piece in a pose that is drawn.
pub(super) fn specimen(face: &Face, stream: &mut Stream) -> Specimen {
    let texture = Texture {
        rms_um: 1.0,
        shortest_mm: 4.0,
        longest_mm: 20.0,
        hurst: 0.8,
        anisotropy: 1.0,
    };
    let substance = Substance {
        nu: 0.3,
        law: Law::Solid,
        creep: [Creep::NONE; 2],
        texture,
    };
    let pose = Pose::draw(face, stream);
    let patch = Patch::new(&texture, 1.0, stream);
    Specimen::new(substance, YOUNG_MPA, face, &pose, &patch)
}

/// A weight on the sensor: the pressure under its flat face.
#[derive(Debug)]
pub(super) struct Weight {
    force_n: f64,
    window: Window,
    pressure: Vec<f32>,
}

/// The weights on sensors under one cover.
pub(super) fn weights(bench: &mut Bench) -> Vec<Weight> {
    // A weight lies by itself, so it does not tilt.
    let face = Face::flat(0.5 * WEIGHT_MM, 0.0);
    let stream = Stream::new(0, "places of weights");
    let mut weights = Vec::new();
    for place in 0..PLACES {
        let specimen = specimen(&face, &mut stream.child(place));
        for force_n in WEIGHTS_N {
            let (window, pressure, _) = bench.press(&specimen, force_n, 0.0, WEIGHT_S);
            weights.push(Weight {
                force_n,
                window,
                pressure,
            });
        }
    }
    weights
}

impl Sensor {
    /// The newtons that the sensor reads under a weight.
    fn weighs(&self, weight: &Weight, noise: &mut Stream) -> f64 {
        let forces = self.grid.taxel_forces(&weight.pressure, weight.window);
        let felt = Film::new(&self.design).advance(&self.design, &forces, WEIGHT_S);
        self.felt(&self.read(&felt, 1.0, noise)).force_n()
    }

    /// Sets the newtons of a count so that the sums under the weights are right on average. A user
    /// who weighs a sensor finds its scale, and takes its response for linear.
    pub(super) fn calibrate(&mut self, weights: &[Weight]) {
        let mut noise = Stream::new(0, "weights");
        let read_n: f64 = weights.iter().map(|w| self.weighs(w, &mut noise)).sum();
        let force_n: f64 = weights.iter().map(|weight| weight.force_n).sum();
        if read_n > 0.0 {
            self.newtons_per_count *= (force_n / read_n) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::press::Cover;
    use super::super::sensor::Design;
    use super::*;

    #[test]
    fn the_mean_sum_of_many_calibrated_broad_sensors_is_the_force() {
        let mut bench = Bench::under(Cover {
            young_mpa: 1.0,
            ..Cover::default()
        });
        let all = weights(&mut bench);
        // Pieces that are no weights.
        let mut pieces = Vec::new();
        for (face, place) in [
            (Face::flat(12.0, 0.0), 1),
            (Face::ball(30.0), 2),
            (Face::flat(8.0, 0.1), 3),
        ] {
            let specimen = specimen(&face, &mut Stream::new(9, "pieces").child(place));
            for force_n in [3.0, 7.0, 15.0] {
                let (window, pressure, _) = bench.press(&specimen, force_n, 0.0, 1.0);
                pieces.push(Weight {
                    force_n,
                    window,
                    pressure,
                });
            }
        }
        let force_n: f64 = pieces.iter().map(|piece| piece.force_n).sum();
        let ratios = (0..40).map(|k| {
            let draws = Stream::new(5, "broad").child(k);
            let design = Design::broad(1.0, &mut draws.child(0));
            let mut sensor = Sensor::draw(design, &draws.child(1));
            sensor.calibrate(&all);
            let mut noise = Stream::new(8, "noise");
            let read_n = pieces.iter().map(|piece| sensor.weighs(piece, &mut noise));
            read_n.sum::<f64>() / force_n
        });
        let ratios: Vec<f64> = ratios.collect();
        let mean = ratios.iter().sum::<f64>() / 40.0;
        assert!((mean - 1.0).abs() < 0.05, "{mean}: {ratios:?}");
        assert!(
            ratios.iter().all(|ratio| (0.5..2.0).contains(ratio)),
            "{ratios:?}"
        );
    }
}
