//! Checks that every value can be used, and that all of them can be used together.

use std::collections::{HashMap, HashSet};
use std::fmt::Display;

use super::error::Problem;
use super::{Config, Publish, Ros2, Unix, Zenoh};
use crate::daemon::baud::Load;
use hardnessd_core::port::Port;
use hardnessd_core::sensor::{self, Sensor};
use hardnessd_core::{verdict, wording};

/// Checks a configuration whose paths are already resolved, and returns its sensors.
pub(super) fn check(config: &Config) -> Result<Vec<Sensor>, Problem> {
    let publish = &config.publish;
    check_built(publish)?;
    check_robot(&config.robot)?;
    let sensors = check_sensors(config)?;
    check_model(&config.model)?;
    check_unix(&publish.unix)?;
    if let Some(record) = &config.record {
        let ranges = record.check_ranges();
        ranges.map_err(|error| error.within("record"))?;
    }
    if let Some(zenoh) = &publish.zenoh {
        check_zenoh(zenoh, &config.robot)?;
    }
    if let Some(ros2) = &publish.ros2 {
        check_ros2(ros2, &config.sensors)?;
    }
    Ok(sensors)
}

/// The problem of a value.
fn value(key: &str, found: impl Display, expected: &str) -> Problem {
    Problem::found(key, found, expected)
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
            let problem = format_args!(
                "this hardnessd was built without {feature}: build it with --features {feature}, or \
                 remove the table"
            );
            return Err(Problem::because(&format!("publish.{feature}"), problem));
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
        let problem = "no sensor: add a [[sensor]] with a port";
        return Err(Problem::Syntax(problem.to_owned()));
    }
    let count = config.sensors.len();
    if count > MOST_SENSORS {
        let found = format!("{count} tables");
        return Err(value("sensor", found, "at most 1000"));
    }
    let mut sensors = Vec::with_capacity(count);
    let mut taken = Taken::default();
    for (index, given) in config.sensors.iter().enumerate() {
        let sensor = Sensor::new(config.describe(given)).map_err(Problem::from);
        let sensor = sensor.and_then(|sensor| {
            taken.add(given)?;
            check_load(given, &sensor)?;
            Ok(sensor)
        });
        sensors.push(sensor.map_err(|problem| problem.of((index, given)))?);
    }
    Ok(sensors)
}

/// Checks that the line of a sensor can carry its frames. A warning is enough where that is uncertain.
fn check_load(given: &sensor::Settings, sensor: &Sensor) -> Result<(), Problem> {
    match Load::of(given, sensor.layout()).excess {
        Some(excess) if excess.is_certain => Err(Problem::because("sensor.frame_rate_hz", excess)),
        _ => Ok(()),
    }
}

fn check_unix(unix: &Unix) -> Result<(), Problem> {
    let ranges = unix.check_ranges();
    ranges.map_err(|error| error.within("publish.unix"))?;
    if unix.enabled && unix.control_path() == unix.path() {
        let problem = format!(
            "{} is the socket of events too: set another path",
            unix.control_path().display()
        );
        return Err(Problem::because("publish.unix.control_path", problem));
    }
    Ok(())
}

fn check_zenoh(zenoh: &Zenoh, robot: &str) -> Result<(), Problem> {
    // These characters have a meaning in zenoh's key expressions. The log shows a site.
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

fn check_ros2(ros2: &Ros2, sensors: &[sensor::Settings]) -> Result<(), Problem> {
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
                &format!("publish.ros2.motion.{sensor}"),
                format!("{topic:?}"),
                "a topic of ROS such as \"/arm_7/approach\"",
            ));
        }
    }
    for (index, sensor) in sensors.iter().enumerate() {
        if !token(&sensor.name) {
            let problem =
                "ROS takes no name with two _ in a row: rename the sensor, or remove publish.ros2";
            return Err(Problem::because("sensor.name", problem).of((index, sensor)));
        }
    }
    Ok(())
}

/// The most characters of a robot's name, as many as in the longest host name.
const MOST_ROBOT_CHARS: usize = 255;

/// The highest domain ID. The ports of a higher domain would exceed 65535 (DDSI-RTPS 2.5, 9.6.2.3).
const LAST_DOMAIN_ID: u16 = 232;

/// The names and the ports that sensors have so far.
#[derive(Default)]
struct Taken<'a> {
    names: HashSet<&'a str>,
    /// The first sensor of each port. A device that exists may have several names.
    ports: HashMap<Port, &'a sensor::Settings>,
}

impl<'a> Taken<'a> {
    /// Checks that a sensor has a name of its own, and that sensors that share a port agree on it.
    fn add(&mut self, sensor: &'a sensor::Settings) -> Result<(), Problem> {
        let name = &sensor.name;
        if !self.names.insert(name) {
            let problem = "two sensors have this name: give each a name of its own";
            return Err(Problem::because("sensor.name", problem));
        }
        let port = &sensor.port;
        let device = port.device().and_then(|path| path.canonicalize().ok());
        let one = device.map_or_else(|| port.clone(), Port::Device);
        let first = *self.ports.entry(one).or_insert(sensor);
        let other = &first.name;
        if first.port != *port {
            let problem = format!(
                "{port} is the port of {other:?} too, which calls it {}: write the same name for both",
                first.port
            );
            return Err(Problem::because("sensor.port", problem));
        }
        if first.baud != sensor.baud {
            let problem = format!(
                "found {}, expected {} as for {other:?}, which has the same port",
                sensor.baud, first.baud
            );
            return Err(Problem::because("sensor.baud", problem));
        }
        Ok(())
    }
}

fn check_model(model: &verdict::Settings) -> Result<(), Problem> {
    match &model.sha256 {
        Some(hash) if hash.len() != 64 || !hash.chars().all(|c| c.is_ascii_hexdigit()) => {
            let found = format!("{hash:?}");
            Err(value("model.sha256", found, "64 hex digits"))
        }
        _ => Ok(()),
    }
}
