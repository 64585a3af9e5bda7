//! Frictionless normal contact under a prescribed force.
//!
//! In: the undeformed gap h, the spectrum of the elastic influence K, the force F, a local law w.
//! Out: the pressure p and the rigid approach `d` such that
//! `gap = h + K p + w(p) - d >= 0`, `p >= 0`, `p gap = 0`, `sum(p) dA = F`.
//! The solver knows neither the pressed object nor the time.
//!
//! The method is the constrained conjugate gradients of Polonsky and Keer (1999), with the local
//! law's slope as preconditioner and in the step length. `w` grows with `p`, so the problem stays
//! convex and the nonlinear gradient replaces a Newton loop around linear solves.

use super::fourier::Convolver;

/// A displacement that depends on the cell's own pressure only.
#[derive(Debug, Clone, Copy)]
pub(super) enum Local<'a> {
    /// Purely elastic.
    None,
    /// Foam plateau: `w = L e_D z / (1 + z)`, `z = (e / s_p)^m`, with the effective pressure
    /// `e = factor p + history` (creep) and `L = min(height, 0.9 a)`.
    Foam {
        /// s_p, the plateau stress, MPa.
        plateau_mpa: f64,
        /// m, the exponent.
        exponent: f64,
        /// e_D, the strain at which the cells have closed.
        strain: f64,
        /// Height of the object, mm.
        height_mm: f64,
        /// Ratio of effective pressure to pressure, from creep.
        factor: f64,
        /// The part of the effective pressure that earlier steps left; empty if there is none.
        history_mpa: &'a [f32],
    },
    /// One implicit step of Norton flow: `w = 0.5 a time (p / p_H)^4`.
    Flow {
        /// p_H, the hardness, MPa.
        hardness_mpa: f64,
        /// Length of the step, s.
        time_s: f64,
    },
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

/// A block under a part of the sensor: see [`super::block`].
#[derive(Debug, Clone, Copy)]
pub(super) struct Standing<'a> {
    /// Spectrum of the short waves' influence, mm per MPa.
    pub(super) spectrum: &'a [f32],
    /// The factor on a cell's pressure and on its displacement, `[width, width]`.
    pub(super) factor: &'a [f32],
    pub(super) column: Column,
    pub(super) axes: Axes,
}

/// A column between the ground and the sensor.
#[derive(Debug, Clone, Copy)]
pub(super) struct Column {
    /// Displacement in mm under an even pressure of 1 MPa.
    pub(super) compliance: f64,
    pub(super) area_mm2: f64,
    /// Second moments of the face along its sides, over its area.
    pub(super) moments_mm2: [f64; 2],
}

/// The places of cells in the axes of a face, mm from its middle.
#[derive(Debug, Clone, Copy)]
pub(super) struct Axes {
    /// The place of the first cell.
    pub(super) first: [f64; 2],
    /// From a cell to the next one in its row.
    pub(super) across: [f64; 2],
}

impl Axes {
    /// The place of a cell.
    pub(super) fn at(&self, row: usize, column: usize) -> [f64; 2] {
        let (row, column) = (row as f64, column as f64);
        let [cos, sin] = [self.across[0], -self.across[1]];
        [
            self.first[0] + column * cos + row * sin,
            self.first[1] + row * cos - column * sin,
        ]
    }
}

impl Standing<'_> {
    /// Adds the displacement under a pressure to `displacement`.
    pub(super) fn displace(
        &self,
        convolver: &mut Convolver,
        [loaded, sunk]: [&mut Vec<f32>; 2],
        pressure_mpa: &[f32],
        displacement: &mut [f32],
    ) {
        let width = convolver.width;
        loaded.clear();
        loaded.extend(pressure_mpa.iter().zip(self.factor).map(|(p, s)| p * s));
        sunk.resize(loaded.len(), 0.0);
        convolver.convolve(self.spectrum, loaded, sunk);
        // The force over the area, and the moments over the second moments.
        let mut means = [0.0; 3];
        for (k, &pressure) in pressure_mpa.iter().enumerate() {
            if pressure != 0.0 {
                let [u, v] = self.axes.at(k / width, k % width);
                let pressure = f64::from(pressure);
                means[0] += pressure;
                means[1] += pressure * u;
                means[2] += pressure * v;
            }
        }
        let [cos, sin] = self.axes.across;
        let cell_mm2 = cos * cos + sin * sin;
        let unit = self.column.compliance * cell_mm2 / self.column.area_mm2;
        let even = unit * means[0];
        let [along_u, along_v] = [0, 1].map(|k| unit * means[1 + k] / self.column.moments_mm2[k]);
        for (k, displacement) in displacement.iter_mut().enumerate() {
            let factor = self.factor[k];
            if factor > 0.0 {
                let [u, v] = self.axes.at(k / width, k % width);
                *displacement += factor * sunk[k] + (even + along_u * u + along_v * v) as f32;
            }
        }
    }
}

impl Problem<'_> {
    /// Computes the displacement under a pressure.
    fn displace(
        &self,
        convolver: &mut Convolver,
        work: [&mut Vec<f32>; 2],
        pressure_mpa: &[f32],
        displacement: &mut [f32],
    ) {
        convolver.convolve(self.spectrum, pressure_mpa, displacement);
        if let Some(block) = &self.block {
            block.displace(convolver, work, pressure_mpa, displacement);
        }
    }
}

/// The solver's results besides the pressure.
#[derive(Debug, Clone, Copy)]
pub(super) struct Contact {
    /// d, the rigid approach, mm.
    pub(super) approach_mm: f64,
    /// a = sqrt(A / pi) of the contact area A, mm.
    pub(super) radius_mm: f64,
    /// Iterations used.
    pub(super) iterations: u32,
    /// Whether the tolerance was met.
    pub(super) converged: bool,
}

/// The solver stops when the pressure-weighted mean of |gap| is below this part of the
/// pressure-weighted mean compression. At 1e-3, areas and forces have settled far below a taxel's
/// noise (1.5 %).
pub(super) const TOLERANCE: f64 = 1e-3;
const MAX_ITERATIONS: u32 = 250;

/// The solver's work fields, kept between calls so that a solve allocates nothing.
#[derive(Debug, Default)]
pub(super) struct Fields {
    displacement: Vec<f32>,
    residual: Vec<f32>,
    previous: Vec<f32>,
    direction: Vec<f32>,
    response: Vec<f32>,
    slope: Vec<f32>,
    inverse: Vec<f32>,
    /// Work fields of a block.
    pub(super) work: [Vec<f32>; 2],
}

impl Fields {
    fn resize(&mut self, cells: usize) {
        for field in [
            &mut self.displacement,
            &mut self.residual,
            &mut self.previous,
            &mut self.direction,
            &mut self.response,
            &mut self.slope,
            &mut self.inverse,
        ] {
            field.clear();
            field.resize(cells, 0.0);
        }
    }
}

/// Solves `problem` from the guess in `pressure_mpa`, which may be any non-negative field, and
/// leaves the solution there.
pub(super) fn solve(
    convolver: &mut Convolver,
    fields: &mut Fields,
    problem: &Problem,
    pressure_mpa: &mut [f32],
) -> Contact {
    let area = problem.cell_mm * problem.cell_mm;
    let total = problem.force_n / area;
    fields.resize(pressure_mpa.len());
    start(problem, total, pressure_mpa);
    // The preconditioner uses the kernel's value at a wavelength of 16 cells.
    let elastic = {
        let padded = 2 * convolver.width;
        let block = problem
            .block
            .map_or(0.0, |block| block.spectrum[padded / 16]);
        (problem.spectrum[padded / 16] + block) * (padded * padded) as f32
    };
    let mut radius_mm = contact_radius(pressure_mpa, area);
    let mut restart = true;
    let mut is_displacement_known = false;
    let mut rz_before = 1.0;
    let mut contact = Contact {
        approach_mm: 0.0,
        radius_mm,
        iterations: 0,
        converged: false,
    };
    while contact.iterations < MAX_ITERATIONS {
        contact.iterations += 1;
        if !is_displacement_known {
            let (work, out) = (&mut fields.work, &mut fields.displacement);
            problem.displace(convolver, work.each_mut(), pressure_mpa, out);
        }
        // Late in the solve, single cells at the rim switch on and off. The radius must not follow
        // them.
        if contact.iterations < 30 {
            radius_mm = contact_radius(pressure_mpa, area);
        }
        let balance = fields.balance(problem, pressure_mpa, radius_mm, elastic);
        contact.approach_mm = balance.approach_mm;
        let misfit = fields.misfit(problem, pressure_mpa, balance.approach_mm as f32);
        let compression = (misfit.work / total).max(1e-9);
        let slack = (problem.tolerance * compression) as f32;
        if misfit.error <= problem.tolerance * misfit.work.max(1e-12)
            && misfit.penetration < 10.0 * slack
        {
            contact.converged = true;
            break;
        }
        // The factor of Polak and Ribiere, never negative.
        let beta = if restart {
            0.0
        } else {
            ((misfit.rz - misfit.cross) / rz_before).max(0.0)
        } as f32;
        rz_before = misfit.rz.max(1e-30);
        fields.turn(pressure_mpa, beta, balance.sum_inverse);
        let Fields {
            work,
            direction,
            response,
            ..
        } = fields;
        problem.displace(convolver, work.each_mut(), direction, response);
        let step = fields.step_length();
        let change = fields.advance(pressure_mpa, step, slack);
        restart = change.loaded;
        is_displacement_known =
            !(change.clipped || change.loaded || contact.iterations.is_multiple_of(25));
        if is_displacement_known {
            for (u, &response) in fields.displacement.iter_mut().zip(&fields.response) {
                *u -= step * response;
            }
        } else if change.sum_mpa > 0.0 {
            let scale = (total / change.sum_mpa) as f32;
            pressure_mpa.iter_mut().for_each(|p| *p *= scale);
        } else {
            pressure_mpa.fill(0.0);
            start(problem, total, pressure_mpa);
        }
    }
    contact.radius_mm = radius_mm;
    contact
}

/// The approach at which the loaded cells balance, and the sum of the cells' inverse slopes.
struct Balance {
    approach_mm: f64,
    sum_inverse: f64,
}

/// How far a pressure is from the solution.
struct Misfit {
    /// Sum over the loaded cells of pressure times |gap|.
    error: f64,
    /// Sum over the loaded cells of pressure times compression.
    work: f64,
    /// Sum of residual times preconditioned residual. `cross` uses the residual of the step before.
    rz: f64,
    cross: f64,
    /// Penetration of the deepest unloaded cell, mm.
    penetration: f32,
}

/// The changes of a step.
struct Change {
    /// Whether a cell would have been in tension.
    clipped: bool,
    /// Whether a cell without load would have penetrated.
    loaded: bool,
    sum_mpa: f64,
}

#[expect(
    clippy::needless_range_loop,
    reason = "one cell of several fields at a time"
)]
impl Fields {
    /// Computes residual, slope and preconditioner of every cell. The approach is the multiplier of
    /// the force constraint.
    fn balance(
        &mut self,
        problem: &Problem,
        pressure_mpa: &[f32],
        radius_mm: f64,
        elastic: f32,
    ) -> Balance {
        let (mut sum_inverse, mut sum_residual) = (0.0_f64, 0.0_f64);
        for i in 0..pressure_mpa.len() {
            let (w, slope) = problem.local.at(i, pressure_mpa[i], radius_mm);
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
        Balance {
            approach_mm: sum_residual / sum_inverse,
            sum_inverse,
        }
    }

    /// Subtracts the approach from the residuals, and measures them.
    fn misfit(&mut self, problem: &Problem, pressure_mpa: &[f32], approach_mm: f32) -> Misfit {
        let (mut error, mut work, mut rz, mut cross) = (0.0_f64, 0.0_f64, 0.0_f64, 0.0_f64);
        let mut penetration = 0.0_f32;
        for i in 0..pressure_mpa.len() {
            let r = self.residual[i] - approach_mm;
            let p = pressure_mpa[i];
            if p > 0.0 {
                let z = r * self.inverse[i];
                error += f64::from(p * r.abs());
                work += f64::from(p * (self.residual[i] - problem.gap_mm[i]));
                rz += f64::from(r * z);
                cross += f64::from(self.previous[i] * z);
                self.previous[i] = r;
            } else {
                penetration = penetration.max(-r);
                self.previous[i] = 0.0;
            }
            self.residual[i] = r;
        }
        Misfit {
            error,
            work,
            rz,
            cross,
            penetration,
        }
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

    /// Takes the step, sets tension to 0, and loads cells that would penetrate by more than
    /// `slack`.
    fn advance(&self, pressure_mpa: &mut [f32], step: f32, slack: f32) -> Change {
        let mut change = Change {
            clipped: false,
            loaded: false,
            sum_mpa: 0.0,
        };
        for i in 0..pressure_mpa.len() {
            let p = pressure_mpa[i];
            if p > 0.0 {
                let next = p - step * self.direction[i];
                change.clipped |= next < 0.0;
                pressure_mpa[i] = next.max(0.0);
            } else if self.residual[i] < -slack {
                pressure_mpa[i] = -step.max(0.0) * self.residual[i] * self.inverse[i];
                change.loaded |= pressure_mpa[i] > 0.0;
            }
            change.sum_mpa += f64::from(pressure_mpa[i]);
        }
        change
    }
}

/// Scales the guess to carry the force. Without a guess, loads the cell with the least gap.
fn start(problem: &Problem, total: f64, pressure_mpa: &mut [f32]) {
    let sum: f64 = pressure_mpa.iter().map(|&p| f64::from(p)).sum();
    if sum > 0.0 {
        let scale = (total / sum) as f32;
        pressure_mpa.iter_mut().for_each(|p| *p *= scale);
        return;
    }
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
    /// Displacement in mm of a cell without history.
    pub(super) fn displacement_mm(&self, pressure_mpa: f32, radius_mm: f64) -> f32 {
        self.at(usize::MAX, pressure_mpa, radius_mm).0
    }

    /// Displacement (mm) at cell `i`, and a slope (mm/MPa) that is safe for a step.
    fn at(&self, i: usize, pressure_mpa: f32, radius_mm: f64) -> (f32, f32) {
        match *self {
            Local::None => (0.0, 0.0),
            Local::Foam {
                plateau_mpa,
                exponent,
                strain,
                height_mm,
                factor,
                history_mpa,
            } => {
                let history = history_mpa.get(i).copied().unwrap_or(0.0);
                let effective = factor as f32 * pressure_mpa + history;
                if effective <= 0.0 {
                    return (0.0, 0.0);
                }
                let reach = (height_mm.min(0.9 * radius_mm) * strain) as f32;
                let z = (effective / plateau_mpa as f32).powf(exponent as f32);
                let w = reach * z / (1.0 + z);
                // dw/de = m w / (e (1 + z)). Where the law flattens, its slope falls below the
                // secant, and steps taken with the slope would overshoot without end.
                let secant = w / effective;
                let slope = secant * (exponent as f32 / (1.0 + z)).max(1.1);
                (w, slope * factor as f32)
            }
            Local::Flow {
                hardness_mpa,
                time_s,
            } => {
                let ratio = pressure_mpa / hardness_mpa as f32;
                let rate = (0.5 * radius_mm * time_s) as f32;
                let cubed = ratio * ratio * ratio;
                (
                    rate * cubed * ratio,
                    4.0 * rate * cubed / hardness_mpa as f32,
                )
            }
        }
    }
}

#[cfg(test)]
mod tests;
