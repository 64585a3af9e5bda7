//! Computes the arm's stiffness and the delay of its stamps from presses on something rigid.
//!
//! The way of the arm over force is nearly a line, whose slope comes from what gives way behind the
//! sensor's face. With the right delay, the arm returns on the same line. With another delay, there is
//! a loop.

use anyhow::{Context as _, Result, bail};

use super::gather::Press;
use hardnessd_core::line::{Sums, extent};

/// A value, and its least and greatest over single presses.
pub(super) type Spread = (f64, [f64; 2]);

/// The values that presses give.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Fit {
    /// The number of presses.
    pub(super) presses: usize,
    /// The least and the greatest peak force of the presses, in newtons.
    pub(super) force_n: [f64; 2],
    pub(super) n_per_mm: Spread,
    pub(super) delay_ms: Spread,
    /// Root mean square of the distance from the line.
    pub(super) residual_mm: f64,
}

/// The least and the greatest delay that are tried.
const DELAYS_MS: (f64, f64) = (-300.0, 600.0);
/// The step between delays.
const STEP_MS: f64 = 2.0;
/// Frames with a smaller share of a press's peak force depend on the cover alone.
const FAIR_SHARE: f64 = 0.2;
/// The slope comes from frames with at least this share of a press's peak force.
const STEEP_SHARE: f64 = 0.5;
/// Fewer frames than this cannot determine four numbers and a spread.
const LEAST_FRAMES: usize = 8;
/// If a delay is wrong by `WRONG_MS`, the distance from the line must be more than `GROWN` times
/// as large as at the best delay. Otherwise, the delay is unknown.
const WRONG_MS: f64 = 150.0;
const GROWN: f64 = 1.3;

impl Press {
    /// Way and force of the frames with at least `share` of the press's peak force. `None` unless
    /// the positions at all frames are known.
    fn points(&self, delay_ms: f64, share: f64) -> Option<Vec<(f64, f64)>> {
        let begin = *self.moments.first()?;
        let way = self.track.approach(begin, &self.moments, delay_ms)?;
        let enough = share * self.force_n();
        let known = way.into_iter().collect::<Option<Vec<f64>>>()?;
        let points = known.into_iter().zip(self.forces_n.iter().copied());
        Some(points.filter(|&(_, force)| force >= enough).collect())
    }

    fn force_n(&self) -> f64 {
        self.forces_n.iter().copied().fold(0.0, f64::max)
    }

    fn is_known(&self) -> bool {
        [DELAYS_MS.0, DELAYS_MS.1]
            .into_iter()
            .all(|delay_ms| self.points(delay_ms, 0.0).is_some())
    }
}

impl Fit {
    /// Computes the values from `presses`.
    pub(super) fn of(presses: &[Press]) -> Result<Self> {
        let known: Vec<&Press> = presses.iter().filter(|press| press.is_known()).collect();
        if known.len() < 2 {
            bail!(
                "only {} of {} presses have positions of the arm from before their begin until after \
                 their end: does the robot send them to the control socket of this configuration?",
                known.len(),
                presses.len()
            );
        }
        let fair = |press: &&Press| {
            press
                .points(0.0, FAIR_SHARE)
                .map_or(0, |points| points.len())
        };
        let found: usize = known.iter().map(fair).sum();
        if found < LEAST_FRAMES {
            bail!(
                "only {found} frames with a fair force in {} presses: press more slowly, harder or more \
                 often",
                known.len()
            );
        }
        let (delay_ms, residual_mm) = best_delay(&known);
        let wrong = [delay_ms - WRONG_MS, delay_ms + WRONG_MS]
            .into_iter()
            .filter_map(|delay_ms| residual_mm_at(&known, delay_ms))
            .fold(f64::INFINITY, f64::min);
        if wrong <= GROWN * residual_mm {
            let way = known
                .iter()
                .filter_map(|press| press.points(delay_ms, 0.0))
                .flatten();
            let moved_mm = way.map(|(mm, _)| mm).fold(0.0, f64::max);
            bail!(
                "the delay cannot be told: the arm went {moved_mm:.2} mm while the sensor was pressed. \
                 Press deeper, and keep the arm moving"
            );
        }
        let (least, most) = DELAYS_MS;
        if [least, most].contains(&delay_ms) {
            bail!(
                "no delay from {least} to {most} ms fits: the best is {delay_ms:.0} ms or beyond. Do the \
                 stamps of the positions come from a clock that agrees with the clock of this machine?"
            );
        }
        let n_per_mm = slope(&known, delay_ms).context(
            "the force does not grow with the way of the arm: do positions grow towards the object?",
        )?;
        let one = |press: &&Press| {
            let alone = [*press];
            let delay_ms = match fair(press) >= LEAST_FRAMES {
                true => best_delay(&alone).0,
                false => delay_ms,
            };
            (delay_ms, slope(&alone, delay_ms).unwrap_or(n_per_mm))
        };
        let alone: Vec<(f64, f64)> = known.iter().map(one).collect();
        let spread = |value: f64, of: fn(&(f64, f64)) -> f64| {
            let least = alone.iter().map(of).fold(value, f64::min);
            (value, [least, alone.iter().map(of).fold(value, f64::max)])
        };
        Ok(Self {
            presses: known.len(),
            force_n: extent(known.iter().map(|press| press.force_n())),
            n_per_mm: spread(n_per_mm, |one| one.1),
            delay_ms: spread(delay_ms, |one| one.0),
            residual_mm,
        })
    }
}

/// The delay with which the presses are nearest to one line, and their distance from it in mm.
fn best_delay(presses: &[&Press]) -> (f64, f64) {
    let (least, most) = DELAYS_MS;
    let delays = (0..=((most - least) / STEP_MS) as u32).map(|n| least + f64::from(n) * STEP_MS);
    let tried = delays.filter_map(|ms| Some((ms, residual_mm_at(presses, ms)?)));
    let best = tried.min_by(|one, other| one.1.total_cmp(&other.1));
    best.unwrap_or((0.0, f64::INFINITY))
}

/// Root mean square distance of the way from a line over force. Each press has its own zero.
fn residual_mm_at(presses: &[&Press], delay_ms: f64) -> Option<f64> {
    let sums = sums(presses, delay_ms, FAIR_SHARE)?;
    let explained = if sums.yy > 0.0 {
        sums.xy * sums.xy / sums.yy
    } else {
        0.0
    };
    Some(((sums.xx - explained).max(0.0) / sums.count).sqrt())
}

/// The slope of force over way, in N/mm. Each press has its own zero.
fn slope(presses: &[&Press], delay_ms: f64) -> Option<f64> {
    let sums = sums(presses, delay_ms, STEEP_SHARE)?;
    (sums.xy > 0.0 && sums.yy > 0.0).then(|| sums.yy / sums.xy)
}

/// The sums of way and force over the frames of all presses.
fn sums(presses: &[&Press], delay_ms: f64, share: f64) -> Option<Sums> {
    let mut all = Sums::default();
    for press in presses {
        let own = Sums::of(&press.points(delay_ms, share)?);
        all.count += own.count;
        all.xx += own.xx;
        all.xy += own.xy;
        all.yy += own.yy;
    }
    Some(all)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use hardnessd_core::motion::{Point, Track};

    /// A press of an arm of `n_per_mm` at 5 mm/s, to `depth_mm` and back, held for 0.4 s. Its
    /// stamps are `delay_ms` early. Frames come at `hz`, positions at 100 Hz.
    fn press(n_per_mm: f64, delay_ms: f64, depth_mm: f64, hz: f64) -> Press {
        let way = |time_s: f64| {
            let load_s = depth_mm / 5.0;
            let gone = 5.0 * (time_s - load_s - 0.4);
            (5.0 * time_s).min(depth_mm).min(depth_mm - gone)
        };
        // The cover gives way by 0.05 mm times the root of the force: by 0.1 mm at 4 N.
        let force = |mm: f64| {
            let root = (0.05_f64.powi(2) + 4.0 * mm / n_per_mm).sqrt() - 0.05;
            (0.5 * n_per_mm * root).powi(2)
        };
        let start_s = 10.0;
        let mut track = Track::default();
        for step in -100..400 {
            let time_s = f64::from(step) / 100.0;
            let at_ns = ((start_s + time_s - delay_ms / 1e3) * 1e9) as i64;
            track
                .push(&[Point {
                    at_ns,
                    mm: 7.0 + way(time_s),
                }])
                .unwrap();
        }
        let frames = (0..400).map(|n| (f64::from(n) + 0.3) / hz);
        let pressed = frames.take_while(|&time_s| way(time_s) > 0.0);
        let (moments, forces_n) = pressed
            .map(|time_s| {
                (
                    Duration::from_secs_f64(start_s + time_s),
                    force(way(time_s)),
                )
            })
            .unzip();
        Press {
            moments,
            forces_n,
            track,
            ..Press::default()
        }
    }

    #[test]
    fn stiffness_and_delay_are_found_at_any_rate() {
        for (n_per_mm, delay_ms, hz) in [
            (10.0, 68.6, 20.0),
            (3.0, 0.0, 100.0),
            (30.0, -40.0, 50.0),
            (8.0, 220.0, 5.0),
        ] {
            let presses =
                [1.0, 1.7, 2.4, 2.0].map(|mm| press(n_per_mm, delay_ms, mm * 10.0 / n_per_mm, hz));
            let fit = Fit::of(&presses).unwrap();
            assert_eq!(fit.presses, 4);
            assert!((fit.delay_ms.0 - delay_ms).abs() < 5.0, "{fit:?}");
            // The cover gives way too, even at half of 24 N, which lowers the stiffness found.
            let ratio = fit.n_per_mm.0 / n_per_mm;
            assert!((0.75..1.01).contains(&ratio), "{fit:?}");
            let (value, [least, most]) = fit.n_per_mm;
            assert!(least <= value && value <= most);
            assert!(fit.residual_mm < 0.02, "{fit:?}");
        }
    }

    #[test]
    fn presses_that_say_nothing_are_told_why() {
        let good = || press(10.0, 50.0, 2.0, 20.0);
        let mut mute = good();
        mute.track = Track::default();
        let check = |presses: &[Press], expected: &str| {
            let error = Fit::of(presses).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        };
        check(&[good(), mute], "only 1 of 2 presses have positions");
        let mut short = [good(), good()];
        for press in &mut short {
            press.moments.truncate(3);
            press.forces_n.truncate(3);
        }
        check(&short, "frames with a fair force in 2 presses");
        // The delay is far beyond those that are tried.
        for (delay_ms, tried_ms) in [(650.0, 600), (-340.0, -300)] {
            let late = [1.7, 2.4].map(|mm| press(10.0, delay_ms, mm, 20.0));
            check(&late, &format!("the best is {tried_ms} ms or beyond"));
        }
        for delay_ms in [590.0, -290.0] {
            let late = [1.7, 2.4].map(|mm| press(10.0, delay_ms, mm, 20.0));
            let fit = Fit::of(&late).unwrap();
            assert!((fit.delay_ms.0 - delay_ms).abs() < 5.0, "{fit:?}");
        }
        // The arm stands still while the force comes and goes.
        let mut still = [good(), good()];
        for press in &mut still {
            press.track = Track::default();
            for step in 0..1000 {
                let at_ns = 8_000_000_000 + step * 10_000_000;
                press.track.push(&[Point { at_ns, mm: 1.0 }]).unwrap();
            }
        }
        check(&still, "the arm went 0.00 mm");
    }
}
