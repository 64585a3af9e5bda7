use std::path::Path;
use std::time::Duration;

use super::*;
use hardnessd_core::exit::CONFIG;
use hardnessd_core::npy;

fn load(text: &str) -> Result<Config, String> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hardnessd.toml");
    std::fs::write(&path, text).unwrap();
    checked(&path)
}

fn checked(path: &Path) -> Result<Config, String> {
    let checked = Config::load(path).and_then(|config| config.check(path).map(|_| config));
    checked.map_err(|error| error.to_string())
}

const LEAST: &str = "[[sensor]]\nport = \"/dev/ttyUSB0\"\n";

#[test]
fn every_key_but_port_has_a_default() {
    let config = load(LEAST).unwrap();
    assert_eq!(
        config,
        Config::new(vec![SensorTable::new(PathBuf::from("/dev/ttyUSB0"))])
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
    let cases: [(&str, &[&str]); 41] = [
        (
            "[[sensor]]\nname = \"a\"",
            &["sensor.port of \"a\" is missing: set it to a path under /dev/serial/by-id/"],
        ),
        (
            "# Two.\n[[sensor]]\nport = \"p\"\n\n[[sensor]]\nname = \"b\"",
            &["sensor.port of \"b\" is missing: set it"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[[sensor]]\nname = \"b\"\nport = \"./p\"",
            &[
                "sensor.port of \"b\"",
                "is the port of \"sensor\"",
                "of its own",
            ],
        ),
        (
            "[[sensor]]\nport = \"\"",
            &["sensor.port of \"sensor\" is missing"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[sensor.frame]\nmask = 65536",
            &["line 4, column 8, `mask = 65536`", "integer `65536`"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[sensor.frame]\nrows = -1",
            &["line 4, column 8, `rows = -1`", "integer `-1`"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[sensor.calibration]\npitch_mm = \"3\"",
            &["`pitch_mm = \"3\"`", "string \"3\""],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[sensor.calibration]\npitch_mm = 1e200",
            &["calibration.pitch_mm: found 1e200,", "at most 1000"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[sensor.calibration]\nnewtons_per_count = 1e38",
            &["newtons_per_count: found 1e38,", "at most 1000"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[http]\nlisten = \"127.0.0.1:99\"\n\
             [publish.tcp]\nlisten = \"0.0.0.0:99\"",
            &["http.listen: 127.0.0.1:99 cannot", "0.0.0.0:99", "another"],
        ),
        (
            "robot = \"\\u202Eevil\"\n[[sensor]]\nport = \"p\"",
            &["robot: found \"\\u{202e}evil\"", "bidirectional characters"],
        ),
        (
            "robot = \"\"\n[[sensor]]\nport = \"p\"",
            &["robot: found \"\"", "expected a name"],
        ),
        ("bad", &["line 1, "]),
        ("[log]", &["no sensor: add a [[sensor]] with a port"]),
        (
            "[[sensor]]\nport = \"p\"\nbauds = 9",
            &["line 3, column 1", "`bauds`", "`baud`"],
        ),
        (
            "[[sensor]]\nport = \"p\"\nbaud = \"9\"",
            &["`baud = \"9\"`", "string \"9\""],
        ),
        (
            "[[sensor]]\nport = \"p\"\nbaud = 0",
            &["`baud = 0`", "integer `0`", "nonzero"],
        ),
        ("[[sensor]]\nport = \"p\"\nname = \"Arm\"", &["name", "Arm"]),
        (
            "[[sensor]]\nport = \"p\"\n[[sensor]]\nport = \"q\"",
            &["name", "two sensors have this name"],
        ),
        (
            "[[sensor]]\nport = \"p\"\nstale_after_ms = 0",
            &["stale_after_ms: found 0.0, expected 0.1 to 3600000 milli"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[sensor.frame]\nrows = 65",
            &["sensor[\"sensor\"].frame.rows", "65", "64"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[sensor.frame]\nsync = \"xyz\"",
            &["line 4, ", "sync", "xyz", "hex"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[sensor.frame]\npreset = \"ascii\"\nsync = \"AA\"",
            &["frame.sync", "frames of preset ascii have no such part"],
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
            &["line 4, ", "mode", "0999"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[publish.unix]\nmax_clients = 0",
            &["publish.unix.max_clients", "0"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[publish.unix]\nmax_clients = 9223372036854775807",
            &["publish.unix.max_clients", "1 to 1000000"],
        ),
        (
            "[[sensor]]\nport = \"p\u{202e}\"",
            &["sensor.port", "the path of a device"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[publish.tcp]\nlisten = \"here:8255\"",
            &[
                "line 4, column 10",
                "listen = \"here:8255\"",
                "socket address",
            ],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[http]\nlisten = 8256",
            &["line 4, column 10", "listen", "8256"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[publish.unix]\npath = \"/control.sock\"",
            &["publish.unix.control_path", "/control.sock"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[publish.unix]\npath = \"\"",
            &["publish.unix.path", "found \"\"", "a path"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[publish.unix]\ncontrol_path = \"a\\nb\"",
            &["publish.unix.control_path", r#""a\nb""#],
        ),
        (
            "[[sensor]]\nport = \"a\\u0000b\"",
            &["sensor.port", r#""a\0b""#, "the path of a device"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[model]\npath = \"\"",
            &["model.path", "found \"\""],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[record]\ndir = \"\"",
            &["record.dir", "found \"\""],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[publish.zenoh]\nlisten = [\"udp/here:1\"]",
            &["line 4, ", "listen", "udp/here:1", "tcp/127.0.0.1:7447"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[record]\nrotate_mb = 0",
            &["record.rotate_mb", "0"],
        ),
        (
            "[[sensor]]\nport = \"p\"\n[log]\nformat = \"xml\"",
            &["line 4, ", "format", "xml", "journald"],
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
fn single_brackets_are_named_as_such() {
    let problem = load("[sensor]\nport = \"p\"\n").unwrap_err();
    assert!(
        problem.ends_with("hardnessd.toml: write [[sensor]], not [sensor]: there may be several"),
        "{problem}"
    );
}

#[test]
fn a_name_that_is_too_long_is_refused_without_being_repeated() {
    let long = "a".repeat(300);
    for (text, expected) in [
        (
            format!("[[sensor]]\nport = \"p\"\nname = \"{long}\""),
            "sensor.name: found 300 characters, expected at most 64",
        ),
        (
            format!("robot = \"{long}\"\n[[sensor]]\nport = \"p\""),
            "robot: found 300 characters, expected a name of at most 255",
        ),
    ] {
        let error = load(&text).unwrap_err();
        assert!(error.contains(expected) && error.len() < 200, "{error}");
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
    let gains = [1.0, 1.1, 0.9, 1.0, 0.5, 2.0];
    let error = checked(&path).unwrap_err();
    let expected = "hardnessd.toml: sensor.calibration.gains of \"sensor\": ";
    assert!(
        error.contains(expected) && error.contains("gains.npy: cannot read: No such file"),
        "{error}"
    );
    write(&npy::to_bytes(&gains, 2, 3));
    let rows = vec![gains[..3].to_vec(), gains[3..].to_vec()];
    let read = checked(&path).unwrap();
    assert_eq!(
        read.sensors[0].calibration.gains,
        Some(tare::Gains::Taxels(rows))
    );
    // The gains may change while the daemon runs.
    write(&npy::to_bytes(&gains.map(|gain| 2.0 * gain), 2, 3));
    let changed = checked(&path).unwrap();
    assert_ne!(read, changed);
    assert_eq!(read.fixed_difference(&changed), None);
    for (bytes, expected) in [
        (
            b"[[1.0]]".to_vec(),
            "gains.npy: found an array that is cut off, expected f32 [rows, cols]",
        ),
        (
            vec![b'#'; 99],
            "gains.npy: found no .npy array, expected f32 [rows, cols]",
        ),
        (
            npy::to_bytes(&gains, 3, 2),
            "sensor[\"sensor\"].calibration.gains: found 3 rows of 2, expected 2 of 3",
        ),
    ] {
        write(&bytes);
        let error = checked(&path).unwrap_err();
        assert!(error.contains(expected) && !error.contains('\n'), "{error}");
    }
    let list = text.replace("\"gains.npy\"", "[[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]");
    let error = load(&list).unwrap_err();
    assert!(
        error.contains("found a list, expected the path of an .npy file"),
        "{error}"
    );
}

#[test]
fn a_file_that_is_no_utf_8_is_a_bad_one_and_its_place_is_named() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hardnessd.toml");
    std::fs::write(&path, b"# a\nrobot = \"\xff\"\n").unwrap();
    let error = Config::load(&path).unwrap_err();
    let text = error.to_string();
    assert!(
        text.contains("toml: invalid utf-8 sequence of 1 bytes from index 13"),
        "{text}"
    );
    assert_eq!(error.exit_code(), CONFIG);
}

#[test]
fn two_names_of_one_device_are_one_port() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("hardnessd.toml");
    std::fs::write(directory.path().join("tty"), "").unwrap();
    std::os::unix::fs::symlink("tty", directory.path().join("by-id")).unwrap();
    let text = "[[sensor]]\nport = \"tty\"\n[[sensor]]\nname = \"b\"\nport = \"by-id\"";
    std::fs::write(&path, text).unwrap();
    let error = checked(&path).unwrap_err();
    assert!(error.contains("sensor.port of \"b\""), "{error}");
}

#[test]
fn listeners_may_share_an_address_or_a_port_but_not_both() {
    for (tcp, http, allowed) in [
        ("127.0.0.1:99", "127.0.0.1:99", false),
        ("0.0.0.0:99", "127.0.0.1:99", false),
        ("127.0.0.1:99", "[::]:99", false),
        ("[::1]:99", "[::]:99", false),
        ("127.0.0.1:99", "127.0.0.1:98", true),
        ("127.0.0.1:99", "127.0.0.2:99", true),
        ("0.0.0.0:99", "[::1]:99", true),
        ("127.0.0.1:0", "127.0.0.1:0", true),
    ] {
        let loaded = load(&format!(
            "{LEAST}[publish.tcp]\nlisten = \"{tcp}\"\n[http]\nlisten = \"{http}\""
        ));
        assert_eq!(loaded.is_ok(), allowed, "{tcp}, {http}: {loaded:?}");
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
    assert_eq!(config.sensors[0].port, directory.path().join("port").into());
    assert_eq!(config.model.path, Some(directory.path().join("hrn.onnx")));
    let unix = &config.publish.unix;
    assert_eq!(unix.path(), Path::new("/run/events.sock"));
    assert_eq!(unix.control_path(), directory.path().join("c"));
    let error = Setup::load(&path, None).unwrap_err().to_string();
    assert!(
        error.contains("model.path: ") && error.contains("hrn.onnx: cannot read: "),
        "{error}"
    );
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

/// Makes a pipe that no program writes to.
fn pipe(path: &Path) {
    let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
    rustix::fs::mknodat(rustix::fs::CWD, path, rustix::fs::FileType::Fifo, mode, 0).unwrap();
}

#[test]
fn a_reload_gives_a_pipe_up_and_a_pipe_that_a_program_writes_is_read() {
    let directory = tempfile::tempdir().unwrap();
    let place = |name: &str| directory.path().join(name);
    let config = place("hardnessd.toml");
    let text = format!(
        "{LEAST}[sensor.frame]\nrows = 1\ncols = 2\n[sensor.calibration]\ngains = \"gains.npy\"\n\
         [model]\npath = \"model.onnx\"\n"
    );
    let files = [
        (
            "hardnessd.toml",
            text.into_bytes(),
            "cannot read: it did not end in time",
        ),
        (
            "gains.npy",
            npy::to_bytes(&[1.0, 1.5], 1, 2),
            "gains.npy: cannot read: it did not end in time",
        ),
        (
            "model.onnx",
            hardnessd_core::verdict::BUILT_IN_HRN.to_vec(),
            "model.onnx: cannot read: it did not end in time",
        ),
    ];
    for (name, bytes, _) in &files {
        std::fs::write(place(name), bytes).unwrap();
    }
    let load = |wait: Duration| {
        let loaded = Setup::load_until(&config, None, Instant::now() + wait);
        loaded.map(drop).map_err(|error| error.to_string())
    };
    let patience = Duration::from_secs(60);
    assert_eq!(load(patience), Ok(()));
    for (name, bytes, expected) in &files {
        let place = place(name);
        std::fs::remove_file(&place).unwrap();
        pipe(&place);
        let begun = Instant::now();
        let error = load(Duration::from_millis(500)).unwrap_err();
        assert!(error.contains(expected), "{error}");
        assert!(
            error.contains("hardnessd.toml: ") && !error.contains('\n'),
            "{error}"
        );
        assert!(begun.elapsed() < Duration::from_secs(30));
        std::thread::scope(|scope| {
            // Opening the pipe for writing waits for its reader.
            scope.spawn(|| std::fs::write(&place, bytes));
            assert_eq!(load(patience), Ok(()), "{name}");
        });
        std::fs::remove_file(&place).unwrap();
        std::fs::write(&place, bytes).unwrap();
        assert_eq!(load(patience), Ok(()), "{name}");
    }
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
            Some("publish.tcp"),
        ),
        ("[[sensor]]\nport = \"/dev/ttyUSB0\"\n[http]", Some("http")),
        (
            "[[sensor]]\nport = \"/dev/ttyUSB0\"\nstale_after_ms = 900\n\
             [sensor.calibration]\npitch_mm = 2.0\n\
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

#[cfg(feature = "zenoh")]
#[test]
fn a_key_of_zenoh_looks_the_same_wherever_it_is_shown() {
    for (key, value) in [
        ("site", "hall\\u202E/3"),
        ("site", "hall\\u0007"),
        ("motion", "arm\\u2066-7/motion"),
    ] {
        let error = load(&format!("{LEAST}[publish.zenoh]\n{key} = \"{value}\"\n")).unwrap_err();
        let expected = format!("publish.zenoh.{key}: found ");
        assert!(error.contains(&expected), "{error}");
        let rest = "control or bidirectional characters";
        assert!(
            error.contains(rest) && hardnessd_core::wording::is_plain(&error),
            "{error:?}"
        );
    }
}

#[cfg(all(feature = "ros2", feature = "zenoh"))]
#[test]
fn zenoh_and_ros2_take_what_their_networks_do() {
    let bad: [(&str, &[&str]); 10] = [
        (
            "zenoh]\nlisten = [\"udp/127.0.0.1:7447\"]",
            &["listen", "udp/"],
        ),
        (
            "zenoh]\nconnect = [\"tcp/router\"]",
            &["connect", "tcp/router"],
        ),
        ("zenoh]\nsite = \"hall//3\"", &["zenoh.site", "hall//3"]),
        ("zenoh]\nsite = \"**\"", &["zenoh.site", "**"]),
        (
            "zenoh]\nmotion = \"*/motion\"",
            &["zenoh.motion", "*/motion"],
        ),
        (
            "ros2]\nmotion = { foot = \"/approach\" }",
            &["ros2.motion", "foot", "the name of a [[sensor]]"],
        ),
        (
            "ros2]\nmotion = { sensor = \"approach\" }",
            &["ros2.motion.sensor", "\"approach\"", "/arm_7/approach"],
        ),
        (
            "ros2]\ndomain_id = 233",
            &["ros2.domain_id", "233", "0 to 232"],
        ),
        ("ros2]\nnamespace = \"arm_7\"", &["ros2.namespace", "arm_7"]),
        (
            "ros2]\nnetworks = [\"eth0\"]",
            &["networks", "eth0", "IP address"],
        ),
    ];
    for (table, expected) in bad {
        let error = load(&format!("{LEAST}[publish.{table}\n")).unwrap_err();
        for part in expected {
            assert!(error.contains(part), "{table:?}: {part:?} not in {error:?}");
        }
    }
    let robot = "robot = \"arm #7\"\n";
    let error = load(&format!("{robot}{LEAST}[publish.zenoh]\n")).unwrap_err();
    assert!(
        error.contains("zenoh.site") && error.contains("arm #7"),
        "{error}"
    );
    let named = LEAST.replace("port", "name = \"a__b\"\nport");
    let error = load(&format!("{named}[publish.ros2]\n")).unwrap_err();
    assert!(error.contains("a__b"), "{error}");
    let good = format!("{robot}{LEAST}[publish.zenoh]\nsite = \"hall/3\"\n[publish.ros2]\n");
    let publish = load(&good).unwrap().publish;
    assert_eq!(publish.zenoh.unwrap().site("arm #7"), "hall/3");
    assert_eq!(publish.ros2, Some(Ros2::default()));
}

#[test]
fn a_table_of_a_part_that_was_not_built_in_is_refused_by_name() {
    for (feature, built) in [
        ("foxglove", cfg!(feature = "foxglove")),
        ("zenoh", cfg!(feature = "zenoh")),
        ("ros2", cfg!(feature = "ros2")),
    ] {
        let loaded = load(&format!("{LEAST}[publish.{feature}]\n"));
        if built {
            assert!(loaded.is_ok(), "{loaded:?}");
        } else {
            let error = loaded.unwrap_err();
            let expected = format!(
                "publish.{feature}: this hardnessd was built without {feature}: build it with \
                 --features {feature}, or remove the table"
            );
            assert!(error.contains(&expected), "{error}");
        }
    }
}

#[test]
fn many_sensors_are_checked_at_once_and_more_are_refused() {
    let table = |index: usize| format!("[[sensor]]\nname = \"s{index}\"\nport = \"p{index}\"\n");
    let most: String = (0..1000).map(table).collect();
    assert!(load(&most).is_ok());
    let error = load(&format!("{most}{}", table(1000))).unwrap_err();
    assert!(error.contains("sensor: found 1001 tables"), "{error}");
    let twice = most + "[[sensor]]\nname = \"twice\"\nport = \"p7\"\n";
    let error = load(&twice.replacen(&table(8), "", 1)).unwrap_err();
    assert!(error.contains("is the port of \"s7\" too"), "{error}");
}
