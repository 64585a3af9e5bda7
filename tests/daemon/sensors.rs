//! Several sensors: a reload that changes one of them, and a port that they share.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::thread;
use std::time::Duration;

use serde_json::{Value, json};

use crate::bench::{Bench, events, sensor, wait_for};

/// The number of frames of a sensor, by a connection of its own: this begins with the statuses.
fn frames(bench: &Bench, sensor: &str) -> Option<u64> {
    bench.subscriber().status(sensor)["frames"].as_u64()
}

#[test]
fn a_sensor_whose_table_changed_begins_anew_and_its_numbers_go_on() {
    let bench = Bench::new();
    let _plays = ["wrist", "palm"].map(|name| bench.sensor_at(name, 20, ""));
    let record = "[record]\ndir = \"rec\"\nkeep_free_mb = 0\n";
    let tables = |fps, other| sensor("wrist", "wrist", fps) + &sensor(other, "palm", 20);
    let mut daemon = bench.daemon_of(&tables(20, "palm"), record);
    let mut subscriber = bench.subscriber();
    let mut press = |state: Option<&str>| {
        let mut wanted = json!({"type": "press", "sensor": "wrist"});
        if let Some(state) = state {
            wanted["state"] = state.into();
        }
        subscriber.until(&wanted)
    };
    let begun = press(Some("begin"));
    let before = [frames(&bench, "wrist"), frames(&bench, "palm")];
    bench.configure(&tables(19, "palm"), record);
    daemon.reload("reloaded");
    let stops = daemon
        .log
        .seen
        .iter()
        .filter(|line| line.contains("stopped"));
    let stops: Vec<_> = stops.collect();
    assert!(stops.len() == 1 && stops[0].contains("wrist"), "{stops:?}");
    let end = press(None);
    assert_eq!(
        (&end["press"], &end["reason"]),
        (&begun["press"], &json!("shutdown"))
    );
    // The changed sensor takes a tare again, and counts on.
    let next = press(Some("begin"));
    let number = |event: &Value| event["press"].as_u64().unwrap();
    assert_eq!(number(&next), number(&begun) + 1);
    assert!(next["frame"].as_u64() > begun["frame"].as_u64(), "{next}");
    assert!(frames(&bench, "wrist") > before[0] && frames(&bench, "palm") > before[1]);

    // The sensors themselves stay the same.
    bench.configure(&tables(19, "elbow"), record);
    let line = daemon.reload("refused");
    assert!(line.contains("sensor.name has changed"), "{line}");

    // One recording has it all, and a replay gives the same presses.
    subscriber.until(&json!({"type": "hardness", "sensor": "wrist", "press": next["press"]}));
    daemon.end();
    let files = bench.recordings("hardnessd-");
    assert_eq!(files.len(), 1, "{files:?}");
    let replayed = events(&bench.succeeds(&format!("replay {}", files[0])));
    for live in [&begun, &end, &next] {
        let keys = ["type", "sensor", "press", "state", "frame", "time"];
        let same = |event: &Value| keys.iter().all(|key| event[*key] == live[*key]);
        assert!(replayed.iter().any(same), "{live} in the replay");
    }
}

/// Modules at one port. Each answers its number with four taxels that read its number. The module `mute` is silent.
fn modules(mute: Arc<AtomicU8>) -> u16 {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let port = listener.local_addr().unwrap().port();
    thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let mut asked = [0];
        while stream.read_exact(&mut asked).is_ok() {
            if asked[0] != mute.load(Ordering::Relaxed) {
                let answer = [&[0xAA, 0x55, asked[0]][..], &asked.repeat(4)].concat();
                stream.write_all(&answer).unwrap();
            }
        }
    });
    port
}

/// `tests/peers/boards.py` has the areas of a real hand.
#[test]
fn seventeen_modules_share_a_port_and_a_silent_one_makes_no_other_stale() {
    let bench = Bench::new();
    let mute = Arc::new(AtomicU8::new(0));
    let port = format!("tcp://127.0.0.1:{}", modules(mute.clone()));
    let modules = 1..=17_u8;
    let tables = modules.clone().map(|number| {
        let keys = format!(
            "stale_after_ms = 1000\n[sensor.frame]\npreset = \"none\"\nsync = \"AA 55 {number:02X}\"\n\
             rows = 2\ncols = 2\nrequest = \"{number:02X}\"\n\
             [sensor.calibration]\ntare_frames = 0\nnewtons_per_count = 1.0\n"
        );
        sensor(&format!("m{number}"), &port, 50) + &keys
    });
    let _daemon = bench.daemon_of(&tables.collect::<String>(), "");
    let mut subscriber = bench.subscriber();
    subscriber.ask(r#"{"subscribe":["frame","status"]}"#);
    // Each sensor has the frames of its own module.
    for number in modules.clone() {
        let frame = subscriber.until(&json!({"type": "frame", "sensor": format!("m{number}")}));
        assert_eq!(
            frame["newtons"],
            json!(vec![f64::from(number); 4]),
            "{frame}"
        );
    }
    let mut others = bench.subscriber();
    for number in modules {
        let name = format!("m{number}");
        // A busy machine may miss some.
        wait_for("50 frames/s", || {
            others.status(&name)["frame_rate_hz"].as_f64() > Some(40.0)
        });
    }
    mute.store(3, Ordering::Relaxed);
    others.until(&json!({"type": "status", "sensor": "m3", "state": "stale"}));
    thread::sleep(Duration::from_secs(2));
    mute.store(0, Ordering::Relaxed);
    // Nothing else was stale in between.
    loop {
        let line = others.until(&json!({"type": "status"}));
        assert_eq!(line["sensor"], "m3", "{line}");
        if line["state"] == "live" {
            break;
        }
    }
}
