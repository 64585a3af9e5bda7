//! The real binary on a real pty: readiness, verdicts, signals, bad input.
//!
//! The limits of time are those of `docs/protocol.md`, measured with the daemon's own stamps where
//! it has them. A busy machine may delay a process beyond a limit. So an action with a limit is
//! tried three times, and must keep the limit once.

use std::fs::{self, File};
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixDatagram, UnixListener};
use std::process::Stdio;
use std::time::{Duration, Instant};

use crate::bench::{Bench, PATIENCE, Process, run, sensor};
use rustix::process::Signal;
use serde_json::{Value, json};

const RUN: &str = "run --config hardnessd.toml";
const CHECK: &str = "check --config hardnessd.toml";

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
    assert_eq!(status["state"], "connecting");
    assert_eq!(status["seq"], Value::Null);

    let _sensor = bench.sensor("--presses 1");
    let begin = subscriber.press("begin");
    let end = subscriber.press("end");
    let verdict = subscriber.next().unwrap();
    assert_eq!(verdict["phase"], "final");
    assert_eq!((&begin["press"], &verdict["press"]), (&json!(1), &json!(1)));
    assert_eq!(
        verdict["seq"].as_u64(),
        end["seq"].as_u64().map(|seq| seq + 1)
    );
    assert_eq!(verdict["state"], "live");
    assert!(verdict["mono_ns"].as_u64() > Some(0));
    assert!(verdict["latency_us"].as_u64() < Some(1_000_000));
    // The chosen frame is older than the release that ended the press.
    assert!(verdict["age_at_publish_ms"].as_f64() > Some(50.0));
    let line = daemon.logged("phase=\"final\"");
    for field in ["sensor=", "press=1", "level=", "confidence=", "model="] {
        assert!(line.contains(field), "{field} not in {line}");
    }
    subscriber.send_line(r#"{"get":"last","id":1}"#);
    assert_eq!(subscriber.verdict(), verdict);
    subscriber.until(&json!({"type": "ok", "id": 1}));
}

#[test]
fn sigterm_aborts_the_press_in_hand_and_ends_within_a_second() {
    let bench = Bench::new();
    let _sensor = bench.sensor("");
    let mut shortest = PATIENCE;
    for signal in [Signal::TERM, Signal::INT, Signal::TERM] {
        let mut daemon = bench.daemon();
        let mut subscriber = bench.subscriber();
        // A subscriber that never reads must not delay the end of the daemon.
        let _deaf = bench.subscriber();
        subscriber.press("begin");
        let start = Instant::now();
        daemon.process.signal(signal);
        assert_eq!(subscriber.press("aborted")["reason"], "shutdown");
        while subscriber.next().is_some() {}
        assert_eq!(daemon.process.exit_code(), Some(0));
        shortest = shortest.min(start.elapsed());
        assert!(!bench.path("events.sock").exists(), "the file stays behind");
    }
    assert!(shortest < Duration::from_secs(1), "took {shortest:?}");
}

#[test]
fn sighup_changes_all_or_nothing() {
    let bench = Bench::new();
    let mut daemon = bench.daemon();
    let _sensor = bench.sensor("");
    let mut subscriber = bench.subscriber();
    let mut reload = |more: &str, answer: &str| {
        bench.configure_forearm(more);
        daemon.reload(answer)
    };
    assert_eq!(subscriber.verdict()["rejected"], Value::Null);
    reload("[model]\nmin_force_n = 900.0\n", "reloaded");
    // A press under way ends with the limit that it began with.
    subscriber.until(&json!({"phase": "final", "rejected": "low_force"}));
    // Neither of these files may take effect, not even in part.
    let line = reload("[model]\nmin_force = 0.0\n", "refused");
    assert!(
        line.contains("min_force") && line.contains("ERROR"),
        "{line}"
    );
    let more = "max_clients = 7\n[model]\nmin_force_n = 0.0\n";
    let line = reload(more, "refused");
    assert!(line.contains("publish.unix.max_clients"), "{line}");
    subscriber.press("begin");
    assert_eq!(subscriber.verdict()["rejected"], "low_force");
    reload("[log]\nformat = \"json\"\n", "reloaded");
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
    let mode = fs::metadata(&socket).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o660);
    bench.fails(RUN, 74, &["events.sock", "serves"]);
    assert_eq!(bench.subscriber().next().unwrap()["type"], "hello");
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
    bench.configure_forearm("");
    // The environment may say anything.
    for (watchdog_usec, beats) in [("200000", 3), ("0", 0)] {
        let mut command = bench.command(RUN);
        command.env("NOTIFY_SOCKET", bench.path("notify"));
        command.env("WATCHDOG_USEC", watchdog_usec);
        let mut daemon = Process::start(command.stderr(Stdio::null()));
        notified("READY=1");
        assert_eq!(bench.subscriber().next().unwrap()["type"], "hello");
        for _ in 0..beats {
            notified("WATCHDOG=1");
        }
        daemon.signal(Signal::TERM);
        notified("STOPPING=1");
        assert_eq!(daemon.exit_code(), Some(0));
    }
}

#[test]
fn a_log_that_nobody_reads_delays_nobody() {
    let bench = Bench::new();
    bench.configure_forearm("");
    let mut command = bench.command(RUN);
    command.env("RUST_LOG", "debug").stderr(Stdio::piped());
    let mut daemon = Process::start(&mut command);
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
    let mut daemon = bench.daemon_with("[log]\nformat = \"journald\"\n");
    // The sensor is absent, so the tare is refused.
    bench.control().is_refused(r#"{"tare":"forearm"}"#, "");
    let log = daemon.end();
    let begins = |line: &str| line.starts_with("<4>") || line.starts_with("<6>");
    assert!(log.lines().all(begins), "{log}");
    for expected in ["<6>started ", "<4>tare refused sensor=\"forearm\" reason="] {
        assert!(log.contains(expected), "{log}");
    }
}

#[test]
fn bad_input_ends_with_its_exit_code_and_one_line() {
    let bench = Bench::new();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let http = format!("[http]\nlisten = \"{address}\"\n");
    for (more, code, parts) in [
        (
            "[press]\nend_framse = 2\n",
            78,
            ["hardnessd.toml", "end_framse", "end_frames"],
        ),
        (
            "[model]\npath = \"none.onnx\"\n",
            78,
            ["none.onnx", "model.path", ""],
        ),
        (&http, 74, ["http.listen", &address, "in use"]),
    ] {
        bench.configure_forearm(more);
        bench.fails(RUN, code, &parts);
    }
    // 20 frames/s of 790 bytes need more than 115,200 baud. An adapter that is not there follows its
    // baud rate. A port of which nothing is known may be a pty.
    bench.configure_forearm("");
    bench.succeeds(CHECK);
    bench.configure(&sensor("forearm", "/dev/ttyUSB99", 20), "");
    bench.fails_each(
        "
        check --config hardnessd.toml | 78 | line 5: sensor.frame_rate_hz of | 14.58
        run --config /no/such.toml | 66 | /no/such.toml
        check --config . | 66 | cannot read: Is a directory
        replay . | 66 | .: cannot read: Is a directory
        replay /no/such.bin | 66 | /no/such.bin
        replay hardnessd.toml --motion none.csv | 66 | none.csv: cannot read
        simulate --faults /dev/zero | 1 | found more than 1048576 bytes
        simulate --fps 20 --baud 115200 | 2 | --baud | 158000
        run x.toml | 2 | argument 'x.toml' | tip: --config x.toml
        simulate --force 1000 | 2 | --force
        demo --speed 0.0001 | 2 | --speed
        record --config x.toml --out x --label note=\u{202e}7 | 2 | --label | found \"\\u{202e}7\"",
    );
    let (code, _, help) = run("");
    assert_eq!(code, 2, "{help}");
    assert!(help.contains("Usage: hardnessd <COMMAND>"), "{help}");
    bench.succeeds("--version");
}

#[test]
fn check_refuses_what_run_would_refuse_and_changes_nothing() {
    let bench = Bench::new();
    bench.write("file", "kept");
    fs::create_dir(bench.path("directory")).unwrap();
    let group = "events.sock\"\ncontrol_group = \"no such";
    for (socket, key, found) in [
        ("directory", "path", "no socket"),
        ("file", "path", "no socket"),
        ("file/events.sock", "path", "in no directory"),
        (
            group,
            "control_group",
            "found \"no such\", expected a group",
        ),
    ] {
        let table = format!("[publish.unix]\npath = \"{socket}\"\n");
        bench.write("bad.toml", sensor("forearm", "port", 20) + &table);
        let key = format!("publish.unix.{key}: ");
        for command in ["check", "run"] {
            bench.fails(&format!("{command} --config bad.toml"), 78, &[&key, found]);
        }
    }
    assert_eq!(bench.read("file"), "kept");
    bench.configure_forearm("[record]\ndir = \"a/b\"\n");
    bench.succeeds(CHECK);
    let left = fs::read_dir(bench.path("")).unwrap().count();
    assert_eq!(left, 4, "no socket and no directory are made");
    // `check` also works beside a running daemon.
    let _daemon = bench.daemon_as_configured();
    bench.succeeds(CHECK);
}

#[test]
fn a_signal_ends_every_command_that_waits_for_a_file() {
    let bench = Bench::new();
    let fifo = bench.fifo("fifo");
    bench.configure_forearm("[model]\npath = \"fifo\"\n");
    let unfinished = "hardnessd: interrupted before it had finished\n";
    for (line, code, printed) in [
        (RUN, 0, ""),
        ("record --config fifo --out new.mcap", 0, ""),
        ("simulate --faults fifo", 0, ""),
        ("check --config fifo", 143, unfinished),
        ("sniff fifo", 143, unfinished),
    ] {
        let mut process = Process::start(bench.command(line).stderr(Stdio::piped()));
        // Opening the pipe for writing succeeds once a process reads.
        let _writer = File::options().write(true).open(&fifo).unwrap();
        process.ends_at(Signal::TERM, code);
        assert_eq!(process.errors(), printed, "{line}");
    }
}
