//! A sensor: the tables of a configuration that describe it.
//!
//! In: a [`Description`] from a configuration or a recording. Out: a [`Sensor`]. Every value of a
//! [`Sensor`] is in its range, and the values fit each other, so no other module checks them again.

use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::port::Port;
use crate::press::Thresholds;
use crate::range::{OutOfRange, check, from_to};
use crate::wire::{self, Layout};
use crate::{motion, press, tare, verdict};

crate::settings! {
    /// The `[[sensor]]` table. By default, it is a JX255N (paper, "Tactile sensor").
    pub struct Settings {
        /// The sensor's name: `[a-z][a-z0-9_]*`.
        pub name: String = "sensor".to_owned();
        /// The sensor's port, which a configuration must name.
        pub port: Port = Port::default();
        /// The baud rate of the serial line, in bits per second. A pty and USB CDC ignore it.
        pub baud: u32 = 115_200, in from_to((50.0, 20_000_000.0), "bits/s");
        /// The number of frames that the sensor is expected to send in a second.
        pub frame_rate_hz: f64 = DEFAULT_FRAME_RATE_HZ, in from_to(FRAME_RATES_HZ, "frames a second");
        /// The silence after which a live sensor is stale. `None` means the larger of three periods and
        /// 150 ms. Nobody waits longer than an hour for a frame.
        pub stale_after_ms: Option<f64>, in from_to((0.1, 3_600_000.0), "milliseconds");
        /// The file with presses of known pieces on this sensor, as `identify` makes it.
        pub references: Option<PathBuf>;
        /// The number of the sensor's last presses that serve as its references. 0 keeps none.
        pub own_presses: u32 = 16, in from_to((0.0, 32.0), "presses");
        /// How the sensor writes a frame.
        pub frame: wire::Settings = wire::Settings::default();
        /// How counts become newtons.
        pub calibration: tare::Settings = tare::Settings::default();
        /// The arm that presses with this sensor.
        pub arm: motion::Settings = motion::Settings::default();
    }
}

impl Settings {
    /// A sensor at `port`, with the defaults of all other keys.
    pub fn new(port: impl Into<Port>) -> Self {
        Self {
            port: port.into(),
            ..Self::default()
        }
    }
}

/// The description of a sensor: the tables of a configuration that hold for it. Its values are
/// unchecked.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Description {
    /// The `[[sensor]]` table.
    #[serde(flatten)]
    pub sensor: Settings,
    /// The `[press]` table.
    pub press: press::Settings,
    /// The `[model]` table.
    pub model: verdict::Settings,
}

/// The frame rate of the paper's sensor.
pub const DEFAULT_FRAME_RATE_HZ: f64 = 5.0;

/// The accepted frame rates: a wider range than that of any sensor, but every period is still a
/// sane time to wait.
pub const FRAME_RATES_HZ: (f64, f64) = (0.01, 10_000.0);

/// The longest name. A name is part of topics, of file names and of each line of the log.
pub const MOST_NAME_CHARS: usize = 64;

/// The first frame after the port was opened is late after this many periods.
pub const LATE_PERIODS: f64 = 2.5;

/// The stale time by default: this many periods, but at least this time. A sender whose frames come
/// unevenly at 50 frames/s was stale 267 times in five minutes with 50 ms.
const STALE_PERIODS: f64 = 3.0;
const LEAST_STALE_AFTER: Duration = Duration::from_millis(150);

/// A sensor whose description has been checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Sensor {
    description: Description,
    layout: Layout,
    thresholds: Thresholds,
    stale_after: Duration,
}

impl Settings {
    /// Checks every value. Returns the layout of a frame.
    fn check(&self) -> Result<Layout, OutOfRange> {
        let part = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        let name = &self.name;
        let found = name.chars().count();
        check(
            "name",
            format_args!("{found} characters"),
            found <= MOST_NAME_CHARS,
            format_args!("at most {MOST_NAME_CHARS}"),
        )?;
        check(
            "name",
            name,
            name.starts_with(|first: char| first.is_ascii_lowercase()) && name.chars().all(part),
            "a letter a to z, then letters a to z, digits or _",
        )?;
        self.check_ranges()?;
        let layout = Layout::new(&self.frame).map_err(|error| error.within("frame"))?;
        let calibration = self.calibration.check(layout.array());
        calibration.map_err(|error| error.within("calibration"))?;
        let arm = self.arm.check_ranges();
        arm.map_err(|error| error.within("arm"))?;
        Ok(layout)
    }
}

impl Sensor {
    /// Checks a description.
    ///
    /// # Errors
    ///
    /// Returns an error for the first value that is out of its range or does not fit the layout. Its
    /// key begins with the table: `sensor`, `press` or `model`.
    ///
    /// # Example
    ///
    /// ```
    /// use hardnessd_core::sensor::{Description, Sensor};
    ///
    /// let described = |frame_rate_hz| {
    ///     let mut described = Description::default();
    ///     described.sensor.frame_rate_hz = frame_rate_hz;
    ///     described
    /// };
    /// let sensor = Sensor::new(described(100.0))?;
    /// assert_eq!(sensor.period().as_millis(), 10);
    /// assert_eq!(sensor.stale_after().as_millis(), 150);
    ///
    /// let error = Sensor::new(described(0.0)).unwrap_err();
    /// assert!(error.to_string().starts_with("sensor.frame_rate_hz: found 0.0, expected"));
    /// # Ok::<(), hardnessd_core::range::OutOfRange>(())
    /// ```
    pub fn new(description: Description) -> Result<Self, OutOfRange> {
        let Description {
            sensor,
            press,
            model,
        } = &description;
        let layout = sensor.check().map_err(|error| error.within("sensor"))?;
        let thresholds = press.check(layout.array(), sensor.calibration.pitch_mm);
        let thresholds = thresholds.map_err(|error| error.within("press"))?;
        let ranges = model.check_ranges();
        ranges.map_err(|error| error.within("model"))?;
        let stale_after = match sensor.stale_after_ms {
            None => LEAST_STALE_AFTER.max(period(sensor.frame_rate_hz).mul_f64(STALE_PERIODS)),
            Some(ms) => Duration::from_nanos((ms * 1e6).round() as u64),
        };
        Ok(Self {
            layout,
            thresholds,
            stale_after,
            description,
        })
    }

    /// The checked description of the sensor.
    pub fn description(&self) -> &Description {
        &self.description
    }

    /// The sensor's name.
    pub fn name(&self) -> &str {
        &self.description.sensor.name
    }

    /// The thresholds of presses, for the size of the sensor's taxels.
    pub fn thresholds(&self) -> &Thresholds {
        &self.thresholds
    }

    /// The `[sensor.calibration]` table.
    pub fn calibration(&self) -> &tare::Settings {
        &self.description.sensor.calibration
    }

    /// The `[sensor.arm]` table.
    pub fn arm(&self) -> &motion::Settings {
        &self.description.sensor.arm
    }

    /// The number of frames that the sensor is expected to send in a second.
    pub fn frame_rate_hz(&self) -> f64 {
        self.description.sensor.frame_rate_hz
    }

    /// The description as a recording holds it, without the port and files of this machine. Values
    /// whose default is computed are written, so a later default does not change what a recording
    /// says.
    pub fn for_recording(&self) -> Description {
        let mut description = self.description.clone();
        let Description {
            sensor,
            press,
            model,
        } = &mut description;
        sensor.port = Port::default();
        sensor.references = None;
        sensor.stale_after_ms = Some(self.stale_after.as_nanos() as f64 / 1e6);
        press.contact_threshold_n = Some(self.thresholds.contact_threshold_n);
        press.begin_area_taxels = Some(self.thresholds.begin_area_taxels);
        press.end_area_taxels = Some(self.thresholds.end_area_taxels);
        (model.path, model.sha256) = (None, None);
        description
    }

    /// How the sensor writes a frame.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// The expected time from frame to frame.
    pub fn period(&self) -> Duration {
        period(self.frame_rate_hz())
    }

    /// The time after which a missing frame is late: 2.5 periods.
    pub fn late_after(&self) -> Duration {
        self.period().mul_f64(LATE_PERIODS)
    }

    /// How long a live sensor may be silent before it is stale.
    pub fn stale_after(&self) -> Duration {
        self.stale_after
    }
}

fn period(frame_rate_hz: f64) -> Duration {
    Duration::from_secs_f64(1.0 / frame_rate_hz)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_that_no_sensor_has_is_refused_with_its_key() {
        for (keys, expected) in [
            ("name = 'Arm'", "sensor.name: found \"Arm\""),
            ("frame_rate_hz = nan", "sensor.frame_rate_hz"),
            ("frame.rows = 65", "sensor.frame.rows"),
            ("frame.request_ms = 5", "sensor.frame.request_ms"),
            (
                "calibration.dead_taxels = [[28, 0]]",
                "sensor.calibration.dead_taxels: found [28, 0]",
            ),
            ("press.end_frames = 0", "press.end_frames: found 0"),
            ("model.min_confidence = 1.5", "model.min_confidence"),
        ] {
            // A description has all its tables.
            let text = format!("{keys}\npress.min_frames = 2\nmodel.min_force_n = 0.0");
            let described: Description = toml::from_str(&text).unwrap();
            let error = Sensor::new(described).unwrap_err().to_string();
            assert!(error.starts_with(expected), "{error}");
        }
    }

    #[test]
    fn a_recording_holds_how_long_a_silence_is_stale() {
        for (hz, ms) in [(5.0, None), (100.0, None), (3.0, None), (100.0, Some(33.3))] {
            let mut described = Description::default();
            described.sensor.frame_rate_hz = hz;
            described.sensor.stale_after_ms = ms;
            let sensor = Sensor::new(described).unwrap();
            let recorded = sensor.for_recording();
            assert!(recorded.sensor.stale_after_ms.is_some());
            assert_eq!(recorded.press.contact_threshold_n, Some(0.07));
            let played = Sensor::new(recorded).unwrap();
            assert_eq!(
                played.stale_after(),
                sensor.stale_after(),
                "{hz} Hz, {ms:?}"
            );
        }
    }
}
