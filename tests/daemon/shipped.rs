//! The shipped files: the real binary accepts them, and they agree with the code.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use hardnessd::daemon::config::{Config, SensorTable};

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
    assert_eq!(config, Config::new(vec![SensorTable::new(port)]));
}

#[test]
fn the_shipped_configuration_names_every_key() {
    let text = fs::read_to_string(shipped("config/hardnessd.toml")).unwrap();
    let named: Vec<&str> = text
        .lines()
        .filter_map(|line| line.trim_start_matches("# ").split_once(" = "))
        .map(|(key, _)| key)
        .collect();
    let mut keys = Vec::new();
    let defaults = Config::new(vec![SensorTable::new(PathBuf::from("/dev/ttyUSB0"))]);
    collect(&toml::Value::try_from(defaults).unwrap(), &mut keys);
    // Keys without a default value are not in the defaults.
    let silent = "gains stale_after_ms sync tail length cell mask invert checksum rows cols order request request_ms start path sha256 control_path listen connect site domain_id namespace networks dir continuous rotate_mb rotate_s keep_free_mb";
    keys.extend(silent.split(' ').map(str::to_owned));
    for key in keys {
        assert!(
            named.contains(&key.as_str()),
            "{key} is not in config/hardnessd.toml"
        );
    }
}

/// The keys of all values that are not tables.
fn collect(value: &toml::Value, keys: &mut Vec<String>) {
    match value {
        toml::Value::Table(table) => {
            for (key, value) in table {
                match value {
                    toml::Value::Table(_) => {}
                    toml::Value::Array(items) if items.iter().any(toml::Value::is_table) => {}
                    _ => keys.push(key.clone()),
                }
                collect(value, keys);
            }
        }
        toml::Value::Array(items) => items.iter().for_each(|item| collect(item, keys)),
        _ => {}
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
        ("CHANGELOG.md", format!("# Changelog\n\n## {version}")),
        (
            "docs/operator.md",
            format!("hardnessd_{version}-1_amd64.deb"),
        ),
    ] {
        let text = fs::read_to_string(shipped(file)).unwrap();
        assert!(text.contains(&expected), "{file}: expected {expected:?}");
    }
}
