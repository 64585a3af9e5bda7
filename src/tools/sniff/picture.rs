//! Judges which shape makes a picture of the cells.
//!
//! In: what presses did to the cells, in the order of the wire. Out: a score for a number of
//! columns. A press is smooth from taxel to taxel, also from row to row. With a wrong number of
//! columns it is striped, or it goes on from the end of a row at the beginning of the next.

use hardnessd_core::wire::Cell;

/// What some presses did to the cells: for each press and several of its frames, the change of each
/// cell.
#[derive(Debug, Clone, Default)]
pub(super) struct Pictures(Vec<Vec<Vec<f32>>>);

/// The numbers of some frames in which something presses, by press, and of some in which nothing does.
#[derive(Debug, Clone)]
pub(super) struct Presses {
    presses: Vec<Vec<usize>>,
    rest: Vec<usize>,
}

/// The share of the strongest press at which a frame makes a picture.
const STRONG: f64 = 0.3;
/// The most presses, the most frames of a press that make pictures, and the most that make the rest.
const PRESSES: usize = 16;
const PICTURES: usize = 4;
const RESTS: usize = 15;

impl Presses {
    /// Finds the presses by how much each frame differs from rest. `None` if nothing presses in any.
    pub(super) fn of(activity: &[u32]) -> Option<Self> {
        let mut sorted = activity.to_vec();
        sorted.sort_unstable();
        let at = |share: usize| f64::from(sorted[(sorted.len() - 1) * share / 100]);
        let (least, quarter, most) = (at(0), at(25), at(98));
        let mean =
            activity.iter().map(|&value| f64::from(value)).sum::<f64>() / activity.len() as f64;
        let spread: f64 = activity
            .iter()
            .map(|&value| (f64::from(value) - mean).powi(2))
            .sum();
        let steps: f64 = activity
            .array_windows()
            .map(|&[a, b]| f64::from(a.abs_diff(b)).powi(2))
            .sum();
        // Noise differs from frame to frame as much as from its mean. A press lasts.
        if most <= least || (steps > spread && most - quarter < 4.0 * (quarter - least).max(1.0)) {
            return None;
        }
        let over = |share: f64| least + share * (most - least);
        let is_strong = |frame: &usize| f64::from(activity[*frame]) > over(STRONG);
        let strong: Vec<usize> = (0..activity.len()).filter(is_strong).collect();
        let presses: Vec<Vec<usize>> = strong
            .chunk_by(|a, b| a + 1 == *b)
            .filter(|press| press.len() > 1)
            .map(|press| some(press, PICTURES))
            .collect();
        let quiet = quarter.min(over(STRONG / 2.0));
        let rest: Vec<usize> = (0..activity.len())
            .filter(|&frame| f64::from(activity[frame]) <= quiet)
            .collect();
        Some(Self {
            presses: some(&presses, PRESSES),
            rest: some(&rest, RESTS),
        })
    }

    /// The frames of all presses.
    pub(super) fn frames(&self) -> impl Iterator<Item = usize> + '_ {
        self.presses.iter().flatten().copied()
    }
}

/// About `most` of `of`, from all over it.
pub(super) fn some<T: Clone>(of: &[T], most: usize) -> Vec<T> {
    of.iter()
        .cloned()
        .step_by(of.len().div_ceil(most).max(1))
        .collect()
}

/// The cells in some bytes.
pub(super) fn cells(bytes: &[u8], cell: Cell) -> impl Iterator<Item = u16> + '_ {
    bytes.chunks_exact(cell.bytes()).map(move |bytes| {
        let number = |join: fn([u8; 2]) -> u16| join([bytes[0], bytes[1]]);
        match cell {
            Cell::U8 => bytes[0].into(),
            Cell::U16le => number(u16::from_le_bytes),
            Cell::U16be => number(u16::from_be_bytes),
        }
    })
}

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

/// Of each cell the value that one in `part` of the frames does not exceed.
pub(super) fn of_each_cell(frames: &[Vec<f32>], part: usize) -> Vec<f32> {
    let cells = frames.first().map_or(0, Vec::len);
    let value = |cell: usize| {
        let mut values: Vec<f32> = frames.iter().map(|frame| frame[cell]).collect();
        values.sort_by(f32::total_cmp);
        values[values.len() / part]
    };
    (0..cells).map(value).collect()
}

impl Pictures {
    /// The pictures of presses, if `frame` returns the cells of a frame.
    pub(super) fn of(presses: &Presses, frame: impl Fn(usize) -> Vec<f32>) -> Self {
        let rests: Vec<Vec<f32>> = presses.rest.iter().map(|&index| frame(index)).collect();
        let rest = of_each_cell(&rests, 2);
        let change = |&index: &usize| -> Vec<f32> {
            let values = frame(index);
            values
                .iter()
                .zip(&rest)
                .map(|(value, rest)| value - rest)
                .collect()
        };
        let of_press = |press: &Vec<usize>| press.iter().map(change).collect();
        Self(presses.presses.iter().map(of_press).collect())
    }

    /// How likely the cells are rows of `cols` cells.
    pub(super) fn score(&self, cols: usize, prior: f64) -> Score {
        let of_press = |pictures: &Vec<Vec<f32>>| {
            let scores = pictures.iter().map(|picture| score(picture, cols));
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
    let smooth_down = down.logarithm(UNKNOWN_ROUGHNESS);
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
