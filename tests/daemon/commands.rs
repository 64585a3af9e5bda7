//! The messages of the commands around the daemon.

use std::fs;
use std::os::unix::fs::symlink;
use std::process::{Command, Output, Stdio};

use crate::bench::{BINARY, Bench, Process, events, hardnessd, on_a_terminal};
use rustix::process::Signal;
use serde_json::{Value, json};

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

#[test]
fn a_recording_without_a_press_is_warned_of() {
    let bench = Bench::new();
    // The sensor's first press comes after 2 s.
    let _sensor = bench.sensor(&["--speed", "0.1"]);
    let config = bench.configure("record.toml", "x.sock", "");
    let out = bench.path("rest.mcap");
    let record = |more: &[&str]| {
        let mut command = Command::new(BINARY);
        command.args(["record", "--config"]).arg(&config);
        command.arg("--out").arg(&out).args(more).output().unwrap()
    };
    let Output { status, stderr, .. } = record(&["--seconds", "1.5"]);
    let message = text(&stderr);
    assert_eq!(status.code(), Some(0), "{message}");
    let warning = message.lines().find(|line| line.starts_with("warning: "));
    assert!(
        warning.is_some_and(|line| line.contains("no press in ")),
        "{message}"
    );
    assert!(out.exists());
}

#[test]
fn whoever_holds_the_port_is_named_and_what_to_do() {
    let bench = Bench::new();
    let _sensor = bench.sensor(&[]);
    let mut daemon = bench.daemon();
    daemon.logged("live");
    let config = bench.configure("record.toml", "x.sock", "");
    let out = bench.path("held.mcap");
    let mut command = Command::new(BINARY);
    command
        .args(["record", "--config"])
        .arg(&config)
        .arg("--out")
        .arg(&out);
    let Output { status, stderr, .. } = command.output().unwrap();
    let message = text(&stderr);
    assert_eq!(status.code(), Some(69), "{message}");
    let message = message
        .lines()
        .find(|line| line.starts_with("hardnessd: "))
        .unwrap();
    let process = format!("held by process {}, the daemon", daemon.process.0.id());
    assert!(
        message.contains(&process)
            && message.contains("(hardnessd run; its scheduling is ordinary")
            && message.contains("systemctl stop hardnessd"),
        "{message}"
    );
    assert!(!out.exists());
}

#[test]
fn check_warns_of_a_pitch_that_the_model_does_not_know() {
    let bench = Bench::new();
    let config = bench.path("coarse.toml");
    let small = "[[sensor]]\nport = \"port\"\n[sensor.calibration]\npitch_mm = [3.5, 9.0]\n";
    fs::write(&config, small).unwrap();
    let Output { status, stderr, .. } = hardnessd(&["check", "--config", config.to_str().unwrap()]);
    let message = text(&stderr);
    assert_eq!(status.code(), Some(0), "{message}");
    assert!(
        message.contains("found [3.5, 9.0], expected the model's 3.5")
            && message.contains("was not trained on such a pitch"),
        "{message}"
    );
    assert!(message.contains("not trained"), "{message}");
}

#[test]
fn check_names_what_the_model_needs_and_what_changes_no_verdict_of_it() {
    let bench = Bench::new();
    let config = bench.path("arm.toml");
    let models = concat!(env!("CARGO_MANIFEST_DIR"), "/models");
    for (model, needs, ignored) in [
        ("hrn.onnx", "judges single frames, needs no arm", true),
        (
            "course.onnx",
            "judges whole presses, best with the arm's positions",
            false,
        ),
    ] {
        let sensor = "[[sensor]]\nport = \"port\"\n[sensor.arm]\nspeed_mm_s = 5.0\n";
        let model = format!("[model]\npath = \"{models}/{model}\"\n");
        fs::write(&config, format!("{sensor}{model}")).unwrap();
        let output = hardnessd(&["check", "--config", config.to_str().unwrap()]);
        assert!(text(&output.stdout).contains(needs), "{output:?}");
        let message = text(&output.stderr);
        let warned = message.contains("sensor.arm of \"sensor\": changes no verdict");
        assert_eq!(warned, ignored, "{message}");
    }
}

#[test]
fn sniff_writes_a_configuration_that_check_takes() {
    let bench = Bench::new();
    let _sensor = bench.sensor(&[]);
    let config = bench.path("sniffed.toml");
    let port = bench.path("port");
    let arguments = ["sniff", "--seconds", "4", "--port", port.to_str().unwrap()];
    let sniff = || {
        let mut command = Command::new(BINARY);
        command
            .args(arguments)
            .arg("--out")
            .arg(&config)
            .output()
            .unwrap()
    };
    let Output {
        status,
        stdout,
        stderr,
    } = sniff();
    let message = text(&stderr);
    assert_eq!(status.code(), Some(0), "{message}");
    assert!(message.contains("press the sensor"), "{message}");
    assert_eq!(text(&stdout), "");
    let written = fs::read_to_string(&config).unwrap();
    let end = "[sensor.frame]\npreset = \"jx255n\"\n\n# [http]\n# listen = \"127.0.0.1:8256\"  # a live page for \
               your browser\n";
    assert!(written.ends_with(end), "{written}");
    let Output {
        status,
        stdout,
        stderr,
    } = hardnessd(&["check", "--config", config.to_str().unwrap()]);
    assert_eq!(status.code(), Some(0), "{}{written}", text(&stderr));
    assert!(
        text(&stdout).contains("28x28 taxels in 790 bytes"),
        "{written}"
    );
    // With this limit, the file fails as on a full disk, and the next try finds its path free.
    fs::remove_file(&config).unwrap();
    let mut full = Command::new("sh");
    full.args(["-c", "ulimit -f 0; exec \"$@\"", "sh", BINARY]);
    full.args(arguments).arg("--out").arg(&config);
    let full = full.output().unwrap();
    assert_eq!(full.status.code(), Some(74), "{}", text(&full.stderr));
    assert!(!config.exists());
    fs::write(&config, &written).unwrap();
    // The file now exists, and must not be overwritten.
    let Output { status, stderr, .. } = sniff();
    assert_eq!(status.code(), Some(74), "{}", text(&stderr));
    assert_eq!(fs::read_to_string(&config).unwrap(), written);
}

#[test]
fn recover_follows_no_link() {
    let bench = Bench::new();
    let (out, target) = (bench.path("good.mcap"), bench.path("nowhere"));
    symlink(&target, &out).unwrap();
    fs::write(bench.path("broken.mcap"), "x").unwrap();
    let mut command = Command::new(BINARY);
    command
        .arg("recover")
        .arg(bench.path("broken.mcap"))
        .arg("--out")
        .arg(&out);
    let Output { status, stderr, .. } = command.output().unwrap();
    assert_eq!(status.code(), Some(74), "{}", text(&stderr));
    assert!(
        text(&stderr).contains("name another one"),
        "{}",
        text(&stderr)
    );
    assert!(!target.exists() && out.is_symlink());
}

#[test]
fn sniff_at_a_port_that_is_interrupted_has_not_finished() {
    let bench = Bench::new();
    let _sensor = bench.sensor(&[]);
    for (signal, code) in [(Signal::INT, 130), (Signal::TERM, 143)] {
        let mut command = Command::new(BINARY);
        command.args(["sniff", "--port"]).arg(bench.path("port"));
        command.stdout(Stdio::null()).stderr(Stdio::null());
        let mut sniff = Process(command.spawn().unwrap());
        std::thread::sleep(std::time::Duration::from_millis(300));
        sniff.signal(signal);
        assert_eq!(sniff.exit_code(), Some(code));
    }
}

#[test]
fn the_control_socket_has_commands_of_its_own() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    let socket = bench.path("control.sock");
    let control = |arguments: &[&str]| {
        let mut command = Command::new(BINARY);
        command.args(arguments).arg("--socket").arg(&socket);
        let Output {
            status,
            stdout,
            stderr,
        } = command.output().unwrap();
        (status.code().unwrap(), text(&stdout), text(&stderr))
    };
    let (code, _, message) = control(&["tare", "forearm"]);
    assert_eq!((code, message.lines().count()), (1, 1), "{message}");
    assert!(message.contains("not live"), "{message}");

    let sets = ["context", "forearm", "tag=pick-17", "speed_mm_s=5.5"];
    assert_eq!(control(&sets), (0, "done\n".to_owned(), String::new()));
    let _sensor = bench.sensor(&[]);
    let mut subscriber = bench.subscriber();
    let begun = subscriber.until(&json!({"type": "press", "state": "begin"}));
    assert_eq!(
        begun["context"],
        json!({"sensor": "forearm", "tag": "pick-17", "speed_mm_s": 5.5})
    );
    assert_eq!(control(&["context", "forearm"]).0, 0);
    let judged = subscriber.until(&json!({"phase": "final"}));
    assert_eq!(judged["context"], Value::Null);
    let (code, tared, message) = control(&["tare", "forearm"]);
    assert!(
        code == 0 && tared.starts_with("tared: the mean offset was 0.00"),
        "{message}"
    );
    let (code, _, message) = control(&["blackbox", "forearm"]);
    assert!(code == 1 && message.contains("[record]"), "{message}");
}

#[test]
fn a_model_of_the_command_line_judges_in_place_of_the_others() {
    let hrn = concat!(env!("CARGO_MANIFEST_DIR"), "/models/hrn.onnx");
    let fixture = concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/foam.5hz.bin");
    let verdict = |arguments: &[&str]| {
        let Output { stdout, stderr, .. } = hardnessd(arguments);
        let mut events = events(&text(&stdout)).into_iter();
        let found = events.find(|event| event["phase"] == "final");
        found.unwrap_or_else(|| panic!("{}", text(&stderr)))
    };
    assert_eq!(verdict(&["replay", fixture])["course"], "none");
    assert_eq!(
        verdict(&["replay", fixture, "--model", hrn])["course"],
        Value::Null
    );
    let demo = ["demo", "--presses", "1", "--speed", "4"];
    assert_eq!(verdict(&demo)["course"], "positions");
    let demo = [&demo[..], &["--model", hrn]].concat();
    assert_eq!(verdict(&demo)["course"], Value::Null);
    for command in [&["demo"][..], &["replay", fixture], &["run"]] {
        let Output { status, stderr, .. } = hardnessd(&[command, &["--model", "no.onnx"]].concat());
        assert_eq!(status.code(), Some(66), "{}", text(&stderr));
    }
    let Output { status, stderr, .. } = hardnessd(&["replay", fixture, "--model", fixture]);
    assert_eq!(status.code(), Some(78), "{}", text(&stderr));
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
