//! A frame as another sensor of the same kind would have given it.
//!
//! Gains, a light cover's crosstalk, noise, the activation threshold and dead taxels are drawn anew
//! for each frame, so that the frames are of many sensors. Forces are rounded to counts. The press
//! stays: total force changes by about ten per cent, and the contact keeps its place.

use hardnessd_core::verdict::{COLS, ModelFrame, ROWS, TAXELS};
use hardnessd_simulator::NEWTONS_PER_COUNT;
use hardnessd_simulator::random::Stream;

/// Largest standard deviation of the gain of a taxel, a row or a column, and of the whole frame.
const GAIN_TAXEL: f64 = 0.16;
const GAIN_LINE: f64 = 0.05;
const GAIN_FRAME: f64 = 0.10;
/// Largest share of its force that a taxel takes from each of its four neighbours.
const CROSSTALK: f64 = 0.04;
/// Standard deviation of the noise: a share of the force, and newtons.
const NOISE: (f64, f64) = (0.015, 0.012);
/// Range of the activation threshold, newtons.
const THRESHOLD_N: (f64, f64) = (0.03, 0.2);
/// Largest share of dead taxels.
const DEAD: f64 = 0.01;

/// Draws one disturbed variant of `frame`.
pub fn disturbed(frame: &ModelFrame, stream: &mut Stream) -> ModelFrame {
    let mut spread = |most: f64| most * stream.uniform();
    let (taxel, line, whole) = (spread(GAIN_TAXEL), spread(GAIN_LINE), spread(GAIN_FRAME));
    let (crosstalk, dead) = (spread(CROSSTALK), spread(DEAD));
    let threshold_n = stream.range(THRESHOLD_N.0, THRESHOLD_N.1) as f32;
    let gain = |stream: &mut Stream, deviation: f64| (deviation * stream.normal()).exp() as f32;
    let whole = gain(stream, whole);
    let rows: Vec<f32> = (0..ROWS).map(|_| gain(stream, line)).collect();
    let columns: Vec<f32> = (0..COLS).map(|_| gain(stream, line)).collect();

    let mut image = mixed(frame, crosstalk as f32);
    for (place, newtons) in image.newtons.iter_mut().enumerate() {
        let gains = whole * rows[place / COLS] * columns[place % COLS] * gain(stream, taxel);
        let noise = NOISE.0 * f64::from(*newtons) * stream.normal() + NOISE.1 * stream.normal();
        let force_n = *newtons * gains + noise as f32;
        *newtons = if *newtons > 0.0 && force_n >= threshold_n {
            (force_n / NEWTONS_PER_COUNT).round() * NEWTONS_PER_COUNT
        } else {
            0.0
        };
    }
    let is_dead: Vec<bool> = (0..TAXELS).map(|_| stream.uniform() < dead).collect();
    filled(&image, &is_dead)
}

/// Each taxel after it gave `share` of its force to each of its neighbours.
fn mixed(frame: &ModelFrame, share: f32) -> ModelFrame {
    let mut image = *frame;
    for place in 0..TAXELS {
        let given: f32 = neighbours(place).map(|other| frame.newtons[other]).sum();
        image.newtons[place] = frame.newtons[place] * (1.0 - 4.0 * share) + share * given;
    }
    image
}

/// The frame with each dead taxel replaced by the mean of the live taxels beside it. `tare` takes the
/// diagonal ones too.
fn filled(frame: &ModelFrame, is_dead: &[bool]) -> ModelFrame {
    let mut image = *frame;
    for place in (0..TAXELS).filter(|&place| is_dead[place]) {
        let live: Vec<f32> = neighbours(place)
            .filter(|&other| !is_dead[other])
            .map(|other| frame.newtons[other])
            .collect();
        image.newtons[place] = live.iter().sum::<f32>() / live.len().max(1) as f32;
    }
    image
}

/// Indices of the taxels beside a taxel in its row and column.
fn neighbours(place: usize) -> impl Iterator<Item = usize> {
    let (row, column) = (place / COLS, place % COLS);
    [
        (row > 0).then(|| place - COLS),
        (row + 1 < ROWS).then(|| place + COLS),
        (column > 0).then(|| place - 1),
        (column + 1 < COLS).then(|| place + 1),
    ]
    .into_iter()
    .flatten()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pressed() -> ModelFrame {
        let mut frame = ModelFrame::default();
        for row in 10..16 {
            for column in 8..14 {
                frame.newtons[row * COLS + column] = 0.6;
            }
        }
        frame
    }

    #[test]
    fn force_and_place_stay_within_what_a_sensor_changes() {
        let frame = pressed();
        for index in 0..200 {
            let variant = disturbed(&frame, &mut Stream::new(1, "test").child(index));
            let ratio = variant.force_n() / frame.force_n();
            assert!((0.5..1.8).contains(&ratio), "{index}: {ratio}");
            let far = variant.newtons[..8 * COLS].iter().sum::<f32>();
            assert_eq!(far, 0.0, "{index}");
            let counts = variant.newtons.map(|n| n / NEWTONS_PER_COUNT);
            let live = counts.iter().filter(|n| (*n - n.round()).abs() < 1e-3);
            assert!(live.count() > TAXELS - 30, "{index}");
        }
    }

    #[test]
    fn the_same_stream_gives_the_same_variant() {
        let draw = |seed| disturbed(&pressed(), &mut Stream::new(seed, "test"));
        assert!(draw(3) == draw(3));
        assert!(draw(3) != draw(4));
    }
}
