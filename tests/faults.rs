//! Faults of a sensor and its cable, with the real binary on a real pty: what subscribers see, and
//! when. `docs/reliability.md` has the same as a table.
#![allow(
    clippy::unwrap_used,
    reason = "clippy knows no helper of a test as a test"
)]

mod bench;
#[path = "../src/tools/pty/pair.rs"]
mod pair;

use std::fs;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use bench::{Bench, Daemon, Subscriber, hardnessd, wait_for};
use hardnessd::frame::{RawFrame, Stamp};
use hardnessd::pipeline::{Clock, Pipeline};
use hardnessd::random::Stream;
use hardnessd::sensor::{Description, Sensor};
use hardnessd::verdict::{BUILT_IN, Hrn};
use hardnessd::wire::{Layout, Settings};
use pair::Pair;
use rustix::process::Signal;
use rustix::termios::OptionalActions;
use serde_json::{Value, json};

/// The time between two frames.
const PERIOD: Duration = Duration::from_millis(10);

fn rest() -> RawFrame {
    RawFrame::default()
}

/// A frame with 36 loaded taxels in the middle of the array.
fn pressed() -> RawFrame {
    let mut raw = rest();
    for row in 11..17 {
        raw.counts[row * 28 + 11..row * 28 + 17].fill(20);
    }
    raw
}

/// The sensor's end of a cable. The test writes every byte on it.
struct Cable {
    pair: Option<Pair>,
    link: PathBuf,
    layout: Layout,
}

impl Cable {
    fn plug(link: PathBuf) -> Self {
        let layout = Layout::new(&Settings::default()).unwrap();
        let mut cable = Self {
            pair: None,
            link,
            layout,
        };
        cable.replug();
        cable
    }

    /// Puts a new port behind the link. The old port, if there is one, is closed after that.
    fn replug(&mut self) {
        let pair = Pair::open().unwrap();
        // A new tty echoes and edits lines, so make it raw.
        let mut settings = rustix::termios::tcgetattr(&pair.device).unwrap();
        settings.make_raw();
        rustix::termios::tcsetattr(&pair.device, OptionalActions::Now, &settings).unwrap();
        let born = self.link.with_extension("new");
        std::os::unix::fs::symlink(&pair.path, &born).unwrap();
        fs::rename(&born, &self.link).unwrap();
        self.pair = Some(pair);
    }

    /// Pulls the cable and returns the time.
    fn unplug(&mut self) -> SystemTime {
        self.drain();
        let now = SystemTime::now();
        fs::remove_file(&self.link).unwrap();
        self.pair = None;
        now
    }

    fn bytes(&self, raw: &RawFrame) -> Vec<u8> {
        let mut bytes = Vec::new();
        self.layout.encode(raw, &mut bytes);
        bytes
    }

    fn write(&self, mut bytes: &[u8]) {
        let master = &self.pair.as_ref().unwrap().master;
        while !bytes.is_empty() {
            bytes = &bytes[rustix::io::write(master, bytes).unwrap()..];
        }
    }

    /// Writes frames at their pace.
    fn play(&self, raw: &RawFrame, frames: usize) {
        for _ in 0..frames {
            self.write(&self.bytes(raw));
            std::thread::sleep(PERIOD);
        }
    }

    /// Waits until everything is read.
    fn drain(&self) {
        let device = &self.pair.as_ref().unwrap().device;
        // Written bytes reach the device a moment later.
        let mut empty = 0;
        wait_for("a reader", || {
            std::thread::sleep(Duration::from_millis(2));
            let is_empty = rustix::io::ioctl_fionread(device).unwrap() == 0;
            empty = if is_empty { empty + 1 } else { 0 };
            empty > 3
        });
    }

    /// Sends frames without load until the port is read. The daemon may drop the first frame,
    /// because it is from before the port was opened.
    fn wake(&self) {
        for _ in 0..2 {
            self.write(&self.bytes(&rest()));
            self.drain();
        }
    }
}

/// A daemon with a sensor on a cable, which is live and tared.
struct Rig {
    bench: Bench,
    daemon: Daemon,
    cable: Cable,
    subscriber: Subscriber,
}

impl Rig {
    /// Starts a rig whose sensor is live and tared. `tables` are added to the configuration.
    fn start(tables: &str) -> Self {
        let mut rig = Self::connect(tables);
        rig.cable.wake();
        rig.cable.play(&rest(), 8);
        rig.sees(&json!({"state": "live", "reason": null}));
        rig
    }

    /// Starts a rig whose port is open, before any byte has come.
    fn connect(tables: &str) -> Self {
        let bench = Bench::new();
        let cable = Cable::plug(bench.path("port"));
        let daemon = Daemon::start(&configure(&bench, tables));
        let mut subscriber = bench.subscriber();
        subscriber.until(&json!({"state": "stale"}));
        Self {
            bench,
            daemon,
            cable,
            subscriber,
        }
    }

    fn sees(&mut self, fields: &Value) -> Value {
        self.subscriber.until(fields)
    }

    /// The status after all bytes so far.
    fn status(&mut self) -> Value {
        self.cable.drain();
        self.subscriber.say(r#"{"get":"status"}"#);
        // Only the status of an event has a number, and this one is an answer.
        self.sees(&json!({"type": "status", "seq": null}))
    }

    /// Ends the press under way, and checks that it is number `press` and has a verdict.
    fn release(&mut self, press: u64) -> Value {
        self.cable.play(&rest(), 4);
        let end = self.sees(&json!({"type": "press", "state": "end"}));
        assert_eq!(
            (&end["press"], &end["reason"]),
            (&json!(press), &json!(null))
        );
        let verdict = self.sees(&json!({"phase": "final"}));
        assert_eq!(verdict["press"], press);
        end
    }

    /// Makes a press, and checks that it is number `press`.
    fn press(&mut self, press: u64) -> Value {
        self.cable.play(&pressed(), 10);
        let begin = self.sees(&json!({"type": "press", "state": "begin"}));
        assert_eq!(begin["press"], press);
        self.release(press)
    }

    fn reload(&mut self, tables: &str) {
        configure(&self.bench, tables);
        self.daemon.process.signal(Signal::HUP);
        self.daemon.logged("reloaded");
    }
}

fn configure(bench: &Bench, tables: &str) -> PathBuf {
    let path = bench.path("hardnessd.toml");
    let text = format!(
        "robot = \"arm-7\"\n[[sensor]]\nname = \"forearm\"\nport = \"port\"\nbaud = 1000000\n\
         frame_rate_hz = 100.0\nstale_after_ms = 300.0\n{tables}\n\
         [publish.unix]\npath = \"events.sock\"\n"
    );
    fs::write(&path, text).unwrap();
    path
}

fn since(moment: SystemTime, event: &Value) -> Duration {
    let time: jiff::Timestamp = event["time"].as_str().unwrap().parse().unwrap();
    SystemTime::from(time)
        .duration_since(moment)
        .unwrap_or_default()
}

#[test]
fn unplugged_after_any_byte_of_a_frame_a_press_is_aborted_and_no_frame_is_made_up() {
    let mut rig = Rig::start("");
    let mut shortest = Duration::MAX;
    let mut skipped = 0;
    for (press, byte) in (1..).zip([0, 1, 2, 4, 395, 788, 789]) {
        let frames = rig.status()["frames"].as_u64().unwrap();
        rig.cable.play(&pressed(), 5);
        rig.cable.write(&rig.cable.bytes(&pressed())[..byte]);
        let unplugged = rig.cable.unplug();
        let lost = rig.sees(&json!({"type": "status", "state": "lost"}));
        let aborted = rig.sees(&json!({"type": "press", "state": "aborted"}));
        assert_eq!(
            (&aborted["press"], &aborted["reason"], &aborted["frames"]),
            (&json!(press), &json!("lost"), &json!(5))
        );
        skipped += byte as u64;
        assert_eq!(lost["frames"], frames + 5, "byte {byte}");
        assert_eq!(
            (&lost["bytes_skipped"], &lost["frames_damaged"]),
            (&json!(skipped), &json!(0)),
            "byte {byte}"
        );
        shortest = shortest.min(since(unplugged, &lost));
        rig.cable.replug();
        rig.cable.wake();
        rig.sees(&json!({"type": "status", "state": "live"}));
    }
    assert!(shortest < Duration::from_millis(100), "{shortest:?}");
}

#[test]
fn plugged_in_elsewhere_behind_its_link_a_sensor_is_read_on_within_its_pause() {
    let mut rig = Rig::start("");
    rig.press(1);
    let mut shortest = Duration::MAX;
    for press in 2..5 {
        let before = fs::read_link(&rig.cable.link).unwrap();
        let replugged = SystemTime::now();
        rig.cable.replug();
        assert_ne!(fs::read_link(&rig.cable.link).unwrap(), before);
        rig.sees(&json!({"type": "status", "state": "lost"}));
        rig.cable.wake();
        let live = rig.sees(&json!({"type": "status", "state": "live"}));
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
    rig.cable.wake();
    let live = rig.sees(&json!({"type": "status", "state": "live"}));
    let away = since(replugged, &live);
    assert!(away < Duration::from_millis(2500), "{away:?}");
    rig.press(5);
}

#[test]
fn flipped_dropped_and_doubled_bytes_cost_their_frame_and_no_press() {
    let mut rig = Rig::start("");
    let before = rig.status();
    let whole = rig.cable.bytes(&pressed());
    rig.cable.play(&pressed(), 3);
    let mut good = 3;
    for place in [4, 300, 787] {
        let mut flipped = whole.clone();
        flipped[place] ^= 0x10;
        let mut dropped = whole.clone();
        dropped.remove(place);
        let mut doubled = whole.clone();
        doubled.insert(place, whole[place] ^ 1);
        for damaged in [flipped, dropped, doubled] {
            rig.cable.write(&damaged);
            rig.cable.play(&pressed(), 2);
            good += 2;
        }
    }
    let after = rig.status();
    let more = |key: &str| after[key].as_u64().unwrap() - before[key].as_u64().unwrap();
    assert_eq!((more("frames"), more("frames_damaged")), (good, 9));
    // Three of the damaged frames have a byte less, three a byte more.
    assert_eq!(more("bytes_skipped"), 9 * 790);
    assert_eq!(after["state"], "live");
    assert_eq!(rig.release(1)["frames"], good);
}

#[test]
fn a_frame_that_comes_twice_is_two_frames_of_the_same_press() {
    let mut rig = Rig::start("");
    for _ in 0..6 {
        let frame = rig.cable.bytes(&pressed());
        rig.cable.write(&[&frame[..], &frame[..]].concat());
        std::thread::sleep(PERIOD);
    }
    assert_eq!(rig.release(1)["frames"], 12);
    assert_eq!(rig.status()["frames_damaged"], 0);
}

#[test]
fn half_a_frame_and_silence_are_stale_and_its_other_half_makes_it_whole() {
    let mut rig = Rig::start("");
    rig.subscriber
        .say(r#"{"subscribe":["status","press","hardness","frame"]}"#);
    let frame = rig.cable.bytes(&pressed());
    let (head, tail) = frame.split_at(400);
    rig.cable.play(&pressed(), 5);
    rig.cable.write(head);
    let begin = rig.sees(&json!({"type": "press", "state": "begin"}));
    let last = begin["frame"].as_u64().unwrap() + 4;
    let last = rig.sees(&json!({"type": "frame", "frame": last}));
    let last: jiff::Timestamp = last["time"].as_str().unwrap().parse().unwrap();
    let stale = rig.sees(&json!({"type": "status", "state": "stale"}));
    assert_eq!(stale["reason"], "no frame for 300 ms");
    let silent = since(last.into(), &stale);
    assert_eq!(silent.as_millis(), 300, "stamped when it became so");
    rig.cable.write(tail);
    rig.sees(&json!({"type": "status", "state": "live"}));

    // Without its other half, the half frame is skipped.
    let before = rig.status();
    rig.cable.write(head);
    rig.sees(&json!({"type": "status", "state": "stale"}));
    rig.cable.write(&frame);
    rig.sees(&json!({"type": "status", "state": "live"}));
    let after = rig.status();
    let more = |key: &str| after[key].as_u64().unwrap() - before[key].as_u64().unwrap();
    assert_eq!((more("frames"), more("bytes_skipped")), (1, 400));
    // There are 5 frames, one in two halves, and one more.
    assert_eq!(rig.release(1)["frames"], 7);
}

#[test]
fn a_burst_after_a_stall_loses_no_frame_and_no_press() {
    let mut rig = Rig::start("");
    let frames = rig.status()["frames"].as_u64().unwrap();
    rig.cable.play(&pressed(), 5);
    let held = rig.cable.bytes(&pressed()).repeat(40);
    rig.sees(&json!({"type": "status", "state": "stale"}));
    rig.cable.write(&held);
    rig.sees(&json!({"type": "status", "state": "live"}));
    assert_eq!(rig.release(1)["frames"], 45);
    let status = rig.status();
    assert_eq!(status["frames"], frames + 49);
    assert_eq!(status["bytes_skipped"], 0);
}

/// The bytes that a UART reads at `ratio` times the rate of the sender of `bytes`. It waits for a
/// start bit, and samples the line in the middle of each of its own bits.
fn misread(bytes: &[u8], ratio: f64) -> Vec<u8> {
    let bits = bytes.iter().flat_map(|byte| {
        let data = (0..8).map(move |bit| byte >> bit & 1 == 1);
        std::iter::once(false).chain(data).chain([true])
    });
    let line: Vec<bool> = bits.collect();
    let level = |time: f64| line.get(time as usize).copied().unwrap_or(true);
    let mut read = Vec::new();
    let mut time = 0.0;
    while (time as usize) < line.len() {
        if level(time) {
            time = time.floor() + 1.0;
            continue;
        }
        let middle = |bit: f64| time + (bit + 0.5) / ratio;
        let byte = (0..8).fold(0, |byte, bit| {
            byte | u8::from(level(middle(f64::from(bit) + 1.0))) << bit
        });
        read.push(byte);
        time = middle(9.0);
        // After a byte without its stop bit, the line must rise first.
        while !level(time) && (time as usize) < line.len() {
            time = time.floor() + 1.0;
        }
    }
    read
}

#[test]
fn at_a_wrong_baud_rate_there_is_no_frame_no_press_and_a_stale_sensor() {
    let mut rig = Rig::connect("");
    let sent = rig.cable.bytes(&pressed()).repeat(20);
    assert_eq!(misread(&sent, 1.0), sent);
    for ratio in [0.25, 0.5, 0.9, 1.1, 2.0, 4.0] {
        rig.cable.write(&misread(&sent, ratio));
    }
    let status = rig.status();
    assert_eq!(
        (&status["state"], &status["frames"]),
        (&json!("stale"), &json!(0))
    );
    assert!(
        status["bytes_skipped"].as_u64().unwrap() > 10_000,
        "{status}"
    );
    // At the right rate, the sensor is live and has no press yet.
    rig.cable.play(&rest(), 8);
    let live = rig.sees(&json!({"type": "status", "state": "live"}));
    assert_eq!(live["seq"], 2, "one event before: it was stale");
    rig.press(1);
}

#[test]
fn a_taxel_that_sticks_begins_no_press_but_holds_one_until_it_is_named() {
    let press = "[press]\nmax_seconds = 0.5\n";
    let mut rig = Rig::start(press);
    let stuck = |mut raw: RawFrame| {
        raw.counts[0] = 255;
        raw
    };
    rig.cable.play(&stuck(rest()), 30);
    rig.cable.play(&stuck(pressed()), 10);
    let begin = rig.sees(&json!({"type": "press"}));
    assert_eq!(
        (&begin["press"], &begin["state"]),
        (&json!(1), &json!("begin"))
    );
    rig.cable.play(&stuck(rest()), 60);
    let end = rig.sees(&json!({"type": "press", "state": "end"}));
    assert_eq!(end["reason"], "timeout");
    let verdict = rig.sees(&json!({"phase": "final"}));
    assert!(
        verdict["notes"]
            .as_array()
            .unwrap()
            .contains(&json!("saturated"))
    );
    rig.reload(&format!(
        "[sensor.calibration]\ndead_taxels = [[0, 0]]\n{press}"
    ));
    rig.cable.play(&stuck(rest()), 4);
    rig.cable.play(&stuck(pressed()), 10);
    rig.cable.play(&stuck(rest()), 4);
    let end = rig.sees(&json!({"type": "press", "state": "end"}));
    assert_eq!((&end["press"], &end["reason"]), (&json!(2), &json!(null)));
}

#[test]
fn a_dead_row_is_missing_in_the_contact_until_it_is_named() {
    let mut rig = Rig::start("");
    let mut dead = pressed();
    dead.counts[13 * 28..14 * 28].fill(0);
    let mut areas = Vec::new();
    let row: Vec<[usize; 2]> = (0..28).map(|column| [13, column]).collect();
    for _ in 0..2 {
        rig.cable.play(&dead, 10);
        rig.cable.play(&rest(), 4);
        let verdict = rig.sees(&json!({"phase": "final"}));
        areas.push(verdict["contact_area_taxels"].as_u64().unwrap());
        rig.reload(&format!("[sensor.calibration]\ndead_taxels = {row:?}\n"));
    }
    // Some neighbours of a dead taxel beside the contact are in the contact.
    assert_eq!(areas, [30, 38]);
}

#[test]
fn drift_is_no_press_below_the_threshold_and_above_it_one_that_ends_by_the_clock() {
    let mut rig = Rig::start("[press]\nmax_seconds = 0.5\n");
    let drifted = |counts: u16| {
        let mut raw = rest();
        raw.counts.fill(counts);
        raw
    };
    // A count is 0.04 N, and the threshold is 0.07 N.
    rig.cable.play(&drifted(1), 60);
    rig.cable.play(&drifted(2), 60);
    let begin = rig.sees(&json!({"type": "press"}));
    assert_eq!(
        (&begin["press"], &begin["state"]),
        (&json!(1), &json!("begin"))
    );
    let end = rig.sees(&json!({"type": "press", "state": "end"}));
    assert_eq!(end["reason"], "timeout");
    let begun: jiff::Timestamp = begin["time"].as_str().unwrap().parse().unwrap();
    let held = since(begun.into(), &end);
    assert!((450..1000).contains(&held.as_millis()), "{held:?}");
    let verdict = rig.sees(&json!({"phase": "final"}));
    assert!(
        verdict["notes"]
            .as_array()
            .unwrap()
            .contains(&json!("at_edge"))
    );
    // A long drift is only one press, and a tare removes the drift.
    rig.cable.play(&drifted(2), 60);
    let control = rig.bench.path("control.sock");
    let taring =
        std::thread::spawn(move || Subscriber::connect(&control).ask(r#"{"tare":"forearm"}"#));
    let start = Instant::now();
    while !taring.is_finished() && start.elapsed() < bench::PATIENCE {
        rig.cable.play(&drifted(2), 1);
    }
    let tared = taring.join().unwrap();
    assert_eq!(tared["type"], "ok", "{tared}");
    rig.cable.play(&drifted(2), 4);
    let mut pressed = pressed();
    pressed.counts.iter_mut().for_each(|count| *count += 2);
    rig.cable.play(&pressed, 10);
    rig.cable.play(&drifted(2), 4);
    let begin = rig.sees(&json!({"type": "press"}));
    assert_eq!(
        (&begin["press"], &begin["state"]),
        (&json!(2), &json!("begin"))
    );
    let end = rig.sees(&json!({"type": "press", "state": "end"}));
    assert_eq!(end["reason"], Value::Null);
}

#[test]
fn pressed_while_it_tares_a_sensor_says_so_and_tares_when_it_is_released() {
    let mut rig = Rig::connect("");
    rig.cable.play(&pressed(), 30);
    let told = rig.sees(&json!({"type": "status", "reason": "tare: contact"}));
    assert_eq!(
        (&told["state"], &told["frames"]),
        (&json!("live"), &json!(5))
    );
    rig.cable.play(&rest(), 8);
    let told = rig.subscriber.next().unwrap();
    assert_eq!(
        (&told["type"], &told["state"], &told["reason"]),
        (&json!("status"), &json!("live"), &json!(null)),
        "and no press before it"
    );
    rig.press(1);
}

#[test]
fn a_wall_clock_that_jumps_changes_the_times_of_events_and_nothing_else() {
    let hrn = Arc::new(Hrn::load(BUILT_IN).unwrap());
    let play = |jumps_s: &[(usize, i64)]| {
        let described = Description {
            frame_rate_hz: 100.0,
            ..Description::default()
        };
        let sensor = Sensor::new(described).unwrap();
        let layout = sensor.layout().clone();
        let mut pipeline = Pipeline::new(sensor, hrn.clone(), Clock::Arrival);
        let mut events = Vec::new();
        let mut wall = jiff::Timestamp::UNIX_EPOCH + Duration::from_secs(1_000_000_000);
        for number in 0..120_u32 {
            if let Some(&(_, by_s)) = jumps_s.iter().find(|(at, _)| *at == number as usize) {
                wall = wall
                    .checked_add(jiff::SignedDuration::from_secs(by_s))
                    .unwrap();
            }
            wall += PERIOD;
            let mono = Duration::from_secs(5) + number * PERIOD;
            let at = Stamp { mono, wall };
            let is_pressed = (20..60).contains(&number) || (80..100).contains(&number);
            let mut bytes = Vec::new();
            let raw = if is_pressed { pressed() } else { rest() };
            layout.encode(&raw, &mut bytes);
            events.extend(pipeline.push(&bytes, at));
            // The next deadline is as far away as after any other frame.
            assert_eq!(
                pipeline.deadline(),
                Some(mono + Duration::from_millis(50)),
                "frame {number}"
            );
        }
        let timeless = |event: &hardnessd::event::Event| {
            let mut event = serde_json::to_value(event).unwrap();
            event.as_object_mut().unwrap().remove("time");
            event
        };
        events.iter().map(timeless).collect::<Vec<Value>>()
    };
    let steady = play(&[]);
    let verdicts = steady.iter().filter(|event| event["phase"] == "final");
    assert_eq!(verdicts.count(), 2);
    let year_s = 365 * 86_400;
    // The calendar jumps during a press, at its last frame, and between presses.
    assert_eq!(
        play(&[(30, year_s), (59, -2 * year_s), (70, -1), (90, 3600)]),
        steady
    );
}

/// This test takes minutes: `.ci/peers` runs it.
#[test]
#[ignore = "heavy"]
fn a_daemon_killed_a_hundred_times_starts_each_time_and_its_recordings_can_be_saved() {
    let bench = Bench::new();
    let config = configure(&bench, "[record]\ndir = \"rec\"\nkeep_free_mb = 0\n");
    let _sensor = bench.sensor_at("port", 100, &[]);
    let mut moments = Stream::new(1, "moments of death");
    let mut lives = Vec::new();
    for round in 1..=100 {
        let mut daemon = Daemon::start(&config);
        let start = Instant::now();
        let mut subscriber = bench.subscriber();
        let hello = subscriber.next().unwrap();
        assert_eq!(hello["type"], "hello", "round {round}");
        subscriber.until(&json!({"type": "status", "state": "live"}));
        std::thread::sleep(Duration::from_secs_f64(1.5 * moments.uniform()));
        lives.push(start.elapsed());
        daemon.process.signal(Signal::KILL);
        daemon.process.exit_code();
    }
    let files = fs::read_dir(bench.path("rec")).unwrap();
    let mut files: Vec<PathBuf> = files.map(|file| file.unwrap().path()).collect();
    // The names are the times at which the files begin.
    files.sort();
    assert_eq!(files.len(), lives.len());
    let mut saved = 0;
    for (damaged, lived) in files.iter().zip(lives) {
        let good = bench.path("good.mcap");
        let [from, to] = [damaged, &good].map(|path| path.to_str().unwrap());
        let output = hardnessd(&["recover", from, "--out", to]);
        let said = String::from_utf8(output.stderr).unwrap();
        if !output.status.success() {
            // Less than a second may be lost, so a recording of less than a second may be lost
            // completely.
            assert!(lived < Duration::from_secs(1), "{lived:?}: {said}");
            assert!(
                said.contains("no chunk of messages in it is whole"),
                "{said}"
            );
            continue;
        }
        let output = hardnessd(&["replay", to]);
        assert!(output.status.success(), "{output:?}");
        saved += 1;
        fs::remove_file(good).unwrap();
    }
    println!("{saved} of 100 recordings saved, the others less than a second long");
    assert!(saved > 30, "{saved}");
}
