//! `hardnessd calibrate` on a simulated arm that presses wood, over a real pty and a real socket.

use std::fs;

use crate::bench::{Bench, sensor, wait_for};
use hardnessd_core::frame::RawFrame;
use hardnessd_core::wire::{Layout, Settings};
use rustix::process::Signal;

const ARM: &str = "calibrate arm --config hardnessd.toml";
const FORCE: &str = "calibrate force --config hardnessd.toml --newtons";
const TAXELS: &str = "calibrate taxels --config hardnessd.toml --from";

fn configured() -> Bench {
    let bench = Bench::new();
    bench.configure_forearm("");
    bench
}

/// The number after `key = ` in a configuration.
fn value(text: &str, key: &str) -> f64 {
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix(key)?.strip_prefix(" = "));
    let value = line.unwrap_or_else(|| panic!("no {key} in {text}"));
    value.parse().unwrap()
}

/// What was measured makes a configuration. Returns what `check` prints.
fn checked(bench: &Bench, lines: &str) -> String {
    bench.write("calibrated.toml", sensor("forearm", "port", 20) + lines);
    bench.succeeds("check --config calibrated.toml")
}

#[test]
fn presses_on_wood_say_the_arms_stiffness_and_delay() {
    let bench = configured();
    // The default sensor of the bench presses hard plastic first.
    let _sensor = bench.sensor("--material wood --motion control.sock");
    // The simulated arm has 10 N/mm. The cover in series and the sensor's own scale make it less or
    // a little more. A frame takes 34.3 ms at 230,400 baud.
    let is_right = |text: &String| {
        (8.0..12.0).contains(&value(text, "stiffness_n_per_mm"))
            && (15.0..90.0).contains(&value(text, "delay_ms"))
    };
    // A busy machine delays the frames of a try.
    let mut tries = (0..3).map(|_| bench.run(&format!("{ARM} --presses 4")));
    let found = tries.find(|(code, text, _)| *code == 0 && is_right(text));
    let (_, text, _) = found.expect("one of three tries is right");
    let (_, lines) = text.split_once("\n\n").unwrap();
    checked(&bench, lines);
}

#[test]
fn a_signal_ends_it_and_its_sockets() {
    let bench = configured();
    let _sensor = bench.sensor("");
    let mut process = bench.start(ARM);
    let socket = bench.path("control.sock");
    wait_for("the socket", || socket.exists());
    process.ends_at(Signal::INT, 130);
    assert!(!socket.exists());
}

#[test]
fn known_weights_say_the_newtons_of_a_count() {
    let bench = configured();
    // The arm is slow, so that even on a busy machine the tare is taken before the first press.
    let _sensor = bench.sensor("--force 5 --force 20 --speed 0.5");
    let (code, text, asked) = bench.run(&format!("{FORCE} 15 5 20"));
    assert_eq!(code, 0, "{asked}");
    // The simulated film has 0.04 N a count, times a scale of each sensor's own.
    let newtons_per_count = value(&text, "newtons_per_count");
    assert!((0.034..0.046).contains(&newtons_per_count), "{text}");
    assert_eq!(value(&text, "exponent"), 1.0, "{text}");
    for weight in ["15.000 N", "5.000 N", "20.000 N"] {
        assert!(text.contains(weight), "{text}");
    }
    let asks = "put 5 N on the sensor, wait until it rests";
    assert!(asked.contains(asks), "{asked}");
    let free = asked.find("leave the sensor free until its zero is taken");
    assert!(free < asked.find("put 15 N") && free.is_some(), "{asked}");
    bench.fails_each(
        "
        calibrate force --config hardnessd.toml --newtons 0 | 2 | --newtons
        calibrate arm --config hardnessd.toml --newtons 5 | 2 | --newtons
        calibrate arm --config hardnessd.toml --presses 1 | 2 | --presses
        calibrate arm --config hardnessd.toml --sensor foot | 2 | \"foot\"",
    );
}

/// Raw bytes of presses on the whole array. A taxel in an odd column reads a fifth more than the others.
fn whole_presses() -> Vec<u8> {
    let layout = Layout::new(&Settings::default()).unwrap();
    let mut bytes = Vec::new();
    for (level, frames) in [(0.0, 6), (50.0, 4), (0.0, 3), (60.0, 4), (0.0, 3)] {
        let mut raw = RawFrame::default();
        for (place, counts) in raw.counts.iter_mut().enumerate() {
            *counts = level * if place % 2 == 1 { 1.2 } else { 1.0 };
        }
        (0..frames).for_each(|_| layout.encode(&raw, &mut bytes));
    }
    bytes
}

#[test]
fn presses_on_the_whole_array_say_the_gains() {
    let bench = configured();
    bench.write("raw.bin", whole_presses());
    let text = bench.succeeds(&format!("{TAXELS} raw.bin"));
    // The file lies beside the configuration.
    assert!(text.contains("gains = \"gains.npy\"\n"), "{text}");
    assert!(text.contains(" 784 of 784 measured in 2 presses"), "{text}");
    let (_, lines) = text.split_once("\n[sensor.calibration]\n").unwrap();
    let printed = checked(&bench, &format!("[sensor.calibration]\n{lines}"));
    assert!(printed.contains("gains = \"0.9"), "{printed}");
    let gains = bench.path("gains.npy");
    fs::remove_file(&gains).unwrap();
    let missing = "sensor.calibration.gains of \"forearm\": gains.npy: cannot read: ";
    bench.fails("check --config calibrated.toml", 78, &[missing]);

    // Without presses, no file is written, and what is there is left alone.
    bench.write("none.bin", [0; 2000]);
    let (code, ..) = bench.run(&format!("{TAXELS} none.bin --out gains.npy"));
    assert_eq!(code, 1);
    assert!(!gains.exists());
    bench.write("gains.npy", "of somebody else");
    let there = "gains.npy: a file or link is there already";
    let (code, _, why) = bench.run(&format!("{TAXELS} raw.bin --out gains.npy"));
    assert!(code == 74 && why.contains(there), "{code}: {why}");
    assert_eq!(bench.read("gains.npy"), "of somebody else");
}
