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

/// A daemon with a sensor on a cable, which is live and tared.
struct Rig {
    bench: Bench,
    _daemon: Daemon,
    cable: Cable,
    subscriber: Subscriber,
}

impl Rig {
    fn start() -> Self {
        let bench = Bench::new();
        let cable = Cable::plug(bench.path("port"));
        let keys = "baud = 1000000\nstale_after_ms = 300\n";
        let daemon = bench.daemon_of(&(sensor("forearm", "port", 100) + keys), "");
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
        assert_eq!(end["press"], press);
        assert_eq!(end["reason"], Value::Null);
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
        assert_eq!(aborted["press"], press);
        assert_eq!(aborted["reason"], "lost");
        assert_eq!(aborted["frames"], 5);
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
        let more = |key| after[key].as_u64().unwrap() - before[key].as_u64().unwrap();
        assert_eq!((more("frames"), more("bytes_skipped")), (frames, skipped));
        before = after;
    }
    assert_eq!(rig.release(1)["frames"], 7);
}
