//! What a search ends with: ranked layouts, or the reason why there is none.

use hardnessd_core::frame::{Array, MOST_SIDE};
use hardnessd_core::wire::Cell;

use crate::layout::Proposal;
use crate::model::Score;

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
    /// Why the best is not sure.
    pub doubt: Option<Doubt>,
}

/// A layout with the picture that it makes.
#[derive(Debug, Clone)]
pub struct Ranked {
    /// The array.
    pub array: Array,
    /// How a cell is written, in words.
    pub words: String,
    /// `None` for text, and for cells that the daemon does not read.
    pub cell: Option<Cell>,
    /// The strongest press, as the array would have it.
    pub picture: Vec<f32>,
    /// The settings, if the daemon reads such a layout.
    pub proposal: Option<Proposal>,
    pub(crate) score: Score,
    /// The bits if no cell has to do with those around it.
    pub(crate) alone: Score,
    /// The doubt about which bytes are cells.
    pub(crate) cells: Option<Doubt>,
}

/// Why the likeliest layout is not sure.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Doubt {
    /// The cells, or something else, are none that the daemon reads.
    #[error("it looks like {0}, which `[sensor.frame]` cannot describe yet")]
    Unreadable(String),
    /// Another array is about as likely.
    #[error(
        "choose with `{0}` or as the pictures say, or press with one finger at several places and at the edges"
    )]
    Between(String),
    /// The cells are no picture.
    #[error(
        "{0} cells beside each other do not act as neighbours do: press with one finger at several places, or this is no array"
    )]
    NoPicture(usize),
    /// The cells may begin elsewhere, or be more or fewer.
    #[error(
        "which bytes are cells: {0} bytes are between the mark and them and {1} behind them, or {2} and {3}; press the \
         first taxels and the last"
    )]
    Cells(usize, usize, usize, usize),
    /// What is beside the cells looks like more of them.
    #[error("{0} bytes beside the cells look like cells at rest: press the edges too")]
    Resting(usize),
    /// There are so few cells that other numbers may pass for an array.
    #[error("{0} numbers are too few to tell an array from others: say `{1}` if it is one")]
    Few(usize, String),
    /// Much is not explained.
    #[error(
        "{frames} whole frames and {damaged} damaged ones, with {share:.0} % of the bytes: lengths vary, as with \
         escapes or packets of several kinds, or --baud is wrong"
    )]
    Unexplained {
        /// The whole frames.
        frames: u64,
        /// The damaged ones.
        damaged: u64,
        /// The share of the bytes in whole frames, in percent.
        share: f64,
    },
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
    /// The bytes are packed in a way that the daemon does not read.
    #[error("{0}")]
    Packed(&'static str),
    /// Bits come in runs.
    #[error(
        "the port is read faster than the sensor sends, for its bits come in runs: try a lower --baud"
    )]
    TooFast,
    /// Stop bits are among the bits of bytes.
    #[error(
        "the port is read slower than the sensor sends, for stop bits are among the bits: try a higher --baud"
    )]
    TooSlow,
    /// Frames of one length without an array.
    #[error(
        "{0} bytes recur, but they hold no array with a mark: press the sensor at several places meanwhile, try another \
         --baud, and say --rows, --cols and --cell if you know them"
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

/// The fewest taxels that show an array.
const FEWEST: usize = 12;

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
        let (best, next) = (ranked.next()?, ranked.next());
        let doubt = best.doubt(next.as_ref(), is_given);
        Some(Self { best, next, doubt })
    }

    /// A layout whose array the bytes or the preset say.
    pub(crate) fn stated(array: Array, cell: Option<Cell>, proposal: Proposal) -> Self {
        let none = Score {
            presses: Vec::new(),
            once: 0.0,
        };
        let best = Ranked {
            array,
            words: "decimals".to_owned(),
            cell,
            picture: Vec::new(),
            proposal: Some(proposal),
            score: none.clone(),
            alone: none,
            cells: None,
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

/// The name of a type of cells in a configuration.
pub fn cell_name(cell: Cell) -> String {
    let name = toml::Value::try_from(cell).ok();
    name.and_then(|name| name.as_str().map(str::to_owned))
        .expect("a type of cells is written as its name")
}

impl Ranked {
    /// The options that choose this array.
    pub fn options(&self) -> String {
        let array = format!("--rows {} --cols {}", self.array.rows, self.array.cols);
        match self.cell {
            Some(cell) => format!("{array} --cell {}", cell_name(cell)),
            None => array,
        }
    }

    fn doubt(&self, next: Option<&Self>, is_given: bool) -> Option<Doubt> {
        let Some(proposal) = &self.proposal else {
            let Array { rows, cols } = self.array;
            return Some(Doubt::Unreadable(format!("{rows}x{cols} {}", self.words)));
        };
        if !proposal.explains_nearly_all() {
            let Proposal {
                frames,
                frames_damaged: damaged,
                share,
                ..
            } = *proposal;
            return Some(Doubt::Unexplained {
                frames,
                damaged,
                share: 100.0 * share,
            });
        }
        if is_given {
            return None;
        }
        // A row of an array looks like an array of one row.
        let is_strip = self.array.rows == 1;
        if is_strip || next.is_some_and(|next| !self.score.is_surely_less(&next.score)) {
            return Some(Doubt::Between(self.options()));
        }
        let taxels = self.array.taxels();
        if taxels < FEWEST {
            return Some(Doubt::Few(taxels, self.options()));
        }
        let is_picture = self.score.is_surely_less(&self.alone);
        let no_picture = || Doubt::NoPicture(self.array.taxels());
        (!is_picture)
            .then(no_picture)
            .or_else(|| self.cells.clone())
    }
}

/// The bits that say which array it is: a long and narrow one is rarer.
pub(crate) fn name_bits(array: Array) -> f64 {
    0.6 * (array.rows as f64 / array.cols as f64).log2().powi(2)
}

/// Whether the array is larger than any that the daemon reads.
pub(crate) fn is_too_large(array: Array) -> bool {
    array.rows.max(array.cols) > MOST_SIDE
}
