//! Checks that every value can be used, and that all of them can be used together.

use super::error::Problem;
use super::{Config, Publish, Unix, Zenoh, domain_id};
use crate::daemon::port;
use hardnessd_core::range::OutOfRange;
use hardnessd_core::sensor::{self, Description, Sensor};
use hardnessd_core::{range, verdict, wording};

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
        let (domain, namespace) = (ros2.domain_id, &ros2.namespace);
        check_ros("publish.ros2", domain, namespace, &config.sensors)?;
    }
    if let Some(ros) = &publish.rmw_zenoh {
        check_endpoints("publish.rmw_zenoh.listen", &ros.listen)?;
        check_endpoints("publish.rmw_zenoh.connect", &ros.connect)?;
        let (domain, namespace) = (ros.domain_id, &ros.namespace);
        check_ros("publish.rmw_zenoh", domain, namespace, &config.sensors)?;
    }
    Ok(sensors)
}

/// Checks that this program was built with the features that the tables need.
fn check_built(publish: &Publish) -> Result<(), OutOfRange> {
    let (has_zenoh, has_ros2) = (cfg!(feature = "zenoh"), cfg!(feature = "ros2"));
    let has_foxglove = cfg!(feature = "foxglove");
    for (table, feature, is_built, is_given) in [
        (
            "foxglove",
            "foxglove",
            has_foxglove,
            publish.foxglove.is_some(),
        ),
        ("zenoh", "zenoh", has_zenoh, publish.zenoh.is_some()),
        ("rmw_zenoh", "zenoh", has_zenoh, publish.rmw_zenoh.is_some()),
        ("ros2", "ros2", has_ros2, publish.ros2.is_some()),
    ] {
        if is_given && !is_built {
            let problem = format_args!(
                "this hardnessd was built without {feature}: build it with --features {feature}, or \
                 remove the table"
            );
            return Err(OutOfRange::because(&format!("publish.{table}"), problem));
        }
    }
    Ok(())
}

fn check_robot(robot: &str) -> Result<(), OutOfRange> {
    let chars = robot.chars().count();
    if chars > MOST_ROBOT_CHARS {
        let found = format_args!("{chars} characters");
        return Err(OutOfRange::new("robot", found, "a name of at most 255"));
    }
    let expected = "a name without control or bidirectional characters";
    let fits = !robot.is_empty() && wording::is_plain(robot);
    range::check("robot", robot, fits, expected)
}

/// Twice as many sensors as a core can read at 100 frames/s.
const MOST_SENSORS: usize = 1000;

fn check_sensors(config: &Config) -> Result<Vec<Sensor>, Problem> {
    if config.sensors.is_empty() {
        let problem = "no sensor: add a [[sensor]] with a port";
        return Err(Problem::of_file(problem));
    }
    let count = config.sensors.len();
    if count > MOST_SENSORS {
        let found = format_args!("{count} tables");
        return Err(OutOfRange::new("sensor", found, "at most 1000").into());
    }
    let checked = |(index, given): (usize, &sensor::Settings)| {
        let described = Description {
            sensor: given.clone(),
            press: config.press.clone(),
            model: config.model.clone(),
        };
        let sensor = Sensor::new(described).map_err(Problem::from);
        let sensor = sensor.and_then(|sensor| {
            check_beside(given, &config.sensors[..index])?;
            let carried = port::check_baud(given, sensor.layout());
            carried.map_err(|problem| OutOfRange::because("sensor.frame_rate_hz", problem))?;
            Ok(sensor)
        });
        sensor.map_err(|problem| problem.of((index, given)))
    };
    config.sensors.iter().enumerate().map(checked).collect()
}

fn check_unix(unix: &Unix) -> Result<(), OutOfRange> {
    let ranges = unix.check_ranges();
    ranges.map_err(|error| error.within("publish.unix"))?;
    if unix.enabled && unix.control_path() == unix.path() {
        let problem = format!(
            "{} is the socket of events too: set another path",
            unix.control_path().display()
        );
        return Err(OutOfRange::because("publish.unix.control_path", problem));
    }
    Ok(())
}

fn check_zenoh(zenoh: &Zenoh, robot: &str) -> Result<(), OutOfRange> {
    check_endpoints("publish.zenoh.listen", &zenoh.listen)?;
    check_endpoints("publish.zenoh.connect", &zenoh.connect)?;
    let site = zenoh.site(robot);
    // These characters have a meaning in zenoh's key expressions. The log shows a site.
    let is_key = !site.split('/').any(str::is_empty)
        && !site.contains(['*', '$', '?', '#'])
        && wording::is_plain(site);
    let expected = "parts of a key (by default the robot's name), without * $ ? #, control or \
                    bidirectional characters";
    range::check("publish.zenoh.site", site, is_key, expected)
}

fn check_endpoints(key: &str, endpoints: &[String]) -> Result<(), OutOfRange> {
    for endpoint in endpoints {
        let expected = "an endpoint such as \"tcp/127.0.0.1:7447\"";
        let fits = Zenoh::address(endpoint).is_some();
        range::check(key, endpoint, fits, expected)?;
    }
    Ok(())
}

/// Checks what both tables of ROS 2 have.
fn check_ros(
    table: &str,
    domain: Option<u16>,
    namespace: &str,
    sensors: &[sensor::Settings],
) -> Result<(), OutOfRange> {
    let key = format!("{table}.domain_id");
    let expected = "0 to 232 (by default $ROS_DOMAIN_ID)";
    match domain_id(domain) {
        Ok(id) => range::check(&key, id, id <= LAST_DOMAIN_ID, expected)?,
        Err(found) => {
            return Err(OutOfRange::new(&key, format_args!("{found}"), expected));
        }
    }
    let token = |token: &str| {
        token.starts_with(|first: char| first.is_ascii_alphabetic())
            && token.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
            && !token.contains("__")
    };
    let tokens = namespace.strip_prefix('/');
    let fits = tokens.is_some_and(|tokens| tokens.is_empty() || tokens.split('/').all(token));
    let expected = "a namespace of ROS such as \"/arm_7\"";
    range::check(&format!("{table}.namespace"), namespace, fits, expected)?;
    let fits = |sensor: &&sensor::Settings| token(&sensor.name);
    match sensors.iter().find(|sensor| !fits(sensor)) {
        Some(sensor) => Err(OutOfRange::new(
            "sensor.name",
            format_args!("{}", sensor.name),
            format_args!("a name without two _ in a row, for {table}"),
        )),
        None => Ok(()),
    }
}

/// The most characters of a robot's name, as many as in the longest host name.
const MOST_ROBOT_CHARS: usize = 255;

/// The highest domain ID. The ports of a higher domain would exceed 65535 (DDSI-RTPS 2.5, 9.6.2.3).
const LAST_DOMAIN_ID: u16 = 232;

/// Checks that a sensor has a name of its own, and agrees with those before it on the port that they share.
fn check_beside(sensor: &sensor::Settings, before: &[sensor::Settings]) -> Result<(), OutOfRange> {
    if before.iter().any(|other| other.name == sensor.name) {
        let problem = "two sensors have this name: give each a name of its own";
        return Err(OutOfRange::because("sensor.name", problem));
    }
    let mut at_its_port = before.iter().filter(|other| other.port == sensor.port);
    let Some(first) = at_its_port.find(|first| first.baud != sensor.baud) else {
        return Ok(());
    };
    let expected = format!(
        "{} as for {:?}, which has the same port",
        first.baud, first.name
    );
    Err(OutOfRange::new("sensor.baud", sensor.baud, expected))
}

fn check_model(model: &verdict::Settings) -> Result<(), OutOfRange> {
    let Some(hash) = &model.sha256 else {
        return Ok(());
    };
    let fits = hash.len() == 64 && hash.chars().all(|c| c.is_ascii_hexdigit());
    range::check("model.sha256", hash, fits, "64 hex digits")
}
