//! The example in Rust, with a daemon that stops and starts again.

use std::path::Path;
use std::process::{Command, Stdio};

use crate::bench::{BINARY, Bench, Lines, Process};
use rustix::process::Signal;

#[test]
fn it_tells_verdicts_that_it_knows_nothing_without_a_daemon_and_goes_on_with_the_next() {
    // `cargo test` builds examples beside the tests.
    let example = Path::new(BINARY).with_file_name("examples/subscribe");
    assert!(example.exists(), "first: cargo build --example subscribe");
    let bench = Bench::new();
    let mut command = Command::new(example);
    command
        .arg(bench.path("events.sock"))
        .stdout(Stdio::piped());
    let mut subscribe = Process::start(&mut command);
    let mut lines = Lines::of(subscribe.0.stdout.take().unwrap());
    lines.until(&["nothing is known until it is back"]);
    let daemon = bench.daemon();
    let _sensor = bench.sensor("");
    lines.until(&["\"forearm\" is \"live\""]);
    let verdict = lines.until(&["\"forearm\" press 1 (\"final\"): \"", "\" at ", " %"]);
    assert!(!verdict.contains("null"), "{verdict}");
    daemon.process.signal(Signal::TERM);
    lines.until(&["nothing is known until it is back"]);
    drop(daemon);
    let _daemon = bench.daemon();
    // A new run begins: its held events are new, and a gap of unknown length is printed.
    lines.until(&["missed null events"]);
    lines.until(&["\"forearm\" is \"live\""]);
    lines.until(&["\"forearm\" press 1 (\"final\"): "]);
}
