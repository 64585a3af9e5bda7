//! The sensor's own presses: what verdicts they help, and what they ask of the robot.

use std::fs;
use std::process::Command;

use crate::bench::{BINARY, Bench, events, ran};
use serde_json::{Value, json};

/// The final verdicts of 20 presses, of a sensor with these keys.
fn finals(keys: &str) -> Vec<Value> {
    let bench = Bench::new();
    let sensor = "[[sensor]]\nname = \"forearm\"\nport = \"port\"\nframe_rate_hz = 20.0\n";
    fs::write(bench.path("hardnessd.toml"), format!("{sensor}{keys}")).unwrap();
    let run = |arguments: &str| {
        let (code, printed, message) = ran(Command::new(BINARY)
            .args(arguments.split_whitespace())
            .current_dir(bench.path(".")));
        assert_eq!(code, 0, "{arguments}: {message}");
        printed
    };
    run("simulate --fps 20 --presses 20 --seed 3 --to mixed.bin");
    let mut events = events(&run("replay --json --config hardnessd.toml mixed.bin"));
    events.retain(|event| event["phase"] == "final");
    events
}

#[test]
fn own_presses_serve_from_the_seventh_press_on_and_a_light_press_before_names_no_level() {
    let with = finals("");
    let references: Vec<&Value> = with.iter().map(|event| &event["references"]).collect();
    assert!(
        references[..6].iter().all(|kinds| *kinds == "none"),
        "{references:?}"
    );
    assert!(
        references[6..].iter().all(|kinds| *kinds == "own"),
        "{references:?}"
    );
    let is_new = |event: &&Value| event["references"] == "own";
    let not_identified = json!("not_identified");
    for event in &with {
        let notes = event["notes"].as_array().unwrap();
        assert_ne!(notes.contains(&not_identified), is_new(&event), "{event}");
        let is_light = !is_new(&event) && event["force_n"].as_f64().unwrap() < 5.0;
        assert_eq!(event["advice"] == "press_harder", is_light, "{event}");
        assert!(!is_light || event["level"].is_null() && event["rejected"] == "low_force");
        if event["advice"] == "press_again" {
            assert!(event["confidence"].as_f64().unwrap() < 0.7, "{event}");
        }
    }
    let without = finals("own_presses = 0\n");
    assert!(without.iter().all(|event| event["references"] == "none"));
    let differ = |(a, b): (&Value, &Value)| a["probabilities"] != b["probabilities"];
    assert!(with.iter().zip(&without).take(6).all(|pair| !differ(pair)));
    assert!(with.iter().zip(&without).skip(6).all(differ));
}
