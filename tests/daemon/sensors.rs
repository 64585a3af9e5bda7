//! A reload that adds and removes sensors.

use std::fs;
use std::path::PathBuf;

use rustix::process::Signal;
use serde_json::json;

use crate::bench::{Bench, Daemon, events, get, hardnessd, recordings_in, wait_for};

/// A configuration with these sensors, each at the port of its name.
fn configure(bench: &Bench, names: &[&str], more: &str) -> PathBuf {
    let path = bench.path("hardnessd.toml");
    let sensors = names.iter().map(|name| {
        format!("[[sensor]]\nname = \"{name}\"\nport = \"{name}\"\nframe_rate_hz = 20.0\n")
    });
    let text = format!(
        "{}[publish.unix]\npath = \"events.sock\"\n[http]\nlisten = \"127.0.0.1:0\"\n[record]\ndir = \"records\"\n\
         keep_free_mb = 0\n{more}",
        sensors.collect::<String>()
    );
    fs::write(&path, text).unwrap();
    path
}

fn reload(daemon: &mut Daemon, answer: &str) -> String {
    daemon.process.signal(Signal::HUP);
    daemon.logged(answer)
}

fn names(hello: &serde_json::Value) -> Vec<&str> {
    let cards = hello["sensors"].as_array().unwrap();
    cards
        .iter()
        .map(|card| card["name"].as_str().unwrap())
        .collect()
}

/// The number of frames of a sensor, by a connection of its own: this begins with the statuses.
fn frames(bench: &Bench, sensor: &str) -> u64 {
    let status = bench
        .subscriber()
        .until(&json!({"type": "status", "sensor": sensor}));
    status["frames"].as_u64().unwrap()
}

#[test]
fn a_reload_adds_and_removes_sensors_and_the_others_run_on() {
    let bench = Bench::new();
    let plays = ["wrist", "elbow", "palm"].map(|name| bench.sensor_at(name, 20, &[]));
    let mut daemon = Daemon::start(&configure(&bench, &["wrist", "elbow"], ""));
    let mut subscriber = bench.subscriber();
    // A press of the sensor that goes is under way.
    subscriber.until(&json!({"type": "press", "sensor": "wrist", "state": "begin"}));
    let press = subscriber.until(&json!({"type": "press", "sensor": "elbow", "state": "begin"}));
    let before = frames(&bench, "wrist");
    configure(&bench, &["palm", "wrist"], "");
    reload(&mut daemon, "reloaded");
    let end = subscriber.until(&json!({"type": "press", "sensor": "elbow"}));
    assert_eq!(end["press"], press["press"]);
    assert_eq!(
        (&end["state"], &end["reason"]),
        (&json!("aborted"), &json!("shutdown"))
    );
    subscriber.until(&json!({"type": "status", "sensor": "palm", "state": "live"}));
    assert!(frames(&bench, "wrist") > before);
    // The next press of the kept sensor goes on with its numbers.
    let next = subscriber.until(&json!({"type": "press", "sensor": "wrist", "state": "begin"}));
    assert!(next["press"].as_u64() >= Some(2), "{next}");

    let mut later = bench.subscriber();
    let hello = later.next().unwrap();
    assert_eq!(names(&hello), ["palm", "wrist"]);
    for name in ["palm", "wrist"] {
        assert_eq!(later.next().unwrap()["sensor"], name);
    }
    later.send_line("{\"get\":\"last\"}");
    while let Some(line) = later.next() {
        assert_ne!(line["sensor"], "elbow", "{line}");
        if line["type"] == "ok" {
            break;
        }
    }
    let text = get(&daemon.address("http").to_string(), "/metrics");
    assert!(
        text.contains("sensor=\"palm\"") && !text.contains("elbow"),
        "{text}"
    );

    // A sensor comes back, and is a new one.
    configure(&bench, &["elbow", "palm", "wrist"], "");
    reload(&mut daemon, "reloaded");
    subscriber.until(&json!({"type": "press", "sensor": "elbow", "press": 1, "state": "begin"}));
    drop(plays);

    // A recording has the sensors that there were, and can be replayed.
    daemon.process.signal(Signal::TERM);
    assert_eq!(daemon.process.exit_code(), Some(0));
    let files = || recordings_in(&bench.path("records"), "hardnessd-");
    wait_for("three recordings", || files().len() == 3);
    for (file, expected) in files().iter().zip([
        ["elbow", "wrist"].as_slice(),
        &["palm", "wrist"],
        &["elbow", "palm", "wrist"],
    ]) {
        let replayed = hardnessd(&["replay", file.to_str().unwrap()]);
        assert!(replayed.status.success(), "{replayed:?}");
        let replayed = events(&String::from_utf8(replayed.stdout).unwrap());
        let mut found: Vec<&str> = replayed
            .iter()
            .map(|event| event["sensor"].as_str().unwrap())
            .collect();
        found.sort_unstable();
        found.dedup();
        assert_eq!(found, expected, "{}", file.display());
    }
}

#[test]
fn a_changed_key_of_a_sensor_is_refused_beside_an_added_one() {
    let bench = Bench::new();
    let mut daemon = Daemon::start(&configure(&bench, &["wrist"], ""));
    let path = configure(&bench, &["wrist", "palm"], "");
    let text = fs::read_to_string(&path).unwrap();
    fs::write(
        &path,
        text.replacen("frame_rate_hz = 20.0", "frame_rate_hz = 30.0", 1),
    )
    .unwrap();
    let line = reload(&mut daemon, "refused");
    assert!(line.contains("sensor.frame_rate_hz of \"wrist\""), "{line}");
    assert_eq!(names(&bench.subscriber().next().unwrap()), ["wrist"]);
}
