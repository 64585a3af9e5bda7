//! Judges which shape makes a picture of the cells.
//!
//! In: what presses did to the cells, in the order of the wire. Out: a score for a number of
//! columns. A press is smooth from taxel to taxel, also from row to row. With a wrong number of
//! columns it is striped, or it goes on from the end of a row at the beginning of the next.

/// What some presses did to the cells: for each press and several of its frames, the change of each
/// cell.
#[derive(Debug, Clone, Default)]
pub(super) struct Pictures(pub(super) Vec<Vec<Vec<f32>>>);

/// How likely an array is, by each press. One more is about a factor of e.
#[derive(Debug, Clone, Default)]
pub(super) struct Score {
    of_presses: Vec<f64>,
    /// What is known beside the pictures.
    pub(super) prior: f64,
}

/// The least lead of an array over another that is sure: by all presses, and without the press that
/// is most in favour of it.
const LEAST_LEAD: f64 = 0.7;
const LEAST_LEAD_OF_OTHERS: f64 = 0.35;
/// The least lead if there is only one press.
const LEAST_LEAD_OF_ONE: f64 = 1.4;

impl Score {
    pub(super) fn total(&self) -> f64 {
        self.prior + self.of_presses.iter().sum::<f64>() / self.of_presses.len().max(1) as f64
    }

    /// Whether presses at several places agree that this array is likelier than `other`.
    pub(super) fn is_surely_more(&self, other: &Self) -> bool {
        let lead = self.total() - other.total();
        let priors = self.prior - other.prior;
        let presses = self.of_presses.iter().zip(&other.of_presses);
        let leads: Vec<f64> = presses
            .map(|(ours, theirs)| priors + ours - theirs)
            .collect();
        let most = leads.iter().copied().fold(f64::MIN, f64::max);
        match leads.len() {
            0 => false,
            1 => lead >= LEAST_LEAD_OF_ONE,
            presses => {
                let others = (leads.iter().sum::<f64>() - most) / (presses - 1) as f64;
                lead >= LEAST_LEAD && others >= LEAST_LEAD_OF_OTHERS
            }
        }
    }
}

/// The roughness of neighbours that nothing is known of, as in an array of one row.
const UNKNOWN_ROUGHNESS: f64 = 0.6;
/// Roughness below this is not distinguished.
const LEAST_ROUGHNESS: f64 = 0.004;
/// The logarithm of how much rougher the step around to the next row is, at least, than the step to
/// the next column.
const BREAK: f64 = 0.6;
const BREAK_SLOPE: f64 = 6.0;
/// The most that such steps add to a score, and take from it.
const MOST_BREAK: (f64, f64) = (1.0, 4.0);
/// What an array of one row costs: most have several.
const STRIP: f64 = 1.0;

/// Differences of some pairs of cells, against their values.
#[derive(Default)]
struct Roughness {
    differences: f64,
    values: f64,
}

impl Roughness {
    fn take(&mut self, a: f32, b: f32) {
        self.differences += f64::from((a - b) * (a - b));
        self.values += f64::from(a * a + b * b);
    }

    /// 0 where neighbours are equal, about 1 where they have nothing to do with each other.
    fn logarithm(&self, or: f64) -> f64 {
        if self.values > 0.0 {
            (self.differences / self.values).max(LEAST_ROUGHNESS).ln()
        } else {
            or.ln()
        }
    }
}

impl Pictures {
    /// How likely `cells` cells from `first` on are rows of `cols` cells.
    pub(super) fn score(&self, first: usize, cells: usize, cols: usize, prior: f64) -> Score {
        let of_press = |pictures: &Vec<Vec<f32>>| {
            let scores = pictures
                .iter()
                .map(|picture| score(&picture[first..first + cells], cols));
            scores.sum::<f64>() / pictures.len() as f64
        };
        Score {
            of_presses: self.0.iter().map(of_press).collect(),
            prior,
        }
    }

    /// The picture with the strongest press.
    pub(super) fn strongest(&self) -> &[f32] {
        let energy = |picture: &&Vec<f32>| {
            picture
                .iter()
                .map(|value| f64::from(value.abs()))
                .sum::<f64>()
        };
        let strongest = self
            .0
            .iter()
            .flatten()
            .max_by(|a, b| energy(a).total_cmp(&energy(b)));
        strongest.map_or(&[], Vec::as_slice)
    }
}

fn score(cells: &[f32], cols: usize) -> f64 {
    let (mut along, mut down, mut around) = (
        Roughness::default(),
        Roughness::default(),
        Roughness::default(),
    );
    for (at, &value) in cells.iter().enumerate() {
        if let Some(&next) = cells.get(at + 1) {
            let is_end = (at + 1).is_multiple_of(cols);
            if is_end { &mut around } else { &mut along }.take(value, next);
        }
        if let Some(&below) = cells.get(at + cols) {
            down.take(value, below);
        }
    }
    let smooth_along = along.logarithm(UNKNOWN_ROUGHNESS);
    // The same steps for any number of columns.
    let smooth_wire = Roughness {
        differences: along.differences + around.differences,
        values: along.values + around.values,
    }
    .logarithm(UNKNOWN_ROUGHNESS);
    let smooth_down = if cells.len() > cols {
        down.logarithm(UNKNOWN_ROUGHNESS)
    } else {
        UNKNOWN_ROUGHNESS.ln() + STRIP
    };
    // The share of the steps around the end of a row that a press reaches.
    let expected = along.values / (cols as f64 - 1.0).max(1.0);
    let reached = if expected > 0.0 {
        (around.values / expected).min(1.0)
    } else {
        0.0
    };
    let breaks = around.logarithm(1.0) - smooth_along;
    let broken = (BREAK_SLOPE * (breaks - BREAK)).clamp(-MOST_BREAK.1, MOST_BREAK.0);
    // Where neighbours are rough anyhow, a break shows nothing.
    reached * (-smooth_wire).clamp(0.0, 1.0) * broken - smooth_wire - smooth_down
}

/// The most characters of a drawing, down and across.
const DRAWN: (usize, usize) = (16, 32);

/// A small picture for a terminal, a line for each row. Large arrays are drawn coarser.
pub(super) fn draw(cells: &[f32], cols: usize) -> Vec<String> {
    let rows = cells.len() / cols;
    let step = rows.div_ceil(DRAWN.0).max(cols.div_ceil(DRAWN.1)).max(1);
    let most = cells
        .iter()
        .fold(f32::MIN_POSITIVE, |most, value| most.max(value.abs()));
    let shade = |row: usize, col: usize| {
        let near = (row..rows.min(row + step)).flat_map(|row| {
            (col..cols.min(col + step)).map(move |col| cells[row * cols + col].abs())
        });
        let value = near.fold(0.0, f32::max);
        let shades = b" .:-=+*#%@";
        char::from(shades[((value / most * 9.0).round() as usize).min(9)])
    };
    (0..rows)
        .step_by(step)
        .map(|row| (0..cols).step_by(step).map(|col| shade(row, col)).collect())
        .collect()
}
