//! The program on a terminal.

use std::fs::File;
use std::io::Read;
use std::os::fd::OwnedFd;
use std::process::{Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use rustix::termios::{tcgetwinsize, tcsetwinsize};

use super::pair::Pair;
use super::{BINARY, PATIENCE, Process};

/// A program on a terminal of 80x24 characters.
pub struct Terminal {
    pub process: Process,
    pub master: OwnedFd,
    pub device: OwnedFd,
    bytes: Receiver<Vec<u8>>,
    /// The output that the test has not looked at yet.
    pub written: String,
}

/// Starts the program with the words of `line` as its arguments on a terminal.
///
/// `setsid` keeps it from using the terminal that the test was started from.
pub fn on_terminal(line: &str, device: &OwnedFd) -> Process {
    let mut size = tcgetwinsize(device).unwrap();
    (size.ws_col, size.ws_row) = (80, 24);
    tcsetwinsize(device, size).unwrap();
    let end = || Stdio::from(device.try_clone().unwrap());
    let mut command = Command::new("setsid");
    command.arg(BINARY).args(line.split_whitespace());
    command
        .env("TERM", "xterm-256color")
        .env("LC_ALL", "C.UTF-8")
        .env("NO_COLOR", "1");
    Process::start(command.stdin(end()).stdout(end()).stderr(end()))
}

impl Terminal {
    pub fn start(line: &str) -> Self {
        let Pair { master, device, .. } = Pair::open().unwrap();
        let process = on_terminal(line, &device);
        let mut output = File::from(master.try_clone().unwrap());
        let (sender, bytes) = channel();
        std::thread::spawn(move || {
            let mut read = [0; 4096];
            while let Ok(length @ 1..) = output.read(&mut read) {
                if sender.send(read[..length].to_vec()).is_err() {
                    return;
                }
            }
        });
        Self {
            process,
            master,
            device,
            bytes,
            written: String::new(),
        }
    }

    pub fn types(&self, keys: &str) {
        rustix::io::write(&self.master, keys.as_bytes()).unwrap();
    }

    /// Takes what it writes within this time, if it writes anything.
    pub fn read(&mut self, patience: Duration) -> Option<Vec<u8>> {
        let bytes = self.bytes.recv_timeout(patience).ok()?;
        self.written += &String::from_utf8_lossy(&bytes);
        Some(bytes)
    }

    /// Waits for `part` in the output that was not looked at before. Returns what comes before it.
    pub fn sees(&mut self, part: &str) -> String {
        let start = Instant::now();
        loop {
            if let Some(at) = self.written.find(part) {
                let rest = self.written.split_off(at + part.len());
                let mut before = std::mem::replace(&mut self.written, rest);
                before.truncate(at);
                return before;
            }
            let left = PATIENCE.saturating_sub(start.elapsed());
            assert!(left > Duration::ZERO, "{part:?} not in {:?}", self.written);
            self.read(left);
        }
    }

    /// Waits for its end. Returns the rest of its output.
    pub fn ends(mut self) -> String {
        assert_eq!(self.process.exit_code(), Some(0), "{}", self.written);
        // The reader ends with the last descriptor of the device.
        drop(self.device);
        let rest: Vec<u8> = self.bytes.iter().flatten().collect();
        self.written += &String::from_utf8_lossy(&rest);
        self.written.replace("\r\n", "\n")
    }
}
