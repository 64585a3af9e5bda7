//! The file of a sensor's references: presses on pieces whose properties are known, as `.npz`.
//!
//! In: the bytes of a file, or presses on the model's grid. Out: the presses, or the bytes.
//! `docs/formats.md` has the arrays. A daemon gives them to its model, and they replace nothing of the
//! calibration.

use std::fmt::Display;
use std::io::Cursor;
use std::ops::RangeInclusive;

use zip::ZipArchive;

use crate::npy::Header;
use crate::npz::Writer;
use crate::verdict::{
    COLS, COURSE_FRAMES, MOST_REFERENCES, ModelFrame, Piece, ROWS, ReferencePress, Sample, TAXELS,
    TimeSeries,
};

/// The newtons on a taxel, without the sign.
const MOST_N: f64 = 1e6;
/// The lengths of pieces, in mm.
const MOST_MM: f64 = 1000.0;
/// The largest file that is read, in bytes.
pub const MAX_FILE_BYTES: usize = 16_000_000;

/// The reason why bytes are not a file of references.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Error(String);

impl Error {
    /// The error of an array.
    fn of(array: &str, found: impl Display, expected: impl Display) -> Self {
        Self(format!("{array}: found {found}, expected {expected}"))
    }
}

/// Reads a file.
///
/// # Errors
///
/// Returns an [`Error`] if the bytes are no such file, or have no press or more than
/// [`MOST_REFERENCES`].
pub fn read(bytes: &[u8]) -> Result<Vec<ReferencePress>, Error> {
    let archive = ZipArchive::new(Cursor::new(bytes)).map_err(|error| {
        Error(format!(
            "found no .npz file ({error}), expected one of `hardnessd identify`"
        ))
    })?;
    let mut arrays = Arrays(archive);
    let kinds = arrays.read("piece", &[], 1..=MOST_REFERENCES, 0.0..=255.0)?;
    let count = kinds.len();
    let piece_mm = arrays.read("piece_mm", &[], count..=count, 0.0..=MOST_MM)?;
    let shore = arrays.read("shore", &[2], count..=count, 0.0..=100.0)?;
    let arm_n_per_mm = arrays.read("arm_n_per_mm", &[], count..=count, 0.0..=1e6)?;
    let most = MOST_REFERENCES * COURSE_FRAMES.1;
    let press = arrays.read("press", &[], 1..=most, 0.0..=f64::from(u32::MAX))?;
    let frames = press.len();
    let time_s = arrays.read("time_s", &[], frames..=frames, 0.0..=1e5)?;
    let approach_mm = arrays.read("approach_mm", &[], frames..=frames, -1e6..=1e6)?;
    let known = arrays.read("known", &[], frames..=frames, 0.0..=1.0)?;
    let newtons = arrays.read("frames", &[ROWS, COLS], frames..=frames, -MOST_N..=MOST_N)?;

    let of_presses: Vec<&[f64]> = press.chunk_by(f64::eq).collect();
    let is_one = |(number, rows): (usize, &&[f64])| {
        rows[0] == number as f64 && rows.len() <= COURSE_FRAMES.1
    };
    if of_presses.len() != count || !of_presses.iter().enumerate().all(is_one) {
        let most = COURSE_FRAMES.1;
        let expected = format!("1 to {most} of each of {count} presses, in order");
        return Err(Error::of("press", format!("{frames} frames"), expected));
    }
    let mut moments = (0..frames).map(|row| Sample {
        time_s: time_s[row] as f32,
        approach_mm: (known[row] == 1.0).then_some(approach_mm[row] as f32),
        frame: ModelFrame {
            newtons: std::array::from_fn(|k| newtons[row * TAXELS + k] as f32),
        },
    });
    let reference = |(number, rows): (usize, &&[f64])| {
        let mm = piece_mm[number] as f32;
        let range = [shore[2 * number] as f32, shore[2 * number + 1] as f32];
        let piece = match kinds[number] {
            1.0 if mm > 0.0 => Piece::Flat { width_mm: mm },
            2.0 if mm > 0.0 => Piece::Ball { radius_mm: mm },
            3.0 if range[0] <= range[1] => Piece::Shore { range },
            kind => {
                let found = format!("{kind} of {mm} mm or Shore {range:?}");
                let expected = "1 (flat), 2 (ball), 3 (known hardness)";
                return Err(Error::of("piece", found, expected));
            }
        };
        let course = TimeSeries {
            moments: moments.by_ref().take(rows.len()).collect(),
            arm_n_per_mm: arm_n_per_mm[number] as f32,
        };
        Ok(ReferencePress { course, piece })
    };
    of_presses.iter().enumerate().map(reference).collect()
}

/// The arrays of a file.
struct Arrays<'a>(ZipArchive<Cursor<&'a [u8]>>);

impl Arrays<'_> {
    /// An array with so many rows of this shape. Nothing is unpacked of an array with another number of rows.
    fn read(
        &mut self,
        array: &str,
        row: &[usize],
        rows: RangeInclusive<usize>,
        range: RangeInclusive<f64>,
    ) -> Result<Vec<f64>, Error> {
        let Ok(mut entry) = self.0.by_name(&format!("{array}.npy")) else {
            let expected = format!("an array with rows of shape {row:?}");
            return Err(Error::of(array, "none", expected));
        };
        let failed = |error: std::io::Error| Error(format!("{array}: found {error}"));
        let header = Header::read(&mut entry).map_err(failed)?;
        let found = match header.shape.split_first() {
            Some((&found, rest)) if rest == row => found,
            _ => return Err(failed(header.unexpected_shape())),
        };
        if !rows.contains(&found) {
            return Err(Error::of(array, format!("{found} rows"), within(&rows)));
        }
        let values = header.elements(&mut entry, Some).map_err(failed)?;
        match values.iter().find(|value| !range.contains(*value)) {
            None => Ok(values),
            Some(found) => Err(Error::of(array, found, within(&range))),
        }
    }
}

/// A range in words.
fn within<T: Display + PartialEq>(range: &RangeInclusive<T>) -> String {
    let (least, most) = (range.start(), range.end());
    if least == most {
        least.to_string()
    } else {
        format!("{least} to {most}")
    }
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
    use super::*;

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
            (of(&[]), "piece: found 0 rows, expected 1 to 64"),
            (of(&vec![press(1, flat); 65]), "piece: found 65 rows"),
            (
                of(&[press(49, flat)]),
                "press: found 49 frames, expected 1 to 48 of each of 1 presses",
            ),
            (of(&[press(4, turned)]), "Shore [70.0, 61.0]"),
            (
                of(&[press(4, Piece::Flat { width_mm: f32::NAN })]),
                "piece_mm: found NaN",
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
            ("piece", 65, "1 to 64"),
            ("piece_mm", 2, "1"),
            ("press", most + 1, "1 to 3072"),
            ("known", 5, "4"),
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
            let expected = format!("{array}: found {rows} rows, expected {expected}");
            assert_eq!(error.to_string(), expected);
        }
    }
}
