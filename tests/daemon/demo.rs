//! The first minute of a user: `demo` on a terminal, and commands that find a daemon and a
//! configuration by themselves.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Output, Stdio};

use crate::bench::{BINARY, Bench, Daemon, Process, on_a_terminal};
use rustix::process::Signal;
use serde_json::Value;

/// The program, with `runtime` as the user's runtime directory.
fn program(runtime: &Path) -> Command {
    let mut command = Command::new(BINARY);
    command.env("XDG_RUNTIME_DIR", runtime);
    command.env("TMPDIR", runtime);
    command.env("HOME", runtime);
    command.env_remove("XDG_STATE_HOME");
    command.env_remove("RUNTIME_DIRECTORY");
    command
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8(bytes.to_vec()).unwrap()
}

#[test]
fn on_a_terminal_each_press_is_a_line_with_the_truth_beside_the_verdict() {
    let bench = Bench::new();
    let mut command = program(&bench.path(""));
    command.args(["demo", "--speed", "4"]);
    // Ctrl-C ends it, and the count comes nevertheless.
    let (shown, code) = on_a_terminal(command, Some("press 4 "));
    assert_eq!(code, Some(0), "{shown}");
    let lines: Vec<&str> = shown.lines().collect();
    assert_eq!(lines.len(), 5, "{shown}");
    let pressed = ["hard-plastic ", "foam ", "soft-candy ", "yoga-mat "];
    for (number, (line, pressed)) in (1..).zip(lines.iter().zip(pressed)) {
        let begin = format!("press {number}  {pressed}");
        assert!(
            line.starts_with(&begin) && line.contains(" OO -> ") && line.contains(" N"),
            "{line}"
        );
    }
    assert!(lines[4].contains(" of 4 presses right"), "{shown}");
    // Its presses are none of the user's sensors.
    assert!(!bench.path(".local").exists());
}

/// One status from `tail`, with its exit code and its stderr.
fn tail(runtime: &Path, arguments: &[&str]) -> (Option<i32>, Value, String) {
    let mut command = program(runtime);
    command.args(["tail", "--json", "--types", "status", "--count", "1"]);
    let Output {
        status,
        stdout,
        stderr,
    } = command.args(arguments).output().unwrap();
    let event = serde_json::from_slice(&stdout).unwrap_or_default();
    (status.code(), event, text(&stderr))
}

#[test]
fn a_running_demo_is_found_and_a_daemon_goes_before_it() {
    let bench = Bench::new();
    let runtime = bench.path("");
    let (code, _, message) = tail(&runtime, &[]);
    assert_eq!(code, Some(69));
    assert!(
        message.contains("hardnessd demo") && message.contains("--socket"),
        "{message}"
    );
    let mut demo = program(&runtime);
    demo.args(["demo", "--json"])
        .stdout(Stdio::null())
        .stderr(Stdio::piped());
    let mut demo = Process(demo.spawn().unwrap());
    let mut printed = BufReader::new(demo.0.stderr.take().unwrap()).lines();
    assert!(
        printed
            .next()
            .unwrap()
            .unwrap()
            .starts_with("live page: http://")
    );
    let socket = printed.next().unwrap().unwrap();
    let socket = socket.strip_prefix("socket: ").unwrap();
    let socket = socket.split(' ').next().unwrap();
    let (code, event, message) = tail(&runtime, &[]);
    assert_eq!(
        (code, &event["sensor"]),
        (Some(0), &"demo".into()),
        "{message}"
    );
    assert_eq!(message, format!("hardnessd: events of {socket}\n"));
    let own = runtime.join("hardnessd/events.sock");
    let config = bench.configure(
        "own.toml",
        own.to_str().unwrap(),
        "[publish.tcp]\nlisten = \"127.0.0.1:0\"\n",
    );
    let mut daemon = Daemon::start(&config);
    let (code, event, message) = tail(&runtime, &[]);
    assert_eq!(
        (code, &event["sensor"]),
        (Some(0), &"forearm".into()),
        "{message}"
    );
    assert_eq!(message, format!("hardnessd: events of {}\n", own.display()));
    // A socket that is named is used without a message.
    let (_, event, message) = tail(&runtime, &["--socket", socket]);
    assert_eq!((&event["sensor"], message.as_str()), (&"demo".into(), ""));
    let address = daemon.address("tcp").to_string();
    let (code, event, message) = tail(&runtime, &["--connect", &address]);
    assert_eq!(
        (code, &event["sensor"]),
        (Some(0), &"forearm".into()),
        "{message}"
    );
    demo.signal(Signal::TERM);
    assert_eq!(demo.exit_code(), Some(0));
    assert!(!Path::new(socket).exists());
}

#[test]
fn a_configuration_is_looked_for_where_none_is_named() {
    let bench = Bench::new();
    let here = bench.path("");
    let check = || {
        let mut command = program(&here);
        let Output {
            status,
            stdout,
            stderr,
        } = command.arg("check").current_dir(&here).output().unwrap();
        (status.code(), text(&stdout), text(&stderr))
    };
    if !Path::new("/etc/hardnessd.toml").exists() {
        let (code, _, message) = check();
        assert_eq!(code, Some(66));
        assert!(
            message.contains("--config") && message.lines().count() == 1,
            "{message}"
        );
    }
    let config = "robot = \"here\"\n[[sensor]]\nport = \"port\"\n";
    fs::write(here.join("hardnessd.toml"), config).unwrap();
    let (code, printed, message) = check();
    assert_eq!(code, Some(0), "{message}");
    assert_eq!(message, "hardnessd: configuration ./hardnessd.toml\n");
    assert!(printed.starts_with("robot here\n"), "{printed}");
}
