//! Takes the terminal over, draws on it, and always restores it.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::mem::ManuallyDrop;
use std::os::fd::AsFd;
use std::panic;

use ratatui_core::layout::Rect;
use ratatui_core::terminal::{Frame, Terminal, TerminalOptions, Viewport};
use ratatui_crossterm::CrosstermBackend;
use ratatui_crossterm::crossterm::cursor::{Hide, MoveTo, Show};
use ratatui_crossterm::crossterm::execute;
use ratatui_crossterm::crossterm::style::{Attribute, SetAttribute, force_color_output};
use ratatui_crossterm::crossterm::terminal::{
    self, Clear, ClearType, EnterAlternateScreen, LeaveAlternateScreen,
};

/// The size of a terminal that does not know its own (a serial console).
const USUAL: (u16, u16) = (80, 24);

/// A terminal that was taken over.
pub(super) struct Screen {
    /// Its own drop writes to stderr, and panics where the terminal has gone.
    terminal: ManuallyDrop<Terminal<CrosstermBackend<BufWriter<File>>>>,
    area: Rect,
}

impl Screen {
    /// Takes the terminal of stdin and stdout over.
    pub(super) fn open() -> io::Result<Self> {
        // This handle avoids the standard library's lock, which a stalled thread could hold while
        // another one panics.
        let stdout = File::from(io::stdout().as_fd().try_clone_to_owned()?);
        let before = panic::take_hook();
        panic::set_hook(Box::new(move |panic| {
            let _ = leave(&mut io::stdout());
            let _ = terminal::disable_raw_mode();
            before(panic);
        }));
        // The map is its colours, so they are drawn where NO_COLOR is set, too.
        force_color_output(true);
        terminal::enable_raw_mode()?;
        let mut out = BufWriter::new(stdout);
        execute!(out, EnterAlternateScreen, Hide, Clear(ClearType::All))?;
        let area = area();
        let viewport = Viewport::Fixed(area);
        let backend = CrosstermBackend::new(out);
        let terminal = Terminal::with_options(backend, TerminalOptions { viewport })?;
        Ok(Self {
            terminal: ManuallyDrop::new(terminal),
            area,
        })
    }

    /// Draws.
    pub(super) fn draw(&mut self, picture: impl FnOnce(&mut Frame)) -> io::Result<()> {
        let area = area();
        if self.area != area {
            self.area = area;
            self.forget()?;
        }
        self.terminal.draw(picture).map(drop)
    }

    /// Forgets what the terminal shows, so that the next picture is written as a whole.
    pub(super) fn forget(&mut self) -> io::Result<()> {
        self.terminal.resize(self.area)
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        let _ = leave(self.terminal.backend_mut());
        let _ = terminal::disable_raw_mode();
    }
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
