//! The newtons of a count, so that a tare passes and noise is no touch.
//!
//! In: a layout and all the bytes. Out: guesses for `[sensor.calibration]` and `[press]`.

use hardnessd_core::frame::Pitch;
use hardnessd_core::tare::{self, NEWTONS_PER_COUNT};
use hardnessd_core::wire::Settings;

use crate::layout::decode;
use crate::pictures::{distance, middle};

/// What to write beside the layout. What is `None` may be left out.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Scale {
    /// Newtons of a count.
    pub newtons_per_count: Option<f32>,
    /// The difference from the other taxels at which a tare refuses.
    pub tare_max_n: Option<f32>,
    /// The newtons at which a taxel is in contact.
    pub contact_threshold_n: Option<f32>,
    /// The largest count.
    pub most_counts: f32,
    /// By how many counts a taxel at rest varies.
    pub noise_counts: f32,
}

/// One in so many frames is quiet, that with the smallest change.
const QUIET: usize = 4;
/// A tare at rest has at most so many times the noise of a usual quiet one, by chance or by drift. In a press the
/// noise is many times as large. All tares at rest must pass, not only most.
const CALM: f32 = 2.5;
/// As many taxels in contact begin a press, and as many may be touched in a tare.
const TAXELS: usize = 3;
/// As many frames make a tare.
const TARE_FRAMES: usize = 5;
/// The most frames that are looked at.
const MOST_FRAMES: usize = 4000;
/// Noise, and what taxels differ by at rest, are at most this share of the thresholds.
const SMALL: f32 = 0.6;
/// The largest value that a configuration may have.
const MOST_NEWTONS_PER_COUNT: f32 = 1000.0;
/// A press has at least so many newtons at its deepest taxel.
const LEAST_PRESS_N: f32 = 1.0;

impl Scale {
    /// The scale for the frames in `bytes`.
    pub fn of(settings: &Settings, bytes: &[u8]) -> Self {
        let mut frames: Vec<Vec<f32>> = Vec::new();
        decode(settings, bytes, |frame| {
            if frames.len() < MOST_FRAMES {
                frames.push(frame.counts.into_vec());
            }
        });
        if frames.is_empty() {
            return Self::default();
        }
        // Most frames may be pressed, but hardly at the same taxel.
        let rest = middle(&frames);
        let changes: Vec<f64> = frames.iter().map(|frame| distance(frame, &rest)).collect();
        let mut sorted = changes.clone();
        sorted.sort_by(f64::total_cmp);
        let most = sorted[sorted.len() / QUIET];
        let quiet = frames.iter().zip(changes);
        let quiet = quiet.filter(|(_, change)| *change <= most);
        let quiet: Vec<Vec<f32>> = quiet.map(|(frame, _)| frame.clone()).collect();
        let rest = middle(&quiet);
        // Damage makes one taxel of a frame larger.
        let most_counts = frames
            .iter()
            .map(|frame| third(frame.clone()))
            .fold(f32::MIN, f32::max);
        let above = |frame: &Vec<f32>| {
            let taxels = frame.iter().zip(&rest);
            third(
                taxels
                    .map(|(count, rest)| (count - rest).max(0.0))
                    .collect(),
            )
        };
        let press = frames.iter().map(above).fold(0.0, f32::max);
        // What the third largest taxel varies by while a tare is taken.
        let varies = |tare: &[Vec<f32>]| {
            let of_taxel = |taxel: usize| {
                let counts = tare.iter().map(|frame| frame[taxel]);
                counts.clone().fold(f32::MIN, f32::max) - counts.fold(f32::MAX, f32::min)
            };
            third((0..rest.len()).map(of_taxel).collect())
        };
        let mut quiet_noises: Vec<f32> = quiet.chunks(TARE_FRAMES).map(varies).collect();
        quiet_noises.sort_by(f32::total_cmp);
        let usual = quiet_noises[quiet_noises.len() / 2];
        // The largest, so that every tare at rest passes. In a press it is larger still.
        let tares = frames.chunks(TARE_FRAMES).map(varies);
        let noise = tares
            .filter(|noise| *noise <= CALM * usual)
            .fold(usual, f32::max);
        let mut sorted = rest.clone();
        sorted.sort_by(f32::total_cmp);
        let median = sorted[sorted.len() / 2];
        let offset = third(rest.iter().map(|rest| (rest - median).max(0.0)).collect());

        let (threshold, tare_max) = (
            Pitch::JX255N.contact_threshold_n(),
            tare::Settings::default().tare_max_n,
        );
        // Counts that are finer than a byte get fewer newtons: full scale is as many as that of a byte.
        let full_scale = match frames.iter().flatten().all(|count| count.fract() == 0.0) {
            true => (most_counts.max(255.0) + 1.0).log2().ceil().exp2() - 1.0,
            // Volts, newtons and their like.
            false => most_counts.max(press),
        };
        let by_scale = NEWTONS_PER_COUNT * f32::from(u8::MAX) / full_scale.max(f32::MIN_POSITIVE);
        let by_noise = SMALL * threshold / noise.max(f32::MIN_POSITIVE);
        let by_offset = SMALL * tare_max / offset.max(f32::MIN_POSITIVE);
        let least = LEAST_PRESS_N / press.max(f32::MIN_POSITIVE).max(full_scale / 255.0);
        let newtons = by_scale
            .min(by_noise.min(by_offset).max(least))
            .min(MOST_NEWTONS_PER_COUNT);
        let above = |value: f32, default: f32| (value > default * 1.001).then_some(value);
        Self {
            newtons_per_count: ((newtons / NEWTONS_PER_COUNT - 1.0).abs() > 0.001)
                .then_some(newtons),
            tare_max_n: above(offset * newtons / SMALL, tare_max),
            contact_threshold_n: above(noise * newtons / SMALL, threshold),
            most_counts,
            noise_counts: noise,
        }
    }
}

/// The third largest: one fewer than touch the sensor.
fn third(mut values: Vec<f32>) -> f32 {
    values.sort_by(f32::total_cmp);
    values
        .iter()
        .rev()
        .nth(TAXELS - 1)
        .or(values.first())
        .copied()
        .unwrap_or(0.0)
}
