//! `hardnessd record` on a real pty, with a simulated sensor: the questions and files of
//! `--session`, and the line of progress.

use std::fs;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::process::Command;
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use crate::bench::pair::Pair;
use crate::bench::{BINARY, Bench, PATIENCE, Process, hardnessd, start_on};
use rustix::process::Signal;

/// A recording, and the terminal that it runs on.
struct Session {
    process: Process,
    master: OwnedFd,
    bytes: Receiver<Vec<u8>>,
    /// The output that the test has not looked at yet.
    written: String,
}

impl Session {
    fn start(config: &Path, directory: &Path) -> Self {
        Self::record(config, &["--session", directory.to_str().unwrap()])
    }

    fn record(config: &Path, more: &[&str]) -> Self {
        let pair = Pair::open().unwrap();
        let mut command = Command::new("setsid");
        command.args([BINARY, "record", "--config"]).arg(config);
        command.args(more);
        let (process, bytes) = start_on(&pair, command);
        Self {
            process,
            master: pair.master,
            bytes,
            written: String::new(),
        }
    }

    /// Waits for `part` in the output that was not looked at before. Returns what comes before it.
    fn sees(&mut self, part: &str) -> String {
        let start = Instant::now();
        loop {
            if let Some(at) = self.written.find(part) {
                let rest = self.written.split_off(at + part.len());
                let mut before = std::mem::replace(&mut self.written, rest);
                before.truncate(at);
                return before;
            }
            let left = PATIENCE.saturating_sub(start.elapsed());
            assert!(left > Duration::ZERO, "{part:?} not in {:?}", self.written);
            if let Ok(bytes) = self.bytes.recv_timeout(left) {
                self.written += &String::from_utf8_lossy(&bytes);
            }
        }
    }

    /// Waits for the end of the process, and returns the output that was not looked at before.
    fn ends(mut self) -> String {
        assert_eq!(self.process.exit_code(), Some(0));
        while let Ok(bytes) = self.bytes.recv_timeout(PATIENCE) {
            self.written += &String::from_utf8_lossy(&bytes);
        }
        self.written
    }

    fn answer(&self, line: &str) {
        self.press(&format!("{line}\n"));
    }

    fn press(&self, keys: &str) {
        rustix::io::write(&self.master, keys.as_bytes()).unwrap();
    }
}

#[test]
fn a_session_asks_for_each_object_and_labels_its_recording() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let own = bench.path("own");
    let _sensor = bench.sensor(&[]);

    let mut session = Session::start(&config, &own);
    session.sees("n: it asks for levels");
    session.press("n");
    session.sees("object 1: its name: ");
    session.answer("");
    session.sees("the name is empty");
    session.answer("Yoga mat");
    session.sees("its level, 1 (hard)");
    session.answer("7");
    session.sees("there is no level");
    session.answer("Very-Soft");
    session.sees("presses: 1");
    session.press("r");
    session.sees("again: Yoga mat");
    session.sees("presses: 2");
    session.press("\r");
    session.sees("object 2: its name: ");
    session.answer("a \"b\", c");
    session.sees("its level");
    session.answer("0");
    session.sees("presses: 1");
    session.press("q");
    session.sees("recorded 2 objects");
    assert_eq!(session.process.exit_code(), Some(0));

    let list = fs::read_to_string(own.join("session.csv")).unwrap();
    let lines: Vec<&str> = list.lines().collect();
    let [heading, first, second] = lines[..] else {
        panic!("{list}");
    };
    assert_eq!(heading, "object,name,shore,level,presses,file");
    assert!(first.starts_with("1,\"Yoga mat\",,4,"), "{first}");
    assert!(second.starts_with("2,\"a \"\"b\"\", c\",,0,"), "{second}");
    let mut files: Vec<_> = fs::read_dir(&own)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    files.sort();
    assert_eq!(
        files,
        ["001-yoga-mat.mcap", "002-a--b---c.mcap", "session.csv"]
    );
    assert_collects(&bench, &own);

    // The next session continues, and a session without a press leaves no file.
    let mut session = Session::start(&config, &own);
    session.sees("n: it asks for levels");
    session.press("n");
    session.sees("object 3: its name: ");
    session.answer("q");
    session.sees("recorded 0 objects");
    assert_eq!(session.process.exit_code(), Some(0));
    assert_eq!(fs::read_dir(&own).unwrap().count(), 3);

    // Numbers go on past files that the list lacks, as after a kill. A file that another program makes
    // meanwhile is left alone.
    fs::write(own.join("007-sponge.mcap"), "theirs").unwrap();
    fs::remove_file(own.join("session.csv")).unwrap();
    let mut session = Session::start(&config, &own);
    session.sees("n: it asks for levels");
    session.press("n");
    session.sees("object 8: its name: ");
    session.answer("foam");
    session.sees("its level");
    fs::write(own.join("008-foam.mcap"), "theirs").unwrap();
    session.answer("2");
    session.sees("it is object 9, because another session took a number");
    session.sees("presses: 0");
    session.press("q");
    session.sees("recorded 0 objects");
    assert_eq!(session.process.exit_code(), Some(0));
    assert!(!own.join("009-foam.mcap").exists());
    for theirs in ["007-sponge.mcap", "008-foam.mcap"] {
        assert_eq!(fs::read(own.join(theirs)).unwrap(), b"theirs");
    }
}

#[test]
fn a_reading_gives_the_level_and_no_line_of_the_log_cuts_through_a_question() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let own = bench.path("own");
    let _sensor = bench.sensor(&[]);

    let mut session = Session::record(&config, &["--sockets", "--session", own.to_str().unwrap()]);
    session.sees("y: it asks for readings");
    session.press("y");
    session.sees("object 1: its name: ");
    session.answer("foam");
    session.sees("its Shore OO reading: ");
    session.answer("soft");
    session.sees("no level has the Shore OO reading \"soft\"");
    session.answer("65.5");
    session.sees("level 2 (firm)");
    session.sees("presses: 0");
    let mut subscriber = bench.subscriber();
    session.sees("presses: 1");
    subscriber.until(&serde_json::json!({"type": "press", "state": "begin", "press": 2}));
    // The recording ends in the middle of a press, and the log warns of that.
    session.press("\r");
    let before = session.sees("object 2: its name: ");
    assert!(before.contains("aborted"), "{before:?}");
    session.answer("sponge");
    let between = session.sees("its Shore OO reading: ");
    assert!(!between.contains("WARN"), "{between:?}");
    session.answer("q");
    session.sees("recorded 1 object in");
    assert_eq!(session.process.exit_code(), Some(0));
    let list = fs::read_to_string(own.join("session.csv")).unwrap();
    assert!(list.contains("\n1,\"foam\",65.5,2,"), "{list}");
}

#[test]
fn a_recording_that_cannot_begin_leaves_no_file() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "no/such/directory/events.sock", "");
    let out = bench.path("a.mcap");
    let _sensor = bench.sensor(&[]);
    let record = [
        "record",
        "--config",
        config.to_str().unwrap(),
        "--sockets",
        "--out",
    ];
    let output = hardnessd(&[&record[..], &[out.to_str().unwrap()]].concat());
    assert!(!output.status.success(), "{output:?}");
    assert!(!out.exists());

    // With this limit, the file fails as on a full disk.
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let full = Command::new("sh")
        .args(["-c", "ulimit -f 0; exec \"$@\"", "sh", BINARY])
        .args(["record", "--seconds", "9", "--config"])
        .arg(config)
        .arg("--out")
        .arg(&out)
        .output()
        .unwrap();
    assert_eq!(full.status.code(), Some(74), "{full:?}");
    assert!(!out.exists());
}

/// `hrn-train` accepts the recordings unchanged.
fn assert_collects(bench: &Bench, own: &Path) {
    let out = bench.path("own.npz");
    let collected = Command::new(crate::bench::hrn_train())
        .args(["collect", "--out"])
        .arg(&out)
        .args([own.join("001-yoga-mat.mcap"), own.join("002-a--b---c.mcap")])
        .output()
        .unwrap();
    let message = String::from_utf8_lossy(&collected.stderr);
    assert_eq!(collected.status.code(), Some(0), "{message}");
    assert!(out.exists());
}

#[test]
fn a_line_of_the_log_is_not_glued_to_the_progress() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let out = bench.path("a.mcap");
    let _sensor = bench.sensor(&[]);
    let mut recording = Session::record(&config, &["--sockets", "--out", out.to_str().unwrap()]);
    // The first line of the progress may come before there is a socket.
    let mut subscriber = bench.subscriber();
    recording.sees(" 1 press (Ctrl-C ends it)");
    loop {
        let event = subscriber.next().unwrap();
        if event["type"] == "press" && event["state"] == "begin" && event["press"] == 2 {
            break;
        }
    }
    recording.process.signal(Signal::TERM);
    let output = recording.ends();
    // What a line shows at last: `\x1b[K` clears what was there.
    let mut lines = output
        .lines()
        .filter_map(|line| line.split("\x1b[K").last());
    let aborted = lines.clone().find(|line| line.contains("aborted"));
    assert!(
        aborted.is_some_and(|line| line.contains("WARN") && !line.contains("Ctrl-C")),
        "{output:?}"
    );
    assert!(
        lines.any(|line| line.starts_with("recorded ") && line.contains(" frames, 1 press: ")),
        "{output:?}"
    );
}

#[test]
fn a_session_needs_a_terminal_and_asks_for_its_labels_itself() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let own = bench.path("own");
    let check = |more: &[&str], part: &str| {
        let arguments = [
            "record",
            "--config",
            config.to_str().unwrap(),
            "--session",
            own.to_str().unwrap(),
        ];
        let output = hardnessd(&[&arguments[..], more].concat());
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(
            message.contains(part) && message.lines().count() == 1,
            "{message}"
        );
    };
    check(&[], "needs a terminal");
    check(&["--label", "level=2"], "--session asks for it");
    check(&["--out", "x.mcap"], "cannot be used with");
    assert!(!own.exists());
}
