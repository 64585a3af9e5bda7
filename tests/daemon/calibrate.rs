//! `hardnessd calibrate` on a simulated arm that presses wood, over a real pty and a real socket.

use std::fs;
use std::process::{Command, Stdio};

use crate::bench::{BINARY, Bench, Process, by_terminal, hardnessd};
use hardnessd_core::test_support::of_a_press;
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
    let output = calibrate(&bench, &["--presses", "4"]).output().unwrap();
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    // The simulated arm has 10 N/mm. The cover in series and the sensor's own scale make it less or
    // a little more, and so do frames that a busy machine delays.
    let n_per_mm = value(&text, "stiffness_n_per_mm");
    assert!((8.0..12.0).contains(&n_per_mm), "{text}");
    // A frame takes 34.3 ms at 230,400 baud. A busy machine adds to it.
    let delay_ms = value(&text, "delay_ms");
    assert!((15.0..90.0).contains(&delay_ms), "{text}");
    // The output is a configuration.
    let lines = text
        .split_once("\n\n")
        .unwrap()
        .1
        .replace("[sensor.arm]", "[sensor.arm] # measured");
    let config = format!("[[sensor]]\nport = \"port\"\n{lines}");
    let path = bench.path("calibrated.toml");
    fs::write(&path, config).unwrap();
    let checked = hardnessd(&["check", "--config", path.to_str().unwrap()]);
    assert!(checked.status.success(), "{checked:?}");
}

#[test]
fn without_positions_there_are_no_values() {
    let bench = Bench::new();
    let _sensor = bench.sensor(&[]);
    let output = calibrate(&bench, &["--presses", "2"]).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let errors = String::from_utf8(output.stderr).unwrap();
    assert!(
        errors.contains("only 0 of 2 presses have positions"),
        "{errors}"
    );
    assert!(output.stdout.is_empty());

    let output = calibrate(&bench, &["--sensor", "foot"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    let output = calibrate(&bench, &["--presses", "1"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{output:?}");
}

#[test]
fn a_signal_ends_it_and_its_sockets() {
    let bench = Bench::new();
    let _sensor = bench.sensor(&[]);
    let mut process = Process(calibrate(&bench, &[]).spawn().unwrap());
    let socket = bench.path("control.sock");
    crate::bench::wait_for("the socket", || socket.exists());
    process.signal(Signal::INT);
    assert_eq!(process.exit_code(), Some(130));
    assert!(!socket.exists());
}

#[test]
fn known_weights_say_the_newtons_of_a_count() {
    let bench = Bench::new();
    // The arm is slow, so that even on a busy machine the tare is taken before the first press.
    let _sensor = bench.sensor(&["--force", "5", "--force", "20", "--speed", "0.5"]);
    let output = calibrate(&bench, &["--newtons", "15", "5", "20"])
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    // The simulated film has 0.04 N a count, times a scale of each sensor's own.
    let newtons_per_count = value(&text, "newtons_per_count");
    assert!((0.034..0.046).contains(&newtons_per_count), "{text}");
    assert_eq!(value(&text, "exponent"), 1.0, "{text}");
    for weight in ["15.000 N", "5.000 N", "20.000 N"] {
        assert!(text.contains(weight), "{text}");
    }
    let asked = String::from_utf8(output.stderr).unwrap();
    assert!(
        asked.contains("put 5 N on the sensor, wait until it rests"),
        "{asked}"
    );
    let free = asked.find("leave the sensor free until its zero is taken");
    assert!(free < asked.find("put 15 N") && free.is_some(), "{asked}");

    let output = calibrate(&bench, &["--newtons", "0"]).output().unwrap();
    assert_eq!(output.status.code(), Some(2), "{output:?}");
    let path = bench.path("hardnessd.toml");
    let of_arm = ["calibrate", "arm", "--newtons", "5", "--config"];
    let of_arm = hardnessd(&[&of_arm[..], &[path.to_str().unwrap()]].concat());
    assert_eq!(of_arm.status.code(), Some(2), "{of_arm:?}");
    let without = hardnessd(&["calibrate", "force"]);
    assert_eq!(without.status.code(), Some(2), "{without:?}");
}

#[test]
fn presses_of_a_recording_say_the_gains_and_a_recording_holds_them() {
    let bench = Bench::new();
    let path = |name: &str| bench.path(name).to_str().unwrap().to_owned();
    let raw = ["--sensor-profile", "raw", "--presses", "80", "--to"];
    let simulated = hardnessd(&[&["simulate"], &raw[..], &[path("raw.bin").as_str()]].concat());
    assert!(simulated.status.success(), "{simulated:?}");
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let config = config.to_str().unwrap();
    let (from, out) = (path("raw.bin"), path("gains.npy"));
    let taxels = |from: &str| {
        hardnessd(&[
            "calibrate",
            "taxels",
            "--config",
            config,
            "--from",
            from,
            "--out",
            &out,
        ])
    };
    let output = taxels(&from);
    assert!(output.status.success(), "{output:?}");
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("gains = \"gains.npy\"\n"), "{text}");
    assert!(text.contains(" of 784 measured, each in "), "{text}");

    // The output is a configuration, and a daemon with it records the gains themselves.
    let (_, lines) = text.split_once("\n[sensor.calibration]\n").unwrap();
    let calibrated = path("calibrated.toml");
    let table = "[[sensor]]\nname = \"forearm\"\nport = \"port\"\nframe_rate_hz = 20.0\n";
    fs::write(&calibrated, format!("{table}[sensor.calibration]\n{lines}")).unwrap();
    let _sensor = bench.sensor(&[]);
    let checked = hardnessd(&["check", "--config", &calibrated]);
    let printed = String::from_utf8(checked.stdout).unwrap();
    assert!(
        printed.contains("whatever the baud rate, gains 0."),
        "{printed}"
    );
    let recording = path("gains.mcap");
    let record = [
        "record",
        "--config",
        &calibrated,
        "--seconds",
        "8",
        "--out",
        &recording,
    ];
    assert!(hardnessd(&record).status.success());
    let replay = || hardnessd(&["replay", &recording]);
    let before = replay();
    assert!(
        String::from_utf8_lossy(&before.stdout).contains("\"phase\":\"final\""),
        "{before:?}"
    );
    fs::remove_file(&out).unwrap();
    assert_eq!(replay().stdout, before.stdout);
    let missing = hardnessd(&["check", "--config", &calibrated]);
    assert_eq!(missing.status.code(), Some(78), "{missing:?}");
    let why = String::from_utf8(missing.stderr).unwrap();
    let expected = format!("sensor.calibration.gains of \"forearm\": {out}: cannot read: ");
    assert!(why.contains(&expected), "{why}");

    // Without presses, no file is written, and the exit code is 1.
    fs::write(path("none.bin"), [0; 2000]).unwrap();
    let output = taxels(&path("none.bin"));
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    let left: Vec<_> = fs::read_dir(bench.path("")).unwrap().collect();
    let is_gains = |entry: &std::io::Result<fs::DirEntry>| {
        entry
            .as_ref()
            .unwrap()
            .file_name()
            .to_string_lossy()
            .contains(".npy")
    };
    assert!(!left.iter().any(is_gains), "{left:?}");
    assert_eq!(taxels(&path("nowhere.bin")).status.code(), Some(66));

    // Without --out, the file lies beside the configuration.
    let beside =
        |from: &str| hardnessd(&["calibrate", "taxels", "--config", config, "--from", from]);
    let none = beside(&path("none.bin"));
    assert_eq!(none.status.code(), Some(1), "{none:?}");
    assert!(!fs::exists(&out).unwrap());
    let made = beside(&from);
    assert!(made.status.success(), "{made:?}");
    assert_eq!(String::from_utf8(made.stdout).unwrap(), text);
    let gains = fs::read(&out).unwrap();
    assert!(gains.len() > 4 * 784, "{}", gains.len());
    fs::write(&out, "of somebody else").unwrap();
    for refused in [beside(&from), taxels(&from)] {
        assert_eq!(refused.status.code(), Some(74), "{refused:?}");
        let why = String::from_utf8(refused.stderr).unwrap();
        let expected = "gains.npy: a file or link is there already: name another one, or remove it";
        assert!(why.contains(expected), "{why}");
        assert_eq!(why.lines().count(), 1, "{why}");
    }
    assert_eq!(fs::read(&out).unwrap(), b"of somebody else");
    fs::remove_file(&out).unwrap();
    // Nothing else is replaced, whatever its name.
    let script = "echo theirs > \"$1.$$.part\"; echo \"$1.$$.part\"; shift; exec \"$@\"";
    let taxels = ["calibrate", "taxels", "--config", config];
    let output = Command::new("sh")
        .args(["-c", script, "sh", &out, BINARY])
        .args(taxels)
        .args(["--from", &from, "--out", &out])
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    assert_eq!(fs::read(&out).unwrap(), gains);
    let message = String::from_utf8(output.stdout).unwrap();
    let theirs = fs::read_to_string(message.lines().next().unwrap());
    assert_eq!(theirs.unwrap(), "theirs\n");
}

#[test]
fn the_other_sensors_neither_count_nor_have_to_be_there() {
    let bench = Bench::new();
    let more = "[[sensor]]\nname = \"wrist\"\nport = \"port-2\"\nframe_rate_hz = 20.0\n";
    let config = bench.configure("hardnessd.toml", "events.sock", more);
    let config = config.to_str().unwrap();
    let weigh = || {
        let force = ["--sensor", "forearm", "--newtons", "15"];
        hardnessd(&[&["calibrate", "force", "--config", config], &force[..]].concat())
    };
    let slow = ["--speed", "0.5"];
    let forearm = bench.sensor(&slow);
    let unplugged = weigh();
    assert!(unplugged.status.success(), "{unplugged:?}");
    drop(forearm);
    // The wrist is pressed again and again, quickly.
    let _wrist = bench.sensor_at("port-2", 20, &["--speed", "20"]);
    let _forearm = bench.sensor(&slow);
    let pressed = weigh();
    assert!(pressed.status.success(), "{pressed:?}");
}

#[test]
fn weights_of_a_recording_are_read_with_its_own_settings() {
    let bench = Bench::new();
    // A press of a daemon with another configuration: 80 counts on each of nine taxels.
    let recording = bench.path("press.mcap");
    fs::write(&recording, of_a_press(|_| {}, None, false).0).unwrap();
    let recording = recording.to_str().unwrap();
    let weigh = |calibration: &str| {
        let path = bench.path("hardnessd.toml");
        let sensor = "[[sensor]]\nname = \"forearm\"\nport = \"port\"\n[sensor.calibration]\n";
        fs::write(&path, format!("{sensor}{calibration}")).unwrap();
        let weights = ["--newtons", "28.8", "--from", recording];
        let config = ["calibrate", "force", "--config", path.to_str().unwrap()];
        let output = hardnessd(&[&config[..], &weights[..]].concat());
        assert!(output.status.success(), "{output:?}");
        value(
            &String::from_utf8(output.stdout).unwrap(),
            "newtons_per_count",
        )
    };
    // The weight is what the recorded frames say, with the recorded 0.04.
    let then = weigh("");
    assert!((0.038..0.043).contains(&then), "{then}");
    let now = weigh("newtons_per_count = 0.01\nexponent = 1.3\n");
    assert_eq!(now, then);
}

#[test]
fn a_recording_that_the_system_cannot_read_is_an_io_error() {
    let bench = Bench::new();
    let config = bench.configure("hardnessd.toml", "events.sock", "");
    let config = config.to_str().unwrap();
    for what in ["arm", "taxels"] {
        let calibrate = ["calibrate", what, "--config", config];
        let output = hardnessd(&[&calibrate[..], &["--from", "/proc/self/mem"]].concat());
        assert_eq!(output.status.code(), Some(74), "{output:?}");
        let why = String::from_utf8(output.stderr).unwrap();
        assert!(why.contains("/proc/self/mem: "), "{why}");
    }
    // A file that is no recording is read, and is of no use.
    let foreign = bench.path("foreign.mcap");
    fs::write(&foreign, b"\x89MCAP0\r\nnothing more").unwrap();
    let foreign = ["arm", "--from", foreign.to_str().unwrap()];
    let output = hardnessd(&[&["calibrate", "--config", config], &foreign[..]].concat());
    assert_eq!(output.status.code(), Some(1), "{output:?}");
}
