//! Errors in what a robot reports. Training presses get these errors, because a network that was
//! trained on exact reports alone would trust every report.

use super::Felt;
use crate::settings::ArmReports;
use hardnessd_simulator::random::Stream;

/// The least number of frames of a press that is judged before its end or seen by a slower sensor.
const LEAST_FRAMES: usize = 3;
/// The slowest sensor sees one frame of this many.
const MOST_FRAMES_A_STEP: usize = 8;
/// A press takes this many times as long, at least and at most. The simulator presses in a second or two, and
/// a robot may hold for half a minute. Simulated creep has times of all magnitudes alike, so a press that is
/// drawn out is as likely as another.
const STRETCH: (f64, f64) = (0.5, 16.0);
impl ArmReports {
    /// The press as a robot might report it.
    pub(super) fn varied(&self, press: &Felt, stream: &mut Stream) -> Felt {
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
            press.arm_n_per_mm = 0.0;
            let moments = press.moments.iter_mut();
            moments.for_each(|moment| moment.approach_mm = None);
            return press;
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
        let reported = press.moments.iter();
        let reported = reported.filter_map(|of| Some((of.time_s, of.approach_mm?)));
        let reported: Vec<(f32, f32)> = reported.collect();
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

impl Felt {
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
        let pairs = self.moments.windows(2);
        let steps = pairs.map(|pair| pair[1].time_s - pair[0].time_s);
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
    let next = reported.partition_point(|&(moment_s, _)| moment_s <= time_s);
    let next = next.clamp(1, reported.len() - 1);
    let (before, after) = (reported[next - 1], reported[next]);
    before.1 + (after.1 - before.1) * (time_s - before.0) / (after.0 - before.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::verdict::Moment;
    use hardnessd_core::verdict::features::frame_of;

    fn press() -> Felt {
        let moment = |n: u8| Moment {
            frame: frame_of(9.0, 1.0),
            time_s: 0.1 * f32::from(n),
            approach_mm: Some(0.5 * f32::from(n)),
        };
        Felt {
            moments: (0..10).map(moment).collect(),
            arm_n_per_mm: 10.0,
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
        let drawn: Vec<Felt> = (0..1000)
            .map(|_| ArmReports::default().varied(&press(), &mut stream))
            .collect();
        let share = |is: fn(&Felt) -> bool| drawn.iter().filter(|press| is(press)).count();
        assert!((240..360).contains(&share(|p| p.moments[0].approach_mm.is_none())));
        // A quarter of the presses end early. Of the others, three in ten have a slower sensor.
        assert!((410..540).contains(&share(|p| p.moments.len() < 10)));
        assert!(drawn.iter().all(|p| p.moments.len() >= 3));
    }
}
