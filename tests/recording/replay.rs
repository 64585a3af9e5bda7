//! Recorded bytes give exactly the expected events, at any pace.

use std::fs;
use std::path::Path;

use crate::bench::{Bench, events, run};
use serde_json::Value;

/// Takes the probabilities out of an event.
fn probabilities(event: &mut Value) -> Vec<f64> {
    let event = event.as_object_mut().unwrap();
    let taken = ["probabilities", "confidence"].map(|key| event.remove(key).unwrap_or_default());
    let [Value::Array(numbers), confidence] = taken else {
        return Vec::new();
    };
    let numbers = numbers.iter().chain([&confidence]);
    numbers.map(|number| number.as_f64().unwrap()).collect()
}

/// Asserts that events are equal, except for probabilities, which may differ by 1e-4 between
/// machines.
fn assert_same(found: &str, golden: &str, recording: &str) {
    let (found, golden) = (events(found), events(golden));
    assert_eq!(found.len(), golden.len(), "{recording}");
    for (mut found, mut golden) in found.into_iter().zip(golden) {
        let numbers = [&mut found, &mut golden].map(probabilities);
        let [here, there] = &numbers;
        let is_near = here.iter().zip(there).all(|(a, b)| (a - b).abs() <= 1e-4);
        assert!(
            is_near && here.len() == there.len(),
            "{recording}: {numbers:?}"
        );
        assert_eq!(found, golden, "{recording}");
    }
}

#[test]
fn recordings_give_their_golden_events_whatever_the_speed() {
    let mut count = 0;
    for entry in fs::read_dir("fixtures").unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_none_or(|extension| extension != "bin") {
            continue;
        }
        count += 1;
        let recording = path.to_str().unwrap();
        let rate = Path::new(path.file_stem().unwrap()).extension().unwrap();
        let line = format!(
            "replay {recording} --config fixtures/{}.toml",
            rate.display()
        );
        let (code, events, errors) = run(&line);
        assert_eq!(code, 0, "{errors}");
        let (_, faster, _) = run(&format!("{line} --speed 1000"));
        assert_eq!(events, faster, "{recording}");
        let golden = fs::read_to_string(path.with_extension("jsonl")).unwrap();
        assert_same(&events, &golden, recording);
    }
    assert!(count >= 11, "found {count} recordings");
}

#[test]
fn bytes_without_a_whole_frame_are_said_to_have_none() {
    let bench = Bench::new();
    // One frame has a damaged byte.
    let mut frame = crate::bench::frame(0.0);
    frame[400] ^= 1;
    bench.write("other.bin", frame);
    let (code, events, message) = bench.run("replay other.bin");
    assert_eq!((code, message.lines().count()), (1, 1), "{message}");
    for part in [
        "other.bin: no whole frame in 790 bytes (1 damaged)",
        "hardnessd sniff",
    ] {
        assert!(message.contains(part), "{message}");
    }
    // The last status with the totals comes nevertheless.
    let end = "\"reason\":\"end of recording\"";
    assert!(events.contains(end), "{events}");
}
