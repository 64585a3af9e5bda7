//! The real binary on a real pty: readiness, verdicts, signals, bad input.
//!
//! The limits of time are those of `docs/protocol.md`, measured with the daemon's own stamps where
//! it has them. A busy machine may delay a process beyond a limit. So an action with a limit is
//! tried three times, and must keep the limit once.

use std::fs;
use std::io::Read;
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixDatagram, UnixListener};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::bench::{BINARY, Bench, Daemon, PATIENCE, Process, Subscriber, fails, hardnessd, run};
use rustix::process::Signal;
use serde_json::{Value, json};

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
    for field in ["sensor=", "press=1", "level=", "confidence=", "model="] {
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
    // A press under way ends with the limit that it began with.
    subscriber.until(&json!({"phase": "final", "rejected": "low_force"}));
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
    subscriber.until(&json!({"phase": "final", "rejected": null}));
    let line = daemon.logged("\"phase\":\"final\"");
    let line: Value = serde_json::from_str(&line).unwrap();
    assert_eq!(line["level"], "INFO");
    assert_eq!(line["fields"]["sensor"], "forearm");
    assert!(line["fields"]["level"].is_u64(), "{line}");
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
    fails(&arguments, 74, &["events.sock", "serves"]);
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
fn each_line_for_journald_begins_with_its_priority() {
    let bench = Bench::new();
    let journald = "[log]\nformat = \"journald\"\n";
    let mut daemon = bench.daemon_with(journald);
    let mut control = Subscriber::connect(&bench.path("control.sock"));
    // The sensor is absent, so the tare is refused.
    assert_eq!(control.ask(r#"{"tare":"forearm"}"#)["type"], "error");
    daemon.end();
    let log = daemon.whole_log();
    let begins = |line: &str| {
        ["<4>", "<6>"]
            .iter()
            .any(|priority| line.starts_with(priority))
    };
    assert!(log.lines().all(begins), "{log}");
    for expected in ["<6>started ", "<4>tare refused sensor=\"forearm\" reason="] {
        assert!(log.contains(expected), "{log}");
    }
}

#[test]
fn bad_input_ends_with_its_exit_code_and_one_line() {
    let bench = Bench::new();
    let written = |more: &str| {
        let path = bench.configure("bad.toml", "bad.sock", more);
        path.to_str().unwrap().to_owned()
    };
    let directory = bench.path("");
    let directory = directory.to_str().unwrap();
    let refused = |more: &str, code: i32, parts: &[&str]| {
        fails(&["run", "--config", &written(more)], code, parts);
    };
    refused(
        "[press]\nend_framse = 2\n",
        78,
        &["bad.toml", "end_framse", "end_frames"],
    );
    refused(
        "[model]\npath = \"none.onnx\"\n",
        78,
        &["none.onnx", "model.path"],
    );
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let http = format!("[http]\nlisten = \"{address}\"\n");
    refused(&http, 74, &["http.listen", &address, "in use"]);
    // 20 frames/s of 790 bytes need more than 115,200 baud. An adapter that is not there follows its
    // baud rate. A port of which nothing is known may be a pty.
    let config = written("");
    assert_eq!(run(&["check", "--config", &config]).0, 0);
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, text.replace("\"port\"", "\"/dev/ttyUSB99\"")).unwrap();
    let label = ["--label", "note=\u{202e}7"];
    let record = [&["record", "--config", "x.toml", "--out", "x"][..], &label].concat();
    for (arguments, code, parts) in [
        (
            &["check", "--config", &config][..],
            78,
            &["line 5: sensor.frame_rate_hz of", "14.58"][..],
        ),
        (
            &["run", "--config", "/no/such.toml"],
            66,
            &["/no/such.toml"],
        ),
        (
            &["check", "--config", directory],
            66,
            &["cannot read: Is a directory"],
        ),
        (&["replay", "/no/such.bin"], 66, &["/no/such.bin"]),
        (
            &["simulate", "--fps", "20", "--baud", "115200"],
            2,
            &["--baud", "158000"],
        ),
        (
            &["run", "x.toml"],
            2,
            &["unexpected argument 'x.toml'", "tip: --config x.toml"],
        ),
        (&["simulate", "--force", "1000"], 2, &["--force"]),
        (&["demo", "--speed", "0.0001"], 2, &["--speed"]),
        (&record, 2, &["--label", "found \"\\u{202e}7\""]),
    ] {
        fails(arguments, code, parts);
    }
    let (code, _, help) = run(&[]);
    assert_eq!(code, 2, "{help}");
    assert!(help.contains("Usage: hardnessd <COMMAND>"), "{help}");
    assert_eq!(run(&["--version"]).0, 0);
}

#[test]
fn check_refuses_what_run_would_refuse() {
    let bench = Bench::new();
    fs::write(bench.path("file"), "").unwrap();
    fs::create_dir(bench.path("directory")).unwrap();
    for (socket, more, key, found) in [
        ("directory", "", "path", "no socket"),
        ("file/events.sock", "", "path", "in no directory"),
        (
            "events.sock",
            "control_group = \"no such\"\n",
            "control_group",
            "found \"no such\", expected a group",
        ),
    ] {
        let config = bench.configure("bad.toml", socket, more);
        let key = format!("publish.unix.{key}: ");
        for command in ["check", "run"] {
            let arguments = [command, "--config", config.to_str().unwrap()];
            fails(&arguments, 78, &[&key, found]);
        }
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
fn a_signal_ends_every_command_that_waits_for_a_file() {
    let bench = Bench::new();
    let fifo = bench.fifo("fifo");
    let fifo = fifo.to_str().unwrap();
    let new = bench.path("new.mcap");
    let new = new.to_str().unwrap();
    let model = bench.configure("model.toml", "x.sock", "[model]\npath = \"fifo\"\n");
    let unfinished = "hardnessd: interrupted before it had finished\n";
    for (arguments, code, printed) in [
        (&["run", "--config", model.to_str().unwrap()][..], 0, ""),
        (&["record", "--config", fifo, "--out", new], 0, ""),
        (&["simulate", "--faults", fifo], 0, ""),
        (&["check", "--config", fifo], 143, unfinished),
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
