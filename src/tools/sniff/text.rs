//! Frames whose length varies: decimals as text, and packed zeros.
//!
//! In: raw bytes. Out: the layout, or what the text lacks.

use std::collections::BTreeMap;

use hardnessd_core::frame::{Array, MOST_SIDE};
use hardnessd_core::wire::{Preset, is_separator};

use super::found::{Failure, Found, Known, LEAST_FRAMES, Shown, elongation, is_too_large};
use super::picture::{Pictures, Presses, of_each_cell};
use super::proposal::sized;

/// The share of the lines, or packed frames, that must have the same number of cells.
const SAME_SHARE: f64 = 0.6;
/// The most frames that are examined.
const MOST_FRAMES: usize = 2000;
/// The fewest cells of an array.
const FEWEST_CELLS: usize = 4;

/// Whether the bytes are lines of text. Cells may all be printable too, but then they are much alike.
pub(super) fn is_text(bytes: &[u8]) -> bool {
    let share = |is: fn(&u8) -> bool| {
        bytes.iter().filter(|&byte| is(byte)).count() as f64 / bytes.len() as f64
    };
    let is_printable = |byte: &u8| matches!(byte, b' '..=b'~' | b'\t' | b'\r' | b'\n');
    let lines = bytes.iter().filter(|&&byte| byte == b'\n').count();
    lines > 2 && share(is_printable) > 0.97 && share(u8::is_ascii_whitespace) < 0.6
}

/// The array of a text.
pub(super) fn find(bytes: &[u8], known: Known) -> Result<Found, Failure> {
    let lines: Vec<&[u8]> = bytes.split(|&byte| byte == b'\n').collect();
    // A frame in rows ends with a line without a digit.
    let blocks: Vec<Vec<Vec<f32>>> = lines
        .split(|line| !line.iter().any(u8::is_ascii_digit))
        .map(|block| block.iter().filter_map(|line| numbers(line)).collect())
        .collect();
    let shape = |block: &Vec<Vec<f32>>| Some((block.len(), block.last()?.len()));
    if let Some(((rows, cols), times)) = most_frequent(blocks.iter().filter_map(shape))
        && rows > 1
        && times >= LEAST_FRAMES
    {
        return in_rows(Array { rows, cols }, bytes, known);
    }
    let no_array = |words: &str| Failure::Text(words.to_owned());
    // Lines without numbers, such as a banner before each frame, count neither for nor against.
    let lines: Vec<&Vec<f32>> = blocks.iter().flatten().collect();
    let Some((count, times)) = most_frequent(lines.iter().map(|line| line.len())) else {
        return Err(no_array(
            "no line has only whole numbers of 0 to 65535 at its end",
        ));
    };
    let is_same = times as f64 >= SAME_SHARE * lines.len() as f64;
    if times < LEAST_FRAMES || !is_same || count < FEWEST_CELLS {
        return Err(no_array("lines have different numbers of numbers"));
    }
    let frames: Vec<&Vec<f32>> = lines
        .into_iter()
        .filter(|line| line.len() == count)
        .collect();
    if let Some(rows) = rows_without_blank(&frames) {
        return Err(no_array(&format!(
            "a frame seems to be {rows} lines of {count} numbers; let the sensor print an empty line after each frame"
        )));
    }
    // Numbers that count are no cells.
    let leading = (0..count).take_while(|&at| is_growing(&frames, at)).count();
    let frames: Vec<Vec<f32>> = frames
        .iter()
        .map(|frame| frame[leading..].to_vec())
        .collect();
    let mut found = in_order(Preset::Csv, &frames, bytes, known)?;
    if leading > 0 {
        let remark = format!(
            "the first {leading} numbers of each line grow steadily: a counter or a clock; they are skipped"
        );
        found.best.proposal.remarks.push(remark);
    }
    Ok(found)
}

/// The array of packed zeros, if the bytes are that.
pub(super) fn packed(bytes: &[u8], known: Known) -> Option<Found> {
    let stretches = bytes.split(|&byte| byte == 0xFF);
    let frames: Vec<Vec<f32>> = stretches
        .filter(|packed| packed.contains(&0))
        .filter_map(unpacked)
        .collect();
    let (count, times) = most_frequent(frames.iter().map(Vec::len))?;
    // Without this, cells with zeros between two marks of FF would be unpacked too.
    if count < 9 || times < LEAST_FRAMES || (times as f64) < SAME_SHARE * frames.len() as f64 {
        return None;
    }
    let frames: Vec<_> = frames
        .into_iter()
        .filter(|frame| frame.len() == count)
        .collect();
    in_order(Preset::ZeroRun, &frames, bytes, known).ok()
}

fn unpacked(packed: &[u8]) -> Option<Vec<f32>> {
    let mut cells = Vec::new();
    let mut bytes = packed.iter();
    while let Some(&byte) = bytes.next() {
        let run = if byte == 0 {
            usize::from(*bytes.next()?)
        } else {
            1
        };
        cells.resize(cells.len() + run, f32::from(byte));
    }
    Some(cells)
}

/// The numbers that end a line. `None` if it has none.
fn numbers(line: &[u8]) -> Option<Vec<f32>> {
    let words = line.split(|&byte| is_separator(byte));
    let words = words.filter(|word| !word.is_empty());
    let number = |word: &[u8]| -> Option<u16> { std::str::from_utf8(word).ok()?.parse().ok() };
    let words: Vec<Option<f32>> = words.map(|word| number(word).map(f32::from)).collect();
    let from = words
        .iter()
        .rposition(Option::is_none)
        .map_or(0, |at| at + 1);
    (from < words.len()).then(|| words[from..].iter().copied().flatten().collect())
}

fn most_frequent<T: Ord + Copy>(of: impl Iterator<Item = T>) -> Option<(T, usize)> {
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
        .then(|| sized(Preset::Ascii, array, bytes))
        .flatten();
    let no_array = || Failure::Text("its blocks of lines are not frames of one array".to_owned());
    Ok(Found::stated(array, None, proposal.ok_or_else(no_array)?))
}

/// The number of lines after which a line is like this one, if that is more than one.
fn rows_without_blank(lines: &[&Vec<f32>]) -> Option<usize> {
    let lines = &lines[..lines.len().min(MOST_FRAMES)];
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
    let most = hardnessd_core::frame::MOST_SIDE.min(lines.len() / 3);
    let (apart, least) = (1..=most)
        .map(|apart| (apart, difference(apart)))
        .min_by(|a, b| a.1.total_cmp(&b.1))?;
    (apart > 1 && 2.0 * least < difference(1)).then_some(apart)
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
    preset: Preset,
    frames: &[Vec<f32>],
    bytes: &[u8],
    known: Known,
) -> Result<Found, Failure> {
    let frames = &frames[..frames.len().min(MOST_FRAMES)];
    let rest = of_each_cell(frames, 4);
    let cells = rest.len();
    let change = |frame: &Vec<f32>| {
        let changes = frame.iter().zip(&rest).map(|(value, rest)| value - rest);
        changes.map(|change| change.abs() as u32).sum()
    };
    let activity: Vec<u32> = frames.iter().map(change).collect();
    let presses = Presses::of(&activity).ok_or(Failure::NoPress(cells))?;
    let pictures = Pictures::of(&presses, |index| frames[index].clone());
    let arrays: Vec<Array> = known.arrays(cells, cells).collect();
    let shown = arrays.iter().filter_map(|&array| {
        Some(Shown {
            array,
            cell: None,
            score: pictures.score(array.cols, -elongation(array)),
            picture: pictures.strongest().to_vec(),
            proposal: sized(preset, array, bytes)?,
        })
    });
    let is_given = known.rows.is_some() && known.cols.is_some();
    let mut too_large = arrays
        .iter()
        .rev()
        .copied()
        .filter(|&array| is_too_large(array));
    Found::among(shown.collect(), is_given).ok_or_else(|| match too_large.next() {
        Some(array) => Failure::TooLarge(array),
        None => Failure::Text(format!("{cells} numbers on each line make no array")),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const ARRAY: Array = Array { rows: 8, cols: 16 };

    /// The counts of presses at several places.
    fn frames() -> Vec<Vec<u16>> {
        let frame = |time: usize| {
            let (press, phase) = (time / 20, time % 20);
            let (row, col) = (1 + 3 * press % 6, 1 + 5 * press % 14);
            let count = |at: usize| {
                let (down, right) = (at / ARRAY.cols, at % ARRAY.cols);
                let apart = down.abs_diff(row).pow(2) + right.abs_diff(col).pow(2);
                let height = if phase < 6 { 0.0 } else { 900.0 };
                3 + (height * (-(apart as f64) / 3.0).exp()) as u16
            };
            (0..ARRAY.taxels()).map(count).collect()
        };
        (0..200).map(frame).collect()
    }

    fn joined(counts: &[u16]) -> String {
        let counts: Vec<String> = counts.iter().map(u16::to_string).collect();
        counts.join(" ")
    }

    fn assert_found(text: &str, preset: Preset) {
        let found = find(text.as_bytes(), Known::default()).unwrap();
        let settings = found.best.proposal.settings;
        assert_eq!(settings.preset, preset, "{}", &text[..40]);
        assert_eq!(found.best.array, ARRAY, "{}", &text[..40]);
    }

    #[test]
    fn lines_are_found_between_banners_with_and_without_numbers() {
        for banner in [
            "--- frame N ---\n",
            "==== FRAME ====\r\n",
            "boot\n\n- N -\n",
        ] {
            let lines = frames().into_iter().enumerate().map(|(number, frame)| {
                banner.replace('N', &number.to_string()) + &joined(&frame) + "\n"
            });
            assert_found(&lines.collect::<String>(), Preset::Csv);
        }
    }

    #[test]
    fn rows_are_found_between_lines_without_a_digit() {
        for banner in ["", "---", "=== frame ===\r"] {
            let blocks = frames().into_iter().map(|frame| {
                let rows: Vec<String> = frame.chunks(ARRAY.cols).map(joined).collect();
                format!("{banner}\n{}\n", rows.join("\n"))
            });
            assert_found(&blocks.collect::<String>(), Preset::Ascii);
        }
    }
}
