//! One press over time with a prescribed motion, `z(t) = d + F / k_arm`.
//!
//! Loading and unloading are solved at chosen forces, and the time of each force follows from the
//! motion. In the hold, the solver seeks the force that keeps z. The state of each Kelvin element
//! carries creep from step to step. Pressure is taken as linear in time within a step, for which
//! the element's update is exact.

use super::motion::{Arm, Motion};
use super::press::{Bench, Specimen, Step, Window, touches_border};
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
}

#[derive(Clone)]
struct SolvedStep {
    time_s: f64,
    force_n: f64,
    /// Pressure on the window, MPa; empty without contact.
    pressure: Vec<f32>,
}

/// A press as the taxels of a grid feel it.
pub(super) struct FeltPress {
    /// Times and taxel forces in newtons. Forces are linear between them.
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
        let levels = if specimen.is_flat {
            FLAT_LEVELS
        } else {
            LEVELS
        };
        // The contact is largest at the end of the hold, when everything has crept.
        let (mut window, _, _) = bench.press(specimen, force_n, 1.0, hold_s);
        loop {
            let mut at = State::new(specimen, window);
            let mut run = Run {
                bench,
                specimen,
                arm,
                at: &mut at,
            };
            run.load(force_n, levels);
            let (top_mm, load_s) = (run.at.travel_mm, run.at.time_s);
            run.hold(hold_s);
            run.unload(levels);
            let State { moments, fits, .. } = at;
            match window.wider(specimen, bench.cover, force_n) {
                Some(wider) if !fits => window = wider,
                _ => {
                    let motion = Motion {
                        top_mm,
                        load_s,
                        hold_s,
                        speed_mm_s: arm.speed_mm_s,
                    };
                    return Self {
                        moments,
                        window,
                        motion,
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
    /// The taxel forces in newtons `time_s` after the touch; zero before and after the press.
    pub(super) fn taxels_n(&self, time_s: f64) -> Vec<f32> {
        let after = self.moments.partition_point(|&(at_s, _)| at_s <= time_s);
        if after == 0 || after == self.moments.len() {
            let taxels = self.moments.first().map_or(0, |(_, taxels)| taxels.len());
            return vec![0.0; taxels];
        }
        let ((a_s, a), (b_s, b)) = (&self.moments[after - 1], &self.moments[after]);
        let part = ((time_s - a_s) / (b_s - a_s)) as f32;
        a.iter().zip(b).map(|(a, b)| a + part * (b - a)).collect()
    }
}

/// A press while it is computed, step by step.
pub(super) struct Run<'a> {
    pub(super) bench: &'a mut Bench,
    pub(super) specimen: &'a Specimen,
    pub(super) arm: Arm,
    pub(super) at: &'a mut State,
}

/// How far a press has come.
pub(super) struct State {
    pub(super) window: Window,
    gap_mm: Vec<f32>,
    /// State of each Kelvin element, MPa.
    crept: Vec<Vec<f32>>,
    /// The displacement left by flow, mm; empty if there is none.
    flowed_mm: Vec<f32>,
    pub(super) pressure: Vec<f32>,
    pub(super) force_n: f64,
    /// Position z of the sensor's carrier, mm.
    travel_mm: f64,
    time_s: f64,
    moments: Vec<SolvedStep>,
    fits: bool,
}

/// A step that is solved but not yet taken.
struct Trial {
    force_n: f64,
    time_s: f64,
    pressure: Vec<f32>,
    travel_mm: f64,
    radius_mm: f64,
}

impl State {
    /// Before the touch.
    pub(super) fn new(specimen: &Specimen, window: Window) -> Self {
        let cells = window.width * window.width;
        let touch = SolvedStep {
            time_s: 0.0,
            force_n: 0.0,
            pressure: Vec::new(),
        };
        Self {
            window,
            gap_mm: specimen.gap_on(window),
            crept: specimen
                .substance
                .creep()
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
}

impl State {
    /// A guess at the pressure under `force_n`: each cell goes on as between the last two moments.
    fn guess(&self, force_n: f64) -> Vec<f32> {
        let mut guess = self.pressure.clone();
        if let [.., before, last] = self.moments.as_slice()
            && before.pressure.len() == guess.len()
            && before.force_n != last.force_n
        {
            let part = ((force_n - last.force_n) / (last.force_n - before.force_n)) as f32;
            for (guess, before) in guess.iter_mut().zip(&before.pressure) {
                *guess = (*guess + part * (*guess - before)).max(0.0);
            }
        }
        guess
    }
}

impl Run<'_> {
    fn load(&mut self, force_n: f64, levels: u32) {
        // Of the first step we only know that it is short. The later guesses are the length of the
        // step before.
        let mut guess_s = 0.05;
        for level in 1..=levels {
            let goal = force_n * (f64::from(level) / f64::from(levels)).powf(SPACING);
            let before_s = self.at.time_s;
            self.step_to_force(goal, guess_s, 1.0);
            guess_s = self.at.time_s - before_s;
        }
    }

    fn unload(&mut self, levels: u32) {
        let top = self.at.force_n;
        let mut guess_s = 0.05;
        for level in (1..levels).rev() {
            let goal = top * (f64::from(level) / f64::from(levels)).powf(SPACING);
            let before_s = self.at.time_s;
            self.step_to_force(goal, guess_s, -1.0);
            guess_s = self.at.time_s - before_s;
        }
        // The press ends where the sensor leaves the surface, with its creep and dents at that
        // time.
        let (gap, _) = self.effective_gap(0.0);
        let end_mm = f64::from(gap.iter().copied().fold(f32::INFINITY, f32::min));
        let last_s = ((self.at.travel_mm - end_mm) / self.arm.speed_mm_s).max(LEAST_STEP_S);
        self.at.moments.push(SolvedStep {
            time_s: self.at.time_s + last_s,
            force_n: 0.0,
            pressure: Vec::new(),
        });
    }

    /// Moves in `direction` until the force is `goal_n`. The time of the step depends on the
    /// travel, and the travel, through creep, on the time. Two or three rounds settle both.
    fn step_to_force(&mut self, goal_n: f64, guess_s: f64, direction: f64) {
        let mut time_s = guess_s.max(LEAST_STEP_S);
        let mut guess = self.at.guess(goal_n);
        for round in 1.. {
            let trial = self.attempt(goal_n, time_s, guess);
            let needed_s = (direction * (trial.travel_mm - self.at.travel_mm)
                / self.arm.speed_mm_s)
                .max(LEAST_STEP_S);
            if round == 3 || (needed_s - time_s).abs() < 0.05 * needed_s {
                return self.take(Trial {
                    time_s: needed_s,
                    ..trial
                });
            }
            time_s = needed_s;
            guess = trial.pressure;
        }
    }

    /// Keeps z for `hold_s`, with forces from the secant method on `z(F)`.
    fn hold(&mut self, hold_s: f64) {
        let keep_mm = self.at.travel_mm;
        let start_s = self.at.time_s;
        let count = self.at.moments.len();
        let mut slope = {
            let (a, b) = (&self.at.moments[count - 2], &self.at.moments[count - 1]);
            self.arm.speed_mm_s * (b.time_s - a.time_s) / (b.force_n - a.force_n)
        };
        let step = if self.specimen.is_flat { FLAT_HOLDS } else { 1 };
        let until = HOLD_S.iter().copied().step_by(step);
        let until = until.take_while(|&at| at < hold_s - 0.01);
        for at in until.chain([hold_s]) {
            let time_s = start_s + at - self.at.time_s;
            let mut trial = self.attempt(self.at.force_n, time_s, self.at.pressure.clone());
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
            self.take(trial);
        }
    }

    /// Moves the carrier to `goal_mm` in `time_s`, into the object or away from it. Keeps no moment.
    pub(super) fn move_to(&mut self, goal_mm: f64, time_s: f64) {
        let (gap, _) = self.effective_gap(time_s);
        let touch_mm = f64::from(gap.iter().copied().fold(f32::INFINITY, f32::min));
        let depth_mm = goal_mm - touch_mm;
        if depth_mm > 0.0 {
            let trial = self.force_at_depth(touch_mm, depth_mm, time_s);
            if touches_border(&trial.pressure, self.at.window.width)
                && let Some(wider) =
                    (self.at.window).wider(self.specimen, self.bench.cover, trial.force_n)
            {
                self.widen(wider);
                return self.move_to(goal_mm, time_s);
            }
            self.take(trial);
        } else if self.at.time_s > 0.0 {
            self.take(Trial {
                force_n: 0.0,
                time_s,
                pressure: vec![0.0; self.at.pressure.len()],
                travel_mm: goal_mm,
                radius_mm: 0.0,
            });
        }
        self.at.moments.clear();
    }

    /// Seeks the force that brings the carrier `depth_mm` beyond `touch_mm`, where the object would be
    /// touched: by the secant method on ln F against the logarithm of the depth, where the contact is
    /// nearly a power law.
    fn force_at_depth(&mut self, touch_mm: f64, depth_mm: f64, time_s: f64) -> Trial {
        let depth_of = |trial: &Trial| (trial.travel_mm - touch_mm).max(LEAST_DEPTH_MM);
        let before_mm = self.at.travel_mm - touch_mm;
        let mut power = 1.5;
        let mut next_n = if self.at.force_n > 0.0 && before_mm > LEAST_DEPTH_MM {
            self.at.force_n * (depth_mm / before_mm).powf(power)
        } else {
            0.3 * self.arm.n_per_mm * depth_mm
        };
        let mut trial = self.attempt(next_n.max(LEAST_FORCE_N), time_s, self.at.pressure.clone());
        for _ in 0..MOST_TRIALS {
            let off = (depth_mm / depth_of(&trial)).ln();
            next_n = (trial.force_n * (power * off).clamp(-2.0, 2.0).exp()).max(LEAST_FORCE_N);
            if (next_n / trial.force_n).ln().abs() < FORCE_TOLERANCE {
                break;
            }
            let (force_before, depth_before) = (trial.force_n, depth_of(&trial));
            trial = self.attempt(next_n, time_s, trial.pressure);
            let seen = (trial.force_n / force_before).ln() / (depth_of(&trial) / depth_before).ln();
            if (0.2..5.0).contains(&seen) {
                power = seen;
            }
        }
        trial
    }

    /// Goes on with the same press on a wider window.
    fn widen(&mut self, window: Window) {
        let from = std::mem::replace(&mut self.at.window, window);
        self.at.gap_mm = self.specimen.gap_on(window);
        let crept = self.at.crept.iter_mut();
        for field in crept.chain([&mut self.at.flowed_mm, &mut self.at.pressure]) {
            if !field.is_empty() {
                *field = window.relaid(field, from);
            }
        }
    }

    /// Solves a step of `time_s` that ends at `force_n`, from a guess at the pressure.
    fn attempt(&mut self, force_n: f64, time_s: f64, mut pressure: Vec<f32>) -> Trial {
        let (gap, history) = self.effective_gap(time_s);
        let factor = 1.0
            + self
                .specimen
                .substance
                .creep()
                .map(|c| c.j * share(time_s, c.tau_s))
                .sum::<f64>();
        let step = Step {
            force_n,
            factor,
            history_mpa: &history,
            time_s,
        };
        let contact = self
            .bench
            .solve(self.specimen, self.at.window, &gap, step, &mut pressure);
        let travel_mm = contact.approach_mm + force_n / self.arm.n_per_mm;
        Trial {
            force_n,
            time_s,
            pressure,
            travel_mm,
            radius_mm: contact.radius_mm,
        }
    }

    /// The gap with the creep and flow that earlier steps leave after another `time_s`, and the
    /// remaining part of the effective pressure, which the foam's law needs separately.
    fn effective_gap(&mut self, time_s: f64) -> (Vec<f32>, Vec<f32>) {
        let mut gap = self.at.gap_mm.clone();
        for (gap, &flowed) in gap.iter_mut().zip(&self.at.flowed_mm) {
            *gap += flowed;
        }
        if self.at.time_s == 0.0 {
            return (gap, Vec::new());
        }
        let mut history = vec![0.0_f32; gap.len()];
        for (creep, crept) in self.specimen.substance.creep().zip(&self.at.crept) {
            let (kept, old) = left(time_s, creep.tau_s);
            let (kept, old) = ((creep.j * kept) as f32, (creep.j * old) as f32);
            for ((history, &crept), &pressure) in
                history.iter_mut().zip(crept).zip(&self.at.pressure)
            {
                *history += kept * crept + old * pressure;
            }
        }
        let displacement = self
            .bench
            .displacement(self.specimen, self.at.window, &history);
        for (gap, u) in gap.iter_mut().zip(displacement) {
            *gap += u;
        }
        (gap, history)
    }

    fn take(&mut self, trial: Trial) {
        for (creep, crept) in self.specimen.substance.creep().zip(&mut self.at.crept) {
            let (kept, old) = left(trial.time_s, creep.tau_s);
            let new = share(trial.time_s, creep.tau_s) as f32;
            let (kept, old) = (kept as f32, old as f32);
            for ((crept, &before), &now) in
                crept.iter_mut().zip(&self.at.pressure).zip(&trial.pressure)
            {
                *crept = kept * *crept + old * before + new * now;
            }
        }
        if let Law::Plastic { .. } = self.specimen.substance.law {
            self.at.flowed_mm.resize(trial.pressure.len(), 0.0);
            let flow = self.specimen.flow(trial.time_s);
            for (flowed, &pressure) in self.at.flowed_mm.iter_mut().zip(&trial.pressure) {
                *flowed += flow.displacement_mm(pressure, trial.radius_mm);
            }
        }
        self.at.fits &=
            self.at.window.is_whole() || !touches_border(&trial.pressure, self.at.window.width);
        self.at.pressure = trial.pressure;
        self.at.force_n = trial.force_n;
        self.at.travel_mm = trial.travel_mm;
        self.at.time_s += trial.time_s;
        self.at.moments.push(SolvedStep {
            time_s: self.at.time_s,
            force_n: self.at.force_n,
            pressure: self.at.pressure.clone(),
        });
    }
}

/// The least force of a contact, N, and the least depth that its power law is followed to, mm.
const LEAST_FORCE_N: f64 = 1e-3;
const LEAST_DEPTH_MM: f64 = 1e-5;
/// Tolerance of the force that belongs to a position, as a part of the force, and the most solves after the
/// first to reach it.
const FORCE_TOLERANCE: f64 = 3e-3;
const MOST_TRIALS: u32 = 5;

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
    use super::super::object::{Face, Pose};
    use super::super::press::Specimen;
    use super::super::texture::Patch;
    use super::*;
    use crate::random::Stream;

    fn specimen(material: Material, face: &Face) -> Specimen {
        let properties = material.properties();
        let mut stream = Stream::new(4, "course");
        let pose = Pose::draw(face, &mut stream.child(0));
        let patch = Patch::new(&properties.substance.texture, 1.0, 0.875, &mut stream);
        Specimen::new(
            properties.substance,
            properties.young_mpa(properties.shore.mean),
            face,
            &pose,
            &patch,
        )
    }

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
        let specimen = specimen(Material::SoftCandy, &Face::ball(27.0));
        let course = SolvedPress::new(&mut Bench::default(), &specimen, Arm::default(), 12.0, 1.5);
        let top = course
            .moments
            .iter()
            .map(|moment| moment.force_n)
            .fold(0.0, f64::max);
        let hold: Vec<&SolvedStep> = course
            .moments
            .iter()
            .skip_while(|moment| moment.force_n < top)
            .take(10)
            .collect();
        assert!((top - 12.0).abs() < 1e-9);
        assert!(
            hold.windows(2)
                .all(|pair| pair[1].force_n < pair[0].force_n)
        );
        let kept = hold[9].force_n / top;
        assert!((0.75..0.97).contains(&kept), "{kept} of the force is left");
    }
}
