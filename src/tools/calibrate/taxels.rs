//! Computes a gain for each taxel from an even pressure on the whole array.
//!
//! In each frame of such a press, a taxel is compared with the array's median. The scale that all taxels
//! share belongs to `newtons_per_count`.

use anyhow::{Result, ensure};

use hardnessd_core::frame::Pitch;

/// The gains that presses give.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Fit {
    /// The factor for each taxel's newtons, `[rows, cols]` of the array. `None` where nothing is known.
    pub(super) gains: Vec<Option<f32>>,
    /// The number of presses that loaded the whole array.
    pub(super) presses: usize,
    /// Standard deviation of the logarithm of the gains.
    pub(super) spread: f64,
    /// The relative error of a gain: half of the standard deviation of the difference between
    /// two halves of the presses.
    pub(super) error: f64,
}

/// A taxel of 3.5 mm pitch is loaded well from this force on, five counts of 0.04 N, and others in proportion to
/// their area.
const LEAST_N: f64 = 0.2;
/// A press loads the whole array if this share of its taxels is loaded well.
const WHOLE_SHARE: f64 = 0.9;

impl Fit {
    /// Computes the gains from presses, each of them frames with the newtons that each taxel would read with a
    /// gain of 1. The newtons of a dead taxel are no measurement.
    pub(super) fn of(presses: &[Vec<Vec<f32>>], is_dead: &[bool], pitch: Pitch) -> Result<Self> {
        let least_n = (LEAST_N * pitch.area_mm2() / Pitch::JX255N.area_mm2()) as f32;
        let whole = presses
            .iter()
            .filter_map(|frames| compare(frames, is_dead, least_n));
        let whole: Vec<Vec<Option<f64>>> = whole.collect();
        ensure!(
            whole.len() > 1,
            "{} of {} presses loaded the whole array, expected at least 2: lay a bag of air or water on all of \
             it, and press that through a plate, harder",
            whole.len(),
            presses.len()
        );
        let logs = medians(&whole.iter());
        let halves = [0, 1].map(|first| medians(&whole.iter().skip(first).step_by(2)));
        let apart = halves[0].iter().zip(&halves[1]);
        let apart = apart.filter_map(|(one, other)| Some((*one)? - (*other)?));
        Ok(Self {
            presses: whole.len(),
            spread: deviation(logs.iter().flatten().copied()),
            error: 0.5 * deviation(apart),
            gains: logs
                .iter()
                .map(|log| log.map(|log| (-log).exp() as f32))
                .collect(),
        })
    }
}

/// The logarithm of each live taxel's newtons over the array's median: the median over the frames that load the
/// whole array. `None` if there is no such frame.
fn compare(frames: &[Vec<f32>], is_dead: &[bool], least_n: f32) -> Option<Vec<Option<f64>>> {
    let live = is_dead.iter().filter(|is_dead| !**is_dead).count();
    let logs = frames.iter().filter_map(|frame| {
        let log = |(&newtons, is_dead): (&f32, &bool)| {
            (!is_dead && newtons >= least_n).then(|| f64::from(newtons).ln())
        };
        let logs: Vec<Option<f64>> = frame.iter().zip(is_dead).map(log).collect();
        let loaded: Vec<f64> = logs.iter().flatten().copied().collect();
        let is_whole = loaded.len() as f64 >= WHOLE_SHARE * live as f64;
        let middle = median(loaded).filter(|_| is_whole)?;
        Some(
            logs.into_iter()
                .map(|log| log.map(|log| log - middle))
                .collect(),
        )
    });
    let logs: Vec<Vec<Option<f64>>> = logs.collect();
    (!logs.is_empty()).then(|| medians(&logs.iter()))
}

/// The median of each taxel over those that know it.
fn medians<'a>(all: &(impl Iterator<Item = &'a Vec<Option<f64>>> + Clone)) -> Vec<Option<f64>> {
    let taxels = all.clone().map(Vec::len).max().unwrap_or(0);
    let median = |place: usize| median(all.clone().filter_map(|one| one[place]).collect());
    (0..taxels).map(median).collect()
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let middle = values.len() / 2;
    match values.len() {
        0 => None,
        odd if odd % 2 == 1 => Some(values[middle]),
        _ => Some(0.5 * (values[middle - 1] + values[middle])),
    }
}

fn deviation(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let count = values.clone().count().max(1) as f64;
    let mean = values.clone().sum::<f64>() / count;
    (values.map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_simulator::random::Stream;

    const TAXELS: usize = 120;

    /// The sensitivity of a taxel.
    fn uneven(place: usize) -> f32 {
        (1.0 + 0.15 * Stream::new(5, "gains").child(place as u64).normal()) as f32
    }

    #[test]
    fn an_even_pressure_says_all_gains_but_those_of_dead_taxels() {
        // One taxel is known to be dead, and another one is.
        let (known, dead) = (77, 34);
        let mut noise = Stream::new(4, "noise");
        let mut frame = |level: f32| -> Vec<f32> {
            let newtons = |place: usize| match place {
                77 | 34 => 0.0,
                _ => level * uneven(place) * (1.0 + 0.01 * noise.normal() as f32),
            };
            (0..TAXELS).map(newtons).collect()
        };
        let presses: Vec<_> = (0..6)
            .map(|_| vec![frame(0.1), frame(1.0), frame(2.0)])
            .collect();
        let is_dead: Vec<bool> = (0..TAXELS).map(|place| place == known).collect();
        let fit = Fit::of(&presses, &is_dead, Pitch::JX255N).unwrap();
        assert_eq!(
            (fit.presses, fit.gains[known], fit.gains[dead]),
            (6, None, None)
        );
        let gains = fit.gains.iter().enumerate();
        let left = gains.filter_map(|(place, gain)| Some(f64::from((*gain)? * uneven(place)).ln()));
        let left = deviation(left);
        assert!(left < 0.01, "{left}");
        assert!((0.1..0.2).contains(&fit.spread), "{}", fit.spread);
        assert!(fit.error > 1e-4 && fit.error < 0.01, "{}", fit.error);

        let half = presses[0].iter().map(|frame| frame[..60].repeat(2));
        let half = half.map(|mut frame: Vec<f32>| {
            frame[60..].fill(0.0);
            frame
        });
        let presses = [presses[0].clone(), half.collect()];
        let error = Fit::of(&presses, &is_dead, Pitch::JX255N).unwrap_err();
        assert!(
            error
                .to_string()
                .starts_with("1 of 2 presses loaded the whole array")
        );
    }
}
