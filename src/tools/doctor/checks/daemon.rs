//! What a running daemon does with a port that it holds: its sensor, and the settings of the line.

use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;

use rustix::fs::{Mode, OFlags};
use rustix::termios::tcgetattr;

use super::{Fault, under};
use crate::daemon::config::{Config, SensorTable};
use crate::daemon::serial::tty::{Changed, make_plain};
use crate::tools::configuration::PLACES;

/// A driver rounds a speed to one that its chip can make.
const ROUNDING: f64 = 0.03;

/// The sensor that the daemon `pid` reads at `device`, by its configuration.
pub(super) fn sensor(root: &Path, pid: u32, device: &Path) -> Option<SensorTable> {
    let process = root.join("proc").join(pid.to_string());
    let line = fs::read(process.join("cmdline")).ok()?;
    let words: Vec<&OsStr> = line
        .split(|&byte| byte == 0)
        .map(OsStr::from_bytes)
        .collect();
    let after = words.iter().position(|word| *word == "--config");
    let given = after.and_then(|index| words.get(index + 1));
    let folder = fs::read_link(process.join("cwd")).unwrap_or_default();
    let path = match given {
        Some(path) => folder.join(path),
        None => {
            let mut places = PLACES.into_iter().map(|place| folder.join(place));
            places.find(|path| under(root, path).exists())?
        }
    };
    let config = Config::load(&under(root, &path)).ok()?;
    let leads_there = |sensor: &SensorTable| {
        let port = sensor
            .port
            .device()
            .and_then(|port| super::device(root, port));
        port.as_deref() == Some(device)
    };
    config.sensors.into_iter().find(leads_there)
}

/// The settings of the line that are not the daemon's. The daemon has the device open, so this resets
/// nothing. Only root may open a device that another process holds.
pub(super) fn line(root: &Path, device: &Path, sensor: Option<&SensorTable>) -> Option<Fault> {
    let flags = OFlags::RDONLY | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let file = rustix::fs::open(under(root, device), flags, Mode::empty()).ok()?;
    let found = tcgetattr(&file).ok()?;
    let speed = found.input_speed();
    let baud = sensor.map_or(speed, |sensor| sensor.baud.get());
    let is_rounded = (f64::from(speed) / f64::from(baud) - 1.0).abs() <= ROUNDING;
    let mut expected = found.clone();
    make_plain(&mut expected, if is_rounded { speed } else { baud }).ok()?;
    Changed::between(&found, &expected).map(|changed| Fault {
        what: format!(
            "another program changed the settings of the line: found {}, expected {}",
            changed.found, changed.expected
        ),
        cure: format!(
            "the daemon sets them again as soon as no frame comes; stop the program, such as \
             `sudo systemctl disable --now serial-getty@{}`",
            device.file_name().unwrap_or_default().display()
        ),
    })
}
