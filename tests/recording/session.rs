//! `hardnessd record --session` on a real pty, with a simulated sensor: its questions and files.

use std::fs;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::process::Command;
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use hardnessd_core::recording::{Entry, Reader};

use crate::bench::pair::Pair;
use crate::bench::{BINARY, Bench, PATIENCE, Process, fails, start_on};

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

    /// Waits for each of the questions, and answers it.
    fn talk(&mut self, exchange: &[(&str, &str)]) {
        for (question, answer) in exchange {
            self.sees(question);
            self.answer(answer);
        }
    }

    /// Waits for its last words and its end.
    fn ends(&mut self, words: &str) {
        self.sees(words);
        assert_eq!(self.process.exit_code(), Some(0));
    }

    fn answer(&self, line: &str) {
        rustix::io::write(&self.master, format!("{line}\n").as_bytes()).unwrap();
    }
}

#[test]
fn a_session_asks_for_each_object_and_labels_its_recording() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let own = bench.path("own");
    let _sensor = bench.sensor(&[]);

    let mut session = Session::start(&config, &own);
    session.talk(&[
        ("object 1: its name: ", ""),
        ("the name is empty", "Yoga mat"),
        ("its level (hard, firm, soft, very-soft)", "7x"),
        ("found \"7x\", expected a Shore OO reading", "Very-Soft"),
    ]);
    session.sees("the zero is taken: press now");
    session.sees("verdict 1: ");
    session.sees(", you said very-soft; ");
    session.sees(" of 1 right");
    session.talk(&[
        ("verdict 2: ", ""),
        ("object 2: its name: ", "a \"b\", c"),
        ("its level", ""),
        ("verdict 1: ", "q"),
    ]);
    session.sees("recorded 2 objects");
    // Only presses of a known level count.
    let score = session.sees(" right");
    let (right, all) = score
        .trim_start_matches(" in this session")
        .trim()
        .split_once(" of ")
        .unwrap();
    let [right, all] = [right, all].map(|count| count.parse::<u64>().unwrap());
    assert!(right <= all && all >= 2, "{score}");
    session.ends(&format!("hrn-train fit {} --out own.onnx", own.display()));

    assert_eq!(fs::read_dir(&own).unwrap().count(), 2);
    assert_collects(&bench, &own);

    // The next session continues, and a session without a press leaves no file.
    let mut session = Session::start(&config, &own);
    session.sees("object 3: its name: ");
    session.answer("q");
    session.ends("recorded 0 objects");
    assert_eq!(fs::read_dir(&own).unwrap().count(), 2);
}

#[test]
fn a_reading_gives_the_level_and_no_line_of_the_log_cuts_through_a_question() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let own = bench.path("own");
    let _sensor = bench.sensor(&[]);

    let mut session = Session::record(&config, &["--sockets", "--session", own.to_str().unwrap()]);
    session.talk(&[
        ("object 1: its name: ", "foam"),
        ("its Shore OO reading, ", "65.5"),
    ]);
    session.sees("level 2 (firm)");
    session.sees("press now");
    let mut subscriber = bench.subscriber();
    session.sees("verdict 1: ");
    subscriber.until(&serde_json::json!({"type": "press", "state": "begin", "press": 2}));
    // The recording ends in the middle of a press, and the log warns of that, or of a slow machine.
    session.answer("");
    let before = session.sees("object 2: its name: ");
    assert!(before.contains("WARN"), "{before:?}");
    session.answer("sponge");
    let between = session.sees("its Shore OO reading, ");
    assert!(!between.contains("WARN"), "{between:?}");
    session.answer("q");
    session.ends("recorded 1 object in");
    assert!(own.join("001-foam.mcap").exists());
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
    let take = fs::File::open(own.join("001-yoga-mat.mcap")).unwrap();
    let first = Reader::new(std::io::BufReader::new(take)).next().unwrap();
    let Entry::State(state) = first.unwrap().entry else {
        panic!("a recording begins with a state");
    };
    let labels = ["object", "name", "level"].map(|key| state.labels[key].as_str());
    assert_eq!(labels, ["1", "Yoga mat", "4"]);
}

#[test]
fn a_session_needs_a_terminal_and_asks_for_its_labels_itself() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let own = bench.path("own");
    let check = |more: &[&str], part: &str| {
        let [config, own] = [&config, &own].map(|path| path.to_str().unwrap());
        let arguments = ["record", "--config", config, "--session", own];
        fails(&[&arguments[..], more].concat(), 2, &[part]);
    };
    check(&[], "needs a terminal");
    check(&["--label", "level=2"], "--session asks for it");
    check(&["--out", "x.mcap"], "cannot be used with");
    assert!(!own.exists());
}
