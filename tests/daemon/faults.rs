//! Faults of a sensor and its cable, with the real binary on a real pty: what subscribers see, and
//! when. `docs/reliability.md` has the same as a table.
//!
//! Most faults come from a script of `hardnessd simulate`. The test itself writes the bytes where it
//! decides at which byte, or at which moment of the daemon, a fault comes.

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::time::{Duration, Instant, SystemTime};

use super::shortage::User;
use crate::bench::pair::Pair;
use crate::bench::{Bench, Daemon, Process, Subscriber, hardnessd, wait_for};
use hardnessd_core::frame::RawFrame;
use hardnessd_core::wire::{Layout, Settings};
use hardnessd_simulator::random::Stream;
use rustix::fs::{FlockOperation, flock};
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
        self.replug_at(Pair::open().unwrap());
    }

    fn replug_at(&mut self, pair: Pair) {
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

    /// Sends frames without load until the port is read. The daemon drops what came before the port was
    /// opened, twice: on a busy machine another frame may come between.
    fn wake(&self) {
        for _ in 0..3 {
            self.write(&self.bytes(&rest()));
            self.drain();
        }
    }
}

/// A daemon with a sensor on a cable, which is live and tared.
struct Rig {
    _bench: Bench,
    _daemon: Daemon,
    cable: Cable,
    subscriber: Subscriber,
}

impl Rig {
    fn start() -> Self {
        let bench = Bench::new();
        let cable = Cable::plug(bench.path("port"));
        let daemon = Daemon::start(&configure(&bench, ""));
        let mut subscriber = bench.subscriber();
        subscriber.until(&json!({"state": "stale"}));
        let mut rig = Self {
            _bench: bench,
            _daemon: daemon,
            cable,
            subscriber,
        };
        rig.cable.wake();
        rig.cable.play(&rest(), 8);
        rig.sees(&json!({"state": "live", "reason": null}));
        rig
    }

    fn sees(&mut self, fields: &Value) -> Value {
        self.subscriber.until(fields)
    }

    /// The status after all bytes so far.
    fn status(&mut self) -> Value {
        self.cable.drain();
        status(&mut self.subscriber)
    }

    /// Ends the press under way, and checks that it is number `press` and has a verdict.
    fn release(&mut self, press: u64) -> Value {
        self.cable.play(&rest(), 4);
        released(&mut self.subscriber, press)
    }

    /// Makes a press, and checks that it is number `press`.
    fn press(&mut self, press: u64) -> Value {
        self.cable.play(&pressed(), 10);
        let begin = self.sees(&json!({"type": "press", "state": "begin"}));
        assert_eq!(begin["press"], press);
        self.release(press)
    }
}

/// The first frame that a fault of a script may strike, unless it strikes all from the first. By
/// then the daemon has opened the port and tared.
const READY: u32 = 600;

/// A daemon with a sensor that `hardnessd simulate` plays. Nothing but a script presses it.
struct Played {
    bench: Bench,
    daemon: Daemon,
    subscriber: Subscriber,
    _sensor: Process,
}

impl Played {
    /// Starts the daemon, then the sensor with the faults of `script`. `tables` are added to the
    /// configuration.
    fn start(tables: &str, script: &[String]) -> Self {
        let bench = Bench::new();
        let daemon = Daemon::start(&configure(&bench, tables));
        let subscriber = bench.subscriber();
        let path = bench.path("faults.toml");
        fs::write(&path, script.concat()).unwrap();
        let faults = path.to_str().unwrap();
        // The line is so fast that no frame is late, even if it comes twice.
        let more = ["--faults", faults, "--rest", "3600", "--baud", "4000000"];
        let sensor = bench.sensor_at("port", 100, &more);
        Self {
            bench,
            daemon,
            subscriber,
            _sensor: sensor,
        }
    }

    fn sees(&mut self, fields: &Value) -> Value {
        self.subscriber.until(fields)
    }

    fn released(&mut self, press: u64) -> Value {
        released(&mut self.subscriber, press)
    }

    fn reload(&mut self, tables: &str) {
        configure(&self.bench, tables);
        self.daemon.process.signal(Signal::HUP);
        self.daemon.logged("reloaded");
    }
}

/// A fault of a script, from a frame of the sensor on.
fn fault(kind: &str, frame: u32, keys: &str) -> String {
    let at_s = (f64::from(frame) - 0.5).max(0.0) / 100.0;
    format!("[[fault]]\nkind = \"{kind}\"\nat_s = {at_s}\n{keys}\n")
}

/// A fault of a script, for a number of frames.
fn during(kind: &str, frame: u32, frames: u32, keys: &str) -> String {
    let for_s = f64::from(frames) / 100.0;
    fault(kind, frame, &format!("for_s = {for_s}\n{keys}"))
}

/// The load of [`pressed`], in a script.
fn touch(frame: u32, frames: u32) -> String {
    let load = "rows = [11, 16]\ncols = [11, 16]\nnewtons = 0.8";
    during("contact", frame, frames, load)
}

/// The status as an answer.
fn status(subscriber: &mut Subscriber) -> Value {
    subscriber.send_line(r#"{"get":"status"}"#);
    // Only the status of an event has a number, and this one is an answer.
    subscriber.until(&json!({"type": "status", "seq": null}))
}

/// Waits for the end of a press, and checks that it is number `press`, ends by its release and has
/// a verdict.
fn released(subscriber: &mut Subscriber, press: u64) -> Value {
    let end = subscriber.until(&json!({"type": "press", "state": "end"}));
    assert_eq!(
        (&end["press"], &end["reason"]),
        (&json!(press), &json!(null))
    );
    let verdict = subscriber.until(&json!({"phase": "final"}));
    assert_eq!(verdict["press"], press);
    end
}

/// How much `key` grew from one status to another.
fn growth(before: &Value, after: &Value, key: &str) -> u64 {
    after[key].as_u64().unwrap() - before[key].as_u64().unwrap()
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
    let mut rig = Rig::start();
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
    let mut rig = Rig::start();
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
fn a_port_that_no_thread_can_open_is_unavailable_and_opened_once_a_thread_can() {
    let bench = Bench::new();
    let user = User::new(&bench, 0);
    let daemon = Daemon::start_by(&mut user.runs(user.program()), &configure(&bench, ""));
    let mut subscriber = bench.subscriber();
    subscriber.until(&json!({"state": "connecting", "reason": "no such device"}));
    user.limit(&daemon.process, Some(1));
    let refused = loop {
        let line = subscriber.until(&json!({"type": "status"}));
        if line["reason"] != "no such device" {
            break line;
        }
    };
    assert_eq!(refused["state"], "connecting", "{refused}");
    let reason = refused["reason"].as_str().unwrap();
    assert!(reason.starts_with("no thread to open it: "), "{refused}");
    user.limit(&daemon.process, None);
    let cable = Cable::plug(bench.path("port"));
    let device = &cable.pair.as_ref().unwrap().path;
    fs::set_permissions(device, Permissions::from_mode(0o666)).unwrap();
    subscriber.until(&json!({"state": "stale"}));
    cable.wake();
    subscriber.until(&json!({"state": "live"}));
}

#[test]
fn a_lost_sensor_says_what_keeps_it_from_being_live_now() {
    let mut rig = Rig::start();
    let lost = |reason: &str| json!({"type": "status", "state": "lost", "reason": reason});
    rig.cable.unplug();
    rig.sees(&lost("no such device"));
    let held = Pair::open().unwrap();
    let device = held.device.try_clone().unwrap();
    flock(&device, FlockOperation::LockExclusive).unwrap();
    rig.cable.replug_at(held);
    rig.sees(&lost("port held by another process"));
    flock(&device, FlockOperation::Unlock).unwrap();
    rig.sees(&lost("no frame for 25 ms"));
    rig.cable.wake();
    rig.sees(&json!({"type": "status", "state": "live"}));
}

#[test]
fn flipped_dropped_and_doubled_bytes_cost_their_frame_and_no_press() {
    let mut rig = Rig::start();
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
    let more = |key| growth(&before, &after, key);
    assert_eq!((more("frames"), more("frames_damaged")), (good, 9));
    // Three of the damaged frames have a byte less, three a byte more.
    assert_eq!(more("bytes_skipped"), 9 * 790);
    assert_eq!(after["state"], "live");
    assert_eq!(rig.release(1)["frames"], good);
}

#[test]
fn a_frame_that_comes_twice_is_two_frames_of_the_same_press() {
    let twice = fault("repeat", READY, "frames = 6");
    let mut played = Played::start("", &[touch(READY, 6), twice]);
    let before = played.sees(&json!({"type": "status", "state": "live"}));
    assert_eq!(played.released(1)["frames"], 12);
    let after = status(&mut played.subscriber);
    assert_eq!(growth(&before, &after, "frames_damaged"), 0);
}

#[test]
fn half_a_frame_and_silence_are_stale_and_its_other_half_makes_it_whole() {
    let script = [
        touch(READY, 200),
        during("half", READY + 5, 60, "other_half = true"),
        during("half", READY + 70, 60, ""),
    ];
    let mut played = Played::start("", &script);
    played
        .subscriber
        .send_line(r#"{"subscribe":["status","press","hardness","frame"]}"#);
    let begin = played.sees(&json!({"type": "press", "state": "begin"}));
    let last = begin["frame"].as_u64().unwrap() + 4;
    let last = played.sees(&json!({"type": "frame", "frame": last}));
    let last: jiff::Timestamp = last["time"].as_str().unwrap().parse().unwrap();
    let stale = played.sees(&json!({"type": "status", "state": "stale"}));
    assert_eq!(stale["reason"], "no frame for 300 ms");
    let silent = since(last.into(), &stale);
    assert_eq!(silent.as_millis(), 300, "stamped when it became so");
    let live = played.sees(&json!({"type": "status", "state": "live"}));
    // The frame is whole with its other half.
    let more = |key| growth(&stale, &live, key);
    assert_eq!((more("frames"), more("bytes_skipped")), (1, 0));

    // Without its other half, the half frame is skipped.
    let stale = played.sees(&json!({"type": "status", "state": "stale"}));
    let live = played.sees(&json!({"type": "status", "state": "live"}));
    let more = |key| growth(&stale, &live, key);
    assert_eq!((more("frames"), more("bytes_skipped")), (1, 395));
    // 59 frames stay unsent in the first silence. In the second, half a frame is lost with them.
    assert_eq!(played.released(1)["frames"], 200 - 59 - 60);
}

#[test]
fn a_burst_after_a_stall_loses_no_frame_and_no_press() {
    let script = [touch(READY, 45), during("stall", READY + 5, 40, "")];
    let mut played = Played::start("", &script);
    played.sees(&json!({"type": "press", "state": "begin"}));
    let stale = played.sees(&json!({"type": "status", "state": "stale"}));
    played.sees(&json!({"type": "status", "state": "live"}));
    assert_eq!(played.released(1)["frames"], 45);
    let after = status(&mut played.subscriber);
    assert_eq!(growth(&stale, &after, "bytes_skipped"), 0);
    assert_eq!(growth(&stale, &after, "frames_damaged"), 0);
}

#[test]
fn at_a_wrong_baud_rate_there_is_no_frame_no_press_and_a_stale_sensor() {
    let ratios = [0.25, 0.5, 0.9, 1.1, 2.0, 4.0];
    let each = READY / 6;
    let mut script = vec![touch(0, READY)];
    for (turn, ratio) in (0..).zip(ratios) {
        let ratio = format!("ratio = {ratio}");
        script.push(during("wrong-baud", turn * each, each, &ratio));
    }
    script.push(touch(READY + 50, 10));
    let mut played = Played::start("", &script);
    let mut was_stale = false;
    let live = loop {
        let event = played.subscriber.next().unwrap();
        assert_ne!(event["type"], "press", "{event}");
        was_stale |= event["state"] == "stale";
        if event["state"] == "live" {
            break event;
        }
    };
    // At the right rate, the sensor is live at once and has no press yet.
    assert!(was_stale);
    assert_eq!(
        (&live["frames"], &live["reason"]),
        (&json!(1), &json!(null))
    );
    assert!(live["bytes_skipped"].as_u64().unwrap() > 10_000, "{live}");
    assert_eq!(played.released(1)["frames"], 10);
}

#[test]
fn a_taxel_that_sticks_begins_no_press_but_holds_one_until_it_is_named() {
    let press = "[press]\nmax_seconds = 0.5\n";
    let script = [
        fault("stuck", READY, "rows = [0, 0]\ncols = [0, 0]"),
        touch(READY + 100, 10),
        touch(READY + 600, 10),
    ];
    let mut played = Played::start(press, &script);
    let begin = played.sees(&json!({"type": "press"}));
    assert_eq!(
        (&begin["press"], &begin["state"]),
        (&json!(1), &json!("begin"))
    );
    let end = played.sees(&json!({"type": "press", "state": "end"}));
    assert_eq!(end["reason"], "timeout");
    let verdict = played.sees(&json!({"phase": "final"}));
    assert!(
        verdict["notes"]
            .as_array()
            .unwrap()
            .contains(&json!("saturated"))
    );
    // The press began with the touch, and not with the taxel a second earlier.
    assert_eq!(verdict["contact_area_taxels"], 37);
    played.reload(&format!(
        "[sensor.calibration]\ndead_taxels = [[0, 0]]\n{press}"
    ));
    assert_eq!(played.released(2)["frames"], 10);
}

#[test]
fn a_dead_row_is_missing_in_the_contact_until_it_is_named() {
    let script = [
        touch(READY, 10),
        touch(READY + 500, 10),
        // It strikes the taxels after the contacts, so that they do not load the row.
        fault("dead", READY, "rows = [13, 13]"),
    ];
    let mut played = Played::start("", &script);
    let first = played.sees(&json!({"phase": "final"}));
    let row: Vec<[usize; 2]> = (0..28).map(|column| [13, column]).collect();
    played.reload(&format!("[sensor.calibration]\ndead_taxels = {row:?}\n"));
    let second = played.sees(&json!({"phase": "final"}));
    let areas = [first, second].map(|verdict| verdict["contact_area_taxels"].clone());
    // Some neighbours of a dead taxel beside the contact are in the contact.
    assert_eq!(areas, [30, 38]);
}

#[test]
fn drift_is_no_press_below_the_threshold_and_above_it_one_that_ends_by_the_clock() {
    // A count is 0.04 N, and the threshold is 0.07 N. A taxel reads a count after 0.3 s, and two
    // from 0.9 s on.
    let script = [
        during("drift", READY, 120, "newtons_per_hour = 240.0"),
        touch(READY + 500, 10),
    ];
    let mut played = Played::start("[press]\nmax_seconds = 0.5\n", &script);
    let begin = played.sees(&json!({"type": "press"}));
    assert_eq!(
        (&begin["press"], &begin["state"]),
        (&json!(1), &json!("begin"))
    );
    let end = played.sees(&json!({"type": "press", "state": "end"}));
    assert_eq!(end["reason"], "timeout");
    let begun: jiff::Timestamp = begin["time"].as_str().unwrap().parse().unwrap();
    let held = since(begun.into(), &end);
    assert!((450..1000).contains(&held.as_millis()), "{held:?}");
    let verdict = played.sees(&json!({"phase": "final"}));
    assert!(
        verdict["notes"]
            .as_array()
            .unwrap()
            .contains(&json!("at_edge"))
    );
    // 784 taxels of two counts each.
    assert_eq!(verdict["force_n"], 62.72);
    // A long drift is only one press, and a tare removes the drift.
    let control = played.bench.path("control.sock");
    let tared = Subscriber::connect(&control).ask(r#"{"tare":"forearm"}"#);
    assert_eq!(tared["type"], "ok", "{tared}");
    let begin = played.sees(&json!({"type": "press"}));
    assert_eq!(
        (&begin["press"], &begin["state"]),
        (&json!(2), &json!("begin"))
    );
    assert_eq!(played.released(2)["frames"], 10);
}

#[test]
fn pressed_while_it_tares_a_sensor_says_so_and_tares_when_it_is_released() {
    let script = [touch(0, READY), touch(READY + 50, 10)];
    let mut played = Played::start("", &script);
    let seen = played.sees(&json!({"type": "status", "reason": "tare: contact"}));
    assert_eq!(
        (&seen["state"], &seen["frames"]),
        (&json!("live"), &json!(5))
    );
    let seen = played.subscriber.next().unwrap();
    assert_eq!(
        (&seen["type"], &seen["state"], &seen["reason"]),
        (&json!("status"), &json!("live"), &json!(null)),
        "and no press before it"
    );
    assert_eq!(played.released(1)["frames"], 10);
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
        let message = String::from_utf8(output.stderr).unwrap();
        if !output.status.success() {
            // Less than a second may be lost, so a recording of less than a second may be lost
            // completely.
            assert!(lived < Duration::from_secs(1), "{lived:?}: {message}");
            assert!(
                message.contains("no chunk of messages in it is whole"),
                "{message}"
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
