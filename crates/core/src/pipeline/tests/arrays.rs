//! Tests that a press is the same press on every array.

use super::*;
use crate::frame::Pitch;
use crate::wire::Cell;

/// The radius of the contact, in mm, and its force.
const RADIUS_MM: f64 = 13.0;
const FORCE_N: f64 = 20.0;
/// So small that rounding to counts does not matter.
const COUNT_N: f32 = 0.0005;

/// The counts of a smooth round contact in the middle of an array.
fn contact(array: Array, pitch: Pitch) -> RawFrame {
    const PARTS: usize = 10;
    let middle = |taxels: usize, mm: f64| taxels as f64 * mm / 2.0;
    let (y0, x0) = (
        middle(array.rows, pitch.rows_mm),
        middle(array.cols, pitch.cols_mm),
    );
    // Hertz's pressure.
    let pressure = |y: f64, x: f64| {
        let share = ((y - y0).powi(2) + (x - x0).powi(2)) / RADIUS_MM.powi(2);
        1.5 * FORCE_N / (std::f64::consts::PI * RADIUS_MM.powi(2)) * (1.0 - share).max(0.0).sqrt()
    };
    let mut raw = RawFrame::zero(array);
    for (place, count) in raw.counts.iter_mut().enumerate() {
        let (row, col) = array.position(place);
        let parts = (0..PARTS * PARTS).map(|part| {
            let along = |own: usize, part: usize| own as f64 + (part as f64 + 0.5) / PARTS as f64;
            let y = along(row, part / PARTS) * pitch.rows_mm;
            let x = along(col, part % PARTS) * pitch.cols_mm;
            pressure(y, x)
        });
        let newtons = parts.sum::<f64>() / (PARTS * PARTS) as f64 * pitch.area_mm2();
        *count = (newtons / f64::from(COUNT_N)).round() as f32;
    }
    raw
}

/// The final verdict on the contact.
fn verdict(array: Array, pitch: Pitch) -> Hardness {
    let mut pipeline = pipeline_of(|described| {
        described.sensor.frame.cell = Some(Cell::U16le);
        described.sensor.frame.rows = Some(array.rows);
        described.sensor.frame.cols = Some(array.cols);
        described.sensor.calibration.newtons_per_count = COUNT_N;
        described.sensor.calibration.pitch_mm = pitch;
    });
    let (free, held) = (RawFrame::zero(array), contact(array, pitch));
    let (before, after) = (vec![free.clone(); 5], vec![free; 2]);
    let frames = [before, vec![held; 4], after].concat();
    let events = feed(&mut pipeline, 0, &frames);
    let shown = shown(&events).last().unwrap();
    assert_eq!((shown.rows, shown.cols), (array.rows, array.cols));
    assert_eq!(shown.newtons.len(), array.taxels());
    verdicts(events).pop().unwrap()
}

#[test]
fn a_contact_is_the_same_on_arrays_of_any_size_and_pitch() {
    let known = verdict(Array::JX255N, Pitch::JX255N);
    assert_eq!(known.notes, []);
    for (rows, cols, rows_mm, cols_mm, notes) in [
        (28, 28, 3.5, 3.5, &[][..]),
        // A part of a larger array of the same film, and a strip.
        (64, 64, 3.5, 3.5, &[]),
        (12, 32, 3.5, 3.5, &[]),
        (56, 56, 1.75, 1.75, &[Note::Resampled]),
        (64, 64, 1.5, 1.5, &[Note::Resampled]),
        (16, 40, 2.0, 2.0, &[Note::Resampled]),
        (28, 56, 3.5, 1.75, &[Note::Resampled]),
        (14, 14, 7.0, 7.0, &[Note::OutsideTraining, Note::Resampled]),
        (4, 4, 10.0, 10.0, &[Note::OutsideTraining, Note::Resampled]),
    ] {
        let array = Array { rows, cols };
        let pitch = Pitch { rows_mm, cols_mm };
        let found = verdict(array, pitch);
        let what = format!("{array} at {pitch}: {found:?}");
        assert_eq!(found.notes, notes, "{what}");
        assert!((found.force_n / FORCE_N - 1.0).abs() < 0.01, "{what}");
        let area_mm2 = std::f64::consts::PI * RADIUS_MM.powi(2);
        let share = found.contact_area_mm2 / area_mm2;
        // A taxel that the contact only touches counts with its whole area.
        let most = (1.0 + rows_mm.max(cols_mm) / RADIUS_MM).powi(2);
        assert!((0.7..most).contains(&share), "{share} on {what}");
        if pitch.area_mm2() <= 12.5 {
            assert_eq!(found.level, known.level, "{what}");
            let apart = found.probabilities.iter().zip(&known.probabilities);
            let apart = apart.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(apart < 0.1, "{apart} on {what}");
        }
    }
}
