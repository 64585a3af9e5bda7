//! The real binary over HTTP: events that resume, metrics, health, and refused requests.

use std::io::{BufRead, BufReader, Write};
use std::net::{SocketAddr, TcpStream};

use crate::bench::{Answer, Bench, Daemon, HTTP, answer, ask, get, open, wait_for};
use serde_json::{Value, json};

/// A daemon with a page, and the page's address.
fn serving(bench: &Bench) -> (Daemon, SocketAddr) {
    let daemon = bench.daemon_with(HTTP);
    let address = daemon.address("http");
    (daemon, address)
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
fn the_page_may_say_what_is_pressed_and_no_page_from_elsewhere_may() {
    let bench = Bench::new();
    let daemon = bench.daemon_with(&format!("{HTTP}set_context = true\n"));
    let address = daemon.address("http");
    let body = r#"{"sensor":"forearm","level":2,"object":"cup"}"#;
    let json = "Content-Type: application/json";
    for (content_type, body, code) in [
        // A form of another page may send this without asking first.
        ("Content-Type: text/plain", body, 415),
        (json, r#"{"sensor":"palm"}"#, 400),
        (json, r#"{"sensor":"forearm","speed_mm_s":5.0}"#, 400),
        (json, "[]", 400),
        (json, &" ".repeat(3000), 413),
        (json, r#"{"sensor":"forearm","object":"can"}"#, 200),
        ("Content-Type: application/json; charset=utf-8", body, 200),
    ] {
        let length = format!("Content-Length: {}", body.len());
        let mut stream = open(address, "POST /api/context", &[content_type, &length]);
        for piece in body.as_bytes().chunks(7) {
            // A body that is too long is not read to its end.
            assert!(stream.write_all(piece).is_ok() || code == 413, "{body}");
        }
        let answer = answer(stream);
        assert_eq!(answer.code, code, "{body}: {}", answer.body);
    }
    let asked = ask(address, "OPTIONS /api/context", &["Origin: null"]);
    assert_eq!(asked.code, 405);
    let _sensor = bench.sensor("--presses 1");
    let press = bench.subscriber().press("begin");
    let expected = json!({"sensor": "forearm", "level": 2, "object": "cup"});
    assert_eq!(press["context"], expected);
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
    let _sensor = bench.sensor("");
    for had in [0, 1, 2, 5] {
        for _ in 0..had {
            assert_eq!(events.next_seq(), next);
            next += 1;
        }
        // More events come while nobody reads.
        witness.press("end");
        let last_id = events.last_id.clone();
        assert_eq!(last_id, format!("{run}:{}", next - 1));
        events = Events::open(address, "/events", Some(&last_id));
    }
    for _ in 0..8 {
        assert_eq!(events.next_seq(), next);
        next += 1;
    }
}

#[test]
fn only_this_machine_by_its_address_is_served_and_no_route_changes_anything() {
    let bench = Bench::new();
    let (_daemon, address) = serving(&bench);
    for path in ["/", "/events", "/api/status", "/metrics", "/livez"] {
        let host = format!("Host: evil.example:{}", address.port());
        let answer = ask(address, &format!("GET {path}"), &[&host]);
        assert_eq!(answer.code, 421, "{path} {host}");
        for method in ["POST", "DELETE", "OPTIONS"] {
            let request = format!("{method} {path}");
            let answer = ask(address, &request, &["Content-Length: 0"]);
            assert_eq!(answer.code, 405, "{request}");
            assert!(answer.head.contains("allow: get,head"), "{}", answer.head);
        }
    }
    assert_eq!(get(address, "/..%2fetc/passwd").code, 404);
    // A page from another origin may not read an answer: no CORS header allows it.
    let answer = ask(address, "GET /api/status", &["Origin: null"]);
    assert!(!answer.head.contains("access-control-"), "{}", answer.head);
    for path in ["/metrics", "/events"] {
        let head = ask(address, &format!("HEAD {path}"), &[]);
        assert_eq!((head.code, head.body.as_str()), (200, ""), "{path}");
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

#[test]
fn metrics_say_what_was_published() {
    let bench = Bench::new();
    let (_daemon, address) = serving(&bench);
    let mut subscriber = bench.subscriber();
    let mut sensor = bench.sensor("--presses 2");
    subscriber.verdict();
    let last = subscriber.verdict();
    bench.unplug(&mut sensor);
    let lost = subscriber.state("lost");
    let Answer { head, body, .. } = get(address, "/metrics");
    assert!(head.contains("application/openmetrics-text"));
    assert!(body.ends_with("# EOF\n"), "{body}");
    let value = |name: &str, more: &str| -> f64 {
        let labels = format!("robot=\"arm-7\",sensor=\"forearm\"{more}");
        let series = format!("hardnessd_{name}{{{labels}}} ");
        let value = body.lines().find_map(|line| line.strip_prefix(&series));
        value.expect(&series).parse().unwrap()
    };
    assert_eq!(Some(value("frames_total", "")), lost["frames"].as_f64());
    assert_eq!(value("presses_total", ",state=\"end\""), 2.0);
    let levels = (1..=4).map(|level| {
        let labels = format!(",phase=\"final\",level=\"{level}\"");
        value("verdicts_total", &labels)
    });
    assert_eq!(levels.sum::<f64>(), 2.0);
    assert_eq!(value("link_state", ",state=\"lost\""), 1.0);
    assert_eq!(value("link_state", ",state=\"live\""), 0.0);
    assert!((0.0..60.0).contains(&value("last_frame_age_seconds", "")));
    let model = format!("model=\"{}", last["model"].as_str().unwrap());
    assert!(body.contains(&model), "{body}");
}

#[test]
fn readiness_follows_the_sensors_and_liveness_does_not() {
    let bench = Bench::new();
    let (_daemon, address) = serving(&bench);
    let codes = || (get(address, "/livez").code, get(address, "/readyz").code);
    assert_eq!(codes(), (200, 503), "no sensor yet");
    let mut sensor = bench.sensor("");
    wait_for("readiness", || get(address, "/readyz").code == 200);
    bench.subscriber().verdict();
    bench.unplug(&mut sensor);
    wait_for("the loss", || get(address, "/readyz").code == 503);
    assert_eq!(codes(), (200, 503), "absent hardware is healthy");
    assert_eq!(get(address, "/readyz").body, "forearm lost\n");

    let status = get(address, "/api/status").json();
    assert_eq!(status["hello"]["robot"], "arm-7");
    let forearm = &status["sensors"][0];
    assert_eq!(forearm["status"]["state"], "lost");
    assert_eq!(forearm["last"]["phase"], "final");
    assert_eq!(forearm["contact_threshold_n"], 0.07);
    assert!(forearm["last_frame_age_s"].as_f64().unwrap() > 0.0);
}

#[test]
fn an_open_page_does_not_keep_the_daemon() {
    let bench = Bench::new();
    let (mut daemon, address) = serving(&bench);
    let mut events = Events::open(address, "/events?types=status,frame", None);
    events.next();
    let log = daemon.end();
    assert!(
        log.contains("stopping") && !log.contains("did not fetch"),
        "{log}"
    );
}
