//! The file of a sensor's references: presses on pieces whose properties are known, as `.npz`.
//!
//! In: the bytes of a file, or presses on the model's grid. Out: the presses, or the bytes.
//! `docs/formats.md` has the arrays. A daemon gives them to its model, and they replace nothing of the
//! calibration.

use std::io::Cursor;

use crate::npz::{Reader, Unexpected, Writer, within};
use crate::verdict::{
    COLS, COURSE_FRAMES, MOST_REFERENCES, ModelFrame, Piece, ROWS, ReferencePress, Sample, TAXELS,
    TimeSeries,
};

/// The newtons on a taxel, without the sign.
const MOST_N: f32 = 1e6;
/// The lengths of pieces, in mm.
const MOST_MM: f32 = 1000.0;
/// The largest file that is read, in bytes.
pub const MAX_FILE_BYTES: usize = 16_000_000;

/// The reason why bytes are not a file of references.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// They are no archive.
    #[error("found no .npz file ({0}), expected one of `hardnessd identify`")]
    Archive(#[from] zip::result::ZipError),
    /// An array is another one than `docs/formats.md` says.
    #[error(transparent)]
    Array(#[from] Unexpected),
}

/// Reads a file.
///
/// # Errors
///
/// Returns an [`Error`] if the bytes are no such file, or have no press or more than
/// [`MOST_REFERENCES`].
pub fn read(bytes: &[u8]) -> Result<Vec<ReferencePress>, Error> {
    let mut file = Reader::new(bytes, usize::MAX)?;
    let kinds: Vec<u8> = file.read("piece", &[], 1..=MOST_REFERENCES)?;
    let count = kinds.len();
    let mut column = |array: &str, row: &[usize], rows: usize, range| {
        let values: Vec<f32> = file.read(array, row, rows..=rows)?;
        within(array, &values, &range).map(|()| values)
    };
    let piece_mm = column("piece_mm", &[], count, 0.0..=MOST_MM)?;
    let shore = column("shore", &[2], count, 0.0..=100.0)?;
    let arm_n_per_mm = column("arm_n_per_mm", &[], count, 0.0..=1e6)?;
    let most = MOST_REFERENCES * COURSE_FRAMES.1;
    let press: Vec<u32> = file.read("press", &[], 1..=most)?;
    let frames = press.len();
    let mut column = |array: &str, row: &[usize], range| {
        let values: Vec<f32> = file.read(array, row, frames..=frames)?;
        within(array, &values, &range).map(|()| values)
    };
    let time_s = column("time_s", &[], 0.0..=1e5)?;
    let approach_mm = column("approach_mm", &[], -1e6..=1e6)?;
    let newtons = column("frames", &[ROWS, COLS], -MOST_N..=MOST_N)?;
    let known: Vec<u8> = file.read("known", &[], frames..=frames)?;
    within("known", &known, &(0..=1))?;

    let of_presses: Vec<&[u32]> = press.chunk_by(u32::eq).collect();
    let is_one = |(number, rows): (usize, &&[u32])| {
        rows[0] as usize == number && rows.len() <= COURSE_FRAMES.1
    };
    if of_presses.len() != count || !of_presses.iter().enumerate().all(is_one) {
        let most = COURSE_FRAMES.1;
        let expected = format!("1 to {most} of each of {count} presses, in order");
        return Err(Unexpected::new("press", format!("{frames} frames"), expected).into());
    }
    let mut moments = (0..frames).map(|row| Sample {
        time_s: time_s[row],
        approach_mm: (known[row] == 1).then_some(approach_mm[row]),
        frame: ModelFrame {
            newtons: std::array::from_fn(|k| newtons[row * TAXELS + k]),
        },
    });
    let reference = |(number, rows): (usize, &&[u32])| {
        let mm = piece_mm[number];
        let range = [shore[2 * number], shore[2 * number + 1]];
        let piece = match kinds[number] {
            1 if mm > 0.0 => Piece::Flat { width_mm: mm },
            2 if mm > 0.0 => Piece::Ball { radius_mm: mm },
            3 if range[0] <= range[1] => Piece::Shore { range },
            kind => {
                let found = format!("{kind} of {mm} mm or Shore {range:?}");
                let expected = "1 (flat), 2 (ball), 3 (known hardness)";
                return Err(Unexpected::new("piece", found, expected).into());
            }
        };
        let course = TimeSeries {
            moments: moments.by_ref().take(rows.len()).collect(),
            arm_n_per_mm: arm_n_per_mm[number],
        };
        Ok(ReferencePress { course, piece })
    };
    of_presses.iter().enumerate().map(reference).collect()
}

/// The bytes of a file with these presses. The same presses give the same bytes.
///
/// # Errors
///
/// Returns the errors of packing.
pub fn write(references: &[ReferencePress]) -> std::io::Result<Vec<u8>> {
    let moments = || {
        let numbered = (0_u32..).zip(references);
        numbered.flat_map(|(number, press)| {
            press
                .course
                .moments
                .iter()
                .map(move |moment| (number, moment))
        })
    };
    let piece = |press: &ReferencePress| match press.piece {
        Piece::Flat { width_mm } => (1, width_mm, [0.0; 2]),
        Piece::Ball { radius_mm } => (2, radius_mm, [0.0; 2]),
        Piece::Shore { range } => (3, 0.0, range),
    };
    let pieces: Vec<(u8, f32, [f32; 2])> = references.iter().map(piece).collect();
    let mut npz = Writer::compressed(Cursor::new(Vec::new()));
    let kinds: Vec<u8> = pieces.iter().map(|piece| piece.0).collect();
    npz.add_list("piece", &kinds)?;
    let piece_mm: Vec<f32> = pieces.iter().map(|piece| piece.1).collect();
    npz.add_list("piece_mm", &piece_mm)?;
    let shore: Vec<f32> = pieces.iter().flat_map(|piece| piece.2).collect();
    npz.add("shore", &[references.len(), 2], &shore)?;
    let arms = references.iter().map(|press| press.course.arm_n_per_mm);
    npz.add_list("arm_n_per_mm", &arms.collect::<Vec<f32>>())?;
    let numbers: Vec<u32> = moments().map(|(number, _)| number).collect();
    npz.add_list("press", &numbers)?;
    let time_s: Vec<f32> = moments().map(|(_, m)| m.time_s).collect();
    npz.add_list("time_s", &time_s)?;
    let approach_mm = moments().map(|(_, m)| m.approach_mm.unwrap_or(0.0));
    npz.add_list("approach_mm", &approach_mm.collect::<Vec<f32>>())?;
    let known = moments().map(|(_, m)| u8::from(m.approach_mm.is_some()));
    npz.add_list("known", &known.collect::<Vec<u8>>())?;
    let newtons = moments().flat_map(|(_, m)| m.frame.newtons);
    let newtons: Vec<f32> = newtons.collect();
    npz.add("frames", &[numbers.len(), ROWS, COLS], &newtons)?;
    Ok(npz.finish()?.into_inner())
}

#[cfg(test)]
mod tests {
    use zip::ZipArchive;

    use super::*;
    use crate::npy::Header;

    fn press(frames: usize, piece: Piece) -> ReferencePress {
        let moment = |place: usize| {
            let mut frame = ModelFrame::default();
            frame.newtons[400..403].fill(0.25 * (place + 1) as f32);
            frame.newtons[403] = -0.0125;
            Sample {
                time_s: 0.05 * place as f32,
                approach_mm: (place != 2).then_some(0.5 * place as f32),
                frame,
            }
        };
        ReferencePress {
            course: TimeSeries {
                moments: (0..frames).map(moment).collect(),
                arm_n_per_mm: 12.5,
            },
            piece,
        }
    }

    fn presses() -> Vec<ReferencePress> {
        vec![
            press(4, Piece::Flat { width_mm: 20.0 }),
            press(1, Piece::Ball { radius_mm: 7.5 }),
            press(
                48,
                Piece::Shore {
                    range: [61.0, 70.0],
                },
            ),
        ]
    }

    #[test]
    fn a_file_gives_the_presses_back() {
        let bytes = write(&presses()).unwrap();
        assert_eq!(read(&bytes).unwrap(), presses());
        assert_eq!(write(&presses()).unwrap(), bytes);
    }

    #[test]
    fn what_is_no_such_file_is_refused() {
        let bytes = write(&presses()).unwrap();
        let of = |presses: &[ReferencePress]| write(presses).unwrap();
        let flat = Piece::Flat { width_mm: 1.0 };
        let turned = Piece::Shore {
            range: [70.0, 61.0],
        };
        for (bytes, expected) in [
            (b"PK".to_vec(), "found no .npz file"),
            (bytes[..bytes.len() / 2].to_vec(), "found no .npz file"),
            (of(&[]), "expected u8 [1 to 64]"),
            (
                of(&vec![press(1, flat); 65]),
                "shape [65], expected u8 [1 to 64]",
            ),
            (
                of(&[press(49, flat)]),
                "array `press`: found 49 frames, expected 1 to 48 of each of 1 presses",
            ),
            (of(&[press(4, turned)]), "Shore [70.0, 61.0]"),
            (
                of(&[press(4, Piece::Flat { width_mm: f32::NAN })]),
                "array `piece_mm`: found NaN",
            ),
        ] {
            let error = read(&bytes).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }

    /// A packed file may hold a thousand times its size.
    #[test]
    fn an_array_with_too_many_rows_is_not_unpacked() {
        let good = write(&presses()[..1]).unwrap();
        let most = MOST_REFERENCES * COURSE_FRAMES.1;
        for (array, rows, expected) in [
            ("piece", 65, "u8 [1 to 64]"),
            ("piece_mm", 2, "f32 [1]"),
            ("press", most + 1, "u32 [1 to 3072]"),
            ("known", 5, "u8 [4]"),
        ] {
            let mut whole = ZipArchive::new(Cursor::new(&good)).unwrap();
            let mut npz = Writer::compressed(Cursor::new(Vec::new()));
            for place in 0..whole.len() {
                let mut entry = whole.by_index(place).unwrap();
                let name = entry.name().trim_end_matches(".npy").to_owned();
                let header = Header::read(&mut entry).unwrap();
                let values = header
                    .elements(&mut entry, |value| Some(value as f32))
                    .unwrap();
                // These elements are out of range, so they would be refused if they were read first.
                match name == array {
                    true => npz.add_list(&name, &vec![-1e9_f32; rows]).unwrap(),
                    false => npz.add(&name, &header.shape, &values).unwrap(),
                }
            }
            let error = read(&npz.finish().unwrap().into_inner()).unwrap_err();
            let found = format!("an array of shape [{rows}]");
            let expected = format!("array `{array}`: found {found}, expected {expected}");
            assert_eq!(error.to_string(), expected);
        }
    }
}
