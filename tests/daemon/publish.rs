//! The outputs of the real binary: TCP, the control socket, bad and many subscribers.

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::UnixStream;
use std::process::{Command, Stdio};

use crate::bench::{Bench, PATIENCE, Process, Subscriber, TCP, events, ran, wait_for};
use rustix::process::{Resource, Rlimit, Signal, getrlimit, setrlimit};
use serde_json::{Value, json};

const TARE: &str = r#"{"tare":"forearm"}"#;

#[test]
fn tcp_speaks_the_same_protocol_and_changes_nothing() {
    let bench = Bench::new();
    let daemon = bench.daemon_with(TCP);
    let mut over_tcp = Subscriber::over_tcp(daemon.address("tcp"));
    let mut over_unix = bench.subscriber();
    let [hello, also] = [&mut over_tcp, &mut over_unix].map(|subscriber| {
        let mut hello = subscriber.next().unwrap();
        // Another status may have come between the two connections.
        hello["seq"].take();
        hello
    });
    assert_eq!(hello, also);
    for subscriber in [&mut over_tcp, &mut over_unix] {
        let answer = subscriber.ask(r#"{"subscribe":["press","hardness"],"id":1}"#);
        assert_eq!(answer, json!({"type": "ok", "id": 1}));
        subscriber.is_refused(TARE, "control socket");
    }
    let _sensor = bench.sensor("--presses 1");
    for _ in ["begin", "end", "final"] {
        assert_eq!(over_tcp.next(), over_unix.next());
    }
}

#[test]
fn the_control_socket_has_its_mode_and_group_tares_and_gives_presses_their_context() {
    let bench = Bench::new();
    // A user may give files to groups of their own; root to any.
    let group = match rustix::process::getgid().as_raw() {
        0 => 1,
        own => own,
    };
    let keys = format!("control_mode = \"0660\"\ncontrol_group = \"{group}\"\n");
    let mut daemon = bench.daemon_with(&keys);
    let made = fs::metadata(bench.path("control.sock")).unwrap();
    assert_eq!((made.mode() & 0o777, made.gid()), (0o660, group));
    let mut control = bench.control();
    assert_eq!(control.next().unwrap()["type"], "hello");
    control.is_refused(TARE, "not live");

    let context = json!({"sensor": "forearm", "tag": "pick-17", "speed_mm_s": 5.0});
    let command = json!({"context": context, "id": "c"}).to_string();
    assert_eq!(control.ask(&command), json!({"type": "ok", "id": "c"}));
    let _sensor = bench.sensor("");
    let mut subscriber = bench.subscriber();
    assert_eq!(subscriber.press("begin")["context"], context);
    // At 20 frames/s, the press does not end before this command arrives.
    control.is_refused(TARE, "a press is under way");
    assert_eq!(subscriber.verdict()["context"], context);

    // Between presses there is usually time for the five frames of a tare.
    let tared = loop {
        subscriber.verdict();
        let answer = control.ask(r#"{"tare":"forearm","id":2}"#);
        if answer["type"] == "ok" {
            break answer;
        }
        assert!(answer.to_string().contains("tare: found"), "{answer}");
    };
    assert_eq!(tared["id"], 2);
    assert_eq!(tared["tare"]["sensor"], "forearm");
    daemon.logged("new_mean_counts=");
    control.ask(r#"{"context":{"sensor":"forearm"}}"#);
    assert_eq!(subscriber.press("begin")["context"], Value::Null);
}

/// `tail` of this bench's daemon, which it finds at the default place of sockets.
fn tail(bench: &Bench, arguments: &str) -> Command {
    let mut command = bench.command(&format!("tail {arguments}"));
    command.env("RUNTIME_DIRECTORY", bench.path(""));
    // Where a demonstration of another test has its socket.
    command.env("TMPDIR", bench.path(""));
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

#[test]
fn tail_gives_a_script_the_events_it_counts_or_an_exit_code() {
    let bench = Bench::new();
    let (code, _, stderr) = ran(&mut tail(&bench, ""));
    assert_eq!((code, stderr.lines().count()), (69, 1), "{stderr}");
    assert!(stderr.contains("events.sock"), "{stderr}");

    let daemon = bench.daemon();
    let none = ran(&mut tail(
        &bench,
        "--types hardness --count 1 --timeout 0.3",
    ));
    assert_eq!((none.0, none.1.as_str()), (1, ""), "nothing was judged");
    let (_, status, _) = ran(&mut tail(&bench, "--types status --count 1"));
    let line = "forearm       status    connecting";
    assert!(status.contains(line), "{status}");

    let _sensor = bench.sensor("");
    let arguments = "--json --types hardness,press --count 5";
    let (code, lines, _) = ran(&mut tail(&bench, arguments));
    assert_eq!((code, lines.lines().count()), (0, 5));
    for event in events(&lines) {
        assert!(["press", "hardness"].contains(&event["type"].as_str().unwrap()));
    }

    let mut unread = Process::start(&mut tail(&bench, "--types frame"));
    drop(unread.0.stdout.take());
    assert_eq!(unread.exit_code(), Some(0), "a closed pipe ends it quietly");
    // The message only names the daemon that was found.
    let stderr = unread.errors();
    assert!(stderr.starts_with("hardnessd: events of ") && stderr.lines().count() == 1);

    let mut left = Process::start(&mut tail(&bench, ""));
    let stdout = left.0.stdout.as_mut().unwrap();
    stdout.read_exact(&mut [0]).unwrap();
    daemon.process.signal(Signal::TERM);
    assert_eq!(left.exit_code(), Some(69), "the daemon has ended");
}

/// Reads up to the event with this number, and checks that nothing was missed.
fn assert_whole(mut subscriber: Subscriber, until: u64) {
    let mut last = [None; 2];
    while last[1] < Some(until) {
        let event = subscriber.next().expect("the connection stays");
        assert_ne!(event["type"], "gap", "{event}");
        for (key, last) in ["frame", "seq"].into_iter().zip(&mut last) {
            let is_own = key == "seq" || event["type"] == "frame";
            if let Some(number) = event[key].as_u64().filter(|_| is_own) {
                assert!(last.is_none_or(|last| number == last + 1), "{event}");
                *last = Some(number);
            }
        }
    }
}

/// Raises this process's limit of open files as far as it may.
fn many_files() {
    let limit = getrlimit(Resource::Nofile);
    let current = limit.maximum;
    setrlimit(Resource::Nofile, Rlimit { current, ..limit }).unwrap();
}

/// Connects, and tells by the first line whether it is served.
fn is_served(bench: &Bench) -> (UnixStream, bool) {
    let stream = UnixStream::connect(bench.path("events.sock")).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut line = String::new();
    let mut lines = BufReader::new(&stream);
    lines.read_line(&mut line).unwrap();
    let is_served = line.contains("\"hello\"");
    if !is_served {
        let is_said = line.contains("\"error\"") && line.contains("try later");
        assert!(is_said, "{line}");
        assert_eq!(lines.read_line(&mut line).unwrap(), 0, "closed");
    }
    (stream, is_served)
}

#[test]
fn bad_subscribers_get_an_error_or_a_refusal_and_cost_nobody_anything() {
    many_files();
    let bench = Bench::new();
    let daemon = bench.daemon_with(TCP);
    let address = daemon.address("tcp");
    let _sensor = bench.sensor("");
    bench.subscriber().state("live");
    let mut witness = bench.subscriber();
    witness.ask(r#"{"subscribe":["frame","status","press","hardness"]}"#);

    let mut kept = Vec::new();
    let over_unix = || bench.subscriber();
    let over_tcp = || Subscriber::over_tcp(address);
    for connect in [&over_unix as &dyn Fn() -> Subscriber, &over_tcp] {
        let mut long = connect();
        // The daemon closes the connection before everything is written.
        let _ = long.lines.get_mut().write_all(&[b'x'; 1 << 20]);
        for line in long.lines.lines().map_while(Result::ok) {
            assert!(!line.contains("\"error\"") || line.contains("65536"));
        }
        // This subscriber asks many questions and never reads an answer, then sends half a line.
        let mut deaf = connect();
        for _ in 0..200 {
            deaf.send_line(r#"{"get":"status"}"#);
        }
        let half = br#"{"subscribe":["#;
        deaf.lines.get_mut().write_all(half).unwrap();
        kept.push(deaf);
    }

    // A thousand connect, and stay.
    let crowd: Vec<(UnixStream, bool)> = (0..1000).map(|_| is_served(&bench)).collect();
    let served = crowd.iter().filter(|(_, is_served)| *is_served).count();
    // Places are taken by the witness and by the kept connections. Closed connections free theirs
    // during the loop.
    assert!((240..=255).contains(&served), "{served} served");
    drop(crowd);
    wait_for("room", || is_served(&bench).1);
    let hello = bench.subscriber().next().unwrap();
    assert_whole(witness, hello["seq"].as_u64().unwrap());
}
