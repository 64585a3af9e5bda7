//! Positions of the arm: sent to the real daemon on the control socket, recorded and replayed.

use crate::bench::{Bench, HTTP, RECORD, get, mono, sensor};
use hardnessd_core::pipeline::Input;
use hardnessd_core::recording::Entry;
use serde_json::{Value, json};

#[test]
fn positions_are_checked_counted_and_recorded() {
    let bench = Bench::new();
    let mut daemon = bench.daemon_with(&format!("{HTTP}{RECORD}"));
    let _sensor = bench.sensor("");
    bench.subscriber().state("live");
    let mut control = bench.control();
    let mut send = |at: Value| {
        control.ask(&json!({"motion": {"sensor": "forearm", "at": at}, "id": 7}).to_string())
    };
    let mono_ns = || u64::try_from(mono().as_nanos()).unwrap();
    let now = mono_ns();
    let ok = json!({"type": "ok", "id": 7});
    assert_eq!(send(json!([[now - 2_000_000, 3.5], [now, 3.75]])), ok);
    let wall = jiff::Timestamp::now().to_string();
    assert_eq!(send(json!([[wall, 4]])), ok);
    // The points are taken nevertheless, because the robot may have set its clock back.
    let back = send(json!([[mono_ns(), 4.5], [now, 5]]));
    let message = back["message"].as_str().unwrap();
    assert!(
        message.starts_with("motion.at[1]: found a step of"),
        "{back}"
    );
    let expected = "this socket changes nothing: send it to the control socket";
    let point = json!({"motion": {"sensor": "forearm", "at": [[now, 1]]}});
    bench.subscriber().is_refused(&point.to_string(), expected);

    let metrics = get(daemon.address("http"), "/metrics").body;
    let counter = "hardnessd_motion_points_total{robot=\"arm-7\",sensor=\"forearm\"} 5";
    assert!(metrics.contains(counter), "{metrics}");

    daemon.end();
    let mut lines: Vec<Vec<(i64, f64)>> = Vec::new();
    for found in bench.entries(&bench.recordings("hardnessd-")[0]) {
        if let Entry::Input(Input::Motion(points)) = found.entry {
            lines.push(points.iter().map(|&point| point.into()).collect());
        }
    }
    let at = i64::try_from(now).unwrap();
    assert_eq!(lines[0], [(at - 2_000_000, 3.5), (at, 3.75)]);
    assert_eq!(lines.iter().map(Vec::len).collect::<Vec<_>>(), [2, 1, 2]);
    // This point was sent with a calendar time. The daemon reads both clocks at the same moment.
    assert!((lines[1][0].0 - at).abs() < 60_000_000_000 && lines[1][0].1 == 4.0);
}

#[test]
fn a_robot_that_tells_its_positions_gets_verdicts_on_the_course() {
    let bench = Bench::new();
    // At 230,400 baud a frame takes 34.3 ms.
    let arm = "arm = { stiffness_n_per_mm = 10.0, delay_ms = 34.3 }\n";
    let model = "[model]\nearly_confidence = 0.5\n";
    let _daemon = bench.daemon_of(&(sensor("forearm", "port", 20) + arm), model);
    let mut subscriber = bench.subscriber();
    let _sensor = bench.sensor("--material yoga-mat --motion control.sock");
    let mut verdicts = Vec::new();
    while verdicts.iter().filter(|&phase| phase == "final").count() < 2 {
        let verdict = subscriber.until(&json!({"type": "hardness"}));
        assert_eq!(verdict["course"], "positions", "{verdict}");
        // On hard plastic, nearly all of the way is the arm's own. The second press is on a yoga
        // mat.
        let stiffness = verdict["stiffness_n_per_mm"].as_f64();
        let is_known = stiffness.is_some_and(|n_per_mm| (0.5..60.0).contains(&n_per_mm));
        let is_hard = verdict["press"] == 1 || verdict["phase"] == "early";
        assert!(is_hard || is_known, "{verdict}");
        verdicts.push(verdict["phase"].clone());
    }
    assert!(verdicts.iter().any(|phase| phase == "early"));
}
