//! The real binary on a real pty: readiness, verdicts, signals, bad input.
//!
//! The limits of time are those of `docs/protocol.md`, measured with the daemon's own stamps where
//! it has them. A busy machine may delay a process beyond a limit. So an action with a limit is
//! tried three times, and must keep the limit once.

use std::fs;
use std::io::{Read, Write};
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixDatagram, UnixListener};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::bench::{BINARY, Bench, Daemon, PATIENCE, Process, Subscriber, hardnessd};
use rustix::process::Signal;
use serde_json::{Value, json};

/// The binary must fail with this exit code and one line that has all these parts.
fn fails(arguments: &[&str], code: i32, parts: &[&str]) {
    let output = hardnessd(arguments);
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {stderr}");
    assert_eq!(stderr.lines().count(), 1, "{stderr}");
    for part in parts {
        assert!(stderr.contains(part), "{part:?} not in {stderr:?}");
    }
}

#[test]
fn a_press_on_the_port_becomes_a_verdict_on_the_socket() {
    let bench = Bench::new();
    let mut daemon = bench.daemon();
    let mut subscriber = bench.subscriber();
    let hello = subscriber.next().unwrap();
    assert_eq!(hello["type"], "hello");
    assert_eq!(hello["protocol"], 1);
    assert_eq!(hello["robot"], "arm-7");
    assert_eq!(hello["sensors"][0]["name"], "forearm");
    assert_eq!(hello["model"]["levels"].as_array().unwrap().len(), 4);
    let status = subscriber.next().unwrap();
    assert_eq!(
        (&status["state"], &status["seq"]),
        (&json!("connecting"), &Value::Null)
    );

    let _sensor = bench.sensor(&["--presses", "1"]);
    let begin = subscriber.until(&json!({"type": "press", "state": "begin"}));
    let end = subscriber.until(&json!({"type": "press", "state": "end"}));
    let verdict = subscriber.next().unwrap();
    assert_eq!(verdict["type"], "hardness");
    assert_eq!(verdict["phase"], "final");
    assert_eq!((&begin["press"], &verdict["press"]), (&json!(1), &json!(1)));
    assert_eq!(
        verdict["seq"].as_u64().unwrap(),
        end["seq"].as_u64().unwrap() + 1
    );
    assert_eq!(verdict["state"], "live");
    assert!(verdict["mono_ns"].as_u64().unwrap() > 0);
    assert!(verdict["latency_us"].as_u64().unwrap() < 1_000_000);
    // The chosen frame is older than the release that ended the press.
    assert!(verdict["age_at_publish_ms"].as_f64().unwrap() > 50.0);
    let line = daemon.logged("phase=\"final\"");
    for field in [
        "sensor=",
        "press=1",
        "level=",
        "label=",
        "confidence=",
        "force_n=",
        "model=",
    ] {
        assert!(line.contains(field), "{field} not in {line}");
    }
    subscriber.send_line(r#"{"get":"last","id":1}"#);
    assert_eq!(subscriber.until(&json!({"phase": "final"})), verdict);
    subscriber.until(&json!({"type": "ok", "id": 1}));
}

#[test]
fn sigterm_aborts_the_press_in_hand_and_ends_within_a_second() {
    let bench = Bench::new();
    let _sensor = bench.sensor(&[]);
    let mut shortest = PATIENCE;
    for signal in [Signal::TERM, Signal::INT, Signal::TERM] {
        let mut daemon = bench.daemon();
        let mut subscriber = bench.subscriber();
        // A subscriber that never reads must not delay the end of the daemon.
        let _deaf = bench.subscriber();
        subscriber.until(&json!({"type": "press", "state": "begin"}));
        let start = Instant::now();
        daemon.process.signal(signal);
        let aborted = subscriber.until(&json!({"type": "press", "state": "aborted"}));
        assert_eq!(aborted["reason"], "shutdown");
        while subscriber.next().is_some() {}
        assert_eq!(daemon.process.exit_code(), Some(0));
        shortest = shortest.min(start.elapsed());
        assert!(
            !bench.path("events.sock").exists(),
            "the socket's file stayed behind"
        );
    }
    assert!(shortest < Duration::from_secs(1), "took {shortest:?}");
}

#[test]
fn sighup_changes_all_or_nothing() {
    let bench = Bench::new();
    let mut daemon = bench.daemon();
    let _sensor = bench.sensor(&[]);
    let mut subscriber = bench.subscriber();
    let reload = |daemon: &mut Daemon, more: &str, answer: &str| {
        bench.configure("hardnessd.toml", "events.sock", more);
        daemon.process.signal(Signal::HUP);
        daemon.logged(answer)
    };
    let rejected = |subscriber: &mut Subscriber| {
        subscriber.until(&json!({"phase": "final"}))["rejected"].clone()
    };
    assert_eq!(rejected(&mut subscriber), Value::Null);
    let low = "[model]\nmin_force_n = 900.0\n";
    reload(&mut daemon, low, "reloaded");
    subscriber.until(&json!({"state": "begin"}));
    assert_eq!(rejected(&mut subscriber), "low_force");
    // Neither of these files may take effect, not even in part.
    let line = reload(&mut daemon, "[model]\nmin_force = 0.0\n", "refused");
    assert!(
        line.contains("min_force") && line.contains("ERROR"),
        "{line}"
    );
    let line = reload(
        &mut daemon,
        "max_clients = 7\n[model]\nmin_force_n = 0.0\n",
        "refused",
    );
    assert!(line.contains("publish.unix.max_clients"), "{line}");
    subscriber.until(&json!({"state": "begin"}));
    assert_eq!(rejected(&mut subscriber), "low_force");
    reload(&mut daemon, "[log]\nformat = \"json\"\n", "reloaded");
    subscriber.until(&json!({"state": "begin"}));
    assert_eq!(rejected(&mut subscriber), Value::Null);
    let line = daemon.logged("\"phase\":\"final\"");
    let line: Value = serde_json::from_str(&line).unwrap();
    assert_eq!(line["level"], "INFO");
    assert_eq!(line["fields"]["sensor"], "forearm");
    assert!(line["fields"]["level"].is_u64(), "{line}");
}

#[test]
fn a_reload_from_what_does_not_end_is_given_up_and_the_next_one_works() {
    let bench = Bench::new();
    let mut daemon = bench.daemon();
    let config = bench.path("hardnessd.toml");
    fs::remove_file(&config).unwrap();
    bench.fifo("hardnessd.toml");
    daemon.process.signal(Signal::HUP);
    let line = daemon.logged("refused");
    for part in [
        "ERROR",
        "hardnessd.toml: cannot read: it did not end in time",
    ] {
        assert!(line.contains(part), "{part} not in {line}");
    }
    // No thread waits for the pipe any more.
    let tasks = format!("/proc/{}/task", daemon.process.0.id());
    let is_reader = |task: fs::DirEntry| {
        let name = fs::read_to_string(task.path().join("comm"));
        name.is_ok_and(|name| name == "reload\n")
    };
    let refused = Instant::now();
    while fs::read_dir(&tasks)
        .unwrap()
        .map(Result::unwrap)
        .any(is_reader)
    {
        assert!(
            refused.elapsed() < Duration::from_secs(5),
            "a thread is left behind"
        );
        std::thread::sleep(Duration::from_millis(10));
    }
    fs::remove_file(&config).unwrap();
    bench.configure("hardnessd.toml", "events.sock", "");
    daemon.process.signal(Signal::HUP);
    daemon.logged("reloaded");
    let start = Instant::now();
    daemon.process.signal(Signal::TERM);
    assert_eq!(daemon.process.exit_code(), Some(0));
    assert!(start.elapsed() < Duration::from_secs(5));
}

#[test]
fn a_socket_whose_file_was_deleted_is_there_again() {
    let bench = Bench::new();
    let mut daemon = bench.daemon();
    let mut before = bench.subscriber();
    for (name, mode) in [("events.sock", 0o660), ("control.sock", 0o600)] {
        let path = bench.path(name);
        fs::remove_file(&path).unwrap();
        let line = daemon.logged("made it again");
        assert!(line.contains("WARN") && line.contains(name), "{line}");
        let mut after = Subscriber::connect(&path);
        assert_eq!(after.next().unwrap()["type"], "hello");
        let made = fs::metadata(&path).unwrap().permissions().mode();
        assert_eq!(made & 0o777, mode, "{name}");
    }
    // An earlier connection stays open.
    assert_eq!(before.ask(r#"{"get":"last"}"#), json!({"type": "ok"}));
    daemon.process.signal(Signal::TERM);
    assert_eq!(daemon.process.exit_code(), Some(0));
    assert!(!bench.path("events.sock").exists());
}

#[test]
fn a_line_that_repeats_without_end_is_left_out_and_counted() {
    const TARES: u64 = 5000;
    let bench = Bench::new();
    let mut daemon = bench.daemon();
    let mut control = Subscriber::connect(&bench.path("control.sock"));
    for _ in 0..TARES {
        // The sensor is absent, so the tare is refused.
        assert_eq!(control.ask(r#"{"tare":"forearm"}"#)["type"], "error");
    }
    daemon.process.signal(Signal::TERM);
    assert_eq!(daemon.process.exit_code(), Some(0));
    let log = daemon.whole_log();
    let printed = |part: &str| log.lines().filter(|line| line.contains(part)).count() as u64;
    let left_out: u64 = log
        .lines()
        .filter_map(|line| line.split_once("left_out=")?.1.split(' ').next())
        .map(|count| count.parse::<u64>().unwrap())
        .sum();
    // A line with `left_out` also contains the text of the line that it counts.
    let written = printed("tare refused") - printed("left_out=");
    assert_eq!(written + left_out, TARES, "{written} written");
    assert!(written < TARES / 10, "{written} written");
    assert!(
        log.contains("of=\"tare refused\" sensor=\"forearm\""),
        "{log}"
    );
}

#[test]
fn a_stale_socket_is_replaced_and_a_live_one_is_not_stolen() {
    let bench = Bench::new();
    let socket = bench.path("events.sock");
    drop(UnixListener::bind(&socket).unwrap());
    let _daemon = bench.daemon();
    assert_eq!(
        fs::metadata(&socket).unwrap().permissions().mode() & 0o777,
        0o660
    );
    let config = bench.path("hardnessd.toml");
    let arguments = ["run", "--config", config.to_str().unwrap()];
    fails(&arguments, 74, &["events.sock", "in use"]);
    assert_eq!(bench.subscriber().next().unwrap()["type"], "hello");

    let file = bench.path("precious");
    fs::write(&file, "kept").unwrap();
    let config = bench.configure("other.toml", "precious", "");
    fails(
        &["run", "--config", config.to_str().unwrap()],
        78,
        &["precious", "no socket"],
    );
    assert_eq!(fs::read_to_string(file).unwrap(), "kept");
}

#[test]
fn a_port_held_by_another_process_is_named_as_such_and_logged_once() {
    let bench = Bench::new();
    let _sensor = bench.sensor(&[]);
    let _holder = bench.daemon();
    bench.subscriber().until(&json!({"state": "live"}));
    let mut second = Daemon::start(&bench.configure(
        "second.toml",
        "second.sock",
        "control_path = \"second-control.sock\"\n",
    ));
    let mut subscriber = Subscriber::connect(&bench.path("second.sock"));
    let held = json!({"state": "connecting", "reason": "port held by another process"});
    subscriber.until(&held);
    // The daemon has tried several times by then, and must have logged nothing more.
    std::thread::sleep(Duration::from_millis(700));
    second.process.signal(Signal::TERM);
    second.logged("stopping");
    let lines = second
        .log
        .seen
        .iter()
        .filter(|line| line.contains("held by another"))
        .count();
    assert_eq!(lines, 1, "{:#?}", second.log.seen);
}

#[test]
fn a_subscriber_beyond_the_configured_most_is_refused_and_an_id_may_be_an_object() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "max_clients = 1\n");
    let _daemon = Daemon::start(&config);
    let mut first = bench.subscriber();
    let answer = first.ask(r#"{"get":"last","id":{"mine":1}}"#);
    assert_eq!(answer, json!({"type": "ok", "id": {"mine": 1}}));
    let mut second = bench.subscriber();
    assert_eq!(second.next().unwrap()["type"], "error");
    assert_eq!(second.next(), None, "closed");
}

#[test]
fn the_service_manager_hears_of_readiness_life_and_stopping_without_any_hardware() {
    let bench = Bench::new();
    let manager = UnixDatagram::bind(bench.path("notify")).unwrap();
    manager.set_read_timeout(Some(PATIENCE)).unwrap();
    let notified = |state: &str| {
        let mut message = [0; 1024];
        loop {
            let length = manager.recv(&mut message).unwrap();
            let message = String::from_utf8_lossy(&message[..length]);
            if message.lines().any(|line| line == state) {
                return;
            }
        }
    };
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let mut command = Command::new(BINARY);
    command
        .args(["run", "--config"])
        .arg(config)
        .stderr(Stdio::null());
    command
        .env("NOTIFY_SOCKET", bench.path("notify"))
        .env("WATCHDOG_USEC", "200000");
    let mut daemon = Process(command.spawn().unwrap());
    notified("READY=1");
    assert_eq!(bench.subscriber().next().unwrap()["type"], "hello");
    for _ in 0..3 {
        notified("WATCHDOG=1");
    }
    daemon.signal(Signal::TERM);
    notified("STOPPING=1");
    assert_eq!(daemon.exit_code(), Some(0));
}

#[test]
fn a_log_that_nobody_reads_delays_nobody() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let mut daemon = Process(
        Command::new(BINARY)
            .args(["run", "--config"])
            .arg(config)
            .env("RUST_LOG", "debug")
            .stderr(Stdio::piped())
            .spawn()
            .unwrap(),
    );
    // Each connection logs a line of 80 bytes: far more in all than a pipe holds and the daemon
    // keeps.
    for _ in 0..4_000 {
        assert_eq!(bench.subscriber().next().unwrap()["type"], "hello");
    }
    daemon.signal(Signal::TERM);
    assert_eq!(daemon.exit_code(), Some(0));
}

#[test]
fn bad_input_ends_with_its_exit_code_and_one_line() {
    let bench = Bench::new();
    let written = |more: &str| {
        let path = bench.configure("bad.toml", "bad.sock", more);
        path.to_str().unwrap().to_owned()
    };
    fails(
        &["run", "--config", "/no/such.toml"],
        66,
        &["/no/such.toml"],
    );
    let directory = bench.path("");
    for command in [&["check", "--config"][..], &["replay"]] {
        let arguments = [command, &[directory.to_str().unwrap()]].concat();
        fails(&arguments, 66, &["cannot read: Is a directory"]);
    }
    let config = written("[press]\nend_framse = 2\n");
    fails(
        &["run", "--config", &config],
        78,
        &["bad.toml", "end_framse", "end_frames"],
    );
    let config = written("[model]\npath = \"none.onnx\"\n");
    fails(
        &["run", "--config", &config],
        78,
        &["none.onnx", "model.path"],
    );
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap();
    let config = written(&format!("[http]\nlisten = \"{address}\"\n"));
    fails(
        &["run", "--config", &config],
        74,
        &["http.listen", &address.to_string(), "in use"],
    );
    // 20 frames/s of 790 bytes need more than 115,200 baud. An adapter that is not there follows its
    // baud rate. A port of which nothing is known may be a pty: that is a warning.
    let config = written("");
    let checked = hardnessd(&["check", "--config", &config]);
    let warning = String::from_utf8(checked.stderr).unwrap();
    assert_eq!(checked.status.code(), Some(0), "{warning}");
    assert!(warning.contains("14.58 over 115200 baud"), "{warning}");
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, text.replace("\"port\"", "\"/dev/ttyUSB99\"")).unwrap();
    fails(
        &["check", "--config", &config],
        78,
        &["frame_rate_hz", "14.58"],
    );
    fails(&["replay", "/no/such.bin"], 66, &["/no/such.bin"]);
    fails(&["replay"], 2, &["not provided", "<FILE>"]);
    fails(
        &["simulate", "--material", "steel"],
        2,
        &["steel", "--material", "wood"],
    );
    for tool in [&["sniff", "/"][..], &["recover", "/", "--out", "x.mcap"]] {
        fails(tool, 66, &["/: cannot read", "directory"]);
    }
    fails(
        &["simulate", "--fps", "20", "--baud", "115200"],
        2,
        &["--baud", "158000"],
    );
    let helped = hardnessd(&[]);
    let help = String::from_utf8(helped.stderr).unwrap();
    assert_eq!(helped.status.code(), Some(2), "{help}");
    assert!(
        help.contains("Usage: hardnessd <COMMAND>") && help.contains("replay"),
        "{help}"
    );
    fails(&["run", "x.toml"], 2, &["unexpected argument 'x.toml'"]);
    fails(&["frobnicate"], 2, &["'frobnicate'"]);
    fails(&["replya"], 2, &["'replya'", "'replay'"]);
    for beyond_any_sensor in [
        ["simulate", "--force", "1000"],
        ["simulate", "--fps", "1e9"],
        ["simulate", "--fps", "nan"],
        ["simulate", "--speed", "1e-300"],
        ["simulate", "--presses", "0"],
        ["demo", "--speed", "0.0001"],
        ["demo", "--speed", "300000"],
    ] {
        fails(&beyond_any_sensor, 2, &[beyond_any_sensor[1]]);
    }
    let record = [
        "record",
        "--config",
        "x.toml",
        "--out",
        "x",
        "--label",
        "note=\u{202e}7",
    ];
    fails(&record, 2, &["--label", "found \"\\u{202e}7\""]);
    assert_eq!(hardnessd(&["--version"]).status.code(), Some(0));
}

#[test]
fn help_that_cannot_be_written_is_an_io_error() {
    for asked in ["--help", "--version"] {
        let output = Command::new(BINARY)
            .arg(asked)
            .stdout(fs::File::create("/dev/full").unwrap())
            .output()
            .unwrap();
        assert_eq!(output.status.code(), Some(74), "{asked}");
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert!(stderr.contains("stdout: No space left"), "{stderr}");
    }
}

#[test]
fn check_refuses_what_run_would_refuse() {
    let bench = Bench::new();
    fs::write(bench.path("file"), "").unwrap();
    fs::create_dir(bench.path("directory")).unwrap();
    let long = format!("{}.sock", "x".repeat(110));
    for (socket, more, key, found) in [
        (long.as_str(), "", "path", "expected a path of at most 107"),
        ("directory", "", "path", "no socket"),
        ("file", "", "path", "no socket"),
        ("none/none/events.sock", "", "path", "in no directory"),
        ("file/events.sock", "", "path", "in no directory"),
        (
            "events.sock",
            "control_path = \"directory\"\n",
            "control_path",
            "directory is no socket: remove it, or set another path",
        ),
    ] {
        let config = bench.configure("bad.toml", socket, more);
        let key = format!("publish.unix.{key}: ");
        for command in ["check", "run"] {
            let arguments = [command, "--config", config.to_str().unwrap()];
            fails(&arguments, 78, &[&key, found]);
        }
    }
    let journal = "[log]\nformat = \"journald\"\n";
    let config = bench.configure("bad.toml", "events.sock", journal);
    if !Path::new("/run/systemd/journal/socket").exists() {
        for command in ["check", "run"] {
            let arguments = [command, "--config", config.to_str().unwrap()];
            fails(
                &arguments,
                78,
                &["log.format: there is no journal", "set \"text\""],
            );
        }
    }
    // The daemon runs without its disk and logs it. `check` tells the user beforehand.
    for dir in ["file", "file/rec"] {
        let record = format!("[record]\ndir = \"{dir}\"\n");
        let config = bench.configure("bad.toml", "events.sock", &record);
        let arguments = ["check", "--config", config.to_str().unwrap()];
        fails(
            &arguments,
            78,
            &[
                "bad.toml",
                "record.dir: cannot write to ",
                "Not a directory",
            ],
        );
    }
    assert!(!bench.path("events.sock").exists());
    assert!(!bench.path("none").exists());
}

#[test]
fn check_looks_and_changes_nothing() {
    let bench = Bench::new();
    let more = "[record]\ndir = \"a/b\"\n";
    let config = bench.configure("hardnessd.toml", "new/events.sock", more);
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, text.replace("20.0", "5.0")).unwrap();
    let output = hardnessd(&["check", "--config", config.to_str().unwrap()]);
    assert!(output.status.success(), "{output:?}");
    let left = fs::read_dir(bench.path("")).unwrap().count();
    assert_eq!(left, 1, "nothing but the configuration");
    // `check` also works beside a running daemon.
    let _daemon = Daemon::start(&config);
    let output = hardnessd(&["check", "--config", config.to_str().unwrap()]);
    assert!(output.status.success(), "{output:?}");
}

#[test]
fn a_signal_ends_recover_while_it_waits_for_a_writer() {
    let bench = Bench::new();
    let fifo = bench.fifo("fifo");
    let mut command = Command::new(BINARY);
    command
        .arg("recover")
        .arg(&fifo)
        .arg("--out")
        .arg(bench.path("new.mcap"));
    let mut process = Process(command.stderr(Stdio::piped()).spawn().unwrap());
    // Without a writer, the process waits while it opens the pipe. Signals must be caught by then.
    let status = format!("/proc/{}/status", process.0.id());
    let are_caught = || {
        let text = fs::read_to_string(&status).unwrap();
        let caught = text.lines().find_map(|line| line.strip_prefix("SigCgt:"));
        let bits = u64::from_str_radix(caught.unwrap().trim(), 16).unwrap();
        bits & (1 << (Signal::TERM.as_raw() - 1)) != 0
    };
    let begun = Instant::now();
    while !are_caught() {
        assert!(
            begun.elapsed() < Duration::from_secs(20),
            "no signal is caught"
        );
        std::thread::sleep(Duration::from_millis(5));
    }
    process.signal(Signal::TERM);
    assert_eq!(process.exit_code(), Some(143));
    let mut logged_lines = String::new();
    let mut stderr = process.0.stderr.take().unwrap();
    stderr.read_to_string(&mut logged_lines).unwrap();
    assert_eq!(
        logged_lines,
        "hardnessd: interrupted before it had finished\n"
    );
}

#[test]
fn a_signal_ends_every_command_that_waits_for_a_file() {
    let bench = Bench::new();
    let fifo = bench.fifo("fifo");
    let fifo = fifo.to_str().unwrap();
    let new = bench.path("new.mcap");
    let new = new.to_str().unwrap();
    let model = bench.configure("model.toml", "x.sock", "[model]\npath = \"fifo\"\n");
    let unfinished = "hardnessd: interrupted before it had finished\n";
    for (arguments, code, printed) in [
        (&["run", "--config", fifo][..], 0, ""),
        (&["run", "--config", model.to_str().unwrap()], 0, ""),
        (&["record", "--config", fifo, "--out", new], 0, ""),
        (&["simulate", "--faults", fifo], 0, ""),
        (&["check", "--config", fifo], 143, unfinished),
        (&["replay", fifo], 143, unfinished),
        (&["sniff", fifo], 143, unfinished),
    ] {
        let mut command = Command::new(BINARY);
        command.args(arguments).stderr(Stdio::piped());
        let mut process = Process(command.spawn().unwrap());
        // Opening the pipe for writing succeeds once a process reads.
        let _writer = fs::File::options().write(true).open(fifo).unwrap();
        let start = Instant::now();
        process.signal(Signal::TERM);
        assert_eq!(process.exit_code(), Some(code), "{arguments:?}");
        assert!(start.elapsed() < Duration::from_secs(5), "{arguments:?}");
        let mut logged_lines = String::new();
        let mut stderr = process.0.stderr.take().unwrap();
        stderr.read_to_string(&mut logged_lines).unwrap();
        assert_eq!(logged_lines, printed, "{arguments:?}");
    }
}

#[test]
fn a_configuration_may_be_a_pipe_but_has_an_end() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let text = fs::read_to_string(&config).unwrap();
    let mut command = Command::new(BINARY);
    command.args(["check", "--config", "/dev/stdin"]);
    let piped = command.stdin(Stdio::piped()).stdout(Stdio::piped());
    let mut check = Process(piped.spawn().unwrap());
    let mut stdin = check.0.stdin.take().unwrap();
    let text = text.replace("20.0", "5.0");
    stdin.write_all(text.as_bytes()).unwrap();
    drop(stdin);
    assert_eq!(check.exit_code(), Some(0));
    fails(
        &["check", "--config", "/dev/zero"],
        78,
        &["/dev/zero", "more than 1048576 bytes"],
    );
}

#[test]
fn a_replay_of_any_length_ends_at_a_signal() {
    for (signal, code) in [(Signal::INT, 130), (Signal::TERM, 143)] {
        let mut command = Command::new(BINARY);
        // This file never ends.
        command.args(["replay", "/dev/zero"]).stdout(Stdio::null());
        let mut replay = Process(command.spawn().unwrap());
        std::thread::sleep(Duration::from_millis(300));
        replay.signal(signal);
        assert_eq!(replay.exit_code(), Some(code), "{signal:?}");
    }
}
