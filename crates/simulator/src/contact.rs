//! Frictionless normal contact under a prescribed force.
//!
//! In: the undeformed gap h, the spectrum of the elastic influence K, the force F, a local law w.
//! Out: the pressure p and the rigid approach `d` such that
//! `gap = h + K p + w(p) - d >= 0`, `p >= 0`, `p gap = 0`, `sum(p) dA = F`.
//! The solver knows neither the pressed object nor its history.
//!
//! The method is the constrained conjugate gradients of Polonsky and Keer (1999), with the local
//! law's slope as preconditioner and in the step length. `w` grows with `p`, so the problem stays
//! convex and the nonlinear gradient replaces a Newton loop around linear solves.

use super::block::Standing;
use super::fourier::Convolver;
use super::substance::Law;

/// A displacement w that depends on the cell's own pressure only. It is 0 for elastic laws.
///
/// - Foam: `w = L e_D z / (1 + z)`, `z = (e / s_p)^m`, with the effective pressure
///   `e = factor p + history` and `L = min(height, 0.9 a)`.
/// - Plastic: one implicit step of Norton flow, `w = 0.5 a time (p / p_H)^4`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Local<'a> {
    pub(super) law: Law,
    pub(super) young_mpa: f64,
    /// Height of the object, mm.
    pub(super) height_mm: f64,
    /// The object's compliance over its instantaneous compliance, from creep.
    pub(super) factor: f64,
    /// The part of the effective pressure that earlier steps left; empty if there is none.
    pub(super) history_mpa: &'a [f32],
    /// Time over which flow acts.
    pub(super) time_s: f64,
}

/// A contact problem on one square window.
pub(super) struct Problem<'a> {
    /// h, mm, `[width, width]`, with the displacement that earlier steps left.
    pub(super) gap_mm: &'a [f32],
    /// Spectrum of the influence that is the same everywhere, mm per MPa: of object and cover together,
    /// or of the cover alone if the object is a block.
    pub(super) spectrum: &'a [f32],
    /// The object, if it is a block with free sides.
    pub(super) block: Option<Standing<'a>>,
    pub(super) local: Local<'a>,
    pub(super) force_n: f64,
    pub(super) cell_mm: f64,
    /// Relative tolerance; see [`TOLERANCE`].
    pub(super) tolerance: f64,
}

/// The solver's results besides the pressure.
#[derive(Debug, Clone, Copy)]
pub(super) struct Contact {
    /// d, the rigid approach, mm.
    pub(super) approach_mm: f64,
    /// a = sqrt(A / pi) of the contact area A, mm.
    pub(super) radius_mm: f64,
    /// Whether the tolerance was met.
    pub(super) converged: bool,
}

/// The solver stops when the pressure-weighted mean of |gap| is below this part of the
/// pressure-weighted mean compression. At 1e-3, areas and forces have settled far below a taxel's
/// noise (1.5 %).
pub(super) const TOLERANCE: f64 = 1e-3;
const MAX_ITERATIONS: u32 = 250;

/// The solver for windows of one width. Its fields are kept between calls, so that a solve allocates
/// nothing, and never change a result.
pub(super) struct Solver {
    pub(super) convolver: Convolver,
    displacement: Vec<f32>,
    residual: Vec<f32>,
    previous: Vec<f32>,
    direction: Vec<f32>,
    response: Vec<f32>,
    slope: Vec<f32>,
    inverse: Vec<f32>,
}

#[expect(
    clippy::needless_range_loop,
    reason = "one cell of several fields at a time"
)]
impl Solver {
    pub(super) fn new(width: usize) -> Self {
        let field = || vec![0.0; width * width];
        Self {
            convolver: Convolver::new(width),
            displacement: field(),
            residual: field(),
            previous: field(),
            direction: field(),
            response: field(),
            slope: field(),
            inverse: field(),
        }
    }

    /// Solves `problem` from the guess in `pressure_mpa`, which may be any non-negative field, and
    /// leaves the solution there.
    pub(super) fn solve(&mut self, problem: &Problem, pressure_mpa: &mut [f32]) -> Contact {
        let area = problem.cell_mm * problem.cell_mm;
        let total = problem.force_n / area;
        self.previous.fill(0.0);
        self.direction.fill(0.0);
        start(problem, total, pressure_mpa);
        // The preconditioner uses the kernel's value at a wavelength of 16 cells.
        let padded = 2 * self.convolver.width;
        let block = problem.block.as_ref();
        let block = block.map_or(0.0, |block| block.spectrum[padded / 16]);
        let elastic = (problem.spectrum[padded / 16] + block) * (padded * padded) as f32;
        let mut contact = Contact {
            approach_mm: 0.0,
            radius_mm: contact_radius(pressure_mpa, area),
            converged: false,
        };
        let (mut restart, mut is_displacement_known, mut rz_before) = (true, false, 1.0);
        for iteration in 1..=MAX_ITERATIONS {
            if !is_displacement_known {
                let out = &mut self.displacement;
                problem.displace(&mut self.convolver, pressure_mpa, out);
            }
            // Late in the solve, single cells at the rim switch on and off. The radius must not
            // follow them.
            if iteration < 30 {
                contact.radius_mm = contact_radius(pressure_mpa, area);
            }

            // Residual, slope and preconditioner of every cell. The approach, the multiplier of the
            // force constraint, is where the loaded cells balance.
            let (mut sum_inverse, mut sum_residual) = (0.0_f64, 0.0_f64);
            for i in 0..pressure_mpa.len() {
                let (w, slope) = problem.local.at(i, pressure_mpa[i], contact.radius_mm);
                let inverse = 1.0 / (elastic + slope);
                let residual = self.displacement[i] + problem.gap_mm[i] + w;
                self.slope[i] = slope;
                self.inverse[i] = inverse;
                self.residual[i] = residual;
                if pressure_mpa[i] > 0.0 {
                    sum_inverse += f64::from(inverse);
                    sum_residual += f64::from(residual * inverse);
                }
            }
            contact.approach_mm = sum_residual / sum_inverse;

            // How far the pressure is from the solution: pressure times |gap|, and pressure times
            // compression. `rz` is the square of the preconditioned residual, and `cross` its product
            // with the residual of the step before.
            let (mut error, mut work, mut rz, mut cross) = (0.0_f64, 0.0_f64, 0.0_f64, 0.0_f64);
            let mut penetration_mm = 0.0_f32;
            for i in 0..pressure_mpa.len() {
                let r = self.residual[i] - contact.approach_mm as f32;
                let p = pressure_mpa[i];
                if p > 0.0 {
                    let z = r * self.inverse[i];
                    error += f64::from(p * r.abs());
                    work += f64::from(p * (self.residual[i] - problem.gap_mm[i]));
                    rz += f64::from(r * z);
                    cross += f64::from(self.previous[i] * z);
                    self.previous[i] = r;
                } else {
                    penetration_mm = penetration_mm.max(-r);
                    self.previous[i] = 0.0;
                }
                self.residual[i] = r;
            }
            let slack_mm = (problem.tolerance * (work / total).max(1e-9)) as f32;
            if error <= problem.tolerance * work.max(1e-12) && penetration_mm < 10.0 * slack_mm {
                contact.converged = true;
                break;
            }

            // The factor of Polak and Ribiere, never negative.
            let beta = if restart {
                0.0
            } else {
                ((rz - cross) / rz_before).max(0.0)
            } as f32;
            rz_before = rz.max(1e-30);
            self.turn(pressure_mpa, beta, sum_inverse);
            let (direction, response) = (&self.direction, &mut self.response);
            problem.displace(&mut self.convolver, direction, response);
            let step = self.step_length();

            // Tension becomes 0, and cells that would penetrate by more than the slack are loaded.
            let (mut is_clipped, mut is_loaded) = (false, false);
            for i in 0..pressure_mpa.len() {
                let p = pressure_mpa[i];
                if p > 0.0 {
                    let next = p - step * self.direction[i];
                    is_clipped |= next < 0.0;
                    pressure_mpa[i] = next.max(0.0);
                } else if self.residual[i] < -slack_mm {
                    pressure_mpa[i] = -step.max(0.0) * self.residual[i] * self.inverse[i];
                    is_loaded |= pressure_mpa[i] > 0.0;
                }
            }
            restart = is_loaded;
            is_displacement_known = !(is_clipped || is_loaded || iteration.is_multiple_of(25));
            if is_displacement_known {
                for (u, &response) in self.displacement.iter_mut().zip(&self.response) {
                    *u -= step * response;
                }
            } else {
                start(problem, total, pressure_mpa);
            }
        }
        contact
    }

    /// Computes the next conjugate direction, without net force.
    fn turn(&mut self, pressure_mpa: &[f32], beta: f32, sum_inverse: f64) {
        let mut sum_direction = 0.0_f64;
        for i in 0..pressure_mpa.len() {
            self.direction[i] = if pressure_mpa[i] > 0.0 {
                let t = self.residual[i] * self.inverse[i] + beta * self.direction[i];
                sum_direction += f64::from(t);
                t
            } else {
                0.0
            };
        }
        let shift = (sum_direction / sum_inverse) as f32;
        for i in 0..pressure_mpa.len() {
            if pressure_mpa[i] > 0.0 {
                self.direction[i] -= shift * self.inverse[i];
            }
        }
    }

    /// The step length along the direction whose displacement is `response`.
    fn step_length(&self) -> f32 {
        let (mut numerator, mut denominator) = (0.0_f64, 0.0_f64);
        for i in 0..self.direction.len() {
            let t = self.direction[i];
            numerator += f64::from(self.residual[i] * t);
            denominator += f64::from(t * (self.response[i] + self.slope[i] * t));
        }
        if denominator > 0.0 {
            (numerator / denominator) as f32
        } else {
            1.0
        }
    }
}

impl Problem<'_> {
    /// Computes the displacement under a pressure.
    fn displace(&self, convolver: &mut Convolver, pressure_mpa: &[f32], displacement: &mut [f32]) {
        convolver.convolve(self.spectrum, pressure_mpa, displacement);
        if let Some(block) = &self.block {
            block.displace(convolver, pressure_mpa, displacement);
        }
    }
}

/// Scales the pressure to carry the force. Without any, loads the cell with the least gap.
fn start(problem: &Problem, total: f64, pressure_mpa: &mut [f32]) {
    let sum: f64 = pressure_mpa.iter().map(|&p| f64::from(p)).sum();
    if sum > 0.0 {
        let scale = (total / sum) as f32;
        pressure_mpa.iter_mut().for_each(|p| *p *= scale);
        return;
    }
    pressure_mpa.fill(0.0);
    let lowest = (0..pressure_mpa.len())
        .min_by(|&i, &j| problem.gap_mm[i].total_cmp(&problem.gap_mm[j]))
        .expect("a window has cells");
    pressure_mpa[lowest] = total as f32;
}

fn contact_radius(pressure_mpa: &[f32], cell_area: f64) -> f64 {
    let count = pressure_mpa.iter().filter(|&&p| p > 0.0).count();
    (count as f64 * cell_area / std::f64::consts::PI).sqrt()
}

impl Local<'_> {
    /// Displacement (mm) at cell `i`, and a slope (mm/MPa) that is safe for a step.
    pub(super) fn at(&self, i: usize, pressure_mpa: f32, radius_mm: f64) -> (f32, f32) {
        match self.law {
            Law::Solid | Law::Layered { .. } => (0.0, 0.0),
            Law::Foam {
                exponent,
                plateau,
                strain,
            } => {
                let history = self.history_mpa.get(i).copied().unwrap_or(0.0);
                let effective = self.factor as f32 * pressure_mpa + history;
                if effective <= 0.0 {
                    return (0.0, 0.0);
                }
                let reach = (self.height_mm.min(0.9 * radius_mm) * strain) as f32;
                let plateau_mpa = (plateau * self.young_mpa) as f32;
                let z = (effective / plateau_mpa).powf(exponent as f32);
                let w = reach * z / (1.0 + z);
                // dw/de = m w / (e (1 + z)). Where the law flattens, its slope falls below the
                // secant, and steps taken with the slope would overshoot without end.
                let secant = w / effective;
                let slope = secant * (exponent as f32 / (1.0 + z)).max(1.1);
                (w, slope * self.factor as f32)
            }
            Law::Plastic { hardness } => {
                let hardness_mpa = (hardness * self.young_mpa) as f32;
                let ratio = pressure_mpa / hardness_mpa;
                let rate = (0.5 * radius_mm * self.time_s) as f32;
                let cubed = ratio * ratio * ratio;
                (rate * cubed * ratio, 4.0 * rate * cubed / hardness_mpa)
            }
        }
    }
}

#[cfg(test)]
mod tests;
