//! One press in time: motion prescribed, `z(t) = d + F / k_arm` at 5 mm/s.
//!
//! Loading and unloading are solved at chosen forces, and the moment each is reached follows from
//! the motion; in the hold the force is sought that keeps z. Creep is carried from step to step as
//! the state of each Kelvin element; pressure is taken as linear in time within a step, for which
//! the element's update is exact.

use super::dataset::{ARM_N_MM, SPEED_MM_S};
use super::material::Law;
use super::press::{Bench, Specimen, Step, Window, touches_border};
use super::sensor::taxel_forces;
use crate::frame::TAXELS;

/// A press from touch to separation.
pub(super) struct Course {
    /// Seconds from the touch, ascending; forces are linear in between.
    moments: Vec<Moment>,
}

#[derive(Clone)]
struct Moment {
    time_s: f64,
    force_n: f64,
    taxels_n: [f32; TAXELS],
}

/// Forces solved at while loading, and while unloading.
const LEVELS: u32 = 14;
/// Exponent that spaces them: contact grows fastest at the touch.
const SPACING: f64 = 1.7;
/// Moments of the hold solved at, s: creep is fastest at first.
const HOLD_S: [f64; 9] = [0.03, 0.07, 0.14, 0.25, 0.4, 0.6, 0.85, 1.15, 1.5];
/// Part of the force to which the hold keeps its position.
const HOLD_TOLERANCE: f64 = 1e-3;

impl Course {
    /// Presses to `force_n`, holds the position for `hold_s` and withdraws.
    pub(super) fn new(bench: &mut Bench, specimen: &Specimen, force_n: f64, hold_s: f64) -> Self {
        // The contact is largest at the end of the hold, when everything has crept.
        let (mut window, _, _) = bench.press(specimen, force_n, 1.0, hold_s);
        loop {
            let mut run = Run::new(bench, specimen, window);
            run.load(force_n);
            run.hold(hold_s);
            run.unload();
            let Run { moments, fits, .. } = run;
            match window.wider(specimen, force_n) {
                Some(wider) if !fits => window = wider,
                _ => return Self { moments },
            }
        }
    }

    /// From touch to separation, s.
    pub(super) fn duration_s(&self) -> f64 {
        self.moments.last().map_or(0.0, |moment| moment.time_s)
    }

    /// Forces under the taxels `time_s` after the touch; zero before and after the press.
    pub(super) fn taxels_n(&self, time_s: f64) -> [f32; TAXELS] {
        let after = self
            .moments
            .partition_point(|moment| moment.time_s <= time_s);
        if after == 0 || after == self.moments.len() {
            return [0.0; TAXELS];
        }
        let (a, b) = (&self.moments[after - 1], &self.moments[after]);
        let part = ((time_s - a.time_s) / (b.time_s - a.time_s)) as f32;
        std::array::from_fn(|k| a.taxels_n[k] + part * (b.taxels_n[k] - a.taxels_n[k]))
    }
}

/// A press in the making.
struct Run<'a> {
    bench: &'a mut Bench,
    specimen: &'a Specimen,
    window: Window,
    gap_mm: Vec<f32>,
    /// State of each Kelvin element, MPa.
    crept: Vec<Vec<f32>>,
    /// Displacement that flow has left, mm; empty while there is none.
    flowed_mm: Vec<f32>,
    pressure: Vec<f32>,
    force_n: f64,
    /// Where the sensor's carrier is, z in mm.
    travel_mm: f64,
    time_s: f64,
    moments: Vec<Moment>,
    fits: bool,
}

/// A step that has been solved but not taken.
struct Trial {
    force_n: f64,
    time_s: f64,
    pressure: Vec<f32>,
    travel_mm: f64,
    radius_mm: f64,
}

impl<'a> Run<'a> {
    fn new(bench: &'a mut Bench, specimen: &'a Specimen, window: Window) -> Self {
        let cells = window.width * window.width;
        let touch = Moment {
            time_s: 0.0,
            force_n: 0.0,
            taxels_n: [0.0; TAXELS],
        };
        Self {
            bench,
            specimen,
            window,
            gap_mm: specimen.gap_on(window),
            crept: specimen
                .properties
                .creep
                .iter()
                .map(|_| vec![0.0; cells])
                .collect(),
            flowed_mm: Vec::new(),
            pressure: vec![0.0; cells],
            force_n: 0.0,
            travel_mm: 0.0,
            time_s: 0.0,
            moments: vec![touch],
            fits: true,
        }
    }

    fn load(&mut self, force_n: f64) {
        // Of the first step only that it is short; afterwards the speed so far tells.
        let mut guess_s = 0.05;
        for level in 1..=LEVELS {
            let goal = force_n * (f64::from(level) / f64::from(LEVELS)).powf(SPACING);
            let before_s = self.time_s;
            self.step_to_force(goal, guess_s, 1.0);
            guess_s = self.time_s - before_s;
        }
    }

    fn unload(&mut self) {
        let top = self.force_n;
        let mut guess_s = 0.05;
        for level in (1..LEVELS).rev() {
            let goal = top * (f64::from(level) / f64::from(LEVELS)).powf(SPACING);
            let before_s = self.time_s;
            self.step_to_force(goal, guess_s, -1.0);
            guess_s = self.time_s - before_s;
        }
        // The last touch: the surface as it is then, creep and dents included.
        let (gap, _) = self.effective_gap(0.0);
        let end_mm = f64::from(gap.iter().copied().fold(f32::INFINITY, f32::min));
        let last_s = ((self.travel_mm - end_mm) / SPEED_MM_S).max(LEAST_STEP_S);
        self.moments.push(Moment {
            time_s: self.time_s + last_s,
            force_n: 0.0,
            taxels_n: [0.0; TAXELS],
        });
    }

    /// Moves in `direction` until the force is `goal_n`. How long that takes depends on the travel
    /// and the travel, through creep, on how long it takes: two or three rounds settle it.
    fn step_to_force(&mut self, goal_n: f64, guess_s: f64, direction: f64) {
        let mut time_s = guess_s.max(LEAST_STEP_S);
        for round in 1.. {
            let trial = self.attempt(goal_n, time_s);
            let needed_s =
                (direction * (trial.travel_mm - self.travel_mm) / SPEED_MM_S).max(LEAST_STEP_S);
            if round == 3 || (needed_s - time_s).abs() < 0.05 * needed_s {
                return self.take(Trial {
                    time_s: needed_s,
                    ..trial
                });
            }
            time_s = needed_s;
        }
    }

    /// Keeps z for `hold_s`; the force follows by secants on `z(F)`.
    fn hold(&mut self, hold_s: f64) {
        let keep_mm = self.travel_mm;
        let start_s = self.time_s;
        let count = self.moments.len();
        let mut slope = {
            let (a, b) = (&self.moments[count - 2], &self.moments[count - 1]);
            SPEED_MM_S * (b.time_s - a.time_s) / (b.force_n - a.force_n)
        };
        let until = HOLD_S.iter().copied().take_while(|&at| at < hold_s - 0.01);
        for at in until.chain([hold_s]) {
            let time_s = start_s + at - self.time_s;
            let mut trial = self.attempt(self.force_n, time_s);
            for _ in 0..4 {
                let off = trial.travel_mm - keep_mm;
                if (off / slope).abs() < HOLD_TOLERANCE * trial.force_n {
                    break;
                }
                let next = (trial.force_n - off / slope).max(0.2 * trial.force_n);
                let (force_before, travel_before) = (trial.force_n, trial.travel_mm);
                trial = self.attempt(next, time_s);
                let seen = (trial.travel_mm - travel_before) / (trial.force_n - force_before);
                if seen > 0.2 * slope && seen < 5.0 * slope {
                    slope = seen;
                }
            }
            self.take(trial);
        }
    }

    /// Solves a step of `time_s` that ends at `force_n`.
    fn attempt(&mut self, force_n: f64, time_s: f64) -> Trial {
        let (gap, history) = self.effective_gap(time_s);
        let factor = 1.0
            + self
                .specimen
                .properties
                .creep
                .iter()
                .map(|c| c.j * share(time_s, c.tau_s))
                .sum::<f64>();
        let mut pressure = self.pressure.clone();
        let step = Step {
            force_n,
            factor,
            history_mpa: &history,
            time_s,
        };
        let contact = self
            .bench
            .solve(self.specimen, self.window.width, &gap, step, &mut pressure);
        let travel_mm = contact.approach_mm + force_n / ARM_N_MM;
        Trial {
            force_n,
            time_s,
            pressure,
            travel_mm,
            radius_mm: contact.radius_mm,
        }
    }

    /// The gap with what earlier steps have left of creep and flow after another `time_s`, and the
    /// left part of the effective pressure, which the foam's law needs on its own.
    fn effective_gap(&mut self, time_s: f64) -> (Vec<f32>, Vec<f32>) {
        let mut gap = self.gap_mm.clone();
        for (gap, &flowed) in gap.iter_mut().zip(&self.flowed_mm) {
            *gap += flowed;
        }
        if self.moments.len() == 1 {
            return (gap, Vec::new());
        }
        let mut history = vec![0.0_f32; gap.len()];
        for (creep, crept) in self.specimen.properties.creep.iter().zip(&self.crept) {
            let (kept, old) = left(time_s, creep.tau_s);
            let (kept, old) = ((creep.j * kept) as f32, (creep.j * old) as f32);
            for ((history, &crept), &pressure) in history.iter_mut().zip(crept).zip(&self.pressure)
            {
                *history += kept * crept + old * pressure;
            }
        }
        let displacement = self
            .bench
            .displacement(self.specimen, self.window.width, &history);
        for (gap, u) in gap.iter_mut().zip(displacement) {
            *gap += u;
        }
        (gap, history)
    }

    fn take(&mut self, trial: Trial) {
        for (creep, crept) in self.specimen.properties.creep.iter().zip(&mut self.crept) {
            let (kept, old) = left(trial.time_s, creep.tau_s);
            let new = share(trial.time_s, creep.tau_s) as f32;
            let (kept, old) = (kept as f32, old as f32);
            for ((crept, &before), &now) in
                crept.iter_mut().zip(&self.pressure).zip(&trial.pressure)
            {
                *crept = kept * *crept + old * before + new * now;
            }
        }
        if let Law::Plastic { .. } = self.specimen.properties.law {
            self.flowed_mm.resize(trial.pressure.len(), 0.0);
            let flow = self.specimen.flow(trial.time_s);
            for (flowed, &pressure) in self.flowed_mm.iter_mut().zip(&trial.pressure) {
                *flowed += flow.displacement_mm(pressure, trial.radius_mm);
            }
        }
        self.fits &= self.window.is_whole() || !touches_border(&trial.pressure, self.window.width);
        self.pressure = trial.pressure;
        self.force_n = trial.force_n;
        self.travel_mm = trial.travel_mm;
        self.time_s += trial.time_s;
        self.moments.push(Moment {
            time_s: self.time_s,
            force_n: self.force_n,
            taxels_n: taxel_forces(&self.pressure, self.window.width, self.window.corner),
        });
    }
}

/// No step is shorter, so that creep that runs ahead of the motion cannot stop time.
const LEAST_STEP_S: f64 = 1e-3;

/// Of a Kelvin element of time constant tau, `s' = (p - s) / tau`, under a pressure linear in time
/// over `t`: the share of the new pressure in the new state, `1 - (tau / t) (1 - exp(-t / tau))`.
fn share(time_s: f64, tau_s: f64) -> f64 {
    if time_s <= 0.0 {
        return 0.0;
    }
    let x = time_s / tau_s;
    1.0 + (-x).exp_m1() / x
}

/// The same element: the shares of its old state and of the old pressure.
fn left(time_s: f64, tau_s: f64) -> (f64, f64) {
    let kept = (-time_s / tau_s).exp();
    (kept, 1.0 - kept - share(time_s, tau_s))
}
