//! Recorded bytes give exactly the expected events, at any pace.

use std::path::{Path, PathBuf};

use crate::bench::{events, hardnessd, run};
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
        recordings.len() >= 11,
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
fn bytes_without_a_whole_frame_are_said_to_have_none() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("other.bin");
    let mut frame = std::fs::read(fixtures().join("foam.5hz.bin")).unwrap();
    // One frame has a damaged byte.
    frame.truncate(790);
    frame[400] ^= 1;
    std::fs::write(&path, frame).unwrap();
    let (code, events, message) = run(&["replay", path.to_str().unwrap()]);
    assert_eq!((code, message.lines().count()), (1, 1), "{message}");
    let found = "other.bin: no whole frame in 790 bytes (1 damaged)";
    assert!(
        message.contains(found) && message.contains("hardnessd sniff"),
        "{message}"
    );
    // The last status with the totals comes nevertheless.
    let end = "\"reason\":\"end of recording\"";
    assert!(events.contains(end), "{events}");
}

#[test]
fn the_pace_of_a_replay_does_not_show() {
    let recording = fixtures().join("flip.5hz.bin");
    assert_eq!(
        replay(&recording, &[]),
        replay(&recording, &["--speed", "50"])
    );
}
