//! The example in Rust, with a daemon that stops and starts again.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::mpsc::{self, Receiver};

use crate::bench::{BINARY, Bench, PATIENCE, Process};
use rustix::process::Signal;

/// Waits for a line that has all these parts.
fn sees(lines: &Receiver<String>, parts: &[&str]) -> String {
    let mut logged = Vec::new();
    loop {
        let line = lines
            .recv_timeout(PATIENCE)
            .unwrap_or_else(|_| panic!("{parts:?} is not said, but {logged:#?}"));
        if parts.iter().all(|part| line.contains(part)) {
            return line;
        }
        logged.push(line);
    }
}

#[test]
fn it_tells_verdicts_that_it_knows_nothing_without_a_daemon_and_goes_on_with_the_next() {
    // `cargo test` builds examples beside the tests.
    let example = Path::new(BINARY).with_file_name("examples/subscribe");
    assert!(example.exists(), "first: cargo build --example subscribe");
    let bench = Bench::new();
    let mut subscribe = Process(
        Command::new(example)
            .arg(bench.path("events.sock"))
            .stdout(Stdio::piped())
            .spawn()
            .unwrap(),
    );
    let output = subscribe.0.stdout.take().unwrap();
    let (sender, lines) = mpsc::channel();
    std::thread::spawn(move || {
        for line in BufReader::new(output).lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                return;
            }
        }
    });
    sees(&lines, &["nothing is known until it is back"]);
    let daemon = bench.daemon();
    let _sensor = bench.sensor(&[]);
    sees(&lines, &["\"forearm\" is \"live\""]);
    let verdict = sees(
        &lines,
        &["\"forearm\" press 1 (\"final\"): \"", "\" at ", " %"],
    );
    assert!(!verdict.contains("null"), "{verdict}");
    daemon.process.signal(Signal::TERM);
    sees(&lines, &["nothing is known until it is back"]);
    drop(daemon);
    let _daemon = bench.daemon();
    // A new run begins: its held events are new, and a gap of unknown length is printed.
    sees(&lines, &["missed null events"]);
    sees(&lines, &["\"forearm\" is \"live\""]);
    sees(&lines, &["\"forearm\" press 1 (\"final\"): "]);
}
