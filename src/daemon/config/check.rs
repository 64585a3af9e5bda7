//! Checks that every value can be used, and that all of them can be used together.

use std::collections::{HashMap, HashSet};
use std::net::{IpAddr, SocketAddr};

use super::error::Problem;
use super::{Config, Model, Publish, Record, Ros2, SensorTable, Unix, Zenoh};
use crate::daemon::port::Port;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::wording;

/// Checks a configuration whose paths are already resolved, and returns its sensors.
pub(super) fn check(config: &Config) -> Result<Vec<Sensor>, Problem> {
    let publish = &config.publish;
    check_built(publish)?;
    check_robot(&config.robot)?;
    let sensors = check_sensors(config)?;
    check_model(&config.model)?;
    check_unix(&publish.unix)?;
    if let Some(record) = &config.record {
        check_record(record)?;
    }
    if let Some(zenoh) = &publish.zenoh {
        check_zenoh(zenoh, &config.robot)?;
    }
    if let Some(ros2) = &publish.ros2 {
        check_ros2(ros2, &config.sensors)?;
    }
    check_listeners(config)?;
    Ok(sensors)
}

fn value(key: impl Into<String>, found: String, expected: &'static str) -> Problem {
    Problem::Value {
        key: key.into(),
        found,
        expected,
    }
}

fn clash(key: impl Into<String>, problem: String) -> Problem {
    Problem::Clash {
        key: key.into(),
        problem,
    }
}

/// Checks that this program was built with the features that the tables need.
fn check_built(publish: &Publish) -> Result<(), Problem> {
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
            return Err(Problem::NotBuilt { feature });
        }
    }
    Ok(())
}

fn check_robot(robot: &str) -> Result<(), Problem> {
    let chars = robot.chars().count();
    if chars > MOST_ROBOT_CHARS {
        let found = format!("{chars} characters");
        return Err(value("robot", found, "a name of at most 255"));
    }
    if robot.is_empty() || !wording::is_plain(robot) {
        let expected = "a name without control or bidirectional characters";
        return Err(value("robot", format!("{robot:?}"), expected));
    }
    Ok(())
}

/// Twice as many sensors as a core can read at 100 frames/s.
const MOST_SENSORS: usize = 1000;

fn check_sensors(config: &Config) -> Result<Vec<Sensor>, Problem> {
    if config.sensors.is_empty() {
        return Err(Problem::NoSensor);
    }
    let count = config.sensors.len();
    if count > MOST_SENSORS {
        let found = format!("{count} tables");
        return Err(value("sensor", found, "at most 1000"));
    }
    let mut sensors = Vec::with_capacity(count);
    let mut taken = Taken::default();
    for given in &config.sensors {
        let sensor = Sensor::new(config.describe(given));
        sensors.push(sensor.map_err(|problem| Problem::Sensor {
            sensor: given.name.clone(),
            problem,
        })?);
        taken.add(given)?;
    }
    Ok(sensors)
}

/// More connections than a process may have open files.
const MOST_CLIENTS: usize = 1_000_000;

fn check_unix(unix: &Unix) -> Result<(), Problem> {
    if !(1..=MOST_CLIENTS).contains(&unix.max_clients) {
        let (key, found) = ("publish.unix.max_clients", unix.max_clients.to_string());
        return Err(value(key, found, "1 to 1000000"));
    }
    if unix.enabled && unix.control_path() == unix.path() {
        let problem = format!(
            "{} is the socket of events too: set another path",
            unix.control_path().display()
        );
        return Err(clash("publish.unix.control_path", problem));
    }
    Ok(())
}

fn check_record(record: &Record) -> Result<(), Problem> {
    for (key, found, least) in [
        ("record.rotate_mb", record.rotate_mb, 1),
        ("record.rotate_s", record.rotate_s, 1),
        ("record.keep_free_mb", record.keep_free_mb, 0),
    ] {
        if !(least..=MOST).contains(&found) {
            let expected = "1 to 1000000000 (keep_free_mb also 0)";
            return Err(value(key, found.to_string(), expected));
        }
    }
    Ok(())
}

/// Checks that all tables that listen on the network can do so at the same time.
fn check_listeners(config: &Config) -> Result<(), Problem> {
    let publish = &config.publish;
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
                let problem = format!(
                    "{listen} cannot be used beside {other_key} = {other}: set another address or port"
                );
                return Err(clash(key, problem));
            }
        }
    }
    Ok(())
}

fn check_zenoh(zenoh: &Zenoh, robot: &str) -> Result<(), Problem> {
    // These characters have a meaning in zenoh's key expressions. The log and `fleet` show a site.
    let is_key = |key: &str| {
        !key.split('/').any(str::is_empty)
            && !key.contains(['*', '$', '?', '#'])
            && wording::is_plain(key)
    };
    let site = zenoh.site(robot);
    if !is_key(site) {
        return Err(value(
            "publish.zenoh.site",
            format!("{site:?} (by default the robot's name)"),
            "parts of a key, without * $ ? #, control or bidirectional characters",
        ));
    }
    if let Some(motion) = zenoh.motion.as_ref().filter(|motion| !is_key(motion)) {
        return Err(value(
            "publish.zenoh.motion",
            format!("{motion:?}"),
            "a key such as \"arm-7/motion\", without * $ ? #, control or bidirectional characters",
        ));
    }
    Ok(())
}

fn check_ros2(ros2: &Ros2, sensors: &[SensorTable]) -> Result<(), Problem> {
    let found = match ros2.chosen_domain_id() {
        Ok(id) if id > LAST_DOMAIN_ID => Some(format!("{id} (by default $ROS_DOMAIN_ID)")),
        Ok(_) => None,
        Err(found) => Some(found.to_string()),
    };
    if let Some(found) = found {
        return Err(value("publish.ros2.domain_id", found, "0 to 232"));
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
            "publish.ros2.namespace",
            format!("{namespace:?}"),
            "a namespace of ROS such as \"/arm_7\"",
        ));
    }
    for (sensor, topic) in &ros2.motion {
        if !sensors.iter().any(|known| known.name == *sensor) {
            return Err(value(
                "publish.ros2.motion",
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
        Some(sensor) => Err(clash(
            format!("sensor.name of {:?}", sensor.name),
            "ROS takes no name with two _ in a row: rename the sensor, or remove publish.ros2"
                .to_owned(),
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

/// The names and the ports that sensors have so far.
#[derive(Default)]
struct Taken<'a> {
    names: HashSet<&'a str>,
    /// The sensor of each port. A device that exists may have several names.
    ports: HashMap<Port, &'a str>,
}

impl<'a> Taken<'a> {
    /// Checks that a sensor has a name and a port of its own.
    fn add(&mut self, sensor: &'a SensorTable) -> Result<(), Problem> {
        let name = &sensor.name;
        let key = |key| format!("sensor.{key} of {name:?}");
        if !self.names.insert(name) {
            let problem = "two sensors have this name: give each a name of its own".to_owned();
            return Err(clash(key("name"), problem));
        }
        let port = &sensor.port;
        let device = port.device().and_then(|path| path.canonicalize().ok());
        let one = device.map_or_else(|| port.clone(), Port::Device);
        if let Some(other) = self.ports.insert(one, name) {
            let problem =
                format!("{port} is the port of {other:?} too: give each sensor a port of its own");
            return Err(clash(key("port"), problem));
        }
        Ok(())
    }
}

fn check_model(model: &Model) -> Result<(), Problem> {
    match &model.sha256 {
        Some(hash) if hash.len() != 64 || !hash.chars().all(|c| c.is_ascii_hexdigit()) => {
            let found = format!("{hash:?}");
            Err(value("model.sha256", found, "64 hex digits"))
        }
        _ => Ok(()),
    }
}
