//! `hardnessd doctor`: finds why a port does not work. It prints each fault on one line, with the
//! remedy.
//!
//! It opens no device, because opening one resets boards like an Arduino. The exception is a port that the
//! daemon has open already.

mod checks;
#[cfg(test)]
mod tests;

use std::path::Path;

use clap::Args as ClapArgs;

use self::checks::{User, examine, in_the_way, network, ports, refused};
use super::absolute;
use super::exit::Failure;
use crate::daemon::port::Port;
use hardnessd_core::exit::{Coded, FAILED, UNAVAILABLE};
use hardnessd_core::wording::escaped;

/// What `--help` says below the options.
const MORE: &str = "\
    It opens no device but one that the daemon has open already. It looks for a missing port, \
    missing rights (of this user, and of the service), other processes that have the port open \
    (all of them only as root), settings of the line that another program changed, addresses \
    that do not answer, brltty, ModemManager and a slow FTDI timer. Exit code 1: it found a \
    fault.";

/// Arguments of `doctor`.
#[derive(Debug, Clone, ClapArgs)]
#[command(after_help = MORE)]
pub struct Args {
    /// Port to examine: a device, tcp://HOST:PORT or udp://ADDRESS:PORT [default: every USB serial port]
    #[arg(long, value_name = "P")]
    port: Option<Port>,
}

/// Faults were found, and stdout names them.
#[derive(Debug, thiserror::Error)]
#[error("{found} fault{} found", if *.found == 1 { "" } else { "s" })]
pub struct Faults {
    /// The number of faults.
    found: usize,
}

impl Coded for Faults {
    fn exit_code(&self) -> u8 {
        FAILED
    }
}

/// The fault that keeps this process from opening `port`, with the remedy. `None` if no fault is
/// visible. For example, only root can see that a process of another user holds the port.
pub(super) fn obstacle(port: &Port) -> Option<String> {
    let root = Path::new("/");
    let port = absolute(port.device()?);
    let user = User::of_this_process(root);
    let fault = refused(root, &port).or_else(|| in_the_way(root, &port, &user).into_iter().next());
    fault.map(|fault| fault.to_string())
}

/// A sensor whose port does not open.
#[derive(Debug, thiserror::Error)]
#[error("sensor {sensor:?}: {port}: {obstacle}")]
pub struct Unavailable {
    /// The sensor's name.
    sensor: String,
    /// The sensor's port, as the configuration gives it.
    port: Port,
    /// The fault, and the remedy.
    obstacle: String,
}

impl Coded for Unavailable {
    fn exit_code(&self) -> u8 {
        UNAVAILABLE
    }
}

impl Unavailable {
    /// `reason` is the system's. It counts where no fault is visible.
    pub(super) fn new(sensor: String, port: Port, reason: String) -> Self {
        let obstacle = obstacle(&port).unwrap_or(reason);
        Self {
            sensor,
            port,
            obstacle,
        }
    }
}

/// Prints the faults, each with its remedy.
///
/// # Errors
///
/// Returns [`Faults`] if there is a fault, and [`super::Stdout`] if stdout cannot be written to.
pub fn run(args: &Args) -> Result<(), Failure> {
    let root = Path::new("/");
    let user = User::of_this_process(root);
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
                let faults = match refused(root, &path) {
                    Some(fault) => vec![fault],
                    None => examine(root, &path, &user),
                };
                (Port::Device(path), faults)
            }
            None => {
                let faults = network::faults(root, &port);
                (port, faults)
            }
        };
        found += faults.len();
        if faults.is_empty() {
            lines.push(format!("{port}: no fault found"));
        }
        for fault in faults {
            lines.push(format!("{port}: {fault}"));
        }
    }
    let printed: String = lines.iter().map(|line| escaped(line) + "\n").collect();
    super::print(printed.as_bytes())?;
    match found {
        0 => Ok(()),
        found => Err(Faults { found }.into()),
    }
}
