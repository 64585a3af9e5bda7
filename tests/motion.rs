//! Where the arm is: told to the real daemon on the control socket, recorded and replayed.
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

mod bench;

use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::time::Duration;

use bench::{Bench, Daemon, Subscriber, hardnessd};
use hardnessd::recording::{Entry, Input, Reader};
use serde_json::json;

fn mono_ns() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    u64::try_from(Duration::try_from(now).unwrap().as_nanos()).unwrap()
}

/// The points that a recording holds, line by line.
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
    let mut daemon = Daemon::start(&bench.configure("hardnessd.toml", "events.sock", more));
    let _sensor = bench.sensor(&[]);
    bench
        .subscriber()
        .until(&json!({"type": "status", "state": "live"}));
    let mut control = Subscriber::connect(&bench.path("control.sock"));
    let mut tell = |sensor: &str, at: serde_json::Value| {
        control.ask(&json!({"motion": {"sensor": sensor, "at": at}, "id": 7}).to_string())
    };
    let now = mono_ns();
    let ok = json!({"type": "ok", "id": 7});
    assert_eq!(
        tell("forearm", json!([[now - 2_000_000, 3.5], [now, 3.75]])),
        ok
    );
    let wall = jiff::Timestamp::now().to_string();
    assert_eq!(tell("forearm", json!([[wall, 4]])), ok);

    let refused = |answer: serde_json::Value, expected: &str| {
        assert_eq!(
            (&answer["type"], &answer["id"]),
            (&json!("error"), &json!(7))
        );
        let message = answer["message"].as_str().unwrap();
        assert!(message.starts_with(expected), "{message}");
    };
    refused(
        tell("foot", json!([[now, 1]])),
        "motion.sensor: found \"foot\"",
    );
    refused(tell("forearm", json!([])), "motion.at: found 0 points");
    let old = json!([[now, 1], [now - 61_000_000_000, 1]]);
    refused(tell("forearm", old), "motion.at[1]: found a moment 61");
    // It is taken in nevertheless: the clock of the robot may have been set back.
    let back = json!([[mono_ns(), 4.5], [now, 5]]);
    refused(tell("forearm", back), "motion.at[1]: found a step of");
    let mut events = bench.subscriber();
    let point = json!({"motion": {"sensor": "forearm", "at": [[now, 1]]}});
    let answer = events.ask(&point.to_string());
    let expected = "motion: this socket changes nothing: send it to the control socket";
    assert_eq!(answer["message"], expected);

    let address = daemon.address("http").to_string();
    let mut stream = TcpStream::connect(&address).unwrap();
    write!(
        stream,
        "GET /metrics HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n"
    )
    .unwrap();
    let mut metrics = String::new();
    stream.read_to_string(&mut metrics).unwrap();
    let counter = "hardnessd_motion_points_total{robot=\"arm-7\",sensor=\"forearm\"} 5";
    assert!(metrics.contains(counter), "{metrics}");

    daemon.process.signal(rustix::process::Signal::TERM);
    assert_eq!(daemon.process.exit_code(), Some(0));
    let tape = fs::read_dir(bench.path("tape"))
        .unwrap()
        .next()
        .unwrap()
        .unwrap()
        .path();
    let lines = recorded(&tape);
    let at = i64::try_from(now).unwrap();
    assert_eq!(lines[0], [(at - 2_000_000, 3.5), (at, 3.75)]);
    assert_eq!(lines.iter().map(Vec::len).collect::<Vec<_>>(), [2, 1, 2]);
    // The calendar and the monotonic clock are read at the same moment.
    assert!((lines[1][0].0 - at).abs() < 60_000_000_000 && lines[1][0].1 == 4.0);
    let replayed = hardnessd(&["replay", tape.to_str().unwrap()]);
    assert!(replayed.status.success(), "{replayed:?}");
}

#[test]
fn positions_of_raw_bytes_come_from_a_table() {
    let bench = Bench::new();
    let raw = bench.path("raw.bin");
    let raw = raw.to_str().unwrap();
    assert!(
        hardnessd(&["simulate", "--presses", "1", "--to", raw])
            .status
            .success()
    );
    let table = bench.path("motion.csv");
    let table = table.to_str().unwrap();
    let check = |more: &[&str], code, expected: &str| {
        let output = hardnessd(&[&["replay", raw, "--motion", table], more].concat());
        assert_eq!(output.status.code(), Some(code), "{output:?}");
        let errors = String::from_utf8(output.stderr).unwrap();
        assert!(errors.contains(expected), "{errors}");
        assert!(errors.lines().count() <= 1, "{errors}");
        output.stdout
    };
    check(&[], 66, "motion.csv: cannot read");
    fs::write(table, "time_s,approach_mm\n0,0\n0.1,x\n").unwrap();
    check(
        &[],
        1,
        "motion.csv:3: approach_mm: found \"x\", expected millimetres",
    );
    fs::write(table, "time_s,approach_mm\n0,0\n0.1,1\n").unwrap();
    let events = check(&[], 0, "");
    assert_eq!(check(&["--speed", "1e6"], 0, ""), events);
}
