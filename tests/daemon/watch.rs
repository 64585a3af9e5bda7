//! `hardnessd watch` on a real pty, with a real daemon: what the terminal shows, and that it is
//! restored.

use std::fs::File;
use std::io::Read;
use std::num::NonZero;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use crate::bench::pair::Pair;
use crate::bench::{BINARY, Bench, PATIENCE, Process, fails, start_on};
use rustix::process::Signal;
use rustix::termios::{LocalModes, Winsize};

/// A terminal with a `watch` on it.
struct Terminal {
    watch: Process,
    pair: Pair,
    bytes: Receiver<Vec<u8>>,
    written: Vec<u8>,
    parser: vt100::Parser,
}

impl Terminal {
    fn new(socket: &Path) -> Self {
        let size = (80, 24);
        let pair = Pair::open().unwrap();
        resize(&pair.master, size);
        let mut command = Command::new("setsid");
        command.args([BINARY, "watch", "--socket"]).arg(socket);
        command
            .env("TERM", "xterm-256color")
            .env("LC_ALL", "C.UTF-8")
            .env_remove("NO_COLOR");
        let (watch, bytes) = start_on(&pair, command);
        Self {
            watch,
            pair,
            bytes,
            written: Vec::new(),
            parser: vt100::Parser::new(nonzero(size.1), nonzero(size.0), 0),
        }
    }

    fn press(&self, keys: &[u8]) {
        rustix::io::write(&self.pair.master, keys).unwrap();
    }

    /// Waits until `there` is true for the screen.
    fn until(&mut self, what: &str, there: impl Fn(&str) -> bool) -> String {
        let start = Instant::now();
        loop {
            let text = self.parser.screen().contents();
            if there(&text) {
                return text;
            }
            assert!(
                start.elapsed() < PATIENCE,
                "{what} is not shown, but\n{text}"
            );
            self.read(Duration::from_millis(50));
        }
    }

    fn shows(&mut self, part: &str) -> String {
        self.until(part, |text| text.contains(part))
    }

    fn read(&mut self, patience: Duration) {
        if let Ok(bytes) = self.bytes.recv_timeout(patience) {
            self.parser.process(&bytes);
            self.written.extend(bytes);
        }
    }

    /// Asserts that `watch` ends by itself and restores the terminal.
    fn ends(mut self) {
        assert_eq!(self.watch.exit_code(), Some(0));
        while !self.written.ends_with(b"\x1b[?1049l") {
            let before = self.written.len();
            self.read(Duration::from_secs(1));
            assert!(self.written.len() > before, "the screen is not given back");
        }
        let screen = self.parser.screen();
        assert!(!screen.alternate_screen() && !screen.hide_cursor());
        let modes = rustix::termios::tcgetattr(&self.pair.device).unwrap();
        let usual = LocalModes::ECHO | LocalModes::ICANON | LocalModes::ISIG;
        assert!(modes.local_modes.contains(usual), "{modes:?}");
    }
}

/// Whether a line is that of the final verdict of a press. It ends with the force, an early one with `early`.
fn is_final(line: &str, press: u32) -> bool {
    line.contains(&format!(" {press} ")) && line.contains(" OO, ") && !line.contains("early")
}

fn nonzero(number: u16) -> NonZero<u16> {
    NonZero::new(number).unwrap()
}

fn resize(terminal: &OwnedFd, (width, height): (u16, u16)) {
    let size = Winsize {
        ws_row: height,
        ws_col: width,
        ws_xpixel: 0,
        ws_ypixel: 0,
    };
    rustix::termios::tcsetwinsize(terminal, size).unwrap();
}

#[test]
fn it_shows_presses_loss_and_a_daemon_that_goes_and_comes_back() {
    let bench = Bench::new();
    let mut terminal = Terminal::new(&bench.path("events.sock"));
    terminal.shows("NO DAEMON");
    let mut daemon = bench.daemon();
    terminal.shows("arm-7");
    let mut sensor = bench.sensor(&[]);
    terminal.shows("LIVE");
    terminal.shows("in contact for");
    terminal.until("a final verdict", |text| {
        text.lines().any(|line| is_final(line, 1))
    });
    let text = terminal.shows("LIVE");
    assert_eq!(text.lines().count(), 24, "{text}");
    bench.unplug(&mut sensor);
    let text = terminal.shows("LOST");
    assert!(text.contains("force not known"), "{text}");
    daemon.process.signal(Signal::TERM);
    let text = terminal.shows("NO DAEMON");
    assert!(text.contains("last frame"), "{text}");
    daemon.process.exit_code();
    let _sensor = bench.sensor(&[]);
    let _daemon = bench.daemon();
    terminal.shows("LIVE");
    // A daemon that runs but does not answer must not look healthy.
    _daemon.process.signal(Signal::STOP);
    terminal.shows("DAEMON SILENT");
    _daemon.process.signal(Signal::CONT);
    terminal.shows("LIVE");
    terminal.press(b"q");
    terminal.ends();
}

#[test]
fn ctrl_c_and_both_signals_end_it_and_give_the_terminal_back() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    let end: [fn(&Terminal); 3] = [
        |terminal| terminal.press(b"\x03"),
        |terminal| terminal.watch.signal(Signal::TERM),
        |terminal| terminal.watch.signal(Signal::INT),
    ];
    for end in end {
        let mut terminal = Terminal::new(&bench.path("events.sock"));
        terminal.shows("CONNECTING");
        end(&terminal);
        terminal.ends();
    }
}

#[test]
fn a_terminal_that_takes_nothing_does_not_keep_it() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    let _sensor = bench.sensor(&[]);
    let mut terminal = Terminal::new(&bench.path("events.sock"));
    terminal.shows("LIVE");
    rustix::termios::tcflow(&terminal.pair.device, rustix::termios::Action::OOff).unwrap();
    std::thread::sleep(Duration::from_secs(1));
    let start = Instant::now();
    terminal.watch.signal(Signal::TERM);
    assert_eq!(terminal.watch.exit_code(), Some(0));
    assert!(start.elapsed() < Duration::from_secs(5));
}

#[test]
fn a_terminal_that_goes_away_ends_it() {
    let bench = Bench::new();
    let Pair { master, device, .. } = Pair::open().unwrap();
    resize(&master, (80, 24));
    let end = || Stdio::from(device.try_clone().unwrap());
    let mut command = Command::new("setsid");
    command.args([BINARY, "watch", "--socket"]);
    command.arg(bench.path("events.sock")).env("TERM", "xterm");
    command.stdin(end()).stdout(end()).stderr(Stdio::null());
    let mut watch = Process(command.spawn().unwrap());
    drop((command, device));
    let mut shown = [0; 4096];
    assert!(File::from(master).read(&mut shown).unwrap() > 0);
    // The other end of the terminal is closed. No signal tells `watch`, because this is not its
    // controlling terminal.
    assert_eq!(watch.exit_code(), Some(0));
}

#[test]
fn without_a_terminal_it_says_what_needs_none() {
    fails(&["watch"], 2, &["terminal", "tail"]);
}
