//! The taxels under the cells on which a press is solved, and the share of a cell's load that each
//! taxel feels.

use super::design::Design;
use crate::press::Window;
use crate::{CELL_MM, CELLS};
use hardnessd_core::frame::{Array, Pitch};

/// The film's taxels lie this deep, in depths, before what they feel of a load is left out. At this
/// distance from a point load, a twentieth of the load lies further away.
const REACH_DEPTHS: f64 = 2.5;
/// The most points along a taxel's active width and along a cell (midpoint rule), and how many there
/// are in a depth of the film. The stress of a deep film needs fewer.
const FINE: (usize, f64) = (12, 4.0);
const PARTS: (usize, f64) = (3, 3.0);

/// The taxels of an array in the middle of the cells.
#[derive(Debug, Clone)]
pub(crate) struct Grid {
    pub(crate) array: Array,
    pub(crate) pitch: Pitch,
    /// For each row of cells, and each column: the taxel that it lies in, which may be beyond the
    /// array, and its place in the taxel.
    places: Vec<(isize, usize)>,
    /// The number of places along a taxel.
    steps: usize,
    /// The number of taxels on each side that feel a load.
    reach: usize,
    /// For each place of a cell in a taxel, `[steps, steps]`, the shares of its load that the taxels
    /// around feel, `[span, span]`.
    shares: Vec<f32>,
}

impl Grid {
    /// The square grid of a design.
    ///
    /// Where the taxels' borders lie on the cells' borders, a cell has one of a few places in a
    /// taxel. In other grids its place is rounded to an eighth of a cell.
    pub(crate) fn new(design: &Design) -> Self {
        let pitch_mm = design.pitch_mm;
        let count = design.array.rows;
        let first_mm = 0.5 * (CELLS as f64 * CELL_MM - count as f64 * pitch_mm);
        let is_whole = |mm: f64| (mm / CELL_MM).fract() == 0.0;
        let steps = if is_whole(pitch_mm) && is_whole(first_mm) {
            pitch_mm / CELL_MM
        } else {
            (4.0 * pitch_mm / CELL_MM).ceil()
        } as usize;
        let place = |cell: usize| {
            let taxels = ((cell as f64 + 0.5) * CELL_MM - first_mm) / pitch_mm;
            let step = ((taxels - taxels.floor()) * steps as f64) as usize;
            (taxels.floor() as isize, step.min(steps - 1))
        };
        let reach = (REACH_DEPTHS * design.depth_mm / pitch_mm + 0.5).ceil() as usize;
        Self {
            array: design.array,
            pitch: Pitch::square(pitch_mm),
            places: (0..CELLS).map(place).collect(),
            steps,
            reach,
            shares: spreading(design, steps, reach),
        }
    }

    /// The taxel forces (N) from the pressure (MPa) on a window of cells. Force beyond the array's
    /// border is lost, as on a real sensor.
    pub(crate) fn taxel_forces(&self, pressure_mpa: &[f32], window: Window) -> Vec<f32> {
        let Array { rows, cols } = self.array;
        let span = 2 * self.reach + 1;
        let mut forces = vec![0.0_f32; self.array.taxels()];
        let area = (CELL_MM * CELL_MM) as f32;
        for (k, &pressure) in pressure_mpa.iter().enumerate() {
            if pressure == 0.0 {
                continue;
            }
            let (row, row_step) = self.places[window.corner.0 + k / window.width];
            let (column, column_step) = self.places[window.corner.1 + k % window.width];
            let cell = row_step * self.steps + column_step;
            let shares = &self.shares[cell * span * span..][..span * span];
            // The columns of the array that the shares lie on, and those of the shares.
            let first = column - self.reach as isize;
            let from = (-first).clamp(0, span as isize) as usize;
            let to = (cols as isize - first).clamp(from as isize, span as isize) as usize;
            let load = pressure * area;
            for (n, shares) in shares.chunks_exact(span).enumerate() {
                let row = row + n as isize - self.reach as isize;
                if !(0..rows as isize).contains(&row) || from == to {
                    continue;
                }
                let at = row as usize * cols + (first + from as isize) as usize;
                let taxels = forces[at..].iter_mut().zip(&shares[from..to]);
                taxels.for_each(|(force, &share)| *force += load * share);
            }
        }
        forces
    }
}

/// The shares of a load on each place of a taxel that the taxel and its neighbours feel.
///
/// Normal stress at depth z under a point load is `3 F z^3 / (2 pi (r^2 + z^2)^(5/2))`, whose
/// transform is `(1 + q z) exp(-q z)`. A taxel integrates its active square and is calibrated
/// under uniform pressure, so that over a taxel's places the shares add up to 1 on average.
fn spreading(design: &Design, steps: usize, reach: usize) -> Vec<f32> {
    let (pitch_mm, depth_mm) = (design.pitch_mm, design.depth_mm);
    let span = 2 * reach + 1;
    let points = |(most, in_depth): (usize, f64), width_mm: f64| {
        most.min((in_depth * width_mm / depth_mm).ceil() as usize)
    };
    let (fine, parts) = (points(FINE, design.active_mm), points(PARTS, CELL_MM));
    let mut shares = vec![0.0_f32; steps * steps * span * span];
    let mut sum = 0.0;
    let step_mm = pitch_mm / steps as f64;
    let along = |step: usize, part: usize| {
        let middle = (step as f64 + 0.5) * step_mm - 0.5 * pitch_mm;
        middle + ((part as f64 + 0.5) / parts as f64 - 0.5) * CELL_MM
    };
    let active = |taxel: usize, point: usize| {
        (taxel as f64 - reach as f64) * pitch_mm
            + ((point as f64 + 0.5) / fine as f64 - 0.5) * design.active_mm
    };
    for (k, share) in shares.iter_mut().enumerate() {
        let (cell, n) = (k / (span * span), k % (span * span));
        let mut value = 0.0;
        for part in 0..parts * parts {
            let y = along(cell / steps, part / parts);
            let x = along(cell % steps, part % parts);
            for point in 0..fine * fine {
                let dy = active(n / span, point / fine) - y;
                let dx = active(n % span, point % fine) - x;
                let square = dx * dx + dy * dy + depth_mm * depth_mm;
                value += depth_mm.powi(3) / (square * square * square.sqrt());
            }
        }
        *share = value as f32;
        sum += value;
    }
    let scale = ((steps * steps) as f64 / sum) as f32;
    shares.iter_mut().for_each(|share| *share *= scale);
    shares
}
