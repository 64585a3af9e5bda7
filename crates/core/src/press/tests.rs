use super::*;
use crate::frame::Pitch;

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
                Change::Settled { peak, .. } => format!("s@{number}:{}", peak.moment.frame),
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

fn check(loads: &[(usize, f32)], expected: &str) {
    assert_eq!(track(&Thresholds::default(), loads, 5), expected);
}

#[test]
fn a_press_runs_from_begin_area_to_release() {
    check(
        &[
            (0, 0.),
            (2, 9.),
            (3, 1.),
            (9, 5.),
            (5, 3.),
            (0, 0.),
            (0, 0.),
        ],
        "b1@2 e@6:last4 n3 peak3",
    );
}

#[test]
fn one_empty_frame_does_not_end_a_press() {
    check(
        &[(3, 1.), (0, 0.), (4, 2.), (0, 0.), (0, 0.)],
        "b1@0 e@4:last2 n2 peak2",
    );
}

#[test]
fn a_press_of_one_frame_is_short() {
    check(
        &[(3, 1.), (0, 0.), (0, 0.), (3, 1.)],
        "b1@0 x@2:last0 n1 short b2@3",
    );
}

#[test]
fn ties_of_area_go_to_force_then_to_the_earlier_frame() {
    check(
        &[(5, 1.), (5, 3.), (5, 3.), (5, 2.), (0, 0.), (0, 0.)],
        "b1@0 e@5:last3 n4 peak1",
    );
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
    let mut loads = vec![(5, 2.0); 8];
    loads.extend([(0, 0.0), (5, 2.0), (0, 0.0), (0, 0.0), (5, 2.0)]);
    assert_eq!(track(&settings, &loads, 5), "b1@0 t@5:last5 n6 peak0 b2@12");
}

#[test]
fn a_press_held_at_its_limit_counts_the_release_it_has_begun() {
    let settings = Thresholds {
        max_seconds: 1.0,
        early_settle_s: 9.0,
        ..Thresholds::default()
    };
    let mut loads = vec![(5, 2.0); 5];
    loads.extend([(0, 0.0), (0, 0.0), (5, 2.0)]);
    assert_eq!(track(&settings, &loads, 5), "b1@0 t@5:last4 n5 peak0 b2@7");
}

#[test]
fn a_press_too_short_for_a_verdict_at_its_limit_is_aborted() {
    let settings = Thresholds {
        max_seconds: 0.4,
        min_frames: 9,
        ..Thresholds::default()
    };
    assert_eq!(
        track(&settings, &[(5, 2.0); 4], 5),
        "b1@0 s@2:0 x@2:last2 n3 short"
    );
}

#[test]
fn frames_below_the_end_area_release_though_something_is_touched() {
    let settings = Thresholds {
        begin_area_taxels: 5,
        end_area_taxels: 3,
        early_settle_s: 9.0,
        ..Thresholds::default()
    };
    let loads = [
        (4, 9.),
        (5, 2.),
        (3, 2.),
        (2, 2.),
        (2, 2.),
        (4, 9.),
        (5, 2.),
    ];
    assert_eq!(track(&settings, &loads, 5), "b1@1 e@4:last2 n2 peak1 b2@6");
    // The same holds after a timeout.
    let settings = Thresholds {
        max_seconds: 0.2,
        ..settings
    };
    let loads = [(5, 2.), (5, 2.), (2, 2.), (2, 2.), (5, 2.)];
    assert_eq!(track(&settings, &loads, 5), "b1@0 t@1:last1 n2 peak0 b2@4");
}

#[test]
fn what_was_reloaded_holds_for_the_press_under_way() {
    let mut tracker = PressTracker::new(Thresholds::default());
    for number in 0..3 {
        let _ = tracker.push(&frame(5, 2.0), Marks::default(), moment(number, 5));
    }
    tracker.reload(Thresholds {
        end_frames: 1,
        ..Thresholds::default()
    });
    assert!(matches!(
        tracker.push(&frame(0, 0.0), Marks::default(), moment(3, 5))[..],
        [Change::End { frames: 3, .. }]
    ));
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
    // At 5 frames/s, three frames within 5 % span 0.4 s.
    check(
        &[(5, 2.), (9, 6.), (12, 10.), (12, 9.9), (12, 9.8), (12, 9.8)],
        "b1@0 s@4:2",
    );
    // At 6 % a frame, every new frame makes the frame two before it too far away.
    let rising: Vec<(usize, f32)> = (0..20).map(|i| (30, 4.0 * 1.06_f32.powi(i))).collect();
    check(&rising, "b1@0");
    // The force is too small for an early verdict.
    check(&[(5, 0.9); 5], "b1@0");
    // The force of the current frame counts, not the largest one.
    check(&[(5, 1.02), (5, 1.02), (5, 0.98)], "b1@0");
}

#[test]
fn settling_needs_its_time_at_high_rates() {
    let settings = Thresholds::default();
    let text = track(&settings, &[(10, 5.0); 40], 100);
    assert_eq!(text, "b1@0 s@30:0");
}

#[test]
fn the_frame_that_settles_a_recorded_press_is_the_trackers() {
    let settled_at = |loads: &[(usize, f32)]| {
        let frames: Vec<Frame> = loads.iter().map(|&(area, n)| frame(area, n)).collect();
        let stamped = frames.iter().zip(0..);
        let stamped =
            stamped.map(|(frame, number)| (moment(number, 5).stamp.mono, &frame.newtons[..]));
        first_settled(stamped, &Thresholds::default())
    };
    let loads = [(5, 2.), (9, 6.), (12, 10.), (12, 9.9), (12, 9.8), (12, 9.8)];
    check(&loads, "b1@0 s@4:2");
    assert_eq!(settled_at(&loads), Some(4));
    assert_eq!(settled_at(&loads[..4]), None);
}

#[test]
fn an_aborted_press_leaves_the_tracker_idle() {
    let mut tracker = PressTracker::new(Thresholds::default());
    assert_eq!(tracker.abort(Abort::Lost), None);
    let _ = tracker.push(&frame(5, 2.0), Marks::default(), moment(0, 5));
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
}

#[test]
fn a_loss_does_not_release_what_timed_out() {
    let mut tracker = PressTracker::new(Thresholds {
        max_seconds: 0.2,
        ..Thresholds::default()
    });
    for number in 0..2 {
        let _ = tracker.push(&frame(5, 2.0), Marks::default(), moment(number, 5));
    }
    assert_eq!(tracker.abort(Abort::Lost), None);
    assert_eq!(
        tracker.push(&frame(5, 2.0), Marks::default(), moment(2, 5)),
        []
    );
}

#[test]
fn what_is_out_of_range_is_told_as_it_was_written() {
    let settings = Settings {
        contact_threshold_n: Some(-0.07),
        ..Settings::default()
    };
    let refusal = settings.check(Array::JX255N, Pitch::JX255N);
    let refusal = refusal.unwrap_err().to_string();
    assert!(
        refusal.starts_with("contact_threshold_n: found -0.07, expected"),
        "{refusal}"
    );
}
