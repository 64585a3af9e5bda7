//! Checks that every value can be used, and that all of them can be used together.

use std::net::{IpAddr, SocketAddr};
use std::path::Path;

use super::error::Error;
use super::{Config, Model, Ros2, SensorTable, Zenoh};
use crate::sensor::Sensor;
use crate::wording;

/// Checks a configuration whose paths are already resolved, and returns its sensors. `path` is only
/// for messages.
pub(super) fn check(config: &Config, path: &Path) -> Result<Vec<Sensor>, Error> {
    let value = |key: String, found: String, expected| Error::Value {
        path: path.to_owned(),
        key,
        found,
        expected,
    };
    let publish = &config.publish;
    for (feature, built, given) in [
        (
            "foxglove",
            cfg!(feature = "foxglove"),
            publish.foxglove.is_some(),
        ),
        ("zenoh", cfg!(feature = "zenoh"), publish.zenoh.is_some()),
        ("ros2", cfg!(feature = "ros2"), publish.ros2.is_some()),
    ] {
        if given && !built {
            return Err(Error::NotBuilt {
                path: path.to_owned(),
                feature,
            });
        }
    }
    let robot = &config.robot;
    let chars = robot.chars().count();
    if chars > MOST_ROBOT_CHARS {
        let found = format!("{chars} characters");
        return Err(value("robot".to_owned(), found, "a name of at most 255"));
    }
    if robot.is_empty() || !wording::is_plain(robot) {
        let expected = "a name without control or bidirectional characters";
        return Err(value("robot".to_owned(), format!("{robot:?}"), expected));
    }
    if config.sensors.is_empty() {
        let expected = "at least one [[sensor]] with a port";
        return Err(value("sensor".to_owned(), "none".to_owned(), expected));
    }
    let mut sensors = Vec::with_capacity(config.sensors.len());
    for (index, given) in config.sensors.iter().enumerate() {
        let sensor = Sensor::new(config.describe(given));
        sensors.push(sensor.map_err(|problem| Error::Sensor {
            path: path.to_owned(),
            sensor: given.name.clone(),
            problem,
        })?);
        check_port(given, &config.sensors[..index], path)?;
    }
    check_model(&config.model, &value)?;
    if config.publish.unix.max_clients == 0 {
        let key = "publish.unix.max_clients".to_owned();
        return Err(value(key, "0".to_owned(), "1 or more"));
    }
    if let Some(record) = &config.record {
        for (key, found, least) in [
            ("record.rotate_mb", record.rotate_mb, 1),
            ("record.rotate_s", record.rotate_s, 1),
            ("record.keep_free_mb", record.keep_free_mb, 0),
        ] {
            if !(least..=MOST).contains(&found) {
                let expected = "1 to 1000000000 (keep_free_mb also 0)";
                return Err(value(key.to_owned(), found.to_string(), expected));
            }
        }
    }
    let unix = &config.publish.unix;
    if unix.enabled && unix.control_path() == unix.path() {
        let key = "publish.unix.control_path".to_owned();
        let found = unix.control_path().display().to_string();
        return Err(value(key, found, "another path than that of events"));
    }
    if let Some(zenoh) = &publish.zenoh {
        check_zenoh(zenoh, &config.robot, &value)?;
    }
    if let Some(ros2) = &publish.ros2 {
        check_ros2(ros2, &config.sensors, &value)?;
    }
    let listeners = [
        (
            "publish.tcp.listen",
            publish.tcp.as_ref().map(|tcp| tcp.listen),
        ),
        (
            "publish.foxglove.listen",
            publish.foxglove.as_ref().map(|foxglove| foxglove.listen),
        ),
        ("http.listen", config.http.as_ref().map(|http| http.listen)),
    ];
    for (index, &(key, listen)) in listeners.iter().enumerate() {
        for &(other_key, other) in &listeners[..index] {
            if let (Some(listen), Some(other)) = (listen, other)
                && meet(listen, other)
            {
                let found = format!("{listen} beside {other_key} = {other}");
                return Err(value(key.to_owned(), found, "another address or port"));
            }
        }
    }
    Ok(sensors)
}

fn check_zenoh(
    zenoh: &Zenoh,
    robot: &str,
    value: &impl Fn(String, String, &'static str) -> Error,
) -> Result<(), Error> {
    // These characters have a meaning in zenoh's key expressions.
    let is_key =
        |key: &str| !key.split('/').any(str::is_empty) && !key.contains(['*', '$', '?', '#']);
    let site = zenoh.site(robot);
    if !is_key(site) {
        return Err(value(
            "publish.zenoh.site".to_owned(),
            format!("{site:?} (by default the robot's name)"),
            "parts of a key, without * $ ? #",
        ));
    }
    if let Some(motion) = zenoh.motion.as_ref().filter(|motion| !is_key(motion)) {
        return Err(value(
            "publish.zenoh.motion".to_owned(),
            format!("{motion:?}"),
            "a key such as \"arm-7/motion\", without * $ ? #",
        ));
    }
    Ok(())
}

fn check_ros2(
    ros2: &Ros2,
    sensors: &[SensorTable],
    value: &impl Fn(String, String, &'static str) -> Error,
) -> Result<(), Error> {
    let found = match ros2.chosen_domain_id() {
        Ok(id) if id > LAST_DOMAIN_ID => Some(format!("{id} (by default $ROS_DOMAIN_ID)")),
        Ok(_) => None,
        Err(found) => Some(found.to_string()),
    };
    if let Some(found) = found {
        return Err(value(
            "publish.ros2.domain_id".to_owned(),
            found,
            "0 to 232",
        ));
    }
    let token = |token: &str| {
        token.starts_with(|first: char| first.is_ascii_alphabetic())
            && token.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
            && !token.contains("__")
    };
    let namespace = &ros2.namespace;
    let tokens = namespace.strip_prefix('/');
    if !tokens.is_some_and(|tokens| tokens.is_empty() || tokens.split('/').all(token)) {
        return Err(value(
            "publish.ros2.namespace".to_owned(),
            format!("{namespace:?}"),
            "a namespace of ROS such as \"/arm_7\"",
        ));
    }
    for (sensor, topic) in &ros2.motion {
        if !sensors.iter().any(|known| known.name == *sensor) {
            return Err(value(
                "publish.ros2.motion".to_owned(),
                format!("{sensor:?}"),
                "the name of a [[sensor]] before each topic",
            ));
        }
        let tokens = topic.strip_prefix('/');
        if !tokens.is_some_and(|tokens| tokens.split('/').all(token)) {
            return Err(value(
                format!("publish.ros2.motion.{sensor}"),
                format!("{topic:?}"),
                "a topic of ROS such as \"/arm_7/approach\"",
            ));
        }
    }
    match sensors.iter().find(|sensor| !token(&sensor.name)) {
        Some(sensor) => Err(value(
            format!("sensor.name of {:?}", sensor.name),
            "two _ in a row".to_owned(),
            "a name that ROS takes, beside publish.ros2",
        )),
        None => Ok(()),
    }
}

/// The most characters of a robot's name, as many as in the longest host name.
const MOST_ROBOT_CHARS: usize = 255;

/// The highest domain ID. The ports of a higher domain would exceed 65535 (DDSI-RTPS 2.5, 9.6.2.3).
const LAST_DOMAIN_ID: u16 = 232;

/// Whether two listeners cannot use these addresses at the same time. For port 0, the system
/// chooses a free port.
fn meet(one: SocketAddr, other: SocketAddr) -> bool {
    // `[::]` also covers all IPv4 addresses, by the kernel's default (bindv6only of ipv6(7)).
    let covers = |all: IpAddr, ip: IpAddr| all.is_unspecified() && (all.is_ipv6() || ip.is_ipv4());
    let (a, b) = (one.ip(), other.ip());
    one.port() == other.port() && one.port() != 0 && (a == b || covers(a, b) || covers(b, a))
}

/// The largest number in `[record]`. As megabytes it is more than any disk has, and the number of
/// bytes still fits in a `u64`. As seconds it is 31 years.
const MOST: u64 = 1_000_000_000;

/// Checks that a sensor has a name and a port of its own.
fn check_port(sensor: &SensorTable, earlier: &[SensorTable], path: &Path) -> Result<(), Error> {
    let name = &sensor.name;
    let value = |key: &str, found: String, expected| {
        let key = format!("sensor.{key} of {name:?}");
        Err(Error::Value {
            path: path.to_owned(),
            key,
            found,
            expected,
        })
    };
    if earlier.iter().any(|other| other.name == *name) {
        return value(
            "name",
            format!("{name:?} twice"),
            "a name of its own for each sensor",
        );
    }
    // A device that exists may have several names.
    let device = |sensor: &SensorTable| {
        let port = &sensor.port;
        port.canonicalize().unwrap_or_else(|_| port.clone())
    };
    if let Some(other) = earlier.iter().find(|other| device(other) == device(sensor)) {
        let found = format!("{}, as for {:?}", sensor.port.display(), other.name);
        return value("port", found, "a port of its own for each sensor");
    }
    Ok(())
}

fn check_model(
    model: &Model,
    value: &impl Fn(String, String, &'static str) -> Error,
) -> Result<(), Error> {
    match &model.sha256 {
        Some(hash) if hash.len() != 64 || !hash.chars().all(|c| c.is_ascii_hexdigit()) => {
            Err(value(
                "model.sha256".to_owned(),
                format!("{hash:?}"),
                "64 hex digits",
            ))
        }
        _ => Ok(()),
    }
}
