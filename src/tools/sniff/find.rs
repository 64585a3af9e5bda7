//! From bytes to layouts: the order of the search.
//!
//! In: raw bytes, and what the user knows of the array. Out: the layout, two pictures to choose from,
//! or the reason why there is neither.

use hardnessd_core::frame::{Array, MOST_SIDE};
use hardnessd_core::wire::{Cell, Layout, Preset, Settings};

use super::checks;
use super::columns::{Columns, Kind};
use super::found::{Failure, Found, Known, LEAST_FRAMES, Shown, elongation, is_too_large};
use super::period::{Frames, periods};
use super::picture::{Pictures, Presses, Score, cells, some};
use super::places::{Place, places};
use super::proposal::{Parts, Proposal, keys};
use super::text;

/// The least score of an array. Cells in any other order have about 0.
const LEAST_SCORE: f64 = 0.5;
/// What it adds to the score of an array that it is the one of a preset.
const PRESET: f64 = 1.0;
/// The longest side that is tried, so that an array that is too large is found.
const LONGEST_SIDE: usize = 128;
/// The most arrays that are decoded.
const MOST_ARRAYS: usize = 40;
/// The number of frames that a checksum is tried on.
const CHECKED: usize = 40;
/// The share of the packets whose number follows the one before.
const COUNTING_SHARE: f64 = 0.95;
/// The logarithm of how much more the low byte of a cell changes from cell to cell than the high one.
const UNLIKE: f64 = 1.4;

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

/// The glove of Weihai JQ, whose packets have two lengths.
fn glove(bytes: &[u8]) -> Option<Found> {
    let settings = Settings {
        preset: Preset::JqGlove,
        ..Settings::default()
    };
    let array = Layout::new(&settings).ok()?.array();
    let proposal = Proposal::decoded(settings, bytes)?;
    Some(Found::stated(array, Some(Cell::U8), proposal))
}

/// Of several failures, the one with the highest rank says most.
fn rank(failure: &Failure) -> usize {
    match failure {
        Failure::TooLarge(_) | Failure::Packets { .. } => 3,
        Failure::NoPress(_) => 2,
        Failure::NoArray(_) => 1,
        _ => 0,
    }
}

/// An array at a place.
#[derive(Debug, Clone)]
struct Candidate {
    array: Array,
    cell: Cell,
    place: Place,
    score: Score,
    picture: Vec<f32>,
}

impl Candidate {
    fn parts<'a>(&'a self, frames: &'a Frames<'a>, columns: &'a Columns) -> Parts<'a> {
        Parts {
            frames,
            columns,
            place: &self.place,
            array: self.array,
            cell: self.cell,
        }
    }
}

fn in_frames(frames: &Frames, bytes: &[u8], known: Known) -> Result<Found, Failure> {
    let period = frames.period();
    // At a wrong distance, hardly a frame begins where the one before it ended.
    if frames.len() < LEAST_FRAMES || 2 * frames.pairs().count() < frames.len() {
        return Err(Failure::NotPeriodic(bytes.len()));
    }
    let frames = &frames.followed();
    let mut columns = Columns::new(frames);
    columns.find_marking(frames);
    let columns = &columns;
    if !columns.kinds.contains(&Kind::Active) {
        return Err(Failure::NoPress(period));
    }
    if let Some(packets) = packets(frames, columns) {
        return Err(packets);
    }
    let places = places(columns);
    if places.is_empty() || columns.are_random {
        return Err(Failure::NoArray(period));
    }
    let presses = Presses::of(&columns.activity(frames)).ok_or(Failure::NoPress(period))?;
    let mut candidates = candidates(places, frames, columns, &presses, known);
    check(&mut candidates, frames, columns);
    candidates.sort_by(|a, b| b.score.total().total_cmp(&a.score.total()));
    candidates.truncate(MOST_ARRAYS);
    let mut shown: Vec<Shown> = Vec::new();
    for candidate in &candidates {
        let Candidate { array, cell, .. } = *candidate;
        if shown.is_empty() && candidate.score.total() < LEAST_SCORE && !known.is_complete() {
            break;
        }
        if is_too_large(array) {
            if shown.is_empty() {
                return Err(Failure::TooLarge(array));
            }
            continue;
        }
        let is_other =
            |shown: &Shown| shown.array != array || shown.cell.is_some_and(|other| other != cell);
        let parts = candidate.parts(frames, columns);
        if shown.iter().all(is_other)
            && let Some(mut proposal) = Proposal::of(&parts, bytes)
        {
            proposal.doubt = doubt(candidate, &candidates, frames, columns);
            let mut score = candidate.score.clone();
            // Boards with the layout of a preset have its array.
            if keys(&proposal.settings) == 1 {
                score.prior += PRESET;
            }
            shown.push(Shown {
                array,
                cell: Some(cell),
                score,
                picture: candidate.picture.clone(),
                proposal,
            });
        }
        if shown.len() == 2 {
            break;
        }
    }
    Found::among(shown, known.is_complete()).ok_or(Failure::NoArray(period))
}

/// The arrays at all places.
fn candidates(
    places: Vec<Place>,
    frames: &Frames,
    columns: &Columns,
    presses: &Presses,
    known: Known,
) -> Vec<Candidate> {
    let mut found = Vec::new();
    for place in places {
        let of_frame = |index: usize| {
            let bytes = frames.from(index, place.start, place.bytes);
            bytes.expect("damaged and cut frames are left out")
        };
        let cost = place.cost(columns).expect("a place has a cost");
        for cell in [Cell::U8, Cell::U16le, Cell::U16be] {
            let count = place.bytes / cell.bytes();
            if !place.bytes.is_multiple_of(cell.bytes())
                || known.cell.is_some_and(|known| known != cell)
            {
                continue;
            }
            let pictures = Pictures::of(presses, |index| {
                cells(of_frame(index), cell).map(f32::from).collect()
            });
            let cost = cost + unlikeness(presses.frames().map(of_frame), cell);
            for array in known.arrays(count, LONGEST_SIDE) {
                // Where a smaller array may be it, the larger ones are not.
                if is_too_large(array) && count <= MOST_SIDE * MOST_SIDE {
                    continue;
                }
                found.push(Candidate {
                    array,
                    cell,
                    place: place.clone(),
                    score: pictures.score(array.cols, -cost - elongation(array)),
                    picture: pictures.strongest().to_vec(),
                });
            }
        }
    }
    found
}

/// What it costs that the high bytes of cells of two bytes change as much from cell to cell as the
/// low ones do, as if they were cells of one byte, or more, as if the order were the other one.
fn unlikeness<'a>(frames: impl Iterator<Item = &'a [u8]>, cell: Cell) -> f64 {
    if cell == Cell::U8 {
        return 0.0;
    }
    let mut differences = [1.0_f64; 2];
    for bytes in frames {
        for (at, [a, _, b]) in bytes.array_windows().enumerate() {
            differences[at % 2] += f64::from(a.abs_diff(*b)).powi(2);
        }
    }
    let [first, second] = differences;
    let ratio = if cell == Cell::U16le {
        first / second
    } else {
        second / first
    };
    UNLIKE - ratio.ln().clamp(-UNLIKE, UNLIKE)
}

/// Finds what holds for the bytes beside the cells.
fn check(candidates: &mut [Candidate], frames: &Frames, columns: &Columns) {
    let indices: Vec<usize> = (0..frames.len()).collect();
    let indices = some(&indices, CHECKED);
    let mut found: Vec<(Place, Cell, Place)> = Vec::new();
    for candidate in candidates {
        let Candidate {
            cell, ref place, ..
        } = *candidate;
        let known = found
            .iter()
            .find(|(before, of, _)| before == place && *of == cell);
        let checked = match known {
            Some((.., checked)) => checked.clone(),
            None => {
                let length = place.beside.len();
                let first = (place.start + frames.period() - length) % frames.period();
                let spans: Vec<&[u8]> = indices
                    .iter()
                    .filter_map(|&index| frames.from(index, first, frames.period() + length))
                    .collect();
                let check = checks::holding(&spans, &place.beside, cell);
                let checked = Place {
                    check,
                    ..place.clone()
                };
                found.push((place.clone(), cell, checked.clone()));
                checked
            }
        };
        let cost = |place: &Place| place.cost(columns).expect("a place has a cost");
        candidate.score.prior += cost(&candidate.place) - cost(&checked);
        candidate.place = checked;
    }
}

/// Says where else the cells may begin, if that is as likely.
fn doubt(
    best: &Candidate,
    candidates: &[Candidate],
    frames: &Frames,
    columns: &Columns,
) -> Option<String> {
    let other = candidates.iter().find(|other| {
        other.array == best.array
            && other.cell == best.cell
            && other.place.start != best.place.start
            && !best.score.is_surely_more(&other.score)
    })?;
    let around = |candidate: &Candidate| candidate.parts(frames, columns).around();
    let ((before, after), (other_before, other_after)) = (around(best)?, around(other)?);
    Some(format!(
        "not sure where the cells begin: {before} bytes are between the mark and them and {after} behind them, but it \
         may be {other_before} and {other_after}; press the first taxels and the last to see"
    ))
}

/// The packets of a frame, if their number shows: what presses is in the same packet of each frame.
fn packets(frames: &Frames, columns: &Columns) -> Option<Failure> {
    let bytes = frames.period();
    (0..bytes).find_map(|at| {
        let values = || frames.iter().map(|frame| frame[at]);
        let (first, last) = (values().min()?, values().max()?);
        let packets = usize::from(last - first) + 1;
        if !(2..=MOST_SIDE).contains(&packets) || frames.len() < LEAST_FRAMES * packets {
            return None;
        }
        let next = |value: u8| if value == last { first } else { value + 1 };
        let pairs = frames.pairs().count();
        let counting = frames
            .pairs()
            .filter(|&(a, b)| frames.get(b)[at] == next(frames.get(a)[at]));
        let change = |distance: usize| {
            let changes = frames
                .at_distance(distance)
                .map(|(a, b)| columns.change(frames.get(a), frames.get(b)));
            let changes: Vec<u32> = changes.collect();
            f64::from(changes.iter().sum::<u32>()) / changes.len() as f64
        };
        // A counter may begin again too, but then the frames before and after are alike.
        (counting.count() as f64 >= COUNTING_SHARE * pairs as f64 && change(packets) < change(1))
            .then_some(Failure::Packets {
                bytes,
                first,
                last,
                packets,
            })
    })
}
