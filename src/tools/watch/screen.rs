//! The terminal: taken over, written to, read from, given back whatever happens.
//!
//! It is written to by a thread of its own, so that one that takes nothing (Ctrl-S, a slow ssh)
//! delays neither the reading of events nor the end: while a picture is on its way no other is
//! drawn.

use std::io;
use std::panic;
use std::sync::{OnceLock, mpsc as std_mpsc};
use std::time::Duration;

use ratatui_core::layout::Size;
use ratatui_core::terminal::{Frame, Terminal};
use rustix::termios::{OptionalActions, Termios};
use tokio::sync::mpsc;

use super::ansi::{Ansi, ENTER, LEAVE};
use super::view::Key;

/// How long the terminal may take for the last bytes.
const LAST_BYTES: Duration = Duration::from_millis(200);

/// As a terminal that does not know its size is taken (a serial console).
const USUAL: Size = Size {
    width: 80,
    height: 24,
};

/// How the terminal was found. Once a process: a panic must be able to find it.
static FOUND: OnceLock<Termios> = OnceLock::new();

/// The terminal in our hands.
pub(super) struct Screen {
    terminal: Terminal<Ansi>,
    out: Option<mpsc::Sender<String>>,
    written: std_mpsc::Receiver<()>,
}

impl Screen {
    /// Takes the terminal of stdin and stdout over.
    pub(super) fn open() -> io::Result<Self> {
        let stdin = rustix::stdio::stdin();
        let found = rustix::termios::tcgetattr(stdin)?;
        let mut raw = FOUND.get_or_init(|| found).clone();
        raw.make_raw();
        let before = panic::take_hook();
        panic::set_hook(Box::new(move |panic| {
            give_back();
            let _ = write(LEAVE.as_bytes());
            before(panic);
        }));
        rustix::termios::tcsetattr(stdin, OptionalActions::Now, &raw)?;
        let (out, mut pictures) = mpsc::channel::<String>(1);
        let (done, written) = std_mpsc::channel();
        std::thread::Builder::new()
            .name("screen".to_owned())
            .spawn(move || {
                let _ = write(ENTER.as_bytes());
                while let Some(picture) = pictures.blocking_recv() {
                    // A terminal that is gone ends the input too.
                    let _ = write(picture.as_bytes());
                }
                let _ = write(LEAVE.as_bytes());
                let _ = done.send(());
            })?;
        let terminal = Terminal::new(Ansi::new(size())).unwrap_or_else(|never| match never {});
        Ok(Self {
            terminal,
            out: Some(out),
            written,
        })
    }

    /// Draws, unless the last picture is still on its way.
    pub(super) fn draw(&mut self, picture: impl FnOnce(&mut Frame)) {
        let Some(Ok(room)) = self.out.as_ref().map(mpsc::Sender::try_reserve) else {
            return;
        };
        self.terminal.backend_mut().resize(size());
        self.terminal
            .draw(picture)
            .unwrap_or_else(|never| match never {});
        let bytes = self.terminal.backend_mut().take();
        if !bytes.is_empty() {
            room.send(bytes);
        }
    }

    /// Forgets what stands there, so that the next picture is written whole.
    pub(super) fn forget(&mut self) {
        self.terminal.clear().unwrap_or_else(|never| match never {});
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        self.out = None;
        let _ = self.written.recv_timeout(LAST_BYTES);
        give_back();
    }
}

fn give_back() {
    if let Some(found) = FOUND.get() {
        let _ = rustix::termios::tcsetattr(rustix::stdio::stdin(), OptionalActions::Now, found);
    }
}

/// Past the standard library's lock, which a stalled thread may hold while another panics.
fn write(mut bytes: &[u8]) -> rustix::io::Result<()> {
    while !bytes.is_empty() {
        let written =
            rustix::io::retry_on_intr(|| rustix::io::write(rustix::stdio::stdout(), bytes))?;
        bytes = &bytes[written..];
    }
    Ok(())
}

fn size() -> Size {
    match rustix::termios::tcgetwinsize(rustix::stdio::stdout()) {
        Ok(size) if size.ws_col > 0 && size.ws_row > 0 => Size::new(size.ws_col, size.ws_row),
        _ => USUAL,
    }
}

/// Keys as they are pressed, until there is no more input.
pub(super) fn keys() -> io::Result<mpsc::Receiver<Key>> {
    let (sender, keys) = mpsc::channel(16);
    std::thread::Builder::new()
        .name("keys".to_owned())
        .spawn(move || {
            let mut bytes = [0; 64];
            let read = |bytes: &mut [u8]| {
                rustix::io::retry_on_intr(|| rustix::io::read(rustix::stdio::stdin(), &mut *bytes))
            };
            while let Ok(length @ 1..) = read(&mut bytes) {
                for key in pressed(&bytes[..length]) {
                    if sender.blocking_send(key).is_err() {
                        return;
                    }
                }
            }
        })?;
    Ok(keys)
}

/// The keys in what a terminal sends at a time; others mean nothing.
pub(super) fn pressed(mut bytes: &[u8]) -> Vec<Key> {
    let mut keys = Vec::new();
    while let Some((&first, rest)) = bytes.split_first() {
        bytes = rest;
        keys.extend(match first {
            // Ctrl-C: in raw mode it is no signal.
            b'q' | b'Q' | 0x03 => Some(Key::Quit),
            0x0c => Some(Key::Redraw),
            b'\t' => Some(Key::Next),
            b'1'..=b'9' => Some(Key::Sensor(usize::from(first - b'1'))),
            0x1b => {
                let escaped = escaped(&mut bytes);
                match escaped {
                    Some(b'C' | b'B') => Some(Key::Next),
                    Some(b'D' | b'A' | b'Z') => Some(Key::Previous),
                    _ => None,
                }
            }
            _ => None,
        });
    }
    keys
}

/// Passes over the rest of an escape sequence; its last byte, if it is one of a key without a
/// parameter.
fn escaped(bytes: &mut &[u8]) -> Option<u8> {
    let is_introduced = matches!(bytes.first(), Some(b'[' | b'O'));
    if !is_introduced {
        return None;
    }
    let end = 1 + bytes[1..]
        .iter()
        .position(|byte| (0x40..0x7f).contains(byte))?;
    let key = (end == 1).then_some(bytes[end]);
    *bytes = &bytes[end + 1..];
    key
}
