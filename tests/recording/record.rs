//! Recordings of the real binary on a real pty: replayed, cut off, damaged, and on a bad disk.

use std::fs;
use std::time::Duration;

use crate::bench::{Bench, Process, RECORD, events, mono, sensor, timeless, wait_for};
use hardnessd_core::pipeline::Input;
use hardnessd_core::recording::{Entry, Found};
use hardnessd_core::tests::support::of_a_press;
use hardnessd_simulator::random::Stream;
use rustix::process::Signal;
use serde_json::Value;

fn record(bench: &Bench, out: &str) -> Process {
    bench.start(&format!("record --config hardnessd.toml --out {out}"))
}

fn replay(bench: &Bench, recording: &str) -> Vec<Value> {
    let replayed = bench.succeeds(&format!("replay {recording}"));
    let again = bench.succeeds(&format!("replay {recording} --speed 1000"));
    assert_eq!(replayed, again, "twice the same, whatever the speed");
    events(&replayed)
}

/// An event of a replay that begins at another number than the daemon.
fn unnumbered(event: &Value) -> Value {
    let mut event = timeless(event.clone());
    event["seq"] = Value::Null;
    event
}

fn is_final(event: &Value) -> bool {
    event["phase"] == "final"
}

fn is_bytes(found: &Found) -> bool {
    matches!(found.entry, Entry::Input(Input::Bytes(_)))
}

#[test]
fn a_replay_repeats_what_subscribers_read_live() {
    let bench = Bench::new();
    let faults = [
        (2, "flip\"\nframes = 3"),
        (4, "drop-bytes\"\nbytes = 9"),
        (6, "silence\"\nfor_s = 0.4"),
        (8, "unplug\"\nfor_s = 0.3"),
    ];
    let faults = faults.map(|(at, what)| format!("[[fault]]\nat_s = {at}.0\nkind = \"{what}\n"));
    bench.write("faults.toml", faults.concat());
    let mut daemon = bench.daemon_with(RECORD);
    let mut subscriber = bench.subscriber();
    let mut sensor = bench.sensor("--presses 3 --faults faults.toml");
    let context = r#"{"context":{"sensor":"forearm","tag":"pick"}}"#;
    assert_eq!(bench.control().ask(context)["type"], "ok");
    assert_eq!(sensor.exit_code(), Some(0));
    daemon.end();
    let mut live: Vec<Value> = std::iter::from_fn(|| subscriber.next()).collect();
    live.retain(|event| event["seq"].is_u64() && event["type"] != "hello");
    for state in ["stale", "lost"] {
        assert!(live.iter().any(|event| event["state"] == state), "{state}");
    }
    assert!(live.iter().filter(|event| is_final(event)).count() >= 2);

    let recordings = bench.recordings("hardnessd-");
    assert_eq!(recordings.len(), 1, "{recordings:?}");
    let mut replayed = replay(&bench, &recordings[0]);
    assert_eq!(replayed.pop().unwrap()["reason"], "end of recording");
    // The subscriber connected a moment after the start.
    let first = live[0]["seq"].as_u64();
    replayed.retain(|event| event["seq"].as_u64() >= first);
    let live: Vec<Value> = live.into_iter().map(timeless).collect();
    assert_eq!(replayed, live);
}

#[test]
fn record_writes_a_new_file_for_as_long_as_there_is_a_sensor() {
    let bench = Bench::new();
    bench.configure_forearm("");
    let line = "record --config hardnessd.toml --out a.mcap --label";
    for (label, part) in [
        ("level=5", "1 (hard), 2 (firm)"),
        ("level=-1", "1 (hard), 2 (firm)"),
        ("object=1 --label object=2", "--label object: given twice"),
    ] {
        bench.fails(&format!("{line} {label}"), 2, &[part]);
    }
    // Without anything to record, `record` says so and leaves no file.
    let (code, _, message) = bench.run(&format!("{line} level=ripe --label levl=2"));
    let expected = "--label levl: did you mean level?";
    assert!(message.contains(expected), "{message}");
    assert!(code == 69 && !message.contains("recorded"), "{message}");
    assert!(!bench.path("a.mcap").exists());

    let _sensor = bench.sensor("");
    bench.succeeds(&format!("{line} level=2 --label object=7 --seconds 1.5"));
    let found = bench.entries("a.mcap");
    let Entry::State(state) = &found[0].entry else {
        panic!("{:?}", found[0]);
    };
    assert_eq!(state.labels["object"], "7");
    assert!(found.iter().filter(|found| is_bytes(found)).count() > 20);
    let last = &found.last().unwrap().entry;
    assert_eq!(*last, Entry::Input(Input::Shutdown));
    let before = fs::read(bench.path("a.mcap")).unwrap();
    assert_eq!(record(&bench, "a.mcap").exit_code(), Some(74));
    assert_eq!(fs::read(bench.path("a.mcap")).unwrap(), before);

    // Where one of two sensors is missing, nothing is kept, though the other one sends.
    let both = sensor("forearm", "port", 20) + &sensor("missing", "nowhere", 20);
    bench.write("both.toml", both);
    let (code, _, message) = bench.run("record --config both.toml --out b.mcap");
    assert!(code == 69 && !message.contains("recorded"), "{message}");
    assert!(!bench.path("b.mcap").exists());

    // The loss of its sensor ends it, too, with another exit code.
    let mut sensor = bench.sensor("--presses 1");
    let mut recording = record(&bench, "c.mcap");
    assert_eq!(sensor.exit_code(), Some(0));
    assert_eq!(recording.exit_code(), Some(69));
    let events = replay(&bench, "c.mcap");
    assert_eq!(events.iter().filter(|event| is_final(event)).count(), 1);
}

#[test]
fn killed_at_any_moment_less_than_a_second_is_lost() {
    let bench = Bench::new();
    bench.configure(&sensor("forearm", "port", 100), "");
    let _sensor = bench.sensor_at("port", 100, "");
    let mut moments = Stream::new(1, "moments of death");
    let (mut losses, mut gaps) = (Vec::new(), Vec::new());
    for round in 0..10 {
        let (out, good) = (format!("{round}.mcap"), format!("{round}.good.mcap"));
        let mut recording = record(&bench, &out);
        wait_for("the file", || {
            fs::metadata(bench.path(&out)).is_ok_and(|file| file.len() > 8_000)
        });
        std::thread::sleep(Duration::from_secs_f64(1.5 * moments.uniform()));
        let before = mono();
        recording.signal(Signal::KILL);
        recording.exit_code();
        bench.succeeds(&format!("recover {out} --out {good}"));
        let found = bench.entries(&good);
        let last = found.iter().rfind(|found| is_bytes(found)).unwrap();
        losses.push(before.saturating_sub(last.at.mono));
        // Nothing is missing in between: bytes came every 4 ms or so, and a frame would be damaged. One may be
        // at the beginning, because the sensor sends while nobody reads.
        let moments: Vec<Duration> = found.iter().map(|found| found.at.mono).collect();
        let gap = moments.windows(2).map(|two| two[1] - two[0]).max();
        gaps.push(gap.unwrap());
        let events = replay(&bench, &good);
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
    let (whole, _) = of_a_press(|_| {}, None, false);
    bench.write("a.mcap", &whole);
    let (code, _, message) = bench.run("recover a.mcap --out whole.mcap");
    assert!(code == 0 && message.contains("lost nothing"), "{message}");
    assert_eq!(replay(&bench, "whole.mcap"), replay(&bench, "a.mcap"));
    bench.write("noise.mcap", vec![7; 100_000]);
    bench.fails_each(
        "
        recover none.mcap --out good.mcap | 66 | none.mcap
        recover noise.mcap --out good.mcap | 1 | noise.mcap: not a recording
        recover noise.mcap --out whole.mcap | 74 | whole.mcap",
    );
    assert!(!bench.path("good.mcap").exists());

    // A recording that is cut off is played to its end, and ends with the same last event as raw
    // bytes. This one has lost the record that ends its chunks, of 13 bytes, and a byte before it.
    let cut = mcap::read::footer(&whole).unwrap().summary_start as usize - 14;
    bench.write("cut.mcap", &whole[..cut]);
    let (code, events, message) = bench.run("replay cut.mcap");
    assert!(code == 1 && message.contains("`hardnessd recover` saves"));
    let last = events.lines().last().unwrap();
    assert!(last.contains(r#""reason":"end of recording""#), "{last}");
    bench.succeeds("recover cut.mcap --out good.mcap");
    replay(&bench, "good.mcap");
}

#[test]
fn the_last_minute_is_written_on_request() {
    let bench = Bench::new();
    let _daemon = bench.daemon_with(RECORD);
    let _sensor = bench.sensor("--presses 2");
    let live = bench.subscriber().verdict();
    let mut control = bench.control();
    let answer = control.ask(r#"{"blackbox":"forearm","id":1}"#);
    assert_eq!(answer["type"], "ok", "{answer}");
    let events = replay(&bench, answer["blackbox"].as_str().unwrap());
    let verdict = events.iter().find(|event| is_final(event)).unwrap();
    assert_eq!(unnumbered(verdict), unnumbered(&live));
    control.is_refused(r#"{"blackbox":"wrist"}"#, "forearm");
}

#[test]
fn files_end_in_time_and_each_can_be_played_by_itself() {
    let bench = Bench::new();
    let mut daemon = bench.daemon_with(&format!("{RECORD}rotate_s = 2\n"));
    let _sensor = bench.sensor("");
    let mut subscriber = bench.subscriber();
    let mut verdicts = Vec::new();
    while bench.recordings("hardnessd-").len() < 4 {
        verdicts.push(unnumbered(&subscriber.verdict()));
    }
    daemon.end();
    let mut played: Vec<Value> = Vec::new();
    for recording in bench.recordings("hardnessd-") {
        let events = replay(&bench, &recording);
        played.extend(
            events
                .iter()
                .filter(|event| is_final(event))
                .map(unnumbered),
        );
    }
    for live in &verdicts {
        let mut same = played
            .iter()
            .filter(|event| event["press"] == live["press"]);
        assert!(same.clone().count() > 0, "{live} is in no file");
        assert!(same.all(|event| event == live));
    }
}

#[test]
fn a_recording_that_is_deleted_begins_anew() {
    let bench = Bench::new();
    let mut daemon = bench.daemon_with(RECORD);
    let _sensor = bench.sensor("");
    let mut subscriber = bench.subscriber();
    subscriber.verdict();
    let is_there = || !bench.recordings("hardnessd-").is_empty();
    wait_for("the recording", is_there);
    fs::remove_dir_all(bench.path("rec")).unwrap();
    wait_for("the next recording", is_there);
    subscriber.verdict();
    daemon.end();
    let recordings = bench.recordings("hardnessd-");
    assert_eq!(recordings.len(), 1, "{recordings:?}");
    assert!(replay(&bench, &recordings[0]).iter().any(is_final));
}

#[test]
fn a_disk_that_is_full_or_fails_does_not_stop_the_sensor() {
    // With too little free space, recording stops with one message, and nothing is written.
    let bench = Bench::new();
    let record = "[record]\ndir = \"rec\"\nkeep_free_mb = 1000000000\n";
    let mut daemon = bench.daemon_with(record);
    let mut sensor = bench.sensor("--presses 1");
    bench.subscriber().verdict();
    bench
        .control()
        .is_refused(r#"{"blackbox":"forearm"}"#, "keep_free_mb");
    assert_eq!(sensor.exit_code(), Some(0));
    let log = daemon.end();
    assert_eq!(log.matches("recording stopped").count(), 1, "{log}");
    assert_eq!(bench.recordings(""), Vec::<String>::new());
}
