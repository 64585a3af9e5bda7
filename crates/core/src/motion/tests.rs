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

fn track(points: &[Point]) -> Track {
    let mut track = Track::default();
    let _ = track.push(points);
    track
}

/// The approach in hundredths of a millimetre.
fn approach(track: &Track, begin: u64, moments: &[u64]) -> Option<Vec<Option<f64>>> {
    let moments: Vec<Duration> = moments.iter().map(|&ms| at(ms)).collect();
    let known = track.approach(at(begin), &moments, 0.0)?;
    let rounded = |mm: Option<f64>| mm.map(|mm| (100.0 * mm).round());
    Some(known.into_iter().map(rounded).collect())
}

#[test]
fn positions_are_interpolated_and_none_is_made_up_after_the_latest() {
    let every_70_ms = track(&steady(0, 5000, 70));
    let known = approach(&every_70_ms, 1001, &[1001, 1034, 2201]);
    assert_eq!(known, Some(vec![Some(0.0), Some(33.0), Some(1200.0)]));
    let until_2_s = track(&steady(0, 2000, 50));
    for (begin, moments, known) in [
        (
            1500,
            &[1500, 2000, 2250][..],
            Some(vec![Some(0.0), Some(500.0), None]),
        ),
        (1500, &[1500, 2000, 2251], None),
        (2100, &[2100, 2200], None),
    ] {
        assert_eq!(approach(&until_2_s, begin, moments), known, "{moments:?}");
    }
    assert_eq!(approach(&Track::default(), 0, &[0]), None);
}

#[test]
fn what_is_missing_jumps_or_steps_back_is_unknown_for_its_press_alone() {
    let hole = |from: i64, to: i64| {
        let mut points = steady(0, 10_000, 50);
        points.retain(|p| !(from..to).contains(&(p.at_ns / MS)));
        points
    };
    // Of each press, the points that came until a little after its end.
    let presses = |points: &[Point]| {
        [(1000, 2000), (4000, 5000), (8000, 9000)].map(|(begin, end)| {
            let is_later = |point: &Point| point.at_ns > (end as i64 + 300) * MS;
            let until = points.iter().position(is_later).unwrap_or(points.len());
            let track = track(&points[..until]);
            approach(&track, begin, &[begin, begin + 500, end]).is_some()
        })
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
    let mut track = track(&steady(0, 5000, 50));
    let again = steady(2000, 9000, 50);
    let back = track.push(&again).unwrap_err();
    assert_eq!((back.index, back.back_ms), (0, 3000.0));
    assert_eq!(approach(&track, 1900, &[2500]), None);
    assert_eq!(approach(&track, 6000, &[6500]), Some(vec![Some(500.0)]));
}

#[test]
fn a_minute_is_held_and_a_flood_is_bounded() {
    let mut track = Track::default();
    track.push(&steady(0, 61_000, 50)).unwrap();
    assert_eq!(approach(&track, 900, &[1200]), None);
    assert!(approach(&track, 1100, &[1200]).is_some());
    assert!(track.has_recent(at(120_000), 0.0));
    assert!(!track.has_recent(at(121_001), 0.0));
    let flood: Vec<Point> = (0..200_000).map(|n| Point { at_ns: n, mm: 0.0 }).collect();
    let mut track = Track::default();
    track.push(&flood).unwrap();
    assert_eq!(track.points.len(), MOST_POINTS);
    assert_eq!(track.counts(), (200_000, 0));
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
        let recorded = track(&whole.since(at(begin)));
        prop_assert_eq!(&recorded.approach(at(begin), &moments, 0.0), &reported);
        let Some(reported) = reported else { return Ok(()) };
        let last = moments[moments.len() - 1].as_nanos() as i64;
        // Only the points since the last step back count.
        let backs = points.windows(2).rposition(|pair| pair[1].at_ns <= pair[0].at_ns);
        let points = &points[backs.map_or(0, |at| at + 1)..];
        let near = |ns: i64| points.iter().any(|p| (p.at_ns - ns).abs() <= LONGEST_GAP_NS);
        prop_assert!(near(begin as i64 * MS) && near(last));
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
    let track = track(&steady(0, 1000, 10));
    for (begin, now, expected) in [
        (200, 500, Some(300.0)),
        (200, 1000, Some(800.0)),
        (200, 1200, Some(800.0)),
        (200, 1300, None),
        // Nobody knows where the arm was when the press began.
        (1100, 1200, None),
    ] {
        let latest = track.latest(at(begin), at(now), 0.0);
        let latest = latest.map(|mm| (100.0 * mm).round());
        assert_eq!(latest, expected, "{begin} to {now}");
    }
}
