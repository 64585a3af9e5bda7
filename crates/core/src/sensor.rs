//! The description of a sensor: how it writes frames, how counts become newtons, when a press
//! begins and ends, and when a verdict is rejected.
//!
//! In: a [`Description`] from a configuration or a recording. Out: a [`Sensor`]. Every value of a
//! [`Sensor`] is in its range, and the values fit each other, so no other module checks them again.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::press::Thresholds;
use crate::range::{self, OutOfRange, within};
use crate::wire::{self, Layout};
use crate::{motion, press, tare};

/// The description of a sensor. Its values are unchecked.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Description {
    /// The sensor's name: `[a-z][a-z0-9_]*`.
    pub name: String,
    /// The number of frames that the sensor is expected to send in a second.
    pub frame_rate_hz: f64,
    /// The silence after which a live sensor is stale. `None` means the larger of 2.5 periods and
    /// 50 ms.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stale_after_ms: Option<f64>,
    /// How the sensor writes a frame.
    pub frame: wire::Settings,
    /// How counts become newtons.
    pub calibration: tare::Settings,
    /// The thresholds that begin and end a press.
    pub press: press::Settings,
    /// The arm that presses with this sensor.
    pub arm: motion::Settings,
    /// A verdict below this confidence is rejected.
    pub min_confidence: f32,
    /// A verdict on a frame with less total force is rejected.
    pub min_force_n: f64,
    /// A model of the course gives an early verdict when its confidence reaches this value.
    pub early_confidence: f32,
}

impl Default for Description {
    /// A JX255N (paper, "Tactile sensor") named `sensor`; nothing is rejected.
    fn default() -> Self {
        Self {
            name: "sensor".to_owned(),
            frame_rate_hz: DEFAULT_FRAME_RATE_HZ,
            stale_after_ms: None,
            frame: wire::Settings::default(),
            calibration: tare::Settings::default(),
            press: press::Settings::default(),
            arm: motion::Settings::default(),
            min_confidence: 0.0,
            min_force_n: 0.0,
            early_confidence: 0.95,
        }
    }
}

impl Description {
    /// The first key that differs and that a running pipeline cannot change.
    pub fn fixed_difference(&self, other: &Self) -> Option<&'static str> {
        let differs = [
            ("name", self.name != other.name),
            ("frame_rate_hz", self.frame_rate_hz != other.frame_rate_hz),
            ("frame", self.frame != other.frame),
        ];
        let first = differs.iter().find(|(_, differs)| *differs);
        first.map(|(key, _)| *key)
    }
}

/// An unusable value of a [`Description`]. The message begins with the value's key.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SensorError {
    /// The name cannot be part of a topic, a file name or a log line.
    #[error("name: found {0:?}, expected a letter a to z, then letters a to z, digits or _")]
    Name(String),
    /// A number is out of its range.
    #[error(transparent)]
    Range(#[from] OutOfRange),
    /// The layout of a frame is unusable.
    #[error("frame.{0}")]
    Frame(#[from] wire::LayoutError),
    /// A time between requests, and no request.
    #[error("frame.request_ms: found a value, expected none without frame.request")]
    NoRequest,
    /// The calibration is unusable.
    #[error("calibration.{0}")]
    Calibration(#[from] tare::SettingsError),
    /// The settings of presses are unusable.
    #[error("press.{0}")]
    Press(OutOfRange),
    /// The settings of the arm are unusable.
    #[error("arm.{0}")]
    Arm(OutOfRange),
}

/// The frame rate of the paper's sensor.
pub const DEFAULT_FRAME_RATE_HZ: f64 = 5.0;

/// The accepted frame rates: a wider range than that of any sensor, but every period is still a
/// sane time to wait.
pub const FRAME_RATES_HZ: (f64, f64) = (0.01, 10_000.0);

/// The accepted stale times: from a period of the highest rate to an hour. Nobody waits longer for
/// a frame.
const STALE_AFTER_MS: (f64, f64) = (0.1, 3_600_000.0);

/// The accepted times between requests, up to an hour.
const REQUEST_MS: (u32, u32) = (1, 3_600_000);

/// The longest name. A name is part of topics, of file names and of each line of the log.
const MOST_NAME_CHARS: usize = 64;

/// A frame is late after this many periods.
pub const LATE_PERIODS: f64 = 2.5;

/// The least stale time by default. USB adapters deliver every 16 ms, and a busy host reads some
/// milliseconds later. With 2.5 periods, a sensor at 100 frames/s would often become stale and live
/// again.
const LEAST_STALE_AFTER: Duration = Duration::from_millis(50);

/// A sensor whose description has been checked.
#[derive(Debug, Clone, PartialEq)]
pub struct Sensor {
    description: Description,
    layout: Layout,
    thresholds: Thresholds,
    stale_after: Duration,
}

impl Sensor {
    /// Checks a description.
    ///
    /// # Errors
    ///
    /// Returns a [`SensorError`] for the first value that is out of its range or does not fit the
    /// layout.
    ///
    /// # Example
    ///
    /// ```
    /// use hardnessd_core::sensor::{Description, Sensor};
    ///
    /// let described = |frame_rate_hz| Description {
    ///     name: "forearm".to_owned(),
    ///     frame_rate_hz,
    ///     ..Description::default()
    /// };
    /// let sensor = Sensor::new(described(100.0))?;
    /// assert_eq!(sensor.period().as_millis(), 10);
    /// assert_eq!(sensor.stale_after().as_millis(), 50);
    ///
    /// let error = Sensor::new(described(0.0)).unwrap_err();
    /// assert!(error.to_string().starts_with("frame_rate_hz: found 0.0, expected"));
    /// # Ok::<(), hardnessd_core::sensor::SensorError>(())
    /// ```
    pub fn new(description: Description) -> Result<Self, SensorError> {
        let Description {
            name,
            frame_rate_hz,
            stale_after_ms,
            frame,
            calibration,
            press,
            arm,
            min_confidence,
            min_force_n,
            early_confidence,
        } = &description;
        let part = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
        let found = name.chars().count();
        range::check(
            "name",
            format_args!("{found} characters"),
            found <= MOST_NAME_CHARS,
            format_args!("at most {MOST_NAME_CHARS}"),
        )?;
        if !(name.starts_with(|first: char| first.is_ascii_lowercase()) && name.chars().all(part)) {
            return Err(SensorError::Name(name.clone()));
        }
        within(
            "frame_rate_hz",
            *frame_rate_hz,
            FRAME_RATES_HZ,
            "frames a second",
        )?;
        let stale_after = match *stale_after_ms {
            None => LEAST_STALE_AFTER.max(late(*frame_rate_hz)),
            Some(ms) => {
                within("stale_after_ms", ms, STALE_AFTER_MS, "milliseconds")?;
                of_ms(ms)
            }
        };
        let layout = Layout::new(frame)?;
        if let Some(ms) = frame.request_ms {
            if frame.request.is_none() {
                return Err(SensorError::NoRequest);
            }
            within("frame.request_ms", ms, REQUEST_MS, "milliseconds")?;
        }
        calibration.check(layout.array())?;
        let thresholds = press.check(layout.array(), calibration.pitch_mm);
        let thresholds = thresholds.map_err(SensorError::Press)?;
        arm.check().map_err(SensorError::Arm)?;
        within("min_confidence", *min_confidence, (0.0, 1.0), "")?;
        let fits = (0.0..=f64::MAX).contains(min_force_n);
        range::check("min_force_n", min_force_n, fits, "newtons, 0 or more")?;
        within("early_confidence", *early_confidence, (0.0, 1.0), "")?;
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
        &self.description.name
    }

    /// The thresholds of presses, for the size of the sensor's taxels.
    pub fn thresholds(&self) -> &Thresholds {
        &self.thresholds
    }

    /// The description as a recording holds it. Values whose default is computed are written, so a
    /// later default does not change what a recording says.
    pub fn for_recording(&self) -> Description {
        let press = press::Settings {
            contact_threshold_n: Some(self.thresholds.contact_threshold_n),
            begin_area_taxels: Some(self.thresholds.begin_area_taxels),
            end_area_taxels: Some(self.thresholds.end_area_taxels),
            ..self.description.press.clone()
        };
        Description {
            stale_after_ms: Some(self.stale_after.as_nanos() as f64 / 1e6),
            press,
            ..self.description.clone()
        }
    }

    /// How the sensor writes a frame.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// The expected time from frame to frame.
    pub fn period(&self) -> Duration {
        period(self.description.frame_rate_hz)
    }

    /// The time after which a missing frame is late: 2.5 periods.
    pub fn late_after(&self) -> Duration {
        late(self.description.frame_rate_hz)
    }

    /// How long a live sensor may be silent before it is stale.
    pub fn stale_after(&self) -> Duration {
        self.stale_after
    }
}

fn period(frame_rate_hz: f64) -> Duration {
    Duration::from_secs_f64(1.0 / frame_rate_hz)
}

fn late(frame_rate_hz: f64) -> Duration {
    period(frame_rate_hz).mul_f64(LATE_PERIODS)
}

fn of_ms(ms: f64) -> Duration {
    Duration::from_nanos((ms * 1e6).round() as u64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Settings as Arm;
    use crate::wire::HexBytes;

    #[test]
    fn a_value_that_no_sensor_has_is_refused_with_its_key() {
        let check = |change: &dyn Fn(&mut Description), expected: &str| {
            let mut described = Description::default();
            change(&mut described);
            let error = Sensor::new(described).unwrap_err().to_string();
            assert!(error.starts_with(expected), "{error}");
        };
        check(
            &|d| d.name = "Arm".to_owned(),
            "name: found \"Arm\", expected a letter a to z, then",
        );
        check(
            &|d| d.name = "\u{202e}".to_owned(),
            "name: found \"\\u{202e}\"",
        );
        check(&|d| d.name.clear(), "name: found \"\"");
        let long = "name: found 300 characters, expected at most 64";
        check(&|d| d.name = "a".repeat(300), long);
        for hz in [0.0, -5.0, 0.009, 10_001.0, f64::NAN, f64::INFINITY] {
            check(&|d| d.frame_rate_hz = hz, "frame_rate_hz: found");
        }
        for ms in [0.0, -1.0, 3.7e6, f64::NAN] {
            check(&|d| d.stale_after_ms = Some(ms), "stale_after_ms: found");
        }
        check(&|d| d.frame.rows = Some(65), "frame.rows: found 65");
        check(
            &|d| d.frame.request_ms = Some(5),
            "frame.request_ms: found a value",
        );
        for ms in [0, 3_600_001] {
            check(
                &|d| {
                    d.frame.request = Some(HexBytes(vec![0x52]));
                    d.frame.request_ms = Some(ms);
                },
                &format!("frame.request_ms: found {ms}, expected 1 to 3600000"),
            );
        }
        let dead = "calibration.dead_taxels: found [5, 0]";
        check(
            &|d| {
                d.frame.rows = Some(5);
                d.calibration.dead_taxels = vec![[5, 0]];
            },
            dead,
        );
        check(
            &|d| d.calibration.exponent = 5.0,
            "calibration.exponent: found 5.0, expected 0.25 to 4",
        );
        check(&|d| d.press.end_frames = 0, "press.end_frames: found 0");
        for (change, found) in [
            (
                Arm {
                    stiffness_n_per_mm: Some(0.0),
                    ..Arm::default()
                },
                "stiffness_n_per_mm: found 0.0",
            ),
            (
                Arm {
                    speed_mm_s: Some(-5.0),
                    ..Arm::default()
                },
                "speed_mm_s: found -5.0",
            ),
            (
                Arm {
                    delay_ms: f64::NAN,
                    ..Arm::default()
                },
                "delay_ms: found NaN",
            ),
        ] {
            check(
                &|d| d.arm = change.clone(),
                &format!("arm.{found}, expected"),
            );
        }
        check(&|d| d.early_confidence = 1.1, "early_confidence: found 1.1");
        check(&|d| d.min_confidence = 1.5, "min_confidence: found 1.5");
        check(&|d| d.min_force_n = f64::NAN, "min_force_n: found NaN");
    }

    #[test]
    fn a_recording_holds_how_long_a_silence_is_stale() {
        for (hz, ms) in [(5.0, None), (100.0, None), (3.0, None), (100.0, Some(33.3))] {
            let described = Description {
                frame_rate_hz: hz,
                stale_after_ms: ms,
                ..Description::default()
            };
            let sensor = Sensor::new(described).unwrap();
            let recorded = sensor.for_recording();
            assert!(recorded.stale_after_ms.is_some());
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
