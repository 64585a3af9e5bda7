//! Faults of a sensor and its cable, with the real binary on a real pty: what subscribers see, and
//! when. `docs/reliability.md` has the same as a table.
//!
//! The test writes every byte of the sensor, so no fault depends on how busy the machine is.

use std::fs;
use std::time::{Duration, SystemTime};

use crate::bench::pair::Pair;
use crate::bench::{Bench, Cable, Daemon, Subscriber, frame, sensor, wait_for};
use rustix::fs::{FlockOperation, flock};
use serde_json::{Value, json};

/// The counts of a press.
const PRESSED: f32 = 20.0;

/// The table of a sensor whose cable a test holds.
fn cabled(name: &str, port: &str, stale_after_ms: u32) -> String {
    let keys = format!("baud = 1000000\nstale_after_ms = {stale_after_ms}\n");
    sensor(name, port, 100) + &keys
}

/// A daemon with a sensor on a cable, which is live and tared.
struct Rig {
    bench: Bench,
    _daemon: Daemon,
    cable: Cable,
    subscriber: Subscriber,
}

impl Rig {
    fn start() -> Self {
        Self::beside("")
    }

    /// A rig whose configuration has other sensors too.
    fn beside(sensors: &str) -> Self {
        let bench = Bench::new();
        let cable = Cable::plug(bench.path("port"));
        let daemon = bench.daemon_of(&(cabled("forearm", "port", 300) + sensors), "");
        let mut subscriber = bench.subscriber();
        subscriber.state("stale");
        let mut rig = Self {
            bench,
            _daemon: daemon,
            cable,
            subscriber,
        };
        rig.wake();
        rig.cable.play(0.0, 8);
        rig.sees(&json!({"state": "live", "reason": null}));
        rig
    }

    fn wake(&self) {
        self.cable.wake(&self.bench, "forearm");
    }

    fn sees(&mut self, fields: &Value) -> Value {
        self.subscriber.until(fields)
    }

    fn status(&mut self) -> Value {
        self.subscriber.status("forearm")
    }

    /// The status once no frame comes any more, which says that all were read.
    fn at_rest(&mut self) -> Value {
        self.subscriber.state("stale");
        self.status()
    }

    /// Ends the press under way, and checks that it is number `press` and has a verdict.
    fn release(&mut self, press: u64) -> Value {
        self.cable.play(0.0, 4);
        let end = self.subscriber.press("end");
        assert_eq!(
            (&end["press"], &end["reason"]),
            (&json!(press), &Value::Null)
        );
        assert_eq!(self.subscriber.verdict()["press"], press);
        end
    }

    /// Makes a press, and checks that it is number `press`.
    fn press(&mut self, press: u64) {
        self.cable.play(PRESSED, 10);
        assert_eq!(self.subscriber.press("begin")["press"], press);
        self.release(press);
    }
}

/// How much `key` grew from one status to another.
fn growth(before: &Value, after: &Value, key: &str) -> u64 {
    after[key].as_u64().unwrap() - before[key].as_u64().unwrap()
}

fn since(moment: SystemTime, event: &Value) -> Duration {
    let time: jiff::Timestamp = event["time"].as_str().unwrap().parse().unwrap();
    SystemTime::from(time)
        .duration_since(moment)
        .unwrap_or_default()
}

#[test]
fn unplugged_after_any_byte_of_a_frame_a_press_is_aborted_and_no_frame_is_made_up() {
    let mut rig = Rig::start();
    let mut shortest = Duration::MAX;
    let mut skipped = 0;
    for (press, byte) in (1..).zip([0, 1, 2, 4, 395, 788, 789]) {
        let frames = rig.at_rest()["frames"].as_u64().unwrap();
        rig.cable.play(PRESSED, 5);
        wait_for("five frames", || rig.status()["frames"] == frames + 5);
        rig.cable.write(&frame(PRESSED)[..byte]);
        let unplugged = rig.cable.unplug();
        let lost = rig.subscriber.state("lost");
        let aborted = rig.subscriber.press("aborted");
        assert_eq!(
            (&aborted["press"], &aborted["reason"], &aborted["frames"]),
            (&json!(press), &json!("lost"), &json!(5))
        );
        assert_eq!(lost["frames"], frames + 5, "byte {byte}");
        assert_eq!(lost["frames_damaged"], 0, "byte {byte}");
        // The kernel drops what nobody had read when the cable went.
        let now = lost["bytes_skipped"].as_u64().unwrap();
        assert!(
            (skipped..=skipped + byte as u64).contains(&now),
            "byte {byte}: {skipped}, {now}"
        );
        skipped = now;
        shortest = shortest.min(since(unplugged, &lost));
        rig.cable.replug();
        rig.wake();
    }
    assert!(skipped > 0);
    assert!(shortest < Duration::from_millis(100), "{shortest:?}");
}

#[test]
fn plugged_in_elsewhere_behind_its_link_a_sensor_is_read_on_within_its_pause() {
    let mut rig = Rig::start();
    rig.press(1);
    let mut shortest = Duration::MAX;
    for press in 2..5 {
        let before = fs::read_link(&rig.cable.link).unwrap();
        let replugged = SystemTime::now();
        rig.cable.replug();
        assert_ne!(fs::read_link(&rig.cable.link).unwrap(), before);
        rig.subscriber.state("lost");
        rig.wake();
        let live = rig.subscriber.state("live");
        shortest = shortest.min(since(replugged, &live));
        rig.press(press);
    }
    // The first pause between two tries to open the port is 50 ms.
    assert!(shortest < Duration::from_millis(500), "{shortest:?}");
    // After a long time without the port, the pause is 2 s.
    rig.cable.unplug();
    std::thread::sleep(Duration::from_secs(4));
    let replugged = SystemTime::now();
    rig.cable.replug();
    rig.wake();
    let live = rig.subscriber.state("live");
    let away = since(replugged, &live);
    assert!(away < Duration::from_millis(2500), "{away:?}");
    rig.press(5);
}

#[test]
fn a_lost_sensor_says_what_keeps_it_from_being_live_now() {
    let mut rig = Rig::start();
    let lost = |reason: &str| json!({"type": "status", "state": "lost", "reason": reason});
    rig.cable.unplug();
    rig.sees(&lost("no such device"));
    let held = Pair::raw().unwrap();
    let device = held.device.try_clone().unwrap();
    flock(&device, FlockOperation::LockExclusive).unwrap();
    rig.cable.replug_at(held);
    rig.sees(&lost("port held by another process"));
    flock(&device, FlockOperation::Unlock).unwrap();
    rig.sees(&lost("no frame for 25 ms"));
    rig.wake();
    rig.subscriber.state("live");
}

#[test]
fn half_a_frame_and_silence_are_stale_and_its_other_half_makes_it_whole() {
    let mut rig = Rig::start();
    let whole = frame(PRESSED);
    let (head, tail) = whole.split_at(395);
    let mut before = rig.at_rest();
    rig.cable.write(&whole.repeat(5));
    // Without its other half, the half frame is skipped.
    for (rest, frames, skipped) in [(tail, 6, 0), (&whole, 1, 395)] {
        rig.cable.write(head);
        let stale = rig.subscriber.state("stale");
        assert_eq!(stale["reason"], "no frame for 300 ms");
        rig.cable.write(rest);
        rig.subscriber.state("live");
        let after = rig.status();
        let more = |key| growth(&before, &after, key);
        assert_eq!((more("frames"), more("bytes_skipped")), (frames, skipped));
        before = after;
    }
    assert_eq!(rig.release(1)["frames"], 7);
}

#[test]
fn a_lost_sensor_disturbs_no_other() {
    let mut rig = Rig::beside(&cabled("wrist", "port-2", 60_000));
    let wrist = Cable::plug(rig.bench.path("port-2"));
    wrist.wake(&rig.bench, "wrist");
    wrist.play(0.0, 8);
    rig.sees(&json!({"type": "status", "state": "live", "sensor": "wrist"}));
    let types = r#"{"subscribe":["status","press","hardness","frame"]}"#;
    assert_eq!(rig.subscriber.ask(types)["type"], "ok");
    rig.cable.play(PRESSED, 5);
    rig.subscriber.press("begin");
    rig.cable.unplug();
    for _ in 0..2 {
        wrist.play(PRESSED, 10);
        wrist.play(0.0, 4);
    }
    let (mut latest, mut finals) = (None, 0);
    while finals < 2 {
        let event = rig.subscriber.next().unwrap();
        if event["sensor"] == "forearm" {
            // What came before the loss, the rest of the press, and why the sensor stays lost.
            let is_loss = event["type"] == "press" && event["reason"] == "lost"
                || event["type"] == "status" && event["state"] != "live";
            assert!(is_loss || event["type"] == "frame", "{event}");
            continue;
        }
        assert_eq!(event["sensor"], "wrist", "{event}");
        match event["type"].as_str().unwrap() {
            "frame" => {
                let number = event["frame"].as_u64().unwrap();
                assert!(latest.is_none_or(|last| number == last + 1), "{event}");
                latest = Some(number);
            }
            "hardness" => finals += u32::from(event["phase"] == "final"),
            "press" => {}
            other => panic!("a {other} of the wrist: {event}"),
        }
    }
}
