//! Several sensors: a reload that changes one of them, and a port that they share.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::Duration;

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

/// The number of frames of a sensor, by a connection of its own: this begins with the statuses.
fn frames(bench: &Bench, sensor: &str) -> u64 {
    let status = bench
        .subscriber()
        .until(&json!({"type": "status", "sensor": sensor}));
    status["frames"].as_u64().unwrap()
}

#[test]
fn a_sensor_whose_table_changed_begins_anew_and_its_numbers_go_on() {
    let bench = Bench::new();
    let _plays = ["wrist", "palm"].map(|name| bench.sensor_at(name, 20, &[]));
    let mut daemon = Daemon::start(&configure(&bench, &["wrist", "palm"], ""));
    let mut subscriber = bench.subscriber();
    let begun = subscriber.until(&json!({"type": "press", "sensor": "wrist", "state": "begin"}));
    let before = [frames(&bench, "wrist"), frames(&bench, "palm")];
    let path = configure(&bench, &["wrist", "palm"], "");
    let text = fs::read_to_string(&path).unwrap();
    let (was, is) = ("frame_rate_hz = 20.0", "frame_rate_hz = 19.0");
    fs::write(&path, text.replacen(was, is, 1)).unwrap();
    reload(&mut daemon, "reloaded");
    let stops = daemon
        .log
        .seen
        .iter()
        .filter(|line| line.contains("stopped"));
    let stops: Vec<_> = stops.collect();
    assert!(stops.len() == 1 && stops[0].contains("wrist"), "{stops:?}");
    let end = subscriber.until(&json!({"type": "press", "sensor": "wrist"}));
    assert_eq!(end["press"], begun["press"]);
    assert_eq!(end["reason"], "shutdown");
    // The changed sensor takes a tare again, and counts on.
    let live = subscriber.until(&json!({"type": "status", "sensor": "wrist", "state": "live"}));
    assert!(live["seq"].as_u64() > end["seq"].as_u64(), "{live}");
    let next = subscriber.until(&json!({"type": "press", "sensor": "wrist", "state": "begin"}));
    assert_eq!(
        next["press"].as_u64(),
        begun["press"].as_u64().map(|press| press + 1)
    );
    assert!(next["frame"].as_u64() > begun["frame"].as_u64(), "{next}");
    assert!(frames(&bench, "wrist") > before[0] && frames(&bench, "palm") > before[1]);

    // The sensors themselves stay the same.
    fs::write(
        &path,
        text.replacen("name = \"palm\"", "name = \"elbow\"", 1),
    )
    .unwrap();
    let line = reload(&mut daemon, "refused");
    assert!(line.contains("sensor.name has changed"), "{line}");

    // One recording has it all, and a replay gives the same presses.
    subscriber.until(&json!({"type": "hardness", "sensor": "wrist", "press": next["press"]}));
    daemon.end();
    let files = recordings_in(&bench.path("records"), "hardnessd-");
    let [file] = &files[..] else {
        panic!("{files:?}");
    };
    let replayed = hardnessd(&["replay", file.to_str().unwrap()]);
    assert!(replayed.status.success(), "{replayed:?}");
    let replayed = events(&String::from_utf8(replayed.stdout).unwrap());
    for live in [&begun, &end, &next] {
        let same = |event: &serde_json::Value| {
            ["type", "sensor", "press", "state", "frame", "time"]
                .iter()
                .all(|key| event[*key] == live[*key])
        };
        assert!(replayed.iter().any(same), "{live} in the replay");
    }
}

/// The areas of a hand: the register at which each begins, and its rows and columns.
fn areas() -> Vec<(u16, usize, usize)> {
    let fingers = (0..5).flat_map(|finger| {
        let first = 3000 + 370 * finger;
        [(first, 3, 3), (first + 18, 12, 8), (first + 210, 10, 8)]
    });
    fingers.chain([(4880, 4, 4), (4900, 14, 8)]).collect()
}

/// A hand on a network that answers Modbus TCP. The area at the register `mute` is silent. All taxels of
/// an area read the number of its register, modulo 97.
fn hand(mute: Arc<AtomicUsize>) -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port();
    thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            let mut request = [0; 12];
            while stream.read_exact(&mut request).is_ok() {
                let first = u16::from_be_bytes([request[8], request[9]]);
                let cells = usize::from(u16::from_be_bytes([request[10], request[11]]));
                if usize::from(first) == mute.load(Ordering::Relaxed) {
                    continue;
                }
                let length = (3 + 2 * cells) as u16;
                // The number of the transaction is repeated.
                let mut answer = vec![request[0], request[1], 0, 0];
                answer.extend(length.to_be_bytes());
                answer.extend([1, 3, (2 * cells) as u8]);
                answer.extend((first % 97).to_be_bytes().repeat(cells));
                stream.write_all(&answer).unwrap();
            }
        }
    });
    port
}

#[test]
fn seventeen_areas_of_a_hand_share_a_port_and_a_silent_one_makes_no_other_stale() {
    let bench = Bench::new();
    let mute = Arc::new(AtomicUsize::new(0));
    let port = hand(mute.clone());
    let hex = |bytes: &[u8]| {
        bytes
            .iter()
            .map(|byte| format!("{byte:02X}"))
            .collect::<String>()
    };
    let mut text =
        "[publish.unix]\npath = \"events.sock\"\n[http]\nlisten = \"127.0.0.1:0\"\n".to_owned();
    for (first, rows, cols) in areas() {
        let bytes = 2 * rows * cols;
        // The register serves as the number of the transaction.
        let [high, low] = first.to_be_bytes();
        let sync = [
            &[high, low, 0, 0][..],
            &((3 + bytes) as u16).to_be_bytes(),
            &[1, 3, bytes as u8],
        ]
        .concat();
        let cells = (rows * cols) as u8;
        let request = [&[high, low, 0, 0, 0, 6, 1, 3][..], &[high, low, 0, cells]].concat();
        text += &format!(
            "[[sensor]]\nname = \"a{first}\"\nport = \"tcp://127.0.0.1:{port}\"\nframe_rate_hz = 50.0\n\
             stale_after_ms = 1000\n[sensor.frame]\nsync = \"{}\"\ncell = \"u16be\"\nrows = {rows}\n\
             cols = {cols}\nrequest = \"{}\"\n[sensor.calibration]\ntare_frames = 0\n\
             newtons_per_count = 1.0\n",
            hex(&sync),
            hex(&request)
        );
    }
    let path = bench.path("hardnessd.toml");
    fs::write(&path, text).unwrap();
    let mut daemon = Daemon::start(&path);
    let http = daemon.address("http").to_string();
    let statuses = || -> Vec<serde_json::Value> {
        let answer = get(&http, "/api/status");
        let (_, body) = answer.split_once("\r\n\r\n").unwrap();
        let status: serde_json::Value = serde_json::from_str(body).unwrap();
        let sensors = status["sensors"].as_array().unwrap().iter();
        sensors.map(|sensor| sensor["status"].clone()).collect()
    };
    let rate = |status: &serde_json::Value| status["frame_rate_hz"].as_f64().unwrap_or(0.0);
    // A busy machine may miss some.
    wait_for("17 areas at 50 frames/s", || {
        statuses().iter().all(|status| rate(status) > 40.0)
    });
    assert_eq!(statuses().len(), 17);

    // Each sensor has the frames of its own area.
    let mut subscriber = bench.subscriber();
    subscriber.send_line("{\"subscribe\":[\"frame\",\"status\"]}");
    for (first, rows, cols) in areas() {
        let frame = subscriber.until(&json!({"type": "frame", "sensor": format!("a{first}")}));
        let newtons = frame["newtons"].as_array().unwrap();
        let expected = f64::from(first % 97);
        assert_eq!(newtons.len(), rows * cols);
        assert!(
            newtons.iter().all(|n| n.as_f64() == Some(expected)),
            "{first}: {frame}"
        );
    }

    let mut others = bench.subscriber();
    mute.store(3018, Ordering::Relaxed);
    others.until(&json!({"type": "status", "sensor": "a3018", "state": "stale"}));
    thread::sleep(Duration::from_secs(2));
    let live = statuses()
        .iter()
        .filter(|status| status["state"] == "live")
        .count();
    assert_eq!(live, 16, "{:?}", statuses());
    mute.store(0, Ordering::Relaxed);
    // Nothing else was stale in between.
    loop {
        let line = others.next().unwrap();
        if line["type"] == "status" {
            assert_eq!(line["sensor"], "a3018", "{line}");
            if line["state"] == "live" {
                break;
            }
        }
    }
}
