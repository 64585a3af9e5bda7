//! The ways out of the real binary: TCP, the control socket, bad and many subscribers, many
//! sensors. The heavy ones are ignored here and run by `.ci/peers`.
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

mod bench;

use std::fs;
use std::os::unix::fs::PermissionsExt;

use bench::{Bench, Daemon, Subscriber};
use serde_json::{Value, json};

#[test]
fn tcp_speaks_the_same_protocol_and_changes_nothing() {
    let bench = Bench::new();
    let tcp = "[publish.tcp]\nlisten = \"127.0.0.1:0\"\n";
    let mut daemon = Daemon::start(&bench.configure("hardnessd.toml", "events.sock", tcp));
    let mut over_tcp = Subscriber::over_tcp(daemon.address("tcp"));
    let mut over_unix = bench.subscriber();
    let [hello, also] = [&mut over_tcp, &mut over_unix].map(|subscriber| {
        let mut hello = subscriber.next().unwrap();
        // Another status may have come between the two.
        hello["seq"].take();
        hello
    });
    assert_eq!(hello, also);
    for subscriber in [&mut over_tcp, &mut over_unix] {
        let answer = subscriber.ask(r#"{"subscribe":["press","hardness"],"id":1}"#);
        assert_eq!(answer, json!({"type": "ok", "id": 1}));
        for command in [
            r#"{"tare":"forearm"}"#,
            r#"{"context":{"sensor":"forearm"}}"#,
            r#"{"blackbox":"forearm"}"#,
        ] {
            let answer = subscriber.ask(command);
            let message = answer["message"].as_str().unwrap();
            assert!(message.contains("control socket"), "{message}");
        }
    }
    let _sensor = bench.sensor(&["--presses", "1"]);
    for _ in ["begin", "end", "final"] {
        assert_eq!(over_tcp.next(), over_unix.next());
    }
}

#[test]
fn the_control_socket_tares_and_gives_presses_their_context() {
    let bench = Bench::new();
    let mut daemon = bench.daemon();
    let path = bench.path("control.sock");
    assert_eq!(
        fs::metadata(&path).unwrap().permissions().mode() & 0o777,
        0o600
    );
    let mut control = Subscriber::connect(&path);
    let refused = |answer: &Value, part: &str| {
        let message = answer["message"].as_str().unwrap();
        assert!(message.contains(part), "{message}");
    };
    assert_eq!(control.next().unwrap()["type"], "hello");
    refused(&control.ask(r#"{"tare":"forearm"}"#), "not live");
    refused(&control.ask(r#"{"tare":"wrist"}"#), "forearm");
    refused(&control.ask(r#"{"blackbox":"forearm"}"#), "recorder");

    let context = json!({"sensor": "forearm", "tag": "pick-17", "speed_mm_s": 5.0});
    let command = json!({"context": context, "id": "c"}).to_string();
    assert_eq!(control.ask(&command), json!({"type": "ok", "id": "c"}));
    let _sensor = bench.sensor(&[]);
    let mut subscriber = bench.subscriber();
    let begin = subscriber.until(&json!({"type": "press", "state": "begin"}));
    assert_eq!(begin["context"], context);
    // At 20 frames/s it is not over before this comes.
    refused(&control.ask(r#"{"tare":"forearm"}"#), "found a press");
    let verdict = subscriber.until(&json!({"phase": "final"}));
    assert_eq!(verdict["context"], context);

    // Between presses there is time for five frames, if not always at once.
    let tared = loop {
        subscriber.until(&json!({"phase": "final"}));
        let answer = control.ask(r#"{"tare":"forearm","id":2}"#);
        if answer["type"] == "ok" {
            break answer;
        }
        refused(&answer, "tare: found");
    };
    assert_eq!(
        (&tared["id"], &tared["tare"]["sensor"]),
        (&json!(2), &json!("forearm"))
    );
    for offsets in ["old", "new"] {
        let offsets = &tared["tare"][offsets];
        let counts = |key: &str| offsets[key].as_f64().unwrap();
        assert!(counts("least_counts") <= counts("mean_counts"));
        assert!(counts("mean_counts") <= counts("most_counts"));
    }
    let line = daemon.logged("new_mean_counts=");
    assert!(line.contains("sensor=\"forearm\"") && line.contains("old_mean_counts="));
    assert_eq!(
        control.ask(r#"{"context":{"sensor":"forearm"}}"#)["type"],
        "ok"
    );
    let begin = subscriber.until(&json!({"type": "press", "state": "begin"}));
    assert_eq!(begin["context"], Value::Null);
}
