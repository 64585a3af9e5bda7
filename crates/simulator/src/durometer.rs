//! Simulates a Shore OO durometer, which relates a material's hardness to its modulus.
//!
//! At the durometer's depths (up to 1.8 radii), small-strain theory is only a convention for
//! labelling. The convention is the same for every material.

use super::contact::{Local, Problem, Solver};
use super::kernel::{self, Layer};
use super::substance::Substance;

/// Radius of the OO indenter's hemisphere, mm (ASTM D2240).
const RADIUS_MM: f64 = 1.19;
/// Time after which the reading is taken, s.
const READ_S: f64 = 0.15;
/// Height of the tested piece, mm, like the objects that the sensor is pressed on.
const PIECE_MM: f64 = 40.0;
const CELL_MM: f64 = 0.04;
const WIDTH: usize = 64;
/// Relative error of a computed force, and absolute error of a reading.
const FORCE_TOLERANCE: f64 = 2e-4;
const SHORE_TOLERANCE: f64 = 0.01;

/// Spring force in N at Shore OO hardness `shore`.
fn spring_force_n(shore: f64) -> f64 {
    0.203 + 0.00908 * shore
}

/// Indentation depth in mm at Shore OO hardness `shore`.
pub(super) fn depth_mm(shore: f64) -> f64 {
    2.54 * (1.0 - shore / 100.0)
}

/// The durometer on a piece of one substance.
pub(super) struct Durometer {
    local: Local<'static>,
    gap_mm: Vec<f32>,
    spectrum: Vec<f32>,
    solver: Solver,
    pressure: Vec<f32>,
}

impl Durometer {
    pub(super) fn new(substance: &Substance) -> Self {
        let mut solver = Solver::new(WIDTH);
        let compliance = substance.compliance_ratio(READ_S);
        let unit = CELL_MM / substance.plane_strain(1.0) * compliance;
        let layer = substance.layer(PIECE_MM);
        let layer = layer.map(|(base, mm)| (Layer::new(substance.nu, base), mm / CELL_MM));
        let spectrum = solver.convolver.spectrum(|i, j| {
            let (x, y) = (i as f64, j as f64);
            unit * match &layer {
                Some((layer, height)) => layer.influence(x, y, *height),
                None => kernel::half_space(x, y),
            }
        });
        // The tip is a hemisphere. Beyond its radius the indenter continues as a cylinder.
        let gap_mm: Vec<f32> = (0..WIDTH * WIDTH)
            .map(|k| {
                let at = |i: usize| (i as f64 + 0.5 - 0.5 * WIDTH as f64) * CELL_MM;
                let square = at(k / WIDTH).powi(2) + at(k % WIDTH).powi(2);
                let rest = RADIUS_MM * RADIUS_MM - square;
                match rest > 0.0 {
                    true => (RADIUS_MM - rest.sqrt()) as f32,
                    false => 1e3,
                }
            })
            .collect();
        let local = Local {
            law: substance.law,
            young_mpa: 1.0,
            height_mm: PIECE_MM,
            factor: compliance,
            history_mpa: &[],
            time_s: READ_S,
        };
        Self {
            local,
            pressure: vec![0.0; gap_mm.len()],
            gap_mm,
            spectrum,
            solver,
        }
    }

    /// Young's modulus in MPa with which the durometer reads `shore`.
    ///
    /// All stresses and moduli of the laws are relative to E, so the force at a given depth is
    /// proportional to E, and one indentation with E = 1 MPa is enough.
    pub(super) fn young_mpa(&mut self, shore: f64) -> f64 {
        spring_force_n(shore) / self.force_n(depth_mm(shore))
    }

    /// The durometer's reading for Young's modulus `young_mpa`, by bisection; 0 if the indenter sinks in
    /// to the end.
    pub(super) fn reading(&mut self, young_mpa: f64) -> f64 {
        let (mut low, mut high) = (0.0, 100.0);
        while high - low > SHORE_TOLERANCE {
            let shore = 0.5 * (low + high);
            if self.approach_mm(spring_force_n(shore) / young_mpa) < depth_mm(shore) {
                low = shore;
            } else {
                high = shore;
            }
        }
        low
    }

    /// Force in N on the indenter at `depth_mm`, for E = 1 MPa.
    fn force_n(&mut self, depth_mm: f64) -> f64 {
        // Use the secant method on ln F against ln d, where the contact is nearly a power law.
        let mut force = [0.5, 0.6];
        let mut error = force.map(|f| (self.approach_mm(f) / depth_mm).ln());
        for _ in 0..40 {
            let slope = (error[1] - error[0]) / (force[1] / force[0]).ln();
            let next = force[1] * (-error[1] / slope).clamp(-0.7, 0.7).exp();
            force = [force[1], next];
            error = [error[1], (self.approach_mm(next) / depth_mm).ln()];
            if error[1].abs() < FORCE_TOLERANCE {
                break;
            }
        }
        force[1]
    }

    /// Depth in mm of the indenter under a force of `force_n`, for E = 1 MPa.
    fn approach_mm(&mut self, force_n: f64) -> f64 {
        let problem = Problem {
            gap_mm: &self.gap_mm,
            spectrum: &self.spectrum,
            block: None,
            local: self.local,
            force_n,
            cell_mm: CELL_MM,
            tolerance: FORCE_TOLERANCE,
        };
        self.solver.solve(&problem, &mut self.pressure).approach_mm
    }
}

#[cfg(test)]
mod tests {
    use super::super::material::Material;
    use super::super::substance::{Creep, Law};
    use super::*;
    use crate::tests::near;

    #[test]
    fn the_tables_moduli_are_what_the_durometer_gives() {
        for material in Material::ALL
            .into_iter()
            .filter(|material| material.level() > 1)
        {
            let properties = material.properties();
            let s = properties.shore;
            // Check the table's three points, and two between them for the parabola.
            for (shore, tolerance) in [
                (s.low, 5e-3),
                (s.mean, 5e-3),
                (s.high, 5e-3),
                (0.5 * (s.low + s.mean), 1e-2),
                (0.5 * (s.mean + s.high), 1e-2),
            ] {
                let held = properties.young_mpa(shore);
                let found = Durometer::new(&properties.substance).young_mpa(shore);
                let what = format!("{material:?} at Shore OO {shore}");
                near(held, found, tolerance, &what);
            }
        }
    }

    #[test]
    fn a_thick_layer_is_all_and_a_thin_one_shows_the_core() {
        let solid = Material::SoftCandy.properties().substance;
        let core = 3.0;
        let layered = |thickness_mm| Substance {
            law: Law::Layered { thickness_mm, core },
            ..solid
        };
        let force_n = |substance: Substance| Durometer::new(&substance).force_n(depth_mm(60.0));
        // The thicknesses range from far beyond the indenter's depth to half a cell.
        let forces = [400.0, 10.0, 3.0, 1.0, 0.3, 0.02].map(|mm| force_n(layered(mm)));
        let (thin, others) = forces.split_last().unwrap();
        assert!(
            others.is_sorted_by(|thick, thin| thick < thin),
            "{forces:?}"
        );
        near(forces[0], force_n(solid), 0.01, "thick");
        let core_n = core * force_n(Substance { nu: 0.3, ..solid });
        near(*thin, core_n, 0.05, "thin");
    }

    #[test]
    fn an_indenter_that_sinks_in_to_the_end_reads_0() {
        let candy = Material::SoftCandy.properties().substance;
        assert_eq!(Durometer::new(&candy).reading(1e-4), 0.0);
    }

    #[test]
    fn a_shallow_reading_is_hertzs() {
        // Hertz: d = (9 F^2 / (16 R E*^2))^(1/3), with F and d from the reading. At readings of
        // 94.5 and below, the indenter sinks in by a tenth of its radius or more.
        let wood = Material::Wood.properties().substance;
        let elastic = Substance {
            creep: [Creep::NONE; 2],
            ..wood
        };
        let shore = 95.0;
        let force_n = spring_force_n(shore);
        let plane_strain =
            (9.0 * force_n.powi(2) / (16.0 * RADIUS_MM * depth_mm(shore).powi(3))).sqrt();
        let expected = plane_strain * (1.0 - elastic.nu.powi(2));
        let found = Durometer::new(&elastic).young_mpa(shore);
        near(found, expected, 0.06, "the modulus");
    }
}
