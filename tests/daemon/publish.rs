//! The outputs of the real binary: TCP, the control socket, bad and many subscribers.

use std::fs;
use std::io::{BufRead, Read, Write};
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use crate::bench::{BINARY, Bench, Process, Subscriber, events, wait_for};
use rustix::process::{Resource, Rlimit, Signal, getrlimit, setrlimit};
use serde_json::{Value, json};

#[test]
fn tcp_speaks_the_same_protocol_and_changes_nothing() {
    let bench = Bench::new();
    let tcp = "[publish.tcp]\nlisten = \"127.0.0.1:0\"\n";
    let mut daemon = bench.daemon_with(tcp);
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
        let answer = subscriber.ask(r#"{"tare":"forearm"}"#);
        let message = answer["message"].as_str().unwrap();
        assert!(message.contains("control socket"), "{message}");
    }
    let _sensor = bench.sensor(&["--presses", "1"]);
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
    let path = bench.path("control.sock");
    let made = fs::metadata(&path).unwrap();
    assert_eq!((made.mode() & 0o777, made.gid()), (0o660, group));
    let mut control = Subscriber::connect(&path);
    let refused = |answer: &Value, part: &str| {
        let message = answer["message"].as_str().unwrap();
        assert!(message.contains(part), "{message}");
    };
    assert_eq!(control.next().unwrap()["type"], "hello");
    refused(&control.ask(r#"{"tare":"forearm"}"#), "not live");

    let context = json!({"sensor": "forearm", "tag": "pick-17", "speed_mm_s": 5.0});
    let command = json!({"context": context, "id": "c"}).to_string();
    assert_eq!(control.ask(&command), json!({"type": "ok", "id": "c"}));
    let _sensor = bench.sensor(&[]);
    let mut subscriber = bench.subscriber();
    let begin = subscriber.until(&json!({"type": "press", "state": "begin"}));
    assert_eq!(begin["context"], context);
    // At 20 frames/s, the press does not end before this command arrives.
    refused(
        &control.ask(r#"{"tare":"forearm"}"#),
        "a press is under way",
    );
    let verdict = subscriber.until(&json!({"phase": "final"}));
    assert_eq!(verdict["context"], context);

    // Between presses there is usually time for the five frames of a tare.
    let tared = loop {
        subscriber.until(&json!({"phase": "final"}));
        let answer = control.ask(r#"{"tare":"forearm","id":2}"#);
        if answer["type"] == "ok" {
            break answer;
        }
        refused(&answer, "tare: found");
    };
    assert_eq!(
        (&tared["id"], &tared["tare"]["sensor"]),
        (&json!(2), &json!("forearm"))
    );
    daemon.logged("new_mean_counts=");
    assert_eq!(
        control.ask(r#"{"context":{"sensor":"forearm"}}"#)["type"],
        "ok"
    );
    let begin = subscriber.until(&json!({"type": "press", "state": "begin"}));
    assert_eq!(begin["context"], Value::Null);
}

/// `tail` of this bench's daemon, which it finds at the default place of sockets.
fn tail(bench: &Bench, arguments: &[&str]) -> Command {
    let mut command = Command::new(BINARY);
    command.arg("tail").args(arguments);
    command.env("RUNTIME_DIRECTORY", bench.path(""));
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

#[test]
fn tail_gives_a_script_the_events_it_counts_or_an_exit_code() {
    let bench = Bench::new();
    let output = tail(&bench, &[]).output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(69), "{stderr}");
    assert!(stderr.contains("events.sock") && stderr.lines().count() == 1);

    let daemon = bench.daemon();
    let arguments = ["--types", "hardness", "--count", "1", "--timeout", "0.3"];
    let output = tail(&bench, &arguments).output().unwrap();
    assert_eq!(
        (output.status.code(), output.stdout),
        (Some(1), Vec::new()),
        "nothing was judged"
    );
    let arguments = ["--types", "status", "--count", "1"];
    let status = tail(&bench, &arguments).output().unwrap();
    let line = String::from_utf8(status.stdout).unwrap();
    assert!(
        line.contains("forearm       status    connecting"),
        "{line}"
    );

    let _sensor = bench.sensor(&[]);
    let arguments = ["--json", "--types", "hardness,press", "--count", "5"];
    let output = tail(&bench, &arguments).output().unwrap();
    assert_eq!(output.status.code(), Some(0));
    let lines = String::from_utf8(output.stdout).unwrap();
    assert_eq!(lines.lines().count(), 5);
    for event in events(&lines) {
        assert!(["press", "hardness"].contains(&event["type"].as_str().unwrap()));
    }

    let mut unread = Process(tail(&bench, &["--types", "frame"]).spawn().unwrap());
    drop(unread.0.stdout.take());
    assert_eq!(unread.exit_code(), Some(0), "a closed pipe ends it quietly");
    let mut stderr = String::new();
    let mut unread = unread.0.stderr.take().unwrap();
    unread.read_to_string(&mut stderr).unwrap();
    // The message only names the daemon that was found.
    assert!(stderr.starts_with("hardnessd: events of ") && stderr.lines().count() == 1);

    let mut left = Process(tail(&bench, &[]).spawn().unwrap());
    let mut line = [0];
    left.0
        .stdout
        .as_mut()
        .unwrap()
        .read_exact(&mut line)
        .unwrap();
    daemon.process.signal(Signal::TERM);
    assert_eq!(left.exit_code(), Some(69), "the daemon has ended");
}

#[test]
fn tail_does_not_wait_for_a_hello_that_does_not_come_nor_take_another_protocol() {
    let bench = Bench::new();
    let first_line = |line: &'static str| {
        let path = bench.path("events.sock");
        let _ = fs::remove_file(&path);
        let listener = UnixListener::bind(&path).unwrap();
        let listening = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            stream.write_all(line.as_bytes()).unwrap();
            // Wait until the client disconnects.
            let _ = stream.read_to_end(&mut Vec::new());
        });
        let output = tail(&bench, &[]).output().unwrap();
        listening.join().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(69), "{stderr}");
        assert_eq!(stderr.lines().count(), 1, "{stderr}");
        stderr
    };
    for (line, parts) in [
        ("", ["no answer for 5 s", "events.sock"]),
        (
            "{\"type\":\"hello\",\"protocol\":2}\n",
            ["protocol 2", "protocol 1"],
        ),
        ("{\"type\":\"ok\"}\n", ["\"ok\"", "expected the hello"]),
        ("SSH-2.0\n", ["no JSON", "events.sock"]),
        (
            "HTTP/1.1 400 Bad Request\r\n",
            ["a web server answers", "[publish.tcp]"],
        ),
    ] {
        let stderr = first_line(line);
        for part in parts {
            assert!(stderr.contains(part), "{part:?} not in {stderr}");
        }
    }
}

/// Reads everything on a thread of its own until it is stopped, and checks that nothing was missed.
struct Witness {
    stop: Arc<AtomicBool>,
    reading: JoinHandle<()>,
}

impl Witness {
    fn start(mut subscriber: Subscriber) -> Self {
        subscriber.ask(r#"{"subscribe":["frame","status","press","hardness"]}"#);
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let reading = std::thread::spawn(move || {
            let mut last = [None; 2];
            while !stopped.load(Ordering::Relaxed) {
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
        });
        Self { stop, reading }
    }

    fn end(self) {
        self.stop.store(true, Ordering::Relaxed);
        self.reading.join().expect("nothing was missed");
    }
}

/// Raises this process's limit of open files as far as it may.
fn many_files() {
    let limit = getrlimit(Resource::Nofile);
    let current = limit.maximum;
    setrlimit(Resource::Nofile, Rlimit { current, ..limit }).unwrap();
}

#[test]
fn bad_subscribers_get_an_error_or_a_refusal_and_cost_nobody_anything() {
    many_files();
    let bench = Bench::new();
    let tcp = "[publish.tcp]\nlisten = \"127.0.0.1:0\"\n";
    let mut daemon = bench.daemon_with(tcp);
    let address = daemon.address("tcp");
    let _sensor = bench.sensor(&[]);
    bench.subscriber().until(&json!({"state": "live"}));
    let witness = Witness::start(bench.subscriber());

    let mut kept = Vec::new();
    for way in ["unix", "tcp"] {
        let connect = || match way {
            "unix" => bench.subscriber(),
            _ => Subscriber::over_tcp(address),
        };
        let mut long = connect();
        // The daemon closes the connection before everything is written.
        let _ = long.lines.get_mut().write_all(&[b'x'; 1 << 20]);
        let mut line = String::new();
        while long
            .lines
            .read_line(&mut line)
            .is_ok_and(|length| length > 0)
        {
            assert!(!line.contains("\"error\"") || line.contains("65536"));
            line.clear();
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

    // A thousand connect at once. Each is served or refused, and its first line says which.
    let crowd: Vec<UnixStream> = (0..1000)
        .map(|_| UnixStream::connect(bench.path("events.sock")).unwrap())
        .collect();
    let (mut served, mut refused) = (0, 0);
    for stream in &crowd {
        stream
            .set_read_timeout(Some(crate::bench::PATIENCE))
            .unwrap();
        let mut line = String::new();
        let mut lines = std::io::BufReader::new(stream);
        lines.read_line(&mut line).unwrap();
        if line.contains("\"hello\"") {
            served += 1;
        } else {
            assert!(
                line.contains("\"error\"") && line.contains("try later"),
                "{line}"
            );
            assert_eq!(lines.read_line(&mut line).unwrap(), 0, "closed");
            refused += 1;
        }
    }
    // Places are taken by the witness and by the kept connections. Closed connections free theirs
    // during the loop.
    assert!((240..=255).contains(&served), "{served} served");
    assert_eq!(served + refused, 1000);
    drop(crowd);
    wait_for("room", || {
        bench
            .subscriber()
            .next()
            .is_some_and(|line| line["type"] == "hello")
    });
    witness.end();
}
