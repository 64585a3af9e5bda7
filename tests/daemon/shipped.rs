//! The shipped files: the real binary accepts them, and they agree with the code.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use hardnessd::daemon::config::Config;
use hardnessd_core::sensor;
use serde_json::Value;

fn shipped(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

#[test]
fn the_shipped_configuration_passes_check_and_equals_the_defaults() {
    let path = shipped("config/hardnessd.toml");
    let output = Command::new(env!("CARGO_BIN_EXE_hardnessd"))
        .args(["check", "--config"])
        .arg(&path)
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    let config = Config::load(&path).unwrap();
    let port = config.sensors[0].port.clone();
    assert_eq!(config, Config::new(vec![sensor::Settings::new(port)]));
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
    toml::from_str::<Config>(&on).unwrap();
    let mut shown = BTreeMap::new();
    leaves(&toml::from_str(&on).unwrap(), "", &mut shown);
    // Tables that are off by default have default values too.
    let off =
        "[http]\n[record]\n[publish.tcp]\n[publish.foxglove]\n[publish.zenoh]\n[publish.ros2]";
    let defaults: Config = toml::from_str(&format!("[[sensor]]\nport = \"p\"\n{off}")).unwrap();
    let mut expected = BTreeMap::new();
    let mut without = vec!["level.label".to_owned(), "publish.ros2.motion".to_owned()];
    nulls(&serde_json::to_value(&defaults).unwrap(), "", &mut without);
    // Written and read again, an f32 has its own digits.
    let defaults = toml::from_str(&toml::to_string(&defaults).unwrap()).unwrap();
    leaves(&defaults, "", &mut expected);
    expected.remove("robot");
    expected.remove("sensor.port");
    for (path, default) in &expected {
        assert_eq!(shown.get(path), Some(default), "{path}");
    }
    assert!(
        without.contains(&"sensor.stale_after_ms".to_owned()),
        "{without:?}"
    );
    for path in without {
        // A key without a default is shown with an example, and may be a table.
        let table = format!("{path}.");
        let is_shown = |shown: &String| *shown == path || shown.starts_with(&table);
        assert!(shown.keys().any(is_shown), "{path}");
    }
}

/// The paths of the keys that have no default.
fn nulls(value: &Value, path: &str, found: &mut Vec<String>) {
    match value {
        Value::Null => found.push(path.to_owned()),
        Value::Object(table) => {
            for (key, value) in table {
                let below = if path.is_empty() {
                    key.clone()
                } else {
                    format!("{path}.{key}")
                };
                nulls(value, &below, found);
            }
        }
        Value::Array(items) => items.iter().for_each(|item| nulls(item, path, found)),
        _ => {}
    }
}

/// The values that are not tables, as TOML writes them, by the path of their keys.
fn leaves(value: &toml::Value, path: &str, found: &mut BTreeMap<String, String>) {
    match value {
        toml::Value::Table(table) => {
            for (key, value) in table {
                let below = if path.is_empty() {
                    key.clone()
                } else {
                    format!("{path}.{key}")
                };
                leaves(value, &below, found);
            }
        }
        toml::Value::Array(items) if items.iter().any(toml::Value::is_table) => {
            items.iter().for_each(|item| leaves(item, path, found));
        }
        _ => {
            found.insert(path.to_owned(), value.to_string());
        }
    }
}

#[test]
fn every_file_that_names_the_version_names_this_one() {
    let version = env!("CARGO_PKG_VERSION");
    for (file, expected) in [
        (
            "clients/python/pyproject.toml",
            format!("\nversion = \"{version}\"\n"),
        ),
        (
            "clients/ros2/tactile_interfaces/package.xml",
            format!("<version>{version}</version>"),
        ),
        ("CHANGELOG.md", format!("\n## {version}")),
        (
            "docs/operator.md",
            format!("hardnessd_{version}-1_amd64.deb"),
        ),
    ] {
        let text = fs::read_to_string(shipped(file)).unwrap();
        assert!(text.contains(&expected), "{file}: expected {expected:?}");
    }
}
