//! A serial line: how it is opened for this process alone, and its settings.
//!
//! The settings are 8 data bits, no parity, 1 stop bit, no flow control, and no processing of the
//! bytes. Another program may change them while the port is open, so they can be compared and set
//! again.

use std::collections::BTreeSet;
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::Path;

use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;
use rustix::termios::{
    ControlModes, InputModes, LocalModes, OptionalActions, OutputModes, SpecialCodeIndex, Termios,
    tcgetattr, tcsetattr,
};
use serialport::{ClearBuffer, ErrorKind, SerialPort, TTYPort};

/// Opens the port at `path`. No other process can open it until it is dropped: TIOCEXCL keeps others
/// out, and a lock also keeps root out.
pub(super) fn open(path: &Path, baud: u32) -> io::Result<(TTYPort, LineSettings)> {
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
    lower_latency(path);
    Ok((port, LineSettings { file, settings }))
}

/// Asks an FTDI adapter to pass bytes on after 1 ms instead of 16. Failure is no error: most ports
/// have no such timer, and a daemon that is not root leaves it to the udev rule.
fn lower_latency(path: &Path) {
    let Ok(device) = path.canonicalize() else {
        return;
    };
    let Some(name) = device.file_name() else {
        return;
    };
    let timer = Path::new("/sys/bus/usb-serial/devices")
        .join(name)
        .join("latency_timer");
    match std::fs::read_to_string(&timer) {
        Ok(ms) if ms.trim() != "1" => {
            if let Err(error) = std::fs::write(&timer, "1") {
                tracing::debug!(timer = %timer.display(), ms = ms.trim(), %error, "latency timer");
            }
        }
        _ => {}
    }
}

/// Whether this process has the device of `path` open, perhaps under another name.
pub(super) fn is_held_here(path: &Path) -> bool {
    let device = |path: &Path| {
        let file = std::fs::metadata(path).ok()?;
        file.file_type().is_char_device().then(|| file.rdev())
    };
    let Some(wanted) = device(path) else {
        return false;
    };
    let files = std::fs::read_dir("/proc/self/fd").into_iter().flatten();
    let mut files = files.flatten();
    files.any(|file| device(&file.path()) == Some(wanted))
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

    /// Sets the settings again if another program has changed them. Returns what it found.
    pub(super) fn restore(&self) -> Result<Option<Changed>, Errno> {
        let changed = Changed::between(&tcgetattr(&self.file)?, &self.settings);
        if changed.is_some() {
            tcsetattr(&self.file, OptionalActions::Now, &self.settings)?;
        }
        Ok(changed)
    }
}

/// Sets 8N1 at `baud`, without flow control and without processing of the bytes.
pub(crate) fn make_plain(settings: &mut Termios, baud: u32) -> Result<(), Errno> {
    settings.make_raw();
    settings.input_modes -= InputModes::INPCK | InputModes::IXOFF;
    settings.input_modes |= InputModes::IGNPAR;
    settings.control_modes -= ControlModes::CSTOPB | ControlModes::PARODD | ControlModes::CRTSCTS;
    settings.control_modes |= ControlModes::CREAD | ControlModes::CLOCAL;
    settings.set_speed(baud)
}

/// The settings of a line that are not as expected, in the words of stty(1).
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Changed {
    pub(crate) found: String,
    pub(crate) expected: String,
}

impl Changed {
    /// The settings that differ, if any do.
    pub(crate) fn between(found: &Termios, expected: &Termios) -> Option<Self> {
        let (found, expected) = (named(found), named(expected));
        let only = |one: &BTreeSet<String>, other| {
            let names: Vec<String> = one.difference(other).cloned().collect();
            names.join(" ")
        };
        (found != expected).then(|| Self {
            found: only(&found, &expected),
            expected: only(&expected, &found),
        })
    }
}

/// The settings that change what is read or written.
fn named(settings: &Termios) -> BTreeSet<String> {
    let input = settings.input_modes;
    let output = settings.output_modes;
    let local = settings.local_modes;
    let control = settings.control_modes;
    let flags = [
        ("brkint", input.contains(InputModes::BRKINT)),
        ("icrnl", input.contains(InputModes::ICRNL)),
        ("igncr", input.contains(InputModes::IGNCR)),
        ("inlcr", input.contains(InputModes::INLCR)),
        ("inpck", input.contains(InputModes::INPCK)),
        ("istrip", input.contains(InputModes::ISTRIP)),
        ("ixoff", input.contains(InputModes::IXOFF)),
        ("ixon", input.contains(InputModes::IXON)),
        ("parmrk", input.contains(InputModes::PARMRK)),
        ("opost", output.contains(OutputModes::OPOST)),
        ("echo", local.contains(LocalModes::ECHO)),
        ("icanon", local.contains(LocalModes::ICANON)),
        ("iexten", local.contains(LocalModes::IEXTEN)),
        ("isig", local.contains(LocalModes::ISIG)),
        ("cread", control.contains(ControlModes::CREAD)),
        ("crtscts", control.contains(ControlModes::CRTSCTS)),
        ("cstopb", control.contains(ControlModes::CSTOPB)),
        ("parenb", control.contains(ControlModes::PARENB)),
        ("parodd", control.contains(ControlModes::PARODD)),
    ];
    let size = match control & ControlModes::CSIZE {
        ControlModes::CS5 => "cs5",
        ControlModes::CS6 => "cs6",
        ControlModes::CS7 => "cs7",
        _ => "cs8",
    };
    let code = |index| settings.special_codes[index];
    let sign = |is_set| if is_set { "" } else { "-" };
    let mut names: BTreeSet<String> = flags
        .iter()
        .map(|(name, is_set)| format!("{}{name}", sign(*is_set)))
        .collect();
    names.insert(size.to_owned());
    names.insert(format!("ispeed {}", settings.input_speed()));
    names.insert(format!("ospeed {}", settings.output_speed()));
    names.insert(format!("min {}", code(SpecialCodeIndex::VMIN)));
    names.insert(format!("time {}", code(SpecialCodeIndex::VTIME)));
    names
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tools::pty::Pty;

    #[test]
    fn settings_that_another_program_changed_are_named_and_set_again() {
        let pty = Pty::open(None).unwrap();
        let (_port, line) = open(pty.path(), 57_600).unwrap();
        assert_eq!(line.restore(), Ok(None));
        // What a getty sets.
        let mut cooked = line.settings.clone();
        cooked.local_modes |= LocalModes::ICANON | LocalModes::ECHO;
        cooked.input_modes |= InputModes::ICRNL;
        cooked.set_speed(9_600).unwrap();
        tcsetattr(&line.file, OptionalActions::Now, &cooked).unwrap();
        let changed = Changed {
            found: "echo icanon icrnl ispeed 9600 ospeed 9600".to_owned(),
            expected: "-echo -icanon -icrnl ispeed 57600 ospeed 57600".to_owned(),
        };
        assert_eq!(line.restore(), Ok(Some(changed)));
        assert_eq!(line.restore(), Ok(None));
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
        let file = tempfile::NamedTempFile::new().unwrap();
        assert_eq!(errno(file.path()), Some(Errno::NOTTY));
    }
}
