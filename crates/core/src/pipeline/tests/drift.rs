//! Tests that the baseline follows slow drift, and nothing else.

use super::*;

/// An hour in seconds.
const HOUR: u64 = 3600;

/// The newtons of one count.
const COUNT_N: f64 = 0.04;

fn following(auto_tare: bool) -> Pipeline {
    let mut pipeline = pipeline_of(|described| {
        described.sensor.frame_rate_hz = 2.0;
        described.sensor.calibration.auto_tare = auto_tare;
    });
    pipeline.opened(at(0));
    play_at_2_hz(&mut pipeline, 0, 10, |_| 0.0, &[]);
    pipeline
}

/// A frame whose taxels all read `count`.
fn even(count: u16) -> RawFrame {
    let mut raw = RawFrame::default();
    raw.counts.fill(count.into());
    raw
}

/// Plays `seconds` seconds of a sensor from second `from_s` on. All its taxels rest at `rest_n`,
/// and `touched` taxels read 1 N more. Returns the words, and the greatest mean of a frame's 12
/// most loaded taxels.
fn play_at_2_hz(
    pipeline: &mut Pipeline,
    from_s: u64,
    seconds: u64,
    rest_n: impl Fn(u64) -> f64,
    touched: &[usize],
) -> (Vec<String>, f64) {
    let (mut published, mut most_n) = (Vec::new(), 0.0_f64);
    for half in 2 * from_s..2 * (from_s + seconds) {
        let rest = rest_n(half / 2) / COUNT_N;
        let mut raw = even(rest.round() as u16);
        for &place in touched {
            raw.counts[place] += 25.0;
        }
        let bytes = bytes(pipeline, &raw);
        let events = pipeline.push(&bytes, at(500 * half));
        for frame in shown(&events) {
            let mut newtons = frame.newtons.clone();
            newtons.sort_by(f32::total_cmp);
            let loaded = newtons[newtons.len() - TOUCHED.len()..].iter();
            most_n = most_n.max(loaded.map(|&n| f64::from(n)).sum::<f64>() / 12.0);
        }
        published.extend(words(&events));
    }
    (published, most_n)
}

/// A drift of 0.5 N an hour.
fn drift(second: u64) -> f64 {
    0.5 * second as f64 / HOUR as f64
}

const TOUCHED: [usize; 12] = [400, 401, 402, 403, 428, 429, 430, 431, 456, 457, 458, 459];

#[test]
fn a_baseline_that_follows_keeps_drift_from_being_a_press() {
    let mut fixed = following(false);
    let (published, most_n) = play_at_2_hz(&mut fixed, 10, HOUR, drift, &[]);
    assert!(published.contains(&"Begin 1".to_owned()), "{published:?}");
    assert!(most_n > 0.45, "{most_n}");

    let mut pipeline = following(true);
    let (published, most_n) = play_at_2_hz(&mut pipeline, 10, HOUR, drift, &[]);
    assert_eq!(published, Vec::<String>::new());
    assert!(most_n <= COUNT_N, "{most_n}");
    // A press then reads the same as an hour ago, within a count.
    let (published, most_n) = play_at_2_hz(&mut pipeline, HOUR + 10, 3, drift, &TOUCHED);
    assert_eq!(published[0], "Begin 1", "{published:?}");
    assert!((most_n - 1.0).abs() <= COUNT_N, "{most_n}");
}

#[test]
fn a_gap_and_a_busy_sensor_do_not_speed_it_up() {
    let mut pipeline = following(true);
    let raised = even(1);
    let bytes = bytes(&pipeline, &raised);
    let newtons = |events: Vec<Event>| shown(&events).last().unwrap().newtons[0];
    // An hour without a frame is one step. Twenty frames within a second are no further step.
    newtons(pipeline.push(&bytes, at(HOUR * 1000)));
    for ms in 0..18 {
        newtons(pipeline.push(&bytes, at(HOUR * 1000 + ms)));
    }
    let left = newtons(pipeline.push(&bytes, at(HOUR * 1000 + 100)));
    assert!(
        (f64::from(left) - (COUNT_N - 1.0 / 3600.0)).abs() < 1e-3,
        "{left}"
    );
}
