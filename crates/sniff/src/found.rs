//! What a search ends with: ranked layouts, or the reason why there is none.

use hardnessd_core::frame::{Array, MOST_SIDE};
use hardnessd_core::wire::{Cell, Order};
use hardnessd_core::wording::name;

use crate::layout::Proposal;
use crate::model::{self, Score};
use crate::pictures::Pictures;

/// What the user knows of the array.
#[derive(Debug, Clone, Copy, Default)]
pub struct Known {
    /// Its rows.
    pub rows: Option<usize>,
    /// Its columns.
    pub cols: Option<usize>,
    /// The type of its cells.
    pub cell: Option<Cell>,
}

/// The likeliest layouts.
#[derive(Debug, Clone)]
pub struct Found {
    /// The likeliest.
    pub best: Ranked,
    /// The next with another array or other cells, if there is one.
    pub next: Option<Ranked>,
    /// Why the best is not sure, in words.
    pub doubt: Option<String>,
}

/// A layout with the picture that it makes.
#[derive(Debug, Clone)]
pub struct Ranked {
    /// The array.
    pub array: Array,
    /// The order of its cells: row by row, or with each second row the other way.
    pub order: Order,
    /// `None` for text.
    pub cell: Option<Cell>,
    /// The strongest press, as the array would have it.
    pub picture: Vec<f32>,
    /// The settings.
    pub proposal: Proposal,
    pub(crate) score: Score,
    /// The doubt that it is an array, or about which bytes are its cells.
    pub(crate) own_doubt: Option<String>,
}

/// The reason why no layout was found.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Failure {
    /// In so many bytes.
    #[error("nothing recurs in {0} bytes: try another --baud, or listen for longer")]
    NotPeriodic(usize),
    /// Frames of so many bytes.
    #[error(
        "{0} bytes recur, but they hold no array with a mark: press the sensor at several places meanwhile, try \
         another --baud, and say --rows, --cols and --cell if you know them"
    )]
    NoArray(usize),
    /// Frames of so many bytes.
    #[error(
        "frames of {0} bytes, but nothing presses the sensor: sniff again, and press it at several places"
    )]
    NoPress(usize),
    /// The array is larger than any that the daemon reads.
    #[error("found an array of about {0} taxels, expected at most 64x64")]
    TooLarge(Array),
    /// No other failure is looked for beside this one.
    #[error("{0}")]
    Sure(String),
}

impl Failure {
    /// How much it says.
    pub(crate) fn rank(&self) -> u8 {
        match self {
            Self::NotPeriodic(_) => 0,
            Self::NoArray(_) => 1,
            Self::NoPress(_) => 2,
            Self::TooLarge(_) => 3,
            Self::Sure(_) => 4,
        }
    }

    pub(crate) fn sure(words: impl Into<String>) -> Self {
        Self::Sure(words.into())
    }
}

/// The fewest taxels that show an array.
const FEWEST: usize = 12;

/// That the order of an array is open.
const TO_AND_FRO: &str = "each second row may run the other way, which is `order = \"serpentine\"`";

/// The number of frames that are needed.
pub(crate) const LEAST_FRAMES: usize = 8;

impl Known {
    pub(crate) fn is_complete(&self) -> bool {
        self.rows.is_some() && self.cols.is_some() && self.cell.is_some()
    }

    /// The arrays of so many cells, as far as the user and the daemon allow them. Larger ones up to
    /// `longest_side` are among them, so that an array that is too large is found.
    pub(crate) fn arrays(&self, cells: usize, longest_side: usize) -> impl Iterator<Item = Array> {
        let Known { rows, cols, .. } = *self;
        let sides = (1..=longest_side.min(cells)).filter(move |&cols| cells.is_multiple_of(cols));
        let arrays = sides.map(move |cols| Array {
            rows: cells / cols,
            cols,
        });
        arrays.filter(move |array| {
            // One column and one row look the same.
            let is_strip = array.cols == 1 && array.rows > 1;
            !is_strip
                && array.rows <= longest_side
                && rows.is_none_or(|rows| rows == array.rows)
                && cols.is_none_or(|cols| cols == array.cols)
        })
    }
}

impl Found {
    /// The likeliest of some layouts, and the next. If the array `is_given`, pictures decide nothing.
    pub(crate) fn among(mut ranked: Vec<Ranked>, is_given: bool) -> Option<Self> {
        ranked.sort_by(|a, b| a.score.bits().total_cmp(&b.score.bits()));
        let mut ranked = ranked.into_iter();
        let (mut best, mut next) = (ranked.next()?, ranked.next());
        // Where the array is given, the next one differs in its order alone. The usual one is proposed.
        if is_given
            && let Some(next) = &mut next
            && best.may_be(next)
        {
            if best.order == Order::Serpentine {
                std::mem::swap(&mut best, next);
            }
            best.proposal.remarks.push(TO_AND_FRO.to_owned());
        }
        let doubt = best.doubt(next.as_ref(), is_given);
        Some(Self { best, next, doubt })
    }

    /// A layout whose array the bytes or the preset say.
    pub(crate) fn stated(array: Array, cell: Option<Cell>, proposal: Proposal) -> Self {
        let best = Ranked {
            array,
            order: Order::RowMajor,
            cell,
            picture: Vec::new(),
            proposal,
            score: Score::default(),
            own_doubt: None,
        };
        let doubt = best.doubt(None, true);
        Self {
            best,
            next: None,
            doubt,
        }
    }

    /// By how many bits the best is likelier than the next.
    pub fn lead_bits(&self) -> Option<f64> {
        Some(self.next.as_ref()?.score.bits() - self.best.score.bits())
    }
}

impl Ranked {
    /// The options that choose this array.
    pub fn options(&self) -> String {
        let array = format!("--rows {} --cols {}", self.array.rows, self.array.cols);
        match self.cell {
            Some(cell) => format!("{array} --cell {}", name(&cell)),
            None => array,
        }
    }

    /// Whether it is what the user knows.
    pub(crate) fn is_as(&self, known: Known) -> bool {
        known.rows.is_none_or(|rows| rows == self.array.rows)
            && known.cols.is_none_or(|cols| cols == self.array.cols)
            && known.cell.is_none_or(|cell| Some(cell) == self.cell)
    }

    /// Whether it may be `other` as well.
    fn may_be(&self, other: &Self) -> bool {
        !self.score.is_surely_less(&other.score)
    }

    fn doubt(&self, next: Option<&Self>, is_given: bool) -> Option<String> {
        let Proposal {
            frames,
            frames_damaged,
            share,
            ..
        } = self.proposal;
        if !self.proposal.explains_nearly_all() {
            return Some(format!(
                "{frames} whole frames and {frames_damaged} damaged ones, with {:.0} % of the bytes: lengths vary, \
                 as with escapes or packets of several kinds, or --baud is wrong",
                100.0 * share
            ));
        }
        if is_given {
            return self.own_doubt.clone();
        }
        let other = next.filter(|next| self.may_be(next));
        if other.is_some_and(|other| other.array == self.array && other.cell == self.cell) {
            return Some(format!(
                "{TO_AND_FRO}: press with one finger at several places and at the edges"
            ));
        }
        let (taxels, options) = (self.array.taxels(), self.options());
        // A row of an array looks like an array of one row.
        let is_strip = self.array.rows == 1;
        if is_strip || other.is_some() {
            return Some(format!(
                "choose with `{options}` or as the pictures say, or press with one finger at several places and at \
                 the edges"
            ));
        }
        if taxels < FEWEST {
            return Some(format!(
                "{taxels} numbers are too few to tell an array from others: say `{options}` if it is one"
            ));
        }
        self.own_doubt.clone()
    }
}

/// The doubt that cells are an array, if it has these bits, and others if no cell has to do with those around it.
pub(crate) fn doubt_of_cells(cells: usize, score: &Score, alone: &Score) -> Option<String> {
    (!score.is_surely_less(alone)).then(|| {
        format!(
            "{cells} cells beside each other do not act as neighbours do: press with one finger at several places, \
             or this is no array"
        )
    })
}

/// The doubt that these are the rows of the array: others, that make another array or none, may be as likely.
pub(crate) fn doubt_of_rows(pictures: &Pictures, array: Array, channels: usize) -> Option<String> {
    let say = "press with one finger at more places and at the edges, or say --rows and --cols";
    if let Some(count) = model::stack(pictures, array, channels) {
        let rows = array.rows / count;
        return Some(format!(
            "{count} arrays of {rows} rows, one behind the other, are as likely as {array} taxels: {say}"
        ));
    }
    let other = model::other_row(pictures, array.cols, channels)?;
    Some(format!(
        "rows of {other} taxels are about as likely as rows of {}: {say}",
        array.cols
    ))
}

/// The bits that say which array it is: a long and narrow one is rarer.
pub(crate) fn name_bits(array: Array) -> f64 {
    0.6 * (array.rows as f64 / array.cols as f64).log2().powi(2)
}

/// Whether the array is larger than any that the daemon reads.
pub(crate) fn is_too_large(array: Array) -> bool {
    array.rows.max(array.cols) > MOST_SIDE
}
