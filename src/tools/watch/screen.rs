//! Takes the terminal over, draws on it, reads keys, and always restores it.
//!
//! Pictures are made in memory, and a thread of their own writes them. So a terminal that accepts
//! no bytes (Ctrl-S, a slow ssh) delays neither the reading of events nor the end. While a picture
//! is being written, no other is drawn.

use std::cell::RefCell;
use std::fs::File;
use std::io::{self, Write};
use std::mem;
use std::os::fd::AsFd;
use std::panic;
use std::rc::Rc;
use std::sync::mpsc as std_mpsc;
use std::time::Duration;

use ratatui_core::layout::Rect;
use ratatui_core::terminal::{Frame, Terminal, TerminalOptions, Viewport};
use ratatui_crossterm::CrosstermBackend;
use ratatui_crossterm::crossterm::cursor::{Hide, MoveTo, Show};
use ratatui_crossterm::crossterm::event::{self, Event, KeyEvent};
use ratatui_crossterm::crossterm::execute;
use ratatui_crossterm::crossterm::style::{Attribute, SetAttribute};
use ratatui_crossterm::crossterm::terminal::{
    self, Clear, ClearType, EnterAlternateScreen, LeaveAlternateScreen,
};
use tokio::sync::mpsc;

use crate::maybe;

/// How long the terminal may take for the last bytes.
const LAST_BYTES: Duration = Duration::from_millis(200);

/// The size of a terminal that does not know its own (a serial console).
const USUAL: (u16, u16) = (80, 24);

/// A terminal that was taken over.
pub(super) struct Screen {
    terminal: Terminal<CrosstermBackend<Picture>>,
    area: Rect,
    picture: Picture,
    out: Option<mpsc::Sender<Vec<u8>>>,
    written: std_mpsc::Receiver<()>,
}

/// The bytes of a picture that is being made.
#[derive(Clone, Default)]
struct Picture(Rc<RefCell<Vec<u8>>>);

impl Write for Picture {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.borrow_mut().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Screen {
    /// Takes the terminal of stdin and stdout over.
    pub(super) fn open() -> io::Result<Self> {
        // This handle avoids the standard library's lock, which a stalled thread could hold while
        // another one panics.
        let stdout = File::from(io::stdout().as_fd().try_clone_to_owned()?);
        let area = area();
        let picture = Picture::default();
        let backend = CrosstermBackend::new(picture.clone());
        let viewport = Viewport::Fixed(area);
        let terminal = Terminal::with_options(backend, TerminalOptions { viewport })?;
        let before = panic::take_hook();
        panic::set_hook(Box::new(move |panic| {
            let _ = leave(&mut io::stdout());
            let _ = terminal::disable_raw_mode();
            before(panic);
        }));
        terminal::enable_raw_mode()?;
        let (out, pictures) = mpsc::channel(1);
        let (done, written) = std_mpsc::channel();
        std::thread::Builder::new()
            .name("screen".to_owned())
            .spawn(move || {
                // If the terminal has gone, this thread ends, and the caller notices that.
                let _ = write_all(stdout, pictures);
                let _ = done.send(());
            })?;
        Ok(Self {
            terminal,
            area,
            picture,
            out: Some(out),
            written,
        })
    }

    /// Draws, unless the last picture is still being written.
    pub(super) fn draw(&mut self, picture: impl FnOnce(&mut Frame)) -> io::Result<()> {
        let Some(Ok(room)) = self.out.as_ref().map(mpsc::Sender::try_reserve) else {
            return Ok(());
        };
        let area = area();
        if mem::replace(&mut self.area, area) != area {
            self.terminal.resize(area)?;
        }
        self.terminal.draw(picture)?;
        room.send(self.picture.0.take());
        Ok(())
    }

    /// Forgets what the terminal shows, so that the next picture is written as a whole.
    pub(super) fn forget(&mut self) -> io::Result<()> {
        self.terminal.resize(self.area)
    }

    /// Waits until the terminal has gone.
    pub(super) async fn gone(&self) {
        maybe::wait(self.out.as_ref().map(mpsc::Sender::closed)).await;
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        self.out = None;
        let _ = self.written.recv_timeout(LAST_BYTES);
        let _ = terminal::disable_raw_mode();
    }
}

/// Writes pictures to a terminal until no more come.
fn write_all(mut out: File, mut pictures: mpsc::Receiver<Vec<u8>>) -> io::Result<()> {
    let clear = Clear(ClearType::All);
    execute!(out, EnterAlternateScreen, Hide, clear)?;
    while let Some(picture) = pictures.blocking_recv() {
        out.write_all(&picture)?;
    }
    leave(&mut out)
}

/// Restores the terminal. A terminal without an alternate screen is left empty.
fn leave(out: &mut impl Write) -> io::Result<()> {
    let (plain, clear) = (SetAttribute(Attribute::Reset), Clear(ClearType::All));
    execute!(out, plain, clear, MoveTo(0, 0), Show, LeaveAlternateScreen)
}

fn area() -> Rect {
    let size = terminal::size().ok();
    let (width, height) = size.filter(|&(w, h)| w > 0 && h > 0).unwrap_or(USUAL);
    Rect::new(0, 0, width, height)
}

/// Sends keys as they are pressed, until the input ends.
pub(super) fn keys() -> io::Result<mpsc::Receiver<KeyEvent>> {
    let (sender, keys) = mpsc::channel(16);
    std::thread::Builder::new()
        .name("keys".to_owned())
        .spawn(move || {
            while let Ok(event) = event::read() {
                if let Event::Key(key) = event
                    && sender.blocking_send(key).is_err()
                {
                    return;
                }
            }
        })?;
    Ok(keys)
}
