//! Every key in force and where it comes from, as TOML.

use super::Setup;
use hardnessd_core::press;
use hardnessd_core::sensor::Sensor;
use hardnessd_core::tare::Gains;
use hardnessd_core::wire::Preset;

impl Setup {
    /// Every key in force as a line of TOML, with a comment that says where the key comes from: `written`,
    /// `default`, or a preset.
    ///
    /// # Errors
    ///
    /// Fails for a path that is not UTF-8, which TOML cannot hold.
    pub fn in_force(&self) -> Result<String, toml::ser::Error> {
        let mut config = self.config.clone();
        for (table, sensor) in config.sensors.iter_mut().zip(&self.sensors) {
            table.stale_after_ms = Some(sensor.stale_after().as_secs_f64() * 1e3);
            let frame = table.frame.in_force();
            table.frame = frame.expect("a sensor has been checked");
            let gains = table.calibration.gains.as_ref();
            if let Some([least, most]) = gains.and_then(Gains::extent) {
                let shown = format!("{least:.2} to {most:.2}");
                table.calibration.gains = Some(Gains::File(shown.into()));
            }
        }
        let press = self.press_in_force();
        let is_alike = press.is_some();
        config.press = press.unwrap_or(config.press);
        let unix = &mut config.publish.unix;
        (unix.path, unix.control_path) = (Some(unix.path()), Some(unix.control_path()));
        if let Some(record) = &mut config.record {
            record.dir = Some(record.dir());
        }
        let text = toml::to_string(&config)?;
        let (mut table, mut sensors) = (String::new(), 0);
        let mut lines = String::new();
        for line in text.lines() {
            lines += line;
            if line.starts_with('[') {
                table = format!("{}.", line.trim_matches(['[', ']']));
                sensors += usize::from(line == "[[sensor]]");
            } else if let Some((key, _)) = line.split_once(" = ") {
                let source = self.source(&format!("{table}{key}"), sensors.saturating_sub(1));
                lines += &format!("  # {source}");
            }
            lines.push('\n');
            if line == "[press]" && !is_alike {
                lines.extend(self.sensors.iter().map(of_sensor));
            }
        }
        Ok(lines)
    }

    /// The `[press]` table, if it is that of all sensors: thresholds depend on the taxels.
    fn press_in_force(&self) -> Option<press::Settings> {
        let mut sensors = self
            .sensors
            .iter()
            .map(|sensor| sensor.for_recording().press);
        let first = sensors.next().unwrap_or_default();
        sensors.all(|press| press == first).then_some(first)
    }

    /// Where the value of a key comes from.
    fn source(&self, key: &str, index: usize) -> String {
        if self.text.is_written(index, key) {
            return "written".to_owned();
        }
        let preset = |frame: &str| {
            let preset = self.config.sensors[index].frame.preset();
            let part = frame.split('.').next()?;
            let is_its = preset != Preset::None && preset.keys().contains_key(part);
            is_its.then(|| format!("preset {preset}"))
        };
        let frame = key.strip_prefix("sensor.frame.");
        frame.and_then(preset).unwrap_or("default".to_owned())
    }
}

/// The thresholds of a sensor, as a comment.
fn of_sensor(sensor: &Sensor) -> String {
    let of = sensor.thresholds();
    format!(
        "# {}: contact_threshold_n = {}, begin_area_taxels = {}, end_area_taxels = {}\n",
        sensor.name(),
        of.contact_threshold_n,
        of.begin_area_taxels,
        of.end_area_taxels
    )
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::daemon::config::Config;

    #[test]
    fn every_key_in_force_is_shown_with_its_source() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("hardnessd.toml");
        let text = "[[sensor]]\nport = \"/dev/ttyACM0\"\n[sensor.frame]\npreset = \"jq\"\nrows = 9\n\
                    [[sensor]]\nname = \"own\"\nport = \"/dev/ttyACM1\"\n\
                    frame = { sync = \"A5\" }\n\
                    [[sensor]]\nname = \"film\"\nport = \"/dev/ttyACM2\"\nframe = { rows = 9 }\n\
                    [press]\nmax_seconds = 5.0\n";
        std::fs::write(&path, text).unwrap();
        let setup = Setup::load(&path, None).unwrap();
        let lines = setup.in_force().unwrap();
        let (first, rest) = lines.split_once("name = \"own\"").unwrap();
        let (own, film) = rest.split_once("name = \"film\"").unwrap();
        for (part, line) in [
            (first, "baud = 115200  # default"),
            (first, "stale_after_ms = 600.0  # default"),
            (first, "preset = \"jq\"  # written"),
            (first, "sync = \"AA 55 03 99\"  # preset jq"),
            (first, "length = \"none\"  # default"),
            (first, "mask = 255  # default"),
            (first, "rows = 9  # written"),
            (first, "newtons_per_count = 0.04  # default"),
            (own, "preset = \"none\"  # default"),
            (own, "sync = \"A5\"  # written"),
            (own, "length = \"none\"  # default"),
            (film, "preset = \"jx255n\"  # default"),
            (film, "length = \"u16le\"  # preset jx255n"),
            (film, "max_seconds = 5.0  # written"),
            (film, "contact_threshold_n = 0.07  # default"),
            (film, "mode = \"0660\"  # default"),
        ] {
            assert!(part.contains(&format!("{line}\n")), "{line} in {part}");
        }
        let unlike = text.replace("[press]", "[sensor.calibration]\npitch_mm = 7.0\n[press]");
        std::fs::write(&path, unlike).unwrap();
        let unlike = Setup::load(&path, None).unwrap().in_force().unwrap();
        for thresholds in [
            "own: contact_threshold_n = 0.07, begin_area_taxels = 3, end_area_taxels = 1",
            "film: contact_threshold_n = 0.28, begin_area_taxels = 3, end_area_taxels = 1",
        ] {
            assert!(unlike.contains(&format!("# {thresholds}\n")), "{unlike}");
        }
        // It is a configuration again, and the same one.
        let again: Config = toml::from_str(&lines).unwrap();
        let again = Setup::of(again, Path::new("again")).unwrap();
        assert_eq!(again.sensors[1].layout(), setup.sensors[1].layout());
    }
}
