//! The real binary over HTTP: events that resume, metrics, health, and refused requests.

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use crate::bench::{Bench, Daemon, PATIENCE, wait_for};
use serde_json::{Value, json};

const HTTP: &str = "[http]\nlisten = \"127.0.0.1:0\"\n";

/// A daemon with a page, and the page's address.
fn serving(bench: &Bench) -> (Daemon, SocketAddr) {
    let config = bench.configure("hardnessd.toml", "events.sock", HTTP);
    let mut daemon = Daemon::start(&config);
    let address = daemon.address("http");
    (daemon, address)
}

struct Answer {
    code: u16,
    head: String,
    body: String,
}

/// Sends a request unchanged. Without a `Host` among `headers`, the right one is added.
fn ask(address: SocketAddr, request: &str, headers: &[&str]) -> Answer {
    let mut stream = open(address, request, headers);
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    let (head, body) = text.split_once("\r\n\r\n").unwrap();
    Answer {
        code: head.split(' ').nth(1).unwrap().parse().unwrap(),
        head: head.to_ascii_lowercase(),
        body: body.to_owned(),
    }
}

fn open(address: SocketAddr, request: &str, headers: &[&str]) -> TcpStream {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut text = format!("{request} HTTP/1.1\r\nConnection: close\r\n");
    if !headers.iter().any(|header| header.starts_with("Host:")) {
        text += &format!("Host: {address}\r\n");
    }
    for header in headers {
        text += &format!("{header}\r\n");
    }
    stream.write_all((text + "\r\n").as_bytes()).unwrap();
    stream
}

fn get(address: SocketAddr, path: &str) -> Answer {
    ask(address, &format!("GET {path}"), &[])
}

/// Server-sent events, as a browser reads them.
struct Events {
    lines: BufReader<TcpStream>,
    /// The value that a browser would send in `Last-Event-ID`.
    last_id: String,
}

impl Events {
    fn open(address: SocketAddr, path: &str, last_id: Option<&str>) -> Self {
        let header = last_id.map(|id| format!("Last-Event-ID: {id}"));
        let headers: Vec<&str> = header.iter().map(String::as_str).collect();
        let stream = open(address, &format!("GET {path}"), &headers);
        let mut lines = BufReader::new(stream);
        let mut line = String::new();
        lines.read_line(&mut line).unwrap();
        assert!(line.contains("200"), "{line}");
        Self {
            lines,
            last_id: last_id.unwrap_or_default().to_owned(),
        }
    }

    /// The next event.
    fn next(&mut self) -> Value {
        loop {
            let mut line = String::new();
            assert!(self.lines.read_line(&mut line).unwrap() > 0, "closed");
            if let Some(id) = line.strip_prefix("id: ") {
                self.last_id = id.trim_end().to_owned();
            } else if let Some(data) = line.strip_prefix("data: ") {
                return serde_json::from_str(data).unwrap();
            }
        }
    }

    /// The number of the next numbered event.
    fn next_seq(&mut self) -> u64 {
        loop {
            let event = self.next();
            assert_ne!(event["type"], "gap", "{event}");
            if event["type"] != "hello"
                && let Some(seq) = event["seq"].as_u64()
            {
                return seq;
            }
        }
    }
}

#[test]
fn events_broken_off_and_resumed_come_once_each() {
    let bench = Bench::new();
    let (_daemon, address) = serving(&bench);
    let mut witness = bench.subscriber();
    let mut events = Events::open(address, "/events", None);
    let hello = events.next();
    assert_eq!(hello["type"], "hello");
    let run = hello["run"].as_str().unwrap().to_owned();
    // A client that disconnects before the first event misses no event either.
    let mut next = hello["seq"].as_u64().unwrap() + 1;
    assert_eq!(events.last_id, format!("{run}:{}", next - 1));
    let _sensor = bench.sensor(&[]);
    for had in [0, 1, 2, 5] {
        for _ in 0..had {
            assert_eq!(events.next_seq(), next);
            next += 1;
        }
        // More events come while nobody reads.
        witness.until(&json!({"type": "press", "state": "end"}));
        let last_id = events.last_id.clone();
        assert_eq!(last_id, format!("{run}:{}", next - 1));
        events = Events::open(address, "/events", Some(&last_id));
    }
    for _ in 0..8 {
        assert_eq!(events.next_seq(), next);
        next += 1;
    }

    // With a place in another run, all held events come, and a gap says that some are missing.
    let mut other = Events::open(address, "/events?types=press", Some("0ther:7"));
    assert_eq!(other.next()["type"], "hello");
    assert_eq!(other.last_id, format!("{run}:0"));
    assert_eq!(other.next()["seq"], Value::Null, "the status as it is");
    assert_eq!(other.next(), json!({"type": "gap", "lost": null}));
    assert_eq!(other.next()["type"], "press");
}

#[test]
fn requests_given_up_at_once_leave_no_subscriber() {
    let bench = Bench::new();
    let (_daemon, address) = serving(&bench);
    for _ in 0..6 {
        for wait_us in 0..50 {
            let stream = open(address, "GET /events", &[]);
            // The connection closes wherever the daemon is in the request by then.
            std::thread::sleep(Duration::from_micros(2 * wait_us));
            drop(stream);
        }
        wait_for("the end of all subscribers", || {
            let none = "hardnessd_subscribers{robot=\"arm-7\"} 0\n";
            get(address, "/metrics").body.contains(none)
        });
    }
}

#[test]
fn a_client_that_leaves_behind_a_further_request_is_noticed() {
    let bench = Bench::new();
    let (_daemon, address) = serving(&bench);
    for rest in ["GET / HTTP/1.1\r\n", &"x".repeat(200_000)] {
        let mut stream = TcpStream::connect(address).unwrap();
        let request = format!("GET /events HTTP/1.1\r\nHost: {address}\r\n\r\n{rest}");
        stream.write_all(request.as_bytes()).unwrap();
        let subscribers = |count| {
            let line = format!("hardnessd_subscribers{{robot=\"arm-7\"}} {count}\n");
            get(address, "/metrics").body.contains(&line)
        };
        wait_for("a subscriber", || subscribers(1));
        drop(stream);
        let left = Instant::now();
        wait_for("the end of all subscribers", || subscribers(0));
        // A write would find it out at a heartbeat, 15 s after the last event.
        assert!(left.elapsed() < Duration::from_secs(10));
    }
}

#[test]
fn frames_come_when_asked_for() {
    let bench = Bench::new();
    let (_daemon, address) = serving(&bench);
    let _sensor = bench.sensor(&[]);
    let mut events = Events::open(address, "/events?types=frame", None);
    let mut last = None;
    for _ in 0..30 {
        let event = events.next();
        match event["type"].as_str().unwrap() {
            "frame" => {
                let number = event["frame"].as_u64().unwrap();
                assert!(last.is_none_or(|last| number > last));
                assert_eq!(event["newtons"].as_array().unwrap().len(), 784);
                last = Some(number);
            }
            "hello" => {}
            other => assert_eq!((other, &event["seq"]), ("status", &Value::Null)),
        }
    }
    assert!(last.is_some());
    let answer = get(address, "/events?types=touch");
    assert_eq!((answer.code, answer.body.contains("touch")), (400, true));
}

#[test]
fn only_this_machine_by_its_address_is_served() {
    let bench = Bench::new();
    let (_daemon, address) = serving(&bench);
    let paths = [
        "/",
        "/events",
        "/api/status",
        "/api/history",
        "/metrics",
        "/livez",
        "/readyz",
    ];
    for path in paths {
        for host in ["evil.example", "localhost.evil.example", "192.0.2.7"] {
            let host = format!("Host: {host}:{}", address.port());
            let answer = ask(address, &format!("GET {path}"), &[&host]);
            assert_eq!(answer.code, 421, "{path} {host}");
        }
        let twice = format!("Host: {address}");
        let answer = ask(
            address,
            &format!("GET {path}"),
            &[&twice, "Host: evil.example"],
        );
        assert_ne!(answer.code, 200, "{path}");
    }
    for host in ["localhost", "127.0.0.1", "[::1]"] {
        let host = format!("Host: {host}:{}", address.port());
        assert_eq!(ask(address, "GET /livez", &[&host]).code, 200, "{host}");
    }
    // A page from another origin may not read an answer: no CORS header allows it.
    let answer = ask(address, "GET /api/status", &["Origin: null"]);
    assert!(!answer.head.contains("access-control-"), "{}", answer.head);
}

#[test]
fn no_route_changes_anything() {
    let bench = Bench::new();
    let (_daemon, address) = serving(&bench);
    let paths = [
        "/",
        "/events",
        "/api/status",
        "/api/history",
        "/metrics",
        "/livez",
        "/readyz",
        "/tare",
        "/api/tare",
    ];
    for path in paths {
        for method in ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "BREW"] {
            let request = format!("{method} {path}");
            let answer = ask(address, &request, &["Content-Length: 0"]);
            assert_eq!(answer.code, 405, "{request}");
            assert!(answer.head.contains("allow: get, head"), "{}", answer.head);
        }
    }
    for path in ["/tare", "/api", "//", "/..%2fetc/passwd", "/events/"] {
        assert_eq!(get(address, path).code, 404, "{path}");
    }
    let target = |bytes: usize| get(address, &format!("/{}", "a".repeat(bytes - 1))).code;
    // hyper itself refuses a target that is so long.
    assert_eq!((target(60_000), target(66_000)), (404, 414));
    let header = |bytes: usize| {
        let header = format!("X-Long: {}", "a".repeat(bytes));
        ask(address, "GET /livez", &[&header]).code
    };
    assert_eq!((header(60_000), header(66_000)), (200, 431));
    let head = ask(address, "HEAD /metrics", &[]);
    assert_eq!((head.code, head.body.as_str()), (200, ""));
    let head = ask(address, "HEAD /events", &[]);
    assert_eq!((head.code, head.body.as_str()), (200, ""));
}

/// hyper panics while it writes a date before 1970.
#[test]
fn no_answer_has_a_date() {
    let bench = Bench::new();
    let (_daemon, address) = serving(&bench);
    for path in ["/", "/api/status", "/metrics", "/livez", "/none"] {
        let head = get(address, path).head;
        assert!(!head.contains("\r\ndate:"), "{head}");
    }
}

#[test]
fn the_page_is_one_file_that_may_load_nothing() {
    let bench = Bench::new();
    let (_daemon, address) = serving(&bench);
    let page = get(address, "/");
    assert_eq!(page.code, 200);
    assert!(page.body.starts_with("<!doctype html>"));
    for part in [
        "content-type: text/html; charset=utf-8",
        "content-security-policy: default-src 'none'; script-src 'sha256-",
        "connect-src 'self'",
        "frame-ancestors 'none'",
        "x-content-type-options: nosniff",
        "referrer-policy: no-referrer",
        "cache-control: no-store",
    ] {
        assert!(page.head.contains(part), "{part} not in {}", page.head);
    }
    assert!(!page.head.contains("unsafe"), "{}", page.head);
}

/// The series of a scrape: name with labels, and value. Every line must be a series or a comment.
fn series(text: &str) -> Vec<(String, f64)> {
    assert_eq!(text.lines().last(), Some("# EOF"));
    text.lines()
        .filter(|line| !line.starts_with("# "))
        .map(|line| {
            let (name, value) = line.rsplit_once(' ').unwrap();
            (name.to_owned(), value.parse().unwrap())
        })
        .collect()
}

#[test]
fn metrics_say_what_was_published() {
    let bench = Bench::new();
    let (_daemon, address) = serving(&bench);
    let value = |name: &str| {
        let answer = get(address, "/metrics");
        assert!(answer.head.contains("application/openmetrics-text"));
        let all = series(&answer.body);
        let found = all.iter().find(|(series, _)| series == name);
        found.map(|(_, value)| *value)
    };
    let of = |name: &str, more: &str| {
        value(&format!(
            "hardnessd_{name}{{robot=\"arm-7\",sensor=\"forearm\"{more}}}"
        ))
    };
    assert_eq!(of("frames_total", ""), Some(0.0));
    assert_eq!(of("presses_total", ",state=\"begin\""), Some(0.0));
    assert_eq!(of("link_state", ",state=\"connecting\""), Some(1.0));
    assert_eq!(of("last_frame_age_seconds", ""), None);

    let mut subscriber = bench.subscriber();
    let mut sensor = bench.sensor(&["--presses", "2"]);
    let mut last = Value::Null;
    for _ in 0..2 {
        last = subscriber.until(&json!({"phase": "final"}));
    }
    bench.unplug(&mut sensor);
    let lost = subscriber.until(&json!({"type": "status", "state": "lost"}));
    assert_eq!(of("frames_total", ""), lost["frames"].as_f64());
    assert_eq!(of("frames_damaged_total", ""), Some(0.0));
    assert_eq!(of("presses_total", ",state=\"begin\""), Some(2.0));
    assert_eq!(of("presses_total", ",state=\"end\""), Some(2.0));
    let levels = (1..=4).map(|level| {
        let labels = format!(",phase=\"final\",level=\"{level}\"");
        of("verdicts_total", &labels).unwrap()
    });
    assert_eq!(levels.sum::<f64>(), 2.0);
    assert_eq!(of("link_state", ",state=\"lost\""), Some(1.0));
    assert_eq!(of("link_state", ",state=\"live\""), Some(0.0));
    let age = of("last_frame_age_seconds", "").unwrap();
    assert!((0.0..60.0).contains(&age));
    let events = value("hardnessd_events_total{robot=\"arm-7\"}");
    assert!(events >= lost["seq"].as_f64());
    assert_eq!(value("hardnessd_subscribers{robot=\"arm-7\"}"), Some(1.0));
    let build = get(address, "/metrics").body;
    let model = last["model"].as_str().unwrap();
    assert!(build.contains(&format!("model=\"{model}")), "{build}");
}

#[test]
fn a_robot_of_any_name_leaves_the_metrics_readable() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", HTTP);
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, text.replace("\"arm-7\"", r#"'arm "7" \ left'"#)).unwrap();
    let mut daemon = Daemon::start(&config);
    let address = daemon.address("http");
    let all = series(&get(address, "/metrics").body);
    assert!(!all.is_empty());
    for (name, _) in all {
        assert!(name.contains(r#"{robot="arm \"7\" \\ left""#), "{name}");
    }
}

#[test]
fn readiness_follows_the_sensors_and_liveness_does_not() {
    let bench = Bench::new();
    let (_daemon, address) = serving(&bench);
    let codes = || (get(address, "/livez").code, get(address, "/readyz").code);
    assert_eq!(codes(), (200, 503), "no sensor yet");
    let mut sensor = bench.sensor(&[]);
    wait_for("readiness", || get(address, "/readyz").code == 200);
    bench.subscriber().until(&json!({"phase": "final"}));
    bench.unplug(&mut sensor);
    wait_for("the loss", || get(address, "/readyz").code == 503);
    assert_eq!(codes(), (200, 503), "absent hardware is healthy");
    assert_eq!(get(address, "/readyz").body, "forearm lost\n");

    let status: Value = serde_json::from_str(&get(address, "/api/status").body).unwrap();
    assert_eq!(status["hello"]["robot"], "arm-7");
    let forearm = &status["sensors"][0];
    assert_eq!(forearm["status"]["state"], "lost");
    assert_eq!(forearm["last"]["phase"], "final");
    assert_eq!(forearm["contact_threshold_n"], 0.07);
    assert!(forearm["last_frame_age_s"].as_f64().unwrap() > 0.0);
    // A test has no right to real time, so its daemon has the test's own scheduling.
    let process = &status["process"];
    assert_eq!(
        (&process["scheduling"], &process["priority"]),
        (&json!("other"), &json!(0))
    );
    assert!(process["memory_locked"].is_boolean(), "{process}");

    // A page that opens now has the curve of the press that is over.
    let history = get(address, "/api/history?sensor=forearm");
    let history: Value = serde_json::from_str(&history.body).unwrap();
    let forces = history["points"].as_array().unwrap().iter();
    let forces = forces.map(|point| point[1].as_f64().unwrap());
    assert!(forces.fold(0.0, f64::max) > 5.0, "{history}");
    assert_eq!(get(address, "/api/history?sensor=palm").code, 404);
}

#[test]
fn connections_are_bounded_and_those_that_leave_make_room() {
    let bench = Bench::new();
    let (mut daemon, address) = serving(&bench);
    let idle: Vec<TcpStream> = (0..200)
        .map(|_| TcpStream::connect(address).unwrap())
        .collect();
    wait_for("a refusal", || get_or_reset(address) == Some(503));
    // Subscribers on sockets are not affected.
    assert_eq!(bench.subscriber().next().unwrap()["type"], "hello");
    drop(idle);
    wait_for("room", || get_or_reset(address) == Some(200));
    daemon.process.signal(rustix::process::Signal::TERM);
    assert_eq!(daemon.process.exit_code(), Some(0));
}

/// The status code of an answer. `None` if the connection was reset before the answer.
fn get_or_reset(address: SocketAddr) -> Option<u16> {
    let mut stream = TcpStream::connect(address).ok()?;
    let request = format!("GET /livez HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).ok()?;
    let mut text = String::new();
    stream.read_to_string(&mut text).ok()?;
    text.split(' ').nth(1)?.parse().ok()
}

#[test]
fn an_open_page_does_not_keep_the_daemon() {
    let bench = Bench::new();
    let (mut daemon, address) = serving(&bench);
    let mut events = Events::open(address, "/events?types=status,frame", None);
    events.next();
    daemon.process.signal(rustix::process::Signal::TERM);
    assert_eq!(daemon.process.exit_code(), Some(0));
    let log = daemon.whole_log();
    assert!(
        log.contains("stopping") && !log.contains("did not fetch"),
        "{log}"
    );
}
