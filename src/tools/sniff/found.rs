//! What a search ends with: a layout, two arrays to choose from, or the reason why there is neither.

use hardnessd_core::frame::{Array, MOST_SIDE};
use hardnessd_core::wire::Cell;

use super::picture::Score;
use super::proposal::Proposal;

/// What the user knows of the array.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Known {
    pub(super) rows: Option<usize>,
    pub(super) cols: Option<usize>,
    pub(super) cell: Option<Cell>,
}

/// A layout was found.
#[derive(Debug, Clone)]
pub(super) struct Found {
    pub(super) best: Shown,
    /// The next array, if there is one.
    pub(super) next: Option<Shown>,
    /// Whether the bytes or the user say the array.
    pub(super) is_given: bool,
}

/// A layout with the picture that it makes.
#[derive(Debug, Clone)]
pub(super) struct Shown {
    pub(super) array: Array,
    /// `None` for frames whose cells are no bytes of a fixed number.
    pub(super) cell: Option<Cell>,
    pub(super) score: Score,
    pub(super) picture: Vec<f32>,
    pub(super) proposal: Proposal,
}

/// The reason why no layout was found.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Failure {
    /// There are no bytes.
    #[error(
        "nothing arrives: check the wiring, or the sensor sends only on a request (`request` and `start` of [sensor.frame])"
    )]
    Nothing,
    /// Lines of text, but not as many numbers on each.
    #[error("text, but no array: {0}")]
    Text(String),
    /// Frames of one length without an array.
    #[error(
        "{0} bytes recur, but they hold no array with a mark: press the sensor at several places meanwhile, and say \
         --rows, --cols and --cell if you know them"
    )]
    NoArray(usize),
    /// Frames of one length, but nothing presses.
    #[error(
        "frames of {0} bytes, but nothing presses the sensor: sniff again, and press it at several places"
    )]
    NoPress(usize),
    /// Each frame comes in several packets.
    #[error(
        "{bytes} bytes recur, with a number from {first} to {last} that begins again: a frame comes in {packets} \
         packets, so write its [sensor.frame.packets]"
    )]
    Packets {
        /// The bytes of a packet.
        bytes: usize,
        /// The number of the first packet.
        first: u8,
        /// The number of the last packet.
        last: u8,
        /// The packets of a frame.
        packets: usize,
    },
    /// The array is larger than any that the daemon reads.
    #[error("found an array of about {rows}x{cols} taxels, expected at most 64x64", rows = .0.rows, cols = .0.cols)]
    TooLarge(Array),
    /// Nothing recurs.
    #[error("nothing recurs in {0} bytes: try another --baud, or listen for longer")]
    NotPeriodic(usize),
}

/// The number of frames that are needed.
pub(super) const LEAST_FRAMES: usize = 8;
/// The least score of an array that is sure.
const SMOOTH_SCORE: f64 = 1.0;
/// What it costs that an array is e times as long as it is wide, or as wide as it is long.
const ELONGATED: f64 = 0.3;

impl Known {
    pub(super) fn is_complete(&self) -> bool {
        self.rows.is_some() && self.cols.is_some() && self.cell.is_some()
    }

    /// The arrays of so many cells, as far as the user and the daemon allow them. Larger ones up to
    /// `longest_side` are among them, so that an array that is too large is found.
    pub(super) fn arrays(&self, cells: usize, longest_side: usize) -> impl Iterator<Item = Array> {
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
    /// The likeliest of some layouts, and the next.
    pub(super) fn among(mut shown: Vec<Shown>, is_given: bool) -> Option<Self> {
        shown.sort_by(|a, b| b.score.total().total_cmp(&a.score.total()));
        let mut shown = shown.into_iter();
        Some(Self {
            best: shown.next()?,
            next: shown.next(),
            is_given,
        })
    }

    /// A layout whose array the bytes say.
    pub(super) fn stated(array: Array, cell: Option<Cell>, proposal: Proposal) -> Self {
        let best = Shown {
            array,
            cell,
            score: Score::default(),
            picture: Vec::new(),
            proposal,
        };
        Self {
            best,
            next: None,
            is_given: true,
        }
    }

    /// By what factor the best is likelier than the next.
    pub(super) fn lead(&self) -> Option<f64> {
        let next = self.next.as_ref()?;
        Some((self.best.score.total() - next.score.total()).exp())
    }

    /// Whether pictures show that no other array is likely.
    pub(super) fn is_sure(&self) -> bool {
        let is_more = |next: &Shown| self.best.score.is_surely_more(&next.score);
        let is_smooth = self.best.score.total() >= SMOOTH_SCORE;
        self.is_given || is_smooth && self.next.as_ref().is_none_or(is_more)
    }
}

/// How much less likely an array is for its sides alone.
pub(super) fn elongation(array: Array) -> f64 {
    ELONGATED * (array.rows as f64 / array.cols as f64).ln().abs()
}

/// Whether the array is larger than any that the daemon reads.
pub(super) fn is_too_large(array: Array) -> bool {
    array.rows.max(array.cols) > MOST_SIDE
}
