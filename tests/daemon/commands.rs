//! The messages of the commands around the daemon.

use std::process::Command;

use crate::bench::{BINARY, Bench, HRN, Terminal, events, run, sensor};
use serde_json::{Value, json};

const COURSE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/models/course.onnx");
const FOAM: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/foam.5hz.bin");

#[test]
fn without_memory_a_command_ends_and_prints_no_backtrace() {
    let bench = Bench::new();
    bench.configure_forearm("");
    for kib in (44_000..=60_000).step_by(2_000) {
        let mut command = Command::new("sh");
        let line = format!("ulimit -v {kib} && exec \"$0\" check --config hardnessd.toml");
        command.args(["-c", &line, BINARY]);
        let output = command.current_dir(bench.path("")).output().unwrap();
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(!stderr.contains("panicked at"), "{kib} KiB: {stderr}");
    }
}

#[test]
fn check_warns_of_what_the_model_or_the_film_does_not_know() {
    let bench = Bench::new();
    let checked = |tables: &str| {
        bench.write("odd.toml", sensor("palm", "port", 5) + tables);
        let (code, printed, message) = bench.run("check --config odd.toml");
        assert_eq!(code, 0, "{message}");
        (printed, message)
    };
    let odd = "
        calibration.pitch_mm = [3.5, 9.0] | found [3.5, 9.0], expected the model's 3.5
        calibration.newtons_per_count = 0.001 | 255 counts are 0.255 N on a taxel
        calibration.newtons_per_count = 40.0 | 255 counts are 10200.000 N on a taxel
        frame.sync = 'A5' | sensor.calibration of \"palm\": pitch_mm and newtons_per_count not written";
    for odd in odd.trim().lines() {
        let (key, expected) = odd.trim().split_once(" | ").unwrap();
        let (_, message) = checked(key);
        assert!(message.contains(expected), "{message}");
    }
    let hrn = format!("arm.speed_mm_s = 5.0\n[model]\npath = \"{HRN}\"\n");
    let (_, message) = checked(&hrn);
    let expected = "sensor.arm of \"palm\": changes no verdict";
    assert!(message.contains(expected), "{message}");
    let (printed, message) = checked(&format!("[model]\npath = \"{COURSE}\"\n"));
    let needs = "judges whole presses, best with the arm's positions";
    assert!(printed.contains(needs), "{printed}");
    assert_eq!(message, "");
}

#[test]
fn the_control_socket_has_commands_of_its_own() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    bench.fails("blackbox forearm --socket control.sock", 1, &["[record]"]);
    let context = "context forearm object=7 level=firm --socket control.sock";
    assert_eq!(bench.succeeds(context), "done\n");
    let _sensor = bench.sensor("");
    let mut subscriber = bench.subscriber();
    let context = json!({"sensor": "forearm", "object": "7", "level": 2});
    assert_eq!(subscriber.press("begin")["context"], context);
}

#[test]
fn a_model_of_the_command_line_judges_in_place_of_the_others() {
    let (model, replay) = (format!("--model {HRN}"), format!("replay {FOAM}"));
    for (command, usual) in [
        (replay.as_str(), "none"),
        ("demo --presses 1 --speed 4", "positions"),
    ] {
        // The paper's network judges no course.
        for (model, course) in [("", json!(usual)), (&model, Value::Null)] {
            let (_, stdout, stderr) = run(&format!("{command} {model}"));
            let mut events = events(&stdout).into_iter();
            let found = events.find(|event| event["phase"] == "final");
            assert_eq!(found.expect(&stderr)["course"], course);
        }
    }
    let bench = Bench::new();
    bench.fails("demo --model no.onnx", 66, &["no.onnx"]);
    let replay = format!("replay {FOAM} --model {FOAM}");
    bench.fails(&replay, 78, &["foam.5hz.bin"]);
}

#[test]
fn replay_prints_readable_lines_on_a_terminal_and_json_if_asked() {
    let lines = Terminal::start(&format!("replay {FOAM}")).ends();
    assert!(lines.contains("press     #1    begin"), "{lines}");
    let json = Terminal::start(&format!("replay --json {FOAM}")).ends();
    assert!(json.contains("{\"type\":\"status\""), "{json}");
}
