//! Errors in what a robot reports. Training presses get these errors, because a network that was
//! trained on exact reports alone would trust every report.

use super::Press;
use crate::data::presses::Timed;
use crate::settings::ArmReports;
use hardnessd_core::verdict::{Extents, extents};
use hardnessd_simulator::random::Stream;

/// The least number of frames of a press that is judged before its end or seen by a slower sensor.
const LEAST_FRAMES: usize = 3;
/// The slowest sensor sees one frame of this many.
const MOST_FRAMES_A_STEP: usize = 8;
/// A press takes this many times as long, at least and at most. The simulator presses in a second or two, and
/// a robot may hold for half a minute. Simulated creep has times of all magnitudes alike, so a press that is
/// drawn out is as likely as another.
const STRETCH: (f64, f64) = (0.5, 16.0);
/// This share of the training presses lies below a range of [`ArmReports::ranges`], and the same
/// share above. The longest of a hundred thousand presses says little about training.
const TAIL: f64 = 0.001;
/// A range is at least this much wider at both ends, relatively, so that rounding does not count.
const MARGIN: f64 = 0.01;

impl ArmReports {
    /// The press as a robot might report it.
    pub(super) fn varied(&self, press: &Press, stream: &mut Stream) -> Press {
        let mut press = press.clone();
        if stream.uniform() < self.slower {
            press.slow_down(stream);
        }
        if self.stretched > 0.0 && stream.uniform() < self.stretched {
            press.stretch(stream.range(STRETCH.0.ln(), STRETCH.1.ln()).exp());
        }
        if stream.uniform() < self.early && press.moments.len() > LEAST_FRAMES {
            let frames = LEAST_FRAMES + stream.below(press.moments.len() - LEAST_FRAMES);
            press.moments.truncate(frames);
        }
        if stream.uniform() < self.unknown {
            return press.without_arm();
        }
        if stream.uniform() < self.unknown_arm {
            press.arm_n_per_mm = 0.0;
        }
        if stream.uniform() < self.exact {
            return press;
        }
        let mut off = |most: f64| stream.range(-most, most);
        let (position, arm) = (1.0 + off(self.position), 1.0 + off(self.arm));
        let late_frames = off(self.clock_frames);
        press.arm_n_per_mm *= arm as f32;
        let late_s = (late_frames * press.period_s()) as f32;
        let reported: Vec<(f32, f32)> = press
            .moments
            .iter()
            .filter_map(|moment| Some((moment.time_s, moment.approach_mm?)))
            .collect();
        let Some(begin) = reported.first().map(|_| at(&reported, late_s)) else {
            return press;
        };
        for moment in &mut press.moments {
            if moment.approach_mm.is_some() {
                let late = at(&reported, moment.time_s + late_s);
                moment.approach_mm = Some((late - begin) * position as f32);
            }
        }
        press
    }
}

impl ArmReports {
    /// The ranges of the training presses as training changes them: with the robot's errors, judged
    /// before the end, as a slower sensor sees them, and stretched. Each change counts alone, because
    /// hardly a press has two of them to their ends. Of each number, about one in a thousand presses
    /// lies below the range and one in a thousand above.
    pub fn ranges(&self, presses: &[Timed]) -> Extents {
        // Of the first frames of a press.
        let of = |press: &Timed, frames: usize| {
            let frames = frames.min(press.moments.len());
            extents(&press.moments[..frames], press.arm_n_per_mm)
        };
        let whole = ranges_of(presses.iter().map(|press| of(press, usize::MAX)));
        let mut ranges = vec![whole];
        if self.early > 0.0 {
            ranges.push(ranges_of(
                presses.iter().map(|press| of(press, LEAST_FRAMES)),
            ));
        }
        if self.slower > 0.0 {
            ranges.push(ranges_of(presses.iter().map(|press| {
                let step = (press.moments.len() / LEAST_FRAMES).clamp(1, MOST_FRAMES_A_STEP);
                let [_, period, ..] = of(press, usize::MAX);
                let slower = period.map(|ends| ends.map(|period_s| period_s * step as f32));
                [None, slower, None, None, None]
            })));
        }
        if self.stretched > 0.0 {
            for factor in [STRETCH.0 as f32, STRETCH.1 as f32] {
                let longer = |ends: [f32; 2]| ends.map(|time_s| time_s * factor);
                let slower = |ends: [f32; 2]| ends.map(|mm_s| mm_s / factor);
                let [duration, period, speed, ..] = whole;
                let times = [duration.map(longer), period.map(longer)];
                ranges.push([times[0], times[1], speed.map(slower), None, None]);
            }
        }
        let unknown_arm = self.unknown.max(self.unknown_arm);
        let unknown = [0.0, 0.0, self.unknown, self.unknown, unknown_arm];
        let errors = [0.0, 0.0, self.position, self.position, self.arm];
        std::array::from_fn(|number| {
            let ends = ranges.iter().filter_map(|range| range[number]);
            let joined = ends.reduce(|one, other| [one[0].min(other[0]), one[1].max(other[1])]);
            let [least, most] = joined.filter(|_| unknown[number] < 1.0)?;
            let error = errors[number].max(MARGIN) as f32;
            Some([least * (1.0 - error), (most * (1.0 + error)).min(f32::MAX)])
        })
    }
}

/// The range of each number: between the quantiles [`TAIL`] and 1 - [`TAIL`] of the presses for
/// which it is known.
fn ranges_of(presses: impl Iterator<Item = Extents>) -> Extents {
    let all: Vec<Extents> = presses.collect();
    std::array::from_fn(|number| {
        let known = all.iter().filter_map(|press| press[number]);
        let known = known.filter(|[low, _]| low.is_finite());
        let (mut lows, mut highs): (Vec<f32>, Vec<f32>) =
            known.map(|[low, high]| (low, high)).unzip();
        lows.sort_unstable_by(f32::total_cmp);
        highs.sort_unstable_by(f32::total_cmp);
        let tail = (TAIL * lows.len() as f64) as usize;
        // Where a press only bounds a number, the other presses tell its ends.
        let least = *highs.get(tail)?;
        let most = *lows.get(lows.len().checked_sub(1 + tail)?)?;
        Some([least.min(most).max(0.0), most.max(0.0)])
    })
}

impl Press {
    /// Keeps every k-th frame, from a randomly chosen first one. The first frame kept becomes the
    /// press's begin, from which times and the approach count.
    fn slow_down(&mut self, stream: &mut Stream) {
        let most = (self.moments.len() / LEAST_FRAMES).min(MOST_FRAMES_A_STEP);
        if most < 2 {
            return;
        }
        let step = 2 + stream.below(most - 1);
        let first = stream.below(step);
        let begin = self.moments[first];
        let kept = |of: usize| of >= first && (of - first).is_multiple_of(step);
        let mut of = 0..;
        self.moments.retain(|_| of.next().is_some_and(kept));
        for moment in &mut self.moments {
            moment.time_s -= begin.time_s;
            let way = moment.approach_mm.zip(begin.approach_mm);
            moment.approach_mm = way.map(|(mm, first)| mm - first);
        }
    }

    /// Makes everything take `factor` times as long.
    fn stretch(&mut self, factor: f64) {
        for moment in &mut self.moments {
            moment.time_s *= factor as f32;
        }
    }

    /// The shortest time between two frames of the press, at most 1 s.
    fn period_s(&self) -> f64 {
        let steps = self
            .moments
            .windows(2)
            .map(|pair| pair[1].time_s - pair[0].time_s);
        f64::from(steps.fold(f32::INFINITY, f32::min).min(1.0))
    }
}

/// The approach at `time_s`, interpolated between the moments of `reported`. Before the first moment it
/// is extrapolated; after the last it stays constant.
fn at(reported: &[(f32, f32)], time_s: f32) -> f32 {
    let [_, .., last] = reported else {
        return reported.first().map_or(0.0, |&(_, mm)| mm);
    };
    if time_s >= last.0 {
        return last.1;
    }
    // Before the begin, the arm moved at the speed between the first two moments.
    let next = reported
        .partition_point(|&(moment_s, _)| moment_s <= time_s)
        .clamp(1, reported.len() - 1);
    let (before, after) = (reported[next - 1], reported[next]);
    before.1 + (after.1 - before.1) * (time_s - before.0) / (after.0 - before.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::verdict::features::{Moment, frame_of};

    fn press() -> Press {
        let moment = |n: u8| Moment {
            frame: frame_of(9.0, 1.0),
            time_s: 0.1 * f32::from(n),
            approach_mm: Some(0.5 * f32::from(n)),
        };
        Press {
            moments: (0..10).map(moment).collect(),
            arm_n_per_mm: 10.0,
            level: 1,
            shore: Some(80.0),
            object: None,
            sensor: 0,
            piece: None,
        }
    }

    /// Reports that change nothing, but for this.
    fn but(change: fn(&mut ArmReports)) -> ArmReports {
        let mut reports = ArmReports {
            unknown: 0.0,
            unknown_arm: 0.0,
            exact: 1.0,
            position: 0.0,
            arm: 0.0,
            clock_frames: 0.0,
            early: 0.0,
            slower: 0.0,
            stretched: 0.0,
        };
        change(&mut reports);
        reports
    }

    #[test]
    fn errors_stay_within_what_was_asked_for() {
        let reports = but(|of| {
            (of.exact, of.position, of.arm, of.clock_frames) = (0.0, 0.1, 0.3, 1.0);
        });
        let mut stream = Stream::new(1, "reports");
        let mut moved = 0.0_f32;
        for _ in 0..200 {
            let press = reports.varied(&press(), &mut stream);
            assert!((7.0..=13.0).contains(&press.arm_n_per_mm));
            assert_eq!(press.moments[0].approach_mm, Some(0.0));
            let top = press.moments[9].approach_mm.unwrap();
            // The approach is 4.5 mm, plus or minus a tenth and the way of one frame.
            assert!((3.5..=5.5).contains(&top), "{top}");
            moved = moved.max((top - 4.5).abs());
        }
        assert!(moved > 0.4, "{moved}");
    }

    #[test]
    fn a_slower_sensor_sees_the_press_from_its_own_first_frame() {
        let reports = but(|of| of.slower = 1.0);
        let mut stream = Stream::new(3, "reports");
        let mut steps = std::collections::BTreeSet::new();
        for _ in 0..100 {
            let slow = reports.varied(&press(), &mut stream);
            let step_s = slow.moments[1].time_s;
            steps.insert((10.0 * step_s).round() as u32);
            assert!((3..=5).contains(&slow.moments.len()), "{slow:?}");
            for (place, moment) in (0_u8..).zip(&slow.moments) {
                let time_s = f32::from(place) * step_s;
                assert!((moment.time_s - time_s).abs() < 1e-5, "{slow:?}");
                // The arm moves at 5 mm/s.
                assert!((moment.approach_mm.unwrap() - 5.0 * time_s).abs() < 1e-4);
            }
        }
        assert_eq!(steps.into_iter().collect::<Vec<_>>(), [2, 3]);
    }

    #[test]
    fn shares_are_kept_and_an_early_press_has_three_frames() {
        let mut stream = Stream::new(2, "reports");
        let drawn: Vec<Press> = (0..1000)
            .map(|_| ArmReports::default().varied(&press(), &mut stream))
            .collect();
        let share = |is: fn(&Press) -> bool| drawn.iter().filter(|press| is(press)).count();
        assert!((240..360).contains(&share(|p| p.moments[0].approach_mm.is_none())));
        // A quarter of the presses end early. Of the others, three in ten have a slower sensor.
        assert!((410..540).contains(&share(|p| p.moments.len() < 10)));
        assert!(drawn.iter().all(|p| p.moments.len() >= 3));
    }

    /// A press at `speed_mm_s` of ten frames, with this time between them.
    fn pressed(speed_mm_s: f32, period_s: f32) -> Timed {
        let moment = |place: u8| {
            let time_s = period_s * f32::from(place);
            (time_s, Some(speed_mm_s * time_s))
        };
        Timed {
            moments: (0..10).map(moment).collect(),
            arm_n_per_mm: 10.0,
        }
    }

    #[test]
    fn ranges_are_those_of_the_presses_as_training_varies_them() {
        let [way, arm] = [Some([3.6, 3.6]), Some([10.0; 2])];
        let [duration, period, speed] = [Some([0.45, 0.9]), Some([0.05, 0.1]), Some([4.0, 8.0])];
        let (longer, slow) = (Some([0.225, 14.4]), Some([0.25, 16.0]));
        let (third, first) = (Some([0.05, 0.3]), [Some([0.1, 0.9]), Some([0.8, 3.6])]);
        for (reports, expected) in [
            (but(|_| ()), [duration, period, speed, way, arm]),
            // The first three frames of the faster sensor.
            (
                but(|of| of.early = 0.1),
                [first[0], period, speed, first[1], arm],
            ),
            // Every third frame of the slower one.
            (
                but(|of| of.slower = 0.1),
                [duration, third, speed, way, arm],
            ),
            // Sixteen times the slower one's period, and not sixteen times three.
            (
                but(|of| (of.slower, of.stretched) = (0.1, 0.1)),
                [longer, Some([0.025, 1.6]), slow, way, arm],
            ),
            (
                but(|of| of.unknown = 1.0),
                [duration, period, None, None, None],
            ),
            (
                but(|of| of.unknown_arm = 1.0),
                [duration, period, speed, way, None],
            ),
        ] {
            let found = reports.ranges(&[pressed(4.0, 0.1), pressed(8.0, 0.05)]);
            for (found, expected) in found.into_iter().zip(expected) {
                let wider = expected.map(|[low, high]: [f32; 2]| [low * 0.99, high * 1.01]);
                let near = |(a, b): (f32, f32)| (a / b - 1.0).abs() < 1e-4;
                let is_near = match (found, wider) {
                    (Some(a), Some(b)) => a.into_iter().zip(b).all(near),
                    (found, wider) => found == wider,
                };
                assert!(is_near, "{reports:?}: {found:?}, expected {wider:?}");
            }
        }
        let errors = but(|of| (of.position, of.arm) = (0.1, 0.3));
        let [.., speed, _, arm] = errors.ranges(&[pressed(4.0, 0.1)]);
        assert_eq!((speed, arm), (Some([3.6, 4.4]), Some([7.0, 13.0])));
        assert_eq!(but(|_| ()).ranges(&[]), [None; 5]);
    }

    #[test]
    fn one_press_of_many_is_no_range() {
        let mut presses: Vec<Timed> = (0..2000).map(|_| pressed(5.0, 0.1)).collect();
        presses[7] = pressed(5.0, 10.0);
        let [duration, ..] = but(|_| ()).ranges(&presses);
        assert!(duration.unwrap()[1] < 1.0, "{duration:?}");
        // Of a thousand presses, one is more than the tail.
        let [duration, ..] = but(|_| ()).ranges(&presses[..999]);
        assert!(duration.unwrap()[1] > 90.0, "{duration:?}");
    }
}
