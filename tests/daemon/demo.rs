//! The first minute of a user: `demo` on a terminal, and commands that find a daemon and a
//! configuration by themselves.

use std::fs;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::{Command, Stdio};

use crate::bench::{Bench, Process, TCP, Terminal, ran, sensor};
use rustix::process::Signal;
use serde_json::Value;

/// The program for a user whose directories are all that of the bench.
fn program(bench: &Bench, line: &str) -> Command {
    let mut command = bench.command(line);
    command.env("XDG_RUNTIME_DIR", bench.path(""));
    command.env("TMPDIR", bench.path(""));
    command.env_remove("RUNTIME_DIRECTORY");
    command
}

/// Whether two verdicts have their force and a level in common. Frames that are late may add a level, or take one
/// away.
fn are_alike(shown: &str, came: &str) -> bool {
    let [shown, came]: [Vec<&str>; 2] =
        [shown, came].map(|line| line.split([' ', ',', '?']).collect());
    let unit = shown.iter().position(|&word| word == "N").unwrap();
    let levels = ["hard", "firm", "soft", "very-soft"];
    let is_common = |level: &&str| shown.contains(level) && came.contains(level);
    came.contains(&shown[unit - 1]) && levels.iter().any(is_common)
}

#[test]
fn on_a_terminal_each_press_is_a_line_as_the_readme_shows() {
    let readme = fs::read_to_string("README.md").unwrap();
    let shown: Vec<_> = readme
        .lines()
        .filter_map(|line| line.split_once(" -> "))
        .collect();
    assert!(readme.contains("\nhardnessd demo ") && shown.len() == 4);
    let is_as_shown = || {
        let mut terminal = Terminal::start("demo");
        let is_alike = shown.iter().all(|(pressed, verdict)| {
            terminal.sees(&format!("{pressed} -> "));
            are_alike(verdict, &terminal.sees("\n"))
        });
        // Ctrl-C ends it, and the count comes nevertheless.
        terminal.process.signal(Signal::INT);
        let rest = terminal.ends();
        assert!(rest.contains(" right, "), "{rest}");
        is_alike
    };
    // A busy machine delays the frames of a try.
    assert!((0..3).any(|_| is_as_shown()), "{shown:?}");
}

/// One status from `tail`, with its exit code and its stderr.
fn tail(bench: &Bench, arguments: &str) -> (i32, Value, String) {
    let line = format!("tail --json --types status --count 1 {arguments}");
    let (code, stdout, stderr) = ran(&mut program(bench, &line));
    let event: Value = serde_json::from_str(&stdout).unwrap_or_default();
    (code, event["sensor"].clone(), stderr)
}

#[test]
fn a_running_demo_is_found_and_a_daemon_goes_before_it() {
    let bench = Bench::new();
    let (code, _, message) = tail(&bench, "");
    let helps = message.contains("hardnessd demo") && message.contains("--socket");
    assert!(code == 69 && helps, "{code}: {message}");
    let mut demo = program(&bench, "demo --json");
    // Its presses are none of the user's sensors.
    demo.env("HOME", bench.path(""))
        .env_remove("XDG_STATE_HOME");
    let mut demo = Process::start(demo.stdout(Stdio::null()).stderr(Stdio::piped()));
    let printed = BufReader::new(demo.0.stderr.take().unwrap()).lines();
    let printed: Vec<String> = printed.take(2).map(Result::unwrap).collect();
    assert!(printed[0].starts_with("live page: http://"), "{printed:?}");
    let socket = printed[1].strip_prefix("socket: ").unwrap();
    let socket = socket.split(' ').next().unwrap();
    let place = Path::new(socket).parent().unwrap();
    assert_eq!(fs::metadata(place).unwrap().mode() & 0o777, 0o700);
    let found =
        |socket: &str, sensor: &str| (0, sensor.into(), format!("hardnessd: events of {socket}\n"));
    assert_eq!(tail(&bench, ""), found(socket, "demo"));

    let own = bench.text_path("hardnessd/events.sock");
    let sockets = format!("[publish.unix]\npath = \"{own}\"\n{TCP}");
    bench.write("hardnessd.toml", sensor("forearm", "port", 20) + &sockets);
    let daemon = bench.daemon_as_configured();
    assert_eq!(tail(&bench, ""), found(&own, "forearm"));
    // A socket that is named is used without a message.
    let named = tail(&bench, &format!("--socket {socket}"));
    assert_eq!(named, (0, "demo".into(), String::new()));
    let (_, sensor, _) = tail(&bench, &format!("--connect {}", daemon.address("tcp")));
    assert_eq!(sensor, "forearm");
    demo.ends_at(Signal::TERM, 0);
    assert!(!Path::new(socket).exists() && !bench.path(".local").exists());
}

#[test]
fn a_configuration_is_looked_for_where_none_is_named() {
    let bench = Bench::new();
    if !Path::new("/etc/hardnessd.toml").exists() {
        bench.fails("check", 66, &["--config"]);
    }
    bench.write("hardnessd.toml", sensor("forearm", "port", 5));
    let (code, _, message) = bench.run("check");
    let expected = "hardnessd: configuration ./hardnessd.toml\n";
    assert_eq!((code, message.as_str()), (0, expected));
}
