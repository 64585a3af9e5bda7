//! Several sensors, and a reload that changes one of them.

use serde_json::{Value, json};

use crate::bench::{Bench, RECORD, events, sensor};

/// The number of frames of a sensor, by a connection of its own: this begins with the statuses.
fn frames(bench: &Bench, sensor: &str) -> Option<u64> {
    bench.subscriber().status(sensor)["frames"].as_u64()
}

#[test]
fn a_sensor_whose_table_changed_begins_anew_and_its_numbers_go_on() {
    let bench = Bench::new();
    let _plays = ["wrist", "palm"].map(|name| bench.sensor_at(name, 20, ""));
    let tables = |fps, other| sensor("wrist", "wrist", fps) + &sensor(other, "palm", 20);
    let mut daemon = bench.daemon_of(&tables(20, "palm"), RECORD);
    let mut subscriber = bench.subscriber();
    let mut press = |state: Option<&str>| {
        let mut wanted = json!({"type": "press", "sensor": "wrist"});
        if let Some(state) = state {
            wanted["state"] = state.into();
        }
        subscriber.until(&wanted)
    };
    let begun = press(Some("begin"));
    let before = [frames(&bench, "wrist"), frames(&bench, "palm")];
    bench.configure(&tables(19, "palm"), RECORD);
    daemon.reload("reloaded");
    let is_stop = |line: &&String| line.contains("stopped");
    let stops: Vec<&String> = daemon.log.seen.iter().filter(is_stop).collect();
    assert!(stops.len() == 1 && stops[0].contains("wrist"), "{stops:?}");
    let end = press(None);
    assert_eq!(end["press"], begun["press"]);
    assert_eq!(end["reason"], "shutdown");
    // The changed sensor takes a tare again, and counts on.
    let next = press(Some("begin"));
    let number = |event: &Value| event["press"].as_u64().unwrap();
    assert_eq!(number(&next), number(&begun) + 1);
    assert!(next["frame"].as_u64() > begun["frame"].as_u64(), "{next}");
    assert!(frames(&bench, "wrist") > before[0] && frames(&bench, "palm") > before[1]);

    // The sensors themselves stay the same.
    bench.configure(&tables(19, "elbow"), RECORD);
    let line = daemon.reload("refused");
    assert!(line.contains("sensor.name has changed"), "{line}");

    // One recording has it all, and a replay gives the same presses.
    subscriber.until(&json!({"type": "hardness", "sensor": "wrist", "press": next["press"]}));
    daemon.end();
    let files = bench.recordings("hardnessd-");
    assert_eq!(files.len(), 1, "{files:?}");
    let replayed = events(&bench.succeeds(&format!("replay {}", files[0])));
    for live in [&begun, &end, &next] {
        let keys = ["type", "sensor", "press", "state", "frame", "time"];
        let same = |event: &Value| keys.iter().all(|key| event[*key] == live[*key]);
        assert!(replayed.iter().any(same), "{live} in the replay");
    }
}
