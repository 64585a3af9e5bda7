//! A Shore OO durometer, simulated: what ties a material's hardness to its modulus.
//!
//! At its depths (up to 1.5 radii) small-strain theory is only a convention for labelling; it is
//! the same convention for every material.

use super::contact::{self, Fields, Local, Problem};
use super::fourier::Convolver;
use super::kernel::{self, Layer};
use super::material::{Law, Properties};

/// Radius of the OO indenter's hemisphere, mm (ASTM D2240).
const RADIUS_MM: f64 = 1.19;
/// The reading is taken after this, s.
const READ_S: f64 = 0.15;
/// Height of what is tested, mm: an object like those the sensor is pressed on.
const PIECE_MM: f64 = 40.0;
const CELL_MM: f64 = 0.04;
const WIDTH: usize = 64;

/// Spring force in N at Shore OO hardness `shore`.
fn spring_force_n(shore: f64) -> f64 {
    0.203 + 0.00908 * shore
}

/// Indentation depth in mm at Shore OO hardness `shore`.
fn depth_mm(shore: f64) -> f64 {
    2.54 * (1.0 - shore / 100.0)
}

/// Young's modulus in MPa with which the durometer reads `shore`.
///
/// All stresses of the laws are relative to E, so the force at a given depth is proportional to E
/// and one indentation with E = 1 MPa suffices.
pub(super) fn young_mpa(material: &Properties, shore: f64) -> f64 {
    spring_force_n(shore) / indent(material, depth_mm(shore))
}

/// Force in N on the indenter at `depth_mm`, for E = 1 MPa.
fn indent(material: &Properties, depth_mm: f64) -> f64 {
    let mut convolver = Convolver::new(WIDTH);
    let compliance = material.compliance_ratio(READ_S);
    let unit = CELL_MM * (1.0 - material.nu * material.nu) * compliance;
    let layer = Layer::new(material.nu);
    let spectrum = convolver.spectrum(|i, j| {
        let (x, y) = (i as f64, j as f64);
        unit * match material.law {
            Law::Foam { .. } => layer.influence(x, y, PIECE_MM / CELL_MM),
            Law::Solid | Law::Plastic { .. } => kernel::half_space(x, y),
        }
    });
    // Hemisphere; beyond its radius the indenter goes on as a cylinder.
    let gap: Vec<f32> = (0..WIDTH * WIDTH)
        .map(|k| {
            let at = |i: usize| (i as f64 + 0.5 - 0.5 * WIDTH as f64) * CELL_MM;
            let square = at(k / WIDTH).powi(2) + at(k % WIDTH).powi(2);
            let rest = RADIUS_MM * RADIUS_MM - square;
            if rest > 0.0 {
                (RADIUS_MM - rest.sqrt()) as f32
            } else {
                1e3
            }
        })
        .collect();
    let local = match material.law {
        Law::Solid => Local::None,
        Law::Plastic { hardness } => Local::Flow {
            hardness_mpa: hardness,
            time_s: READ_S,
        },
        Law::Foam {
            exponent,
            plateau,
            strain,
        } => Local::Foam {
            plateau_mpa: plateau,
            exponent,
            strain,
            height_mm: PIECE_MM,
            factor: compliance,
            history_mpa: &[],
        },
    };
    let mut fields = Fields::default();
    let mut pressure = vec![0.0; WIDTH * WIDTH];
    let mut approach = |force_n: f64| {
        let problem = Problem {
            gap_mm: &gap,
            spectrum: &spectrum,
            local,
            force_n,
            cell_mm: CELL_MM,
            tolerance: 2e-4,
        };
        contact::solve(&mut convolver, &mut fields, &problem, &mut pressure).approach_mm
    };
    // Secant on ln F against ln d, where the contact is nearly a power law.
    let mut force = [0.5, 0.6];
    let mut error = force.map(|f| (approach(f) / depth_mm).ln());
    for _ in 0..40 {
        let slope = (error[1] - error[0]) / (force[1] / force[0]).ln();
        let next = force[1] * (-error[1] / slope).clamp(-0.7, 0.7).exp();
        force = [force[1], next];
        error = [error[1], (approach(next) / depth_mm).ln()];
        if error[1].abs() < 2e-4 {
            break;
        }
    }
    force[1]
}

#[cfg(test)]
mod tests {
    use super::super::material::Material;
    use super::*;

    #[test]
    fn the_tables_moduli_are_what_the_durometer_gives() {
        for material in Material::ALL
            .into_iter()
            .filter(|material| material.level() > 1)
        {
            let properties = material.properties();
            let s = properties.shore;
            // The table's three points, and two between them for the parabola.
            for (shore, tolerance) in [
                (s.low, 5e-3),
                (s.mean, 5e-3),
                (s.high, 5e-3),
                (0.5 * (s.low + s.mean), 1e-2),
                (0.5 * (s.mean + s.high), 1e-2),
            ] {
                let (held, found) = (properties.young_mpa(shore), young_mpa(properties, shore));
                assert!(
                    (held / found - 1.0).abs() < tolerance,
                    "{material} at Shore OO {shore}: table {held}, durometer {found}"
                );
            }
        }
    }
}
