//! The outputs of the real binary: TCP, the control socket, bad and many subscribers, many sensors.
//! The heavy tests are ignored here; `.ci/peers` runs them.

use std::collections::HashMap;
use std::fs;
use std::io::{BufRead, Read, Write};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::bench::{BINARY, Bench, Daemon, Process, Subscriber, events, get, wait_for};
use rustix::process::{Resource, Rlimit, Signal, getrlimit, setrlimit};
use serde_json::{Value, json};

#[test]
fn tcp_speaks_the_same_protocol_and_changes_nothing() {
    let bench = Bench::new();
    let tcp = "[publish.tcp]\nlisten = \"127.0.0.1:0\"\n";
    let mut daemon = Daemon::start(&bench.configure("hardnessd.toml", "events.sock", tcp));
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
        for command in [
            r#"{"tare":"forearm"}"#,
            r#"{"context":{"sensor":"forearm"}}"#,
            r#"{"blackbox":"forearm"}"#,
        ] {
            let answer = subscriber.ask(command);
            let message = answer["message"].as_str().unwrap();
            assert!(message.contains("control socket"), "{message}");
        }
    }
    let _sensor = bench.sensor(&["--presses", "1"]);
    for _ in ["begin", "end", "final"] {
        assert_eq!(over_tcp.next(), over_unix.next());
    }
}

#[test]
fn the_control_socket_tares_and_gives_presses_their_context() {
    let bench = Bench::new();
    let mut daemon = bench.daemon();
    let path = bench.path("control.sock");
    assert_eq!(
        fs::metadata(&path).unwrap().permissions().mode() & 0o777,
        0o600
    );
    let mut control = Subscriber::connect(&path);
    let refused = |answer: &Value, part: &str| {
        let message = answer["message"].as_str().unwrap();
        assert!(message.contains(part), "{message}");
    };
    assert_eq!(control.next().unwrap()["type"], "hello");
    refused(&control.ask(r#"{"tare":"forearm"}"#), "not live");
    refused(&control.ask(r#"{"tare":"wrist"}"#), "forearm");
    refused(&control.ask(r#"{"blackbox":"forearm"}"#), "[record]");

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
    for offsets in ["old", "new"] {
        let offsets = &tared["tare"][offsets];
        let counts = |key: &str| offsets[key].as_f64().unwrap();
        assert!(counts("least_counts") <= counts("mean_counts"));
        assert!(counts("mean_counts") <= counts("most_counts"));
    }
    let line = daemon.logged("new_mean_counts=");
    assert!(line.contains("sensor=\"forearm\"") && line.contains("old_mean_counts="));
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

#[test]
fn ok_comes_before_all_that_since_asks_for() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    let mut first = bench.subscriber();
    let run = first.next().unwrap()["run"].as_str().unwrap().to_owned();
    let mut sensor = bench.sensor(&["--presses", "1"]);
    assert_eq!(sensor.exit_code(), Some(0));
    // From then on, no event comes.
    let last = first.until(&json!({"state": "lost", "type": "status"}))["seq"].clone();
    for subscription in [
        json!({"subscribe": ["hardness", "press", "status"], "since": format!("{run}:0")}),
        json!({"subscribe": ["press"], "since": "another:7"}),
    ] {
        let mut subscriber = bench.subscriber();
        assert_eq!(subscriber.next().unwrap()["type"], "hello");
        assert_eq!(subscriber.next().unwrap()["state"], "lost");
        subscriber.send_line(&subscription.to_string());
        assert_eq!(subscriber.next().unwrap(), json!({"type": "ok"}));
        let held = subscriber.next().unwrap();
        let expected = if held["type"] == "gap" { "lost" } else { "seq" };
        assert!(held.get(expected).is_some(), "{held}");
        subscriber.until(&json!({"type": "press", "state": "end"}));
        // The subscriber also gets later lines.
        assert_eq!(subscriber.ask(r#"{"get":"status"}"#)["type"], "ok");
    }
    let mut again = bench.subscriber();
    again.send_line(&json!({"subscribe": ["status"], "since": format!("{run}:1")}).to_string());
    again.until(&json!({"type": "ok"}));
    assert_eq!(again.until(&json!({"seq": last}))["state"], "lost");
    let _sensor = bench.sensor(&["--presses", "1"]);
    again.until(&json!({"state": "live"}));
}

/// Reads everything on a thread of its own until it is stopped, and checks that nothing was missed.
struct Witness {
    stop: Arc<AtomicBool>,
    reading: JoinHandle<u64>,
}

impl Witness {
    fn start(mut subscriber: Subscriber) -> Self {
        subscriber.ask(r#"{"subscribe":["frame","status","press","hardness"]}"#);
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = stop.clone();
        let reading = std::thread::spawn(move || {
            let mut frames: HashMap<String, u64> = HashMap::new();
            let mut last_seq = None;
            let mut total = 0;
            while !stopped.load(Ordering::Relaxed) {
                let event = subscriber.next().expect("the connection stays");
                assert_ne!(event["type"], "gap", "{event}");
                if event["type"] == "frame" {
                    let sensor = event["sensor"].as_str().unwrap().to_owned();
                    let frame = event["frame"].as_u64().unwrap();
                    if let Some(last) = frames.insert(sensor, frame) {
                        assert_eq!(frame, last + 1);
                    }
                    total += 1;
                }
                if event["type"] == "status" {
                    assert_eq!(event["frames_damaged"], 0, "{event}");
                }
                if let Some(seq) = event["seq"].as_u64() {
                    assert!(last_seq.is_none_or(|last| seq == last + 1), "{event}");
                    last_seq = Some(seq);
                }
            }
            total
        });
        Self { stop, reading }
    }

    /// Ends the witness and returns its number of frames.
    fn end(self) -> u64 {
        self.stop.store(true, Ordering::Relaxed);
        self.reading.join().expect("nothing was missed")
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
    let mut daemon = Daemon::start(&bench.configure("hardnessd.toml", "events.sock", tcp));
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
        let mut binary = connect();
        let noise: Vec<u8> = (0..4096_u32).map(|i| (i * 167 % 251) as u8).collect();
        binary.lines.get_mut().write_all(&noise).unwrap();
        binary.send_line("");
        binary.until(&json!({"type": "error"}));
        assert_eq!(
            binary.ask(r#"{"get":"last","id":"still"}"#)["type"],
            "error"
        );
        binary.until(&json!({"type": "ok", "id": "still"}));

        let mut unknown = connect();
        let answer = unknown.ask(r#"{"subscribe":["touch"],"id":7}"#);
        assert_eq!(
            (&answer["type"], &answer["id"]),
            (&json!("error"), &json!(7))
        );
        assert_eq!(unknown.ask(r#"{"subscribe":[]}"#), json!({"type": "ok"}));

        let mut long = connect();
        // The daemon closes the connection before everything is written.
        let _ = long.lines.get_mut().write_all(&[b'x'; 1 << 20]);
        let mut line = String::new();
        let ended = loop {
            line.clear();
            match long.lines.read_line(&mut line) {
                Ok(0) | Err(_) => break true,
                Ok(_) if line.contains("\"error\"") => assert!(line.contains("65536")),
                Ok(_) => {}
            }
        };
        assert!(ended);

        // This subscriber sends half a line, then nothing.
        let mut half = connect();
        half.lines
            .get_mut()
            .write_all(br#"{"subscribe":["#)
            .unwrap();
        // This subscriber asks many questions and never reads an answer.
        let mut deaf = connect();
        for _ in 0..200 {
            deaf.send_line(r#"{"get":"status"}"#);
        }
        kept.extend([half, deaf]);
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
    // Places are taken by the witness and by the two kept connections of each way. Closed
    // connections free theirs during the loop.
    assert!((240..=255).contains(&served), "{served} served");
    assert_eq!(served + refused, 1000);
    drop(crowd);
    wait_for("room", || {
        bench
            .subscriber()
            .next()
            .is_some_and(|line| line["type"] == "hello")
    });
    assert!(witness.end() > 0);
}

#[test]
fn a_lost_sensor_disturbs_no_other_and_every_word_names_its_sensor() {
    let bench = Bench::new();
    let more = "[[sensor]]\nname = \"wrist\"\nport = \"port-2\"\nframe_rate_hz = 20.0\n\
                [http]\nlisten = \"127.0.0.1:0\"\n";
    let mut daemon = Daemon::start(&bench.configure("hardnessd.toml", "events.sock", more));
    let http = daemon.address("http").to_string();
    let mut forearm = bench.sensor(&[]);
    let _wrist = bench.sensor_at("port-2", 20, &["--seed", "2"]);
    let mut subscriber = bench.subscriber();
    assert_eq!(subscriber.next().unwrap()["sensors"][1]["name"], "wrist");
    subscriber.send_line(r#"{"subscribe":["status","press","hardness","frame"]}"#);
    for sensor in ["forearm", "wrist"] {
        subscriber.until(&json!({"type": "hardness", "phase": "final", "sensor": sensor}));
    }
    bench.unplug(&mut forearm);
    subscriber.until(&json!({"type": "status", "state": "lost", "sensor": "forearm"}));
    let mut frame = None;
    let mut finals = 0;
    while finals < 2 {
        let event = subscriber.next().unwrap();
        if event["sensor"] == "forearm" {
            // The rest of the sensor's press, and why the sensor stays lost.
            let is_rest = event["type"] == "press" && event["reason"] == "lost";
            let is_reason = event["type"] == "status" && event["state"] == "lost";
            assert!(is_rest || is_reason, "{event}");
            continue;
        }
        assert_eq!(event["sensor"], "wrist");
        match event["type"].as_str().unwrap() {
            "frame" => {
                let number = event["frame"].as_u64().unwrap();
                assert!(frame.is_none_or(|last| number == last + 1), "{event}");
                frame = Some(number);
            }
            "hardness" => finals += u32::from(event["phase"] == "final"),
            "press" => {}
            other => panic!("a {other} of the wrist"),
        }
    }

    let metrics = get(&http, "/metrics");
    for (sensor, live) in [("forearm", "0.0"), ("wrist", "1.0")] {
        let labels = format!("robot=\"arm-7\",sensor=\"{sensor}\"");
        let state = format!("hardnessd_link_state{{{labels},state=\"live\"}} {live}\n");
        assert!(metrics.contains(&state), "{metrics}");
        assert!(metrics.contains(&format!("hardnessd_frames_total{{{labels}}}")));
    }
    daemon.process.signal(Signal::TERM);
    assert_eq!(daemon.process.exit_code(), Some(0));
    let log = daemon.whole_log();
    let of_sensors = ["status seq", "press seq", "hardness seq"];
    let mut lines = 0;
    for line in log.lines() {
        if of_sensors.iter().any(|event| line.contains(event)) {
            assert!(line.contains("sensor=\"forearm\"") || line.contains("sensor=\"wrist\""));
            lines += 1;
        }
    }
    assert!(lines > 6, "{log}");
}

/// The mark of an event: `s` and its number, or `f` and the frame's number.
type Mark = (char, u64);

fn mark(line: &str) -> Option<Mark> {
    let after = |key: &str| -> Option<u64> {
        let (_, rest) = line.split_once(key)?;
        rest[..rest.find([',', '}'])?].parse().ok()
    };
    if line.starts_with("{\"type\":\"frame\"") {
        after("\"frame\":").map(|frame| ('f', frame))
    } else {
        after("\"seq\":").map(|seq| ('s', seq))
    }
}

/// Reads until `end`. Returns the marks of all events, and for each gap its place and its count.
fn read_marks(mut subscriber: Subscriber, end: Instant) -> (Vec<Mark>, Vec<(usize, u64)>) {
    let (mut marks, mut gaps) = (Vec::new(), Vec::new());
    let mut line = String::new();
    while Instant::now() < end {
        line.clear();
        assert!(subscriber.lines.read_line(&mut line).unwrap() > 0);
        if let Some(lost) = line.strip_prefix("{\"type\":\"gap\",\"lost\":") {
            let lost = lost.trim_end().trim_end_matches('}');
            gaps.push((marks.len(), lost.parse().unwrap()));
        } else if !line.starts_with("{\"type\":\"hello\"") {
            marks.extend(mark(&line));
        }
    }
    (marks, gaps)
}

/// This test takes 40 s and both cores of a small machine: `.ci/peers` runs it.
#[test]
#[ignore = "takes 40 s and much of the machine"]
fn fifty_subscribers_miss_nothing_beside_one_that_never_reads() {
    let bench = Bench::new();
    let config = bench.path("hardnessd.toml");
    let text = "[[sensor]]\nname = \"forearm\"\nport = \"port\"\nframe_rate_hz = 100.0\n\
                [publish.unix]\npath = \"events.sock\"\n[publish.tcp]\nlisten = \"127.0.0.1:0\"\n\
                [http]\nlisten = \"127.0.0.1:0\"\n";
    fs::write(&config, text).unwrap();
    let mut daemon = Daemon::start(&config);
    let address = daemon.address("tcp");
    let _sensor = bench.sensor_at("port", 100, &[]);
    bench.subscriber().until(&json!({"state": "live"}));
    let alone_kb = daemon.resident_kb();

    let all = r#"{"subscribe":["status","press","hardness","frame"]}"#;
    let subscribe = |mut subscriber: Subscriber| {
        subscriber.ask(all);
        subscriber
    };
    let mut stalled = [
        subscribe(bench.subscriber()),
        subscribe(Subscriber::over_tcp(address)),
    ];
    // This page never reads. It must get the newest frame, and every other event.
    let http = daemon.address("http");
    let page =
        format!("GET /events?types=status,press,hardness,frame HTTP/1.1\r\nHost: {http}\r\n\r\n");
    let mut asleep_page = TcpStream::connect(http).unwrap();
    asleep_page
        .set_read_timeout(Some(crate::bench::PATIENCE))
        .unwrap();
    asleep_page.write_all(page.as_bytes()).unwrap();
    let readers: Vec<Subscriber> = (0..50)
        .map(|number| match number % 2 {
            0 => subscribe(bench.subscriber()),
            _ => subscribe(Subscriber::over_tcp(address)),
        })
        .collect();
    let start = Instant::now();
    let asleep = start + Duration::from_secs(30);
    let end = asleep + Duration::from_secs(6);
    let reading: Vec<_> = readers
        .into_iter()
        .map(|reader| std::thread::spawn(move || read_marks(reader, end)))
        .collect();
    std::thread::sleep(asleep.duration_since(Instant::now()));
    let crowded_kb = daemon.resident_kb();
    let woken: Vec<_> = stalled
        .each_mut()
        .map(|stalled| std::mem::replace(stalled, bench.subscriber()))
        .into_iter()
        .map(|stalled| std::thread::spawn(move || read_marks(stalled, end)))
        .collect();

    let mut seqs = Vec::new();
    let mut page_gaps = 0;
    for line in std::io::BufReader::new(asleep_page).lines() {
        let line = line.unwrap();
        page_gaps += usize::from(line.contains("\"type\":\"gap\""));
        // `hello` has the number before that of the first event.
        if let Some(id) = line.strip_prefix("id: ") {
            seqs.push(id.rsplit_once(':').unwrap().1.parse::<u64>().unwrap());
        }
        if Instant::now() > end {
            break;
        }
    }
    assert_eq!(page_gaps, 0, "a page missed an event");
    assert!(seqs.len() > 10 && seqs.windows(2).all(|pair| pair[1] == pair[0] + 1));

    let read: Vec<_> = reading.into_iter().map(|r| r.join().unwrap()).collect();
    // Readers end at moments of their own.
    let longest = read.iter().max_by_key(|(marks, _)| marks.len());
    let reference = &longest.unwrap().0;
    let frames = reference.iter().filter(|(kind, _)| *kind == 'f').count();
    for (marks, gaps) in &read {
        assert_eq!(gaps, &[], "a reader missed something");
        for kind in ['f', 's'] {
            let numbers: Vec<u64> = marks.iter().filter(|m| m.0 == kind).map(|m| m.1).collect();
            assert!(numbers.windows(2).all(|pair| pair[1] == pair[0] + 1));
            assert!(!numbers.is_empty());
        }
    }
    let mut gaps_sent = Vec::new();
    for woken in woken {
        let (mut marks, gaps) = woken.join().unwrap();
        let is_newer = |mark: &Mark| !reference.contains(mark);
        while marks.last().is_some_and(is_newer) {
            marks.pop();
        }
        assert_eq!(gaps.len(), 1, "one gap, before what is left");
        let (at, lost) = gaps[0];
        let place = |mark: &Mark| reference.iter().position(|other| other == mark).unwrap();
        let missing = place(&marks[at]) - place(&marks[at - 1]) - 1;
        assert_eq!(missing as u64, lost);
        let back = place(marks.last().unwrap()) - place(&marks[at]) + 1;
        assert_eq!(marks.len() - at, back, "after the gap it misses nothing");
        gaps_sent.push(lost);
    }
    println!(
        "{frames} frames to each of 50 readers; gaps told {gaps_sent:?}; resident {alone_kb} kB alone, \
         {crowded_kb} kB with 53 subscribers"
    );
    assert!(frames > 2500, "{frames} frames in 36 s");
    assert!(
        crowded_kb < alone_kb + 24 * 1024,
        "memory grew to {crowded_kb} kB"
    );
}
