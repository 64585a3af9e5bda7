//! `hardnessd watch` on a real pty, with a real daemon: what the watch shows, and that it is
//! restored.

use std::collections::HashSet;
use std::fs::File;
use std::io::Read;
use std::time::{Duration, Instant};

use crate::bench::pair::Pair;
use crate::bench::{Bench, PATIENCE, Terminal, on_terminal};
use rustix::process::Signal;
use rustix::termios::LocalModes;

/// A `watch` on a terminal.
struct Watch {
    terminal: Terminal,
    screen: vt100::Parser,
}

impl Watch {
    fn new(bench: &Bench) -> Self {
        let socket = bench.text_path("events.sock");
        Self {
            terminal: Terminal::start(&format!("watch --socket {socket}")),
            screen: vt100::Parser::default(),
        }
    }

    /// Waits until `there` is true for the screen. Returns its text.
    fn until(&mut self, what: &str, there: impl Fn(&vt100::Screen) -> bool) -> String {
        let start = Instant::now();
        loop {
            let text = self.screen.screen().contents();
            if there(self.screen.screen()) {
                return text;
            }
            assert!(
                start.elapsed() < PATIENCE,
                "{what} is not shown, but\n{text}"
            );
            if let Some(bytes) = self.terminal.read(Duration::from_millis(50)) {
                self.screen.process(&bytes);
            }
        }
    }

    fn shows(&mut self, part: &str) -> String {
        self.until(part, |screen| screen.contents().contains(part))
    }

    /// Asserts that `watch` ends by itself and restores the terminal.
    fn ends(mut self) {
        self.terminal.process.exit_code();
        let modes = rustix::termios::tcgetattr(&self.terminal.device).unwrap();
        let usual = LocalModes::ECHO | LocalModes::ICANON | LocalModes::ISIG;
        assert!(modes.local_modes.contains(usual), "{modes:?}");
        let written = self.terminal.ends();
        assert!(
            written.ends_with("\x1b[?1049l"),
            "the screen is not given back"
        );
        self.screen.process(written.as_bytes());
        assert!(!self.screen.screen().hide_cursor());
    }
}

/// The number of different colours.
fn colours(screen: &vt100::Screen) -> usize {
    let cells = (0..24).flat_map(|row| (0..80).map(move |col| (row, col)));
    let cells = cells.filter_map(|(row, col)| screen.cell(row, col));
    let found = cells.flat_map(|cell| [cell.fgcolor(), cell.bgcolor()]);
    let found: HashSet<String> = found.map(|colour| format!("{colour:?}")).collect();
    found.len()
}

/// Whether a line is that of the final verdict of a press. It ends with the force, an early one with `early`.
fn is_final(line: &str, press: u32) -> bool {
    line.contains(&format!(" {press} ")) && line.contains(" OO") && !line.contains("early")
}

#[test]
fn it_shows_presses_loss_and_a_daemon_that_goes_and_comes_back() {
    let bench = Bench::new();
    let mut watch = Watch::new(&bench);
    watch.shows("NO DAEMON");
    // Another program writes to the same terminal.
    watch.screen.process(b"\x1b[20;30Ha line of the log");
    watch.until("a whole picture", |screen| {
        !screen.contents().contains("a line of the log")
    });
    let mut daemon = bench.daemon();
    watch.shows("arm-7");
    let mut sensor = bench.sensor("");
    watch.shows("LIVE");
    watch.shows("in contact for");
    // The map is nothing but colours. The terminal's user has NO_COLOR.
    watch.until("a map", |screen| colours(screen) >= 10);
    watch.until("a final verdict", |screen| {
        let text = screen.contents();
        text.lines().any(|line| is_final(line, 1))
    });
    let text = watch.shows("LIVE");
    assert_eq!(text.lines().count(), 24, "{text}");
    bench.unplug(&mut sensor);
    let text = watch.shows("LOST");
    assert!(text.contains("force not known"), "{text}");
    daemon.process.signal(Signal::TERM);
    let text = watch.shows("NO DAEMON");
    assert!(text.contains("last frame"), "{text}");
    daemon.process.exit_code();
    let _sensor = bench.sensor("");
    let daemon = bench.daemon();
    watch.shows("LIVE");
    // A daemon that runs but does not answer must not look healthy.
    daemon.process.signal(Signal::STOP);
    watch.shows("DAEMON SILENT");
    daemon.process.signal(Signal::CONT);
    watch.shows("LIVE");
    watch.terminal.types("q");
    watch.ends();
}

#[test]
fn ctrl_c_and_both_signals_end_it_and_give_the_terminal_back() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    let end: [fn(&Terminal); 3] = [
        |terminal| terminal.types("\x03"),
        |terminal| terminal.process.signal(Signal::TERM),
        |terminal| terminal.process.signal(Signal::INT),
    ];
    for end in end {
        let mut watch = Watch::new(&bench);
        watch.shows("CONNECTING");
        end(&watch.terminal);
        watch.ends();
    }
}

#[test]
fn a_terminal_that_takes_nothing_does_not_keep_it() {
    let bench = Bench::new();
    let _daemon = bench.daemon();
    let _sensor = bench.sensor("");
    let mut watch = Watch::new(&bench);
    watch.shows("LIVE");
    let Terminal {
        device, process, ..
    } = &mut watch.terminal;
    rustix::termios::tcflow(device, rustix::termios::Action::OOff).unwrap();
    std::thread::sleep(Duration::from_secs(1));
    process.ends_at(Signal::TERM, 0);
}

#[test]
fn a_terminal_that_goes_away_ends_it() {
    let bench = Bench::new();
    let Pair { master, device, .. } = Pair::open().unwrap();
    let socket = bench.text_path("events.sock");
    let mut watch = on_terminal(&format!("watch --socket {socket}"), &device);
    drop(device);
    assert!(File::from(master).read(&mut [0; 4096]).unwrap() > 0);
    // The other end of the terminal is closed. No signal tells `watch`, because this is not its
    // controlling terminal.
    assert_eq!(watch.exit_code(), Some(0));
}

#[test]
fn without_a_terminal_it_says_what_needs_none() {
    Bench::new().fails("watch", 2, &["terminal", "tail"]);
}
