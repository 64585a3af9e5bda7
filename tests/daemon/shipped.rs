//! The shipped files: the real binary accepts them, and they agree with the code.

use std::fs;
use std::path::{Path, PathBuf};

use crate::bench::run;
use hardnessd::daemon::config::Config;
use hardnessd_core::sensor;
use serde_json::{Value, json};

fn shipped(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

#[test]
fn the_shipped_configuration_passes_check_and_equals_the_defaults() {
    let (code, _, errors) = run("check --config config/hardnessd.toml");
    assert_eq!(code, 0, "{errors}");
    let config = Config::load(&shipped("config/hardnessd.toml")).unwrap();
    let port = config.sensors[0].port.clone();
    assert_eq!(config, Config::new(vec![sensor::Settings::new(port)]));
}

/// Every key has a value in `shown`, and that is the default if there is one.
fn compare(shown: &Value, default: &Value, path: &str) {
    match default {
        Value::Object(table) => {
            for (key, default) in table {
                compare(&shown[key], default, &format!("{path}.{key}"));
            }
        }
        Value::Array(tables) if tables.iter().any(Value::is_object) => {
            compare(&shown[0], &tables[0], path);
        }
        Value::Null => assert!(!shown.is_null(), "{path}"),
        default => assert_eq!(shown, default, "{path}"),
    }
}

#[test]
fn the_shipped_configuration_shows_every_key_and_its_default_also_in_lines_that_are_off() {
    let text = fs::read_to_string(shipped("config/hardnessd.toml")).unwrap();
    let is_key = |line: &str| {
        line.split_once(" = ").is_some_and(|(key, _)| {
            key.chars()
                .all(|c| c.is_ascii_lowercase() || "0123456789_".contains(c))
        })
    };
    let on = text.lines().map(|line| match line.strip_prefix("# ") {
        Some(off) if off.starts_with('[') || is_key(off) => off,
        _ => line,
    });
    let on = on.collect::<Vec<_>>().join("\n");
    // It has no key that the daemon does not know.
    let shown: Config = toml::from_str(&on).unwrap();
    // Tables that are off by default have default values too.
    let off =
        "[http]\n[record]\n[publish.tcp]\n[publish.foxglove]\n[publish.zenoh]\n[publish.ros2]";
    let mut defaults: Config = toml::from_str(&format!("[[sensor]]\nport = \"p\"\n{off}")).unwrap();
    defaults.robot = shown.robot.clone();
    defaults.sensors[0].port = shown.sensors[0].port.clone();
    let [shown, defaults] = [shown, defaults].map(|config| json!(config));
    compare(&shown, &defaults, "");
}

#[test]
fn every_file_that_names_the_version_names_this_one() {
    let files = "
        clients/python/pyproject.toml | version = \"VERSION\"
        clients/lerobot/pyproject.toml | version = \"VERSION\"
        clients/ros2/tactile_interfaces/package.xml | <version>VERSION</version>
        CHANGELOG.md | ## VERSION
        docs/operator.md | hardnessd_VERSION-1_amd64.deb";
    for file in files.trim().lines() {
        let (file, expected) = file.trim().split_once(" | ").unwrap();
        let expected = expected.replace("VERSION", env!("CARGO_PKG_VERSION"));
        let text = fs::read_to_string(shipped(file)).unwrap();
        assert!(text.contains(&expected), "{file}: expected {expected:?}");
    }
}
