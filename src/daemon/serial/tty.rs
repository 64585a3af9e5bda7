//! A serial line: how it is opened for this process alone, and its settings.
//!
//! The settings are 8 data bits, no parity, 1 stop bit, no flow control, and no processing of the
//! bytes. Another program may change them while the port is open, so they can be set again.

use std::io;
use std::os::fd::OwnedFd;
use std::path::Path;

use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;
use rustix::termios::{OptionalActions, SpecialCodeIndex, Termios, tcgetattr, tcsetattr};
use rustix::thread::{CapabilitySet, CapabilitySets, capabilities, set_capabilities};
use serialport::{ClearBuffer, ErrorKind, SerialPort, TTYPort};

use crate::holders::holders;

/// Opens the port at `path`. No other process can open it until it is dropped: TIOCEXCL keeps others
/// out, and a lock also keeps root out. A port that another process keeps for itself in one of these ways
/// is not opened, not even by root.
pub(super) fn open(path: &Path, baud: u32) -> io::Result<(TTYPort, LineSettings)> {
    // This capability passes over the TIOCEXCL of others. Only this thread goes without it.
    let before = capabilities(None)?;
    let admin = CapabilitySet::SYS_ADMIN;
    if !before.effective.contains(admin) {
        return open_alone(path, baud);
    }
    let effective = before.effective.difference(admin);
    set_capabilities(
        None,
        CapabilitySets {
            effective,
            ..before
        },
    )?;
    let opened = open_alone(path, baud);
    set_capabilities(None, before)?;
    let is_busy = |error: &io::Error| error.raw_os_error() == Some(Errno::BUSY.raw_os_error());
    // A pty stays exclusive when the process that made it so is killed, until its other end closes too.
    if opened.as_ref().is_err_and(is_busy) && holders(Path::new("/"), path).next().is_none() {
        return open_alone(path, baud);
    }
    opened
}

fn open_alone(path: &Path, baud: u32) -> io::Result<(TTYPort, LineSettings)> {
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    // From TIOCEXCL on, not even this process can open the port again.
    let file = rustix::fs::open(path, flags, Mode::empty())?;
    tcgetattr(&file)?;
    // The builder's defaults are 8N1 without flow control, and exclusive access.
    let opened = TTYPort::open(&serialport::new(path.to_string_lossy(), baud));
    let port = opened.map_err(|error| match error.kind() {
        // The port is locked.
        ErrorKind::NoDevice => Errno::BUSY.into(),
        _ => io::Error::from(error),
    })?;
    // Bytes from before the port had its settings are of unknown age, and may be garbled.
    port.clear(ClearBuffer::Input)?;
    let settings = tcgetattr(&file)?;
    Ok((port, LineSettings { file, settings }))
}

/// The settings of an open serial line, on a descriptor of their own: that of the port is not
/// reachable.
#[derive(Debug)]
pub(super) struct LineSettings {
    file: OwnedFd,
    /// The settings, as the driver took them.
    settings: Termios,
}

impl LineSettings {
    /// Sends bytes, if there is room for them.
    pub(super) fn send(&self, bytes: &[u8]) -> io::Result<()> {
        rustix::io::write(&self.file, bytes)?;
        Ok(())
    }

    /// Sets the settings again if another program has changed them. Some drivers send them to the adapter even
    /// if nothing changes, and the sensors wait for that.
    pub(super) fn restore(&self) -> Result<(), Errno> {
        if !are_same(&tcgetattr(&self.file)?, &self.settings) {
            tcsetattr(&self.file, OptionalActions::Now, &self.settings)?;
        }
        Ok(())
    }
}

/// Whether two settings read and write bytes alike.
fn are_same(one: &Termios, other: &Termios) -> bool {
    let modes = |settings: &Termios| {
        let Termios {
            input_modes,
            output_modes,
            local_modes,
            control_modes,
            ..
        } = *settings;
        (input_modes, output_modes, local_modes, control_modes)
    };
    let speeds = |settings: &Termios| (settings.input_speed(), settings.output_speed());
    let codes = |settings: &Termios| {
        let code = |index| settings.special_codes[index];
        (code(SpecialCodeIndex::VMIN), code(SpecialCodeIndex::VTIME))
    };
    modes(one) == modes(other) && speeds(one) == speeds(other) && codes(one) == codes(other)
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use rustix::termios::{InputModes, LocalModes};

    use super::*;
    use crate::tools::pty::Pty;

    #[test]
    fn settings_that_another_program_changed_are_set_again() {
        let pty = Pty::open(None).unwrap();
        let (_port, line) = open(pty.path(), 57_600).unwrap();
        // What a getty sets.
        let mut cooked = line.settings.clone();
        cooked.local_modes |= LocalModes::ICANON | LocalModes::ECHO;
        cooked.input_modes |= InputModes::ICRNL;
        cooked.set_speed(9_600).unwrap();
        tcsetattr(&line.file, OptionalActions::Now, &cooked).unwrap();
        line.restore().unwrap();
        assert!(are_same(&tcgetattr(&line.file).unwrap(), &line.settings));
        assert!(!are_same(&cooked, &line.settings));
    }

    #[test]
    fn a_port_is_held_by_one_until_it_is_dropped_and_takes_any_speed() {
        let pty = Pty::open(None).unwrap();
        let opened = open(pty.path(), 250_000).unwrap();
        assert_eq!(opened.1.settings.input_speed(), 250_000);
        let errno = |path: &Path| Errno::from_io_error(&open(path, 250_000).unwrap_err());
        assert_eq!(errno(pty.path()), Some(Errno::BUSY));
        drop(opened);
        open(pty.path(), 250_000).unwrap();
        // Another program keeps the port for itself, without a lock. Root could open it nevertheless.
        // The programs of other tests must not inherit it.
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC;
        let other = rustix::fs::open(pty.path(), flags, Mode::empty()).unwrap();
        rustix::termios::ioctl_tiocexcl(&other).unwrap();
        let mut command = Command::new("sleep");
        let mut program = command.arg("60").stdin(other).spawn().unwrap();
        drop(command);
        assert_eq!(errno(pty.path()), Some(Errno::BUSY));
        // It is killed, and the pty is still for itself. Only root can open it.
        program.kill().unwrap();
        program.wait().unwrap();
        if capabilities(None)
            .unwrap()
            .effective
            .contains(CapabilitySet::SYS_ADMIN)
        {
            open(pty.path(), 250_000).unwrap();
        }
        let file = tempfile::NamedTempFile::new().unwrap();
        assert_eq!(errno(file.path()), Some(Errno::NOTTY));
    }
}
