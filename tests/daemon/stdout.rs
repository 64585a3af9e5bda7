//! If nobody reads stdout, or a pipe delivers no input, no command waits longer than it was asked
//! to run.

use std::fs::File;
use std::io::{self, BufRead, BufReader, ErrorKind, PipeReader, PipeWriter, Read, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::bench::{BINARY, Bench, Process, get, wait_for};
use rustix::io::{ioctl_fionbio, ioctl_fionread};
use rustix::process::Signal;
use serde_json::Value;

/// A pipe that has no room for another byte.
fn full_pipe() -> (PipeReader, PipeWriter) {
    let (reader, mut writer) = io::pipe().unwrap();
    ioctl_fionbio(&writer, true).unwrap();
    let refusal = loop {
        if let Err(refusal) = writer.write_all(&[b'\n'; 4096]) {
            break refusal;
        }
    };
    assert_eq!(refusal.kind(), ErrorKind::WouldBlock);
    ioctl_fionbio(&writer, false).unwrap();
    (reader, writer)
}

/// The program with a full pipe as stdout. Nobody reads the pipe as long as the reader is kept.
fn unread(arguments: &[&str]) -> (Command, PipeReader) {
    let (reader, writer) = full_pipe();
    let mut command = Command::new(BINARY);
    command.args(arguments).stdout(writer);
    (command, reader)
}

/// The process must end soon after this signal, with this exit code.
fn ends_at(signal: Signal, process: &mut Process, code: i32) {
    let start = Instant::now();
    process.signal(signal);
    assert_eq!(process.exit_code(), Some(code));
    let took = start.elapsed();
    assert!(took < Duration::from_secs(5), "took {took:?}");
}

#[test]
fn a_replay_that_nobody_reads_ends_at_a_signal() {
    let foam = Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/foam.5hz.bin");
    let mut frame = [0; 790];
    File::open(foam).unwrap().read_exact(&mut frame).unwrap();
    for (signal, code) in [(Signal::TERM, 143), (Signal::INT, 130)] {
        let bench = Bench::new();
        let fifo = bench.fifo("fifo.bin");
        let (mut command, _reader) = unread(&["replay", fifo.to_str().unwrap()]);
        let mut replay = Process(command.spawn().unwrap());
        // The first frame causes a status, which blocks the output.
        let mut writer = File::options().write(true).open(&fifo).unwrap();
        writer.write_all(&frame).unwrap();
        wait_for("a reader", || ioctl_fionread(&writer).unwrap() == 0);
        ends_at(signal, &mut replay, code);
    }
}

#[test]
fn a_tail_that_nobody_reads_is_over_in_its_time() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    let socket = bench.path("events.sock");
    let (mut command, _reader) = unread(&["tail", "--timeout", "0.5", "--socket"]);
    let child = command.arg(socket).stderr(Stdio::piped()).spawn();
    let mut tail = Process(child.unwrap());
    assert_eq!(tail.exit_code(), Some(1));
    let mut message = String::new();
    let mut stderr = tail.0.stderr.take().unwrap();
    stderr.read_to_string(&mut message).unwrap();
    assert!(message.contains("timed out after 0.5 s"), "{message}");
}

#[test]
fn a_demonstration_that_nobody_reads_goes_on_and_ends_at_a_signal() {
    let (mut command, _reader) = unread(&["demo"]);
    let mut demo = Process(command.stderr(Stdio::piped()).spawn().unwrap());
    let mut message = String::new();
    let mut stderr = BufReader::new(demo.0.stderr.take().unwrap());
    stderr.read_line(&mut message).unwrap();
    let (_, address) = message.trim().split_once("http://").unwrap();
    let (address, _) = address.split_once('/').unwrap();
    let frames = || {
        let answer = get(address, "/api/status");
        let (_, body) = answer.split_once("\r\n\r\n").unwrap();
        let status: Value = serde_json::from_str(body).unwrap();
        status["sensors"][0]["status"]["frames"].as_u64().unwrap()
    };
    wait_for("the tenth frame", || frames() > 10);
    ends_at(Signal::TERM, &mut demo, 0);
}
