use super::*;

/// A frame of `area` taxels sharing `force_n`.
fn frame(area: usize, force_n: f32) -> Frame {
    let mut frame = Frame::default();
    for newtons in frame.newtons.iter_mut().take(area) {
        *newtons = force_n / area as f32;
    }
    frame
}

fn moment(frame: u64, rate_hz: u64) -> FrameAt {
    let mono = Duration::from_nanos(frame * 1_000_000_000 / rate_hz);
    let wall = jiff::Timestamp::UNIX_EPOCH + mono;
    FrameAt {
        frame,
        stamp: Stamp { mono, wall },
    }
}

/// Tracks `loads` and writes each change as a letter with its frame: b begin, s settled, e end, t
/// timeout, x aborted.
fn track(settings: &Thresholds, loads: &[(usize, f32)], rate_hz: u64) -> String {
    let mut tracker = PressTracker::new(settings.clone());
    let mut text = Vec::new();
    for (number, &(area, force_n)) in (0..).zip(loads) {
        for change in tracker.push(
            &frame(area, force_n),
            Marks::default(),
            moment(number, rate_hz),
        ) {
            text.push(match change {
                Change::Begin { press, at } => format!("b{press}@{}", at.frame),
                Change::Settled { press } => format!("s@{number}:{}", press.peak().moment.frame),
                Change::End {
                    last,
                    frames,
                    end,
                    press,
                } => format!(
                    "{}@{number}:last{} n{frames} peak{}",
                    if end == End::Release { 'e' } else { 't' },
                    last.frame,
                    press.peak().moment.frame
                ),
                Change::Aborted {
                    last,
                    frames,
                    reason,
                    ..
                } => {
                    format!(
                        "x@{number}:last{} n{frames} {}",
                        last.frame,
                        reason.reason()
                    )
                }
            });
        }
    }
    text.join(" ")
}

fn check(settings: &Thresholds, cases: &[(&[(usize, f32)], &str)]) {
    for (loads, expected) in cases {
        assert_eq!(track(settings, loads, 5), *expected, "{loads:?}");
    }
}

const TOUCH: (usize, f32) = (5, 2.0);
const FREE: (usize, f32) = (0, 0.0);

#[test]
fn a_press_runs_from_its_begin_area_to_its_release() {
    check(
        &Thresholds::default(),
        &[
            (
                &[FREE, (2, 9.), (3, 1.), (9, 5.), (5, 3.), FREE, FREE],
                "b1@2 e@6:last4 n3 peak3",
            ),
            // One empty frame does not end it.
            (
                &[(3, 1.), FREE, (4, 2.), FREE, FREE],
                "b1@0 e@4:last2 n2 peak2",
            ),
            // A press of one frame is short.
            (
                &[(3, 1.), FREE, FREE, (3, 1.)],
                "b1@0 x@2:last0 n1 short b2@3",
            ),
            // Ties of area go to the force, then to the earlier frame.
            (
                &[(5, 1.), (5, 3.), (5, 3.), (5, 2.), FREE, FREE],
                "b1@0 e@5:last3 n4 peak1",
            ),
        ],
    );
    // Frames below the end area release, though something is touched.
    let settings = Thresholds {
        begin_area_taxels: 5,
        end_area_taxels: 3,
        early_settle_s: 9.0,
        ..Thresholds::default()
    };
    let few = (2, 2.);
    let loads = &[(4, 9.), TOUCH, (3, 2.), few, few, (4, 9.), TOUCH];
    check(&settings, &[(loads, "b1@1 e@4:last2 n2 peak1 b2@6")]);
    // The same holds after a timeout.
    let settings = Thresholds {
        max_seconds: 0.2,
        ..settings
    };
    let loads = &[TOUCH, TOUCH, few, few, TOUCH];
    check(&settings, &[(loads, "b1@0 t@1:last1 n2 peak0 b2@4")]);
}

#[test]
fn equal_counts_are_a_tie_however_their_newtons_are_rounded() {
    let mut tracker = PressTracker::new(Thresholds::default());
    let mut changes = Vec::new();
    // In f32, the second force is greater by 7e-9 N.
    let counts = [[2_u8, 5, 6], [3, 4, 6], [0; 3], [0; 3]];
    for (number, counts) in (0..).zip(counts) {
        let mut frame = Frame::default();
        for (newtons, count) in frame.newtons.iter_mut().zip(counts) {
            *newtons = 0.04 * f32::from(count);
        }
        changes.extend(tracker.push(&frame, Marks::default(), moment(number, 5)));
    }
    let ended = changes.into_iter().find_map(|change| match change {
        Change::End { press, .. } => Some(press),
        _ => None,
    });
    assert_eq!(ended.unwrap().peak().moment.frame, 0);
}

#[test]
fn a_held_press_times_out_once_and_waits_for_release() {
    let settings = Thresholds {
        max_seconds: 1.0,
        early_settle_s: 9.0,
        ..Thresholds::default()
    };
    let held = [&[TOUCH; 8][..], &[FREE, TOUCH, FREE, FREE, TOUCH]].concat();
    // The release that had begun at the limit counts.
    let released = [&[TOUCH; 5][..], &[FREE, FREE, TOUCH]].concat();
    check(
        &settings,
        &[
            (&held, "b1@0 t@5:last5 n6 peak0 b2@12"),
            (&released, "b1@0 t@5:last4 n5 peak0 b2@7"),
        ],
    );
    // A press too short for a verdict at its limit is aborted.
    let settings = Thresholds {
        max_seconds: 0.4,
        min_frames: 9,
        ..Thresholds::default()
    };
    check(&settings, &[(&[TOUCH; 4], "b1@0 s@2:0 x@2:last2 n3 short")]);
}

#[test]
fn a_contact_settles_within_a_taxel_or_5_percent_of_its_largest_area_and_force() {
    let settles = |loads: &[(usize, f32)]| track(&Thresholds::default(), loads, 5).contains(" s@");
    for (loads, expected) in [
        (&[(100, 8.), (95, 8.), (95, 8.)][..], true),
        (&[(100, 8.), (94, 8.), (94, 8.)], false),
        (&[(5, 8.), (4, 8.), (4, 8.)], true),
        (&[(5, 8.), (3, 8.), (3, 8.)], false),
        (&[(100, 8.), (100, 7.625), (100, 7.625)], true),
        (&[(100, 8.), (100, 7.5), (100, 7.5)], false),
        // One far frame among them prevents settling.
        (&[(100, 8.), (94, 8.), (100, 8.)], false),
        // Several far frames do too, once a greater force comes.
        (&[(5, 0.5), (5, 0.5), (5, 0.5), (5, 8.)], false),
        // The force is the least for a verdict, and a little less.
        (&[(4, 1.), (4, 1.), (4, 1.)], true),
        (&[(4, 0.9375), (4, 0.9375), (4, 0.9375)], false),
    ] {
        assert_eq!(settles(loads), expected, "{loads:?}");
    }
}

#[test]
fn settled_contact_is_reported_once_and_never_while_the_load_rises() {
    // At 6 % a frame, every new frame makes the frame two before it too far away.
    let rising: Vec<(usize, f32)> = (0..20).map(|i| (30, 4.0 * 1.06_f32.powi(i))).collect();
    check(
        &Thresholds::default(),
        &[
            // At 5 frames/s, three frames within 5 % span 0.4 s.
            (
                &[TOUCH, (9, 6.), (12, 10.), (12, 9.9), (12, 9.8), (12, 9.8)],
                "b1@0 s@4:2",
            ),
            (&rising, "b1@0"),
            // The force is too small for an early verdict.
            (&[(5, 0.9); 5], "b1@0"),
            // The force of the current frame counts, not the largest one.
            (&[(5, 1.02), (5, 1.02), (5, 0.98)], "b1@0"),
        ],
    );
    // At high rates, settling needs its time.
    let text = track(&Thresholds::default(), &[(10, 5.0); 40], 100);
    assert_eq!(text, "b1@0 s@30:0");
}

#[test]
fn an_aborted_press_leaves_the_tracker_idle_and_a_loss_does_not_release_what_timed_out() {
    let push = |tracker: &mut PressTracker, number| {
        tracker.push(&frame(5, 2.0), Marks::default(), moment(number, 5))
    };
    let mut tracker = PressTracker::new(Thresholds {
        max_seconds: 0.2,
        ..Thresholds::default()
    });
    assert_eq!(tracker.abort(Abort::Lost), None);
    push(&mut tracker, 0);
    assert!(matches!(
        tracker.abort(Abort::Lost),
        Some(Change::Aborted {
            press: 1,
            frames: 1,
            reason: Abort::Lost,
            ..
        })
    ));
    assert!(!tracker.is_pressed());
    push(&mut tracker, 1);
    push(&mut tracker, 2);
    assert_eq!(tracker.abort(Abort::Lost), None, "it timed out");
    assert_eq!(push(&mut tracker, 3), []);
}
