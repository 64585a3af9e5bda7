//! How many bytes a serial port could not read, because no stop bit ended them.
//!
//! In: the number of a device, and the kernel's files under a root, which is `/` except in tests. Out: a count
//! since the system started. The kernel shows it to root only, and only of ports of the computer itself: the
//! drivers of USB adapters do not count there.

use std::fs;
use std::path::Path;

use rustix::fs::{major, minor};

/// The framing errors and breaks that the driver has counted at this device. A byte of zeros without a stop bit
/// is a break. `None` if no count is shown.
pub(super) fn errors(root: &Path, device: u64) -> Option<u64> {
    let drivers = fs::read_to_string(root.join("proc/tty/drivers")).ok()?;
    let (driver, line) = drivers.lines().find_map(|line| line_of(line, device))?;
    let lines = fs::read_to_string(root.join("proc/tty/driver").join(driver)).ok()?;
    let begin = format!("{line}: uart:");
    let of_line = lines.lines().find(|line| line.starts_with(&begin))?;
    let counts = of_line.split_ascii_whitespace().filter_map(|word| {
        let count = word.strip_prefix("fe:").or(word.strip_prefix("brk:"))?;
        count.parse::<u64>().ok()
    });
    Some(counts.sum())
}

/// The driver's name and the number of its line that is this device, if the driver of this line of
/// `/proc/tty/drivers` has it: `serial  /dev/ttyS  4 64-95 serial`.
fn line_of(driver: &str, device: u64) -> Option<(&str, u32)> {
    let words: Vec<&str> = driver.split_ascii_whitespace().collect();
    let [name, _, of, minors, ..] = words[..] else {
        return None;
    };
    let (first, last) = minors.split_once('-').unwrap_or((minors, minors));
    let (first, last): (u32, u32) = (first.parse().ok()?, last.parse().ok()?);
    // The kernel's own drivers, such as `/dev/tty`, have a path as their name, and no counts.
    let is_its = !name.contains('/')
        && of.parse() == Ok(major(device))
        && (first..=last).contains(&minor(device));
    is_its.then(|| (name, minor(device) - first))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_counted_where_the_driver_counts_them() {
        let root = tempfile::tempdir().unwrap();
        let write = |path: &str, text: &str| {
            let path = root.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        let at = |major, minor| errors(root.path(), rustix::fs::makedev(major, minor));
        assert_eq!(at(4, 65), None);
        write(
            "proc/tty/drivers",
            "/dev/tty             /dev/tty        5       0 system:/dev/tty\n\
             usbserial            /dev/ttyUSB   188 0-511 serial\n\
             serial               /dev/ttyS       4 64-95 serial\n",
        );
        write(
            "proc/tty/driver/serial",
            "serinfo:1.0 driver revision:\n\
             0: uart:16550A port:000003F8 irq:4 tx:0 rx:812 fe:2 RTS|DTR\n\
             1: uart:16550A port:000002F8 irq:3 tx:71 rx:90210 fe:41 pe:3 brk:9 oe:1 RTS|DTR|CD\n\
             2: uart:unknown port:000003E8 irq:4\n",
        );
        write(
            "proc/tty/driver/usbserial",
            "usbserinfo:1.0 driver:2.0\n0: module:ftdi_sio name:\"FTDI USB Serial Device\"\n",
        );
        assert_eq!(
            [at(4, 64), at(4, 65), at(4, 66)],
            [Some(2), Some(50), Some(0)]
        );
        write("/dev/tty".trim_start_matches('/'), "0: uart:");
        assert_eq!([at(4, 67), at(4, 63), at(188, 0), at(5, 0)], [None; 4]);
    }
}
