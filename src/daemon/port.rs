//! Which ports are those of a simulated sensor.

use rustix::fs::{Mode, OFlags};

use hardnessd_core::port::Port;

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
