//! From bytes to layouts: the order of the search, and when its outcome is sure.
//!
//! In: raw bytes, and what the user knows of the array. Out: the layout, two pictures to choose from,
//! or the reason why there is neither.

use hardnessd_core::frame::Array;
use hardnessd_core::wire::{Cell, Layout, Preset, Settings};

use super::checks::{self, Holds};
use super::columns::{Columns, Kind, Stretch};
use super::hypotheses::{Framed, Hypothesis, Known};
use super::period::{Frames, periods};
use super::picture::Score;
use super::proposal::{Proposal, keys, shortened};
use super::text;

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
        "{0} bytes recur, but they hold no array with a mark: press the sensor at several places meanwhile"
    )]
    NoArray(usize),
    /// Frames of one length, but nothing presses.
    #[error(
        "frames of {0} bytes, but nothing presses the sensor: sniff again, and press it at several places"
    )]
    NoPress(usize),
    /// The array is larger than any that the daemon reads.
    #[error("found an array of about {rows}x{cols} taxels, expected at most 64x64", rows = .0.rows, cols = .0.cols)]
    TooLarge(Array),
    /// Nothing recurs.
    #[error("nothing recurs in {0} bytes: try another --baud, or listen for longer")]
    NotPeriodic(usize),
}

/// The least score of an array. Cells in any other order have about 0.
const LEAST_SCORE: f64 = 0.5;
/// What it adds to the score of an array that it is the one of a preset.
const PRESET: f64 = 1.0;
/// The least score of an array that is sure.
const SMOOTH_SCORE: f64 = 1.0;
/// The number of frames that are needed.
const LEAST_FRAMES: usize = 8;

impl Found {
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

/// The layout that explains `bytes`.
pub(super) fn find(bytes: &[u8], known: Known) -> Result<Found, Failure> {
    if bytes.is_empty() {
        return Err(Failure::Nothing);
    }
    if text::is_text(bytes) {
        return text::find(bytes, known);
    }
    if let Some(found) = glove(bytes).or_else(|| text::packed(bytes, known)) {
        return Ok(found);
    }
    let mut failure = Failure::NotPeriodic(bytes.len());
    for period in periods(bytes) {
        match in_frames(&Frames::new(bytes, &period), bytes, known) {
            Ok(found) => return Ok(found),
            Err(other) => {
                if rank(&other) > rank(&failure) {
                    failure = other;
                }
            }
        }
    }
    Err(failure)
}

/// Of several failures, the one with the highest rank says most.
fn rank(failure: &Failure) -> usize {
    match failure {
        Failure::TooLarge(_) => 3,
        Failure::NoPress(_) => 2,
        Failure::NoArray(_) => 1,
        _ => 0,
    }
}

/// The most bytes that are skipped without a reason, if there is no array otherwise.
const MOST_UNKNOWN: usize = 4;
/// The most arrays of a mark that are examined further.
const MOST_ARRAYS: usize = 40;
/// The number of marks that are examined. Stuck taxels look like another one.
const MARKS: usize = 2;

fn in_frames(frames: &Frames, bytes: &[u8], known: Known) -> Result<Found, Failure> {
    // At a wrong distance, hardly a frame begins where the one before it ended.
    if frames.len() < LEAST_FRAMES || 2 * frames.pairs().count() < frames.len() {
        return Err(Failure::NotPeriodic(bytes.len()));
    }
    let period = frames.period();
    let mut failure = Failure::NoArray(period);
    let mut arrays: Vec<(Hypothesis, Framed)> = Vec::new();
    let columns = Columns::new(frames);
    if !columns.kinds.contains(&Kind::Active) {
        return Err(Failure::NoPress(period));
    }
    for mark in columns.marks().into_iter().take(MARKS) {
        let Some(mut framed) = framed(frames, mark) else {
            continue;
        };
        for most_unknown in [0, MOST_UNKNOWN] {
            framed.most_unknown = most_unknown;
            let Some(found) = framed.hypotheses(known) else {
                failure = Failure::NoPress(period);
                break;
            };
            let is_likely = found
                .first()
                .is_some_and(|best| best.score.total() >= LEAST_SCORE);
            let found = found.into_iter().take(MOST_ARRAYS);
            arrays.extend(found.map(|hypothesis| (hypothesis, framed.clone())));
            if is_likely {
                break;
            }
        }
    }
    arrays.sort_by(|(a, _), (b, _)| b.score.total().total_cmp(&a.score.total()));
    let mut shown: Vec<Shown> = Vec::new();
    for (hypothesis, framed) in &arrays {
        let Hypothesis { array, cell, .. } = *hypothesis;
        if shown.is_empty() && hypothesis.score.total() < LEAST_SCORE && !known.is_complete() {
            break;
        }
        if Framed::is_too_large(array) {
            if shown.is_empty() {
                return Err(Failure::TooLarge(array));
            }
            continue;
        }
        let is_other = shown
            .iter()
            .all(|other| other.array != array || other.cell != Some(cell));
        if is_other && let Some(proposal) = Proposal::of(framed, hypothesis, bytes) {
            let (score, picture) = (hypothesis.score.clone(), hypothesis.picture.clone());
            shown.push(Shown {
                array,
                cell: Some(cell),
                score,
                picture,
                proposal,
            });
        }
        if shown.len() == 2 {
            break;
        }
    }
    // Boards with the layout of a preset have its array.
    for one in &mut shown {
        if keys(&one.proposal.settings) == 1 {
            one.score.prior += PRESET;
        }
    }
    shown.sort_by(|a, b| b.score.total().total_cmp(&a.score.total()));
    let mut shown = shown.into_iter();
    let mut best = shown.next().ok_or(failure)?;
    let is_same = |(other, _): &&(Hypothesis, Framed)| {
        other.array == best.array
            && Some(other.cell) == best.cell
            && !best.score.is_surely_more(&other.score)
    };
    let places: Vec<(usize, usize)> = arrays
        .iter()
        .filter(is_same)
        .map(|(other, _)| other.skipped)
        .collect();
    if let Some((before, after)) = places.iter().find(|&&other| other != places[0]) {
        best.proposal.doubt = Some(format!(
            "not sure where the cells begin: {} bytes beside the mark are skipped before them and {} after \
             them, but it may be {before} and {after}; press the first taxels and the last to see",
            places[0].0, places[0].1
        ));
    }
    Ok(Found {
        best,
        next: shown.next(),
        is_given: known.is_complete(),
    })
}

/// The frames from the first byte after `mark` on, with their checksum.
fn framed<'a>(frames: &Frames<'a>, mark: Stretch) -> Option<Framed<'a>> {
    let period = frames.period();
    if mark.length >= period {
        return None;
    }
    let turned = frames.turned((mark.start + mark.length) % period);
    let columns = Columns::new(&turned);
    // Frames without the mark are damaged.
    let constants: Vec<(usize, u8)> = (period - mark.length..period)
        .filter_map(|at| match columns.kinds[at] {
            Kind::Constant(value) => Some((at, value)),
            _ => None,
        })
        .collect();
    let is_marked = |frame: &[u8]| {
        let right = constants
            .iter()
            .filter(|&&(at, value)| frame[at] == value)
            .count();
        2 * right >= constants.len()
    };
    let frames = turned.kept(|index| is_marked(turned.get(index)));
    if frames.len() < LEAST_FRAMES {
        return None;
    }
    let mut columns = Columns::new(&frames);
    let mut overhead = mark.length;
    let holds = checks::holding(&frames, &columns, overhead);
    let skipped = match &holds {
        Some(Holds::Checksum(check)) => check.at..check.at + check.checksum.bytes(),
        Some(Holds::Sum(sum)) => sum.clone(),
        None => period - overhead..period - overhead,
    };
    overhead = overhead.max(period - skipped.start);
    columns.kinds[skipped].fill(Kind::Restless);
    // A number may stand before the checksum.
    let mark = columns.grown(Stretch {
        start: period - overhead,
        length: overhead,
    });
    overhead = period - mark.start;
    Some(Framed {
        frames,
        columns,
        overhead,
        holds,
        most_unknown: 0,
    })
}

/// The glove of Weihai JQ, whose packets have two lengths.
fn glove(bytes: &[u8]) -> Option<Found> {
    let settings = Settings {
        preset: Preset::JqGlove,
        ..Settings::default()
    };
    let proposal = Proposal::decoded(settings.clone(), bytes)?;
    let array = Layout::new(&settings).ok()?.array();
    let (score, picture) = (Score::default(), Vec::new());
    let best = Shown {
        array,
        cell: Some(Cell::U8),
        score,
        picture,
        proposal,
    };
    Some(Found {
        best,
        next: None,
        is_given: true,
    })
}

/// The layout of a preset that has only rows and columns.
pub(super) fn sized(preset: Preset, array: Array, bytes: &[u8]) -> Option<Proposal> {
    let settings = Settings {
        preset,
        rows: Some(array.rows),
        cols: Some(array.cols),
        ..Settings::default()
    };
    let layout = Layout::new(&settings).ok()?;
    Proposal::decoded(shortened(settings, &layout), bytes)
}
