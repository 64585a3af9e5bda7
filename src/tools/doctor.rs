//! `hardnessd doctor`: why a port does not work. One line per finding, each with the remedy.
//!
//! It opens no device, because opening one resets boards like an Arduino.

mod checks;
#[cfg(test)]
mod tests;

use std::io;
use std::path::{Path, PathBuf};

use clap::Args as ClapArgs;

use self::checks::{User, examine, in_the_way, ports, refused};
use super::shown;

/// Arguments of `doctor`.
#[derive(Debug, Clone, ClapArgs)]
pub struct Args {
    /// Port to examine [default: every USB serial port]
    #[arg(long, value_name = "P")]
    port: Option<PathBuf>,
}

/// Why it ended with an error.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Faults were found, and stdout names them.
    #[error("{found} fault{} found", if *.found == 1 { "" } else { "s" })]
    Faults {
        /// Lines printed.
        found: usize,
    },
    /// Stdout cannot be written to.
    #[error("stdout: {0}")]
    Print(#[source] io::Error),
}

/// What keeps this process from opening `port`, and what to do; `None` where nothing is seen, such as
/// a process of another user that holds it.
pub(super) fn obstacle(port: &Path) -> Option<String> {
    let root = Path::new("/");
    let port = std::path::absolute(port).unwrap_or_else(|_| port.to_owned());
    let user = User::of_this_process(root);
    let fault = refused(root, &port).or_else(|| in_the_way(root, &port, &user).into_iter().next());
    fault.map(|fault| fault.to_string())
}

/// Prints what is wrong, and the remedy.
///
/// # Errors
///
/// [`Error::Faults`], if anything is; [`Error::Print`], if it cannot be said.
pub fn run(args: &Args) -> Result<(), Error> {
    let root = Path::new("/");
    let user = User::of_this_process(root);
    let ports = args
        .port
        .as_ref()
        .map_or_else(|| ports(root), |port| vec![port.clone()]);
    let mut lines = Vec::new();
    let mut found = 0;
    if ports.is_empty() {
        found += 1;
        let line = "no USB serial port: plug the sensor in, then see `sudo dmesg | grep tty`";
        lines.push(line.to_owned());
    }
    for port in ports {
        let port = std::path::absolute(&port).unwrap_or(port);
        let faults = match refused(root, &port) {
            Some(fault) => vec![fault],
            None => examine(root, &port, &user),
        };
        found += faults.len();
        if faults.is_empty() {
            lines.push(format!("{}: no fault found", port.display()));
        }
        for fault in faults {
            lines.push(format!("{}: {fault}", port.display()));
        }
    }
    let told: String = lines.iter().map(|line| shown(line) + "\n").collect();
    super::print(told.as_bytes()).map_err(Error::Print)?;
    match found {
        0 => Ok(()),
        found => Err(Error::Faults { found }),
    }
}
