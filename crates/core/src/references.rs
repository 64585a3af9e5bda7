//! The file of a sensor's references: presses on pieces whose properties are known, as `.npz`.
//!
//! In: the bytes of a file, or presses on the model's grid. Out: the presses, or the bytes.
//! `docs/formats.md` describes it. A daemon gives them to its model, and they replace nothing of the
//! calibration.

use std::io::Cursor;

use crate::npz::{Reader, Unexpected, Writer};
use crate::verdict::{COURSE_FRAMES, MOST_REFERENCES, Moment, Piece, ReferencePress, TAXELS};
use crate::wording::{cut, escaped};

/// The newtons on a taxel, without the sign.
const MOST_N: f32 = 1e6;
/// The lengths of pieces, in mm.
const MOST_MM: f32 = 1000.0;
/// The seconds of a press.
const MOST_S: f32 = 1e5;
/// The text of a press: its frames, with some room for each frame's other numbers.
const MOST_PRESS_BYTES: usize = COURSE_FRAMES.1 * (8 * TAXELS + 100);
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
    let mut file = Reader::new(bytes, MOST_REFERENCES * MOST_PRESS_BYTES)?;
    let mut presses = Vec::new();
    loop {
        let array = presses.len().to_string();
        match (presses.len(), file.has(&array)) {
            (0, false) => {
                let expected = "a press: make the file with `hardnessd identify`";
                return Err(Unexpected::new(&array, "none", expected).into());
            }
            (MOST_REFERENCES, true) => {
                let expected = format!("at most {MOST_REFERENCES} presses");
                return Err(Unexpected::new(&array, "one more", expected).into());
            }
            (_, true) => presses.push(read_press(&mut file, &array)?),
            (_, false) => return Ok(presses),
        }
    }
}

/// Reads a press. Nothing is unpacked of a text that is too long.
fn read_press(file: &mut Reader<'_>, array: &str) -> Result<ReferencePress, Unexpected> {
    let text: Vec<u8> = file.read(array, &[], 1..=MOST_PRESS_BYTES)?;
    let unexpected = |found: &str| {
        let expected = "a press as `hardnessd identify` writes it";
        Unexpected::new(array, cut(&escaped(found)), expected)
    };
    let press = serde_json::from_slice(&text);
    let press: ReferencePress = press.map_err(|error| unexpected(&error.to_string()))?;
    match is_usable(&press) {
        true => Ok(press),
        false => Err(unexpected("numbers that no press has")),
    }
}

/// Whether all numbers are in their ranges.
fn is_usable(press: &ReferencePress) -> bool {
    let is_piece = match press.piece {
        Piece::Flat { width_mm: mm } | Piece::Ball { radius_mm: mm } => mm > 0.0 && mm <= MOST_MM,
        Piece::Shore { range } => range.is_sorted() && range[0] >= 0.0 && range[1] <= 100.0,
    };
    let is_sample = |moment: &Moment| {
        (0.0..=MOST_S).contains(&moment.time_s)
            && moment.approach_mm.is_none_or(|mm| mm.abs() <= 1e6)
            && moment.frame.newtons.iter().all(|n| n.abs() <= MOST_N)
    };
    let mut moments = press.course.moments.iter();
    is_piece && (0.0..=1e6).contains(&press.course.arm_n_per_mm) && moments.all(is_sample)
}

/// The bytes of a file with these presses. The same presses give the same bytes.
///
/// # Errors
///
/// Returns the errors of packing.
pub fn write(references: &[ReferencePress]) -> std::io::Result<Vec<u8>> {
    let mut npz = Writer::new(Cursor::new(Vec::new()));
    for (number, press) in references.iter().enumerate() {
        npz.add_list(&number.to_string(), &serde_json::to_vec(press)?)?;
    }
    Ok(npz.finish()?.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::verdict::{ModelFrame, TimeSeries};

    fn press(frames: usize, piece: Piece) -> ReferencePress {
        let moment = |place: usize| {
            let mut frame = ModelFrame::default();
            frame.newtons[400..403].fill(0.25 * (place + 1) as f32);
            frame.newtons[403] = -0.0125;
            Moment {
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

    #[test]
    fn what_is_no_such_file_is_refused() {
        let of = |presses: &[ReferencePress]| write(presses).unwrap();
        let flat = |width_mm| Piece::Flat { width_mm };
        let range = [70.0, 61.0];
        let mut strong = press(4, flat(1.0));
        strong.course.moments[2].frame.newtons[7] = 2e6;
        let text = |bytes: &[u8]| {
            let mut npz = Writer::new(Cursor::new(Vec::new()));
            npz.add_list("0", bytes).unwrap();
            npz.finish().unwrap().into_inner()
        };
        let good = of(&[press(4, flat(1.0))]);
        // A press on all taxels for as long as a model takes is given back.
        let mut full = press(48, flat(1.0));
        for moment in &mut full.course.moments {
            moment.frame.newtons.fill(0.3);
        }
        assert_eq!(read(&of(std::slice::from_ref(&full))).unwrap(), [full]);
        for (bytes, expected) in [
            (b"PK".to_vec(), "found no .npz file"),
            (good[..good.len() / 2].to_vec(), "found no .npz file"),
            (
                of(&[]),
                "expected a press: make the file with `hardnessd identify`",
            ),
            (
                of(&vec![press(1, flat(1.0)); 65]),
                "array `64`: found one more, expected at most 64",
            ),
            (of(&[press(49, flat(1.0))]), "array `0`: found 49 times"),
            (of(&[press(4, Piece::Shore { range })]), "that no press has"),
            (of(&[press(4, flat(0.0))]), "that no press has"),
            (of(&[press(4, flat(f32::NAN))]), "array `0`: found invalid"),
            (of(&[strong]), "that no press has"),
            (text(b"{}"), "array `0`: found missing field"),
            (text(br#"{"a\nb": 1}"#), "array `0`: found missing field"),
            // A packed file may hold a thousand times its size.
            (text(&vec![b' '; 1 << 20]), "an array of shape [1048576]"),
        ] {
            let error = read(&bytes).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
