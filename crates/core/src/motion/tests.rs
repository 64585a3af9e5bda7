use proptest::prelude::*;

use super::*;

const MS: i64 = 1_000_000;

/// The points of an arm at a steady 10 mm/s, one every `step_ms`.
fn steady(from_ms: i64, to_ms: i64, step_ms: usize) -> Vec<Point> {
    (from_ms..=to_ms)
        .step_by(step_ms)
        .map(|ms| Point {
            at_ns: ms * MS,
            mm: 0.01 * ms as f64,
        })
        .collect()
}

fn at(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn approach(points: &[Point], begin: u64, moments: &[u64]) -> Option<Vec<Option<f64>>> {
    let mut track = Track::default();
    let _ = track.push(points);
    let moments: Vec<Duration> = moments.iter().map(|&ms| at(ms)).collect();
    track.approach(at(begin), &moments, 0.0)
}

fn close(found: Option<Vec<Option<f64>>>, expected: &[Option<f64>]) {
    let found = found.expect("the approach is known");
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(expected) {
        match (found, expected) {
            (Some(found), Some(expected)) => assert!((found - expected).abs() < 1e-9),
            (found, expected) => assert_eq!(found, expected),
        }
    }
}

#[test]
fn positions_are_interpolated_and_count_from_the_begin() {
    let points = steady(0, 5000, 70);
    let expected = [Some(0.0), Some(0.33), Some(12.0)];
    close(approach(&points, 1001, &[1001, 1034, 2201]), &expected);
}

#[test]
fn a_delay_looks_that_much_earlier() {
    let mut track = Track::default();
    let mut points = steady(0, 2000, 50);
    // The arm stops at 1 s.
    for point in &mut points {
        point.mm = point.mm.min(10.0);
    }
    track.push(&points).unwrap();
    let moments = [at(900), at(1000), at(1100), at(1200)];
    let reported = |delay_ms| track.approach(at(900), &moments, delay_ms).unwrap();
    let values = |reported: Vec<Option<f64>>| reported.into_iter().map(|mm| mm.unwrap().round());
    assert!(values(reported(0.0)).eq([0.0, 1.0, 1.0, 1.0]));
    assert!(values(reported(100.0)).eq([0.0, 1.0, 2.0, 2.0]));
    assert!(values(reported(-100.0)).eq([0.0, 0.0, 0.0, 0.0]));
}

#[test]
fn what_is_missing_jumps_or_steps_back_is_unknown_for_its_press_alone() {
    let hole = |from: i64, to: i64| {
        let mut points = steady(0, 10_000, 50);
        points.retain(|p| !(from..to).contains(&(p.at_ns / MS)));
        points
    };
    let presses = |points: &[Point]| {
        [(1000, 2000), (4000, 5000), (8000, 9000)]
            .map(|(begin, end)| approach(points, begin, &[begin, begin + 500, end]).is_some())
    };
    assert_eq!(presses(&hole(0, 0)), [true, true, true]);
    // 250 ms are not a gap, 300 ms are.
    assert_eq!(presses(&hole(4300, 4500)), [true, true, true]);
    assert_eq!(presses(&hole(4300, 4550)), [true, false, true]);
    // The positions used reach from the last one before the press to the first one after it.
    assert_eq!(presses(&hole(3750, 4050)), [true, false, true]);
    assert_eq!(presses(&hole(4950, 5300)), [true, false, true]);
    assert_eq!(presses(&hole(3000, 3950)), [true, true, true]);
    assert_eq!(presses(&hole(8500, 20_000)), [true, true, false]);
    assert_eq!(presses(&hole(0, 4010)), [false, false, true]);

    let mut jump = hole(0, 0);
    jump[90].mm += 21.0;
    assert_eq!(presses(&jump), [true, false, true]);
    jump[90].mm -= 2.0;
    assert_eq!(presses(&jump), [true, true, true]);

    let mut back = hole(0, 0);
    back.insert(90, back[85]);
    assert_eq!(presses(&back), [true, false, true]);
    back[90] = back[89];
    assert_eq!(presses(&back), [true, false, true]);
}

#[test]
fn a_step_back_is_told_and_time_goes_on_from_there() {
    let mut track = Track::default();
    track.push(&steady(0, 5000, 50)).unwrap();
    let again = steady(2000, 9000, 50);
    let back = track.push(&again).unwrap_err();
    assert_eq!((back.index, back.back_ms), (0, 3000.0));
    // The track does not trust moments that came twice. It trusts later ones.
    assert_eq!(track.approach(at(4000), &[at(4500)], 0.0), None);
    let expected = [Some(5.0)];
    close(track.approach(at(6000), &[at(6500)], 0.0), &expected);
}

#[test]
fn where_a_clock_was_set_is_unknown_and_presses_on_either_side_are_not() {
    let mut track = Track::default();
    track.push(&steady(0, 2000, 50)).unwrap();
    track.clock_set(2300 * MS);
    track.push(&steady(2200, 4000, 50)).unwrap();
    let known = |begin, last| {
        track
            .approach(at(begin), &[at(begin), at(last)], 0.0)
            .is_some()
    };
    assert!(known(1000, 1990));
    assert!(!known(1000, 2000));
    assert!(!known(1900, 3000));
    assert!(
        !known(2250, 3000),
        "its points may be of the earlier setting"
    );
    assert!(known(2301, 3000));
    // Without a position before it, everything up to then is uncertain.
    let mut track = Track::default();
    track.clock_set(500 * MS);
    track.push(&steady(0, 2000, 50)).unwrap();
    assert!(track.is_possible());
    assert_eq!(track.approach(at(400), &[at(900)], 0.0), None);
    assert!(track.approach(at(501), &[at(900)], 0.0).is_some());
}

#[test]
fn moments_after_the_latest_position_are_unknown_by_themselves() {
    let points = steady(0, 2000, 50);
    let expected = [Some(0.0), Some(5.0), None];
    close(approach(&points, 1500, &[1500, 2000, 2250]), &expected);
    assert_eq!(approach(&points, 1500, &[1500, 2000, 2251]), None);
    assert_eq!(approach(&points, 2100, &[2100, 2200]), None);
    assert_eq!(approach(&[], 0, &[0]), None);
}

#[test]
fn a_minute_is_held() {
    let mut track = Track::default();
    track.push(&steady(0, 61_000, 50)).unwrap();
    assert_eq!(track.approach(at(900), &[at(1200)], 0.0), None);
    assert!(track.approach(at(1100), &[at(1200)], 0.0).is_some());
    assert!(track.has_recent(at(120_000), 0.0));
    assert!(!track.has_recent(at(121_001), 0.0));
    assert!(!Track::default().has_recent(at(0), 0.0));
}

#[test]
fn a_flood_is_bounded() {
    let mut track = Track::default();
    let flood: Vec<Point> = (0..200_000).map(|n| Point { at_ns: n, mm: 0.0 }).collect();
    track.push(&flood).unwrap();
    assert_eq!(track.points.len(), MOST_POINTS);
    for n in 0..100 {
        track
            .push(&[Point {
                at_ns: 300_000 - n,
                mm: 0.0,
            }])
            .ok();
    }
    assert!(track.doubts.len() <= MOST_DOUBTS);
    assert!(track.is_possible());
    assert_eq!(track.counts(), (200_100, 0));
}

#[test]
fn a_point_after_its_final_verdict_is_late() {
    let mut track = Track::default();
    track.push(&steady(0, 1000, 50)).unwrap();
    track.judged(at(1200), 100.0);
    track.push(&steady(1050, 1300, 50)).unwrap();
    assert_eq!(track.counts(), (27, 2));
}

/// Positions as a robot may send them: mostly in order, with gaps, jumps and steps back.
fn reported() -> impl Strategy<Value = Vec<Point>> {
    let step = prop_oneof![
        8 => 1..100_i64,
        1 => 200..400_i64,
        1 => -300..1_i64,
    ];
    let moved = prop_oneof![12 => -2.0..2.0_f64, 1 => -40.0..40.0_f64];
    prop::collection::vec((step, moved), 0..200).prop_map(|steps| {
        let (mut at_ns, mut mm) = (0, 0.0);
        let mut point = |(step, moved): (i64, f64)| {
            at_ns += step * MS;
            mm += moved;
            Point { at_ns, mm }
        };
        steps.into_iter().map(&mut point).collect()
    })
}

proptest! {
    #[test]
    fn whatever_is_told_the_approach_is_between_told_positions_or_unknown(
        points in reported(),
        cuts in prop::collection::vec(0..200_usize, 0..8),
        begin in 0..6000_u64,
        frames in prop::collection::vec(1..300_u64, 1..40),
    ) {
        let mut moments = vec![at(begin)];
        for step in frames {
            let last = moments[moments.len() - 1];
            moments.push(last + at(step));
        }
        let mut whole = Track::default();
        let _ = whole.push(&points);
        prop_assert!(whole.is_possible());
        // The division into lines makes no difference.
        let mut cut = Track::default();
        let mut ends: Vec<usize> = cuts.into_iter().map(|end| end.min(points.len())).collect();
        ends.extend([0, points.len()]);
        ends.sort_unstable();
        for ends in ends.windows(2) {
            let _ = cut.push(&points[ends[0]..ends[1]]);
        }
        prop_assert_eq!(&whole, &cut);

        let reported = whole.approach(at(begin), &moments, 0.0);
        // A recording, which holds fewer points, gives the same answer.
        prop_assert_eq!(&whole.since(at(begin)).approach(at(begin), &moments, 0.0), &reported);
        let Some(reported) = reported else { return Ok(()) };
        let last = moments[moments.len() - 1].as_nanos() as i64;
        let near = |ns: i64| points.iter().any(|p| (p.at_ns - ns).abs() <= LONGEST_GAP_NS);
        prop_assert!(near(begin as i64 * MS) && near(last));
        // No step back falls into the press.
        let mut latest = i64::MIN;
        for point in &points {
            let falls_in = point.at_ns <= last && latest >= begin as i64 * MS;
            prop_assert!(point.at_ns > latest || !falls_in);
            latest = point.at_ns;
        }
        let (low, high) = points.iter().fold((f64::MAX, f64::MIN), |(low, high), p| {
            (low.min(p.mm), high.max(p.mm))
        });
        prop_assert_eq!(reported[0], Some(0.0));
        for (moment, mm) in moments.iter().zip(&reported) {
            let is_reported = whole.points.back().is_some_and(|p| p.at_ns >= moment.as_nanos() as i64);
            prop_assert_eq!(mm.is_some(), is_reported);
            prop_assert!(mm.is_none_or(|mm| mm.abs() <= high - low + 1e-9));
        }
    }
}

#[test]
fn the_latest_approach_is_behind_by_no_more_than_a_gap() {
    let mut track = Track::default();
    track.push(&steady(0, 1000, 10)).unwrap();
    let latest = |begin, now| track.latest(at(begin), at(now), 0.0);
    for (now, expected) in [
        (500, Some(3.0)),
        (1000, Some(8.0)),
        (1200, Some(8.0)),
        (1300, None),
    ] {
        let found = latest(200, now);
        let is_close = found
            .zip(expected)
            .is_none_or(|(a, b)| f64::abs(a - b) < 1e-9);
        assert!(
            is_close && found.is_some() == expected.is_some(),
            "{now}: {found:?}"
        );
    }
    assert_eq!(
        latest(1100, 1200),
        None,
        "nobody knows where it was at the begin"
    );
}
