//! The published bytes of protocol 1, frozen. If one of these tests fails, the change is wrong, not
//! the test. Fields may be added with a new expectation, but never renamed, reordered or given
//! another meaning.

use std::time::Duration;

use hardnessd_core::event::*;
use hardnessd_core::frame::Pitch;
use hardnessd_core::tare::Offsets;
use hardnessd_core::verdict::Level;
use jiff::Timestamp;
use serde_json::json;

fn time() -> Timestamp {
    Timestamp::new(1_700_000_000, 123_456_789).unwrap()
}

fn status() -> Status {
    Status {
        seq: Some(7),
        sensor: "forearm".to_owned(),
        time: time(),
        state: LinkState::Lost,
        reason: Some("end of file".to_owned()),
        detail: None,
        frames: 100,
        frames_damaged: 2,
        frames_dropped: 3,
        bytes_skipped: 1580,
        frame_rate_hz: Some(4.999_96),
    }
}

fn hardness() -> Hardness {
    Hardness {
        seq: None,
        sensor: "forearm".to_owned(),
        time: time(),
        press: 3,
        phase: Phase::Final,
        level: Some(2),
        label: Some("firm".to_owned()),
        rejected: None,
        notes: vec![Note::AtEdge, Note::Saturated, Note::OutsideTraining],
        probabilities: vec![0.125, 0.75, 0.125, 0.0],
        confidence: 0.75,
        frame: 41,
        contact_area_taxels: 25,
        contact_area_mm2: 306.25,
        force_n: 12.345_678,
        model: "0123456789ab".to_owned(),
        state: LinkState::Live,
        context: Some(json!({"tag": "pick-17"})),
        mono_ns: Some(5_000_000_000),
        age_at_publish_ms: Some(0.25),
        latency_us: Some(150),
        shore: None,
        levels: None,
        course: None,
        stiffness_n_per_mm: None,
        references: "none".to_owned(),
        advice: None,
        object: None,
        arrival: Duration::ZERO,
    }
}

fn check(line: &str, expected: &str) {
    assert_eq!(line.strip_suffix('\n'), Some(expected));
}

#[test]
fn status_is_frozen() {
    let frozen = r#"{"type":"status","seq":7,"sensor":"forearm","time":"2023-11-14T22:13:20.123456Z","state":"lost","reason":"end of file","frames":100,"frames_damaged":2,"frames_dropped":3,"bytes_skipped":1580,"frame_rate_hz":5.0,"detail":null}"#;
    check(&Event::Status(status()).to_line(), frozen);
    let asked = Status {
        seq: None,
        reason: None,
        state: LinkState::Connecting,
        frame_rate_hz: None,
        ..status()
    };
    let frozen = r#"{"type":"status","sensor":"forearm","time":"2023-11-14T22:13:20.123456Z","state":"connecting","reason":null,"frames":100,"frames_damaged":2,"frames_dropped":3,"bytes_skipped":1580,"frame_rate_hz":null,"detail":null}"#;
    check(&Event::Status(asked).to_line(), frozen);
}

#[test]
fn press_is_frozen() {
    let press = Press {
        seq: Some(1),
        sensor: "forearm".to_owned(),
        time: time(),
        press: 3,
        state: PressState::Aborted,
        frame: 44,
        reason: Some("short"),
        frames: 1,
        context: None,
    };
    let frozen = r#"{"type":"press","seq":1,"sensor":"forearm","time":"2023-11-14T22:13:20.123456Z","press":3,"state":"aborted","frame":44,"reason":"short","frames":1,"context":null}"#;
    check(&Event::Press(press).to_line(), frozen);
}

#[test]
fn hardness_is_frozen() {
    let frozen = r#"{"type":"hardness","sensor":"forearm","time":"2023-11-14T22:13:20.123456Z","press":3,"phase":"final","level":2,"label":"firm","rejected":null,"notes":["at_edge","saturated","outside_training"],"probabilities":[0.125,0.75,0.125,0.0],"confidence":0.75,"frame":41,"contact_area_taxels":25,"contact_area_mm2":306.25,"force_n":12.346,"model":"0123456789ab","state":"live","context":{"tag":"pick-17"},"mono_ns":5000000000,"age_at_publish_ms":0.25,"latency_us":150,"shore":null,"levels":null,"course":null,"stiffness_n_per_mm":null,"references":"none","advice":null,"object":null}"#;
    check(&Event::Hardness(hardness()).to_line(), frozen);
    let mut rejected = Event::Hardness(Hardness {
        phase: Phase::Early,
        level: None,
        label: None,
        rejected: Some(Rejection::LowConfidence),
        notes: vec![],
        context: None,
        mono_ns: None,
        age_at_publish_ms: None,
        latency_us: None,
        ..hardness()
    });
    rejected.number(9);
    let frozen = r#"{"type":"hardness","seq":9,"sensor":"forearm","time":"2023-11-14T22:13:20.123456Z","press":3,"phase":"early","level":null,"label":null,"rejected":"low_confidence","notes":[],"probabilities":[0.125,0.75,0.125,0.0],"confidence":0.75,"frame":41,"contact_area_taxels":25,"contact_area_mm2":306.25,"force_n":12.346,"model":"0123456789ab","state":"live","context":null,"mono_ns":null,"age_at_publish_ms":null,"latency_us":null,"shore":null,"levels":null,"course":null,"stiffness_n_per_mm":null,"references":"none","advice":null,"object":null}"#;
    check(&rejected.to_line(), frozen);
}

#[test]
fn a_probability_has_at_most_six_digits_after_the_point() {
    let verdict = Hardness {
        probabilities: vec![0.123_456_78, 0.876_543, 5.8e-9, 1.0 / 3.0],
        confidence: 0.876_543_2,
        ..hardness()
    };
    let line = Event::Hardness(verdict).to_line();
    let expected = r#""probabilities":[0.123457,0.876543,0.0,0.333333],"confidence":0.876543,"#;
    assert!(line.contains(expected), "{line}");
}

#[test]
fn frame_is_frozen_and_never_numbered() {
    let mut frame = Event::Frame(FrameEvent {
        sensor: "forearm".to_owned(),
        time: time(),
        frame: 5,
        rows: 1,
        cols: 3,
        newtons: vec![-0.000_4, 0.123_456, 10.2],
        contact_area_taxels: 2,
        force_n: Some(10.323_4),
        tared: true,
        approach_mm: None,
    });
    frame.number(9);
    let frozen = r#"{"type":"frame","sensor":"forearm","time":"2023-11-14T22:13:20.123456Z","frame":5,"rows":1,"cols":3,"newtons":[0.0,0.123,10.2],"contact_area_taxels":2,"force_n":10.323,"tared":true,"approach_mm":null}"#;
    check(&frame.to_line(), frozen);
}

#[test]
fn replies_are_frozen() {
    let ok = |id, tare, blackbox| Reply::Ok { id, tare, blackbox };
    let error = Reply::Error {
        message: "no".to_owned(),
        id: None,
    };
    let offsets = |mean_counts| Offsets {
        mean_counts,
        least_counts: 1.5,
        most_counts: 9.0,
    };
    let tared = Tared {
        sensor: "forearm".to_owned(),
        old: offsets(2.25),
        new: offsets(2.5),
    };
    let blackbox = "/var/lib/hardnessd/blackbox.mcap".to_owned();
    let hello = Hello {
        protocol: PROTOCOL,
        server: "hardnessd",
        version: "0.1.0",
        robot: "arm-7".to_owned(),
        run: "r".to_owned(),
        boot_id: "b".to_owned(),
        seq: 0,
        sensors: vec![SensorCard {
            name: "forearm".to_owned(),
            rows: 28,
            cols: 28,
            pitch_mm: Pitch::JX255N,
        }],
        model: ModelCard {
            sha256: "00".to_owned(),
            validation: "simulated data only".to_owned(),
            levels: vec![Level::new(1, "hard", ">70")],
            name: "built in".to_owned(),
            needs: "judges single frames, needs no arm".to_owned(),
            without_effect: vec!["sensor.arm of \"forearm\"".to_owned()],
        },
    };
    for (reply, text) in [
        (Reply::Gap { lost: Some(12) }, r#"{"type":"gap","lost":12}"#),
        (Reply::Gap { lost: None }, r#"{"type":"gap","lost":null}"#),
        (error, r#"{"type":"error","message":"no"}"#),
        (
            ok(Some(json!("a")), None, None),
            r#"{"type":"ok","id":"a"}"#,
        ),
        (
            ok(None, None, Some(blackbox)),
            r#"{"type":"ok","blackbox":"/var/lib/hardnessd/blackbox.mcap"}"#,
        ),
        (
            ok(None, Some(tared), None),
            r#"{"type":"ok","tare":{"sensor":"forearm","old":{"mean_counts":2.25,"least_counts":1.5,"most_counts":9.0},"new":{"mean_counts":2.5,"least_counts":1.5,"most_counts":9.0}}}"#,
        ),
        (
            Reply::Hello(hello),
            r#"{"type":"hello","protocol":1,"server":"hardnessd","version":"0.1.0","robot":"arm-7","run":"r","boot_id":"b","seq":0,"sensors":[{"name":"forearm","rows":28,"cols":28,"pitch_mm":3.5}],"model":{"sha256":"00","validation":"simulated data only","levels":[{"level":1,"label":"hard","shore":">70"}],"name":"built in","needs":"judges single frames, needs no arm","without_effect":["sensor.arm of \"forearm\""]}}"#,
        ),
    ] {
        check(&reply.to_line(), text);
    }
}
