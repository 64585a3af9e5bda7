//! The sensor's own presses: what verdicts they help, and what they ask of the robot.

use crate::bench::{Bench, sensor};
use serde_json::Value;

/// The final verdicts of 20 presses, of a sensor with these keys.
fn finals(keys: &str) -> Vec<Value> {
    let bench = Bench::new();
    bench.write("hardnessd.toml", sensor("forearm", "port", 20) + keys);
    bench.succeeds("simulate --fps 20 --presses 20 --seed 3 --to mixed.bin");
    bench.finals("--config hardnessd.toml mixed.bin")
}

#[test]
fn own_presses_serve_from_the_seventh_press_on_and_a_light_press_before_names_no_level() {
    let with = finals("");
    for (number, event) in (1..).zip(&with) {
        let is_new = number < 7;
        let expected = if is_new { "none" } else { "own" };
        assert_eq!(event["references"], expected, "{event}");
        let notes = event["notes"].as_array().unwrap();
        assert_eq!(notes.contains(&"not_identified".into()), is_new, "{event}");
        let is_light = is_new && event["force_n"].as_f64() < Some(5.0);
        assert_eq!(event["advice"] == "press_harder", is_light, "{event}");
        assert!(!is_light || event["level"].is_null() && event["rejected"] == "low_force");
        if event["advice"] == "press_again" {
            assert!(event["confidence"].as_f64() < Some(0.7), "{event}");
        }
    }
    let without = finals("own_presses = 0\n");
    for (number, (with, without)) in (1..).zip(with.iter().zip(&without)) {
        assert_eq!(without["references"], "none");
        let is_same = with["probabilities"] == without["probabilities"];
        assert_eq!(is_same, number < 7, "press {number}");
    }
}
