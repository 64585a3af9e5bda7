//! `hardnessd calibrate` on a simulated arm that presses wood, over a real pty and a real socket.

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

use crate::bench::{Bench, Process, by_terminal, fails, ran, run, wait_for};
use hardnessd_core::frame::RawFrame;
use hardnessd_core::wire::{Layout, Settings};
use rustix::process::Signal;

fn calibrate(bench: &Bench, more: &[&str]) -> Command {
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let mut command = by_terminal();
    let what = if more.contains(&"--newtons") {
        "force"
    } else {
        "arm"
    };
    command
        .args(["calibrate", what, "--config"])
        .arg(config)
        .args(more);
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// The number after `key = ` in a configuration.
fn value(text: &str, key: &str) -> f64 {
    let line = text
        .lines()
        .find_map(|line| line.strip_prefix(key)?.strip_prefix(" = "));
    line.unwrap_or_else(|| panic!("no {key} in {text}"))
        .parse()
        .unwrap()
}

#[test]
fn presses_on_wood_say_the_arms_stiffness_and_delay() {
    let bench = Bench::new();
    let control = bench.path("control.sock");
    let control = control.to_str().unwrap();
    // The default sensor of the bench presses hard plastic first.
    let more = ["--material", "wood", "--motion", control];
    let _sensor = bench.sensor(&more);
    // The simulated arm has 10 N/mm. The cover in series and the sensor's own scale make it less or
    // a little more. A frame takes 34.3 ms at 230,400 baud.
    let is_right = |text: &String| {
        (8.0..12.0).contains(&value(text, "stiffness_n_per_mm"))
            && (15.0..90.0).contains(&value(text, "delay_ms"))
    };
    let tried = || {
        let (code, text, errors) = ran(&mut calibrate(&bench, &["--presses", "4"]));
        assert_eq!(code, 0, "{errors}");
        text
    };
    // A busy machine delays the frames of a try.
    let text = (0..3).map(|_| tried()).find(is_right);
    let text = text.expect("one of three tries is right");
    // The output is a configuration.
    let lines = text
        .split_once("\n\n")
        .unwrap()
        .1
        .replace("[sensor.arm]", "[sensor.arm] # measured");
    let config = format!("[[sensor]]\nport = \"port\"\n{lines}");
    let path = bench.path("calibrated.toml");
    fs::write(&path, config).unwrap();
    let (code, _, errors) = run(&["check", "--config", path.to_str().unwrap()]);
    assert_eq!(code, 0, "{errors}");
}

#[test]
fn without_positions_there_are_no_values() {
    let bench = Bench::new();
    let _sensor = bench.sensor(&[]);
    for (more, expected, part) in [
        (["--presses", "2"], 1, "only 0 of 2 presses have positions"),
        (["--sensor", "foot"], 2, "foot"),
        (["--presses", "1"], 2, "--presses"),
    ] {
        let (code, text, errors) = ran(&mut calibrate(&bench, &more));
        assert_eq!((code, text.as_str()), (expected, ""), "{errors}");
        assert!(errors.contains(part), "{errors}");
    }
}

#[test]
fn a_signal_ends_it_and_its_sockets() {
    let bench = Bench::new();
    let _sensor = bench.sensor(&[]);
    let mut process = Process(calibrate(&bench, &[]).spawn().unwrap());
    let socket = bench.path("control.sock");
    wait_for("the socket", || socket.exists());
    process.signal(Signal::INT);
    assert_eq!(process.exit_code(), Some(130));
    assert!(!socket.exists());
}

#[test]
fn known_weights_say_the_newtons_of_a_count() {
    let bench = Bench::new();
    // The arm is slow, so that even on a busy machine the tare is taken before the first press.
    let _sensor = bench.sensor(&["--force", "5", "--force", "20", "--speed", "0.5"]);
    let weights = ["--newtons", "15", "5", "20"];
    let (code, text, asked) = ran(&mut calibrate(&bench, &weights));
    assert_eq!(code, 0, "{asked}");
    // The simulated film has 0.04 N a count, times a scale of each sensor's own.
    let newtons_per_count = value(&text, "newtons_per_count");
    assert!((0.034..0.046).contains(&newtons_per_count), "{text}");
    assert_eq!(value(&text, "exponent"), 1.0, "{text}");
    for weight in ["15.000 N", "5.000 N", "20.000 N"] {
        assert!(text.contains(weight), "{text}");
    }
    assert!(
        asked.contains("put 5 N on the sensor, wait until it rests"),
        "{asked}"
    );
    let free = asked.find("leave the sensor free until its zero is taken");
    assert!(free < asked.find("put 15 N") && free.is_some(), "{asked}");

    assert_eq!(ran(&mut calibrate(&bench, &["--newtons", "0"])).0, 2);
    let path = bench.path("hardnessd.toml");
    let of_arm = ["calibrate", "arm", "--newtons", "5", "--config"];
    assert_eq!(run(&[&of_arm[..], &[path.to_str().unwrap()]].concat()).0, 2);
}

/// Raw bytes of presses on the whole array. A taxel in an odd column reads a fifth more than the others.
fn whole_presses(path: &Path) {
    let layout = Layout::new(&Settings::default()).unwrap();
    let mut bytes = Vec::new();
    for (level, frames) in [(0.0, 6), (50.0, 4), (0.0, 3), (60.0, 4), (0.0, 3)] {
        let mut raw = RawFrame::default();
        for (place, counts) in raw.counts.iter_mut().enumerate() {
            *counts = level * if place % 2 == 1 { 1.2 } else { 1.0 };
        }
        (0..frames).for_each(|_| layout.encode(&raw, &mut bytes));
    }
    fs::write(path, bytes).unwrap();
}

#[test]
fn presses_on_the_whole_array_say_the_gains() {
    let bench = Bench::new();
    let path = |name: &str| bench.path(name).to_str().unwrap().to_owned();
    let (from, out) = (path("raw.bin"), path("gains.npy"));
    whole_presses(&bench.path("raw.bin"));
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let config = config.to_str().unwrap();
    let calibrate = ["calibrate", "taxels", "--config", config, "--from"];
    let (code, text, message) = run(&[&calibrate[..], &[&from]].concat());
    assert_eq!(code, 0, "{message}");
    // The file lies beside the configuration.
    assert!(text.contains("gains = \"gains.npy\"\n"), "{text}");
    assert!(text.contains(" 784 of 784 measured in 2 presses"), "{text}");
    let (_, lines) = text.split_once("\n[sensor.calibration]\n").unwrap();
    let calibrated = path("calibrated.toml");
    let table = "[[sensor]]\nname = \"forearm\"\nport = \"port\"\n";
    fs::write(&calibrated, format!("{table}[sensor.calibration]\n{lines}")).unwrap();
    let (code, printed, message) = run(&["check", "--config", &calibrated]);
    assert!(
        code == 0 && printed.contains("gains = \"0.9"),
        "{printed}{message}"
    );
    fs::remove_file(&out).unwrap();
    let missing = format!("sensor.calibration.gains of \"forearm\": {out}: cannot read: ");
    fails(&["check", "--config", &calibrated], 78, &[&missing]);
    let taxels = |from: &str| run(&[&calibrate[..], &[from, "--out", &out]].concat());

    // Without presses, no file is written, and what is there is left alone.
    fs::write(path("none.bin"), [0; 2000]).unwrap();
    assert_eq!(taxels(&path("none.bin")).0, 1);
    assert!(!fs::exists(&out).unwrap());
    fs::write(&out, "of somebody else").unwrap();
    let (code, _, why) = taxels(&from);
    assert_eq!(code, 74, "{why}");
    let expected = "gains.npy: a file or link is there already";
    assert!(why.contains(expected), "{why}");
    assert_eq!(fs::read(&out).unwrap(), b"of somebody else");
}
