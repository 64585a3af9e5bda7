use super::*;

mod course;
mod arrays;
mod bounds;
mod noise;
use crate::event::{Advice, Hardness, LinkState, Note, Phase, Rejection, Status};
use crate::frame::Array;
use crate::motion::Point;
use crate::sensor::Description;
use crate::tests::graph::{changed, metadata};
use crate::tests::support;
use crate::verdict::{BUILT_IN, BUILT_IN_HRN, Level};
use crate::wire::Preset;

const PERIOD: Duration = Duration::from_millis(200);

fn pipeline(preset: Preset) -> Pipeline {
    pipeline_of(|described| described.sensor.frame.preset = Some(preset))
}

/// A pipeline of a JX255N at 5 frames/s, changed by `change`.
fn pipeline_of(change: impl FnOnce(&mut Description)) -> Pipeline {
    Pipeline::new(support::sensor_of(change), support::hrn(), Clock::Arrival)
}

/// The same after the five frames of its first tare.
fn ready(change: impl FnOnce(&mut Description)) -> Pipeline {
    let mut pipeline = pipeline_of(change);
    play(&mut pipeline, 0, &vec![raw(0, 0); 5]);
    pipeline
}

fn judge_by(pipeline: &mut Pipeline, hrn: Arc<Model>) {
    pipeline.judge = Judge::new(Arc::clone(&pipeline.sensor), hrn);
}

fn at(millis: u64) -> Stamp {
    let mono = Duration::from_millis(1000 + millis);
    Stamp {
        mono,
        wall: Stamp::EPOCH.wall.checked_add(mono).unwrap(),
    }
}

/// A frame with `taxels` taxels at `counts` in the middle of the array.
fn raw(taxels: usize, counts: u16) -> RawFrame {
    let mut raw = RawFrame::default();
    raw.counts[400..400 + taxels].fill(counts.into());
    raw
}

fn bytes(pipeline: &Pipeline, raw: &RawFrame) -> Vec<u8> {
    let mut bytes = Vec::new();
    pipeline.sensor().layout().encode(raw, &mut bytes);
    bytes
}

/// The events except `frame`s, one word each.
fn words(events: &[Event]) -> Vec<String> {
    let word = |event: &Event| match event {
        Event::Frame(_) => None,
        Event::Status(status) => Some(match &status.reason {
            Some(reason) => format!("{:?} ({reason})", status.state),
            None => format!("{:?}", status.state),
        }),
        Event::Press(press) => Some(match press.reason {
            Some(reason) => format!("{:?} {} ({reason})", press.state, press.press),
            None => format!("{:?} {}", press.state, press.press),
        }),
        Event::Hardness(verdict) => Some(format!("{:?} of {}", verdict.phase, verdict.frame)),
    };
    events.iter().filter_map(word).collect()
}

/// The frames among the events.
fn shown(events: &[Event]) -> impl Iterator<Item = &FrameEvent> {
    events.iter().filter_map(|event| match event {
        Event::Frame(frame) => Some(frame),
        _ => None,
    })
}

/// The last status among the events.
fn status_of(events: &[Event]) -> &Status {
    let mut events = events.iter().rev();
    let status = events.find_map(|event| match event {
        Event::Status(status) => Some(status),
        _ => None,
    });
    status.unwrap()
}

/// The verdicts among the events.
fn verdicts(events: Vec<Event>) -> Vec<Hardness> {
    let verdict = |event| match event {
        Event::Hardness(verdict) => Some(verdict),
        _ => None,
    };
    events.into_iter().filter_map(verdict).collect()
}

/// A press of two frames on nine taxels, and its release.
fn short_press() -> [RawFrame; 4] {
    [raw(9, 50), raw(9, 50), raw(0, 0), raw(0, 0)]
}

/// The last verdict on frames with numbers from `first` on.
fn last_verdict(pipeline: &mut Pipeline, first: u64, frames: &[RawFrame]) -> Hardness {
    verdicts(feed(pipeline, first, frames)).pop().unwrap()
}

/// Pushes one frame a period, with numbers from `first` on.
fn feed(pipeline: &mut Pipeline, first: u64, frames: &[RawFrame]) -> Vec<Event> {
    let mut events = Vec::new();
    for (number, raw) in (first..).zip(frames) {
        let bytes = bytes(pipeline, raw);
        events.extend(pipeline.push(&bytes, at(number * 200)));
    }
    events
}

/// The same, with the events in words.
fn play(pipeline: &mut Pipeline, first: u64, frames: &[RawFrame]) -> Vec<String> {
    words(&feed(pipeline, first, frames))
}

#[test]
fn a_contact_that_settles_when_its_press_times_out_has_an_early_verdict() {
    let judged = "Begin 1, Live (not released for 0.4 s), Early of 5, End 1 (timeout), Final of 5";
    let aborted = "Begin 1, Early of 5, Aborted 1 (short)";
    for (min_frames, expected) in [(2, judged), (9, aborted)] {
        let mut pipeline = pipeline_of(|described| {
            described.press.max_seconds = 0.4;
            described.press.min_frames = min_frames;
        });
        play(&mut pipeline, 1, &vec![raw(0, 0); 5]);
        let said = play(&mut pipeline, 6, &vec![raw(9, 50); 5]);
        assert_eq!(said.join(", "), expected);
    }
}

#[test]
fn a_load_during_tare_is_said_and_tracked_as_no_press() {
    let mut pipeline = pipeline(Preset::Jx255n);
    let loaded = vec![raw(9, 50); 5];
    let events = feed(&mut pipeline, 0, &loaded);
    assert_eq!(words(&events), ["Live", "Live (tare: contact)"]);
    let shown = shown(&events).map(|frame| (frame.tared, frame.force_n));
    assert!(shown.eq([(false, None); 5]), "there is no zero yet");
    let detail = pipeline.status(at(0)).detail.unwrap();
    assert!(
        detail.starts_with("9 taxels read more than 0.5 N"),
        "{detail}"
    );
    assert!(play(&mut pipeline, 5, &loaded).is_empty(), "said once");
    let refusal = pipeline.retare().unwrap_err().to_string();
    assert!(refusal.contains("9 taxels read more"), "{refusal}");
    assert_eq!(play(&mut pipeline, 10, &vec![raw(0, 0); 5]), ["Live"]);
    assert_eq!(play(&mut pipeline, 15, &loaded[..1]), ["Begin 1"]);
}

#[test]
fn a_press_that_timed_out_is_no_reason_against_a_tare() {
    let mut pipeline = ready(|_| {});
    let drift = raw(784 - 400, 3);
    play(&mut pipeline, 5, &vec![drift.clone(); 160]);
    assert_eq!(pipeline.retare(), Ok(()));
    play(&mut pipeline, 165, &vec![drift.clone(); 5]);
    assert!(matches!(pipeline.retared(), Some(Ok(_))));
    let mut pressed = drift.clone();
    pressed.counts[400..409].fill(53.0);
    let published = play(&mut pipeline, 170, &[drift.clone(), drift, pressed]);
    assert_eq!(
        published,
        ["Live", "Begin 2"],
        "the baseline is the drift's"
    );
}

#[test]
fn a_tare_on_request_zeroes_drift_and_is_refused_or_given_up_under_load() {
    let mut pipeline = pipeline(Preset::Jx255n);
    assert_eq!(pipeline.retare(), Err(RetareError::NotLive));
    play(&mut pipeline, 0, &vec![raw(0, 0); 4]);
    assert_eq!(pipeline.retare(), Err(RetareError::UnderWay));
    play(&mut pipeline, 4, &vec![raw(0, 0); 1]);
    let drift = raw(784 - 400, 1);

    assert_eq!(pipeline.retare(), Ok(()));
    play(&mut pipeline, 5, &vec![drift.clone(); 4]);
    assert_eq!(pipeline.retared(), None);
    assert_eq!(pipeline.retare(), Err(RetareError::UnderWay));
    play(&mut pipeline, 9, &[drift]);
    let tared = pipeline.retared().unwrap().unwrap();
    assert_eq!((tared.old.most_counts, tared.new.most_counts), (0.0, 1.0));
    assert_eq!(pipeline.retared(), None, "told once");

    // A press that begins during a tare is followed, and the offsets stay.
    assert_eq!(pipeline.retare(), Ok(()));
    let begun = play(&mut pipeline, 10, &[raw(9, 50)]);
    assert_eq!(begun, ["Begin 1"]);
    assert_eq!(pipeline.retared(), Some(Err(RetareError::Pressed)));
    assert_eq!(pipeline.retare(), Err(RetareError::Pressed));
    assert_eq!(pipeline.tare.offsets(), tared.new);
    assert_eq!(
        play(&mut pipeline, 11, &[raw(9, 50), raw(0, 0), raw(0, 0)]),
        ["End 1", "Final of 10"]
    );

    // The offsets also stay after a touch too small to be a press, and after a loss.
    assert_eq!(pipeline.retare(), Ok(()));
    let touch = [raw(0, 0), raw(4, 2), raw(0, 0), raw(0, 0), raw(0, 0)];
    assert!(play(&mut pipeline, 14, &touch).is_empty());
    assert_eq!(pipeline.retared(), Some(Err(RetareError::Touched)));
    assert_eq!(pipeline.retare(), Ok(()));
    pipeline.lost("end of file".to_owned(), at(3900));
    assert_eq!(pipeline.retared(), Some(Err(RetareError::NotLive)));
    assert_eq!(pipeline.tare.aim(), None);
}

#[test]
fn a_gap_and_a_busy_sensor_do_not_speed_up_a_baseline_that_follows() {
    let mut pipeline = ready(|described| described.sensor.calibration.auto_tare = true);
    let mut drifted = RawFrame::default();
    drifted.counts.fill(1.0);
    let bytes = bytes(&pipeline, &drifted);
    // An hour without a frame is one step. More frames within a second are no further step.
    let mut events = Vec::new();
    for ms in 0..20 {
        events = pipeline.push(&bytes, at(3_600_000 + ms));
    }
    let left = shown(&events).last().unwrap().newtons[0];
    assert!((left - (0.04 - 1.0 / 3600.0)).abs() < 1e-4, "{left}");
}

#[test]
fn silence_is_stale_after_three_periods_and_ends_no_press() {
    let mut pipeline = ready(|_| {});
    play(&mut pipeline, 5, &vec![raw(5, 50); 1]);
    let deadline = pipeline.deadline().unwrap();
    assert_eq!(deadline, at(1000).mono + 3 * PERIOD);
    assert!(pipeline.tick(at(1599)).is_empty());
    let published = pipeline.tick(at(1607));
    assert_eq!(words(&published), ["Stale (no frame for 600 ms)"]);
    let status = status_of(&published);
    assert_eq!(status.time, at(1600).wall, "when it became so");
    assert_eq!(pipeline.deadline(), None);
    let back = [raw(5, 50), raw(0, 0), raw(0, 0)];
    assert_eq!(
        play(&mut pipeline, 20, &back),
        ["Live", "End 1", "Final of 5"]
    );
}

#[test]
fn how_long_a_sensor_may_be_silent_never_moves_however_slowly_it_sends() {
    // 100 frames/s are configured, and five come.
    for (stale_after_ms, reason) in [
        (None, "Stale (no frame for 150 ms)"),
        (Some(60.0), "Stale (no frame for 60 ms)"),
    ] {
        let mut pipeline = pipeline_of(|described| {
            described.sensor.frame_rate_hz = 100.0;
            described.sensor.stale_after_ms = stale_after_ms;
        });
        pipeline.opened(at(0));
        let mut published = Vec::new();
        for ms in (10..6000).step_by(10) {
            published.extend(words(&pipeline.tick(at(ms))));
            if ms % 200 == 10 {
                let bytes = bytes(&pipeline, &raw(0, 0));
                published.extend(words(&pipeline.push(&bytes, at(ms))));
            }
        }
        assert_eq!(published, ["Live", reason].repeat(30));
    }
}

#[test]
fn a_restarted_pipeline_begins_anew_and_its_numbers_go_on() {
    let mut pipeline = ready(|_| {});
    pipeline.judge.context = Some(serde_json::json!({"tag": "x"}));
    play(&mut pipeline, 5, &vec![raw(5, 50); 2]);
    let stopped = pipeline.take(Input::Shutdown, at(1400)).unwrap();
    assert_eq!(words(&stopped), ["Aborted 1 (shutdown)"]);
    let mut described = pipeline.sensor().description().clone();
    described.sensor.frame.preset = Some(Preset::Jq);
    let skipped = pipeline.status(at(0)).bytes_skipped;
    pipeline.push(&[0xBB; 3], at(1500));
    let hrn = pipeline.hrn().clone();
    let mut next = pipeline.restarted(Sensor::new(described).unwrap(), hrn);
    let status = next.status(at(0));
    assert_eq!((status.state, status.frames), (LinkState::Connecting, 7));
    assert_eq!(status.bytes_skipped, skipped + 3);
    // Who was told that it is live is told that it is no longer.
    let opened = next.take(Input::Opened, at(1550)).unwrap();
    assert_eq!(words(&opened), ["Connecting"]);
    assert_eq!(play(&mut next, 8, &vec![raw(0, 0); 6]), ["Live"]);
    assert_eq!(play(&mut next, 14, &vec![raw(5, 50); 2]), ["Begin 2"]);
    assert_eq!(next.judge.context, Some(serde_json::json!({"tag": "x"})));
}

#[test]
fn a_press_is_judged_by_the_model_that_it_began_with() {
    let mut pipeline = ready(|_| {});
    let mut described = pipeline.sensor().description().clone();
    described.model.min_force_n = 900.0;
    let (sensor, hrn) = (Sensor::new(described).unwrap(), pipeline.hrn().clone());
    play(&mut pipeline, 5, &vec![raw(5, 50); 2]);
    assert!(pipeline.with_model(sensor.clone(), hrn.clone()).is_none());
    play(&mut pipeline, 7, &vec![raw(0, 0); 2]);
    let mut next = pipeline.with_model(sensor, hrn).unwrap();
    assert_eq!(next.at_rest(), pipeline.at_rest());
    let verdict = last_verdict(&mut next, 9, &short_press());
    let expected = (2, Some(Rejection::LowForce));
    assert_eq!((verdict.press, verdict.rejected), expected);
}

#[test]
fn a_model_of_other_levels_forgets_the_level_that_was_said_and_judges_objects_anew() {
    let mut pipeline = ready(|_| {});
    judge_by(&mut pipeline, Arc::new(Model::load(BUILT_IN).unwrap()));
    let said = serde_json::json!({"object": "cup", "level": 4});
    pipeline.judge.context = Some(said.clone());
    let presses = |pipeline: &mut Pipeline, first: u64| {
        let verdict = last_verdict(pipeline, first, &short_press());
        verdict.object.unwrap().presses
    };
    assert_eq!(presses(&mut pipeline, 5), 1);
    let (sensor, same) = (pipeline.sensor().clone(), pipeline.hrn().clone());
    let mut next = pipeline.with_model(sensor.clone(), same).unwrap();
    assert_eq!(presses(&mut next, 9), 2);
    assert_eq!(next.judge.context, Some(said));
    // As many levels as before.
    let levels = (1..).zip([">80", "60-80", "40-60", "<=40"]);
    let levels = levels.map(|(level, shore)| Level::new(level, level.to_string(), shore));
    let other = Model::load(BUILT_IN).unwrap().with_levels(levels.collect());
    let other = Arc::new(other.unwrap());
    let kept = Some(serde_json::json!({"object": "cup"}));
    let mut next = pipeline.with_model(sensor.clone(), other.clone()).unwrap();
    assert_eq!(next.judge.context, kept);
    assert_eq!(presses(&mut next, 9), 1);
    assert_eq!(pipeline.restarted(sensor, other).judge.context, kept);
}

/// Gives each input at its time in ms, and compares the events in words.
fn story(pipeline: &mut Pipeline, steps: &[(u64, Input, &[&str])]) {
    for (ms, input, expected) in steps {
        let events = pipeline.take(input.to_owned(), at(*ms)).unwrap();
        assert_eq!(words(&events), *expected, "{input:?} at {ms} ms");
    }
}

#[test]
fn a_link_says_each_change_once_and_a_lost_device_ends_its_press() {
    let lost = |reason: &'static str| Input::Lost(reason.into());
    let unavailable = |reason: &'static str| Input::Unavailable(reason.into());
    let noise = Input::Bytes(vec![0; 2000]);
    let mut pipeline = pipeline(Preset::Jx255n);
    let steps: &[(u64, Input, &[&str])] = &[
        (0, unavailable("none"), &["Connecting (none)"]),
        (100, unavailable("none"), &[]),
        (200, Input::Opened, &["Connecting"]),
        (700, Input::Tick, &["Stale (no frame for 500 ms)"]),
    ];
    story(&mut pipeline, steps);
    assert_eq!(play(&mut pipeline, 5, &vec![raw(0, 0); 5]), ["Live"]);
    assert_eq!(play(&mut pipeline, 10, &vec![raw(5, 50); 2]), ["Begin 1"]);
    let noisy = "Lost (no frame for 500 ms, but bytes come: is the baud rate or the layout wrong?)";
    let steps: &[(u64, Input, &[&str])] = &[
        (2300, lost("eof"), &["Lost (eof)", "Aborted 1 (lost)"]),
        // A device that stays lost says why, once.
        (2400, unavailable("none"), &["Lost (none)"]),
        (2500, unavailable("none"), &[]),
        (2600, unavailable("held"), &["Lost (held)"]),
        // A port that is lost again as soon as it is open says nothing new.
        (3000, Input::Opened, &[]),
        (3001, lost("held"), &[]),
        (3002, Input::Opened, &[]),
        (3501, Input::Tick, &[]),
        (3502, Input::Tick, &["Lost (no frame for 500 ms)"]),
        (4000, lost("eof"), &["Lost (eof)"]),
        (4001, Input::Opened, &[]),
        (4100, noise, &[]),
        (4501, Input::Tick, &[noisy]),
        // The bytes before the loss do not count.
        (5000, lost("eof"), &["Lost (eof)"]),
        (5001, Input::Opened, &[]),
        (5501, Input::Tick, &["Lost (no frame for 500 ms)"]),
    ];
    story(&mut pipeline, steps);
    assert_eq!(play(&mut pipeline, 30, &[raw(5, 50)]), ["Live", "Begin 2"]);
    assert_eq!(pipeline.status(at(0)).frames, 8);
}

#[test]
fn a_wall_clock_that_jumps_changes_the_times_of_events_and_nothing_else() {
    let play = |jumps_s: &[(u64, i64)]| {
        let mut pipeline = pipeline(Preset::Jx255n);
        let mut events = Vec::new();
        let mut away = jiff::SignedDuration::ZERO;
        for number in 0..120 {
            for &(_, by_s) in jumps_s.iter().filter(|jump| jump.0 == number) {
                away += jiff::SignedDuration::from_secs(by_s);
            }
            let is_pressed = (20..60).contains(&number) || (80..100).contains(&number);
            let raw = if is_pressed { raw(36, 20) } else { raw(0, 0) };
            let bytes = bytes(&pipeline, &raw);
            let Stamp { mono, wall } = at(number * 200);
            let wall = wall.checked_add(away).unwrap();
            events.extend(pipeline.push(&bytes, Stamp { mono, wall }));
            // The next deadline is as far away as after any other frame.
            let deadline = mono + Duration::from_millis(600);
            assert_eq!(pipeline.deadline(), Some(deadline), "frame {number}");
        }
        let timeless = |event: &Event| {
            let mut event = serde_json::to_value(event).unwrap();
            event.as_object_mut().unwrap().remove("time");
            event
        };
        events.iter().map(timeless).collect::<Vec<_>>()
    };
    let steady = play(&[]);
    let verdicts = steady.iter().filter(|event| event["phase"] == "final");
    assert_eq!(verdicts.count(), 2);
    let year_s = 365 * 86_400;
    // The calendar jumps during a press, at its last frame, and between presses.
    assert_eq!(
        play(&[(30, year_s), (59, -2 * year_s), (70, -1), (90, 3600)]),
        steady
    );
}

#[test]
fn half_a_period_of_silence_makes_a_jq_frame_whole_at_its_own_time() {
    let mut pipeline = pipeline(Preset::Jq);
    let bytes = bytes(&pipeline, &raw(0, 0));
    assert!(pipeline.push(&bytes, at(0)).is_empty());
    assert_eq!(pipeline.deadline(), Some(at(100).mono));
    let events = pipeline.tick(at(103));
    assert_eq!(words(&events), ["Live"]);
    let status = status_of(&events);
    assert_eq!(status.time, at(0).wall, "the frame's last byte came then");
    // With a frame, the sensor becomes stale later.
    pipeline.push(&bytes, at(200));
    assert_eq!(pipeline.deadline(), Some(at(300).mono));
    assert_eq!(words(&pipeline.tick(at(300))), [""; 0]);
    assert_eq!(pipeline.deadline(), Some(at(800).mono));
    // The pipeline waits only once for the rest of the pending bytes.
    pipeline.push(&bytes[..400], at(350));
    assert_eq!(pipeline.deadline(), Some(at(450).mono));
    assert_eq!(words(&pipeline.tick(at(450))), [""; 0]);
    assert_eq!(pipeline.deadline(), Some(at(800).mono));
}

#[test]
fn a_frame_sent_in_pieces_has_the_time_of_its_last_byte() {
    let mut pipeline = pipeline(Preset::Jx255n);
    let bytes = bytes(&pipeline, &raw(0, 0));
    assert!(pipeline.push(&bytes[..500], at(0)).is_empty());
    let events = pipeline.push(&[&bytes[500..], &bytes[..300]].concat(), at(40));
    let times = |events: &[Event]| Vec::from_iter(shown(events).map(|frame| frame.time));
    assert_eq!(times(&events), [at(40).wall]);
    let events = pipeline.push(&bytes[300..], at(90));
    assert_eq!(times(&events), [at(90).wall]);
}

#[test]
fn verdicts_below_the_thresholds_are_rejected() {
    let check = |min_force_n: f64, min_confidence: f32, expected: Option<Rejection>| {
        let mut pipeline = ready(|described| {
            described.model.min_force_n = min_force_n;
            described.model.min_confidence = min_confidence;
        });
        let verdict = last_verdict(&mut pipeline, 5, &short_press());
        assert_eq!(verdict.rejected, expected);
        assert_eq!(verdict.level.is_some(), expected.is_none());
        assert_eq!(verdict.label.is_some(), expected.is_none());
        assert!((verdict.probabilities.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        let came = at(verdict.frame * 200).mono.as_nanos() as u64;
        assert_eq!(verdict.mono_ns, Some(came));
        verdict
    };
    let verdict = check(0.0, 0.0, None);
    check(verdict.force_n, verdict.confidence, None);
    check(100.0, 0.0, Some(Rejection::LowForce));
    let more = verdict.confidence.next_up();
    check(0.0, more, Some(Rejection::LowConfidence));
}

#[test]
fn notes_name_the_edge_saturation_and_what_the_model_has_not_seen() {
    let array = Array::JX255N;
    let check = |range: [f32; 2], place: usize, count: u16, expected: &[Note]| {
        let mut pipeline = ready(|_| {});
        let seen = serde_json::json!({"force_n": range, "contact_area_taxels": [9, 10]});
        let file = changed(BUILT_IN_HRN, |proto| {
            *metadata(proto, "hrn.range") = seen.to_string();
        });
        judge_by(&mut pipeline, Arc::new(Model::load(&file).unwrap()));
        let mut held = RawFrame::default();
        // Three by three taxels in the middle.
        for row in 12..15 {
            held.counts[array.place(row, 12)..array.place(row, 15)].fill(50.0);
        }
        held.counts[place] = f32::from(count);
        let press = [held.clone(), held, raw(0, 0), raw(0, 0)];
        let verdict = last_verdict(&mut pipeline, 5, &press);
        assert_eq!(verdict.notes, expected, "{count} at {place}, {range:?}");
    };
    let (wide, middle) = ([0.0, 100.0], array.place(12, 12));
    check(wide, middle, 50, &[]);
    for (row, col) in [(0, 9), (27, 9), (9, 0), (9, 27)] {
        check(wide, array.place(row, col), 10, &[Note::AtEdge]);
        // The count is below the contact threshold.
        check(wide, array.place(row, col), 1, &[]);
    }
    check(wide, middle, 255, &[Note::Saturated]);
    check(wide, middle, 254, &[]);
    // The force is 9 x 50 x 0.04 N.
    check([0.0, 17.9], middle, 50, &[Note::OutsideTraining]);
    check([18.1, 100.0], middle, 50, &[Note::OutsideTraining]);
    check(wide, middle, 1, &[Note::OutsideTraining]);
}

#[test]
fn a_verdict_became_possible_with_the_last_byte_it_rests_on() {
    // The ninth frame ends the press. It is whole with the next header, after a pause, or with its
    // own last byte.
    for (preset, every_ms, came) in [
        (Preset::Jq, 90, 9 * 90),
        (Preset::Jq, 200, 8 * 200),
        (Preset::Jx255n, 200, 8 * 200),
    ] {
        let mut pipeline = pipeline(preset);
        let mut events = Vec::new();
        let (free, held) = (vec![raw(0, 0); 5], vec![raw(9, 50); 2]);
        let frames = [&free[..], &held[..], &free[..3]].concat();
        for (number, raw) in (0..).zip(frames) {
            let bytes = bytes(&pipeline, &raw);
            events.extend(pipeline.push(&bytes, at(number * every_ms)));
        }
        let arrivals: Vec<_> = verdicts(events).iter().map(|v| v.arrival).collect();
        assert_eq!(arrivals, [at(came).mono], "{preset:?}");
    }
}

#[test]
fn the_rate_is_measured_over_the_last_frames() {
    let mut pipeline = pipeline(Preset::Jx255n);
    let mut rates = vec![pipeline.status(at(0)).frame_rate_hz];
    for number in 0..2 {
        play(&mut pipeline, number, &[raw(0, 0)]);
        rates.push(pipeline.status(at(0)).frame_rate_hz);
    }
    assert_eq!(rates, [None, None, Some(5.0)]);
    // The rate doubles. After 32 frames, the first rate has no more effect.
    let bytes = bytes(&pipeline, &raw(0, 0));
    for number in 0..link::RATE_FRAMES as u64 {
        pipeline.push(&bytes, at(300 + 100 * number));
    }
    assert_eq!(pipeline.status(at(0)).frame_rate_hz, Some(10.0));
    // A stale silence does not count in the rate after it.
    pipeline.tick(at(8000));
    for (moment, rate) in [(8000, None), (8200, Some(5.0))] {
        pipeline.push(&bytes, at(moment));
        assert_eq!(pipeline.status(at(moment)).frame_rate_hz, rate);
    }
    pipeline.lost("end of file".to_owned(), at(9000));
    assert_eq!(pipeline.status(at(9000)).frame_rate_hz, None);
}

#[test]
fn presses_of_one_object_are_judged_together_also_by_a_pipeline_that_goes_on() {
    let mut pipeline = ready(|_| {});
    let judged = |pipeline: &mut Pipeline, first: u64| {
        let object = last_verdict(pipeline, first, &short_press()).object;
        object.map(|object| (object.name, object.presses))
    };
    assert_eq!(judged(&mut pipeline, 5), None, "no object is named");
    pipeline.judge.context = Some(serde_json::json!({"object": "cup"}));
    assert_eq!(judged(&mut pipeline, 9), Some(("cup".to_owned(), 1)));
    pipeline.judge.context = Some(serde_json::json!({"object": 7}));
    assert_eq!(judged(&mut pipeline, 13), Some(("7".to_owned(), 1)));
    let state = pipeline.at_rest().unwrap();
    let mut next = Pipeline::resumed(pipeline.sensor().clone(), support::hrn(), state);
    next.judge.context = Some(serde_json::json!({"object": "cup"}));
    assert_eq!(judged(&mut next, 17), Some(("cup".to_owned(), 2)));
}

#[test]
fn four_presses_at_one_place_are_advised_whatever_the_model_keeps() {
    for own_presses in [0, 16] {
        let mut pipeline = ready(|described| described.sensor.own_presses = own_presses);
        let mut first = 5;
        let mut advised = |pipeline: &mut Pipeline| {
            first += 4;
            let light = [raw(9, 8), raw(9, 8), raw(0, 0), raw(0, 0)];
            let verdict = last_verdict(pipeline, first, &light);
            assert!(verdict.confidence < 0.7, "{}", verdict.confidence);
            verdict.advice
        };
        let again = Some(Advice::PressAgain);
        assert_eq!([advised(&mut pipeline), advised(&mut pipeline)], [again; 2]);
        let (sensor, hrn) = (pipeline.sensor().clone(), pipeline.hrn().clone());
        let mut next = pipeline.with_model(sensor, hrn).unwrap();
        assert_eq!([advised(&mut next), advised(&mut next)], [again, None]);
    }
}
