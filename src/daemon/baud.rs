//! Whether a serial line can carry the frames of its sensor.

use hardnessd_core::port::Port;
use hardnessd_core::sensor;
use hardnessd_core::wire::Layout;

/// The number of bits that a byte takes on a line: a start bit, eight bits and a stop bit.
pub(crate) const BITS_A_BYTE: f64 = 10.0;

/// The names of serial ports that follow their baud rate.
const PACED: [&str; 11] = [
    "ttyUSB", "ttyS", "ttyAMA", "ttyTHS", "ttymxc", "ttyLP", "ttyPS", "ttyO", "ttyMSM", "ttySTM",
    "ttyXRUSB",
];

/// Whether the baud rate limits what a port carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Pace {
    /// The port follows the baud rate.
    Baud,
    /// A pty, USB CDC, Bluetooth and a network ignore it.
    Free,
    /// The port does not exist yet, and its name does not show what it is.
    Unknown,
}

impl Pace {
    fn of(port: &Port) -> Self {
        let Some(path) = port.device() else {
            return Self::Free;
        };
        let there = path.canonicalize();
        let device = there.as_deref().unwrap_or(path);
        let name = device.file_name().unwrap_or_default().to_string_lossy();
        let is_free = ["ttyACM", "ttyGS", "rfcomm"].map(|free| name.starts_with(free));
        if device.starts_with("/dev/pts") || is_free.contains(&true) {
            Self::Free
        } else if there.is_ok() || PACED.iter().any(|paced| name.starts_with(paced)) {
            Self::Baud
        } else {
            Self::Unknown
        }
    }
}

/// The frames of a sensor, beside what its line carries.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Load {
    pub(crate) pace: Pace,
    /// The bytes that the line carries in a second.
    pub(crate) capacity: f64,
    /// The bytes that the sensor sends in a second, with its longest frames.
    pub(crate) bytes_per_s: f64,
    /// The frames that the line cannot carry, if there are any.
    pub(crate) excess: Option<Excess>,
}

/// Frames that a line cannot carry.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error(
    "found {frame_rate_hz} frames/s of {frame_bytes} bytes, expected at most {most:.2} over {baud} baud at 10 \
     bits a byte (a pty or USB CDC port has no such limit)"
)]
pub(crate) struct Excess {
    frame_rate_hz: f64,
    frame_bytes: usize,
    most: f64,
    baud: u32,
    /// Whether no frame of the layout is short enough, and the port is known to follow its baud rate.
    pub(crate) is_certain: bool,
}

impl Load {
    /// The load of the line of `sensor`, whose frames have `layout`.
    pub(crate) fn of(sensor: &sensor::Settings, layout: &Layout) -> Self {
        let pace = Pace::of(&sensor.port);
        let capacity = f64::from(sensor.baud) / BITS_A_BYTE;
        let (shortest, longest) = (layout.min_frame_bytes(), layout.max_frame_bytes());
        let is_excess =
            |bytes: usize| pace != Pace::Free && sensor.frame_rate_hz * bytes as f64 > capacity;
        let none_fits = is_excess(shortest);
        let frame_bytes = if none_fits { shortest } else { longest };
        Self {
            pace,
            capacity,
            bytes_per_s: sensor.frame_rate_hz * longest as f64,
            excess: is_excess(frame_bytes).then(|| Excess {
                frame_rate_hz: sensor.frame_rate_hz,
                frame_bytes,
                most: capacity / frame_bytes as f64,
                baud: sensor.baud,
                is_certain: none_fits && pace == Pace::Baud,
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tools::pty::Pty;
    use hardnessd_core::wire::{Preset, Settings};

    #[test]
    fn only_a_port_that_follows_its_baud_rate_is_certain_to_be_too_slow() {
        let layout = Layout::new(&Settings::default()).unwrap();
        let excess = |port: &str| {
            let sensor = sensor::Settings {
                frame_rate_hz: 100.0,
                ..sensor::Settings::new(port.parse::<Port>().unwrap())
            };
            let load = Load::of(&sensor, &layout);
            (load.pace, load.excess.map(|excess| excess.is_certain))
        };
        let directory = tempfile::tempdir().unwrap();
        let link = directory.path().join("port");
        let shown = link.to_str().unwrap().to_owned();
        // The same before and after the simulator makes its link: `check` does not refuse it.
        assert_eq!(excess(&shown), (Pace::Unknown, Some(false)));
        let _pty = Pty::open(Some(&link)).unwrap();
        assert_eq!(excess(&shown), (Pace::Free, None));
        for port in ["tcp://localhost:1", "udp://0.0.0.0:1", "/dev/ttyACM99"] {
            assert_eq!(excess(port), (Pace::Free, None), "{port}");
        }
        let by_id = "/dev/serial/by-id/usb-of-an-unknown-board-if00";
        assert_eq!(excess(by_id), (Pace::Unknown, Some(false)));
        for port in ["/dev/ttyUSB99", "/dev/ttyAMA99"] {
            assert_eq!(excess(port), (Pace::Baud, Some(true)), "{port}");
        }
    }

    #[test]
    fn a_rate_that_no_frame_allows_is_certain_to_be_too_high_and_one_that_some_do_not_is_not() {
        // At 115,200 baud: texts of 784 values have 1,568 to 5,610 bytes. A glove's two packets have 284.
        for (frame_rate_hz, preset, expected) in [
            (2.0, Preset::Csv, None),
            (5.0, Preset::Csv, Some((5610, false))),
            (7.4, Preset::Csv, Some((1568, true))),
            (22.2, Preset::M1616, Some((519, true))),
            (40.6, Preset::JqGlove, Some((284, true))),
        ] {
            let settings = Settings {
                preset: Some(preset),
                ..Settings::default()
            };
            let sensor = sensor::Settings {
                frame_rate_hz,
                ..sensor::Settings::new("/dev/ttyUSB99".parse::<Port>().unwrap())
            };
            let load = Load::of(&sensor, &Layout::new(&settings).unwrap());
            let excess = load.excess;
            let found = excess.map(|excess| (excess.frame_bytes, excess.is_certain));
            assert_eq!(found, expected, "{frame_rate_hz} {preset}");
        }
    }
}
