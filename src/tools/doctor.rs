//! `hardnessd doctor`: finds why a port does not work. It prints each fault on one line, with the
//! remedy.
//!
//! It opens no device, because opening one resets boards like an Arduino. The checks of a port read the file
//! trees under a root, which is `/` except in tests.

use std::ffi::OsStr;
use std::fs;
use std::io::{self, ErrorKind};
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;
use rustix::fs::{AtFlags, CWD, accessat};

use super::absolute;
use super::exit::{FAILED, Failure, USAGE};
use crate::daemon::serial;
use crate::holders::{holders, processes, under};
use hardnessd_core::port::Port;
use hardnessd_core::wording::escaped;

/// What `--help` says below the options.
const MORE: &str = "\
    It opens no device. It looks for a missing port, missing rights of this user, other processes \
    that have the port open (all of them only as root), addresses that do not answer, \
    ModemManager and a slow FTDI timer. Exit code 1: it found a fault.";

/// Arguments of `doctor`.
#[derive(Debug, Clone, ClapArgs)]
#[command(after_help = MORE)]
pub struct Args {
    /// Port to examine: a device, tcp://HOST:PORT or udp://ADDRESS:PORT [default: every USB serial port]
    #[arg(long, value_name = "P")]
    port: Option<Port>,
}

/// The fault that keeps this process from opening `port`, with the remedy. `None` if no fault is
/// visible. For example, only root can see that a process of another user holds the port.
pub(super) fn obstacle(port: &Port) -> Option<String> {
    let root = Path::new("/");
    let port = absolute(port.device()?);
    refused(root, &port).or_else(|| in_the_way(root, &port, access).into_iter().next())
}

/// The name of a group.
pub(super) fn group(gid: u32) -> Option<String> {
    let line = entry(Path::new("/"), "etc/group", gid)?;
    Some(field(&line, 0))
}

/// Prints the faults, each with its remedy.
///
/// # Errors
///
/// Fails if there is a fault, or stdout cannot be written to.
pub fn run(args: &Args) -> Result<(), Failure> {
    let root = Path::new("/");
    let ports = match &args.port {
        Some(Port::Device(path)) if path.as_os_str().is_empty() => {
            return Err(Failure::new(USAGE, "--port: found none, expected a path"));
        }
        Some(port) => vec![port.clone()],
        None => ports(root).into_iter().map(Port::Device).collect(),
    };
    let mut lines = Vec::new();
    let mut found = 0;
    if ports.is_empty() {
        found += 1;
        let line = "no USB serial port: plug the sensor in, then see `sudo dmesg | grep tty`";
        lines.push(line.to_owned());
    }
    for port in ports {
        let (port, faults) = match port.device().map(absolute) {
            Some(path) => {
                let refused = refused(root, &path).map(|fault| vec![fault]);
                let faults = refused.unwrap_or_else(|| examine(root, &path, access));
                (Port::Device(path), faults)
            }
            None => {
                let fault = unreachable(&port);
                (port, fault.into_iter().collect())
            }
        };
        found += faults.len();
        if faults.is_empty() {
            lines.push(format!("{port}: no fault found"));
        }
        lines.extend(faults.iter().map(|fault| format!("{port}: {fault}")));
    }
    let printed: String = lines.iter().map(|line| escaped(line) + "\n").collect();
    super::print(printed.as_bytes())?;
    match found {
        0 => Ok(()),
        1 => Err(Failure::new(FAILED, "1 fault found")),
        _ => Err(Failure::new(FAILED, format!("{found} faults found"))),
    }
}

/// Asks the kernel whether this process may read and write. The kernel also knows access lists and containers.
type Access = fn(&Path) -> io::Result<()>;

fn access(path: &Path) -> io::Result<()> {
    let wanted = rustix::fs::Access::READ_OK | rustix::fs::Access::WRITE_OK;
    Ok(accessat(CWD, path, wanted, AtFlags::EACCESS)?)
}

/// Every USB serial port, by its persistent name if it has one.
fn ports(root: &Path) -> Vec<PathBuf> {
    let of = |folder: &str, is_meant: fn(&Path) -> bool| {
        let files = fs::read_dir(root.join(folder)).into_iter().flatten();
        let paths = files.flatten();
        let paths = paths.map(|file| Path::new("/").join(folder).join(file.file_name()));
        let mut paths: Vec<PathBuf> = paths.filter(|path| is_meant(path)).collect();
        paths.sort();
        paths
    };
    let lasting = of("dev/serial/by-id", |_| true);
    match lasting.is_empty() {
        true => of("dev", is_usb),
        false => lasting,
    }
}

/// The fault if `port` exists but cannot be a serial port. Then no other check makes sense.
fn refused(root: &Path, port: &Path) -> Option<String> {
    let file = fs::metadata(port).ok()?;
    let is_other = match file.file_type().is_char_device() {
        true => is_no_tty(root, file.rdev()),
        false => true,
    };
    is_other.then(|| format!("this is not a serial port: {}", others(&ports(root))))
}

/// Whether the kernel says that the character device `number` is no tty. It does not say it of a pty,
/// because that has no entry in sysfs.
fn is_no_tty(root: &Path, number: u64) -> bool {
    let (major, minor) = (rustix::fs::major(number), rustix::fs::minor(number));
    let entry = format!("sys/dev/char/{major}:{minor}/subsystem");
    fs::read_link(root.join(entry)).is_ok_and(|kind| !kind.ends_with("tty"))
}

/// All faults of `port`, an absolute path under `root`.
fn examine(root: &Path, port: &Path, access: Access) -> Vec<String> {
    let mut faults = in_the_way(root, port, access);
    if let Some(device) = device(root, port) {
        faults.extend(modem_manager(root, &device));
        faults.extend(latency(root, &device));
    }
    faults
}

/// The fault of a port that is no device. It connects, or binds the address, for a moment.
fn unreachable(port: &Port) -> Option<String> {
    let error = match serial::probe(port) {
        Err(error) => error,
        Ok(false) => return None,
        Ok(true) => {
            let telnet = "the other end is a telnet server (RFC 2217), which doubles each FF: set it to raw mode, \
                          as in `connection: raw` of ser2net or its menu";
            return Some(telnet.to_owned());
        }
    };
    let cure = match (port, error.kind()) {
        (Port::Udp(_), ErrorKind::AddrInUse) => {
            "another program receives there, such as the running daemon: `sudo ss -ulpn` names it"
        }
        (_, ErrorKind::ConnectionRefused) => {
            "nothing listens there: start the server on the board or the other computer, or correct the port"
        }
        _ => "correct the address, or look for the way there with `ping`",
    };
    Some(format!("{}: {cure}", serial::reason(port, &error)))
}

/// The faults that keep this process from opening `port`.
fn in_the_way(root: &Path, port: &Path, access: Access) -> Vec<String> {
    let Some(device) = device(root, port) else {
        return vec![format!("no such device: {}", others(&ports(root)))];
    };
    let denied = denied(root, &device, access).into_iter();
    denied
        .chain(held(root, &device, std::process::id()))
        .collect()
}

/// The path of the device that `port` leads to, without the root.
fn device(root: &Path, port: &Path) -> Option<PathBuf> {
    let device = under(root, port).canonicalize().ok()?;
    let device = device.strip_prefix(root.canonicalize().ok()?).ok()?;
    Some(Path::new("/").join(device))
}

/// Other ports that the user could mean.
fn others(ports: &[PathBuf]) -> String {
    if ports.is_empty() {
        return "no other is there either: plug the sensor in, then see `sudo dmesg | grep tty`"
            .to_owned();
    }
    let keys = ports.iter().map(|port| format!("port = {port:?}"));
    format!("these are there: {}", keys.collect::<Vec<_>>().join(", "))
}

fn denied(root: &Path, device: &Path, access: Access) -> Option<String> {
    let path = under(root, device);
    access(&path).err()?;
    let uid = rustix::process::geteuid().as_raw();
    let user = entry(root, "etc/passwd", uid);
    let name = user.map_or(uid.to_string(), |line| field(&line, 0));
    let file = fs::metadata(path).ok()?;
    let (mode, gid) = (file.mode(), file.gid());
    let (line, shown) = (entry(root, "etc/group", gid), device.display());
    let group = line.as_ref().map_or(gid.to_string(), |line| field(line, 0));
    let is_listed = line.is_some_and(|line| field(&line, 3).split(',').any(|one| one == name));
    let cure = if gid == 0 || !allows(mode, 3) {
        format!(
            "sudo chgrp dialout {shown} && sudo chmod 660 {shown} && sudo usermod -aG dialout {name}"
        )
    } else if is_listed {
        format!("{name} joined after login: log in again, or `newgrp {group}`")
    } else {
        format!("sudo usermod -aG {group} {name}, then log in again")
    };
    let mode = mode & 0o777;
    Some(format!(
        "permission denied to {name} (group {group}, mode {mode:03o}): {cure}"
    ))
}

fn allows(mode: u32, shift: u32) -> bool {
    const READ_WRITE: u32 = 0o6;
    (mode >> shift) & READ_WRITE == READ_WRITE
}

/// A fault for each process other than `own` that has the device open. Only root can see this of
/// other users' processes.
fn held(root: &Path, device: &Path, own: u32) -> Vec<String> {
    let others = holders(root, device).filter(|&pid| pid != own);
    let fault = |pid| match is_daemon(root, pid) {
        true => format!(
            "held by process {pid}, the daemon (hardnessd run): sudo systemctl stop hardnessd; where it is no \
             service, kill {pid}"
        ),
        false => format!("held by process {pid} ({}): kill {pid}", command(root, pid)),
    };
    others.map(fault).collect()
}

/// Whether a process is `hardnessd run`.
fn is_daemon(root: &Path, pid: u32) -> bool {
    let line = fs::read(root.join(format!("proc/{pid}/cmdline"))).unwrap_or_default();
    let mut words = line.split(|&byte| byte == 0);
    let program = Path::new(OsStr::from_bytes(words.next().unwrap_or_default()));
    program.file_name() == Some(OsStr::new("hardnessd")) && words.next() == Some(b"run")
}

/// ModemManager writes to every new USB serial port, unless udev's database says of this one that it
/// must not.
fn modem_manager(root: &Path, device: &Path) -> Option<String> {
    if !is_usb(device) || property(root, device, "ID_MM_DEVICE_IGNORE").as_deref() == Some("1") {
        return None;
    }
    let pid = processes(root).find(|&pid| command(root, pid) == "ModemManager")?;
    let cure = udev_rule(root, device);
    Some(format!(
        "ModemManager (process {pid}) writes to it, and no udev rule forbids that: {cure}"
    ))
}

/// An FTDI adapter holds bytes back until its latency timer expires.
fn latency(root: &Path, device: &Path) -> Option<String> {
    let name = device.file_name()?.to_string_lossy();
    let timer = format!("sys/class/tty/{name}/device/latency_timer");
    let ms = fs::read_to_string(root.join(&timer)).ok()?;
    let ms = ms.trim().parse::<u32>().ok().filter(|&ms| ms > 1)?;
    let rule = udev_rule(root, device);
    Some(format!(
        "its latency timer holds bytes back for {ms} ms: echo 1 | sudo tee /{timer}; to last: {rule}"
    ))
}

/// What udev's database says of a serial port. Its file has the port's number, MAJOR:MINOR.
fn property(root: &Path, device: &Path, key: &str) -> Option<String> {
    let entry = Path::new("sys/class/tty").join(device.file_name()?);
    let number = fs::read_to_string(root.join(entry).join("dev")).ok()?;
    let entry = format!("run/udev/data/c{}", number.trim());
    let text = fs::read_to_string(root.join(entry)).ok()?;
    let key = format!("E:{key}=");
    let value = text.lines().find_map(|line| line.strip_prefix(&key))?;
    Some(value.to_owned())
}

/// The commands that let the shipped udev rules act on this device.
fn udev_rule(root: &Path, device: &Path) -> String {
    let keys = ["ID_SERIAL", "ID_PATH"];
    let known = keys
        .iter()
        .find_map(|key| Some((*key, property(root, device, key)?)));
    let (key, value) = known.unwrap_or(("ID_SERIAL", "its serial number".to_owned()));
    let shown = device.display();
    format!(
        "echo 'SUBSYSTEM==\"tty\", ENV{{{key}}}==\"{value}\", ENV{{HARDNESSD}}=\"1\"' | sudo tee -a \
         /etc/udev/rules.d/98-hardnessd.rules && sudo udevadm control --reload && sudo udevadm trigger \
         --action=add {shown} (99-hardnessd.rules of the package does the rest)"
    )
}

fn is_usb(device: &Path) -> bool {
    let name = device.file_name().unwrap_or_default().to_string_lossy();
    name.starts_with("ttyUSB") || name.starts_with("ttyACM")
}

fn command(root: &Path, pid: u32) -> String {
    let name = fs::read_to_string(root.join("proc").join(pid.to_string()).join("comm"));
    name.map_or("?".to_owned(), |name| name.trim().to_owned())
}

/// The line of `etc/passwd` or `etc/group` whose third field is `id`.
fn entry(root: &Path, file: &str, id: u32) -> Option<String> {
    let text = fs::read_to_string(root.join(file)).ok()?;
    let line = text.lines().find(|line| field(line, 2) == id.to_string())?;
    Some(line.to_owned())
}

fn field(line: &str, index: usize) -> String {
    line.split(':').nth(index).unwrap_or_default().to_owned()
}

#[cfg(test)]
mod tests;
