//! Hand-made features of a press: what its frames, its force over time and the arm's approach say of
//! what was pressed.
//!
//! In: the course of a press. Out: [`FEATURES`] numbers, the input `features` of a model of format 3.
//! The trainer computes them with this code, so both see the same. Logarithms turn the power laws of
//! contact into sums. What is not known is 0, beside a number that says whether it is known.

use std::ops::Range;

use super::course::{Moment, TimeSeries, period_s};
use super::grid::{COLS, ModelFrame, ROWS};
use crate::line;
use crate::press::Phases;

/// The numbers of a frame.
pub const FRAME: usize = 20;
/// The numbers of a press.
pub const FEATURES: usize = FRAME + 103;

/// A taxel of the model's grid is in contact at or above this force. It lies a little below 0.07 N, and the next numbers
/// below round ones: whole counts and whole millinewtons of one force round apart.
const CONTACT_N: f32 = 0.0699;
/// Thresholds above which taxels are counted, in newtons.
const COUNTED_N: [f32; 5] = [0.1999, 0.4999, 0.9999, 1.9999, 3.9999];
/// Shares of the peak above which taxels are counted.
const COUNTED_SHARES: [f32; 3] = [0.4999, 0.2499, 0.7499];
/// Added before a logarithm or to a divisor to keep it finite.
const LITTLE_N: f32 = 0.05;
const LITTLE_MM: f32 = 0.1;
const LITTLE_S: f32 = 0.05;
const TINY: f32 = 1e-4;
/// The limit of second moments, in squared taxels: that of an evenly loaded grid.
const MOST_MOMENT: f32 = 131.0;
/// The limit of lengths, in mm.
const MOST_MM: f32 = 60.0;
/// The least stiffness of an arm, in N/mm.
const LEAST_ARM: f32 = 0.5;
/// Shares of the greatest force at which the loading is read off.
const LOADING: [f32; 4] = [0.1, 0.25, 0.5, 0.75];
/// Shares of the last force of the hold at which the unloading is compared with the loading.
const UNLOADING: [f32; 3] = [0.25, 0.5, 0.75];
/// Approaches at which force and area are read off, in mm.
const APPROACHES_MM: [f32; 4] = [0.5, 1.0, 2.0, 4.0];
/// Times of the hold at which it is compared with its beginning, in s.
const HOLD_S: [f32; 3] = [0.1, 0.3, 1.0];
/// Laws are fitted from this share of loading's last force on, and the slope of its end from this one.
const FITTED: f32 = 0.08;
const END: f32 = 0.5;

/// Places of a frame's numbers.
const AREA: usize = 0;
const HALF: usize = 6;
const FORCE: usize = 9;
const PEAK: usize = 10;
const SPREAD: usize = 11;
const WIDTH: usize = 12;
const EFFECTIVE: usize = 13;

/// The numbers of one frame: logarithms of areas, force, peak and second moments, and the contact's
/// form.
pub type FrameFeatures = [f32; FRAME];

/// The features of a frame on the model's grid.
pub fn of_frame(frame: &ModelFrame) -> FrameFeatures {
    // A press has 0 beyond the margin of its contact, so most frames have few other taxels.
    let taxels = frame.newtons.iter().enumerate();
    let felt = taxels.filter(|&(_, &newtons)| newtons != 0.0);
    let felt = felt.map(|(place, &newtons)| (place / COLS, place % COLS, newtons));
    let felt: Vec<(usize, usize, f32)> = felt.collect();
    let peak = felt.iter().map(|taxel| taxel.2).fold(0.0, f32::max);
    // The force over all taxels has its sign, so that noise cancels. The taxels in contact count alike.
    let (mut of_force, mut of_contact) = (Moments::default(), Moments::default());
    let mut squares = 0.0;
    let mut counts = [0.0_f32; 5];
    let mut shares = [0.0_f32; 3];
    let (mut roughness, mut border) = (0.0, 0.0);
    for &(row, col, newtons) in &felt {
        of_force.add(row, col, newtons);
        if newtons < CONTACT_N {
            continue;
        }
        of_contact.add(row, col, 1.0);
        squares += newtons * newtons;
        for (count, threshold_n) in counts.iter_mut().zip(COUNTED_N) {
            *count += f32::from(u8::from(newtons >= threshold_n));
        }
        for (count, share) in shares.iter_mut().zip(COUNTED_SHARES) {
            *count += f32::from(u8::from(newtons >= share * peak));
        }
        let (above, left) = (row.wrapping_sub(1), col.wrapping_sub(1));
        for (row, col) in [(above, col), (row, left), (row, col + 1), (row + 1, col)] {
            if row >= ROWS || col >= COLS {
                continue;
            }
            match frame.newtons[row * COLS + col] {
                // Two taxels in contact meet twice.
                beside if beside >= CONTACT_N => roughness += 0.5 * (newtons - beside).abs(),
                _ => {
                    roughness += newtons;
                    border += 1.0;
                }
            }
        }
    }
    let (spread, elongation) = of_force.moments();
    let (width, oblong) = of_contact.moments();
    let (force, area) = (of_force.total.max(0.0), of_contact.total);
    let fourth = of_force.fourth(&felt);
    let effective = force * force / (squares + TINY);
    let [c02, c05, c1, c2, c4] = counts.map(f32::ln_1p);
    let [half, quarter, most] = shares.map(|count| (count + 0.5).ln());
    [
        area.ln_1p(),
        c02,
        c05,
        c1,
        c2,
        c4,
        half,
        quarter,
        most,
        (force + LITTLE_N).ln(),
        (peak + LITTLE_N).ln(),
        (spread + 0.05).ln(),
        (width + 0.05).ln(),
        (effective + 0.5).ln(),
        elongation,
        oblong,
        roughness / (force + LITTLE_N),
        border / (area + 0.5),
        ((fourth + 0.1) / (spread * spread + 0.1)).ln(),
        (peak * area / (force + 0.01) + 0.5).ln(),
    ]
}

/// The features of a frame of which only the area in taxels and the force are known.
#[cfg(any(test, feature = "test-support"))]
pub fn frame_of(area: f32, force_n: f32) -> FrameFeatures {
    let mut frame = [0.0; FRAME];
    frame[AREA] = area.ln_1p();
    frame[FORCE] = (force_n + LITTLE_N).ln();
    frame
}

/// The force of a frame, from its features.
pub fn force_n(frame: &FrameFeatures) -> f32 {
    (frame[FORCE].exp() - LITTLE_N).max(0.0)
}

/// A taxel's place from the middle of the grid.
fn centred(row: usize, col: usize) -> (f32, f32) {
    let middle = |length: usize| (length as f32 - 1.0) / 2.0;
    (row as f32 - middle(ROWS), col as f32 - middle(COLS))
}

/// The moments of a weight over the grid.
#[derive(Default)]
struct Moments {
    total: f32,
    first: [f32; 2],
    second: [f32; 3],
}

impl Moments {
    fn add(&mut self, row: usize, col: usize, weight: f32) {
        let (row, col) = centred(row, col);
        self.total += weight;
        self.first[0] += weight * row;
        self.first[1] += weight * col;
        self.second[0] += weight * row * row;
        self.second[1] += weight * col * col;
        self.second[2] += weight * row * col;
    }

    fn centre(&self) -> [f32; 2] {
        self.first.map(|sum| sum / self.weight())
    }

    /// The divisor of sums. It is positive, even where noise outweighs a light touch.
    fn weight(&self) -> f32 {
        self.total.max(0.0) + TINY
    }

    /// The fourth moment of these taxels' weight about its centre.
    fn fourth(&self, taxels: &[(usize, usize, f32)]) -> f32 {
        let [centre_row, centre_col] = self.centre();
        let moment = |&(row, col, weight): &(usize, usize, f32)| {
            let (row, col) = centred(row, col);
            let square = (row - centre_row).powi(2) + (col - centre_col).powi(2);
            weight * square * square
        };
        let sum: f32 = taxels.iter().map(moment).sum();
        (sum / self.weight()).clamp(0.0, MOST_MOMENT * MOST_MOMENT)
    }

    /// The trace of the second central moments, and their anisotropy from 0 (round) to 1 (a line).
    fn moments(&self) -> (f32, f32) {
        let [row, col] = self.centre();
        let [rows, cols, both] = self.second.map(|sum| sum / self.weight());
        let (rows, cols, both) = (rows - row * row, cols - col * col, both - row * col);
        let trace = (rows + cols).clamp(0.0, MOST_MOMENT);
        let difference = ((rows - cols).powi(2) + 4.0 * both * both).sqrt();
        (trace, (difference / (trace + 0.05)).min(1.0))
    }
}

impl TimeSeries {
    /// The features of the press.
    ///
    /// # Panics
    ///
    /// Panics if the course has no frame.
    pub fn features(&self) -> [f32; FEATURES] {
        let moments = self.moments.iter().map(|moment| moment.map(of_frame));
        of_press(&moments.collect::<Vec<_>>(), self.arm_n_per_mm)
    }
}

/// The features of a press of at least one frame. `arm_n_per_mm` is 0 if the stiffness is unknown.
///
/// # Panics
///
/// Panics if there is no frame.
pub fn of_press(moments: &[Moment<FrameFeatures>], arm_n_per_mm: f32) -> [f32; FEATURES] {
    let press = Press::new(moments, arm_n_per_mm);
    let mut row = Vec::with_capacity(FEATURES);
    row.extend(press.moments[press.top].frame);
    press.times(&mut row);
    press.depths(&mut row);
    press.loading(&mut row);
    press.laws(&mut row);
    press.ratios(&mut row);
    press.hold(&mut row);
    press.unloading(&mut row);
    row.try_into().expect("a press has its number of features")
}

/// The logarithm of a length.
fn length(mm: f32) -> f32 {
    (mm.clamp(0.0, MOST_MM) + LITTLE_MM).ln()
}

/// A press with what all features need.
struct Press<'a> {
    moments: &'a [Moment<FrameFeatures>],
    forces_n: Vec<f32>,
    /// The frame of the largest area, and that of the greatest force.
    best: usize,
    top: usize,
    /// The last frame of loading, and of the hold.
    loaded: usize,
    held: usize,
    /// 0 if unknown.
    arm_n_per_mm: f32,
}

impl<'a> Press<'a> {
    fn new(moments: &'a [Moment<FrameFeatures>], arm_n_per_mm: f32) -> Self {
        let forces_n: Vec<f32> = moments
            .iter()
            .map(|moment| force_n(&moment.frame).max(1e-3))
            .collect();
        let before = |a: &usize, b: &usize| {
            let area = |place: usize| moments[place].frame[AREA];
            let areas = area(*a).total_cmp(&area(*b));
            areas.then(forces_n[*a].total_cmp(&forces_n[*b]))
        };
        let best = (0..moments.len())
            .max_by(before)
            .expect("a press has a frame");
        let forces: Vec<f64> = forces_n.iter().map(|&n| f64::from(n)).collect();
        let Phases { loaded, top, held } = Phases::of(&forces);
        Self {
            moments,
            best,
            top,
            loaded,
            held,
            arm_n_per_mm,
            forces_n,
        }
    }

    fn approach_mm(&self, place: usize) -> Option<f32> {
        self.moments[place].approach_mm
    }

    /// How far object and cover gave way together: the approach without that of the arm itself.
    fn indentation_mm(&self, place: usize) -> Option<f32> {
        let approach_mm = self.approach_mm(place)?;
        let arm = self.arm_n_per_mm.max(LEAST_ARM);
        (self.arm_n_per_mm > 0.0).then(|| approach_mm - self.forces_n[place] / arm)
    }

    fn of_frame(&self, number: usize) -> impl Fn(usize) -> Option<f32> {
        move |place| Some(self.moments[place].frame[number])
    }

    fn times(&self, row: &mut Vec<f32>) {
        let time_s = |place: usize| self.moments[place].time_s;
        let period = period_s(self.moments.iter().map(|moment| moment.time_s));
        row.extend([
            period.map_or(0.0, |period_s| (period_s.max(0.0) + 0.005).ln()),
            (self.moments.len() as f32).ln(),
            (time_s(self.top) + LITTLE_S).ln(),
            (time_s(self.held) - time_s(self.loaded) + LITTLE_S).ln(),
            (time_s(self.moments.len() - 1) - time_s(self.held) + LITTLE_S).ln(),
        ]);
    }

    fn depths(&self, row: &mut Vec<f32>) {
        let furthest = self.moments.iter().filter_map(|moment| moment.approach_mm);
        let furthest = furthest.reduce(f32::max);
        let is_known = |known: bool| f32::from(u8::from(known));
        let of_top = self.indentation_mm(self.top);
        row.extend([
            is_known(self.approach_mm(self.top).is_some()),
            is_known(of_top.is_some()),
            match self.arm_n_per_mm > 0.0 {
                true => self.arm_n_per_mm.max(LEAST_ARM).ln(),
                false => 0.0,
            },
            furthest.map_or(0.0, length),
            of_top.map_or(0.0, length),
            self.indentation_mm(self.best).map_or(0.0, length),
            of_top.map_or(0.0, |mm| mm.clamp(-3.0, 20.0)),
        ]);
    }

    /// The value where `by` passed `level` among these frames, interpolated between two of them.
    fn passed(
        &self,
        places: Range<usize>,
        by: impl Fn(usize) -> Option<f32>,
        level: f32,
        value: &dyn Fn(usize) -> Option<f32>,
    ) -> Option<f32> {
        let mut places = places.into_iter();
        let after = places.find(|&place| by(place).is_some_and(|own| own >= level))?;
        let before = after.checked_sub(1)?;
        let (low, high) = (by(before)?, by(after)?);
        let part = (level - low) / (high - low + TINY);
        let (low, high) = (value(before)?, value(after)?);
        Some(low + part * (high - low))
    }

    /// The value when the rising force passed `force_n`. The first frame may have more force already.
    fn while_loading(&self, force_n: f32, value: &dyn Fn(usize) -> Option<f32>) -> Option<f32> {
        if self.forces_n[0] >= force_n {
            return value(0);
        }
        let force = |place: usize| Some(self.forces_n[place]);
        self.passed(0..self.top + 1, force, force_n, value)
    }

    /// The value when the falling force passed `force_n`.
    fn while_unloading(&self, force_n: f32, value: &dyn Fn(usize) -> Option<f32>) -> Option<f32> {
        let force = |place: usize| Some(-self.forces_n[place]);
        self.passed(self.held..self.moments.len(), force, -force_n, value)
    }

    fn loading(&self, row: &mut Vec<f32>) {
        for share in LOADING {
            let force_n = share * self.forces_n[self.top];
            let at = |value: &dyn Fn(usize) -> Option<f32>| self.while_loading(force_n, value);
            row.push(at(&|place| self.approach_mm(place)).map_or(0.0, length));
            row.push(at(&|place| self.indentation_mm(place)).map_or(0.0, length));
            for number in [AREA, SPREAD, WIDTH, EFFECTIVE, PEAK, HALF] {
                row.push(at(&self.of_frame(number)).unwrap_or(0.0));
            }
        }
        for mm in APPROACHES_MM {
            let at = |value: &dyn Fn(usize) -> Option<f32>| {
                self.passed(0..self.top + 1, |place| self.approach_mm(place), mm, value)
            };
            let force = at(&|place| Some(self.forces_n[place]));
            let area = at(&self.of_frame(AREA));
            row.push(force.map_or(0.0, |force_n| (force_n + LITTLE_N).ln()));
            row.push(area.unwrap_or(0.0));
            row.push(f32::from(u8::from(force.is_some())));
        }
    }

    /// The points of a law of loading.
    fn points(
        &self,
        share: f32,
        x: impl Fn(usize) -> Option<f32>,
        y: impl Fn(usize) -> f32,
    ) -> Vec<(f32, f32)> {
        let least = share * self.forces_n[self.top];
        let places = (0..=self.top).filter(|&place| self.forces_n[place] >= least);
        let point = |place: usize| Some((x(place)?, y(place)));
        places.filter_map(point).collect()
    }

    /// Exponents of the laws of loading, the compliance at its end, and Hertz's law.
    fn laws(&self, row: &mut Vec<f32>) {
        let force = |place: usize| (self.forces_n[place] + LITTLE_N).ln();
        let depth = |mm: f32| (mm.clamp(0.0, MOST_MM) + 0.15).ln();
        let by_indentation = |place: usize| self.indentation_mm(place).map(depth);
        let by_approach = |place: usize| self.approach_mm(place).map(depth);
        row.push(slope(&self.points(FITTED, by_indentation, force)));
        row.push(slope(&self.points(FITTED, by_approach, force)));
        for number in [AREA, SPREAD, PEAK, EFFECTIVE] {
            let of = |place: usize| self.moments[place].frame[number];
            row.push(slope(&self.points(FITTED, |place| Some(force(place)), of)));
        }

        let end = self.points(END, |place| self.approach_mm(place), |p| self.forces_n[p]);
        let end: Vec<(f32, f32)> = end.into_iter().map(|(mm, n)| (n, mm)).collect();
        let known = f32::from(u8::from(end.len() > 1));
        let compliance = slope(&end);
        let own = match self.arm_n_per_mm > 0.0 {
            true => compliance - 1.0 / self.arm_n_per_mm.max(LEAST_ARM),
            false => compliance,
        };
        row.extend([compliance, own].map(|mm_per_n| known * mm_per_n.clamp(3e-3, 5.0).ln()));

        let hertz = |place: usize| self.forces_n[place].powf(2.0 / 3.0);
        let points = self.points(FITTED, |place| self.indentation_mm(place), hertz);
        let known = f32::from(u8::from(points.len() > 1));
        let rise = known * slope(&points).clamp(0.02, 50.0).ln();
        let width = self.moments[self.top].frame[WIDTH];
        row.extend([rise, known * (1.5 * rise - 0.25 * width)]);
    }

    /// Quotients that are the same for contacts of one form and other sizes.
    fn ratios(&self, row: &mut Vec<f32>) {
        let top = &self.moments[self.top].frame;
        let depth = self.indentation_mm(self.top).map(length);
        let against = |number: usize, power: f32| depth.map_or(0.0, |mm| mm - power * top[number]);
        row.extend([
            top[FORCE] - top[AREA],
            top[FORCE] - 1.5 * top[AREA],
            top[FORCE] - 1.5 * top[WIDTH],
            against(AREA, 0.5),
            against(WIDTH, 1.0),
            against(SPREAD, 1.0),
            against(WIDTH, 0.5),
            top[PEAK] - top[FORCE],
            top[EFFECTIVE] - top[AREA],
            top[SPREAD] - top[WIDTH],
            top[HALF] - top[AREA],
        ]);
    }

    /// How force, area and peak change while the arm holds its position.
    fn hold(&self, row: &mut Vec<f32>) {
        let begin = &self.moments[self.loaded];
        let after = |seconds: f32, number: usize| {
            let wanted = begin.time_s + seconds;
            let late = (self.loaded..=self.held).find(|&p| self.moments[p].time_s >= wanted);
            let late = late.unwrap_or(self.held);
            self.moments[late].frame[number] - begin.frame[number]
        };
        for seconds in HOLD_S {
            row.extend([FORCE, AREA, PEAK].map(|number| after(seconds, number)));
        }
        row.extend([FORCE, SPREAD, EFFECTIVE].map(|number| after(f32::INFINITY, number)));
    }

    /// How the unloading differs from the loading.
    fn unloading(&self, row: &mut Vec<f32>) {
        let last = self.moments.len() - 1;
        let furthest_mm = self.approach_mm(self.held).unwrap_or(0.0).max(0.0);
        row.push(f32::from(u8::from(last > self.held + 1)));
        for share in UNLOADING {
            let force_n = share * self.forces_n[self.held];
            let difference = |value: &dyn Fn(usize) -> Option<f32>| {
                let up = self.while_loading(force_n, value)?;
                Some(self.while_unloading(force_n, value)? - up)
            };
            let way = difference(&|place| self.approach_mm(place));
            row.push(way.map_or(0.0, |mm| mm / (furthest_mm + LITTLE_MM)));
            row.push(difference(&self.of_frame(AREA)).unwrap_or(0.0));
            row.push(difference(&self.of_frame(SPREAD)).unwrap_or(0.0));
        }
        let left = self.approach_mm(last).filter(|_| last > self.held);
        row.push(left.map_or(0.0, length));
        row.push(left.map_or(0.0, |mm| mm / (furthest_mm + LITTLE_MM)));
        let (up, down) = (self.work(0, self.loaded), -self.work(self.held, last));
        let known = f32::from(u8::from(left.is_some() && up > 0.0));
        row.push(known * ((down.max(0.0) + 0.05) / (up.max(0.0) + 0.05)).ln());
        let of_box = self.forces_n[self.loaded] * furthest_mm;
        let known = f32::from(u8::from(self.approach_mm(self.loaded).is_some()));
        row.push(known * ((up.max(0.0) + 0.05) / (of_box + 0.05)).ln());
    }

    /// The work of the force between two frames, in mJ. 0 where the approach is unknown.
    fn work(&self, first: usize, last: usize) -> f32 {
        let step = |place: usize| {
            let way = self.approach_mm(place + 1)? - self.approach_mm(place)?;
            Some(0.5 * (self.forces_n[place] + self.forces_n[place + 1]) * way)
        };
        (first..last).filter_map(step).sum()
    }
}

/// The slope of a line through points by least squares. Points that hardly differ in x give a slope
/// near 0.
fn slope(points: &[(f32, f32)]) -> f32 {
    let points: Vec<(f64, f64)> = points.iter().map(|&(x, y)| (x.into(), y.into())).collect();
    let line::Sums { count, xx, xy, .. } = line::Sums::of(&points);
    (xy / (xx + 0.02 * count.max(1.0))) as f32
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn counts_of_0_04_n_give_the_features_of_their_millinewtons() {
        let of = |newtons: [f32; 2]| {
            let mut frame = ModelFrame::default();
            frame.newtons[..2].copy_from_slice(&newtons);
            of_frame(&frame)
        };
        let counts = of([5.0_f32, 10.0].map(|counts| counts * 0.04));
        let mut both = counts.into_iter().zip(of([0.2, 0.4]));
        assert!(both.all(|(one, other)| (one - other).abs() < 1e-4));
    }

    proptest! {
        #[test]
        fn every_press_has_finite_features(
            rows in proptest::collection::vec(
                (0.0..400.0_f32, 0.0..300.0_f32, proptest::option::of(-50.0..500.0_f32)), 1..48),
            period_s in 0.0..2.0_f32,
            arm_n_per_mm in 0.0..100.0_f32,
        ) {
            let moment = |(place, &(area, force_n, approach_mm)): (usize, &(f32, f32, _))| Moment {
                frame: frame_of(area, force_n),
                time_s: period_s * place as f32,
                approach_mm,
            };
            let moments: Vec<_> = rows.iter().enumerate().map(moment).collect();
            let features = of_press(&moments, arm_n_per_mm);
            prop_assert!(features.iter().all(|x| x.is_finite()), "{features:?}");
        }
    }
}
