//! Tests with a model that judges the course of a press.

use serde_json::{Value, json};
use tract_onnx::pb;

use super::*;
use crate::event::ApproachSource;
use crate::judge::OwnPresses;
use crate::tests::course_model::{self, course_model, encoded};
use crate::tests::graph::{node, number};
use crate::verdict::BUILT_IN;

/// A tared pipeline with an arm of 10 N/mm. Its model returns its own input.
fn tared(more: &[(&str, Value)], change: impl FnOnce(&mut Description)) -> Pipeline {
    let mut pipeline = pipeline_of(|described| {
        described.sensor.arm.stiffness_n_per_mm = Some(10.0);
        described.model.early_confidence = 0.8;
        change(described);
    });
    let hrn = Model::read(&course_model(8, more)).unwrap();
    judge_by(&mut pipeline, Arc::new(hrn));
    play(&mut pipeline, 1, &vec![raw(0, 0); 5]);
    pipeline
}

/// The frames of a press on nine taxels, loaded in four frames, held for one and released: 7.2 to
/// 28.8 N.
fn press() -> Vec<RawFrame> {
    let held = [20, 40, 60, 80, 80].map(|counts| raw(9, counts));
    [&held[..], &vec![raw(0, 0); 2]].concat()
}

/// Positions of an arm at 5 mm/s, one every 50 ms. The arm stops at 2.8 s, when the press's fourth
/// frame comes.
fn positions(from_ms: i64, to_ms: i64) -> Vec<Point> {
    (from_ms..=to_ms)
        .step_by(50)
        .map(|ms| Point {
            at_ns: ms * 1_000_000,
            mm: 0.005 * ms.min(2800) as f64,
        })
        .collect()
}

/// The verdicts on one press. Before each frame, the pipeline gets the positions that `told`
/// returns for the frame's time in ms.
fn judged(pipeline: &mut Pipeline, reported: impl Fn(i64) -> Vec<Point>) -> Vec<Hardness> {
    let mut events = Vec::new();
    for (number, raw) in (6..).zip(press()) {
        let at = at(number * 200);
        let _ = pipeline
            .judge
            .track
            .push(&reported(at.mono.as_millis() as i64));
        let bytes = bytes(pipeline, &raw);
        events.extend(pipeline.push(&bytes, at));
    }
    verdicts(events)
}

/// The model's input: the sum of the approach, the number of frames and the arm's stiffness.
fn given(verdict: &Hardness) -> [f32; 3] {
    course_model::given(&verdict.probabilities)
}

#[test]
fn positions_reach_the_model_and_the_slope_is_the_objects() {
    let mut pipeline = tared(&[], |_| {});
    pipeline.judge.track.push(&positions(1000, 9000)).unwrap();
    let found = judged(&mut pipeline, |_| Vec::new());
    let [early, last] = &found[..] else {
        panic!("{found:?}");
    };
    // This is the sum of 0, 1, 2, 3 and again 3 mm.
    assert_eq!(given(last), [9.0, 5.0, 10.0]);
    assert_eq!(last.course, Some(ApproachSource::Positions));
    // From 14.4 to 28.8 N the arm goes 2 mm, of which 1.44 mm are its own bending.
    let slope = last.stiffness_n_per_mm.unwrap();
    assert!((slope - 14.4 / 0.56).abs() < 1e-3, "{slope}");
    assert_eq!((last.level, last.frame), (Some(2), 8));
    // With three frames, the confidence is 78 %. With four, it is 86 %.
    assert_eq!((early.phase, early.frame), (Phase::Early, 8));
    assert_eq!(given(early), [6.0, 4.0, 10.0]);
    assert!(early.confidence > 0.8);
}

#[test]
fn a_delay_shifts_the_approach() {
    let mut pipeline = tared(&[], |described| described.sensor.arm.delay_ms = 100.0);
    pipeline.judge.track.push(&positions(1000, 9000)).unwrap();
    let found = judged(&mut pipeline, |_| Vec::new());
    // At the fifth frame the arm has stopped: half a millimetre further than at the fourth.
    assert_eq!(given(&found[1]), [9.5, 5.0, 10.0]);
}

#[test]
fn an_early_verdict_is_on_the_frames_whose_positions_have_come() {
    let mut pipeline = tared(&[], |_| {});
    let _ = pipeline.judge.track.push(&positions(1000, 1950));
    let found = judged(&mut pipeline, |now| positions(now - 250, now - 100));
    let [early, last] = &found[..] else {
        panic!("{found:?}");
    };
    // The early verdict comes with the fifth frame, and leaves that frame out.
    assert_eq!((early.frame, given(early)), (8, [6.0, 4.0, 10.0]));
    assert_eq!((last.frame, given(last)), (8, [9.0, 5.0, 10.0]));
}

#[test]
fn without_positions_the_arm_moves_at_its_speed_and_then_holds() {
    let context = |speed: f64| Some(json!({"sensor": "forearm", "speed_mm_s": speed}));
    for (context, configured, value) in [
        (context(5.0), None, 9.0),
        (None, Some(5.0), 9.0),
        (context(10.0), Some(5.0), 18.0),
    ] {
        let mut pipeline = tared(&[], |described| {
            described.sensor.arm.speed_mm_s = configured;
        });
        pipeline.judge.context = context;
        let found = judged(&mut pipeline, |_| Vec::new());
        // At 5 mm/s, this is the sum of 0, 1, 2, 3 and again 3 mm.
        assert_eq!(given(&found[1]), [value, 5.0, 10.0]);
        assert_eq!(found[1].course, Some(ApproachSource::Speed));
        assert!(found[1].stiffness_n_per_mm.is_some());
    }
    // Below a baseline that stands too high, no frame of a press has a force.
    let mut pipeline = pipeline_of(|described| described.sensor.arm.speed_mm_s = Some(5.0));
    let hrn = Model::read(&course_model(8, &[])).unwrap();
    judge_by(&mut pipeline, Arc::new(hrn));
    let mut unloaded = raw(0, 0);
    unloaded.counts.fill(2.0);
    play(&mut pipeline, 1, &vec![unloaded; 5]);
    let below = [raw(9, 4), raw(9, 4), raw(0, 0), raw(0, 0)];
    assert!(last_verdict(&mut pipeline, 6, &below).force_n < 0.0);
    // A context may be any JSON.
    let mut pipeline = tared(&[], |_| {});
    pipeline.judge.context = Some(json!({"speed_mm_s": "fast"}));
    let found = judged(&mut pipeline, |_| Vec::new());
    assert_eq!(found[1].course, Some(ApproachSource::None));
}

#[test]
fn where_the_approach_is_unknown_nothing_is_said_of_the_arm() {
    let late = |pipeline: &mut Pipeline| {
        let _ = pipeline.judge.track.push(&positions(1000, 2500));
    };
    let jump = |pipeline: &mut Pipeline| {
        let mut points = positions(1000, 9000);
        points[30].mm += 30.0;
        let _ = pipeline.judge.track.push(&points);
    };
    let speed_beside_positions = |pipeline: &mut Pipeline| {
        pipeline.judge.context = Some(json!({"speed_mm_s": 5.0}));
        let _ = pipeline.judge.track.push(&positions(1000, 1500));
    };
    let prepare: [fn(&mut Pipeline); 4] = [|_| {}, late, jump, speed_beside_positions];
    for prepare in prepare {
        let mut pipeline = tared(&[], |_| {});
        prepare(&mut pipeline);
        let found = judged(&mut pipeline, |_| Vec::new());
        let last = found.last().unwrap();
        assert_eq!(given(last), [0.0, 5.0, 0.0]);
        assert_eq!(
            (last.course, last.stiffness_n_per_mm),
            (Some(ApproachSource::None), None)
        );
    }
}

#[test]
fn positions_after_the_final_verdict_are_counted() {
    let mut pipeline = tared(&[], |_| {});
    judged(&mut pipeline, |_| Vec::new());
    pipeline.judge.track.push(&positions(2000, 4000)).unwrap();
    // The press's last frame in contact came at 3 s.
    assert_eq!(pipeline.track().counts(), (41, 21));
}

#[test]
fn positions_that_say_nothing_of_the_press_are_no_course() {
    // The first frame comes at 2.2 s and the second at 2.4 s. The sensor is released at 2.6 s.
    let found = |first: RawFrame, until_ms: i64| {
        let mut pipeline = tared(&[], |_| {});
        let _ = pipeline.judge.track.push(&positions(1000, until_ms));
        let press = [first, raw(9, 80), raw(0, 0), raw(0, 0)];
        let last = last_verdict(&mut pipeline, 6, &press);
        (last.frame, last.course, given(&last))
    };
    let known = Some(ApproachSource::Positions);
    assert_eq!(found(raw(9, 20), 2400), (6, known, [1.0, 2.0, 10.0]));
    // The approach is known at the first frame only.
    let unknown = Some(ApproachSource::None);
    assert_eq!(found(raw(9, 20), 2350), (6, unknown, [0.0, 2.0, 0.0]));
    // If the first frame is the best one, the second one counts too.
    assert_eq!(found(raw(12, 80), 2400), (5, known, [1.0, 2.0, 10.0]));
    assert_eq!(found(raw(12, 80), 2350), (5, unknown, [0.0, 2.0, 0.0]));
}

#[test]
fn levels_that_it_cannot_tell_apart_are_a_rejection() {
    let check = |threshold: f64, level, rejected, levels: &[u8]| {
        let conformal = json!({"alpha": 0.1, "threshold": threshold});
        let mut pipeline = tared(&[("hrn.conformal", conformal)], |_| {});
        let found = judged(&mut pipeline, |_| Vec::new());
        let last = found.last().unwrap();
        assert_eq!((last.level, last.rejected), (level, rejected));
        assert_eq!(last.levels.as_deref(), Some(levels));
    };
    check(0.5, Some(2), None, &[2]);
    check(0.09, None, Some(Rejection::Ambiguous), &[2, 3]);
}

#[test]
fn an_early_verdict_comes_once_and_only_if_it_is_sure_and_on_enough_force() {
    // The frames 5 to 8 have 7.2 to 28.8 N.
    for (early_confidence, min_force_n, expected) in [
        (0.0, 1.0, Some(7)),
        (0.0, 22.0, Some(8)),
        (0.0, 30.0, None),
        (0.8, 1.0, Some(8)),
        (0.99, 1.0, None),
    ] {
        let mut pipeline = tared(&[], |described| {
            described.model.early_confidence = early_confidence;
            described.press.early_min_force_n = min_force_n;
        });
        let mut early = judged(&mut pipeline, |_| Vec::new());
        assert_eq!(early.pop().unwrap().phase, Phase::Final);
        let frames: Vec<u64> = early.iter().map(|verdict| verdict.frame).collect();
        assert_eq!(frames, Vec::from_iter(expected));
    }
}

#[test]
fn an_early_verdict_waits_until_it_is_no_rejection() {
    // The third frame has 21.6 N, and the fourth has 28.8 N.
    let mut pipeline = tared(&[], |described| {
        described.model.early_confidence = 0.0;
        described.model.min_force_n = 25.0;
    });
    let found = judged(&mut pipeline, |_| Vec::new());
    assert_eq!((found[0].phase, found[0].frame), (Phase::Early, 8));
    assert_eq!((found[0].rejected, found[0].level.is_some()), (None, true));
    assert_eq!(found.len(), 2);

    let conformal = json!({"alpha": 0.1, "threshold": 0.001});
    let mut pipeline = tared(&[("hrn.conformal", conformal)], |described| {
        described.model.early_confidence = 0.0;
    });
    let found = judged(&mut pipeline, |_| Vec::new());
    let phases: Vec<_> = found.iter().map(|one| (one.phase, one.rejected)).collect();
    assert_eq!(phases, [(Phase::Final, Some(Rejection::Ambiguous))]);
}

#[test]
fn a_long_press_is_thinned() {
    let mut pipeline = tared(&[], |_| {});
    let held: Vec<RawFrame> = (0..100)
        .map(|n| raw(9 + usize::from(n == 50), 60))
        .collect();
    let press = [&held[..], &vec![raw(0, 0); 2]].concat();
    let last = last_verdict(&mut pipeline, 6, &press);
    assert_eq!(last.frame, 55);
    let frames = given(&last)[1];
    assert!(frames == 7.0 || frames == 8.0, "{frames}");
    // The last time and the best frame's force are in the logits.
    let [first, second, third] = [0, 1, 2].map(|n| f64::from(last.probabilities[n]).ln());
    assert!((third - first - 19.8).abs() < 0.01);
    assert!((second - first - 2.4).abs() < 0.01);
}

#[test]
fn a_model_of_frames_has_no_course_but_the_slope_is_known() {
    let found = |reported: &[Point], arm_n_per_mm| {
        let mut pipeline = tared(&[], |d| d.sensor.arm.stiffness_n_per_mm = arm_n_per_mm);
        judge_by(&mut pipeline, support::hrn());
        pipeline.judge.track.push(reported).unwrap();
        let held = [20, 40, 60, 80, 80, 80, 80, 0, 0].map(|counts| raw(9, counts));
        let found = verdicts(feed(&mut pipeline, 6, &held));
        let phases: Vec<Phase> = found.iter().map(|verdict| verdict.phase).collect();
        assert_eq!(phases, [Phase::Early, Phase::Final]);
        found
    };
    for verdict in found(&positions(1000, 9000), Some(10.0)) {
        let slope = verdict.stiffness_n_per_mm.unwrap();
        assert!((slope - 14.4 / 0.56).abs() < 1e-3, "{slope}");
        assert_eq!((verdict.course, &verdict.levels), (None, &None));
        assert!(verdict.shore.is_some(), "the built-in model's second head");
    }
    for (reported, arm_n_per_mm) in [(Vec::new(), Some(10.0)), (positions(1000, 9000), None)] {
        for verdict in found(&reported, arm_n_per_mm) {
            assert_eq!(verdict.stiffness_n_per_mm, None);
        }
    }
}

/// Adds a number to an output of a model: a tiny one if `other` is less than `most`, and NaN if it is more.
fn spoil(proto: &mut pb::ModelProto, output: &str, most: f32, other: &str) {
    let graph = proto.graph.as_mut().unwrap();
    let is_of = |node: &&mut pb::NodeProto| node.output[0] == output;
    let spoilt = graph.node.iter_mut().find(is_of).unwrap();
    spoilt.name = "unspoilt".to_owned();
    spoilt.output[0] = "unspoilt".to_owned();
    let numbers = [number("most", most), number("tiny factor", 1e-30)];
    graph.initializer.extend(numbers);
    graph.node.extend([
        node("Sub", &["most", other], &["left"], &[]),
        node("Log", &["left"], &["log"], &[]),
        node("Mul", &["log", "tiny factor"], &["tiny or NaN"], &[]),
        node("Add", &["unspoilt", "tiny or NaN"], &[output], &[]),
    ]);
}

#[test]
fn a_press_that_cannot_be_kept_has_its_verdict() {
    // The model fails on presses of objects of which nothing is known, and judges the press.
    let file = changed(BUILT_IN, |proto| spoil(proto, "reference", 99.0, "high"));
    let mut pipeline = tared(&[], |_| {});
    judge_by(&mut pipeline, Arc::new(Model::load(&file).unwrap()));
    let found = judged(&mut pipeline, |_| Vec::new());
    assert_eq!(found.last().unwrap().phase, Phase::Final);
    let [error] = &pipeline.unjudged()[..] else {
        panic!("expected one error")
    };
    let expected = "model gave a number that is not finite in `reference`";
    assert_eq!((error.press, error.phase), (1, Phase::Final));
    assert_eq!(error.error.to_string(), expected);
}

#[test]
fn a_press_without_a_verdict_is_told_once_and_remembered() {
    // The model fails on an arm of 10 N/mm. That of its checks is at most 6 N/mm.
    let bytes = encoded(8, &[], |proto| spoil(proto, "second", 7.0, "arm_n_per_mm"));
    let mut pipeline = tared(&[], |described| described.sensor.arm.speed_mm_s = Some(5.0));
    judge_by(&mut pipeline, Arc::new(Model::read(&bytes).unwrap()));
    assert_eq!(play(&mut pipeline, 6, &press()), ["Begin 1", "End 1"]);
    let told = pipeline.unjudged();
    assert_eq!(told.last().unwrap().phase, Phase::Final);
    assert!(told[0].error.to_string().contains("not finite"));
    assert!(pipeline.unjudged().is_empty(), "told once");
    assert_ne!(pipeline.judge.kept.own, OwnPresses::default());
}
