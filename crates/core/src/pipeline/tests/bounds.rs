//! A sensor that sends too much, and one whose press never ends.

use super::*;
use crate::wire::Cell;

#[test]
fn frames_above_twice_the_rate_are_dropped_counted_and_said_once() {
    let mut pipeline = pipeline(Preset::Jx255n);
    let frame = bytes(&pipeline, &raw(0, 0));
    let mut events = Vec::from_iter(pipeline.opened(at(0)));
    // 100 frames/s of a sensor of 5.
    for ms in (0..60_000).step_by(10) {
        events.extend(pipeline.push(&frame, at(ms)));
    }
    assert_eq!(
        words(&events),
        ["Live", "Live (frames above 10 Hz are dropped)"]
    );
    let taken = events.len() as u64 - 2;
    let status = pipeline.status(at(60_000));
    assert_eq!(
        (status.frames, status.frames_dropped),
        (taken, 6_000 - taken)
    );
    assert!((645..655).contains(&taken), "{taken}");
    // The measured rate is that of the sensor.
    assert!(
        (status.frame_rate_hz.unwrap() - 100.0).abs() < 1.0,
        "{status:?}"
    );
    // The numbers of the frames have no gap.
    assert!(shown(&events).map(|frame| frame.frame).eq(0..taken));
    // At its rate, nothing is dropped any more, and ten seconds later that is said.
    let mut events = Vec::new();
    for ms in (60_000..80_000).step_by(200) {
        events.extend(pipeline.push(&frame, at(ms)));
    }
    assert_eq!(words(&events), ["Live"]);
    assert_eq!(pipeline.status(at(80_000)).frames, taken + 100);
}

#[test]
fn a_sensor_at_twice_its_rate_loses_nothing_and_neither_does_one_after_a_stall() {
    let mut pipeline = pipeline(Preset::Jx255n);
    let frame = bytes(&pipeline, &raw(0, 0));
    for ms in (0..60_000).step_by(100) {
        pipeline.push(&frame, at(ms));
    }
    for _ in 0..50 {
        pipeline.push(&frame, at(70_000));
    }
    let status = pipeline.status(at(70_000));
    assert_eq!((status.frames, status.frames_dropped), (650, 0));
}

#[test]
fn a_recording_that_begins_in_a_flood_goes_on_as_the_sensor_did() {
    let mut first = pipeline(Preset::Jx255n);
    let frame = bytes(&first, &raw(0, 0));
    for ms in (0..10_000).step_by(10) {
        first.push(&frame, at(ms));
    }
    let state = first.at_rest().unwrap();
    let mut second = Pipeline::resumed(first.sensor().clone(), support::hrn(), state);
    for ms in (10_000..20_000).step_by(10) {
        assert_eq!(second.push(&frame, at(ms)), first.push(&frame, at(ms)));
    }
    assert_eq!(second.status(at(0)), first.status(at(0)));
}

#[test]
fn bytes_that_are_not_read_are_counted_and_end_the_frame_before_them() {
    let mut pipeline = pipeline(Preset::Jx255n);
    let frame = bytes(&pipeline, &raw(0, 0));
    pipeline.push(&frame, at(0));
    pipeline.push(&frame[..100], at(200));
    pipeline.take(Input::Skipped(1_000), at(300)).unwrap();
    // The rest of a frame is no frame.
    pipeline.push(&frame[100..], at(400));
    pipeline.push(&frame, at(600));
    let status = pipeline.status(at(600));
    let skipped = 1_000 + frame.len() as u64;
    assert_eq!((status.frames, status.bytes_skipped), (2, skipped));
    assert_eq!(pipeline.decoder.received(), 3 * frame.len() as u64 + 1_000);
}

#[test]
fn a_press_that_is_not_released_is_said_with_its_taxels() {
    let mut pipeline = ready(|_| {});
    let mut stuck = RawFrame::default();
    stuck.counts[28..56].fill(255.0);
    let events = feed(&mut pipeline, 5, &vec![stuck; 160]);
    let reason = "Live (not released for 30 s)";
    assert!(
        words(&events).contains(&reason.to_owned()),
        "{:?}",
        words(&events)
    );
    assert_eq!(
        status_of(&events).detail.as_deref(),
        Some(
            "taxels [1, 0], [1, 1], [1, 2], [1, 3] and 24 more: if nothing touches them, take a tare, \
             or put them into dead_taxels"
        )
    );
    assert_eq!(play(&mut pipeline, 165, &vec![raw(0, 0); 3]), ["Live"]);
}

#[test]
fn a_sensor_whose_bytes_are_skipped_is_live_as_long_as_its_frames_come() {
    let mut pipeline = pipeline(Preset::Jx255n);
    let frame = bytes(&pipeline, &raw(0, 0));
    let mut events = Vec::from_iter(pipeline.opened(at(0)));
    let skip = |pipeline: &mut Pipeline, ms| pipeline.take(Input::Skipped(1_000), at(ms)).unwrap();
    // The bytes of two seconds are skipped again and again.
    for ms in (0..20_000).step_by(50) {
        match ms % 2_000 {
            0 => events.extend(pipeline.push(&frame, at(ms))),
            _ => events.extend(skip(&mut pipeline, ms)),
        }
    }
    let skipped = "Live (more bytes come than are read: some are skipped)";
    assert_eq!(words(&events), ["Live", skipped]);
    // Bytes without frames are no frames, and neither is a silence.
    let events: Vec<Event> = (20_000..40_000)
        .step_by(50)
        .flat_map(|ms| skip(&mut pipeline, ms))
        .collect();
    assert_eq!(words(&events), ["Stale (no frame for 600 ms)"]);
    let events = pipeline.push(&frame, at(55_000));
    assert_eq!(words(&events), ["Live"]);
    skip(&mut pipeline, 55_100);
    let events = pipeline.tick(at(55_700));
    assert_eq!(words(&events), ["Stale (no frame for 600 ms)"]);
    // A flood of noise, of which a part is read, is said once.
    let mut events = Vec::new();
    for ms in (55_800..70_000).step_by(50) {
        events.extend(pipeline.push(&[7; 1_000], at(ms)));
        events.extend(skip(&mut pipeline, ms));
    }
    let noise =
        "Stale (no frame for 600 ms, but bytes come: is the baud rate or the layout wrong?)";
    assert_eq!(words(&events), [noise]);
}

#[test]
fn bare_frames_follow_a_pause_and_those_of_a_file_each_other_also_after_a_damaged_one() {
    let sensor = support::sensor_of(|described| {
        let frame = &mut described.sensor.frame;
        (frame.preset, frame.cell) = (Some(Preset::None), Some(Cell::F32le));
        (frame.rows, frame.cols) = (Some(4), Some(4));
    });
    let frames = |clock, ms, cells: &[f32]| {
        let mut pipeline = Pipeline::new(sensor.clone(), support::hrn(), clock);
        if clock == Clock::Arrival {
            pipeline.opened(at(0));
        }
        let bytes: Vec<u8> = cells.iter().flat_map(|cell| cell.to_le_bytes()).collect();
        pipeline.push(&bytes, at(ms));
        let status = pipeline.status(at(ms));
        (status.frames, status.frames_damaged)
    };
    let mut cells = [7.0; 16 * 9];
    // On a line, only a pause or a request shows where a frame begins. A silence after the opening is a pause.
    assert_eq!(frames(Clock::Arrival, 99, &cells), (0, 0));
    assert_eq!(frames(Clock::Arrival, 100, &cells), (9, 0));
    assert_eq!(frames(Clock::FrameRate, 0, &cells), (9, 0));
    cells[16 * 3 + 5] = f32::NAN;
    assert_eq!(frames(Clock::FrameRate, 0, &cells), (8, 1));
    cells[2] = f32::INFINITY;
    assert_eq!(frames(Clock::FrameRate, 0, &cells), (7, 2));
}
