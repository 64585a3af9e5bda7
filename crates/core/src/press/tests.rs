use std::time::Duration;

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

fn contact(frame: &Frame, at: FrameAt) -> ContactFrame {
    ContactFrame::new(frame, Thresholds::default().contact_threshold_n, at)
}

fn tracker(settings: &Settings) -> PressTracker {
    PressTracker::new(settings.check(Array::JX255N, Pitch::JX255N).unwrap())
}

/// Tracks `loads` and writes each change as a letter with its frame: b begin, s settled, e end, t
/// timeout, x without a verdict.
fn track(settings: &Settings, loads: &[(usize, f32)], rate_hz: u64) -> String {
    let mut tracker = tracker(settings);
    let mut text = Vec::new();
    let mut was_settled = false;
    for (number, &(area, force_n)) in (0..).zip(loads) {
        let change = tracker.push(contact(&frame(area, force_n), moment(number, rate_hz)));
        let press = match &change {
            Some(Change::End { press, .. }) => Some(&**press),
            _ => tracker.so_far(),
        };
        let settled = press.filter(|press| press.is_settled);
        let peak = settled.map(|press| press.peak.moment.frame);
        text.extend(
            peak.filter(|_| !was_settled)
                .map(|peak| format!("s@{number}:{peak}")),
        );
        was_settled = peak.is_some();
        text.extend(change.map(|change| match change {
            Change::Begin { press, at } => format!("b{press}@{}", at.frame),
            Change::End { press, end } => {
                let letter = match end {
                    End::Release => 'e',
                    End::Timeout => 't',
                    _ => 'x',
                };
                let (last, frames) = (press.last().frame, press.frames);
                let peak = press.peak.moment.frame;
                format!("{letter}@{number}:last{last} n{frames} peak{peak}")
            }
        }));
    }
    text.join(" ")
}

fn check(settings: &Settings, cases: &[(&[(usize, f32)], &str)]) {
    for (loads, expected) in cases {
        assert_eq!(track(settings, loads, 5), *expected, "{loads:?}");
    }
}

const TOUCH: (usize, f32) = (5, 2.0);
const FREE: (usize, f32) = (0, 0.0);

#[test]
fn a_press_runs_from_its_begin_area_to_its_release() {
    check(
        &Settings::default(),
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
                "b1@0 x@2:last0 n1 peak0 b2@3",
            ),
            // Ties of area go to the force, then to the earlier frame.
            (
                &[(5, 1.), (5, 3.), (5, 3.), (5, 2.), FREE, FREE],
                "b1@0 e@5:last3 n4 peak1",
            ),
        ],
    );
    // Frames below the end area release, though something is touched.
    let settings = Settings {
        begin_area_taxels: Some(5),
        end_area_taxels: Some(3),
        early_settle_s: 9.0,
        ..Settings::default()
    };
    let few = (2, 2.);
    let loads = &[(4, 9.), TOUCH, (3, 2.), few, few, (4, 9.), TOUCH];
    check(&settings, &[(loads, "b1@1 e@4:last2 n2 peak1 b2@6")]);
    // The same holds after a timeout.
    let settings = Settings {
        max_seconds: 0.2,
        ..settings
    };
    let loads = &[TOUCH, TOUCH, few, few, TOUCH];
    check(&settings, &[(loads, "b1@0 t@1:last1 n2 peak0 b2@4")]);
}

#[test]
fn equal_counts_are_a_tie_however_their_newtons_are_rounded() {
    let mut tracker = tracker(&Settings::default());
    let mut ended = None;
    // In f32, the second force is greater by 7e-9 N.
    let counts = [[2_u8, 5, 6], [3, 4, 6], [0; 3], [0; 3]];
    for (number, counts) in (0..).zip(counts) {
        let mut frame = Frame::default();
        for (newtons, count) in frame.newtons.iter_mut().zip(counts) {
            *newtons = 0.04 * f32::from(count);
        }
        ended = tracker.push(contact(&frame, moment(number, 5)));
    }
    let Some(Change::End { press, .. }) = ended else {
        panic!("{ended:?}");
    };
    assert_eq!(press.peak.moment.frame, 0);
}

#[test]
fn a_held_press_times_out_once_and_waits_for_release() {
    let settings = Settings {
        max_seconds: 1.0,
        early_settle_s: 9.0,
        ..Settings::default()
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
    let settings = Settings {
        max_seconds: 0.4,
        min_frames: 9,
        ..Settings::default()
    };
    check(&settings, &[(&[TOUCH; 4], "b1@0 s@2:0 x@2:last2 n3 peak0")]);
}

#[test]
fn a_contact_settles_within_a_taxel_or_5_percent_of_its_largest_area_and_force() {
    let settles = |loads: &[(usize, f32)]| track(&Settings::default(), loads, 5).contains(" s@");
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
        &Settings::default(),
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
    let text = track(&Settings::default(), &[(10, 5.0); 40], 100);
    assert_eq!(text, "b1@0 s@30:0");
}

#[test]
fn an_aborted_press_leaves_the_tracker_idle_and_a_loss_does_not_release_what_timed_out() {
    let push = |tracker: &mut PressTracker, number| {
        tracker.push(contact(&frame(5, 2.0), moment(number, 5)))
    };
    let mut tracker = tracker(&Settings {
        max_seconds: 0.2,
        ..Settings::default()
    });
    assert_eq!(tracker.abort(End::Lost), None);
    push(&mut tracker, 0);
    let Some(Change::End { press, end }) = tracker.abort(End::Lost) else {
        panic!("the press goes on");
    };
    assert_eq!((press.press, press.frames, end), (1, 1, End::Lost));
    assert!(!tracker.is_pressed());
    push(&mut tracker, 1);
    push(&mut tracker, 2);
    assert_eq!(tracker.abort(End::Lost), None, "it timed out");
    assert_eq!(push(&mut tracker, 3), None);
}

/// A press whose frames have these contact areas.
fn of_areas(areas: impl IntoIterator<Item = u32>) -> SoFar {
    let mut frames = (0..).zip(areas).map(|(number, area)| ContactFrame {
        contact_area_taxels: area,
        ..contact(&Frame::default(), moment(number, 100))
    });
    let mut press = SoFar::new(1, frames.next().unwrap());
    frames.for_each(|frame| press.push(frame));
    press
}

#[test]
fn first_best_and_last_are_held_and_the_rest_is_even() {
    for count in [1, 2, 511, 512, 513, 1024, 1025, 5000] {
        let best = count / 3;
        let press = of_areas((0..count).map(|number| if number == best { 9 } else { 5 }));
        let frames = press.spread();
        let numbers: Vec<u64> = frames.iter().map(|frame| frame.moment.frame).collect();
        assert_eq!(numbers[press.best_of(&frames)], best, "{count}");
        assert_eq!((numbers[0], numbers.last()), (0, Some(&(count - 1))));
        assert_eq!((press.last().frame, press.frames), (count - 1, count));
        assert!(numbers.is_sorted_by(|one, next| one < next));
        assert!(numbers.len() >= 256.min(count as usize) && numbers.len() <= 514);
        let widest = numbers.windows(2).map(|pair| pair[1] - pair[0]).max();
        assert!(widest.unwrap_or(1) <= count.div_ceil(256), "{count}");
    }
}

#[test]
fn the_best_frame_of_a_part_is_the_best_until_then() {
    let press = of_areas([3, 5, 5, 4, 8, 8, 2]);
    let frames = press.spread();
    for (length, best) in [(1, 0), (2, 1), (4, 1), (5, 4), (7, 4)] {
        assert_eq!(press.best_of(&frames[..length]), best);
    }
}
