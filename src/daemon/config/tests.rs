use std::path::Path;

use super::*;

fn load(text: &str) -> Result<Config, String> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hardnessd.toml");
    std::fs::write(&path, text).unwrap();
    Config::load(&path).map_err(|error| error.to_string())
}

const LEAST: &str = "[[sensor]]\nport = \"/dev/ttyUSB0\"\n";

#[test]
fn every_key_but_port_has_a_default() {
    let config = load(LEAST).unwrap();
    assert_eq!(
        config,
        Config::new(vec![Sensor::new(PathBuf::from("/dev/ttyUSB0"))])
    );
    let config = load(&format!(
        "{LEAST}[publish.tcp]\n[http]\n[publish.unix]\npath = \"/x/y.sock\""
    ));
    let config = config.unwrap();
    assert_eq!(config.publish.tcp, Some(Tcp::default()));
    assert_eq!(config.http, Some(Http::default()));
    let control = config.publish.unix.control_path();
    assert_eq!(control, Path::new("/x/control.sock"));
}

#[test]
fn an_error_is_one_line_that_names_file_place_key_found_and_expected() {
    let cases: [(&str, &[&str]); 23] = [
        ("[[sensor]]\nname = \"a\"", &["1:1", "missing field `port`"]),
        ("bad", &["1:"]),
        ("[log]", &["sensor", "found none"]),
        (
            "[[sensor]]\nport = \"p\"\nbauds = 9",
            &["3:1", "`bauds`", "`baud`"],
        ),
        (
            "[[sensor]]\nport = \"p\"\nbaud = \"9\"",
            &["3:8", "baud", "\"9\"", "u32"],
        ),
        ("[[sensor]]\nport = \"p\"\nbaud = 0", &["sensor.baud", "0"]),
        ("[[sensor]]\nport = \"p\"\nname = \"Arm\"", &["name", "Arm"]),
        (
            "[[sensor]]\nport = \"p\"\n[[sensor]]\nport = \"q\"",
            &["name", "twice"],
        ),
        (
            "[[sensor]]\nport = \"p\"\nframe_rate_hz = nan",
            &["frame_rate_hz", "NaN"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[sensor.frame]\nrows = 29",
            &["frame.rows", "29", "28"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[sensor.frame]\nsync = \"xyz\"",
            &["4:", "sync", "xyz", "hex"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[sensor.calibration]\ndead_taxels = [[28, 0]]",
            &["dead_taxels", "28"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[press]\nend_area_taxels = 9",
            &["press.end_area_taxels", "9"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[model]\nmin_confidence = 2.0",
            &["model.min_confidence", "2"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[model]\nsha256 = \"12\"",
            &["model.sha256", "12", "64"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[publish.unix]\nmode = \"0999\"",
            &["4:", "mode", "0999"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[publish.unix]\nmax_clients = 0",
            &["publish.unix.max_clients", "0"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[publish.tcp]\nlisten = \"here:8255\"",
            &["4:10", "listen", "socket address"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[http]\nlisten = 8256",
            &["4:10", "listen", "8256"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[publish.unix]\npath = \"/control.sock\"",
            &["publish.unix.control_path", "/control.sock"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[publish.zenoh]",
            &["publish.zenoh", "not in this version"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[record]\nrotate_mb = 0",
            &["record.rotate_mb", "0"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[log]\nformat = \"xml\"",
            &["4:10", "format", "xml", "journald"],
        ),
    ];
    for (text, expected) in cases {
        let error = load(text).unwrap_err();
        assert!(
            !error.contains('\n') && error.contains("hardnessd.toml:"),
            "{error}"
        );
        for part in expected {
            assert!(error.contains(part), "{text:?}: {part:?} not in {error:?}");
        }
    }
}

#[test]
fn paths_are_relative_to_the_file() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hardnessd.toml");
    let text = "[[sensor]]\nport = \"port\"\n[model]\npath = \"hrn.onnx\"\n\
                [publish.unix]\npath = \"/run/events.sock\"\ncontrol_path = \"c\"";
    std::fs::write(&path, text).unwrap();
    let config = Config::load(&path).unwrap();
    assert_eq!(config.sensors[0].port, directory.path().join("port"));
    assert_eq!(config.model.path, Some(directory.path().join("hrn.onnx")));
    let unix = &config.publish.unix;
    assert_eq!(unix.path(), Path::new("/run/events.sock"));
    assert_eq!(unix.control_path(), directory.path().join("c"));
    let error = Setup::load(&path).unwrap_err().to_string();
    assert!(error.contains("model.path: cannot read"), "{error}");
}

#[test]
fn a_model_of_another_hash_is_refused() {
    let hash = "ab".repeat(32);
    let config = load(&format!("{LEAST}[model]\nsha256 = \"{hash}\"")).unwrap();
    let error = Setup::of(config, Path::new("f")).unwrap_err().to_string();
    assert!(
        error.contains("model.sha256") && error.contains(&hash),
        "{error}"
    );
}

#[test]
fn only_what_a_sensor_can_change_while_it_runs_may_differ_in_a_reload() {
    let old = load(LEAST).unwrap();
    for (text, expected) in [
        ("[[sensor]]\nport = \"/dev/ttyUSB1\"", Some("sensor.port")),
        (
            "[[sensor]]\nport = \"/dev/ttyUSB0\"\nbaud = 9600",
            Some("sensor.baud"),
        ),
        (
            "[[sensor]]\nport = \"/dev/ttyUSB0\"\n[sensor.frame]\npreset = \"jq\"",
            Some("sensor.frame"),
        ),
        (
            "[[sensor]]\nport = \"/dev/ttyUSB0\"\n[publish.unix]\npath = \"/x\"",
            Some("publish.unix.path"),
        ),
        (
            "[[sensor]]\nport = \"/dev/ttyUSB0\"\n[publish.unix]\ncontrol_path = \"/x\"",
            Some("publish.unix.control_path"),
        ),
        (
            "[[sensor]]\nport = \"/dev/ttyUSB0\"\n[publish.tcp]",
            Some("publish.tcp.listen"),
        ),
        (
            "[[sensor]]\nport = \"/dev/ttyUSB0\"\n[http]",
            Some("http.listen"),
        ),
        (
            "[[sensor]]\nport = \"/dev/ttyUSB0\"\n[sensor.calibration]\npitch_mm = 2.0\n\
             [press]\nmin_frames = 3\n[model]\nmin_force_n = 1.0\n[log]\nformat = \"json\"",
            None,
        ),
    ] {
        let difference = old.fixed_difference(&load(text).unwrap());
        match expected {
            Some(key) => assert!(difference.unwrap().starts_with(key)),
            None => assert_eq!(difference, None),
        }
    }
}
