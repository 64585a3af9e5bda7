//! The messages of the commands around the daemon.

use std::fs;
use std::process::Command;

use crate::bench::{BINARY, Bench, events, fails, on_a_terminal, run};
use serde_json::{Value, json};

#[test]
fn without_memory_a_command_ends_and_prints_no_backtrace() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    for kib in (44_000..=60_000).step_by(2_000) {
        let mut command = Command::new("sh");
        let line = format!("ulimit -v {kib} && exec \"$0\" check --config \"$1\"");
        command.args(["-c", &line, BINARY, config.to_str().unwrap()]);
        let output = command.output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(!stderr.contains("panicked at"), "{kib} KiB: {stderr}");
    }
}

#[test]
fn check_warns_of_what_the_model_or_the_film_does_not_know() {
    let bench = Bench::new();
    let config = bench.path("odd.toml");
    let models = concat!(env!("CARGO_MANIFEST_DIR"), "/models");
    let calibration = |key: &str| format!("[sensor.calibration]\n{key}\n");
    let hrn = format!("[sensor.arm]\nspeed_mm_s = 5.0\n[model]\npath = \"{models}/hrn.onnx\"\n");
    for (tables, expected) in [
        (
            calibration("pitch_mm = [3.5, 9.0]"),
            "found [3.5, 9.0], expected the model's 3.5",
        ),
        (
            calibration("newtons_per_count = 0.001"),
            "255 counts are 0.255 N on a taxel",
        ),
        (
            calibration("newtons_per_count = 40.0"),
            "255 counts are 10200.000 N on a taxel",
        ),
        (hrn, "sensor.arm of \"sensor\": changes no verdict"),
    ] {
        fs::write(&config, format!("[[sensor]]\nport = \"port\"\n{tables}")).unwrap();
        let (code, _, message) = run(&["check", "--config", config.to_str().unwrap()]);
        assert_eq!(code, 0, "{message}");
        assert!(message.contains(expected), "{message}");
    }
    let usual = format!("[[sensor]]\nport = \"port\"\n[model]\npath = \"{models}/course.onnx\"\n");
    fs::write(&config, usual).unwrap();
    let (_, printed, message) = run(&["check", "--config", config.to_str().unwrap()]);
    let needs = "judges whole presses, best with the arm's positions";
    assert!(printed.contains(needs), "{printed}");
    for warning in ["on a taxel", "expected the model's", "changes no verdict"] {
        assert!(!message.contains(warning), "{message}");
    }
}

#[test]
fn the_control_socket_has_commands_of_its_own() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    let socket = bench.path("control.sock");
    let socket = ["--socket", socket.to_str().unwrap()];
    let blackbox = [&["blackbox", "forearm"][..], &socket].concat();
    fails(&blackbox, 1, &["[record]"]);
    let control = |arguments: &[&str]| run(&[arguments, &socket].concat());
    let (code, printed, _) = control(&["context", "forearm", "object=7", "level=firm"]);
    assert_eq!((code, printed.as_str()), (0, "done\n"));
    let _sensor = bench.sensor(&[]);
    let mut subscriber = bench.subscriber();
    let begun = subscriber.until(&json!({"type": "press", "state": "begin"}));
    let context = json!({"sensor": "forearm", "object": "7", "level": 2});
    assert_eq!(begun["context"], context);
    subscriber.until(&json!({"phase": "final"}));
    let (code, tared, message) = control(&["tare", "forearm"]);
    assert!(
        code == 0 && tared.starts_with("tared: the mean offset was 0.00"),
        "{message}"
    );
}

#[test]
fn a_model_of_the_command_line_judges_in_place_of_the_others() {
    let hrn = concat!(env!("CARGO_MANIFEST_DIR"), "/models/hrn.onnx");
    let fixture = concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/foam.5hz.bin");
    for (command, usual) in [
        (&["replay", fixture][..], json!("none")),
        (
            &["demo", "--presses", "1", "--speed", "4"],
            json!("positions"),
        ),
    ] {
        // The paper's network judges no course.
        let models = [(&[][..], usual), (&["--model", hrn], Value::Null)];
        for (model, course) in models {
            let (_, stdout, stderr) = run(&[command, model].concat());
            let mut events = events(&stdout).into_iter();
            let found = events.find(|event| event["phase"] == "final");
            assert_eq!(found.expect(&stderr)["course"], course);
        }
    }
    fails(&["demo", "--model", "no.onnx"], 66, &["no.onnx"]);
    let replay = ["replay", fixture, "--model", fixture];
    fails(&replay, 78, &["foam.5hz.bin"]);
}

#[test]
fn replay_prints_readable_lines_on_a_terminal_and_json_if_asked() {
    let fixture = concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/foam.5hz.bin");
    let shown = |more: &[&str]| {
        let mut command = Command::new(BINARY);
        command.args(["replay", fixture]).args(more);
        let (shown, code) = on_a_terminal(command, None);
        assert_eq!(code, Some(0), "{shown}");
        shown
    };
    let lines = shown(&[]);
    assert!(lines.contains("press     #1    begin"), "{lines}");
    assert!(shown(&["--json"]).starts_with("{\"type\":\"status\""));
}
