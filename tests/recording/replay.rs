//! Recorded bytes give exactly the expected events, at any pace.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::bench::{events, hardnessd};
use hardnessd_core::test_support::of_a_press;
use serde_json::Value;

fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures")
}

/// Every recording, with the configuration for its rate and its golden events.
fn recordings() -> Vec<(PathBuf, PathBuf, PathBuf)> {
    let mut found: Vec<_> = std::fs::read_dir(fixtures())
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "bin"))
        .map(|path| {
            let rate = Path::new(path.file_stem().unwrap()).extension().unwrap();
            let config = fixtures().join(rate).with_extension("toml");
            let golden = path.with_extension("jsonl");
            (path, config, golden)
        })
        .collect();
    found.sort();
    found
}

fn replay(recording: &Path, more: &[&str]) -> String {
    let output = hardnessd(&[&["replay", recording.to_str().unwrap()], more].concat());
    assert!(output.status.success(), "{recording:?}: {output:?}");
    String::from_utf8(output.stdout).unwrap()
}

fn simulate(to: &Path, more: &[&str]) {
    let output = hardnessd(&[&["simulate", "--to", to.to_str().unwrap()], more].concat());
    assert!(output.status.success(), "{to:?}: {output:?}");
}

/// Asserts that events are equal, except for probabilities, which may differ by 1e-4 between
/// machines.
fn assert_same(found: &str, golden: &str, recording: &Path) {
    let (mut found, mut golden) = (events(found), events(golden));
    assert_eq!(found.len(), golden.len(), "{recording:?}");
    for (found, golden) in found.iter_mut().zip(&mut golden) {
        for key in ["probabilities", "confidence"] {
            let numbers = |event: &mut Value| -> Vec<f64> {
                match event.as_object_mut().unwrap().remove(key) {
                    Some(Value::Array(numbers)) => numbers
                        .iter()
                        .map(|number| number.as_f64().unwrap())
                        .collect(),
                    Some(number) => vec![number.as_f64().unwrap()],
                    None => vec![],
                }
            };
            let (found, golden) = (numbers(found), numbers(golden));
            assert_eq!(found.len(), golden.len());
            for (found, golden) in found.iter().zip(golden) {
                assert!(
                    (found - golden).abs() <= 1e-4,
                    "{recording:?}: {found} for {golden}"
                );
            }
        }
        assert_eq!(found, golden, "{recording:?}");
    }
}

#[test]
fn recordings_give_their_golden_events_twice_the_same() {
    let recordings = recordings();
    assert!(
        recordings.len() >= 13,
        "found {} recordings",
        recordings.len()
    );
    for (recording, config, golden) in recordings {
        let config = config.to_str().unwrap();
        let events = replay(&recording, &["--config", config]);
        assert_eq!(
            events,
            replay(&recording, &["--config", config]),
            "{recording:?}"
        );
        assert_same(
            &events,
            &std::fs::read_to_string(golden).unwrap(),
            &recording,
        );
    }
}

#[test]
fn what_a_file_holds_its_first_bytes_say_and_not_its_name() {
    let directory = tempfile::tempdir().unwrap();
    let raw = std::fs::read(fixtures().join("foam.5hz.bin")).unwrap();
    let (recording, _) = of_a_press(|_| {}, None, true);
    for (bytes, usual, others) in [
        (recording, "press.mcap", ["take1", "take1.bin"]),
        (raw, "foam.bin", ["foam", "foam.mcap"]),
    ] {
        let config = fixtures().join("5hz.toml");
        let events = |name: &str| {
            let path = directory.path().join(name);
            std::fs::write(&path, &bytes).unwrap();
            replay(&path, &["--config", config.to_str().unwrap()])
        };
        let expected = events(usual);
        assert!(expected.contains("\"hardness\""), "{expected}");
        for name in others {
            assert_eq!(events(name), expected, "{name}");
        }
    }
}

#[test]
fn bytes_without_a_whole_frame_are_said_to_have_none() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("other.bin");
    let mut frame = std::fs::read(fixtures().join("foam.5hz.bin")).unwrap();
    // One frame has a damaged byte.
    frame.truncate(790);
    frame[400] ^= 1;
    let text = "no frame ".repeat(100).into_bytes();
    for (bytes, found) in [
        (vec![0], "no whole frame in 1 bytes (0 damaged)"),
        (text, "no whole frame in 900 bytes (0 damaged)"),
        (frame, "no whole frame in 790 bytes (1 damaged)"),
    ] {
        std::fs::write(&path, bytes).unwrap();
        let output = hardnessd(&["replay", path.to_str().unwrap()]);
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{stderr}");
        assert_eq!(stderr.lines().count(), 1, "{stderr}");
        for part in ["other.bin", found, "hardnessd sniff"] {
            assert!(stderr.contains(part), "{part:?} not in {stderr}");
        }
        // The last status with the totals comes nevertheless.
        let events = String::from_utf8(output.stdout).unwrap();
        assert!(
            events.contains("\"reason\":\"end of recording\""),
            "{events}"
        );
    }
}

#[test]
fn the_pace_of_a_replay_does_not_show() {
    let recording = fixtures().join("flip.5hz.bin");
    assert_eq!(
        replay(&recording, &[]),
        replay(&recording, &["--speed", "50"])
    );
}

#[test]
fn a_frame_comes_no_earlier_than_its_time_however_long_frames_are() {
    let directory = tempfile::tempdir().unwrap();
    for preset in ["ascii", "csv", "zero-run", "jx255n", "jq-glove", "m1616"] {
        let path = |extension| directory.path().join(preset).with_extension(extension);
        simulate(&path("bin"), &["--presses", "1", "--preset", preset]);
        let config =
            format!("[[sensor]]\nport = \"none\"\n[sensor.frame]\npreset = \"{preset}\"\n");
        std::fs::write(path("toml"), config).unwrap();
        let config = path("toml");
        let start = Instant::now();
        let more = ["--config", config.to_str().unwrap(), "--speed", "10"];
        let events = replay(&path("bin"), &more);
        let took = start.elapsed();
        let last = events.lines().last().unwrap();
        let frames = serde_json::from_str::<Value>(last).unwrap()["frames"].clone();
        let frames = frames.as_f64().unwrap();
        assert!(frames > 10.0, "{events}");
        // The replay runs ten times as fast as 5 frames/s.
        let least = Duration::from_secs_f64((frames - 1.0) / 50.0);
        assert!(took >= least, "{preset}: {took:?} for {frames} frames");
    }
}

/// Lines of a sketch that prints 12 bits of 12x8 taxels, at 20 frames/s: 2 s of rest and three presses, with
/// noise of up to four counts.
fn noisy_counts(most: f32) -> String {
    let mut lines = String::new();
    let (mut noise, rest) = (1_u32, 40);
    for frame in 0..rest + 3 * 40 {
        let press = (frame as f32 - rest as f32) / 40.0;
        let (row, col) = [(3.0, 2.0), (8.0, 5.0), (5.0, 4.0)][press.max(0.0) as usize];
        let depth = (std::f32::consts::PI * press.max(0.0).fract()).sin() - 0.2;
        let taxel = |place: usize| {
            let (down, along) = ((place / 8) as f32 - row, (place % 8) as f32 - col);
            let load = most * depth.max(0.0) * (-(down * down + along * along) / 4.0).exp();
            noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (60 + (noise >> 24) % 5 + load as u32).to_string()
        };
        lines += &(0..96).map(taxel).collect::<Vec<_>>().join(",");
        lines += "\n";
    }
    lines
}

/// Asserts that three presses are found with what `sniff` writes for noisy counts up to `most`, and none
/// without its part from `table` on, which has `line`.
fn assert_noise_is_no_touch(most: f32, table: &str, line: &str) {
    let directory = tempfile::tempdir().unwrap();
    let (bytes, config) = (
        directory.path().join("s.bin"),
        directory.path().join("s.toml"),
    );
    std::fs::write(&bytes, noisy_counts(most)).unwrap();
    let [from, to] = [&bytes, &config].map(|path| path.to_str().unwrap());
    let sniffed = hardnessd(&["sniff", from, "--out", to]);
    assert!(sniffed.status.success(), "{sniffed:?}");
    let written = std::fs::read_to_string(&config).unwrap();
    assert!(written.contains(line), "{written}");
    let replayed = |config: &str| {
        std::fs::write(directory.path().join("rate.toml"), config).unwrap();
        let at = directory.path().join("rate.toml");
        replay(&bytes, &["--config", at.to_str().unwrap()])
    };
    let at_rate = written.replace("# frame_rate_hz = 5.0", "frame_rate_hz = 20.0");
    let events = replayed(&at_rate);
    assert_eq!(events.matches("\"state\":\"end\"").count(), 3, "{events}");
    // The defaults take the noise for a touch, so there is no zero and no press.
    let without = at_rate.split(table).next().unwrap();
    assert!(!replayed(without).contains("\"state\":\"end\""));
}

#[test]
fn what_sniff_writes_takes_noise_for_no_touch() {
    let newtons = "\nnewtons_per_count = 0.00249  # a guess";
    assert_noise_is_no_touch(3000.0, "\n[sensor.calibration]", newtons);
    let threshold = "\ncontact_threshold_n = 0.180  # noise of 3 counts at rest is no touch\n";
    assert_noise_is_no_touch(150.0, "\n[press]", threshold);
}

/// What came of the presses of a recording.
#[derive(Debug, Default, PartialEq)]
struct Outcome {
    /// The level of each press that ended by its release.
    released: Vec<u64>,
    /// The number of presses that ended by `max_seconds`.
    timed_out: usize,
}

/// Replays a recording with or without `auto_tare`.
fn outcome(recording: &Path, auto_tare: bool) -> Outcome {
    let config = recording.with_extension("toml");
    let text = format!(
        "[[sensor]]\nname = \"forearm\"\nport = \"none\"\n\
         [sensor.calibration]\nauto_tare = {auto_tare}\n[model]\nbuilt_in = \"hrn\"\n"
    );
    std::fs::write(&config, text).unwrap();
    let replayed = replay(recording, &["--config", config.to_str().unwrap()]);
    let mut outcome = Outcome::default();
    let mut is_released = false;
    for event in events(&replayed) {
        if event["state"] == "end" {
            is_released = event["reason"].is_null();
            outcome.timed_out += usize::from(event["reason"] == "timeout");
        }
        if event["phase"] == "final" && is_released {
            outcome.released.push(event["level"].as_u64().unwrap());
        }
    }
    outcome
}

/// The figures are in `docs/operator.md`, "Slow drift".
#[test]
fn with_auto_tare_an_hour_of_drift_costs_no_press() {
    let directory = tempfile::tempdir().unwrap();
    let script = directory.path().join("drift.toml");
    let drift = "[[fault]]\nat_s = 0.0\nkind = \"drift\"\nnewtons_per_hour = 0.5\n";
    std::fs::write(&script, drift).unwrap();
    let simulated = |name: &str, more: &[&str]| {
        let path = directory.path().join(name);
        let presses = ["--presses", "60", "--rest", "60"];
        simulate(&path, &[&presses, more].concat());
        path
    };
    let steady = simulated("steady.bin", &[]);
    let drifting = simulated("drift.bin", &["--faults", script.to_str().unwrap()]);
    let frames = std::fs::metadata(&drifting).unwrap().len() / 790;
    assert!(frames > 5 * 3600, "more than an hour: {frames} frames");

    let presses = |outcome: &Outcome| (outcome.released.len(), outcome.timed_out);
    let without_drift = outcome(&steady, false);
    assert_eq!(presses(&without_drift), (60, 0));
    assert_eq!(outcome(&steady, true), without_drift);
    // Once the drift is above the contact threshold, it is a press that never ends.
    let fixed = outcome(&drifting, false);
    assert_eq!(presses(&fixed), (6, 1), "{fixed:?}");
    let following = outcome(&drifting, true);
    assert_eq!(presses(&following), (60, 0), "{following:?}");
    let levels = following.released.iter().zip(&without_drift.released);
    let same = levels.filter(|(with, without)| with == without).count();
    println!("{same} of 60 levels are those without drift");
    assert!(same >= 56, "{following:?} {without_drift:?}");
}

#[test]
fn the_shore_hardness_is_in_the_range_of_the_level() {
    let directory = tempfile::tempdir().unwrap();
    let recording = directory.path().join("presses.bin");
    simulate(&recording, &["--presses", "40", "--fps", "5"]);
    let config = directory.path().join("hardnessd.toml");
    for model in ["hrn", "course"] {
        let text = format!(
            "[[sensor]]\nname = \"forearm\"\nport = \"p\"\n[model]\nbuilt_in = \"{model}\"\n"
        );
        std::fs::write(&config, text).unwrap();
        let mut events = events(&replay(&recording, &["--config", config.to_str().unwrap()]));
        events.retain(|event| event["type"] == "hardness");
        let mut verdicts = 0;
        for event in events {
            let probabilities = event["probabilities"].as_array().unwrap();
            let probability = |place: &usize| probabilities[*place].as_f64().unwrap();
            let place = (0..4).max_by(|a, b| probability(a).total_cmp(&probability(b)));
            let least = [70.0, 60.0, 50.0, 0.0][place.unwrap()];
            let most = [100.0, 71.0, 61.0, 51.0][place.unwrap()];
            let value = event["shore"]["value"].as_f64().unwrap();
            assert!((least..=most).contains(&value), "{model}: {event}");
            verdicts += 1;
        }
        assert!(verdicts >= 40, "{model}: {verdicts}");
    }
}
