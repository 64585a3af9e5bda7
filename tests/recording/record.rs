//! Recordings of the real binary on a real pty: replayed, cut off, damaged, and on a bad disk.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use crate::bench::{
    Bench, Process, Subscriber, by_terminal, events, fails, hardnessd, recordings_in, run,
    timeless, wait_for,
};
use hardnessd_core::pipeline::Input;
use hardnessd_core::recording::{Entry, Found, Reader};
use hardnessd_simulator::random::Stream;
use rustix::process::Signal;
use serde_json::{Value, json};

/// A configuration without paths of sockets, for `record`.
fn configure(bench: &Bench, fps: u32) -> PathBuf {
    let path = bench.path("record.toml");
    let text =
        format!("[[sensor]]\nname = \"forearm\"\nport = \"port\"\nframe_rate_hz = {fps}.0\n");
    fs::write(&path, text).unwrap();
    path
}

fn record(config: &Path, out: &Path, more: &[&str]) -> Process {
    let mut command = by_terminal();
    command.args(["record", "--config"]).arg(config);
    command.arg("--out").arg(out).args(more);
    let child = command.stderr(Stdio::null()).stdout(Stdio::null()).spawn();
    Process(child.unwrap())
}

fn replay(recording: &Path) -> Vec<Value> {
    let output = hardnessd(&["replay", recording.to_str().unwrap()]);
    assert!(output.status.success(), "{recording:?}: {output:?}");
    assert_eq!(
        output.stdout,
        hardnessd(&["replay", recording.to_str().unwrap(), "--speed", "1000"]).stdout,
        "twice the same, whatever the speed"
    );
    events(&String::from_utf8(output.stdout).unwrap())
}

fn entries(recording: &Path) -> Vec<Found> {
    let file = fs::File::open(recording).unwrap();
    Reader::new(std::io::BufReader::new(file))
        .map(Result::unwrap)
        .collect()
}

fn recover(broken: &Path, good: &Path) {
    let [from, to] = [broken, good].map(|path| path.to_str().unwrap());
    let output = hardnessd(&["recover", from, "--out", to]);
    assert!(output.status.success(), "{output:?}");
}

fn is_bytes(found: &Found) -> bool {
    matches!(found.entry, Entry::Input(Input::Bytes(_)))
}

fn mono() -> Duration {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    Duration::try_from(now).unwrap()
}

#[test]
fn a_replay_repeats_what_subscribers_read_live() {
    let bench = Bench::new();
    let script = bench.path("faults.toml");
    fs::write(
        &script,
        "[[fault]]\nat_s = 2.0\nkind = \"flip\"\nframes = 3\n\
         [[fault]]\nat_s = 4.0\nkind = \"drop-bytes\"\nbytes = 9\n\
         [[fault]]\nat_s = 6.0\nkind = \"silence\"\nfor_s = 0.4\n\
         [[fault]]\nat_s = 8.0\nkind = \"unplug\"\nfor_s = 0.3\n",
    )
    .unwrap();
    let mut daemon = bench.daemon_with("[record]\ndir = \"rec\"\nkeep_free_mb = 0\n");
    let mut subscriber = bench.subscriber();
    let mut sensor = bench.sensor(&["--presses", "3", "--faults", script.to_str().unwrap()]);
    let mut control = Subscriber::connect(&bench.path("control.sock"));
    let context = r#"{"context":{"sensor":"forearm","tag":"pick"}}"#;
    assert_eq!(control.ask(context)["type"], "ok");
    assert_eq!(sensor.exit_code(), Some(0));
    daemon.end();
    let mut live: Vec<Value> = std::iter::from_fn(|| subscriber.next()).collect();
    live.retain(|event| event["seq"].is_u64() && event["type"] != "hello");
    let states: Vec<&Value> = live.iter().map(|event| &event["state"]).collect();
    assert!(states.contains(&&json!("stale")) && states.contains(&&json!("lost")));
    assert!(
        live.iter()
            .filter(|event| event["phase"] == "final")
            .count()
            >= 2
    );

    let recordings = recordings_in(&bench.path("rec"), "hardnessd-");
    let [recording] = recordings.as_slice() else {
        panic!("{recordings:?}");
    };
    let mut replayed = replay(recording);
    let end = replayed.pop().unwrap();
    assert_eq!(end["reason"], "end of recording");
    // The subscriber connected a moment after the start.
    let first = live[0]["seq"].as_u64().unwrap();
    replayed.retain(|event| event["seq"].as_u64().unwrap() >= first);
    let live: Vec<Value> = live.into_iter().map(timeless).collect();
    assert_eq!(replayed, live);
}

#[test]
fn record_writes_a_new_file_for_as_long_as_there_is_a_sensor() {
    let bench = Bench::new();
    let config = configure(&bench, 20);
    let out = bench.path("a.mcap");
    let labels = ["--label", "level=2", "--label", "object=7"];
    let [at, to] = [&config, &out].map(|path| path.to_str().unwrap());
    let command = ["record", "--config", at, "--out", to];
    // A label with a level that no model has is refused.
    for level in ["level=5", "level=-1"] {
        let labelled = [&command[..], &["--label", level]].concat();
        fails(&labelled, 2, &["1 (hard), 2 (firm)"]);
    }
    let twice = ["--label", "object=1", "--label", "object=2"];
    fails(
        &[&command[..], &twice].concat(),
        2,
        &["--label object: given twice"],
    );
    // Without anything to record, `record` says so and leaves no file.
    let own = ["--label", "level=ripe", "--label", "levl=2"];
    let (code, _, message) = run(&[&command[..], &own].concat());
    assert!(
        message.contains("--label levl: did you mean level?"),
        "{message}"
    );
    assert!(code == 69 && !message.contains("recorded"), "{message}");
    assert!(!out.exists());

    let _sensor = bench.sensor(&[]);
    let seconds = [&labels[..], &["--seconds", "1.5"]].concat();
    let mut recording = record(&config, &out, &seconds);
    assert_eq!(recording.exit_code(), Some(0));
    let found = entries(&out);
    let Entry::State(state) = &found[0].entry else {
        panic!("{:?}", found[0]);
    };
    assert_eq!(state.labels["object"], "7");
    assert!(found.iter().filter(|found| is_bytes(found)).count() > 20);
    let last = &found.last().unwrap().entry;
    assert_eq!(*last, Entry::Input(Input::Shutdown));
    let before = fs::read(&out).unwrap();
    let mut again = record(&config, &out, &[]);
    assert_eq!(again.exit_code(), Some(74));
    assert_eq!(fs::read(&out).unwrap(), before);

    // The loss of its sensor ends it, too, with another exit code.
    let third = bench.path("c.mcap");
    let mut sensor = bench.sensor_at("port", 20, &["--presses", "1"]);
    let mut recording = record(&config, &third, &[]);
    assert_eq!(sensor.exit_code(), Some(0));
    assert_eq!(recording.exit_code(), Some(69));
    let events = replay(&third);
    let finals = events.iter().filter(|event| event["phase"] == "final");
    assert_eq!(finals.count(), 1);
}

#[test]
fn killed_at_any_moment_less_than_a_second_is_lost() {
    let bench = Bench::new();
    let config = configure(&bench, 100);
    let _sensor = bench.sensor_at("port", 100, &[]);
    let mut moments = Stream::new(1, "moments of death");
    let (mut losses, mut gaps) = (Vec::new(), Vec::new());
    for round in 0..10 {
        let out = bench.path(&format!("{round}.mcap"));
        let good = bench.path(&format!("{round}.good.mcap"));
        let mut recording = record(&config, &out, &[]);
        wait_for("the file", || {
            fs::metadata(&out).is_ok_and(|file| file.len() > 8_000)
        });
        std::thread::sleep(Duration::from_secs_f64(1.5 * moments.uniform()));
        let before = mono();
        recording.signal(Signal::KILL);
        recording.exit_code();
        recover(&out, &good);
        let found = entries(&good);
        let last = found.iter().rfind(|found| is_bytes(found)).unwrap();
        losses.push(before.saturating_sub(last.at.mono));
        // Nothing is missing in between: bytes came every 4 ms or so, and a frame would be damaged. One may be
        // at the beginning, because the sensor sends while nobody reads.
        let moments: Vec<Duration> = found.iter().map(|found| found.at.mono).collect();
        let gap = moments.windows(2).map(|two| two[1] - two[0]).max();
        gaps.push(gap.unwrap());
        let events = replay(&good);
        let end = events.last().unwrap();
        assert_eq!(end["reason"], "end of recording");
        let damaged = end["frames_damaged"].as_u64().unwrap();
        assert!(damaged <= 1, "{end} in round {round}");
    }
    // A busy machine is late in some rounds.
    let median = |mut all: Vec<Duration>| {
        all.sort();
        all[all.len() / 2]
    };
    let (loss, gap) = (median(losses), median(gaps));
    assert!(loss < Duration::from_secs(1), "{loss:?}");
    assert!(gap < Duration::from_millis(500), "{gap:?}");
}

#[test]
fn recover_says_what_it_saved_and_leaves_files_alone() {
    let bench = Bench::new();
    let path = |name: &str| bench.path(name).to_str().unwrap().to_owned();
    let recover = |broken: &str, good: &str| {
        let (code, _, message) = run(&["recover", &path(broken), "--out", &path(good)]);
        (code, message)
    };
    let (code, message) = recover("none.mcap", "good.mcap");
    assert_eq!(code, 66, "{message}");
    fs::write(path("noise.mcap"), vec![7; 100_000]).unwrap();
    let (code, message) = recover("noise.mcap", "good.mcap");
    assert_eq!(code, 1, "{message}");
    assert!(!bench.path("good.mcap").exists());

    let _sensor = bench.sensor(&[]);
    let config = configure(&bench, 20);
    let out = bench.path("a.mcap");
    assert_eq!(
        record(&config, &out, &["--seconds", "3"]).exit_code(),
        Some(0)
    );
    let (code, message) = recover("a.mcap", "whole.mcap");
    assert_eq!(code, 0, "{message}");
    assert!(message.contains("lost nothing"), "{message}");
    let (code, message) = recover("noise.mcap", "whole.mcap");
    assert_eq!(code, 74, "{message}");
    assert_eq!(replay(&bench.path("whole.mcap")), replay(&out));

    // A recording that is cut off is played to its end, and ends with the same last event as raw
    // bytes.
    let mut bytes = fs::read(&out).unwrap();
    fs::write(path("cut.mcap"), &bytes[..bytes.len() / 2]).unwrap();
    let (code, events, message) = run(&["replay", &path("cut.mcap")]);
    assert_eq!((code, message.lines().count()), (1, 1), "{message}");
    let last = events.trim_end().lines().last().unwrap();
    assert!(last.contains(r#""reason":"end of recording""#), "{last}");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    fs::write(&out, bytes).unwrap();
    let (code, message) = recover("a.mcap", "good.mcap");
    assert_eq!(code, 0, "{message}");
    replay(&bench.path("good.mcap"));
}

#[test]
fn the_last_minute_is_written_on_request() {
    let bench = Bench::new();
    let _daemon = bench.daemon_with("[record]\ndir = \"rec\"\nkeep_free_mb = 0\n");
    let _sensor = bench.sensor(&["--presses", "2"]);
    let mut subscriber = bench.subscriber();
    let live = subscriber.until(&json!({"phase": "final"}));
    let mut control = Subscriber::connect(&bench.path("control.sock"));
    let answer = control.ask(r#"{"blackbox":"forearm","id":1}"#);
    assert_eq!(answer["type"], "ok", "{answer}");
    let written = PathBuf::from(answer["blackbox"].as_str().unwrap());
    let events = replay(&written);
    let verdict = events
        .iter()
        .find(|event| event["phase"] == "final")
        .unwrap();
    let mut live = timeless(live);
    live["seq"] = verdict["seq"].clone();
    assert_eq!(*verdict, live);
    let unknown = control.ask(r#"{"blackbox":"wrist"}"#);
    assert_eq!(unknown["type"], "error", "{unknown}");
}

#[test]
fn files_end_in_time_and_each_can_be_played_by_itself() {
    let bench = Bench::new();
    let record = "[record]\ndir = \"rec\"\nrotate_s = 2\nkeep_free_mb = 0\n";
    let mut daemon = bench.daemon_with(record);
    let _sensor = bench.sensor(&[]);
    let mut subscriber = bench.subscriber();
    let mut verdicts = Vec::new();
    while recordings_in(&bench.path("rec"), "hardnessd-").len() < 4 {
        verdicts.push(subscriber.until(&json!({"phase": "final"})));
    }
    daemon.end();
    let mut played: Vec<(u64, Value)> = Vec::new();
    for recording in recordings_in(&bench.path("rec"), "hardnessd-") {
        for mut event in replay(&recording) {
            if event["phase"] == "final" {
                event["seq"] = Value::Null;
                played.push((event["press"].as_u64().unwrap(), event));
            }
        }
    }
    for live in verdicts {
        let press = live["press"].as_u64().unwrap();
        let mut live = timeless(live);
        live["seq"] = Value::Null;
        let same: Vec<_> = played
            .iter()
            .filter(|(number, _)| *number == press)
            .collect();
        assert!(!same.is_empty(), "press {press} is in no file");
        assert!(same.iter().all(|(_, event)| *event == live));
    }
}

#[test]
fn a_recording_that_is_deleted_begins_anew() {
    let bench = Bench::new();
    let record = "[record]\ndir = \"rec\"\nkeep_free_mb = 0\n";
    let mut daemon = bench.daemon_with(record);
    let _sensor = bench.sensor(&[]);
    let mut subscriber = bench.subscriber();
    subscriber.until(&json!({"phase": "final"}));
    let directory = bench.path("rec");
    daemon.logged("recording path=");
    fs::remove_dir_all(&directory).unwrap();
    daemon.logged("recording path=");
    subscriber.until(&json!({"phase": "final"}));
    daemon.end();
    let recordings = recordings_in(&directory, "hardnessd-");
    assert_eq!(recordings.len(), 1, "{recordings:?}");
    assert!(
        replay(&recordings[0])
            .iter()
            .any(|event| event["phase"] == "final")
    );
}

#[test]
fn a_disk_that_is_full_or_fails_does_not_stop_the_sensor() {
    // With too little free space, recording stops with one message, and nothing is written.
    let bench = Bench::new();
    let record = "[record]\ndir = \"rec\"\nkeep_free_mb = 1000000000\n";
    let mut daemon = bench.daemon_with(record);
    let mut sensor = bench.sensor(&["--presses", "1"]);
    let mut subscriber = bench.subscriber();
    subscriber.until(&json!({"phase": "final"}));
    let mut control = Subscriber::connect(&bench.path("control.sock"));
    let answer = control.ask(r#"{"blackbox":"forearm"}"#);
    assert!(answer["message"].as_str().unwrap().contains("keep_free_mb"));
    assert_eq!(sensor.exit_code(), Some(0));
    daemon.end();
    let log = daemon.whole_log();
    assert_eq!(log.matches("recording stopped").count(), 1, "{log}");
    assert_eq!(recordings_in(&bench.path("rec"), ""), Vec::<PathBuf>::new());
}
