//! `hardnessd watch` on a real pty, with a real daemon: what the terminal shows, and that it is
//! restored.

use std::fs::File;
use std::io::Read;
use std::num::NonZero;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixListener;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use crate::bench::pair::Pair;
use crate::bench::{BINARY, Bench, PATIENCE, Process, hardnessd, start_on};
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
    fn new(socket: &Path, size: (u16, u16), variables: &[(&str, &str)]) -> Self {
        let pair = Pair::open().unwrap();
        resize(&pair.master, size);
        let mut command = Command::new("setsid");
        command.args([BINARY, "watch", "--socket"]).arg(socket);
        command
            .env("TERM", "xterm-256color")
            .env("LC_ALL", "C.UTF-8")
            .env_remove("NO_COLOR")
            .envs(variables.iter().copied());
        let (watch, bytes) = start_on(&pair, command);
        Self {
            watch,
            pair,
            bytes,
            written: Vec::new(),
            parser: vt100::Parser::new(nonzero(size.1), nonzero(size.0), 0),
        }
    }

    fn resize(&mut self, size: (u16, u16)) {
        self.parser
            .screen_mut()
            .set_size(nonzero(size.1), nonzero(size.0));
        resize(&self.pair.master, size);
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
    let mut terminal = Terminal::new(&bench.path("events.sock"), (80, 24), &[]);
    terminal.shows("NO DAEMON");
    let mut daemon = bench.daemon();
    terminal.shows("arm-7");
    let mut sensor = bench.sensor(&[]);
    terminal.shows("LIVE");
    terminal.shows("in contact for");
    terminal.until("a final verdict", |text| {
        text.lines().any(|line| line.contains("1 final"))
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
fn what_takes_the_connection_and_says_nothing_is_silent() {
    let bench = Bench::new();
    let path = bench.path("events.sock");
    // The system accepts connections for any listener.
    let listener = UnixListener::bind(&path).unwrap();
    let mut terminal = Terminal::new(&path, (80, 24), &[]);
    terminal.shows("NO DAEMON");
    terminal.shows("DAEMON SILENT  no answer for");
    std::fs::remove_file(&path).unwrap();
    drop(listener);
    terminal.shows("NO DAEMON");
    let _daemon = bench.daemon();
    terminal.shows("CONNECTING");
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
        let mut terminal = Terminal::new(&bench.path("events.sock"), (80, 24), &[]);
        terminal.shows("CONNECTING");
        end(&terminal);
        terminal.ends();
    }
}

#[test]
fn it_fits_whatever_size_the_terminal_takes() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    let _sensor = bench.sensor(&[]);
    let mut terminal = Terminal::new(&bench.path("events.sock"), (120, 50), &[]);
    terminal.shows("LIVE");
    terminal.shows("contact area");
    for size in [(40, 24), (80, 24), (20, 5), (100, 40)] {
        terminal.resize(size);
        // The old screen is gone: the keys are in the last row and nowhere else.
        terminal.until("the new size", |text| {
            let lines: Vec<&str> = text.lines().collect();
            let keys = |line: &&str| line.starts_with("q quit");
            lines.len() == usize::from(size.1)
                && lines.last().is_some_and(keys)
                && lines.iter().filter(|line| keys(line)).count() == 1
                && text.contains("LIVE")
        });
    }
    terminal.press(b"q");
    terminal.ends();
}

#[test]
fn a_terminal_without_colours_gets_none() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    let _sensor = bench.sensor(&[]);
    let check = |variables: &[(&str, &str)], forbidden: &[&str]| {
        let mut terminal = Terminal::new(&bench.path("events.sock"), (80, 24), variables);
        terminal.shows("in contact for");
        let written = String::from_utf8_lossy(&terminal.written).into_owned();
        for sequence in forbidden {
            assert!(!written.contains(sequence), "{sequence:?} in {variables:?}");
        }
        terminal.press(b"q");
        terminal.ends();
    };
    check(&[], &[]);
    check(&[("COLORTERM", "")], &["38;2", "48;2"]);
    check(&[("COLORTERM", "truecolor")], &["48;5;53"]);
    check(
        &[("COLORTERM", "truecolor"), ("NO_COLOR", "1")],
        &["38;2", "38;5", "48;5"],
    );
    check(&[("TERM", "vt100")], &["38;5", "48;5", "\u{2580}"]);
    check(&[("TERM", "dumb")], &["38;5", ";1m", ";7m", "\u{2580}"]);
}

#[test]
fn a_terminal_that_takes_nothing_does_not_keep_it() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    let _sensor = bench.sensor(&[]);
    let mut terminal = Terminal::new(&bench.path("events.sock"), (80, 24), &[]);
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
    command
        .args([BINARY, "watch", "--socket"])
        .arg(bench.path("events.sock"));
    command
        .env("TERM", "xterm")
        .stdin(end())
        .stdout(end())
        .stderr(Stdio::null());
    let mut watch = Process(command.spawn().unwrap());
    drop((command, device));
    let mut shown = [0; 4096];
    assert!(File::from(master).read(&mut shown).unwrap() > 0);
    // The other end of the terminal is closed. No signal tells `watch`, because this is not its
    // controlling terminal.
    assert_eq!(watch.exit_code(), Some(0));
}

#[test]
fn presses_from_before_are_known() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    let _sensor = bench.sensor(&["--speed", "4", "--presses", "2"]);
    let mut subscriber = bench.subscriber();
    for press in [1, 2] {
        let last = serde_json::json!({"type": "hardness", "phase": "final", "press": press});
        subscriber.until(&last);
    }
    let mut terminal = Terminal::new(&bench.path("events.sock"), (80, 24), &[]);
    let both = |text: &str| {
        let shows = |part| text.lines().any(|line| line.contains(part));
        shows("press 2 ") && shows("  2 final ") && shows("  1 final ")
    };
    terminal.until("both presses", both);
    terminal.shows("LOST  unplugged");
    terminal.press(b"q");
    terminal.ends();
}

#[test]
fn without_a_terminal_it_says_what_needs_none() {
    let output = hardnessd(&["watch"]);
    assert_eq!(output.status.code(), Some(2));
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(
        stderr.contains("terminal") && stderr.contains("tail"),
        "{stderr}"
    );
}
