//! What stands around the daemon: a sensor to try it on, recordings played again, eyes on a terminal.

pub mod check;
pub mod demo;
pub mod doctor;
mod faults;
pub mod generate;
mod player;
mod pty;
pub mod replay;
pub mod simulate;
pub mod sniff;
pub mod tail;
pub mod watch;

use std::io::{ErrorKind, Write};

/// Writes lines to stdout at once. `Ok(false)`: nobody reads any more, which ends a tool quietly.
fn print(lines: &[u8]) -> std::io::Result<bool> {
    let mut out = std::io::stdout().lock();
    match out.write_all(lines).and_then(|()| out.flush()) {
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(false),
        written => written.map(|()| true),
    }
}
