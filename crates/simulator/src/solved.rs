//! One press over time with a prescribed motion, `z(t) = d + F / k_arm`.
//!
//! Loading and unloading are solved at chosen forces, and the time of each force follows from the
//! motion. In the hold, the solver seeks the force that keeps z. The state of each Kelvin element
//! carries creep from step to step. Pressure is taken as linear in time within a step, for which
//! the element's update is exact.

use super::motion::{Arm, Motion};
use super::press::{Bench, Specimen, Window, touches_border};
use super::sensor::Grid;
use super::substance::Law;

/// A press from touch to separation, as pressure under the cover. Sensors under the same cover may
/// feel the same press.
pub(super) struct SolvedPress {
    /// The solved moments, ascending in time from the touch.
    moments: Vec<SolvedStep>,
    window: Window,
    /// The arm's motion during the press.
    pub(super) motion: Motion,
    /// The greatest force, at the end of the approach.
    pub(super) force_n: f64,
}

/// A solved moment.
struct SolvedStep {
    time_s: f64,
    force_n: f64,
    /// Pressure on the window, MPa.
    pressure: Vec<f32>,
    /// Position z of the sensor's carrier, mm.
    travel_mm: f64,
    /// Radius of the contact.
    radius_mm: f64,
}

/// A press as the taxels of a grid feel it.
pub(super) struct FeltPress {
    /// Times, and the forces of the taxels in newtons. Forces are linear between them.
    moments: Vec<(f64, Vec<f32>)>,
}

/// The number of forces solved while loading, and while unloading. With twice as many, less of the
/// force lies elsewhere than noise moves (1.5 %).
const LEVELS: u32 = 14;
/// The number for a flat face, which touches as a whole early on (3 %).
const FLAT_LEVELS: u32 = 8;
/// Exponent of the spacing of the forces. They are denser at the touch, where the contact grows
/// fastest.
const SPACING: f64 = 1.7;
/// Times of the hold that are solved, s. They are denser at first, where creep is fastest.
const HOLD_S: [f64; 9] = [0.03, 0.07, 0.14, 0.25, 0.4, 0.6, 0.85, 1.15, 1.5];
/// Of these, every second is solved for a flat face.
const FLAT_HOLDS: usize = 2;
/// Tolerance of the position in the hold, as a part of the force.
const HOLD_TOLERANCE: f64 = 1e-3;

impl SolvedPress {
    /// Presses to `force_n`, holds the position for `hold_s` and withdraws.
    pub(super) fn new(
        bench: &mut Bench,
        specimen: &Specimen,
        arm: Arm,
        force_n: f64,
        hold_s: f64,
    ) -> Self {
        // The contact is largest at the end of the hold, when everything has crept.
        let (mut window, _, _) = bench.press(specimen, force_n, 1.0, hold_s);
        loop {
            let mut run = Run::new(bench, specimen, arm, window);
            run.step_to_forces(run.levels(force_n), 1.0);
            let motion = Motion {
                top_mm: run.last().travel_mm,
                load_s: run.last().time_s,
                hold_s,
                speed_mm_s: arm.speed_mm_s,
            };
            run.hold(hold_s);
            run.unload();
            let (moments, fits) = (run.moments, run.fits);
            match window.wider(specimen, bench.cover, force_n) {
                Some(wider) if !fits => window = wider,
                _ => {
                    return Self {
                        moments,
                        window,
                        motion,
                        force_n,
                    };
                }
            }
        }
    }

    /// Time from touch to separation, s.
    pub(super) fn duration_s(&self) -> f64 {
        self.moments.last().map_or(0.0, |moment| moment.time_s)
    }

    /// The press on the taxels of `grid`.
    pub(super) fn felt(&self, grid: &Grid) -> FeltPress {
        let moment = |step: &SolvedStep| {
            let taxels_n = grid.taxel_forces(&step.pressure, self.window);
            (step.time_s, taxels_n)
        };
        FeltPress {
            moments: self.moments.iter().map(moment).collect(),
        }
    }
}

impl FeltPress {
    /// The forces of the taxels in newtons, `time_s` after the touch; zero before and after the press.
    pub(super) fn at(&self, time_s: f64) -> Vec<f32> {
        let after = self.moments.partition_point(|&(at_s, _)| at_s <= time_s);
        if after == 0 || after == self.moments.len() {
            return vec![0.0; self.moments[0].1.len()];
        }
        let ((a_s, a), (b_s, b)) = (&self.moments[after - 1], &self.moments[after]);
        let part = (time_s - a_s) / (b_s - a_s);
        let taxels = a.iter().zip(b).map(|(a, b)| a + part as f32 * (b - a));
        taxels.collect()
    }
}

/// A press while it is computed, step by step.
struct Run<'a> {
    bench: &'a mut Bench,
    specimen: &'a Specimen,
    arm: Arm,
    window: Window,
    gap_mm: Vec<f32>,
    /// State of each Kelvin element, MPa.
    crept: Vec<Vec<f32>>,
    /// The displacement left by flow, mm.
    flowed_mm: Vec<f32>,
    /// The moments so far. The first is the touch.
    moments: Vec<SolvedStep>,
    fits: bool,
}

impl<'a> Run<'a> {
    fn new(bench: &'a mut Bench, specimen: &'a Specimen, arm: Arm, window: Window) -> Self {
        let cells = window.width * window.width;
        let creep = specimen.substance.creep();
        Self {
            bench,
            specimen,
            arm,
            window,
            gap_mm: specimen.gap_on(window),
            crept: creep.map(|_| vec![0.0; cells]).collect(),
            flowed_mm: vec![0.0; cells],
            moments: vec![SolvedStep {
                time_s: 0.0,
                force_n: 0.0,
                pressure: vec![0.0; cells],
                travel_mm: 0.0,
                radius_mm: 0.0,
            }],
            fits: true,
        }
    }

    fn last(&self) -> &SolvedStep {
        self.moments.last().expect("the touch is there")
    }

    /// The forces between the touch and `top_n`, at which a press is solved.
    fn levels(&self, top_n: f64) -> impl DoubleEndedIterator<Item = f64> + use<> {
        let count = match self.specimen.is_flat {
            true => FLAT_LEVELS,
            false => LEVELS,
        };
        (1..=count).map(move |level| top_n * (f64::from(level) / f64::from(count)).powf(SPACING))
    }

    fn unload(&mut self) {
        let levels = self.levels(self.last().force_n);
        self.step_to_forces(levels.rev().skip(1), -1.0);
        // The press ends where the sensor leaves the surface, with its creep and dents at that
        // time.
        let (gap, _) = self.effective_gap(0.0);
        let end_mm = f64::from(gap.iter().copied().fold(f32::INFINITY, f32::min));
        let last = self.last();
        let last_s = ((last.travel_mm - end_mm) / self.arm.speed_mm_s).max(LEAST_STEP_S);
        let end = SolvedStep {
            time_s: last.time_s + last_s,
            force_n: 0.0,
            pressure: vec![0.0; gap.len()],
            travel_mm: end_mm,
            radius_mm: 0.0,
        };
        self.moments.push(end);
    }

    /// Moves in `direction` from one force to the next. The time that this takes depends on the travel, and the
    /// travel, through creep, on the time. Two or three rounds settle both.
    fn step_to_forces(&mut self, goals_n: impl Iterator<Item = f64>, direction: f64) {
        // Of the first step we only know that it is short. The later guesses are the length of the
        // step before.
        let mut time_s = 0.05;
        for goal_n in goals_n {
            let (before_mm, before_s) = (self.last().travel_mm, self.last().time_s);
            let mut guess = self.guess(goal_n);
            for round in 1.. {
                let mut step = self.attempt(goal_n, time_s, guess);
                let needed_s = direction * (step.travel_mm - before_mm) / self.arm.speed_mm_s;
                let needed_s = needed_s.max(LEAST_STEP_S);
                let is_settled = (needed_s - time_s).abs() < 0.05 * needed_s;
                time_s = needed_s;
                if round == 3 || is_settled {
                    step.time_s = before_s + needed_s;
                    self.take(step, needed_s);
                    break;
                }
                guess = step.pressure;
            }
            time_s = (self.last().time_s - before_s).max(LEAST_STEP_S);
        }
    }

    /// A guess at the pressure under `force_n`: each cell goes on as between the last two moments.
    fn guess(&self, force_n: f64) -> Vec<f32> {
        let mut guess = self.last().pressure.clone();
        if let [_, .., before, last] = self.moments.as_slice()
            && before.force_n != last.force_n
        {
            let part = ((force_n - last.force_n) / (last.force_n - before.force_n)) as f32;
            for (guess, before) in guess.iter_mut().zip(&before.pressure) {
                *guess = (*guess + part * (*guess - before)).max(0.0);
            }
        }
        guess
    }

    /// Keeps z for `hold_s`, with forces from the secant method on `z(F)`.
    fn hold(&mut self, hold_s: f64) {
        let (keep_mm, start_s) = (self.last().travel_mm, self.last().time_s);
        let mut slope = {
            let [.., a, b] = self.moments.as_slice() else {
                unreachable!("a press is held after it was loaded");
            };
            self.arm.speed_mm_s * (b.time_s - a.time_s) / (b.force_n - a.force_n)
        };
        let step = if self.specimen.is_flat { FLAT_HOLDS } else { 1 };
        let until = HOLD_S.iter().copied().step_by(step);
        let until = until.take_while(|&at| at < hold_s - 0.01);
        for at in until.chain([hold_s]) {
            let last = self.last();
            let time_s = start_s + at - last.time_s;
            let mut trial = self.attempt(last.force_n, time_s, last.pressure.clone());
            for _ in 0..4 {
                let off = trial.travel_mm - keep_mm;
                if (off / slope).abs() < HOLD_TOLERANCE * trial.force_n {
                    break;
                }
                let next = (trial.force_n - off / slope).max(0.2 * trial.force_n);
                let (force_before, travel_before) = (trial.force_n, trial.travel_mm);
                trial = self.attempt(next, time_s, trial.pressure);
                let seen = (trial.travel_mm - travel_before) / (trial.force_n - force_before);
                if seen > 0.2 * slope && seen < 5.0 * slope {
                    slope = seen;
                }
            }
            self.take(trial, time_s);
        }
    }

    /// Solves a step of `time_s` that ends at `force_n`, from a guess at the pressure.
    fn attempt(&mut self, force_n: f64, time_s: f64, mut pressure: Vec<f32>) -> SolvedStep {
        let (gap, history) = self.effective_gap(time_s);
        let creep = self.specimen.substance.creep();
        let factor = 1.0 + creep.map(|c| c.j * share(time_s, c.tau_s)).sum::<f64>();
        let (specimen, window) = (self.specimen, self.window);
        let local = specimen.local(factor, &history, time_s);
        let bench = &mut self.bench;
        let contact = bench.solve(specimen, window, &gap, force_n, local, &mut pressure);
        SolvedStep {
            time_s: self.last().time_s + time_s,
            force_n,
            pressure,
            travel_mm: contact.approach_mm + force_n / self.arm.n_per_mm,
            radius_mm: contact.radius_mm,
        }
    }

    /// The gap with the creep and flow that earlier steps leave after another `time_s`, and the
    /// remaining part of the effective pressure, which the foam's law needs separately.
    fn effective_gap(&mut self, time_s: f64) -> (Vec<f32>, Vec<f32>) {
        let mut gap = self.gap_mm.clone();
        for (gap, &flowed) in gap.iter_mut().zip(&self.flowed_mm) {
            *gap += flowed;
        }
        let last = self.last();
        if last.time_s == 0.0 {
            return (gap, Vec::new());
        }
        let mut history = vec![0.0_f32; gap.len()];
        for (creep, crept) in self.specimen.substance.creep().zip(&self.crept) {
            let (kept, old) = left(time_s, creep.tau_s);
            let (kept, old) = ((creep.j * kept) as f32, (creep.j * old) as f32);
            for ((history, &crept), &pressure) in history.iter_mut().zip(crept).zip(&last.pressure)
            {
                *history += kept * crept + old * pressure;
            }
        }
        let (bench, specimen) = (&mut self.bench, self.specimen);
        let displacement = bench.displacement(specimen, self.window, &history);
        for (gap, u) in gap.iter_mut().zip(displacement) {
            *gap += u;
        }
        (gap, history)
    }

    /// Goes on to this moment, `time_s` after the last one.
    fn take(&mut self, step: SolvedStep, time_s: f64) {
        let last = self.moments.last().expect("the touch is there");
        for (creep, crept) in self.specimen.substance.creep().zip(&mut self.crept) {
            let (kept, old) = left(time_s, creep.tau_s);
            let new = share(time_s, creep.tau_s) as f32;
            let (kept, old) = (kept as f32, old as f32);
            for ((crept, &before), &now) in crept.iter_mut().zip(&last.pressure).zip(&step.pressure)
            {
                *crept = kept * *crept + old * before + new * now;
            }
        }
        if let Law::Plastic { .. } = self.specimen.substance.law {
            let flow = self.specimen.local(1.0, &[], time_s);
            for (k, (flowed, &pressure)) in
                self.flowed_mm.iter_mut().zip(&step.pressure).enumerate()
            {
                *flowed += flow.at(k, pressure, step.radius_mm).0;
            }
        }
        self.fits &= self.window.is_whole() || !touches_border(&step.pressure, self.window.width);
        self.moments.push(step);
    }
}

/// The least length of a step, so that time advances even where creep runs ahead of the motion.
const LEAST_STEP_S: f64 = 1e-3;

/// For a Kelvin element of time constant tau, `s' = (p - s) / tau`, under a pressure linear in time
/// over `t`: the share of the new pressure in the new state, `1 - (tau / t) (1 - exp(-t / tau))`.
fn share(time_s: f64, tau_s: f64) -> f64 {
    if time_s <= 0.0 {
        return 0.0;
    }
    let x = time_s / tau_s;
    1.0 + (-x).exp_m1() / x
}

/// For the same element: the shares of the old state and of the old pressure in the new state.
fn left(time_s: f64, tau_s: f64) -> (f64, f64) {
    let kept = (-time_s / tau_s).exp();
    (kept, 1.0 - kept - share(time_s, tau_s))
}

#[cfg(test)]
mod tests {
    use super::super::material::Material;
    use super::super::press::tests::ball;
    use super::*;

    #[test]
    fn an_element_keeps_to_its_closed_form_at_50_hz() {
        // z held by a spring 1/k in series with c (p + sum j s): with one element,
        // c (p + j s) + p / k = z, s' = (p - s) / tau gives
        // p = p0 (1 + b exp(-(1 + b) t / tau)) / (1 + b), p0 = z / (c + 1/k), b = j c / (c + 1/k).
        let (c, arm, j, tau, z) = (0.12, 0.1, 0.30, 0.2, 2.0);
        let b = j * c / (c + arm);
        let start = z / (c + arm);
        let (mut s, mut before, mut time) = (0.0, start, 0.0);
        let mut worst = 0.0_f64;
        for _ in 0..75 {
            let step = 0.02;
            let (kept, old) = left(step, tau);
            let history = kept * s + old * before;
            let now = (z - c * j * history) / (c + arm + c * j * share(step, tau));
            s = history + share(step, tau) * now;
            before = now;
            time += step;
            let expected = start * (1.0 + b * (-(1.0 + b) * time / tau).exp()) / (1.0 + b);
            worst = worst.max((now / expected - 1.0).abs());
        }
        assert!(worst < 1e-2, "relaxation off by {worst}");
    }

    #[test]
    fn force_relaxes_in_the_hold_as_creep_and_arm_say() {
        // Soft candy's compliance grows by up to 60 %, which the arm and the growing contact share.
        let ball = ball(Material::SoftCandy, 1.0);
        let course = SolvedPress::new(&mut Bench::default(), &ball, Arm::default(), 12.0, 1.5);
        let forces_n = course.moments.iter().map(|moment| moment.force_n);
        let top = forces_n.clone().fold(0.0, f64::max);
        let hold = forces_n.skip_while(|&force_n| force_n < top);
        let hold: Vec<f64> = hold.take(10).collect();
        assert!((top - 12.0).abs() < 1e-9);
        assert!(hold.is_sorted_by(|before, after| before > after));
        let kept = hold[9] / top;
        assert!((0.75..0.97).contains(&kept), "{kept} of the force is left");
    }
}
