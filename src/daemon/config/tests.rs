use std::path::Path;

use super::*;
use hardnessd_core::exit::CONFIG;
use hardnessd_core::{npy, tare};

fn load(text: &str) -> Result<Config, String> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hardnessd.toml");
    std::fs::write(&path, text).unwrap();
    checked(&path)
}

fn checked(path: &Path) -> Result<Config, String> {
    Config::load(path).map_err(|error| error.to_string())
}

/// Asserts that a configuration is refused in one line that has all these parts.
#[track_caller]
fn assert_refused<T: std::fmt::Debug>(loaded: Result<T, String>, parts: &[&str]) {
    let error = loaded.unwrap_err();
    assert!(!error.contains('\n'), "{error}");
    for part in parts {
        assert!(error.contains(part), "{part:?} not in {error:?}");
    }
}

const LEAST: &str = "[[sensor]]\nport = \"/dev/ttyUSB0\"\n";

#[test]
fn an_error_is_one_line_that_names_file_place_key_found_and_expected() {
    // What follows the sensor's port, and what is said of it.
    let cases = "
        [[sensor]]; name = 'b' | line 3: sensor.port of \"b\": found none, expected a path
        [[sensor]]; name = 'b'; port = '/dev/ttyUSB0'; baud = 9600 | line 6: sensor.baud of \"b\": found 9600, expected 115200 as for \"sensor\"
        bauds = 9 | line 3, column 1
        bauds = 9 | `bauds`: did you mean `baud`?
        [sensor.frame]; checksum = 'crc-16' | unknown variant `crc-16`, expected one of `none`
        [[sensor]]; port = 'q' | sensor.name of \"sensor\": two sensors have this name
        stale_after_ms = 0 | line 3: sensor.stale_after_ms of \"sensor\": found 0.0, expected 0.1 to
        [sensor.frame]; preset = 'csv'; sync = 'AA' | line 5: sensor.frame.sync of \"sensor\": found
        [press]; end_area_taxels = 9 | line 4: press.end_area_taxels: found 9
        [publish.unix]; mode = '0999' | found \"0999\", expected octal permissions
        [publish.tcp]; listen = 'here:8255' | line 4, column 10
        [publish.tcp]; listen = 'here:8255' | expected ADDRESS:PORT, such as
        [publish.unix]; path = '/control.sock' | publish.unix.control_path: /control.sock is the";
    for case in cases.trim().lines() {
        let (keys, expected) = case.trim().split_once(" | ").unwrap();
        let text = keys.replace("; ", "\n");
        let loaded = load(&format!("{LEAST}{text}"));
        assert_refused(loaded, &["hardnessd.toml:", expected]);
    }
    let long = "a".repeat(300);
    for (text, expected) in [
        (
            format!("robot = \"\\u202Eevil\"\n{LEAST}"),
            "robot: found \"\\u{202e}evil\", expected a name without control or bidirectional",
        ),
        (
            "[log]".to_owned(),
            "no sensor: add a [[sensor]] with a port",
        ),
        (
            "[sensor]\nport = \"p\"\n".to_owned(),
            "hardnessd.toml: line 1: write [[sensor]], not [sensor]: there may be several",
        ),
        (
            format!("{LEAST}name = \"{long}\""),
            "sensor.name: found 300 characters, expected at most 64",
        ),
        (
            format!("robot = \"{long}\"\n{LEAST}"),
            "robot: found 300 characters, expected a name of at most 255",
        ),
    ] {
        let error = load(&text).unwrap_err();
        // A name that is too long is not repeated.
        assert!(error.contains(expected) && error.len() < 200, "{error}");
    }
}

#[test]
fn levels_that_no_model_can_have_are_refused() {
    let level = |label, shore| format!("[[level]]\nlabel = \"{label}\"\nshore = {shore}\n");
    for (first, second, expected) in [
        ("stiff", "", "found 1 tables, expected none, or 2 to 16"),
        ("\\u202E", "[0, 50]", "a label is empty, too long"),
        ("stiff", "[0, 60]", "which is not softer than"),
    ] {
        let mut text = LEAST.to_owned() + &level(first, "[50, 100]");
        if !second.is_empty() {
            text += &level("limp", second);
        }
        let config = load(&text).unwrap();
        let setup = Setup::of(config, Path::new("a.toml")).map_err(|error| error.to_string());
        assert_refused(setup, &[expected]);
    }
}

#[test]
fn gains_are_read_from_a_file_beside_the_configuration() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hardnessd.toml");
    let text = format!(
        "{LEAST}[sensor.frame]\nrows = 2\ncols = 3\n[sensor.calibration]\ngains = \"gains.npy\"\n"
    );
    std::fs::write(&path, &text).unwrap();
    let write = |bytes: &[u8]| std::fs::write(directory.path().join("gains.npy"), bytes).unwrap();
    let gains = [1.0_f32, 1.1, 0.9, 1.0, 0.5, 2.0];
    write(&npy::to_bytes(&[2, 3], &gains));
    let rows = vec![gains[..3].to_vec(), gains[3..].to_vec()];
    let read = checked(&path).unwrap();
    assert_eq!(
        read.sensors[0].calibration.gains,
        Some(tare::Gains::Taxels(rows))
    );
    // The sensor begins anew with other gains.
    write(&npy::to_bytes(&[2, 3], &gains.map(|gain| 2.0 * gain)));
    let changed = checked(&path).unwrap();
    assert_ne!(read, changed);
    assert_eq!(read.fixed_difference(&changed), None);
    write(&npy::to_bytes(&[3, 2], &gains));
    let expected = "sensor.calibration.gains of \"sensor\": found 3 rows of 2, expected 2 of 3";
    assert_refused(checked(&path), &[expected]);
    let list = text.replace("\"gains.npy\"", "[[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]");
    let expected = "found a list, expected the path of an .npy file";
    assert_refused(load(&list), &[expected]);
}

#[test]
fn a_file_that_is_no_utf_8_is_a_bad_one_and_its_place_is_named() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hardnessd.toml");
    std::fs::write(&path, b"# a\nrobot = \"\xff\"\n").unwrap();
    let error = Config::load(&path).unwrap_err();
    let text = error.to_string();
    assert!(
        text.contains("not a text file, such as TOML") && text.contains("index 13"),
        "{text}"
    );
    assert_eq!(error.exit_code(), CONFIG);
}

#[test]
fn paths_are_relative_to_the_file() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hardnessd.toml");
    let text = "[[sensor]]\nport = \"port\"\n[model]\npath = \"hrn.onnx\"\n\
                [publish.unix]\npath = \"/run/events.sock\"\ncontrol_path = \"c\"";
    std::fs::write(&path, text).unwrap();
    let config = Config::load(&path).unwrap();
    assert_eq!(config.sensors[0].port, directory.path().join("port").into());
    assert_eq!(config.model.path, Some(directory.path().join("hrn.onnx")));
    let unix = &config.publish.unix;
    assert_eq!(unix.path(), Path::new("/run/events.sock"));
    assert_eq!(unix.control_path(), directory.path().join("c"));
}

#[test]
fn a_model_of_another_hash_is_refused() {
    let hash = "ab".repeat(32);
    let config = load(&format!("{LEAST}[model]\nsha256 = \"{hash}\"")).unwrap();
    let setup = Setup::of(config, Path::new("f")).map_err(|error| error.to_string());
    assert_refused(setup, &["model.sha256", &hash]);
}

#[test]
fn only_what_describes_the_sensors_the_model_and_the_log_may_differ_in_a_reload() {
    let old = load(LEAST).unwrap();
    for (more, expected) in [
        ("[publish.unix]\npath = \"/x\"", Some("publish.unix.path")),
        ("[publish.tcp]", Some("publish.tcp")),
        ("[http]", Some("http")),
        (
            "baud = 9600\nframe_rate_hz = 1.0\n[sensor.frame]\npreset = \"jq\"\n\
             [press]\nmin_frames = 3\n[model]\nmin_force_n = 1.0\n[log]\nformat = \"json\"",
            None,
        ),
    ] {
        let difference = old.fixed_difference(&load(&format!("{LEAST}{more}")).unwrap());
        assert_eq!(difference.as_deref(), expected);
    }
}

#[cfg(all(feature = "ros2", feature = "zenoh"))]
#[test]
fn zenoh_and_ros2_take_what_their_networks_do() {
    for (table, expected) in [
        ("zenoh]\nlisten = [\"udp/127.0.0.1:7447\"]", "udp/"),
        ("zenoh]\nconnect = [\"tcp/router\"]", "tcp/router"),
        ("zenoh]\nsite = \"hall//3\"", "zenoh.site"),
        ("zenoh]\nsite = \"**\"", "zenoh.site"),
        (
            "ros2]\nnamespace = \"arm_7\"",
            "ros2.namespace: found \"arm_7\"",
        ),
        ("ros2]\ndomain_id = 233", "found 233, expected 0 to 232"),
        ("ros2]\nnetworks = [\"eth0\"]", "IP address"),
        ("rmw_zenoh]\nconnect = [\"router\"]", "zenoh.connect"),
        ("rmw_zenoh]\nnamespace = \"arm_7\"", "zenoh.namespace"),
    ] {
        assert_refused(load(&format!("{LEAST}[publish.{table}\n")), &[expected]);
    }
    let robot = "robot = \"arm #7\"\n";
    let odd = load(&format!("{robot}{LEAST}[publish.zenoh]\n"));
    assert_refused(odd, &["zenoh.site", "arm #7"]);
    let named = LEAST.replace("port", "name = \"a__b\"\nport");
    for table in ["publish.ros2", "publish.rmw_zenoh"] {
        assert_refused(load(&format!("{named}[{table}]\n")), &["a__b", table]);
    }
    let good = format!("{robot}{LEAST}[publish.zenoh]\nsite = \"hall/3\"\n[publish.ros2]\n");
    let publish = load(&good).unwrap().publish;
    assert_eq!(publish.zenoh.unwrap().site("arm #7"), "hall/3");
    assert_eq!(publish.ros2, Some(Ros2::default()));
}

#[test]
fn a_table_of_a_part_that_was_not_built_in_is_refused_by_name() {
    for (table, feature, built) in [
        ("foxglove", "foxglove", cfg!(feature = "foxglove")),
        ("zenoh", "zenoh", cfg!(feature = "zenoh")),
        ("rmw_zenoh", "zenoh", cfg!(feature = "zenoh")),
        ("ros2", "ros2", cfg!(feature = "ros2")),
    ] {
        let loaded = load(&format!("{LEAST}[publish.{table}]\n"));
        if built {
            assert!(loaded.is_ok(), "{loaded:?}");
        } else {
            let expected = format!(
                "publish.{table}: this hardnessd was built without {feature}: build it with \
                 --features {feature}, or remove the table"
            );
            assert_refused(loaded, &[&expected]);
        }
    }
}

#[test]
fn many_sensors_are_checked_at_once_and_more_are_refused() {
    let table = |index: usize| format!("[[sensor]]\nname = \"s{index}\"\nport = \"p{index}\"\n");
    let most: String = (0..1000).map(table).collect();
    assert!(load(&most).is_ok());
    let more = load(&format!("{most}{}", table(1000)));
    assert_refused(more, &["sensor: found 1001 tables"]);
    let twice = most + "[[sensor]]\nname = \"twice\"\nport = \"p7\"\n";
    assert!(load(&twice.replacen(&table(8), "", 1)).is_ok());
}
