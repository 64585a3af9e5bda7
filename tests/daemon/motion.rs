//! Positions of the arm: sent to the real daemon on the control socket, recorded and replayed.

use std::fs;
use std::path::Path;
use std::time::Duration;

use crate::bench::{Bench, Daemon, Subscriber, fails, get, recordings_in, run};
use hardnessd_core::pipeline::Input;
use hardnessd_core::recording::{Entry, Reader};
use serde_json::{Value, json};

fn mono_ns() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    u64::try_from(Duration::try_from(now).unwrap().as_nanos()).unwrap()
}

/// The points in a recording, line by line.
fn recorded(path: &Path) -> Vec<Vec<(i64, f64)>> {
    let file = fs::File::open(path).unwrap();
    let found = Reader::new(std::io::BufReader::new(file)).map(Result::unwrap);
    found
        .filter_map(|found| match found.entry {
            Entry::Input(Input::Motion(points)) => {
                Some(points.iter().map(|&point| point.into()).collect())
            }
            _ => None,
        })
        .collect()
}

#[test]
fn positions_are_checked_counted_and_recorded() {
    let bench = Bench::new();
    let more = "[http]\nlisten = \"127.0.0.1:0\"\n[record]\ndir = \"tape\"\nkeep_free_mb = 0\n";
    let mut daemon = bench.daemon_with(more);
    let _sensor = bench.sensor(&[]);
    bench
        .subscriber()
        .until(&json!({"type": "status", "state": "live"}));
    let mut control = Subscriber::connect(&bench.path("control.sock"));
    let mut send_positions = |sensor: &str, at: Value| {
        control.ask(&json!({"motion": {"sensor": sensor, "at": at}, "id": 7}).to_string())
    };
    let now = mono_ns();
    let ok = json!({"type": "ok", "id": 7});
    assert_eq!(
        send_positions("forearm", json!([[now - 2_000_000, 3.5], [now, 3.75]])),
        ok
    );
    let wall = jiff::Timestamp::now().to_string();
    assert_eq!(send_positions("forearm", json!([[wall, 4]])), ok);

    // The points are taken nevertheless, because the robot may have set its clock back.
    let back = send_positions("forearm", json!([[mono_ns(), 4.5], [now, 5]]));
    let message = back["message"].as_str().unwrap();
    assert!(
        message.starts_with("motion.at[1]: found a step of"),
        "{back}"
    );
    let mut events = bench.subscriber();
    let point = json!({"motion": {"sensor": "forearm", "at": [[now, 1]]}});
    let answer = events.ask(&point.to_string());
    let expected = "motion: this socket changes nothing: send it to the control socket";
    assert_eq!(answer["message"], expected);

    let address = daemon.address("http").to_string();
    let metrics = get(&address, "/metrics");
    let counter = "hardnessd_motion_points_total{robot=\"arm-7\",sensor=\"forearm\"} 5";
    assert!(metrics.contains(counter), "{metrics}");

    daemon.end();
    let tape = recordings_in(&bench.path("tape"), "hardnessd-").remove(0);
    let lines = recorded(&tape);
    let at = i64::try_from(now).unwrap();
    assert_eq!(lines[0], [(at - 2_000_000, 3.5), (at, 3.75)]);
    assert_eq!(lines.iter().map(Vec::len).collect::<Vec<_>>(), [2, 1, 2]);
    // This point was sent with a calendar time. The daemon reads both clocks at the same moment.
    assert!((lines[1][0].0 - at).abs() < 60_000_000_000 && lines[1][0].1 == 4.0);
}

#[test]
fn positions_of_raw_bytes_come_from_a_table() {
    let bench = Bench::new();
    let [raw, table] = ["raw.bin", "motion.csv"].map(|name| bench.path(name));
    let [raw, table] = [&raw, &table].map(|path| path.to_str().unwrap());
    assert_eq!(run(&["simulate", "--presses", "1", "--to", raw]).0, 0);
    let replay = ["replay", raw, "--motion", table];
    fails(&replay, 66, &["motion.csv: cannot read"]);
    fs::write(table, "time_s,approach_mm\n0,0\n0.1,x\n").unwrap();
    fails(&replay, 1, &["motion.csv:3: approach_mm: found \"x\""]);
    fs::write(table, "time_s,approach_mm\n0,0\n0.1,1\n").unwrap();
    let (code, events, _) = run(&replay);
    assert_eq!(code, 0);
    assert_eq!(run(&[&replay[..], &["--speed", "1e6"]].concat()).1, events);
}

#[test]
fn a_robot_that_tells_its_positions_gets_verdicts_on_the_course() {
    let bench = Bench::new();
    let model = "[model]\nearly_confidence = 0.5\n";
    let config = bench.configure("hardnessd.toml", "events.sock", model);
    let text = fs::read_to_string(&config).unwrap();
    let arm = "frame_rate_hz = 20.0\narm = { stiffness_n_per_mm = 10.0, delay_ms = 34.3 }";
    fs::write(&config, text.replace("frame_rate_hz = 20.0", arm)).unwrap();
    let _daemon = Daemon::start(&config);
    let mut subscriber = bench.subscriber();
    let control = bench.path("control.sock");
    let control = control.to_str().unwrap();
    // At 230,400 baud a frame takes 34.3 ms.
    let _sensor = bench.sensor(&["--material", "yoga-mat", "--motion", control]);
    let (mut earlies, mut finals) = (0, 0);
    while finals < 2 {
        let verdict = subscriber.until(&json!({"type": "hardness"}));
        assert_eq!(verdict["course"], "positions", "{verdict}");
        if verdict["phase"] == "early" {
            earlies += 1;
            continue;
        }
        // On hard plastic, nearly all of the way is the arm's own. The second press is on a yoga
        // mat.
        let stiffness = verdict["stiffness_n_per_mm"].as_f64();
        let is_known = stiffness.is_some_and(|n_per_mm| (0.5..60.0).contains(&n_per_mm));
        assert!(finals == 0 || is_known, "{verdict}");
        finals += 1;
    }
    assert!(earlies >= 1);
}
