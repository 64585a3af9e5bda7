//! The design of a sensor: what its instances have in common.
//!
//! [`Design::jx255n`] is the array of the paper. [`Design::broad`] draws one of many.

use super::SensorProfile;
use crate::random::{Stream, log_even};
use crate::{CELL_MM, CELLS};
use hardnessd_core::frame::{Array, MOST_SIDE, Pitch};
use hardnessd_core::tare::NEWTONS_PER_COUNT;

/// What the instances of a sensor have in common. Forces are in newtons on a taxel.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Design {
    pub(crate) array: Array,
    pub(crate) pitch_mm: f64,
    /// Width of a taxel's sensitive area.
    pub(super) active_mm: f64,
    /// Depth of the film under the cover's surface.
    pub(super) depth_mm: f64,
    pub(super) response: Response,
    /// Film creep, as share and time constant in s.
    pub(super) creep: [(f32, f32); 2],
    /// Time constant of the film's delay, s.
    pub(super) lag_s: f32,
    /// The greatest share that an unloading taxel reads too much.
    pub(super) hysteresis: f32,
    /// The share of its force that a taxel gives to each of its four neighbours, through the cover.
    pub(super) crosstalk_neighbour: f32,
    /// The share of its force that the loaded taxels of its row and column read.
    pub(super) crosstalk_line: f32,
    /// Standard deviation of the noise as a share of the force, and in newtons.
    pub(super) noise_ratio: f64,
    pub(super) noise_n: f64,
    pub(super) dead_share: f64,
    /// Where every taxel reads something without load. `None` for a film whose layers do not touch
    /// below an activation threshold: it reads exactly 0.
    pub(super) rest: Option<Rest>,
    /// Median and greatest of the lognormal activation thresholds. The greatest is at 3 sigma.
    pub(super) threshold_median_n: f64,
    pub(super) threshold_bound_n: f64,
    /// The newtons of a count of a sensor whose response is linear.
    pub(super) count_n: f32,
    pub(super) full_scale_counts: u16,
    /// Fewer counts are read as 0.
    pub(super) least_counts: f32,
    pub(super) spread: Spread,
}

/// The counts of taxels without load: their mean and the standard deviation between taxels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rest {
    pub(super) counts: f64,
    pub(super) spread: f64,
}

/// The reading of a taxel under a force, before its gain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Response {
    Linear,
    /// A power of the force. It reads `unit_n` at `unit_n`.
    Power {
        exponent: f32,
        unit_n: f32,
    },
    /// The reading rises to `most_n`, which it never reaches.
    Levels {
        most_n: f32,
    },
    /// The reading falls again when the force rises above twice `most_n`, the greatest reading.
    Falls {
        most_n: f32,
    },
}

impl Response {
    pub(super) fn of(self, force_n: f32) -> f32 {
        match self {
            Response::Linear => force_n,
            Response::Power { exponent, unit_n } => unit_n * (force_n / unit_n).powf(exponent),
            Response::Levels { most_n } => force_n / (1.0 + force_n / most_n),
            Response::Falls { most_n } => {
                let half = 0.5 * force_n / most_n;
                force_n / (1.0 + half * half)
            }
        }
    }
}

/// Relative standard deviations of the gains, per taxel, row, column and press.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Spread {
    pub(super) taxel: f64,
    pub(super) row: f64,
    pub(super) column: f64,
    pub(super) press: f64,
}

impl SensorProfile {
    fn spread(self) -> Spread {
        match self {
            SensorProfile::Clean => Spread {
                taxel: 0.06,
                row: 0.03,
                column: 0.03,
                press: 0.0,
            },
            SensorProfile::Raw => Spread {
                taxel: 0.16,
                row: 0.03,
                column: 0.055,
                press: 0.10,
            },
        }
    }
}

/// The distances between the taxels of broad designs, mm.
pub(crate) const BROAD_PITCHES_MM: [f64; 2] = [2.0, 7.0];
/// Thickness of the foil over the film.
const FOIL_MM: f64 = 0.3;
/// The probabilities of the responses: linear, a power, one that levels. The others fall.
const RESPONSES: [f64; 3] = [0.2, 0.35, 0.35];
/// The share of the arrays without an activation threshold, whose every taxel has noise.
const RESTLESS_SHARE: f64 = 0.5;
/// The share of the arrays that are smaller than the cells' 98 mm.
const SMALL_SHARE: f64 = 0.25;
/// The least width of an array in mm. A smaller one would lose most presses over its border.
const LEAST_WIDTH_MM: f64 = 50.0;
/// Sensors with smaller counts than this have 12 bits, the others 8. Less would not hold a press.
const COARSE_COUNT_N: f64 = 0.04;

impl Design {
    /// The simulated JX255N.
    pub(crate) fn jx255n(profile: SensorProfile) -> Self {
        Self {
            array: Array::JX255N,
            pitch_mm: Pitch::JX255N.rows_mm,
            active_mm: 3.0,
            depth_mm: 1.0,
            response: Response::Linear,
            creep: [(0.03, 0.4), (0.04, 8.0)],
            lag_s: 0.0,
            hysteresis: 0.0,
            crosstalk_neighbour: 0.015,
            crosstalk_line: 0.004,
            noise_ratio: 0.015,
            noise_n: 0.012,
            dead_share: 0.003,
            rest: None,
            // The bound is the paper's "minimum discrimination" of 0.2 N, for every taxel.
            threshold_median_n: 0.05,
            threshold_bound_n: 0.2,
            count_n: NEWTONS_PER_COUNT,
            full_scale_counts: super::FULL_SCALE_COUNTS,
            // A reading of one count becomes 0.
            least_counts: 2.0,
            spread: profile.spread(),
        }
    }

    /// A reading as whole counts.
    pub(super) fn counts(&self, read: f32) -> f32 {
        read.round().clamp(0.0, f32::from(self.full_scale_counts))
    }

    /// How long the film is not settled after its load has gone, s.
    pub(crate) fn settled_s(&self) -> f64 {
        5.0 * f64::from(self.lag_s)
    }

    /// Draws the design of a sensor under a cover of this thickness. The ranges of forces are those of a
    /// taxel 3.5 mm wide; wider taxels have more, by area. `results/simulator.md` gives the sources.
    pub(crate) fn broad(cover_mm: f64, stream: &mut Stream) -> Self {
        let pitch_mm = log_even(BROAD_PITCHES_MM, stream);
        let area = (pitch_mm / Pitch::JX255N.rows_mm).powi(2);
        let whole = CELLS as f64 * CELL_MM;
        let is_small = stream.uniform() < SMALL_SHARE;
        let width_mm = stream.range(LEAST_WIDTH_MM, whole);
        let side = (if is_small { width_mm } else { whole } / pitch_mm).round() as usize;
        let side = side.min(MOST_SIDE);
        let kind = stream.uniform();
        let exponent = log_even([0.6, 1.7], stream) as f32;
        let most_n = (area * log_even([1.5, 30.0], stream)) as f32;
        let [linear, power, levels] = RESPONSES;
        let response = if kind < linear {
            Response::Linear
        } else if kind < linear + power {
            let unit_n = area as f32;
            Response::Power { exponent, unit_n }
        } else if kind < linear + power + levels {
            Response::Levels { most_n }
        } else {
            Response::Falls { most_n }
        };
        let threshold_n = area * log_even([0.01, 0.25], stream);
        // The spread of the thresholds' logarithms.
        let sigma = stream.range(0.15, 0.5);
        let count_n = log_even([0.005, 0.1], stream);
        let full_scale_counts = if count_n < COARSE_COUNT_N { 4095 } else { 255 };
        let mut of_rest = stream.child(0);
        let counts = f64::from(full_scale_counts) * log_even([0.002, 0.075], &mut of_rest);
        let rest = Rest {
            counts,
            spread: counts * of_rest.range(0.05, 0.5),
        };
        let is_restless = of_rest.uniform() < RESTLESS_SHARE;
        let active_mm = pitch_mm * stream.range(0.6, 1.0);
        // The stiff base of a thin cover keeps stress from spreading as far as in a thick one.
        let depth_mm = FOIL_MM + cover_mm * log_even([0.3, 1.0], stream);
        let mut creep = |share: [f64; 2], tau_s: [f64; 2]| {
            let share = stream.range(share[0], share[1]) as f32;
            (share, log_even(tau_s, stream) as f32)
        };
        Self {
            rest: is_restless.then_some(rest),
            array: Array {
                rows: side,
                cols: side,
            },
            pitch_mm,
            active_mm,
            depth_mm,
            response,
            creep: [
                creep([0.0, 0.08], [0.2, 1.0]),
                creep([0.0, 0.1], [4.0, 16.0]),
            ],
            lag_s: stream.range(0.0, 0.08) as f32,
            hysteresis: stream.range(0.0, 0.3) as f32,
            crosstalk_neighbour: stream.range(0.0, 0.04) as f32,
            crosstalk_line: stream.range(0.0, 0.01) as f32,
            noise_ratio: log_even([0.003, 0.03], stream),
            noise_n: area * log_even([0.002, 0.04], stream),
            dead_share: stream.range(0.0, 0.02),
            threshold_median_n: threshold_n,
            threshold_bound_n: threshold_n * (3.0 * sigma).exp(),
            count_n: (area * count_n) as f32,
            full_scale_counts,
            least_counts: if stream.uniform() < 0.5 { 1.0 } else { 2.0 },
            spread: Spread {
                taxel: stream.range(0.02, 0.2),
                row: stream.range(0.0, 0.06),
                column: stream.range(0.0, 0.06),
                press: stream.range(0.0, 0.16),
            },
        }
    }
}
