//! `hardnessd doctor`: finds why a port does not work. It prints each fault on one line, with the
//! remedy.
//!
//! It opens no device, because opening one resets boards like an Arduino.

mod checks;
#[cfg(test)]
mod tests;

use std::path::Path;

use clap::Args as ClapArgs;

use self::checks::{access, entry, examine, field, in_the_way, ports, refused, unreachable};
use super::absolute;
use super::exit::Failure;
use hardnessd_core::exit::FAILED;
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
