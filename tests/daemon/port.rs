//! `sniff` and `doctor` in use: the real binary, with recordings and ptys of the simulator.

use std::fs;
use std::process::Command;

use crate::bench::{BINARY, Bench, run};
use rustix::process::Signal;
use serde_json::json;

fn recorded(bench: &Bench, preset: &str) -> String {
    let name = format!("{preset}.bin");
    let path = bench.path(&name).to_str().unwrap().to_owned();
    let played = ["--presses", "4", "--fps", "20", "--seed", "5"];
    let arguments = [
        &["simulate", "--to", &path, "--preset", preset],
        &played[..],
    ];
    let (code, _, stderr) = run(&arguments.concat());
    assert_eq!(code, 0, "{stderr}");
    path
}

/// Runs `check` on a configuration with the proposal.
fn checked(bench: &Bench, proposal: &str) -> String {
    let text = format!("[[sensor]]\nname = \"forearm\"\nport = \"/dev/ttyACM0\"\n{proposal}");
    let path = bench.path("proposed.toml");
    fs::write(&path, text).unwrap();
    let (code, stdout, stderr) = run(&["check", "--config", path.to_str().unwrap()]);
    assert_eq!(code, 0, "{stderr}\n{proposal}");
    stdout
}

#[test]
fn a_recording_of_an_unknown_layout_is_named_and_the_proposal_runs() {
    let bench = Bench::new();
    for preset in ["jx255n", "jq-u16", "csv"] {
        let recording = recorded(&bench, preset);
        let (code, toml, stderr) = run(&["sniff", &recording]);
        assert_eq!(code, 0, "{preset}: {stderr}");
        assert!(toml.contains("[sensor.frame]"), "{toml}");
        // Without a checksum, a header and a tail look the same in the middle of a stream.
        let named = format!("preset = \"{preset}\"");
        let is_named = toml.contains(&named) || preset.starts_with("jq");
        assert!(is_named, "{preset} is not named in\n{toml}");
        // A capture decodes with the proposed layout.
        let config = bench.path("proposed.toml");
        checked(&bench, &toml);
        let (code, events, stderr) =
            run(&["replay", &recording, "--config", config.to_str().unwrap()]);
        assert_eq!(code, 0, "{stderr}");
        let presses = events.matches("\"state\":\"begin\"").count();
        assert_eq!(presses, 4, "{preset}: {toml}");
    }
}

#[test]
fn sniff_says_why_it_has_no_proposal() {
    let bench = Bench::new();
    let check = |arguments: &[&str], code: i32, part: &str| {
        let (found, stdout, stderr) = run(&[&["sniff"], arguments].concat());
        assert_eq!(found, code, "{arguments:?}: {stderr}");
        assert!(stderr.contains(part) && stdout.is_empty(), "{stderr}");
        assert_eq!(stderr.lines().count(), 1, "{stderr}");
    };
    check(&["/no/such.bin"], 66, "/no/such.bin");
    // A port in place of a file would be read for ever.
    let _sensor = bench.sensor(&[]);
    let port = bench.path("port").display().to_string();
    let new = bench.path("new.mcap").display().to_string();
    for command in [&["sniff"][..], &["replay"], &["recover", "--out", &new]] {
        let (code, _, stderr) = run(&[command, &[port.as_str()]].concat());
        assert_eq!(code, 66, "{stderr}");
        assert!(
            stderr.contains("found a serial port or a terminal"),
            "{stderr}"
        );
    }
    check(&["/etc/passwd"], 1, "text, but no array");
    check(
        &["--port", "/dev/no-such"],
        69,
        "/dev/no-such: no such device",
    );
    check(&["x.bin", "--port", "y"], 2, "cannot be used with");
}

#[test]
fn doctor_names_what_is_missing_and_who_holds_a_port() {
    let bench = Bench::new();
    let (code, stdout, _) = run(&["doctor", "--port", "/dev/no-such"]);
    assert_eq!(code, 1);
    assert!(
        stdout.starts_with("/dev/no-such: no such device"),
        "{stdout}"
    );

    // The port's name cannot split the line, nor send codes to the terminal.
    let (_, stdout, _) = run(&["doctor", "--port", "/dev/no\nsuch\u{1b}[2J"]);
    assert!(stdout.starts_with("/dev/no\\nsuch\\u{1b}[2J: "), "{stdout}");
    assert_eq!(stdout.lines().count(), 1, "{stdout}");

    // One line says that this is not a port, whatever else is reported.
    for port in ["/dev/null", "/tmp", "Cargo.toml"] {
        let (code, stdout, _) = run(&["doctor", "--port", port]);
        assert_eq!(code, 1, "{stdout}");
        assert_eq!(stdout.lines().count(), 1, "{stdout}");
        assert!(stdout.contains("not a serial port"), "{stdout}");
    }

    let _sensor = bench.sensor(&[]);
    let daemon = bench.daemon();
    bench.subscriber().until(&json!({"state": "live"}));
    let port = bench.path("port").to_str().unwrap().to_owned();
    let (code, stdout, stderr) = run(&["doctor", "--port", &port]);
    assert_eq!(code, 1);
    let holder = format!(
        "held by process {}, the daemon (hardnessd run",
        daemon.process.0.id()
    );
    assert!(stdout.contains(&holder), "{holder:?} not in {stdout}");
    assert!(
        stdout.contains(": sudo systemctl stop hardnessd"),
        "{stdout}"
    );
    assert!(stderr.contains("1 fault found"), "{stderr}");
}

#[test]
fn a_simulated_sensor_ends_at_a_signal_and_takes_its_link_along() {
    let bench = Bench::new();
    for signal in [Signal::INT, Signal::TERM, Signal::HUP] {
        let mut sensor = bench.sensor(&[]);
        let start = std::time::Instant::now();
        sensor.signal(signal);
        assert_eq!(sensor.exit_code(), Some(0), "{signal:?}");
        assert!(start.elapsed().as_secs() < 5, "{signal:?}");
        assert!(
            fs::symlink_metadata(bench.path("port")).is_err(),
            "{signal:?}"
        );
    }
}

#[test]
fn a_simulation_leaves_files_and_links_of_others_alone() {
    let bench = Bench::new();
    let path = bench.path("theirs.bin").to_str().unwrap().to_owned();
    fs::write(&path, "theirs").unwrap();
    let (code, _, error) = run(&["simulate", "--presses", "1", "--to", &path]);
    assert_eq!(code, 74, "{error}");
    assert!(error.contains("File exists"), "{error}");
    assert_eq!(fs::read(&path).unwrap(), b"theirs");

    let _sensor = bench.sensor(&[]);
    let link = bench.path("port");
    let first = fs::read_link(&link).unwrap();
    let (code, _, error) = run(&["simulate", "--link", link.to_str().unwrap()]);
    assert_eq!(code, 74, "{error}");
    assert!(error.contains("another `hardnessd simulate`"), "{error}");
    assert_eq!(fs::read_link(&link).unwrap(), first);

    // Of the links that lead nowhere, only that of a killed simulation is replaced.
    for (target, code) in [("/dev/ttyUSB99", 74), ("/dev/pts/99999", 0)] {
        let link = bench.path(&format!("dead{code}"));
        std::os::unix::fs::symlink(target, &link).unwrap();
        let arguments = ["simulate", "--presses", "1", "--speed", "100", "--link"];
        let simulate = Command::new(BINARY).args(arguments).arg(&link).output();
        let simulate = simulate.unwrap();
        assert_eq!(simulate.status.code(), Some(code), "{target}: {simulate:?}");
        assert_eq!(link.is_symlink(), code == 74, "{target}");
    }
}

#[test]
fn the_user_chooses_between_two_pictures() {
    let bench = Bench::new();
    let path = bench.path("open.bin").to_str().unwrap().to_owned();
    // 12x8 u8. One press on a part of one row shows how long that part is, not how long a row is.
    let frames = (0..60_u8).flat_map(|time| {
        let mut frame = [&[0xAA, 0x55][..], &[0; 96]].concat();
        if time / 20 == 1 {
            frame[42..46].copy_from_slice(&[60, 90, 90, 60].map(|value| value + time));
        }
        frame
    });
    fs::write(&path, frames.collect::<Vec<u8>>()).unwrap();
    let (code, toml, stderr) = run(&["sniff", &path]);
    assert_eq!((code, toml.as_str()), (1, ""), "{stderr}");
    let drawn = stderr.lines().filter(|line| line.trim().starts_with('|'));
    assert!(drawn.clone().any(|line| line.contains('@')), "{stderr}");
    let message = stderr.lines().last().unwrap();
    assert!(
        message.contains("not sure: choose with `--rows "),
        "{stderr}"
    );
    let known = ["--rows", "12", "--cols", "8", "--cell", "u8"];
    let (code, toml, stderr) = run(&[&["sniff", &path], &known[..]].concat());
    assert_eq!(code, 0, "{stderr}");
    assert!(toml.ends_with("rows = 12\ncols = 8\n"), "{toml}");
    // A file that exists is not overwritten.
    let (code, _, _) = run(&[&["sniff", &path, "--out", &path], &known[..]].concat());
    assert_eq!(code, 74);
    let (code, _, stderr) = run(&["sniff", &path, "--rows", "65"]);
    assert_eq!(code, 2, "{stderr}");
    assert!(stderr.contains("expected 1 to 64"), "{stderr}");
}
