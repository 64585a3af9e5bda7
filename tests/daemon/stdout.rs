//! If nobody reads stdout, or a pipe delivers no input, no command waits longer than it was asked
//! to run.

use std::fs::File;
use std::io::{self, BufRead, BufReader, ErrorKind, PipeReader, PipeWriter, Write};
use std::process::{Command, Stdio};

use crate::bench::{Bench, Process, frame, get, wait_for};
use rustix::io::{ioctl_fionbio, ioctl_fionread};
use rustix::process::Signal;

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

/// The command with a full pipe as stdout. Nobody reads the pipe as long as the reader is kept.
fn unread(mut command: Command) -> (Process, PipeReader) {
    let (reader, writer) = full_pipe();
    command.stdout(writer).stderr(Stdio::piped());
    (Process::start(&mut command), reader)
}

#[test]
fn a_replay_that_nobody_reads_ends_at_a_signal() {
    for (signal, code) in [(Signal::TERM, 143), (Signal::INT, 130)] {
        let bench = Bench::new();
        let fifo = bench.fifo("fifo.bin");
        let (mut replay, _reader) = unread(bench.command("replay fifo.bin"));
        // The first frame causes a status, which blocks the output.
        let mut writer = File::options().write(true).open(&fifo).unwrap();
        writer.write_all(&frame(0.0)).unwrap();
        wait_for("a reader", || ioctl_fionread(&writer).unwrap() == 0);
        replay.ends_at(signal, code);
    }
}

#[test]
fn a_tail_that_nobody_reads_is_over_in_its_time() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    let (mut tail, _reader) = unread(bench.command("tail --timeout 0.5 --socket events.sock"));
    assert_eq!(tail.exit_code(), Some(1));
    let message = tail.errors();
    assert!(message.contains("timed out after 0.5 s"), "{message}");
}

#[test]
fn a_demonstration_that_nobody_reads_goes_on_and_ends_at_a_signal() {
    let bench = Bench::new();
    let (mut demo, _reader) = unread(bench.command("demo"));
    let mut message = String::new();
    let mut stderr = BufReader::new(demo.0.stderr.take().unwrap());
    stderr.read_line(&mut message).unwrap();
    let (_, address) = message.trim().split_once("http://").unwrap();
    let address = address.split('/').next().unwrap().parse().unwrap();
    let status = || get(address, "/api/status").json();
    wait_for("the tenth frame", || {
        status()["sensors"][0]["status"]["frames"].as_u64() > Some(10)
    });
    demo.ends_at(Signal::TERM, 0);
}
