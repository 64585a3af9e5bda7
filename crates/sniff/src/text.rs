//! Frames as text.
//!
//! In: raw bytes. Out: the layout, or what the text lacks.

use std::collections::BTreeMap;

use hardnessd_core::frame::{Array, MOST_SIDE};
use hardnessd_core::wire::{Order, Preset, Settings, is_separator};

use crate::found::{
    Failure, Found, Known, LEAST_FRAMES, Ranked, doubt_of_cells, doubt_of_rows, is_too_large,
    name_bits,
};
use crate::layout::Proposal;
use crate::model::{self, Score};
use crate::pictures::{Pictures, Presses, distance, middle};

/// The share of the lines that must have the same number of cells.
const SAME_SHARE: f64 = 0.6;
/// The share of the difference of lines below which they are alike.
const ALIKE: f32 = 0.9;
/// The most frames that are examined.
const MOST_FRAMES: usize = 2000;
/// The fewest cells of an array.
const FEWEST_CELLS: usize = 4;
/// The share of printable bytes in a text, where it has lines and where it has none. Cells may all be
/// printable too, but a mark seldom is.
const PRINTABLE: f64 = 0.97;
const PRINTABLE_WITHOUT_LINES: f64 = 0.995;

/// Whether the bytes are text.
pub(crate) fn is_text(bytes: &[u8]) -> bool {
    let share = |is: fn(&u8) -> bool| {
        bytes.iter().filter(|&byte| is(byte)).count() as f64 / bytes.len() as f64
    };
    let printable = share(|byte| matches!(byte, b' '..=b'~' | b'\t' | b'\r' | b'\n'));
    let ends = bytes
        .iter()
        .filter(|&&byte| matches!(byte, b'\n' | b'\r'))
        .count();
    let is_in_lines = ends > 2 && printable > PRINTABLE;
    (is_in_lines || printable > PRINTABLE_WITHOUT_LINES) && share(u8::is_ascii_whitespace) < 0.6
}

/// The numbers of a line that follow each other before its end. Words may be after them, such as a unit.
fn numbers_of(line: &[u8]) -> Vec<f32> {
    let words = line
        .split(|&byte| is_separator(byte))
        .filter(|word| !word.is_empty());
    let number = |word: &[u8]| -> Option<f32> {
        let number: f32 = std::str::from_utf8(word).ok()?.parse().ok()?;
        number.is_finite().then_some(number)
    };
    let words: Vec<Option<f32>> = words.map(number).collect();
    let end = words
        .iter()
        .rposition(Option::is_some)
        .map_or(0, |at| at + 1);
    let from = words[..end]
        .iter()
        .rposition(Option::is_none)
        .map_or(0, |at| at + 1);
    words[from..end].iter().copied().flatten().collect()
}

/// The array of a text.
pub(crate) fn find(bytes: &[u8], known: Known) -> Result<Found, Failure> {
    let no_array = |words: &str| Err(Failure::sure(format!("text, but no array: {words}")));
    let lines: Vec<&[u8]> = bytes.split(|&byte| byte == b'\n').collect();
    // Lines without a digit may end frames.
    let blocks = lines
        .split(|line| !line.iter().any(u8::is_ascii_digit))
        .map(<[_]>::len)
        .filter(|&rows| rows > 0);
    let rows = most_frequent(blocks).filter(|&(rows, times)| rows > 1 && times >= LEAST_FRAMES);
    let lines: Vec<Vec<f32>> = lines.into_iter().map(numbers_of).collect();
    // Lines without numbers, such as a banner before each frame, count neither for nor against.
    let lines: Vec<&Vec<f32>> = lines.iter().filter(|numbers| !numbers.is_empty()).collect();
    let Some((count, times)) = most_frequent(lines.iter().map(|line| line.len())) else {
        return no_array("no line has only numbers at its end");
    };
    if times < LEAST_FRAMES || (times as f64) < SAME_SHARE * lines.len() as f64 {
        return no_array("lines have different numbers of numbers");
    }
    let frames: Vec<&Vec<f32>> = lines
        .into_iter()
        .filter(|line| line.len() == count)
        .take(MOST_FRAMES)
        .collect();
    if let Some((rows, _)) = rows {
        let mut found = in_rows(Array { rows, cols: count }, bytes, known)?;
        if is_growing(&frames, 0) || is_numbered(&frames, rows) {
            found.doubt = Some(
                "the first number of each row grows, as a time or the row's number does: print a colon after it, or \
                 leave it out"
                    .to_owned(),
            );
        }
        return Ok(found);
    }
    if let Some(rows) = rows_of_a_frame(&frames) {
        return no_array(&format!(
            "a frame seems to be {rows} lines of {count} numbers; let the sensor print an empty line after each frame"
        ));
    }
    // Numbers that count are no cells.
    let leading = (0..count).take_while(|&at| is_growing(&frames, at)).count();
    let cells = count - leading;
    if cells < FEWEST_CELLS {
        return no_array("lines have too few numbers");
    }
    let frames: Vec<Vec<f32>> = frames
        .iter()
        .map(|frame| frame[leading..].to_vec())
        .collect();
    let mut found = in_order(&frames, cells, bytes, known)?;
    if leading > 0 {
        found.best.proposal.remarks.push(format!(
            "the first {leading} numbers of each line grow steadily: a counter or a clock; they are skipped"
        ));
    }
    Ok(found)
}

/// The most frequent of these, and how often it is there.
pub(crate) fn most_frequent<T: Ord + Copy>(of: impl Iterator<Item = T>) -> Option<(T, usize)> {
    let mut counts: BTreeMap<T, usize> = BTreeMap::new();
    for one in of {
        *counts.entry(one).or_default() += 1;
    }
    counts.into_iter().max_by_key(|&(_, count)| count)
}

/// The text says the array itself.
fn in_rows(array: Array, bytes: &[u8], known: Known) -> Result<Found, Failure> {
    if is_too_large(array) {
        return Err(Failure::TooLarge(array));
    }
    let is_allowed = known
        .arrays(array.taxels(), MOST_SIDE)
        .any(|allowed| allowed == array);
    let proposal = is_allowed
        .then(|| Proposal::decoded(settings(array), true, bytes))
        .flatten();
    let no_array =
        || Failure::sure("text, but no array: its blocks of lines are not frames of one array");
    Ok(Found::stated(array, None, proposal.ok_or_else(no_array)?))
}

fn settings(array: Array) -> Settings {
    Settings {
        preset: Some(Preset::Csv),
        rows: Some(array.rows),
        cols: Some(array.cols),
        ..Settings::default()
    }
}

/// The number of lines after which a line is like this one, if that is more than one.
fn rows_of_a_frame(lines: &[&Vec<f32>]) -> Option<usize> {
    let difference = |apart: usize| {
        let pairs = lines.iter().zip(&lines[apart..]);
        let of_pair = |(a, b): (&&Vec<f32>, &&Vec<f32>)| {
            a.iter()
                .zip(b.iter())
                .map(|(a, b)| (a - b).abs())
                .sum::<f32>()
        };
        pairs.map(of_pair).sum::<f32>() / (lines.len() - apart) as f32
    };
    let most = MOST_SIDE.min(lines.len() / 3);
    let of: Vec<f32> = (1..=most + 1).map(difference).collect();
    let is_alike = |apart: &usize| {
        let (before, here, after) = (of[apart - 2], of[apart - 1], of[*apart]);
        here < ALIKE * of[0] || here < ALIKE * ALIKE * before.min(after)
    };
    (2..=most)
        .filter(is_alike)
        .min_by(|a, b| of[a - 1].total_cmp(&of[b - 1]))
}

/// Whether the first numbers of the rows of a frame count them, in each frame.
fn is_numbered(lines: &[&Vec<f32>], rows: usize) -> bool {
    let last = rows as f32 - 1.0;
    let mut steps = lines.windows(2).map(|pair| pair[1][0] - pair[0][0]);
    steps.all(|step| [1.0, -last].contains(&step))
}

fn is_growing(frames: &[&Vec<f32>], at: usize) -> bool {
    let steps: Vec<f32> = frames
        .windows(2)
        .map(|pair| pair[1][at] - pair[0][at])
        .collect();
    10 * steps.iter().filter(|&&step| step > 0.0).count() >= 9 * steps.len()
}

/// The array of frames whose cells are known, but not its sides.
fn in_order(
    frames: &[Vec<f32>],
    cells: usize,
    bytes: &[u8],
    known: Known,
) -> Result<Found, Failure> {
    let rest = middle(frames);
    let changes: Vec<f64> = frames.iter().map(|frame| distance(frame, &rest)).collect();
    // In whole steps, also of volts. Most cells of a quiet board seldom change, so their usual step says nothing.
    let most = changes.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
    let activity = changes.iter().map(|change| (change / most * 1e6) as u32);
    let activity: Vec<u32> = activity.collect();
    let presses = Presses::of(&activity).ok_or(Failure::NoPress(bytes.len() / frames.len()))?;
    let pictures =
        Pictures::of(&presses, |index| frames[index].clone()).expect("words were numbers");
    let score = |array: Array, presses| Score {
        presses,
        weights: pictures.weights.clone(),
        once: name_bits(array),
    };
    let alone = model::alone(&pictures);
    let alone: Vec<f64> = alone.iter().map(|press| press.iter().sum()).collect();
    let is_given = known.rows.is_some() && known.cols.is_some();
    let arrays: Vec<Array> = known.arrays(cells, cells).collect();
    let readable = arrays.iter().filter(|&&array| !is_too_large(array));
    let ranked = readable.filter_map(|&array| {
        let proposal = Proposal::decoded(settings(array), true, bytes)?;
        let own = score(array, model::rows(&pictures, array.cols, 1));
        Some(Ranked {
            array,
            order: Order::RowMajor,
            cell: None,
            picture: pictures.strongest().to_vec(),
            proposal,
            own_doubt: (!is_given)
                .then(|| {
                    doubt_of_cells(cells, &own, &score(array, alone.clone()))
                        .or_else(|| doubt_of_rows(&pictures, array, 1))
                })
                .flatten(),
            score: own,
        })
    });
    Found::among(ranked.collect(), is_given).ok_or_else(|| {
        match arrays.into_iter().find(|&array| is_too_large(array)) {
            Some(array) => Failure::TooLarge(array),
            None => Failure::sure(format!(
                "text, but no array: {cells} numbers on each line make no array"
            )),
        }
    })
}
