//! What is known of a port before the daemon opens it: whether its line can carry the frames of its sensor, and
//! whether the sensor is simulated.

use rustix::fs::{Mode, OFlags};

use hardnessd_core::port::Port;
use hardnessd_core::sensor;
use hardnessd_core::wire::Layout;

/// Whether `hardnessd simulate` plays at the port now. No other port is opened for this.
pub(crate) fn is_simulated(port: &Port) -> bool {
    let device = port.device().and_then(|path| path.canonicalize().ok());
    let Some(device) = device.filter(|path| path.starts_with("/dev/pts")) else {
        return false;
    };
    let flags = OFlags::RDONLY | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let opened = rustix::fs::open(&device, flags, Mode::empty());
    let size = opened.and_then(rustix::termios::tcgetwinsize);
    size.is_ok_and(|size| (size.ws_xpixel, size.ws_ypixel) == SIMULATED)
}

/// The pixels of the window of a pty at which `hardnessd simulate` plays. A port has no window, so this
/// marks it for every process, whatever else it sets.
pub(crate) const SIMULATED: (u16, u16) = (0x6864, 0x7369);

/// The number of bits that a byte takes on a line: a start bit, eight bits and a stop bit.
pub(crate) const BITS_A_BYTE: f64 = 10.0;

/// Whether a port is known to follow its baud rate. A pty, USB CDC, Bluetooth and a network ignore it. A device
/// that does not exist yet is judged by its name.
fn is_paced(port: &Port) -> bool {
    let Some(path) = port.device() else {
        return false;
    };
    let there = path.canonicalize();
    let device = there.as_deref().unwrap_or(path);
    let name = device.file_name().unwrap_or_default().to_string_lossy();
    let free = ["ttyACM", "ttyGS", "rfcomm"];
    let is_free = device.starts_with("/dev/pts") || free.iter().any(|free| name.starts_with(free));
    !is_free && (there.is_ok() || name.starts_with("tty"))
}

/// Checks that the line of `sensor` can carry its frames, the shortest at least. The error says what it can
/// carry.
pub(crate) fn check_baud(sensor: &sensor::Settings, layout: &Layout) -> Result<(), String> {
    let sensor::Settings {
        port,
        baud,
        frame_rate_hz,
        ..
    } = sensor;
    let frame_bytes = layout.min_frame_bytes();
    let most = f64::from(*baud) / BITS_A_BYTE / frame_bytes as f64;
    if *frame_rate_hz <= most || !is_paced(port) {
        return Ok(());
    }
    Err(format!(
        "found {frame_rate_hz} frames/s of {frame_bytes} bytes, expected at most {most:.2} over {baud} baud at \
         10 bits a byte (a pty or USB CDC port has no such limit)"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use hardnessd_core::wire::{Preset, Settings};

    #[test]
    fn only_a_port_that_follows_its_baud_rate_is_too_slow_for_the_shortest_frames() {
        // At 115,200 baud: texts of 784 values have 1,568 to 5,610 bytes.
        for (port, frame_rate_hz, preset, is_carried) in [
            ("/dev/ttyUSB99", 7.3, Preset::Csv, true),
            ("/dev/ttyUSB99", 7.4, Preset::Csv, false),
            ("/dev/ttyAMA99", 22.2, Preset::M1616, false),
            ("/dev/ttyACM99", 22.2, Preset::M1616, true),
            (
                "/dev/serial/by-id/usb-unknown-if00",
                22.2,
                Preset::M1616,
                true,
            ),
            ("tcp://localhost:1", 22.2, Preset::M1616, true),
        ] {
            let settings = Settings {
                preset: Some(preset),
                ..Settings::default()
            };
            let sensor = sensor::Settings {
                frame_rate_hz,
                ..sensor::Settings::new(port.parse::<Port>().unwrap())
            };
            let checked = check_baud(&sensor, &Layout::new(&settings).unwrap());
            assert_eq!(checked.is_ok(), is_carried, "{port}: {checked:?}");
        }
    }
}
